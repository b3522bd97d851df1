"""What every public transform, module, loss and sampler owes: copies, pickles, its settings, its state."""

from __future__ import annotations

import copy
import io
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, get_args

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

import torchrl_morl.data
import torchrl_morl.modules
import torchrl_morl.objectives
import torchrl_morl.transforms
from tests._mo_td3 import OBS, SPACE, SPEC, make_batch, make_interpolator, make_loss
from torchrl_morl.data import RankedSnippets
from torchrl_morl.modules import (
    HeldEGreedyModule,
    PreferenceInterpolator,
    RewardModel,
    StandardizedLinear,
    make_actor,
    make_vector_critic,
)
from torchrl_morl.objectives import BradleyTerryLoss, MultiObjectiveGAE
from torchrl_morl.preferences import SamplingDistribution
from torchrl_morl.testing import VectorRewardMockEnv
from torchrl_morl.transforms import (
    CheckFinite,
    HullRange,
    InUnitsOf,
    IsNobody,
    LidarMinPool,
    LogRange,
    MotionInUnits,
    OwnMotion,
    PolarFeatures,
    PreferenceExpand,
    PreferenceOverlay,
    PreferenceRelabel,
    PreferenceSampler,
    RewardModelReward,
    RobotScale,
    ScalarizeReward,
    VelocityInFrame,
)

BATCH = 6


def transitions() -> TensorDict:
    """What the components below read, for any of them."""
    generator = torch.Generator().manual_seed(0)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(BATCH, *shape, generator=generator)

    torch.manual_seed(0)
    data = make_batch(BATCH)
    data["scan"], data["goal"], data["human"] = rand(12), rand(2), rand(2)
    data["human_pose"], data["next", "human_pose"] = rand(3), rand(3)
    data["next", "pose"], data["robot"] = rand(3), 0.1 + rand(6)
    data["pixels"] = (255 * rand(120, 200, 3)).to(torch.uint8)
    return data


def trajectories() -> TensorDict:
    data = transitions().select(
        "preference", ("next", "reward"), ("next", "done"), ("next", "terminated")
    )
    torch.manual_seed(0)
    data["state_value"], data["next", "state_value"] = torch.randn(2, BATCH, 3)
    return data.reshape(2, 3)


def pairs() -> TensorDict:
    torch.manual_seed(0)

    def snippets() -> TensorDict:
        data = {"observation": torch.randn(BATCH, 5, OBS), "action": torch.randn(BATCH, 5, 2)}
        return TensorDict(data, batch_size=[BATCH, 5])

    return TensorDict(preferred=snippets(), other=snippets(), batch_size=[BATCH])


def ranked(seed: int) -> RankedSnippets:
    torch.manual_seed(0)
    groups = [
        (quality, TensorDict(observation=torch.randn(4, 9, 3), batch_size=[4, 9]))
        for quality in (0.0, -0.5)
    ]
    return RankedSnippets(groups, length=5, in_keys=["observation"], min_gap=0.25, seed=seed)


def fitted(seed: int) -> PreferenceInterpolator:
    interpolator = make_interpolator()
    interpolator.refit(torch.rand(2, 2, generator=torch.Generator().manual_seed(seed)))
    return interpolator


def reward_model(seed: int) -> RewardModel:
    torch.manual_seed(seed)
    return RewardModel(in_features=OBS + 2, num_cells=(8,), last_layer_gain=5.0)


def actor(seed: int) -> nn.Module:
    torch.manual_seed(seed)
    return make_actor(SPEC, in_features=OBS + 2, num_cells=(8,), last_layer_gain=1.0)


def standardized(seed: int) -> StandardizedLinear:
    torch.manual_seed(seed)
    return StandardizedLinear(3, 2, torch.tensor([5.0, -1.0]), torch.tensor([2.0, 4.0]))


def critic(seed: int) -> nn.Module:
    torch.manual_seed(seed)
    return make_vector_critic(3, in_features=OBS + 4, num_cells=(8,))


def td3(seed: int) -> nn.Module:
    torch.manual_seed(seed)
    return make_loss(interpolator=fitted(seed), policy_noise=0.0)


@dataclass
class Case:
    """A component.

    Args:
        make: builds one, with another state for another seed.
        settings: what its ``repr`` has to name.
        data: what it is called with.
        call: how.
    """

    make: Callable[[int], Any]
    settings: tuple[str, ...]
    data: Callable[[], Any] = transitions
    call: Callable[[Any, Any], Any] = lambda component, data: component(data)
    compiles: bool = True


def explore(module: nn.Module, data: TensorDict) -> TensorDict:
    with set_exploration_type(ExplorationType.RANDOM):
        return module(data)


