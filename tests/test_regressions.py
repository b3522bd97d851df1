"""What must not creep in: graph breaks, recompilations, waits for a device, loops over a batch.

Nothing here is timed. Operators, new tensors and compiled graphs are counted, which gives the same
numbers on every machine with the same libraries.
"""

from __future__ import annotations

import functools

import pytest
import torch
from tensordict import TensorDict
from torch._dynamo.testing import CompileCounter
from torch._dynamo.utils import counters
from torchrl.envs import EnvBase, TransformedEnv

from benchmarks.ours import Ours
from benchmarks.workload import config, transitions
from envs.metrics import episode_metrics, trajectories
from envs.policy_env import make_policy_env
from recipes.training import gradients
from recipes.training.task import make_preference_space
from tests._tally import count, python_calls
from torchrl_morl.deploy.features import OBSERVATION_SIZE, policy_transforms
from torchrl_morl.evaluation import discrete_frechet
from torchrl_morl.modules import PreferenceInterpolator, RewardModel
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.testing import VectorRewardMockEnv
from torchrl_morl.transforms import (
    PreferenceExpand,
    PreferenceRelabel,
    PreferenceSampler,
    RewardModelReward,
    ScalarizeReward,
)

pytestmark = pytest.mark.benchmark

# Most operators, and most new tensors among their results. To change a budget run
# `pytest tests/test_regressions.py -k budget`: a failure tells the numbers. More than before needs a
# reason; less is a new budget. They are those of the versions in constraints.txt.
BUDGET = {
    "value_loss": (306, 210),  # rewards of several steps, prioritized replay
    "actor_loss": (159, 107),  # no cache of detached critics: deep copies
    "sample and relabel": (24, 23),
    "transforms of a step": (58, 50),  # scans that are stored stay as they are
}

SPACE = make_preference_space(with_demonstrations=True)
MODEL = RewardModel(in_features=OBSERVATION_SIZE + 2, num_cells=(16,))
ROWS = 300


def _learner(*overrides: str) -> Ours:
    """The recipe's update, with small networks and as many of them as the recipe has."""
    small = ("network.num_cells=[16,16,16,16]", f"replay_buffer.size={ROWS}")
    cfg = config("compute.compile=false", "replay_buffer.batch_size=32", *small, *overrides)
    return Ours(cfg, transitions(ROWS))


@pytest.fixture(scope="module")
def learner() -> Ours:
    return _learner()


def _rows(size: int) -> TensorDict:
    return transitions(size, seed=1)


# --- compiled gradients --------------------------------------------------------------------------


def test_compiled_gradients_have_one_graph_for_the_whole_training(monkeypatch):
    """As the recipe compiles and calls them, with a backend that runs the graph as it is."""
    graphs: list[CompileCounter] = []

    def compiled(function, **options):
        graphs.append(CompileCounter())
        # Nothing else in the default mode.
        assert options["options"].keys() == {"guard_filter_fn"}
        return compile_with(function, backend=graphs[-1], **options)

    compile_with = torch.compile
    monkeypatch.setattr(torch, "compile", compiled)
    monkeypatch.setattr(gradients.shutil, "which", lambda name: name)
    torch._dynamo.reset()
    counters.clear()
    # Fewer layers than elsewhere: tracing them is what takes time here.
    learner = _learner("compute.compile=true", "network.num_cells=[8]")
    assert len(graphs) == 2
    delay = learner.policy_delay
    for _ in range(delay):
        learner.update()
    assert [graph.frame_count for graph in graphs] == [1, 1]
    for step in range(1, 4):
        # All that a training changes between two updates.
        learner.loss.pre_tanh_coeff = 0.01 / step
        learner.loss.angle_coeff_actor = 0.1 * step
        learner.loss.angle_coeff_critic = 0.05 * step
        learner.loss.interpolator.refit(-torch.rand(3, 3) * step, momentum=0.5)
        for group in (g for o in learner.optimizers.values() for g in o.param_groups):
            group["lr"] *= 0.9
        for _ in range(delay):
            learner.update()
    assert learner.updates == 4 * delay
    assert [graph.frame_count for graph in graphs] == [1, 1], "compiled again"
    assert not counters["graph_break"]
    torch._dynamo.reset()


# --- waits for a device --------------------------------------------------------------------------


def test_losses_never_wait(learner):
    batch = _rows(16)
    for loss in (learner.loss.value_loss, learner.loss.actor_loss):
        assert count(lambda loss=loss: loss(batch)).waits == []
        assert count(lambda loss=loss: loss(batch)[0].backward()).waits == []


def test_sampling_waits_once_for_all_batches(learner):
    """``RewardScaling`` of TorchRL looks at its flag ``standard_normal``, a buffer."""
    assert len(count(learner.replay_buffer.sample).waits) == 1


def test_only_the_average_of_the_actor_waits(learner):
    """``AveragedModel`` of PyTorch looks at its own counter, twice for every update of the actor."""
    learner._sample()

    def update() -> None:
        learner._critic_gradients()
        learner._critic_step()
        learner._actor_gradients()
        learner._actor_step()
        learner._follow()

    waits = count(update).waits
    assert len(waits) == 2
    assert all("update_parameters" in wait for wait in waits), waits


