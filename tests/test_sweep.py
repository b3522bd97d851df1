"""Sweeps over preferences, a change of preference on the way, and what is shown of them."""

from __future__ import annotations

import dataclasses
import json
import math
import subprocess
import sys
from pathlib import Path

import imageio.v2 as imageio
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded

import recipes.figures
import recipes.train
from envs import NavigationEnv, Perturbation
from envs.demonstrator import CircleDemonstrator
from envs.policy_env import OBSERVATION_SIZE
from envs.rendering import gl_context_type
from recipes.figures import Row, sweep_figure, switch_figure
from recipes.film import film
from recipes.sweep import edge, sweep
from recipes.switch import Switch, switch
from torchrl_morl import PreferenceSpace
from torchrl_morl.deploy import save_policy
from torchrl_morl.modules import make_actor

ROOT = Path(__file__).resolve().parent.parent
SPACE = PreferenceSpace(("core", "distance", "efficiency"), static={"core": 1.0})
DEMO_SPACE = PreferenceSpace(("core", "demo", "distance", "efficiency"), static={"core": 1.0})

try:
    gl_context_type()
    NO_GL = ""
except RuntimeError as error:
    NO_GL = str(error)
needs_gl = pytest.mark.skipif(bool(NO_GL), reason=NO_GL)


def bend(preference: torch.Tensor) -> torch.Tensor:
    """Full speed; the first objective asks for a left bend."""
    turn = 0.1 * preference[..., 0]
    return torch.stack((torch.ones_like(turn), turn), dim=-1)


BEND = TensorDictModule(bend, in_keys=["preference"], out_keys=["action"])
STEPS = {"max_episode_steps": 100, "num_threads": 1}


# --- sweep


@pytest.fixture(scope="module")
def swept():
    preferences = edge(SPACE, "efficiency", "distance", 3)
    return sweep(BEND, SPACE, preferences, episodes=20, seed=5, **STEPS)


def test_every_preference_meets_the_same_scenes(swept):
    assert swept.metrics.shape == swept.paths.shape == (3, 20)
    assert swept.scenes.shape == (20,)
    for row in range(3):
        start = swept.paths[row]
        assert torch.equal(start["position"][:, 0], swept.scenes["start"][:, :2])
        assert torch.equal(start["human"][:, 0], swept.scenes["human"][:, :2])
        distance = swept.scenes["goal"].norm(dim=-1).float()
        torch.testing.assert_close(swept.metrics["direct_distance"][row], distance)
    assert swept.scenes["goal"].unique(dim=0).shape == (20, 2)
    assert not torch.equal(swept.paths["position"][0], swept.paths["position"][2])
    again = sweep(BEND, SPACE, swept.preferences[2:], episodes=20, seed=5, **STEPS)
    for name in ("time", "min_human_distance", "path_length"):
        torch.testing.assert_close(
            again.metrics[name][0], swept.metrics[name][2], rtol=0, atol=0, equal_nan=True
        )


def test_scenes_hold_what_a_picture_needs(swept):
    env = NavigationEnv(num_envs=20, seed=5, num_threads=1)
    start = env.reset()
    env.close()
    for name, key in (
        ("start", "pose"),
        ("human", "human_pose"),
        ("goal", ("scene", "goal")),
        ("boxes", ("scene", "boxes")),
    ):
        assert torch.equal(swept.scenes[name], start[key])


def test_table_has_a_row_per_preference(swept):
    header, *rows = swept.table().splitlines()
    assert header.split()[:2] == ["distance", "efficiency"]
    assert "Frechet" not in header
    assert swept.demonstration is None
    assert "frechet" not in swept.metrics.keys()
    weights = [tuple(map(float, row.split()[:2])) for row in rows]
    assert weights == [(0.0, 1.0), (0.5, 0.5), (1.0, 0.0)]
    for row, solved in zip(rows, swept.metrics["success"].sum(-1).tolist(), strict=True):
        assert f"s ({solved})" in row
        assert "m (20)" in row


@pytest.fixture(scope="module")
def demonstrated():
    """The demonstrator itself, as a policy that does not care for preferences."""
    return sweep(
        CircleDemonstrator(scaled=True),
        DEMO_SPACE,
        edge(DEMO_SPACE, "efficiency", "demo", 2),
        episodes=30,
        seed=3,
        demonstrator=CircleDemonstrator(),
        num_threads=1,
    )


def test_the_demonstrator_follows_its_demonstration(demonstrated):
    free, frechet = demonstrated.demonstration["free"], demonstrated.metrics["frechet"]
    assert 3 < free.sum() < 30
    assert frechet[:, free].max() < 1e-3
    assert demonstrated.metrics["success"][:, free].all()
    # Where a box is in its way it hits it, and the rest of the demonstration is missing.
    assert demonstrated.metrics["collision_obstacle"][:, ~free].all()
    assert (frechet[:, ~free] > 0.3).all()


