"""The baselines: short trainings, their scalar rewards by hand, and what they share with PD-MORL."""

from __future__ import annotations

import json
import sys
from functools import partial
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_module
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

import recipes.evaluate
from envs import NavigationEnv
from envs.policy_env import make_policy_env
from recipes.evaluation.sweep import sweep
from recipes.scalarized import sac, td3
from recipes.scalarized.core import core_only, cut_off_preference
from recipes.scalarized.rewards import make_replay_buffer
from recipes.scalarized.stochastic import make_stochastic_policy
from recipes.training.agent import make_actor
from recipes.training.task import Task
from tests._command import run_here
from tests._task import make_task
from torchrl_morl import PreferenceSpace
from torchrl_morl.deploy import load_policy, save_reward_model
from torchrl_morl.deploy.features import OBSERVATION_SIZE
from torchrl_morl.modules import RewardModel
from torchrl_morl.transforms import PreferenceSampler, ScalarizeReward

SPACE = PreferenceSpace(NavigationEnv.objectives, static={"core": 1.0})
SCRIPTS = {"sac": sac, "td3": td3}
TINY = (
    "collector.total_frames=288",
    "collector.init_random_frames=96",
    "evaluation.interval=192",
    "evaluation.episodes=2",
    "replay_buffer.batch_size=16",
    "replay_buffer.size=288",
    "network.num_cells=[16,16]",
    "logger.interval=96",
    "env.max_episode_steps=20",
    "optim.updates_per_batch=4",
    # A setting of the process: other tests run in it.
)


def train(script: str, folder: Path, *overrides: str) -> Path:
    run_here(SCRIPTS[script].main, *TINY, *overrides, f"hydra.run.dir={folder}")
    return folder


OVERRIDES = {
    "sac": ("loss.gamma=0.98",),
    "td3": ("loss.policy_noise=0.04",),
    "core": ("objective=core",),
}


@pytest.fixture(scope="module", params=OVERRIDES)
def trained(request, tmp_path_factory) -> tuple[str, Path]:
    folder = tmp_path_factory.mktemp(request.param) / "run"
    script = "sac" if request.param == "sac" else "td3"
    return request.param, train(script, folder, *OVERRIDES[request.param])


def configuration(name: str, *overrides: str) -> DictConfig:
    module = "recipes.pd_morl" if name == "config" else "recipes.scalarized"
    with initialize_config_module(module, version_base="1.3"):
        return compose(name, overrides=[*(TINY if name != "config" else ()), *overrides])


def actions(folder: Path, observation: torch.Tensor, preference: torch.Tensor) -> torch.Tensor:
    policy = load_policy(folder)
    assert policy.preference_space == SPACE
    return policy.actor(TensorDict(observation=observation, preference=preference))["action"]


# --- the scripts


def test_training_saves_policies_that_load(trained):
    name, folder = trained
    names = sorted(path.name for path in (folder / "policies").iterdir())
    assert names == ["000000192", "000000288"]
    seen, corners = torch.randn(2, OBSERVATION_SIZE), torch.eye(2)
    after = [actions(folder / "policies" / name, seen, corners) for name in names]
    assert (after[1].abs() <= 1).all()
    assert not torch.equal(*after)  # it learned
    # All preferences of CORE get one action, of the others not.
    same = torch.equal(*actions(folder / "policies" / names[1], seen[:1].expand(2, -1), corners))
    assert same == (name == "core")


def test_run_folder_tells_what_happened(trained):
    name, folder = trained
    text = (folder / "policies" / "000000288" / "policy.json").read_text()
    card = json.loads(text)["card"]
    assert card.get("preference") == ("ignored" if name == "core" else None)
    config = OmegaConf.create(card["config"])
    for override in OVERRIDES[name]:
        key, value = override.split("=")
        assert str(OmegaConf.select(config, key)) == value
    logged = ["train/loss_actor", "train/loss_qvalue", "train/grad_norm", "eval/success"]
    for metric in logged + (["train/alpha", "train/entropy"] if name == "sac" else []):
        with (folder / "log_csv" / "scalars" / f"{metric}.csv").open() as rows:
            values = [float(row.split(",")[1]) for row in rows]
        assert values and all(value == value for value in values), metric
    assert (folder / "run.json").is_file()
    assert any((folder / "checkpoints").iterdir())