CASES = {
    "CheckFinite": Case(lambda seed: CheckFinite(["observation"]), ("['observation']",)),
    "HullRange": Case(lambda seed: HullRange("scan"), ("'scan'", "'hull_lidar'", "'robot'")),
    "InUnitsOf": Case(lambda seed: InUnitsOf("human"), ("key='human'", "robot_key='robot'")),
    "MotionInUnits": Case(
        lambda seed: MotionInUnits("human"), ("key='human'", "'own_motion'", "robot_key='robot'")
    ),
    "OwnMotion": Case(
        lambda seed: OwnMotion(period=0.5, num_commands=3),
        ("period=0.5", "num_commands=3"),
        lambda: TensorDict(
            pose=torch.rand(6, 3),
            motion=torch.rand(6, 8),
            action=torch.rand(6, 2),
            next=TensorDict(pose=torch.rand(6, 3), batch_size=6),
            batch_size=6,
        ),
    ),
    "IsNobody": Case(
        lambda seed: IsNobody(3.0, 1.5), ("distance=3.0", "bearing=1.5"), lambda: torch.rand(4, 2)
    ),
    "LidarMinPool": Case(lambda seed: LidarMinPool(4), ("num_sectors=4", "scan")),
    "LogRange": Case(lambda seed: LogRange(3.5), ("max_range=3.5",), lambda: torch.rand(4)),
    "PolarFeatures": Case(
        lambda seed: PolarFeatures(scale=[5.0, 2.0]), ("goal", "human_features", "(5.0, 2.0)")
    ),
    "PreferenceExpand": Case(
        lambda seed: PreferenceExpand(SPACE, copies=2, seed=seed),
        ("'distance'", "copies=2", "seed=1", "dirichlet"),
        call=lambda transform, data: transform.inv(data),
        compiles=False,  # replay buffers do not compile what they store
    ),
    "PreferenceOverlay": Case(
        lambda seed: PreferenceOverlay(SPACE),
        ("distance", "pixels"),
        compiles=False,  # Pillow
    ),
    "PreferenceRelabel": Case(
        lambda seed: PreferenceRelabel(SPACE, ratio=0.5, seed=seed),
        ("'distance'", "ratio=0.5", "seed=1", "preference_key='preference'"),
    ),
    "PreferenceSampler": Case(
        lambda seed: PreferenceSampler(
            SPACE, num_segments=2, distribution="jeffreys", preference_key="wish", seed=seed
        ),
        ("'distance'", "num_segments=2", "jeffreys", "seed=1", "'wish'"),
    ),
    "PreferenceSampler.fixed": Case(
        lambda seed: PreferenceSampler.fixed(SPACE, [seed / 4, 1 - seed / 4], preference_key="w"),
        ("preferences=[0.25, 0.75]",),
    ),
    "RewardModelReward": Case(
        lambda seed: RewardModelReward(reward_model(seed), position=2, scale=4.0),
        ("position=2", "scale=4.0", "RewardModel(", "in_features=6"),
    ),
    "RobotScale": Case(lambda seed: RobotScale(3.5), ("max_range=3.5",), lambda: torch.rand(4, 6)),
    "ScalarizeReward": Case(
        lambda seed: ScalarizeReward(SPACE), ("'core', 1.0", "['scalar_reward']", "['reward']")
    ),
    "VelocityInFrame": Case(
        lambda seed: VelocityInFrame(period=0.25), ("human_pose", "period=0.25")
    ),
    "HeldEGreedyModule": Case(
        lambda seed: HeldEGreedyModule(Bounded(-1.0, 1.0, (2,)), 0.5, 3, seed=seed),
        ("eps=0.5", "hold=3", "seed=1", "'action'"),
        call=explore,
    ),
    "PreferenceInterpolator": Case(
        fitted, ("num_keys=2", "value_space='normalized'"), lambda: transitions()["preference"]
    ),
    "RewardModel": Case(reward_model, ("in_features=6", "['observation', 'action']")),
    "StandardizedLinear": Case(
        standardized,
        ("in_features=3", "out_features=2", "standardized=2"),
        lambda: torch.rand(4, 3),
    ),
    "make_actor": Case(actor, ("in_features=6", "['observation', 'preference']")),
    "make_vector_critic": Case(critic, ("in_features=8", "out_features=3")),
    "MOTD3Loss": Case(
        td3, ("angle='normalized'", "angle_coeff_actor=0.3", "num_qvalue_nets=2", "in_features=6")
    ),
    "BradleyTerryLoss": Case(
        lambda seed: BradleyTerryLoss(reward_model(seed), label_smoothing=0.1),
        ("beta='5 / L'", "label_smoothing=0.1", "reduction='mean'", "RewardModel("),
        pairs,
    ),
    "MultiObjectiveGAE": Case(
        lambda seed: MultiObjectiveGAE(
            gamma=0.5 + seed / 8, lmbda=0.75, value_network=None, preference_space=SPACE
        ),
        ("gamma=0.625", "lmbda=0.75", "'distance'", "level_preferences=False"),
        trajectories,
        compiles=False,  # test_gae compiles it, with a value network
    ),
    "RankedSnippets": Case(
        ranked,
        ("length=5", "min_gap=0.25", "{0.0: 4, -0.5: 4}", "seed=1"),
        lambda: 7,
        lambda snippets, number: snippets.sample(number),
        compiles=False,  # indices
    ),
}
every_case = pytest.mark.parametrize("case", CASES.values(), ids=CASES)


