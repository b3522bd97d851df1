"""MO-PPO: a short run, its likelihoods and its anchor by hand, and what it refuses."""

from __future__ import annotations

import json
import pickle
import shutil
import sys
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint, CheckpointRotation
from torchrl.data import Bounded

from envs import NavigationEnv
from recipes.mo_ppo import mo_ppo
from recipes.mo_ppo.optimizers import lmbda, make_schedule, noise
from recipes.training.checkpoint import SafeStateAdapter
from tests._command import run_here
from torchrl_morl import PreferenceSpace
from torchrl_morl.data import save_demonstrations
from torchrl_morl.deploy import load_policy, save_policy, save_reward_model
from torchrl_morl.deploy.features import OBSERVATION_SIZE
from torchrl_morl.modules import RewardModel, make_actor

SPACE = PreferenceSpace(NavigationEnv.objectives, static={"core": 1.0})
SHIPPED = Path(mo_ppo.__file__).parents[1] / "policies" / "navigation"
CONFIG = {
    "seed": 7,
    "env": {
        "scene": "exploring",
        "robot": "turtlebot2",
        "goal_radius": 0.3,
        "max_episode_steps": 20,
        "num_envs": 24,
    },
    "evaluation": {"scene": "static", "episodes": 50},
}
TINY = (
    # Settings of the process: other tests run in it.
    "compute.torch_threads=1",
    "compute.bfloat16=false",
    "env.num_threads=1",
    "env.num_envs=4",
    "collector.frames_per_batch=32",
    "collector.total_frames=128",
    "optim.batch_size=16",
    "optim.critic_batches=1",
    "network.num_cells=[16,16]",
    "evaluation.interval=64",
    "evaluation.episodes=2",
    "logger.backends=[csv]",
)


def small_policy(folder: Path, preference_space: PreferenceSpace = SPACE) -> Path:
    torch.manual_seed(0)
    spec = Bounded(-1.0, 1.0, (2,))
    size = OBSERVATION_SIZE + preference_space.num_tunable
    actor = make_actor(spec, in_features=size, num_cells=(8,), last_layer_gain=1.0)
    return save_policy(
        folder,
        actor,
        preference_space=preference_space,
        card={"config": CONFIG},
    )


def run(folder: Path, policy: Path, *overrides: str) -> Path:
    run_here(
        mo_ppo.main,
        f"policy={policy}",
        *TINY,
        *overrides,
        f"hydra.run.dir={folder}",
    )
    return folder


