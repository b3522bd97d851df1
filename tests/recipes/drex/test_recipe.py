"""The D-REX recipe and what becomes of it: a reward model, its report, and PD-MORL with it."""

from __future__ import annotations

import importlib.metadata
import json
import math
import subprocess
from pathlib import Path

import matplotlib.axes
import pytest
import torch
from safetensors.torch import load_file
from tensordict import TensorDict

from envs.demonstrations import CircleDemonstrator
from envs.policy_env import make_policy_env
from recipes.drex import drex, report
from recipes.drex.cloning import clone_behaviour
from recipes.drex.demonstrations import demonstrated, demonstrator
from recipes.drex.rollouts import core_return, mean_and_error, rollouts, succeeded
from recipes.training.replay import make_replay_buffer
from recipes.training.task import make_preference_space
from tests._command import run
from tests._drex import TINY, config
from tests._task import make_task
from torchrl_morl.data import load_demonstrations, save_demonstrations
from torchrl_morl.deploy import load_policy, load_reward_model
from torchrl_morl.deploy.features import OBSERVATION_SIZE
from torchrl_morl.modules import RewardModel

PICTURES = ("degradation.png", "heat_map.png", "style_contrast.png")
STYLES = (
    "demonstration",
    "orbit 0.7 m",
    "orbit 1.3 m",
    "orbit 1.6 m",
    "mirrored",
    "cut corners",
    "distance keeping",
    "straight",
)


def distill(folder: Path, *overrides: str) -> subprocess.CompletedProcess[str]:
    return run("recipes.drex.drex", *TINY, *overrides, f"hydra.run.dir={folder}")


# --- from the command line


@pytest.fixture(scope="module")
def distilled(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("drex") / "run"
    result = distill(folder)
    assert result.returncode == 0, result.stderr
    warnings = [line for line in result.stderr.splitlines() if "Warning" in line]
    # TorchRL's BCLoss about itself.
    assert all("torchrl/objectives/common.py" in line for line in warnings), warnings
    lines = (
        "Spearman rho(noise level, mean R)",
        "held-out pairs ranked right",
        "share of R outside [0.02, 0.98]",
        "lead of the demonstration",
    )
    for text in (*lines, *STYLES):
        assert text in result.stdout
    return folder


def test_run_leaves_demonstrations_a_reward_model_and_pictures(distilled):
    data, metadata = load_demonstrations(distilled / "demonstrations.safetensors")
    assert len(data) == 6
    assert succeeded(data).all()
    demonstrator = {"radius": 1.0, "side": "left", "speed": 0.5, "robot": "turtlebot2"}
    assert metadata["demonstrator"] == demonstrator
    for name in PICTURES:
        assert (distilled / name).read_bytes().startswith(b"\x89PNG")
    model, card = load_reward_model(distilled / "reward_model")
    score = model(data.select("observation", "action"))["demo_score"][data["mask"]]
    assert 0 < score.min() < score.max() < 1
    assert card["demonstrator"] == demonstrator


def test_run_leaves_what_a_policy_is_cloned_from(distilled):
    """Drives along demonstrated paths, whose actions lead back to them."""
    data, metadata = load_demonstrations(distilled / "tracked.safetensors")
    assert data["observation"].shape[-1] == OBSERVATION_SIZE
    actions = data["action"][data["mask"]]
    assert actions.shape[-1] == 2 and actions.abs().max() <= 1
    assert metadata["demonstrator"]["radius"] == 1.0
    nearest = data["human"][..., 0].masked_fill(~data["mask"], 9.0).amin(-1)
    assert (nearest > 0.8).all() and (nearest < 1.1).all()


def test_card_holds_the_gates(distilled):
    _, card = load_reward_model(distilled / "reward_model")
    assert card["config"]["reward_model"]["num_cells"] == [16]
    # Of the package: that of the module may have a build behind it.
    assert card["versions"]["torch"] == importlib.metadata.version("torch")
    assert card["noise_levels"] == [0.0, 0.2]
    low, high = card["mean_score_per_level"]
    assert card["spearman_noise_score"] == pytest.approx(1.0 if high > low else -1.0)
    assert list(card["style_contrast"]) == list(STYLES)
    first, *others = card["style_contrast"].values()
    assert card["style_lead"] == pytest.approx(first - max(others))
    assert 0 <= card["share_saturated"] <= 1
    assert math.isfinite(card["behaviour_cloning_loss"])
    for name in ("noise pairs", "style pairs"):
        assert 0 <= card[f"held_out_accuracy {name}"] <= 1
    per_gap = card["held_out_accuracy per noise gap"]
    assert list(per_gap) == ["0.2"]
    assert 0 <= per_gap["0.2"] <= 1


def test_one_seed_gives_one_reward_model(distilled, tmp_path):
    again, other = tmp_path / "again", tmp_path / "other"
    assert distill(again).returncode == 0
    for name in ("demonstrations.safetensors", "reward_model/reward_model.safetensors"):
        first, second = load_file(distilled / name), load_file(again / name)
        assert first.keys() == second.keys()
        for key in first:
            assert torch.equal(first[key], second[key]), (name, key)
    # Another seed and, at once, D-REX without the extension.
    result = distill(other, "seed=1", "style_negatives.rollouts=0", "tracking.rollouts=0")
    assert result.returncode == 0, result.stderr
    weights = (distilled / "reward_model" / "reward_model.safetensors").read_bytes()
    assert weights != (other / "reward_model" / "reward_model.safetensors").read_bytes()
    card = json.loads((other / "reward_model" / "reward_model.json").read_text())["card"]
    assert [name for name in card if name.startswith("held_out")] == [
        "held_out_accuracy noise pairs",
        "held_out_accuracy per noise gap",
    ]
    assert list(card["style_contrast"]) == list(STYLES)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"style_negatives__rollouts": 5}, "rollouts must be 0 or at least 12"),
        ({"reward_model__inputs": ["position"]}, "inputs must be some of"),
    ],
)
def test_what_is_wrong_shows_before_anything_is_run(changes, message):
    """There is not even a run folder: Hydra makes it, which is not called here."""
    with pytest.raises(ValueError, match=message):
        drex.main.__wrapped__(config(**changes))