def test_policy_is_evaluated_by_the_common_command(trained, monkeypatch, capsys):
    name, folder = trained
    policy = str(folder / "policies" / "000000288")
    arguments = ["--policy", policy, "--episodes", "2", "--preferences", "1,0", "0,1"]
    monkeypatch.setattr(sys, "argv", ["evaluate.py", *arguments])
    # Two episodes of an untrained policy last 300 steps, which a test need not see.
    monkeypatch.setattr(recipes.evaluate, "sweep", partial(sweep, max_episode_steps=10))
    recipes.evaluate.main()
    setting, *rest = capsys.readouterr().out.splitlines()
    if name == "core":
        note, *rest = rest
        assert note.startswith("note: this policy")
    header, *rows = rest
    assert setting == "scene static, robot turtlebot2, drive planar, goal radius 0.3 m"
    assert header.split()[:3] == ["distance", "efficiency", "success"]
    if name == "core":
        assert rows[0].split()[2:] == rows[1].split()[2:]


def test_reward_model_adds_its_objective(tmp_path):
    save_reward_model(
        tmp_path / "model",
        RewardModel(in_features=OBSERVATION_SIZE + 2, num_cells=(8,), num_members=1),
        card={"demonstrator": {"radius": 1.0, "side": "left", "speed": 0.5}},
    )
    folder = train("sac", tmp_path / "run", f"demonstrations.reward_model={tmp_path / 'model'}")
    policy = load_policy(folder / "policies" / "000000288")
    assert policy.preference_space.tunable == ("demo", "distance", "efficiency")
    assert policy.card["demonstrator"]["radius"] == 1.0
    assert "frechet" in policy.card["evaluation"]


