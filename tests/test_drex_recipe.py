"""The D-REX recipe and what becomes of it: a reward model, its report, and PD-MORL with it."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from omegaconf import DictConfig, OmegaConf
from safetensors.torch import load_file
from tensordict import TensorDict

from envs.demonstrator import CircleDemonstrator
from envs.policy_env import OBSERVATION_SIZE, make_policy_env
from recipes.drex import report, utils
from recipes.pd_morl import utils as pd_morl
from torchrl_morl.data import load_demonstrations
from torchrl_morl.deploy import load_policy, load_reward_model
from torchrl_morl.modules import RewardModel

ROOT = Path(__file__).resolve().parent.parent
PICTURES = ("degradation.png", "heat_map.png", "style_contrast.png")
STYLES = (
    "demonstration",
    "orbit 0.7 m",
    "orbit 1.3 m",
    "orbit 1.6 m",
    "mirrored",
    "distance keeping",
    "straight",
)
TINY = (
    "demonstrations.count=6",
    "demonstrations.batch=12",
    "cloning.updates=100",
    "cloning.batch_size=64",
    "cloning.num_cells=[16]",
    "noise.levels=[0.0,0.2]",
    "noise.rollouts=4",
    "style_negatives.rollouts=8",
    "reward_model.updates=20",
    "reward_model.num_cells=[16]",
    "reward_model.batch_size=8",
    "diagnostics.rollouts=4",
    "env.num_threads=1",
)


def run(module: str, *args: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", module, *map(str, args)],
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=300,
    )


def distill(folder: Path, *overrides: str) -> subprocess.CompletedProcess[str]:
    return run("recipes.drex.drex", *TINY, *overrides, f"hydra.run.dir={folder}")


def config(recipe: str = "drex", **changes: object) -> DictConfig:
    cfg = OmegaConf.load(ROOT / "recipes" / recipe / "config.yaml")
    for key, value in changes.items():
        OmegaConf.update(cfg, key.replace("__", "."), value)
    return cfg


# --- from the command line


@pytest.fixture(scope="module")
def distilled(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("drex") / "run"
    result = distill(folder)
    assert result.returncode == 0, result.stderr
    warnings = [line for line in result.stderr.splitlines() if "Warning" in line]
    # TorchRL's BCLoss about itself.
    assert all("torchrl/objectives/common.py" in line for line in warnings), warnings
    for text in ("Spearman rho(noise level, mean R)", "lead of the demonstration", *STYLES):
        assert text in result.stdout
    return folder


def test_run_leaves_demonstrations_a_reward_model_and_pictures(distilled):
    data, metadata = load_demonstrations(distilled / "demonstrations.safetensors")
    assert len(data) == 6
    assert utils.succeeded(data).all()
    demonstrator = {"radius": 1.0, "side": "left", "speed": 0.5, "robot": "turtlebot2"}
    assert metadata["demonstrator"] == demonstrator
    for name in PICTURES:
        assert (distilled / name).read_bytes().startswith(b"\x89PNG")
    model, card = load_reward_model(distilled / "reward_model")
    score = model(data.select("observation", "action"))["demo_score"][data["mask"]]
    assert 0 < score.min() < score.max() < 1
    assert card["demonstrator"] == demonstrator


def test_card_holds_the_gates(distilled):
    _, card = load_reward_model(distilled / "reward_model")
    assert card["config"]["reward_model"]["num_cells"] == [16]
    assert card["versions"]["torch"] == torch.__version__
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


def test_one_seed_gives_one_reward_model(distilled, tmp_path):
    again, other = tmp_path / "again", tmp_path / "other"
    assert distill(again).returncode == 0
    for name in ("demonstrations.safetensors", "reward_model/reward_model.safetensors"):
        first, second = load_file(distilled / name), load_file(again / name)
        assert first.keys() == second.keys()
        for key in first:
            assert torch.equal(first[key], second[key]), (name, key)
    # Another seed and, at once, D-REX without the extension.
    result = distill(other, "seed=1", "style_negatives.rollouts=0")
    assert result.returncode == 0, result.stderr
    weights = (distilled / "reward_model" / "reward_model.safetensors").read_bytes()
    assert weights != (other / "reward_model" / "reward_model.safetensors").read_bytes()
    card = json.loads((other / "reward_model" / "reward_model.json").read_text())["card"]
    assert [name for name in card if name.startswith("held_out")] == [
        "held_out_accuracy noise pairs"
    ]
    assert list(card["style_contrast"]) == list(STYLES)


# --- its stages


def group(number: int, count: int = 5, steps: int = 60) -> TensorDict:
    """Trajectories whose observation says who they are; they are near the human halfway."""
    step = torch.arange(steps, dtype=torch.float32).expand(count, steps)
    return TensorDict(
        {
            "observation": torch.stack((torch.full_like(step, number), step), dim=-1),
            "action": torch.zeros(count, steps, 2),
            "human": torch.stack(((step - 25).abs() / 5, torch.zeros_like(step)), dim=-1),
            "mask": torch.ones(count, steps, dtype=torch.bool),
        },
        batch_size=[count, steps],
    )


DEMONSTRATION, CLONE, NOISY, NOISIER, ORBIT, STRAIGHT = range(6)
NOISE = {DEMONSTRATION: 0.0, CLONE: -0.0, NOISY: -0.1, NOISIER: -0.2}


def test_styles_are_compared_with_undisturbed_driving_near_the_human():
    noisy = [(quality, group(number)) for number, quality in NOISE.items()]
    styles = [group(ORBIT), group(STRAIGHT)]
    _, source = utils.ranked_snippets(config(reward_model__near_human=2.0), noisy, styles)
    pairs = source.sample(500)
    preferred, other = (pairs[key, "observation"][:, 0] for key in ("preferred", "other"))
    assert set(preferred[:, 0].tolist()) == {DEMONSTRATION, CLONE}
    assert set(other[:, 0].tolist()) == {ORBIT, STRAIGHT}
    for snippets in (preferred, other):
        assert set(snippets[:, 1].tolist()) == set(range(16, 35))  # within 2 m, see `group`


@pytest.mark.parametrize("styles", [[], [group(ORBIT)]], ids=["plain", "extended"])
def test_noise_is_compared_with_less_noise_anywhere(styles):
    noisy = [(quality, group(number)) for number, quality in NOISE.items()]
    cfg = config(reward_model__snippet_length=20, reward_model__min_gap=0.05)
    sources = utils.ranked_snippets(cfg, noisy, styles)
    assert len(sources) == 1 + bool(styles)
    pairs = sources[0].sample(500)
    preferred, other = (pairs[key, "observation"][:, 0] for key in ("preferred", "other"))
    combinations = {
        (int(better), int(worse))
        for better, worse in zip(preferred[:, 0], other[:, 0], strict=True)
    }
    expected = {(i, j) for i, a in NOISE.items() for j, b in NOISE.items() if a > b}
    assert combinations == expected
    assert set(preferred[:, 1].tolist()) == set(range(41))


def test_other_styles_are_none_of_the_demonstration():
    cfg = config(style_negatives__rollouts=12, env__num_threads=1)
    narrow, mirrored, opposite, straight = utils.other_styles(cfg)
    assert all(len(data) == 3 for data in (narrow, mirrored, opposite, straight))
    for data in (narrow, mirrored, opposite, straight):
        assert torch.equal(data["mask"].any(-1), torch.ones(3, dtype=torch.bool))
    near = [
        data["human"][..., 0].masked_fill(~data["mask"], torch.inf).amin(-1)
        for data in (narrow, mirrored)
    ]
    assert ((torch.cat(near) - 1.0).abs() > 0.05).any()
    # What a robot on the other side sees: the human on its left.
    beside = opposite["mask"] & (opposite["human"][..., 0] < 1.05)
    median = opposite["human"][..., 1][beside].median().item()
    assert median == pytest.approx(math.pi / 2, abs=0.2)


@pytest.mark.parametrize("updates", [100, 500])
def test_cloning_returns_its_best_policy(updates):
    """Also when it ends before the first regular check."""
    observation = torch.rand(12, 30, OBSERVATION_SIZE) - 0.5
    data = TensorDict(
        observation=observation,
        action=observation[..., :2],
        mask=torch.ones(12, 30, dtype=torch.bool),
        batch_size=[12, 30],
    )
    cfg = config(cloning__num_cells=[16], cloning__updates=updates, cloning__lr=1e-2)
    policy, loss = utils.clone_behaviour(cfg, data)
    error = (policy(data.clone())["action"] - data["action"]).square().mean()
    signal = data["action"].square().mean()
    assert error < 0.1 * signal
    assert 0 < loss < 0.1 * signal


AHEAD = torch.tensor([[5.0, 0.1], [4.0, 0.0], [4.0, 0.0]])
BESIDE = torch.tensor([[2.0, 0.2], [1.0, -math.pi / 2], [1.0, math.pi / 2]])


@pytest.mark.parametrize("side", ["left", "right"])
def test_contrast_is_with_the_demonstration_that_was_given(side):
    section = {"radius": 1.2, "side": side, "speed": 0.3}
    cfg = config(**{f"demonstrations__{key}": value for key, value in section.items()})
    seen = TensorDict(goal=AHEAD, human=BESIDE, batch_size=[3])
    expected = CircleDemonstrator(**section, scaled=True)(seen.clone())["action"]
    styles = utils.contrast_styles(cfg)
    assert torch.equal(styles.pop("demonstration")(seen.clone())["action"], expected)
    for name, policy in styles.items():
        action = policy(seen.clone())["action"]
        assert not torch.equal(action, expected), name
        # As fast as demonstrated: what tells styles apart must be the way that they take.
        assert ((action[:, 0] + 1) / 4).max() <= 0.3 + 1e-6, name


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
    _, space, card = load_policy(policy)
    assert space.tunable == ("demo", "distance", "efficiency")
    assert card["evaluation"]["preferences"] == list(corners)
    assert len(card["evaluation"]["frechet"]) == 4
    assert CircleDemonstrator(**card["demonstrator"]).radius == 1.0


def test_prefilled_demonstrations_are_experience_under_their_own_preference(distilled):
    model, _ = load_reward_model(distilled / "reward_model")
    path = distilled / "demonstrations.safetensors"
    cfg = config("pd_morl", demonstrations__dataset=str(path), demonstrations__prefill=4)
    cfg.replay_buffer.size = 2000
    space = pd_morl.make_preference_space(with_demonstrations=True)
    buffer = pd_morl.make_replay_buffer(cfg, space, torch.device("cpu"))
    pd_morl.prefill(cfg, buffer, space, model)
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


def test_reward_model_that_is_missing_fails_before_anything_is_written(tmp_path):
    folder = tmp_path / "run"
    nowhere = f"demonstrations.reward_model={tmp_path / 'nowhere'}"
    result = run("recipes.pd_morl.pd_morl", *TRAINING, nowhere, f"hydra.run.dir={folder}")
    assert result.returncode != 0
    assert "reward_model.safetensors not found: a reward model is a folder" in result.stderr
    assert {path.name for path in folder.glob("*")} <= {".hydra", "pd_morl.log"}