def test_table_with_a_demonstrator_has_the_distance_to_it(demonstrated):
    header, *rows = demonstrated.table().splitlines()
    assert header.split()[:3] == ["demo", "distance", "efficiency"]
    free = int(demonstrated.demonstration["free"].sum())
    assert "Frechet, free (n)" in header and "all (n)" in header
    assert len(rows) == 2
    for row in rows:
        assert f"  0.00 m ({free})" in row
        assert row.endswith(f"{demonstrated.metrics['frechet'][0].mean():.2f} m (30)")


def test_faults_of_the_robot_do_not_change_what_it_was_shown(demonstrated):
    faulty = sweep(
        CircleDemonstrator(scaled=True),
        DEMO_SPACE,
        demonstrated.preferences[:1],
        episodes=4,
        seed=3,
        demonstrator=CircleDemonstrator(),
        perturbation=Perturbation(velocity_noise=0.2, latency=1),
        num_threads=1,
    )
    shown, before = faulty.demonstration, demonstrated.demonstration[:4]
    for row in range(4):
        path = shown["position"][row][shown["mask"][row]]
        assert torch.equal(path, before["position"][row][before["mask"][row]])
    assert (faulty.metrics["frechet"] > 1e-3).all()


def test_sweep_tells_its_progress_and_refuses_what_is_no_preference():
    done = []
    sweep(
        BEND,
        SPACE,
        edge(SPACE, "distance", "efficiency", 2),
        episodes=1,
        seed=0,
        max_episode_steps=3,
        num_threads=1,
        on_preference=done.append,
    )
    assert done == [0, 1]
    with pytest.raises(ValueError, match="preference"):
        sweep(BEND, SPACE, torch.tensor([[0.5, 0.6]]), episodes=1, seed=0)


def test_edge():
    expected = torch.tensor([[0.0, 0.0, 1.0], [0.5, 0.0, 0.5], [1.0, 0.0, 0.0]])
    assert torch.equal(edge(DEMO_SPACE, "efficiency", "demo", 3), expected)
    assert edge(SPACE, "efficiency", "distance").shape == (11, 2)


@pytest.mark.parametrize(("first", "second"), [("core", "distance"), ("distance", "comfort")])
def test_edge_between_what_is_not_tunable(first, second):
    with pytest.raises(ValueError, match=r"'(core|comfort)' is not tunable: choose among"):
        edge(SPACE, first, second)


# --- switch


def test_path_is_the_old_one_up_to_the_change_and_another_one_after_it():
    preferences = torch.tensor([[0.0, 1.0], [1.0, 0.0]])
    change = switch(BEND, SPACE, preferences, switch_step=12)
    first, second, switched = change.paths["position"]
    assert torch.equal(switched[:13], first[:13])  # the start and the 12 steps before
    assert not torch.equal(second[:13], first[:13])
    assert (switched[13:] != first[13:]).any(-1).all()
    low, high = torch.tensor([0.0, -math.pi]), torch.tensor([0.5, math.pi])
    expected = low + (bend(preferences) + 1) / 2 * (high - low)
    torch.testing.assert_close(change.actions[2, 11], expected[0])
    torch.testing.assert_close(change.actions[2, 12], expected[1])
    assert change.separation == pytest.approx((switched[17] - first[17]).norm().item())
    assert change.separation > 0.05


def test_change_between_equal_preferences_changes_nothing():
    change = switch(BEND, SPACE, torch.tensor([[0.5, 0.5], [0.5, 0.5]]), switch_step=10)
    assert torch.equal(change.paths["position"][2], change.paths["position"][0])
    assert change.separation == 0.0


def test_change_without_a_second_to_look_back_on_has_no_separation():
    preferences = torch.tensor([[0.0, 1.0], [1.0, 0.0]])

    def drive(steps):
        return switch(BEND, SPACE, preferences, switch_step=12, max_episode_steps=steps)

    # One second after the change is 5 steps of 0.2 s later, at the end of the 17th.
    assert drive(17).separation == drive(18).separation > 0.05
    assert drive(17).turned > 0
    for too_short in (16, 12, 3):  # the last one ends before the change
        change = drive(too_short)
        assert math.isnan(change.separation) and math.isnan(change.turned)


