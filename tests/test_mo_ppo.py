"""MO-PPO: a short run, its likelihoods and its anchor by hand, and what it refuses."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_module
from omegaconf import DictConfig
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from envs import NavigationEnv
from envs.policy_env import OBSERVATION_SIZE
from recipes.mo_ppo import mo_ppo, utils
from tests._command import run_here
from torchrl_morl import PreferenceSpace
from torchrl_morl.deploy import load_policy, save_policy, save_reward_model
from torchrl_morl.modules import RewardModel, make_actor, make_vector_critic
from torchrl_morl.objectives import MultiObjectiveGAE

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


def small_policy(folder: Path, space: PreferenceSpace = SPACE) -> Path:
    torch.manual_seed(0)
    spec = Bounded(-1.0, 1.0, (2,))
    size = OBSERVATION_SIZE + space.num_tunable
    actor = make_actor(spec, in_features=size, num_cells=(8,), last_layer_gain=1.0)
    return save_policy(
        folder,
        actor,
        space=space,
        observation_size=OBSERVATION_SIZE,
        action_size=2,
        num_cells=(8,),
        card={"config": CONFIG},
    )


def run(folder: Path, policy: Path, *overrides: str) -> Path:
    run_here(mo_ppo.main, f"policy={policy}", *TINY, *overrides, f"hydra.run.dir={folder}")
    return folder


def configuration(*overrides: str) -> DictConfig:
    with initialize_config_module("recipes.mo_ppo", version_base="1.3"):
        return compose("config", overrides=[*TINY, *overrides])


@pytest.fixture(scope="module")
def polished(tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("mo_ppo")
    start = small_policy(folder / "start")
    return start, run(folder / "run", start)


def test_writes_policies_that_load(polished):
    start, folder = polished
    saved = sorted((folder / "policies").glob("*"))
    assert [path.name for path in saved] == ["000000064", "000000128"]
    actor, space, card = load_policy(saved[-1])
    assert space == SPACE
    assert card["start"]["config"] == CONFIG
    assert card["config"]["loss"]["lmbda"] == 0.8
    # What was null is what the policy was trained in.
    own = {"num_envs": 4, "num_threads": 1, "repeat_failed": 0.25}
    assert card["config"]["env"] == CONFIG["env"] | own
    assert card["config"]["evaluation"]["scene"] == "static"
    before, *_ = load_policy(start)
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
    actor, *_ = load_policy(folder / "policies" / "000000128")
    before, *_ = load_policy(start)
    for name, value in actor.state_dict().items():
        assert torch.equal(value, before.state_dict()[name]), name


def test_anchor_holds_a_policy_with_demonstrations(tmp_path):
    objectives = ("core", "demo", *SPACE.tunable)
    start = small_policy(tmp_path / "start", PreferenceSpace(objectives, static={"core": 1.0}))
    size = OBSERVATION_SIZE + 2
    torch.manual_seed(0)
    model = RewardModel(in_features=size, num_cells=(8,), num_members=1)
    sizes = {"in_features": size, "num_cells": (8,), "num_members": 1}
    save_reward_model(tmp_path / "model", model, **sizes, card={})
    moved = []
    for coefficient in (0.0, 1e6):
        folder = run(
            tmp_path / str(coefficient),
            start,
            f"demonstrations.reward_model={tmp_path / 'model'}",
            f"loss.anchor_coeff={coefficient}",
            "loss.anchor_radius=100",  # everywhere: few of these short episodes meet the human
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


def test_likelihood_and_bounds():
    actor = make_actor(Bounded(-1.0, 1.0, (2,)), in_features=4 + 2, num_cells=(8,))
    _, noisy, policy = utils.make_policy(actor, torch.tensor([0.5, 0.25]))
    data = TensorDict(
        observation=torch.randn(200, 4), preference=torch.rand(200, 2), batch_size=[200]
    )
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        drawn = policy(data.clone())
        mean = actor(data.clone())["action"]
    z = (drawn["noisy_action"] - mean) / torch.tensor([0.5, 0.25])
    expected = -0.5 * z.square().sum(-1) - math.log(0.5) - math.log(0.25) - math.log(2 * math.pi)
    torch.testing.assert_close(drawn["noisy_action_log_prob"], expected)
    torch.testing.assert_close(drawn["action"], drawn["noisy_action"].clamp(-1, 1))
    assert (drawn["noisy_action"].abs() > 1).any()
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        torch.testing.assert_close(noisy(data.clone())["noisy_action"], mean)


def test_anchor_by_hand():
    def policy(turn: float):
        actor = make_actor(Bounded(-1.0, 1.0, (2,)), in_features=4 + 2, num_cells=(8,))
        with torch.no_grad():
            actor[0].module[-1].weight.zero_()
            actor[0].module[-1].bias.copy_(torch.tensor([0.0, turn]).atanh())
        return actor

    batch = TensorDict(
        observation=torch.randn(3, 4),
        preference=torch.tensor([[1.0, 0.0], [0.5, 0.5], [1.0, 0.0]]),
        human=torch.tensor([[2.4, 1.0], [0.5, -2.0], [2.6, 1.0]]),
        batch_size=[3],
    )
    # 0.2 apart, a standard deviation of 0.1: 2 nats, of which ln(1 + 2), weighed by 1, 1/8 and, where
    # nobody is near, 0.
    batch["start_action"] = policy(0.1)(batch.clone())["action"].detach()
    action = policy(0.3)(batch.clone())["action"]
    sigma = torch.tensor([0.5, 0.1])
    distance = utils.anchor(batch, action, sigma=sigma, objective=0, radius=2.5)
    torch.testing.assert_close(distance, torch.tensor(math.log(3) * 1.125 / 3))
    # Ten times as far is a hundred times as many nats, and costs less than five times as much.
    far = utils.anchor(
        batch, 10 * action - 9 * batch["start_action"], sigma=sigma, objective=0, radius=2.5
    )
    torch.testing.assert_close(far / distance, torch.tensor(math.log(201) / math.log(3)))


def test_smoothness_by_hand():
    actor = make_actor(Bounded(-1.0, 1.0, (2,)), in_features=1 + 2, num_cells=())
    with torch.no_grad():
        actor[0].module[-1].weight.copy_(torch.tensor([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    seen = torch.tensor([[0.1], [0.1], [0.5], [0.0]]).atanh()
    later = torch.tensor([[0.4], [0.4], [0.5], [-0.1]]).atanh()
    batch = TensorDict(
        observation=seen,
        preference=torch.rand(4, 2),
        next=TensorDict(
            observation=later,
            done=torch.tensor([[False], [True], [False], [False]]),
            batch_size=[4],
        ),
        batch_size=[4],
    )
    # The second episode ends: what follows is another one.
    change = utils.smoothness(batch, actor(batch.clone())["action"], actor)
    torch.testing.assert_close(change, torch.tensor((0.09 + 0.01) / 4))
    assert "action" not in batch.keys()


def test_failures_are_the_episodes_that_end_elsewhere():
    def rate(done: list[bool], success: list[bool]) -> float:
        ends = TensorDict(done=torch.tensor(done), success=torch.tensor(success), batch_size=[4])
        return utils.failure_rate(TensorDict(next=ends, batch_size=[4])).item()

    assert rate([True, True, False, True], [True, False, False, True]) == pytest.approx(1 / 3)
    assert math.isnan(rate([False] * 4, [False] * 4))


def test_interpolated_by_hand():
    def policy(seed: int):
        torch.manual_seed(seed)
        return make_actor(Bounded(-1.0, 1.0, (2,)), in_features=4 + 2, num_cells=(8,))

    start, end = policy(0), policy(1)
    kept = [value.clone() for value in (*start.parameters(), *end.parameters())]
    between = utils.interpolated(start, end, 0.25)
    for value, a, b in zip(between.parameters(), start.parameters(), end.parameters(), strict=True):
        torch.testing.assert_close(value, 0.75 * a + 0.25 * b)
    assert torch.equal(between[1].action_high, end[1].action_high)
    for value, a in zip(utils.interpolated(start, start, 0.7).parameters(), start.parameters()):
        assert torch.equal(value, a)
    for value, b in zip(utils.interpolated(start, end, 1.0).parameters(), end.parameters()):
        torch.testing.assert_close(value, b)
    assert all(map(torch.equal, kept, (*start.parameters(), *end.parameters())))


def test_saves_what_lies_between(polished, tmp_path):
    start, _ = polished
    weights = {"0": load_policy(start)[0].state_dict()}
    for share in ("0.5", "1.0"):
        folder = run(tmp_path / share, start, f"optim.interpolation={share}")
        weights[share] = load_policy(folder / "policies" / "000000128")[0].state_dict()
    for name, value in weights["0.5"].items():
        torch.testing.assert_close(value, (weights["0"][name] + weights["1.0"][name]) / 2)


def test_bfloat16_rounds_layers_and_not_actions():
    torch.manual_seed(0)
    actor = make_actor(Bounded(-1.0, 1.0, (2,)), in_features=4 + 2, num_cells=(8,))
    with torch.no_grad():
        actor[0].module[-1].bias.fill_(3.0)  # tanh 0.9951, between two numbers of bfloat16
    mean, noisy, _ = utils.make_policy(actor, torch.tensor([0.1, 0.1]))
    data = TensorDict(observation=torch.randn(50, 4), preference=torch.rand(50, 2), batch_size=[50])
    exact = actor(data.clone())["action"]
    with torch.autocast("cpu", torch.bfloat16):
        rounded = mean(data.clone())
        density = noisy.get_dist(data.clone()).log_prob(exact)
    assert rounded["action"].dtype == rounded["pre_tanh"].dtype == density.dtype == torch.float32
    assert not torch.equal(rounded["action"], exact)
    torch.testing.assert_close(rounded["action"], exact, atol=3e-4, rtol=0)


@pytest.mark.parametrize("given", [True, False])
def test_bfloat16_as_asked_for(given):
    cfg = configuration(f"compute.bfloat16={given}")
    assert utils.use_bfloat16(cfg, torch.device("cpu")) is given


@pytest.mark.parametrize("feature", ["avx512_bf16", "amx_bf16", None])
def test_bfloat16_where_the_processor_has_it(feature, monkeypatch):
    found = dict.fromkeys(("avx512_bf16", "amx_bf16"), False) | {feature: True}
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: found)
    cfg = configuration("compute.bfloat16=null")
    assert utils.use_bfloat16(cfg, torch.device("cpu")) is (feature is not None)


def test_trains_in_bfloat16(polished, tmp_path, monkeypatch):
    start, folder = polished
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True})
    rounded = run(tmp_path / "run", start, "compute.bfloat16=null")
    name = "policies/000000128"
    cards = [load_policy(path / name)[2] for path in (folder, rounded)]
    assert [card["config"]["compute"]["bfloat16"] for card in cards] == [False, True]
    weights = [load_policy(path / name)[0].state_dict() for path in (folder, rounded)]
    assert all(value.dtype == torch.float32 for value in weights[1].values())
    moved = [torch.equal(weights[0][key], weights[1][key]) for key in weights[0]]
    assert not all(moved)


def test_gradients_go_where_they_belong():
    torch.manual_seed(0)
    actor = make_actor(Bounded(-1.0, 1.0, (2,)), in_features=4 + 2, num_cells=(8,))
    mean, noisy, policy = utils.make_policy(actor, torch.tensor([0.1, 0.1]))
    critic = make_vector_critic(
        3,
        in_features=4 + 2,
        in_keys=("observation", "preference"),
        num_cells=(8,),
        out_key="state_value",
    )
    loss = utils.make_loss(configuration(), noisy, critic)
    data = TensorDict(
        observation=torch.randn(6, 8, 4),
        preference=torch.tensor([0.5, 0.5]).expand(6, 8, 2),
        next=TensorDict(
            observation=torch.randn(6, 8, 4),
            preference=torch.tensor([0.5, 0.5]).expand(6, 8, 2),
            reward=torch.randn(6, 8, 3),
            done=torch.zeros(6, 8, 1, dtype=torch.bool),
            terminated=torch.zeros(6, 8, 1, dtype=torch.bool),
            batch_size=[6, 8],
        ),
        batch_size=[6, 8],
    )
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        policy(data)
    MultiObjectiveGAE(gamma=0.9, lmbda=0.8, value_network=critic, preference_space=SPACE)(data)
    data["start_action"] = torch.zeros(6, 8, 2)
    data["human"] = torch.ones(6, 8, 2)
    batch = data.reshape(-1).select(*utils.BATCH)
    losses = loss(batch)

    def trained(value: torch.Tensor) -> set[str]:
        loss.zero_grad()
        value.backward(retain_graph=True)
        return {
            name.split("_network")[0]
            for name, parameter in loss.named_parameters()
            if parameter.grad is not None and parameter.grad.any()
        }

    assert trained(losses["loss_objective"]) == {"actor"}
    assert trained(losses["loss_critic"]) == {"critic"}
    action = mean(batch.select(*mean.in_keys))["action"]
    assert trained(utils.smoothness(batch, action, mean)) == {"actor"}
    sigma = torch.tensor([0.5, 0.1])
    held = utils.anchor(batch, action, sigma=sigma, objective=0, radius=2.5)
    assert trained(held) == {"actor"}


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("optim.batch_size=64", "optim.batch_size must lie between"),
        ("collector.exploration_sigma=[0.05,0]", "exploration_sigma must be positive"),
        ("loss.anchor_coeff=-1", "anchor_coeff must not be negative"),
        ("loss.anchor_radius=-1", "anchor_radius must not be negative"),
        ("loss.smoothness_coeff=-1", "smoothness_coeff must not be negative"),
        ("loss.gamma=1.5", "loss.gamma must be in"),
        ("collector.frames_per_batch=30", "must be a multiple of env.num_envs, 4, got 30"),
        ("optim.batch_size=0", "optim.batch_size must lie between"),
        ("optim.interpolation=0", "optim.interpolation must be greater than 0"),
        ("optim.interpolation=1.2", "and at most 1, got 1.2"),
        ("optim.penalty_batch_size=0", "penalty_batch_size must be at least 1, got 0"),
        ("env.observe_human=false", "observations of 36 entries, here they have 33"),
        ("policy=nowhere", "nowhere"),
    ],
)
def test_refuses_bad_configurations(polished, tmp_path, override, message):
    start, _ = polished
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        run(tmp_path / "run", start, override)
    assert not (tmp_path / "run" / "policies").exists()


def test_refuses_a_policy_of_other_objectives(tmp_path):
    with pytest.raises(ValueError, match=r"demonstrations\.reward_model must name"):
        run(tmp_path / "run", SHIPPED)


def test_asks_for_what_the_card_does_not_tell(polished, tmp_path):
    start, _ = polished
    actor, space, card = load_policy(start)
    del card["config"]["env"]["scene"], card["config"]["evaluation"]
    policy = save_policy(
        tmp_path / "policy",
        actor,
        space=space,
        observation_size=OBSERVATION_SIZE,
        action_size=2,
        num_cells=(8,),
        card=card,
    )
    with pytest.raises(ValueError, match=r"does not say what it was trained in: give env\.scene\."):
        run(tmp_path / "run", policy)
    folder = run(tmp_path / "again", policy, "env.scene=corridor")
    *_, card = load_policy(folder / "policies" / "000000128")
    assert card["config"]["evaluation"]["scene"] == "corridor"