# --- its stages


def test_the_clone_is_evaluated_as_one_that_ignores_preferences(distilled):
    assert load_policy(distilled / "behaviour_clone").card["preference"] == "ignored"


@pytest.mark.parametrize(("count", "updates"), [(12, 100), (12, 500), (1, 500)])
def test_cloning_returns_its_best_policy(count, updates):
    """Also when it ends before the first regular check, and with nothing to hold out."""
    observation = torch.rand(count, 30, OBSERVATION_SIZE) - 0.5
    data = TensorDict(
        observation=observation,
        action=observation[..., :2],
        mask=torch.ones(count, 30, dtype=torch.bool),
        batch_size=[count, 30],
    )
    cfg = config(cloning__num_cells=[16], cloning__updates=updates, cloning__lr=1e-2)
    policy, loss = clone_behaviour(cfg, data)
    error = (policy(data.clone())["action"] - data["action"]).square().mean()
    signal = data["action"].square().mean()
    assert error < 0.1 * signal
    assert 0 < loss < 0.1 * signal


# --- the report


def test_mean_and_error():
    mean, error = mean_and_error(torch.tensor([[1.0, 2.0, 3.0], [4.0, 4.0, 4.0]]))
    assert mean.tolist() == [2.0, 4.0]
    assert error.tolist() == pytest.approx([3**-0.5, 0.0])
    for count in (0, 1):
        mean, error = mean_and_error(torch.ones(2, count))
        assert mean.isnan().all() == (count == 0)
        assert error.isnan().all()


def test_core_return_is_a_share_of_the_way():
    data = TensorDict(
        {
            "goal": torch.tensor([[8.0, 0.0]]).expand(2, 3, 2),
            "mask": torch.tensor([[True, True, True], [True, True, False]]),
            "next": {"reward": torch.tensor([[500.0, 250.0, 250.0], [500.0, -1000.0, 7.0]])},
        },
        batch_size=[2, 3],
    )
    data["next", "reward"] = torch.stack((data["next", "reward"], torch.ones(2, 3)), dim=-1)
    assert core_return(data).tolist() == [1.0, -0.5]