@pytest.fixture(scope="module")
def polished(tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("mo_ppo")
    start = small_policy(folder / "start")
    return start, run(folder / "run", start)


def test_writes_policies_that_load(polished):
    start, folder = polished
    saved = sorted((folder / "policies").glob("*"))
    assert [path.name for path in saved] == ["000000064", "000000128"]
    policy = load_policy(saved[-1])
    actor, preference_space, card = policy.actor, policy.preference_space, policy.card
    assert preference_space == SPACE
    assert card["start"]["config"] == CONFIG
    assert card["config"]["loss"]["lmbda"] == 0.8
    # What was null is what the policy was trained in, but for the scene: that of its evaluations.
    own = {"scene": "static", "num_envs": 4, "num_threads": 1, "repeat_failed": 0.25}
    assert card["config"]["env"] == CONFIG["env"] | own
    assert card["config"]["evaluation"]["scene"] == "static"
    before = load_policy(start).actor
    assert actor.state_dict().keys() == before.state_dict().keys()
    assert any(
        not torch.equal(value, before.state_dict()[name])
        for name, value in actor.state_dict().items()
    )
    assert (folder / "run.json").is_file()


def test_same_seed_same_policy(polished, tmp_path):
    start, folder = polished
    again = run(tmp_path / "run", start)
    name = "policies/000000128/policy.safetensors"
    assert (again / name).read_bytes() == (folder / name).read_bytes()


def test_critic_learns_first(polished, tmp_path):
    start, _ = polished
    folder = run(tmp_path / "run", start, "optim.critic_batches=4")
    actor = load_policy(folder / "policies" / "000000128").actor
    before = load_policy(start).actor
    for name, value in actor.state_dict().items():
        assert torch.equal(value, before.state_dict()[name]), name


def test_critic_alone_learns_whole_returns_in_more_passes(polished, tmp_path, monkeypatch):
    start, _ = polished
    seen, plain_advantage, plain_step = [], mo_ppo.make_advantage, mo_ppo.step

    def make_advantage(*args):
        advantage = plain_advantage(*args)

        def recorded(module, _):
            seen.append(round(module.lmbda.item(), 6))

        advantage.register_forward_pre_hook(recorded)
        return advantage

    def step(optimizer, loss, *args):
        seen.append("step")
        return plain_step(optimizer, loss, *args)

    monkeypatch.setattr(mo_ppo, "make_advantage", make_advantage)
    monkeypatch.setattr(mo_ppo, "step", step)
    run(tmp_path / "run", start, "optim.critic_batches=2", "optim.critic_epochs=3")
    # Four batches of two small ones: of the critic, and then of the critic and of the actor.
    alone, both = [1.0, *["step"] * 2 * 3], [0.8, *["step"] * 2 * 2]
    assert seen == [*alone, *alone, *both, *both]


def test_anchor_holds_a_policy_with_demonstrations(tmp_path):
    objectives = ("core", "demo", *SPACE.tunable)
    start = small_policy(tmp_path / "start", PreferenceSpace(objectives, static={"core": 1.0}))
    torch.manual_seed(0)
    model = RewardModel(in_features=OBSERVATION_SIZE + 2, num_cells=(8,), num_members=1)
    save_reward_model(tmp_path / "model", model, card={})
    moved = []
    for coefficient in (1e-9, 1e6):
        folder = run(
            tmp_path / str(coefficient),
            start,
            f"demonstrations.reward_model={tmp_path / 'model'}",
            f"loss.anchor_coeff={coefficient}",
            "loss.anchor_radius=100",  # everywhere: few of these short episodes meet the human
            "env.max_episode_steps=300",  # what ends too late is not held
            *("optim.lr=1e-2", "optim.epochs=3"),
            *("collector.total_frames=320", "evaluation.interval=320"),
        )
        rows = (folder / "log_csv/scalars/train/anchor.csv").read_text().split()
        moved.append(float(rows[-1].split(",")[-1]))
    assert 0 < moved[1] < moved[0] / 2, moved


def test_smoothness_steadies_a_policy(polished, tmp_path):
    start, _ = polished
    changes = []
    for coefficient in (1e-9, 1e6):
        folder = run(
            tmp_path / str(coefficient),
            start,
            f"loss.smoothness_coeff={coefficient}",
            *("optim.lr=1e-2", "optim.epochs=3"),
            *("collector.total_frames=320", "evaluation.interval=320"),
        )
        rows = (folder / "log_csv/scalars/train/smoothness.csv").read_text().split()
        changes.append(float(rows[-1].split(",")[-1]))
        assert (folder / "log_csv/scalars/train/failed.csv").exists()
    assert 0 < changes[1] < changes[0] / 2, changes


def test_trains_in_bfloat16(polished, tmp_path, monkeypatch):
    start, folder = polished
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True})
    rounded = run(tmp_path / "run", start, "compute.bfloat16=null")
    name = "policies/000000128"
    cards = [load_policy(path / name).card for path in (folder, rounded)]
    assert [card["bfloat16"] for card in cards] == [False, True]
    weights = [load_policy(path / name).actor.state_dict() for path in (folder, rounded)]
    assert all(value.dtype == torch.float32 for value in weights[1].values())
    moved = [torch.equal(weights[0][key], weights[1][key]) for key in weights[0]]
    assert not all(moved)


@pytest.fixture
def begun(polished, tmp_path) -> Path:
    """A run folder of its own, whose training is over."""
    return shutil.copytree(polished[1], tmp_path / "begun")


def go_on(folder: Path, *overrides: str) -> None:
    run_here(mo_ppo.main, f"resume={folder}", *overrides)