def test_only_the_two_compared_runs_must_last_for_that_second():
    path = torch.arange(8.0).repeat(3, 1)
    change = Switch(
        paths=TensorDict(
            position=torch.stack((path, path * torch.tensor([[0.0], [0.0], [2.0]])), dim=-1),
            heading=path * torch.tensor([[0.0], [0.0], [math.radians(10)]]),
            mask=torch.ones(3, 8, dtype=torch.bool),
            batch_size=[3],
        ),
        actions=torch.zeros(3, 7, 2),
        switch_step=1,
    )
    assert change.separation == 12.0  # after six steps: one second after the first of them
    assert change.turned == pytest.approx(60.0)
    change.paths["mask"][1, 2:] = False  # the run under the second preference
    assert change.separation == 12.0
    for row in (0, 2):
        mask = change.paths["mask"].clone()
        mask[row, 6:] = False  # what follows the end of an episode means nothing
        ended = dataclasses.replace(change, paths=change.paths.clone().set("mask", mask))
        assert math.isnan(ended.separation) and math.isnan(ended.turned)


# --- pictures


def is_png(path: Path) -> bool:
    return path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 20_000


def row(space: PreferenceSpace, first: str, second: str, demonstrator=None) -> Row:
    kwargs = {"demonstrator": demonstrator, "num_threads": 1, "max_episode_steps": 120}
    results = [
        sweep(
            CircleDemonstrator(scaled=True),
            space,
            edge(space, first, second, 2),
            episodes=episodes,
            seed=3,
            scene=scene,
            **kwargs,
        )
        for episodes, scene in ((1, "showcase"), (4, "static"))
    ]
    return Row(first, second, *results)


def test_sweep_figure_of_two_objectives(tmp_path):
    path = tmp_path / "sweep.png"
    sweep_figure(path, [row(SPACE, "efficiency", "distance")], goal_radius=0.3)
    assert is_png(path)


def test_sweep_figure_of_three_objectives(tmp_path, monkeypatch):
    labels = []
    savefig = recipes.figures.plt.Figure.savefig

    def spy(figure, *args, **kwargs):
        labels.extend(ax.get_ylabel() for ax in figure.axes)
        savefig(figure, *args, **kwargs)

    monkeypatch.setattr(recipes.figures.plt.Figure, "savefig", spy)
    pairs = (("efficiency", "distance"), ("efficiency", "demo"), ("demo", "distance"))
    rows = [row(DEMO_SPACE, *pair, CircleDemonstrator()) for pair in pairs]
    path = tmp_path / "sweep.png"
    sweep_figure(path, rows, goal_radius=0.3)
    assert is_png(path)
    shown = [label.split(" / ")[0] for label in labels if "/" in label and "weight" not in label]
    shown = [label for label in shown if label not in ("x", "y")]
    human, time = "smallest distance to the human", "time to the goal"
    frechet = "Frechet distance to the demonstration"
    assert shown == [human, time, frechet, time, human, frechet]


def test_figures_of_a_policy_that_never_arrives(tmp_path):
    """Early in a training: no time to the goal is defined. That is no reason to warn."""
    results = [
        sweep(
            BEND,
            SPACE,
            edge(SPACE, "efficiency", "distance", 2),
            episodes=2,
            seed=0,
            scene=scene,
            max_episode_steps=5,
            num_threads=1,
        )
        for scene in ("showcase", "static")
    ]
    assert results[1].metrics["time"].isnan().all()
    path = tmp_path / "sweep.png"
    sweep_figure(path, [Row("efficiency", "distance", *results)], goal_radius=0.3)
    assert is_png(path)
    assert "nan s (0)" in results[1].table()


@pytest.mark.parametrize("steps", [300, 5], ids=["", "ended_before_the_change"])
def test_switch_figure(steps, tmp_path):
    preferences = edge(SPACE, "efficiency", "distance", 2)
    change = switch(BEND, SPACE, preferences, max_episode_steps=steps)
    scene = sweep(
        BEND, SPACE, preferences, episodes=1, seed=0, scene="showcase", max_episode_steps=5
    ).scenes[0]
    path = tmp_path / "switch.png"
    switch_figure(
        path,
        change.paths,
        change.actions,
        scene,
        names=("efficiency", "distance", "both"),
        switch_step=change.switch_step,
        goal_radius=0.3,
    )
    assert is_png(path)


@needs_gl
def test_film_has_every_third_step_of_every_preference(tmp_path):
    path = film(
        tmp_path / "film.gif",
        BEND,
        SPACE,
        SPACE.corners(),
        max_episode_steps=14,
        size=(160, 90),
    )
    frames = imageio.mimread(path)
    assert len(frames) == 2 * 4  # steps 3, 6, 9 and 12
    assert all(frame.shape[:2] == (90, 160) for frame in frames)


# --- recipes.demo


@pytest.fixture(scope="module")
def policy(tmp_path_factory) -> Path:
    """Drives ahead at full speed, into the human of the showcase."""
    torch.manual_seed(0)
    space, cells = DEMO_SPACE, (8,)
    actor = make_actor(
        Bounded(-1.0, 1.0, (2,)),
        in_features=OBSERVATION_SIZE + space.num_tunable,
        num_cells=cells,
    )
    with torch.no_grad():
        actor[0].module[-1].bias.copy_(torch.tensor([5.0, 0.0]))
    return save_policy(
        tmp_path_factory.mktemp("policies") / "tiny",
        actor,
        space=space,
        observation_size=OBSERVATION_SIZE,
        action_size=2,
        num_cells=cells,
        card={"demonstrator": {"radius": 1.0, "side": "left", "speed": 0.5}},
    )