def run(case: Case, component: Any) -> dict:
    """Everything that the component answers, as numbers, at its next call."""
    torch.manual_seed(5)
    out = case.call(component, case.data())
    return out.detach().to_dict() if isinstance(out, TensorDict) else {"out": out}


def assert_same(first: dict, second: dict) -> None:
    torch.testing.assert_close(first, second, rtol=0, atol=0)


def test_every_public_component_is_here():
    names = set()
    for package in (
        torchrl_morl.transforms,
        torchrl_morl.modules,
        torchrl_morl.objectives,
        torchrl_morl.data,
    ):
        for name in package.__all__:
            value = getattr(package, name)
            if isinstance(value, type) or name.startswith("make_"):
                names.add(name)
    assert names <= set(CASES)


@every_case
def test_repr_names_the_settings(case):
    text = repr(case.make(1))
    for setting in case.settings:
        assert setting in text
    assert text.startswith(type(case.make(1)).__name__)


@every_case
@pytest.mark.parametrize("how", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_a_copy_does_the_same_and_lives_alone(case, how):
    component = case.make(1)
    run(case, component)  # what a call leaves behind is copied, too
    twin = how(component)
    first = run(case, twin)
    run(case, twin)
    assert_same(run(case, component), first)


@pytest.mark.parametrize(
    "case",
    [case for case in CASES.values() if isinstance(case.make(1), nn.Module)],
    ids=[name for name, case in CASES.items() if isinstance(case.make(1), nn.Module)],
)
def test_state_dict_round_trip(case):
    component, other = case.make(1), case.make(2)
    run(case, component)
    file = io.BytesIO()
    torch.save(component.state_dict(), file)
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))
    if case is CASES["PreferenceSampler.fixed"]:
        assert torch.equal(other.preferences, component.preferences)
    assert_same(run(case, other), run(case, component))


@pytest.mark.parametrize(
    "case",
    [case for case in CASES.values() if case.compiles],
    ids=[name for name, case in CASES.items() if case.compiles],
)
def test_compiled_it_does_the_same(case):
    component, twin = case.make(1), case.make(1)
    compiled = torch.compile(lambda data: case.call(twin, data), backend="eager")
    expected = run(case, component)
    torch.manual_seed(5)
    out = compiled(case.data())
    out = out.detach().to_dict() if isinstance(out, TensorDict) else {"out": out}
    torch.testing.assert_close(out, expected)


@pytest.mark.parametrize("distribution", get_args(SamplingDistribution))
@pytest.mark.parametrize("name", ["relabel", "sampler", "segments", "noise"])
def test_compiled_without_a_seed_it_draws_for_batches_of_any_size(name, distribution):
    kwargs = {"distribution": distribution}
    torch._dynamo.reset()  # else the sizes of another test are remembered
    component = {
        "relabel": lambda: PreferenceRelabel(SPACE, 1.0, **kwargs),
        "sampler": lambda: PreferenceSampler(SPACE, preference_key="wish", **kwargs),
        "segments": lambda: PreferenceSampler(
            SPACE, preference_key="wish", num_segments=3, **kwargs
        ),
        "noise": lambda: HeldEGreedyModule(Bounded(-1.0, 1.0, (2,)), 1.0),
    }[name]()
    key = {"relabel": "preference", "noise": "action"}.get(name, "wish")
    compiled = torch.compile(component, backend="eager", dynamic=True)
    for size in (6, 20):
        data = compiled(make_batch(size))
        assert data[key].shape == (size, 2)
        assert len(data[key].unique(dim=0)) == size


@pytest.mark.parametrize(
    "name", ["PreferenceRelabel", "PreferenceExpand", "PreferenceSampler", "HeldEGreedyModule"]
)
def test_a_seed_is_a_generator_of_its_own(name):
    case = CASES[name]
    components = [case.make(seed) for seed in (1, 1, 2)]
    outs = []
    for seed, component in enumerate(components):
        torch.manual_seed(seed)
        before = torch.get_rng_state()
        out = case.call(component, case.data())
        outs.append(out.to_dict())
        torch.manual_seed(seed)
        assert torch.equal(torch.get_rng_state(), before)
    assert_same(outs[0], outs[1])
    with pytest.raises(AssertionError):
        assert_same(outs[0], outs[2])


@pytest.mark.parametrize("transform", [lambda: PreferenceSampler(SPACE, seed=0)])
def test_an_environment_with_it_is_copied_with_its_generator(transform):
    env = TransformedEnv(VectorRewardMockEnv(3, batch_size=(4,), seed=0), transform())
    env.rollout(3)
    twin = copy.deepcopy(env)
    assert torch.equal(twin.reset()["preference"], env.reset()["preference"])
    state = env.state_dict()
    expected = env.reset()["preference"]
    env.load_state_dict(state)
    assert torch.equal(env.reset()["preference"], expected)