def refused(folder: Path, monkeypatch, capsys, *overrides: str) -> str:
    """The line that a user reads who cannot go on with a run."""
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    monkeypatch.setattr(sys, "argv", ["recipe.py", f"resume={folder}", *overrides])
    with pytest.raises(SystemExit) as stop:
        mo_ppo.main()
    assert stop.value.code in (1, 2)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    return line


class Sink:
    """Holds what was saved."""

    def load_state_dict(self, state):
        self.state = state

    def state_dict(self):
        return {}


def saved_state(checkpoint: Path, name: str) -> dict:
    sink = Sink()
    reader = Checkpoint()
    reader.register(name, sink, adapter=SafeStateAdapter())
    assert not reader.load(checkpoint, strict="warn").incompatible
    return sink.state


def test_goes_on_from_the_last_checkpoint(begun):
    before = {path: path.read_bytes() for path in begun.glob("policies/*/*")}
    # The actor waits for the critic: what is saved at the end is what was loaded.
    go_on(begun, "collector.total_frames=192", "optim.critic_batches=100")
    names = ["000000064", "000000128", "000000192"]
    assert sorted(path.name for path in (begun / "policies").iterdir()) == names
    assert before == {path: path.read_bytes() for path in before}
    weights = [load_policy(begun / "policies" / name).actor.state_dict() for name in names]
    for name, value in weights[2].items():
        torch.testing.assert_close(value, weights[1][name], rtol=0, atol=0)
    assert any(not torch.equal(value, weights[0][name]) for name, value in weights[2].items())
    # What was given at the start still counts.
    config = load_policy(begun / "policies" / "000000192").card["config"]
    assert (config["env"]["num_envs"], config["optim"]["batch_size"]) == (4, 16)
    # And so does the critic's optimizer: 2 updates a pass over a batch of 32 frames. Of the first run
    # one batch in three passes and three in one; of the second, whose critic is alone, two in three.
    (last,) = (begun / "checkpoints").iterdir()
    assert saved_state(last, "count") == {"frames": 192, "begin": 192}
    steps = {int(entry["step"]) for entry in saved_state(last, "critic")["state"].values()}
    assert steps == {2 * (3 + 3) + 2 * (3 + 3)}


def test_checkpoints_say_where_the_schedule_begins(polished, tmp_path, monkeypatch):
    start, _ = polished
    saved, save = [], CheckpointRotation.save

    def record(self, *args, **kwargs):
        path = save(self, *args, **kwargs)
        count = saved_state(path, "count")
        saved.append((count["frames"], count["begin"]))
        return path

    monkeypatch.setattr(CheckpointRotation, "save", record)
    folder = run(tmp_path / "run", start)
    # Cut short anywhere it goes on with its own schedule; what follows its end begins another.
    assert saved == [(64, 0), (128, 128)]
    go_on(folder, "collector.total_frames=256")
    assert saved[2:] == [(192, 128), (256, 256)]


@pytest.mark.parametrize("count", [{"frames": 128}, {"frames": 128, "begin": "soon"}])
def test_refuses_a_checkpoint_that_does_not_say_where_it_stands(begun, count, monkeypatch, capsys):
    (state,) = begun.glob("checkpoints/*/components/*-count/state.json")
    state.write_text(json.dumps({"dict": list(count.items())}))
    line = refused(begun, monkeypatch, capsys, "collector.total_frames=192")
    assert "does not fit this training" in line
    assert f"it must say frames, begin, it says {count}." in line
    assert not (begun / "policies" / "000000192").exists()