@pytest.mark.parametrize(
    ("script", "override", "message"),
    [
        ("td3", "objective=speed", "objective must be 'preference' or 'core', got 'speed'"),
        ("td3", "loss.gamma=1.5", r"loss.gamma must be in \(0, 1\], got 1.5"),
        ("sac", "optim.updates_per_batch=0", "updates_per_batch must be at least 1, got 0"),
        ("sac", "env.scene=nowhere", "Unknown scene 'nowhere'"),
        ("sac", "preference.relabel_ratio=2", r"ratio must be in \[0, 1\], got 2"),
        ("sac", "demonstrations.dataset=x", "dataset needs demonstrations.reward_model"),
        ("sac", "network.min_scale=0", "network.min_scale must be in"),
        ("sac", "loss.alpha_init=0", "loss.alpha_init must be positive, got 0"),
    ],
)
def test_bad_override_fails_before_anything_is_written(script, override, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        train(script, tmp_path / "run", override)
    written = {path.name for path in (tmp_path / "run").glob("*")}
    assert written <= {".hydra", f"{script}.log"}  # by Hydra itself


def test_run_folder_that_holds_policies_is_refused(tmp_path):
    (tmp_path / "run" / "policies").mkdir(parents=True)
    with pytest.raises(FileExistsError, match=r"choose another hydra\.run\.dir"):
        train("td3", tmp_path / "run")


# --- scalar rewards


def test_scalar_reward_of_an_environment_follows_the_sampled_preference():
    sampler = PreferenceSampler(SPACE, seed=0)
    env = TransformedEnv(make_policy_env(sampler, num_envs=4, seed=0), ScalarizeReward(SPACE))
    data = env.rollout(5)
    core, distance, efficiency = data["next", "reward"].unbind(-1)
    first, second = data["preference"].unbind(-1)
    expected = core + first * distance + second * efficiency
    assert torch.allclose(data["next", "scalar_reward"].squeeze(-1), expected)
    assert (data["preference"][:, 0].std(0) > 0).all()


def sampled(cfg: DictConfig, task: Task) -> TensorDict:
    """What is drawn from a buffer that holds one transition."""
    transition = TensorDict(
        observation=torch.zeros(1, OBSERVATION_SIZE),
        preference=torch.tensor([[0.25, 0.75]]),
        action=torch.zeros(1, 2),
        next=TensorDict(
            observation=torch.zeros(1, OBSERVATION_SIZE),
            preference=torch.tensor([[0.25, 0.75]]),
            reward=torch.tensor([[12.0, -4.0, -10.0]]),
            batch_size=1,
        ),
        batch_size=1,
    )
    replay_buffer = make_replay_buffer(cfg, task)
    replay_buffer.extend(transition)
    return replay_buffer.sample()


def test_scalar_reward_of_a_batch_by_hand():
    batch = sampled(configuration("td3"), make_task(SPACE))
    # (12 - 0.25 * 4 - 0.75 * 10) / 100
    assert torch.allclose(batch["next", "scalar_reward"], torch.tensor([[0.035]]))
    assert torch.equal(batch["preference"][0], torch.tensor([0.25, 0.75]))


def test_scalar_reward_of_core_is_the_core_reward():
    batch = sampled(configuration("td3", "objective=core"), core_only(make_task(SPACE)))
    assert torch.allclose(batch["next", "scalar_reward"], torch.tensor([[0.12]]))
    assert not batch["preference"].any()
    assert not batch["next", "preference"].any()


def test_relabelled_preferences_change_the_scalar_reward():
    batch = sampled(configuration("td3", "preference.relabel_ratio=1"), make_task(SPACE))
    first, second = batch["preference"].unbind(-1)
    expected = 0.12 - 0.04 * first - 0.1 * second
    assert torch.allclose(batch["next", "scalar_reward"].squeeze(-1), expected)
    assert batch["preference"].std(0).min() > 0


# --- networks


def test_deterministic_sac_policy_is_the_saved_actor():
    cfg, given = configuration("sac"), make_task(SPACE)
    actor = make_actor(cfg, given)
    policy = make_stochastic_policy(cfg, given, actor)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.normal_()  # through the policy too: they are the same
    seen = TensorDict(
        observation=torch.randn(32, OBSERVATION_SIZE),
        preference=torch.rand(32, 2),
        batch_size=32,
    )
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert torch.allclose(policy(seen.clone())["action"], actor(seen)["action"], atol=1e-5)
    with set_exploration_type(ExplorationType.RANDOM):
        explored = policy(seen.clone())
    assert not torch.allclose(explored["action"], actor(seen)["action"], atol=1e-2)
    assert torch.allclose(explored["loc"], actor(seen)["pre_tanh"])
    shared = {id(parameter) for parameter in actor.parameters()}
    assert shared < {id(parameter) for parameter in policy.parameters()}


def test_actor_of_core_ignores_the_preference_and_keeps_its_bounds():
    cfg, given = configuration("td3"), make_task(SPACE)
    actor = make_actor(cfg, given)
    before = actor[0].module[0].weight.clone()
    cut_off_preference(actor, SPACE)
    weight = actor[0].module[0].weight
    assert not weight[:, OBSERVATION_SIZE:].any()
    assert torch.equal(weight[:, :OBSERVATION_SIZE], before[:, :OBSERVATION_SIZE])
    assert isinstance(given.env.action_spec_unbatched, Bounded)


# --- a fair comparison


@pytest.mark.parametrize("name", ["sac", "td3"])
def test_what_is_not_specific_to_pd_morl_is_as_in_pd_morl(name):
    """Fields that both have agree, but for PD-MORL's own ingredients and the paper's discount."""
    theirs = {"preference.num_segments", "preference.relabel_ratio", "loss.gamma"}
    # PD-MORL is polished by MO-PPO, the baselines are not: longer, and errors that mind collisions.
    theirs |= {"collector.total_frames", "loss.loss_function"}
    with initialize_config_module("recipes.scalarized", version_base="1.3"):
        ours = flat(compose(name))
    reference = flat(configuration("config"))
    shared = ours.keys() & reference.keys()
    assert len(shared) > 25
    different = {key for key in shared if ours[key] != reference[key]}
    assert different <= theirs, {key: (ours[key], reference[key]) for key in different - theirs}
    # What PD-MORL has beyond these must not be left out silently.
    alone = {key for key in reference.keys() - ours.keys() if not key.startswith(("loss", "env"))}
    without_noise = {f"collector.{name}_sigma" for name in ("exploration", "final_exploration")}
    delayed = {"optim.policy_delay"}
    own = {"evaluation.refit_momentum", "network.straight_drive"}
    own |= {"preference.slabs", "preference.relabel_copies"}  # of the paper's configuration
    own |= {"compute.compile", "compute.compile_mode", "compute.bfloat16"}
    workers = ("backend", "num_workers", "worker_cpus", "ray_address")
    own |= {f"collector.{name}" for name in workers}  # the baselines have one process
    assert alone <= own | (without_noise | delayed if name == "sac" else set())


def flat(cfg: DictConfig, prefix: str = "") -> dict[str, object]:
    found = {}
    for key, value in cfg.items():
        if isinstance(value, DictConfig):
            found |= flat(value, f"{prefix}{key}.")
        else:
            found[f"{prefix}{key}"] = value
    return found