@pytest.mark.parametrize(
    "transform",
    [
        PreferenceRelabel(SPACE),
        PreferenceRelabel(SPACE, seed=0, distribution="jeffreys"),
        PreferenceExpand(SPACE),
        PreferenceSampler(SPACE),
        RewardModelReward(MODEL, position=1),
        ScalarizeReward(SPACE),
    ],
    ids=lambda transform: type(transform).__name__,
)
def test_transforms_of_a_replay_buffer_never_wait(transform):
    batch = _rows(8)
    run = transform.inv if isinstance(transform, PreferenceExpand) else transform
    assert count(lambda: run(batch.copy())).waits == []


def test_interpolator_never_waits():
    interpolator = PreferenceInterpolator(torch.eye(3))
    preference = SPACE.sample(5)
    assert count(lambda: interpolator(preference)).waits == []
    assert count(lambda: interpolator.normalize(preference)).waits == []


def _mock(size: int) -> EnvBase:
    """Cheap, and looks at no values."""
    return VectorRewardMockEnv(
        3, batch_size=(size,), polar=True, num_rays=720, horizon=1000, seed=0
    )


def _transformed(size: int) -> EnvBase:
    """With every transform of the recipe, and one more."""
    chain = policy_transforms()
    chain.append(PreferenceSampler(SPACE, distribution="jeffreys", num_segments=2, seed=0))
    chain.append(RewardModelReward(MODEL))
    chain.append(ScalarizeReward(SPACE))
    return TransformedEnv(_mock(size), chain)


def _count_step(env: EnvBase):
    data = env.rand_action(env.reset())
    return count(lambda: env.step(data.copy()))


def test_transforms_of_a_step_wait_for_nothing_but_the_check():
    """``CheckFinite`` has to stop a training at a broken sensor: one look at scan, goal and human."""
    waits = _count_step(_transformed(4)).waits
    assert len(waits) == 3
    assert all("finite.py" in wait for wait in waits), waits


# --- budgets -------------------------------------------------------------------------------------


def _within_budget(name: str, operators: int, allocations: int) -> None:
    assert operators <= BUDGET[name][0] and allocations <= BUDGET[name][1], (
        f"{name!r}: ({operators}, {allocations}), more than {BUDGET[name]}"
    )


@pytest.mark.parametrize("name", ["value_loss", "actor_loss"])
def test_losses_are_within_their_budget_at_any_batch_size(name, learner):
    loss = getattr(learner.loss, name)
    small, large = (count(functools.partial(loss, _rows(size))) for size in (8, 64))
    _within_budget(name, small.total, small.allocations)
    assert small.operators == large.operators


def test_sample_and_relabel_is_within_its_budget_at_any_batch_size(learner):
    small, large = (
        count(functools.partial(learner.replay_buffer.sample, size)) for size in (8, 64)
    )
    _within_budget("sample and relabel", small.total, small.allocations)
    assert small.operators == large.operators


def test_transforms_of_a_step_are_within_their_budget_for_any_number_of_environments():
    bare = _count_step(_mock(2))
    small, large = (_count_step(_transformed(size)) for size in (2, 32))
    _within_budget(
        "transforms of a step", small.total - bare.total, small.allocations - bare.allocations
    )
    assert small.operators == large.operators


# --- growth --------------------------------------------------------------------------------------


def _step(num_envs: int):
    sampler = PreferenceSampler(SPACE, num_segments=2)
    env = make_policy_env(sampler, reward_model=MODEL, num_envs=num_envs, num_threads=1, seed=0)
    data = env.rand_action(env.reset())
    return functools.partial(lambda: env.step(data.copy()))


def test_a_step_asks_the_same_of_any_number_of_environments():
    small, large = _step(2), _step(32)
    assert count(small).operators == count(large).operators
    # Also what runs in NumPy.
    assert python_calls(large) <= python_calls(small)


def _rollout(preferences: int, scenes: int) -> TensorDict:
    """Episodes of three steps, all successful."""
    shape = (preferences, scenes, 3)
    end = torch.zeros(*shape, 1, dtype=torch.bool)
    success = end.clone()
    success[..., -1, :] = True
    later = {"pose": torch.randn(*shape, 3), "human_pose": torch.randn(*shape, 3)}
    causes = {"collision_human": end, "collision_obstacle": end, "truncated": end}
    return TensorDict(
        **{key: value.clone() for key, value in later.items()},
        goal=torch.rand(*shape, 2),
        mask=torch.ones(shape, dtype=torch.bool),
        next=TensorDict({**later, **causes, "success": success}, batch_size=shape),
        batch_size=shape,
    )


def test_metrics_ask_the_same_for_any_number_of_preferences():
    def metrics(rollout: TensorDict):
        path = trajectories(rollout)
        shown = path[0]
        episode_metrics(rollout)
        discrete_frechet(path["position"], path["mask"], shown["position"], shown["mask"])

    small, large = (count(lambda n=n: metrics(_rollout(n, 2 * n))) for n in (2, 16))
    assert small.operators == large.operators


def test_preferences_ask_the_same_for_any_number_of_them():
    for distribution in ("dirichlet", "jeffreys", "abs_normal"):
        small, large = (count(functools.partial(SPACE.sample, n, distribution)) for n in (2, 200))
        assert small.operators == large.operators


def test_objectives_cost_operators_in_the_weights_alone():
    """The interpolator, the angle and the relabelling know no loop over objectives."""

    def operators(objectives: int) -> int:
        preference_space = PreferenceSpace([f"objective_{i}" for i in range(objectives)])
        interpolator = PreferenceInterpolator(preference_space.corners())
        relabel = PreferenceRelabel(preference_space)
        batch = TensorDict(preference=preference_space.sample(8), batch_size=8)
        return count(lambda: (relabel(batch), interpolator(batch["preference"]))).total

    assert operators(3) == operators(12)