class Bomb:
    """Leaves a file behind when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


READ = (
    ".hydra/overrides.yaml",
    "run.json",
    "log_csv/scalars/train/failed.csv",
    "checkpoints/*/manifest.json",
    *(
        f"checkpoints/*/components/*-{name}/state.{ending}"
        for name in (
            *("loss", "advantage", "averaged", "actor", "critic"),
            *("collector", "count", "generators"),
        )
        for ending in ("json", "safetensors")
    ),
)
"""What a resume reads of a run folder."""


@pytest.mark.parametrize("name", READ)
def test_a_pickle_in_a_run_is_not_opened(begun, name, tmp_path, monkeypatch, capsys):
    (file,) = begun.glob(name)
    trace = tmp_path / "trace"
    for plant in (
        lambda: file.write_bytes(pickle.dumps(Bomb(trace))),
        lambda: torch.save({"state": Bomb(trace)}, file),
        lambda: file.write_text(f"!!python/object/apply:pathlib.Path.touch [{trace}]\n"),
    ):
        plant()
        line = refused(begun, monkeypatch, capsys, "collector.total_frames=192")
        assert str(begun) in line
        assert not trace.exists()
    assert not (begun / "policies" / "000000192").exists()


def test_a_checkpoint_in_a_format_with_pickles_is_not_opened(begun, tmp_path, monkeypatch, capsys):
    trace = tmp_path / "trace"
    (manifest,) = begun.glob("checkpoints/*/manifest.json")
    content = json.loads(manifest.read_text())
    for record in content["components"].values():
        record.update(adapter="torchrl.state_dict", files=["state.pt"])
        torch.save({"state": Bomb(trace)}, manifest.parent / record["path"] / "state.pt")
    manifest.write_text(json.dumps(content))
    line = refused(begun, monkeypatch, capsys, "collector.total_frames=192")
    assert "does not fit this training" in line
    assert not trace.exists()


def test_all_that_a_checkpoint_holds_is_safe_to_read(begun):
    files = {path.name for path in begun.glob("checkpoints/*/components/*/*")}
    assert files == {"state.json", "state.safetensors"}
    components = {path.name.split("-")[1] for path in begun.glob("checkpoints/*/components/*")}
    assert components == {
        name.split("*-")[1].split("/")[0] for name in READ if "components" in name
    }


def test_the_rate_falls_over_all_frames_of_a_training():
    def rates(frames, total, steps, *, begin=0, loaded=None):
        """Of the actor, at the first batch and after every further one."""
        optimizer = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))], lr=0.2)
        if loaded is not None:
            optimizer.load_state_dict(loaded)
        cfg = OmegaConf.create(
            {
                "collector": {"total_frames": total, "frames_per_batch": 10},
                "optim": {"lr": 0.2, "critic_batches": 2},
            }
        )
        schedule = make_schedule(cfg, optimizer, frames, begin)
        found = [optimizer.param_groups[0]["lr"]]
        for _ in range(steps):
            optimizer.step()
            schedule.step()
            found.append(optimizer.param_groups[0]["lr"])
        return found, optimizer.state_dict()

    # Twelve batches, two of which are for the critic alone: ten steps down to a twentieth.
    whole, over = rates(0, 120, 10)
    assert whole == pytest.approx([0.2 - 0.019 * step for step in range(11)])
    # Cut after six batches, four of which had an update.
    cut = rates(0, 120, 4)[1]
    assert rates(60, 120, 6, loaded=cut)[0] == pytest.approx(whole[4:])
    # Cut while the critic was alone.
    assert rates(10, 120, 0, loaded=cut)[0] == pytest.approx([0.2])
    # It was over, and goes on for ten batches; that was cut after four.
    assert rates(120, 220, 10, begin=120, loaded=over)[0] == pytest.approx(whole)
    assert rates(160, 220, 6, begin=120, loaded=cut)[0] == pytest.approx(whole[4:])


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("optim.batch_size=64", "optim.batch_size must lie between"),
        ("collector.exploration_sigma=[0.05,0]", "exploration_sigma must be positive"),
        ("loss.anchor_coeff=-1", "anchor_coeff must not be negative"),
        ("loss.anchor_radius=-1", "anchor_radius must not be negative"),
        ("loss.anchor_clearance=-1", "anchor_clearance must not be negative"),
        ("loss.final_lmbda=1.1", "final_lmbda must be in"),
        ("loss.anchor_window=4", "anchor_window must be an odd number of steps, .* got 4"),
        ("loss.anchor_window=-1", "anchor_window must be an odd number of steps, .* got -1"),
        ("loss.smoothness_coeff=-1", "smoothness_coeff must not be negative"),
        ("loss.standing_coeff=-1", "standing_coeff must not be negative"),
        ("loss.gamma=1.5", "loss.gamma must be in"),
        ("collector.frames_per_batch=30", "must be a multiple of env.num_envs, 4, got 30"),
        ("optim.batch_size=0", "optim.batch_size must lie between"),
        ("optim.penalty_batch_size=0", "penalty_batch_size must be at least 1, got 0"),
        ("optim.critic_epochs=0", "critic_epochs must be at least 1, got 0"),
        ("optim.epochs=0", "optim.epochs must be at least 1, got 0"),
        ("optim.critic_batches=-1", "critic_batches must be at least 0, got -1"),
        ("env.observe_human=false", "observations of 36 entries, here they have 33"),
        ("policy=nowhere", "nowhere"),
        (
            "resume=nowhere",
            "resume=nowhere is no run: it must be the folder of one that has begun.",
        ),
    ],
)
def test_refuses_bad_configurations(polished, tmp_path, override, message):
    start, _ = polished
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        run(tmp_path / "run", start, override)
    assert not (tmp_path / "run" / "policies").exists()


def test_refuses_to_resume_what_is_done(begun):
    files = {path: path.read_bytes() for path in begun.rglob("*") if path.is_file()}
    with pytest.raises(ValueError, match="has seen 128 frames already"):
        go_on(begun)
    after = {path: path.read_bytes() for path in begun.rglob("*") if path.is_file()}
    changed = {path.relative_to(begun).parts[0] for path in after if after[path] != files.get(path)}
    assert changed <= {".hydra"} and after.keys() == files.keys()


def test_refuses_to_resume_in_another_folder(polished, tmp_path):
    start, folder = polished
    with pytest.raises(ValueError, match=r"goes on in its own folder: leave out hydra\.run\.dir"):
        run(tmp_path / "run", start, f"resume={folder}", "collector.total_frames=192")
    assert not (tmp_path / "run").exists()


def test_refuses_a_policy_of_other_objectives(tmp_path):
    with pytest.raises(ValueError, match=r"demonstrations\.reward_model must name"):
        run(tmp_path / "run", SHIPPED)


def test_asks_for_what_the_card_does_not_tell(polished, tmp_path):
    start, _ = polished
    loaded = load_policy(start)
    actor, preference_space, card = loaded.actor, loaded.preference_space, loaded.card
    del card["config"]["env"]["scene"], card["config"]["evaluation"]
    policy = save_policy(
        tmp_path / "policy",
        actor,
        preference_space=preference_space,
        card=card,
    )
    with pytest.raises(ValueError, match=r"does not say what it was trained in: give env\.scene\."):
        run(tmp_path / "run", policy)
    folder = run(tmp_path / "again", policy, "env.scene=corridor")
    card = load_policy(folder / "policies" / "000000128").card
    assert card["config"]["evaluation"]["scene"] == "corridor"


# --- from nothing


def nothing(folder: Path, *overrides: str) -> Path:
    run_here(mo_ppo.main, "preset=nothing", *TINY, *overrides, f"hydra.run.dir={folder}")
    return folder


def test_learns_without_a_policy(tmp_path):
    folder = nothing(tmp_path / "run")
    policy = load_policy(folder / "policies" / "000000128")
    assert policy.preference_space == SPACE
    assert "start" not in policy.card
    config = policy.card["config"]
    assert (config["env"]["scene"], config["evaluation"]["scene"]) == ("static", "static")
    # Null is what PD-MORL trains with.
    assert (config["env"]["goal_radius"], config["env"]["max_episode_steps"]) == (0.3, 300)
    again = nothing(tmp_path / "again")
    name = "policies/000000128/policy.safetensors"
    assert (again / name).read_bytes() == (folder / name).read_bytes()


def test_goes_on_without_a_policy(tmp_path, demonstrated):
    """What was cloned is not cloned again: the actor, which waits, is what was saved."""
    folder = nothing(tmp_path / "run", *demonstrated, "optim.critic_batches=100")
    go_on(folder, "collector.total_frames=192")
    names = ["000000128", "000000192"]
    before, after = (load_policy(folder / "policies" / name).actor.state_dict() for name in names)
    for name, value in before.items():
        torch.testing.assert_close(after[name], value, rtol=0, atol=0)


@pytest.fixture
def demonstrated(tmp_path) -> tuple[str, str]:
    """Options for a style that holds one action everywhere, and a reward model."""
    torch.manual_seed(0)
    data = TensorDict(
        observation=torch.randn(4, 30, OBSERVATION_SIZE),
        action=torch.tensor([0.5, -0.25]).expand(4, 30, 2).clone(),
        mask=torch.ones(4, 30, dtype=torch.bool),
        batch_size=[4, 30],
    )
    file = save_demonstrations(tmp_path / "drives.safetensors", data, {})
    model = RewardModel(in_features=OBSERVATION_SIZE + 2, num_cells=(8,), num_members=1)
    save_reward_model(tmp_path / "model", model, card={})
    return (
        f"demonstrations.reward_model={tmp_path / 'model'}",
        f"demonstrations.dataset={file}",
    )


def test_clones_demonstrations_first(tmp_path, demonstrated):
    """The actor waits for the critic: what is saved is the clone."""
    errors, elsewhere = [], []
    for updates in (0, 300):
        folder = nothing(
            tmp_path / str(updates),
            *demonstrated,
            f"optim.cloning_updates={updates}",
            "optim.critic_batches=100",
        )
        policy = load_policy(folder / "policies" / "000000128")
        corner = policy.preference_space.corners()[policy.preference_space.tunable.index("demo")]
        inputs = TensorDict(
            observation=torch.randn(50, OBSERVATION_SIZE, generator=torch.manual_seed(1)),
            preference=corner.expand(50, -1),
            batch_size=[50],
        )
        action = policy.actor(inputs)["action"]
        errors.append((action - torch.tensor([0.5, -0.25])).square().mean().item())
        inputs["preference"] = (1 - corner).div(2).expand(50, -1)
        elsewhere.append(policy.actor(inputs)["action"].square().mean().item())
    assert errors[1] < 0.02 < errors[0]
    # Where the style is not wished nothing is imitated.
    assert max(elsewhere) < 0.06  # of the style: 0.16


def test_the_noise_falls_geometrically():
    cfg = OmegaConf.create(
        {
            "collector": {
                "exploration_sigma": [0.2, 0.4],
                "final_exploration_sigma": [0.05, 0.1],
                "total_frames": 100,
            }
        }
    )
    torch.testing.assert_close(noise(cfg, 0), torch.tensor([0.2, 0.4]))
    torch.testing.assert_close(noise(cfg, 50), torch.tensor([0.1, 0.2]))
    torch.testing.assert_close(noise(cfg, 100), torch.tensor([0.05, 0.1]))
    torch.testing.assert_close(noise(cfg, 150), torch.tensor([0.05, 0.1]))


def test_lambda_goes_linearly_to_its_last_value():
    cfg = OmegaConf.create(
        {
            "loss": {"lmbda": 0.9, "final_lmbda": 0.7},
            "collector": {"total_frames": 100},
        }
    )
    assert [round(lmbda(cfg, frames), 6) for frames in (0, 50, 100, 150)] == [0.9, 0.8, 0.7, 0.7]
    cfg.loss.final_lmbda = None
    assert lmbda(cfg, 100) == 0.9


@pytest.mark.parametrize(("updates", "anchored"), [(1, True), (0, False)])
def test_a_clone_is_an_anchor_and_what_has_learned_nothing_is_none(
    updates, anchored, tmp_path, demonstrated
):
    folder = nothing(tmp_path / "run", *demonstrated, f"optim.cloning_updates={updates}")
    assert (folder / "log_csv/scalars/train/anchor.csv").exists() == anchored


def test_refuses_demonstrations_without_their_objective(tmp_path, demonstrated):
    with pytest.raises(ValueError, match=r"dataset needs demonstrations\.reward_model"):
        nothing(tmp_path / "run", demonstrated[1])
    assert not (tmp_path / "run").exists()