@needs_gl
def test_demo_leaves_pictures_and_a_film(policy, tmp_path):
    arguments = ("--policy", policy, "--output", tmp_path, "--episodes", 2, "--steps", 2)
    result = subprocess.run(
        [sys.executable, "-m", "recipes.demo", *map(str, arguments)],
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert result.returncode == 0, result.stderr
    assert "Warning" not in result.stderr
    names = ["sweep.gif", "switch.png", "trajectories.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert all(name in result.stdout for name in names)
    for first, second in (("efficiency", "distance"), ("demo", "distance")):
        pair = f"from {first} to {second}", f"from {second} to {first}"
        assert any(text in result.stdout for text in pair)
    assert result.stdout.count("Spearman rho of weight and mean metric") == 3
    assert "demo -> frechet" in result.stdout
    assert is_png(tmp_path / "trajectories.png") and is_png(tmp_path / "switch.png")
    # Each of the three corners drives for about 40 steps before it hits the human.
    assert 30 < len(imageio.mimread(tmp_path / "sweep.gif")) < 50


# --- recipes.train


def save_scores(folder: Path, scores: list[float]) -> None:
    for index, score in enumerate(scores, start=1):
        policy = folder / "policies" / f"{index * 1000:09d}"
        policy.mkdir(parents=True)
        (policy / "policy.json").write_text(json.dumps({"card": {"score": score}}))


@pytest.mark.parametrize(
    ("scores", "best"),
    [
        ([9, 9, 9, 9, 9, 9, 9, 9, 1, 2], 10),
        ([9, 9, 9, 9, 9, 9, 9, 9, 2, 1], 9),
        ([3, 2, 1], 3),
        ([-4], 1),
    ],
)
def test_final_policy_is_the_best_of_the_last_fifth(scores, best, tmp_path):
    save_scores(tmp_path, scores)
    assert recipes.train.final_policy(tmp_path).name == f"{best * 1000:09d}"


@pytest.mark.parametrize("folder_exists", [False, True])
def test_training_that_saved_no_policy_is_named(folder_exists, tmp_path):
    if folder_exists:
        (tmp_path / "policies").mkdir()
    with pytest.raises(SystemExit) as stop:
        recipes.train.final_policy(tmp_path)
    message = str(stop.value)
    assert f"{tmp_path / 'policies'} holds no policy" in message
    assert "--pd-morl collector.total_frames=" in message


def test_train_runs_its_stages_one_after_the_other(tmp_path, monkeypatch, capsys):
    calls = []

    def run(name, command):
        calls.append((name, command))
        if name == "PD-MORL":
            save_scores(tmp_path / "run" / "pd_morl", [1, 2])
        return 1.0

    monkeypatch.setattr(recipes.train, "run", run)
    options = ["--output", str(tmp_path / "run"), "--episodes", "5", "--pd-morl", "seed=1"]
    monkeypatch.setattr(sys, "argv", ["train.py", *options, "--drex", "seed=2"])
    recipes.train.main()
    assert [name for name, _ in calls] == ["D-REX", "PD-MORL", "evaluation"]
    drex, morl, evaluation = (command for _, command in calls)
    folder = tmp_path / "run"
    policy = str(folder / "pd_morl" / "policies" / "000002000")
    assert drex == ["recipes.drex.drex", f"hydra.run.dir={folder / 'drex'}", "seed=2"]
    assert f"demonstrations.reward_model={folder / 'drex' / 'reward_model'}" in morl
    assert f"demonstrations.dataset={folder / 'drex' / 'demonstrations.safetensors'}" in morl
    assert morl[-1] == "seed=1"
    assert evaluation[1:5] == ["--policy", policy, "--episodes", "5"]
    assert f"python -m recipes.demo --policy {policy}" in capsys.readouterr().out


def test_train_refuses_a_folder_that_exists(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(recipes.train, "run", lambda *_: pytest.fail("a stage has begun"))
    monkeypatch.setattr(sys, "argv", ["train.py", "--output", str(tmp_path)])
    with pytest.raises(SystemExit) as stop:
        recipes.train.main()
    assert stop.value.code == 2
    assert f"{tmp_path} exists and is not overwritten" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_train_stops_at_the_first_stage_that_fails():
    with pytest.raises(SystemExit, match="D-REX failed with exit code 2"):
        recipes.train.run("D-REX", ["json.tool", "--no-such-option"])