def test_degradation_is_measured_against_the_demonstrated_paths(tmp_path, monkeypatch):
    """Whoever drives as demonstrated is 0 m off, in fewer scenes than were rolled out, too."""
    cfg = config(overrides=TINY, noise__rollouts=16, diagnostics__rollouts=12)
    data = rollouts(demonstrator(cfg), 16, cfg.seed + 10_000, **cfg.env)
    free = demonstrated(cfg, 16, cfg.seed + 10_000)["free"]
    assert torch.equal(succeeded(data), free)
    assert 3 < free[:12].sum() < 12
    seen = []
    monkeypatch.setattr(
        matplotlib.axes.Axes, "errorbar", lambda ax, *points, **style: seen.append(points)
    )
    backwards = data.clone()  # of the goal, by all of the way
    backwards["next", "reward"] = -data["next", "reward"]
    groups = [(0.0, data), (-0.2, backwards)]
    report.degradation_figure(tmp_path / "degradation.png", cfg, groups)
    (levels, core, core_error), (_, frechet, frechet_error) = seen
    assert levels == [0.0, 0.2]
    expected = core_return(data[:12]).mean().item()
    assert core.tolist() == pytest.approx([expected, -expected])
    assert (core_error > 0).all()
    assert frechet.abs().max() < 1e-4
    assert frechet_error.abs().max() < 1e-4


# --- the report's own observation


def test_observation_of_the_report_is_the_environments():
    """Poses around a human, with nothing else in sight: every entry, also of grazing sectors."""
    count, goal = 300, 4.0
    distance = 0.45 + 4.2 * torch.rand(count, dtype=torch.float64)
    around, heading = (torch.rand(2, count, dtype=torch.float64) * 2 - 1) * math.pi
    position = distance[:, None] * torch.stack((around.cos(), around.sin()), dim=-1)
    env = make_policy_env(
        keep_simulation=True, num_envs=count, num_threads=1, scene="empty", seed=0
    )
    state = env.reset()
    state["qpos"] = torch.cat((position, heading[:, None]), dim=-1)
    state["human_pose"].zero_()
    state["scene", "goal"].copy_(torch.tensor([goal, 0.0]))
    expected = env.reset(state, set_state=True)["observation"]
    env.close()
    found = report.observation(position, heading, goal)
    assert found.shape == (count, OBSERVATION_SIZE)
    torch.testing.assert_close(found.float(), expected, rtol=0, atol=1e-5)
    lidar = expected[:, :30]
    assert ((lidar < 0).any(-1) == (distance < 4.25)).all()
    assert ((lidar < 0).sum(-1)).unique().numel() > 3


@pytest.mark.parametrize(("radius", "side"), [(1.0, "left"), (1.4, "left"), (1.0, "right")])
def test_heat_map_heads_as_demonstrated(radius, side, tmp_path):
    """Its left picture is what the demonstrator would do there, once it has turned."""
    section = {"radius": radius, "side": side}
    cfg = config(**{f"demonstrations__{key}": value for key, value in section.items()})
    seen: list[TensorDict] = []

    class Spy(RewardModel):
        def forward(self, data):
            seen.append(data.clone())
            return super().forward(data)

    model = Spy(in_features=OBSERVATION_SIZE + 2, num_cells=(4,)).requires_grad_(False)
    report.heat_map(tmp_path / "heat_map.png", cfg, model)
    assert (tmp_path / "heat_map.png").stat().st_size > 10_000
    data = seen[0].reshape(-1)
    features = data["observation"][:, 30:].unflatten(-1, (2, 3))
    polar = torch.stack(
        (
            features[..., 0] * torch.tensor([5.0, 2.0]),
            torch.atan2(features[..., 1], features[..., 2]),
        ),
        dim=-1,
    )
    goal, human = polar.unbind(1)
    demonstrated = CircleDemonstrator(**section, scaled=True)(
        TensorDict(goal=goal, human=human, batch_size=goal.shape[:1])
    )
    # On the circle, before it leaves: no correction is due.
    orbit = (human[:, 0] - radius).abs() < 0.02
    mirror = 1.0 if side == "left" else -1.0
    beside = orbit & ((human[:, 1] * mirror + math.pi / 2).abs() < 1e-3)
    assert beside.sum() > 10
    torch.testing.assert_close(
        data["action"][beside], demonstrated["action"][beside], rtol=0, atol=0.12
    )
    assert (data["action"][beside][:, 1] * mirror < -0.05).all()


# --- PD-MORL with the objective "demo"

TRAINING = (
    "collector.total_frames=576",
    "collector.init_random_frames=480",
    "collector.frames_per_batch=96",
    "evaluation.interval=576",
    "evaluation.episodes=3",
    "replay_buffer.batch_size=16",
    "network.num_cells=[16,16]",
    "env.max_episode_steps=30",
    "optim.updates_per_batch=4",
    "logger.interval=96",
    "logger.backends=[csv]",
)


@pytest.mark.slow
def test_demonstrations_become_an_objective(distilled, tmp_path):
    demonstrations = (
        f"demonstrations.reward_model={distilled / 'reward_model'}",
        f"demonstrations.dataset={distilled / 'demonstrations.safetensors'}",
        "demonstrations.prefill=4",
    )
    folder = tmp_path / "run"
    overrides = (*TRAINING, *demonstrations, f"hydra.run.dir={folder}")
    result = run("recipes.pd_morl.pd_morl", *overrides)
    assert result.returncode == 0, result.stderr
    corners = ("demo", "distance", "efficiency", "balanced")
    for column in ("success", "frechet all"):
        for name in corners:
            path = folder / "log_csv" / "scalars" / "eval" / column / f"{name}.csv"
            ((step, value),) = [line.split(",") for line in path.read_text().split()]
            assert int(float(step)) == 576
            assert math.isfinite(float(value))
    policy = folder / "policies" / "000000576"
    loaded = load_policy(policy)
    assert loaded.preference_space.tunable == ("demo", "distance", "efficiency")
    assert loaded.card["evaluation"]["preferences"] == list(corners)
    assert len(loaded.card["evaluation"]["frechet"]) == 4
    assert CircleDemonstrator(**loaded.card["demonstrator"]).radius == 1.0


def test_prefilled_demonstrations_are_experience_under_their_own_preference(distilled):
    model, _ = load_reward_model(distilled / "reward_model")
    path = distilled / "demonstrations.safetensors"
    cfg = config("pd_morl", demonstrations__dataset=str(path), demonstrations__prefill=4)
    cfg.replay_buffer.size = 2000
    preference_space = make_preference_space(with_demonstrations=True)
    buffer = make_replay_buffer(cfg, make_task(preference_space, reward_model=model))
    data, _ = load_demonstrations(path)
    data = data[:4][data[:4]["mask"]]
    assert len(buffer) == len(data)
    stored = buffer.storage[:]
    score = model(data.select("observation", "action"))["demo_score"]
    core, distance, efficiency = data["next", "reward"].split(1, dim=-1)
    expected = torch.cat((core, 10 * (score - 1), distance, efficiency), dim=-1)
    torch.testing.assert_close(stored["next", "reward"], expected)
    for key in ("preference", ("next", "preference")):
        assert (stored[key] == torch.tensor([1.0, 0.0, 0.0])).all()
    assert stored["next", "done"].sum() == 4


def test_drives_without_rewards_are_no_experience(distilled, tmp_path):
    """Their actions lead back to the path; others were driven."""
    model, _ = load_reward_model(distilled / "reward_model")
    data, card = load_demonstrations(distilled / "demonstrations.safetensors")
    path = save_demonstrations(tmp_path / "tracked.safetensors", data.exclude("next"), card)
    cfg = config("pd_morl", demonstrations__dataset=str(path))
    task = make_task(make_preference_space(with_demonstrations=True), reward_model=model)
    with pytest.raises(ValueError, match=r"tracked.safetensors' has no rewards: give the demons"):
        make_replay_buffer(cfg, task)


def test_reward_model_that_is_missing_fails_before_anything_is_written(tmp_path):
    folder = tmp_path / "run"
    nowhere = f"demonstrations.reward_model={tmp_path / 'nowhere'}"
    result = run("recipes.pd_morl.pd_morl", *TRAINING, nowhere, f"hydra.run.dir={folder}")
    assert result.returncode != 0
    assert "reward_model.safetensors not found: a reward model is a folder" in result.stderr
    assert {path.name for path in folder.glob("*")} <= {".hydra", "pd_morl.log"}
