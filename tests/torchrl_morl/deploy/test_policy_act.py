"""One validated call: numpy, lists and tensors, one observation or many, and what is refused."""

from __future__ import annotations

import copy
import inspect
import math
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch._subclasses import FakeTensorMode

from envs.gym import NavigationGymEnv
from envs.policy_env import contract, make_policy_env
from torchrl_morl.deploy import Sensing, load_policy
from torchrl_morl.deploy.features import RowFeatures, observation
from torchrl_morl.testing import untrained_policy
from torchrl_morl.transforms import PreferenceSampler

POLICIES = Path(__file__).parents[3] / "recipes" / "policies"


@pytest.fixture(scope="module")
def policy():
    return load_policy(POLICIES / "polished_seed0")


def inputs(*batch: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    weights = rng.uniform(0.1, 1.0, (*batch, 3))
    return {
        "preference": weights / weights.sum(-1, keepdims=True),
        "lidar": rng.uniform(0.2, 4.0, (*batch, 30)),
        "goal": np.stack((rng.uniform(1, 9, batch), rng.uniform(-3, 3, batch)), -1),
        "human": np.stack((rng.uniform(1, 7, batch), rng.uniform(-3, 3, batch)), -1),
    }


def test_the_action_is_that_of_the_network_in_physical_units(policy):
    given = inputs(16)
    tensors = {name: torch.tensor(value, dtype=torch.float32) for name, value in given.items()}
    preference = tensors.pop("preference")
    features = observation(policy.sensing, **tensors)
    assert features.shape == (16, policy.sensing.observation_size)
    scaled = policy.actor(features, preference)[1].numpy()
    expected = np.stack((0.25 * (scaled[:, 0] + 1), math.pi * scaled[:, 1]), -1)
    np.testing.assert_allclose(policy.act(**given), expected, atol=2e-6)


@pytest.mark.parametrize("name", ["polished_seed0", "our_nh", "walking", "hsr"])
def test_features_are_those_of_the_environment(policy_folders, name):
    policy = load_policy(policy_folders[name])
    sensing = policy.sensing
    flags = {
        "observe_human": sensing.observe_human,
        "observe_human_velocity": sensing.observe_human_velocity,
    }
    env = make_policy_env(
        PreferenceSampler(policy.preference_space, seed=0),
        policy=policy,
        num_envs=4,
        scene="mixed",
        robot=policy.robot,
        seed=0,
        keep_simulation=True,
        **flags,
    )
    data = env.rollout(20, policy.actor, break_when_any_done=False)
    # The environment keeps no copy of the velocity: its features are itself.
    velocity = {"human_velocity": data["observation"][..., 36:]}
    seen = {name: data[name] for name in ("lidar", "goal", "human")} | velocity
    assert torch.equal(observation(sensing, **seen), data["observation"])
    env.close()


@pytest.mark.parametrize("batch", [(), (1,), (5,), (2, 3)])
@pytest.mark.parametrize(
    "changes", [{}, {"observe_human_velocity": True}, {"observe_human": False}]
)
def test_a_row_of_inputs_has_the_same_features(changes, batch):
    """One observation costs too many operations otherwise; the numbers are the same, to rounding."""
    sensing = Sensing(goal_scale=4.7, human_scale=1.9, max_range=3.3, unknown_range=3.3, **changes)
    lidar = 3.3 * torch.rand(*batch, 30)
    lidar[..., 0] = 0.0
    given = {"lidar": lidar, "goal": 6 * torch.randn(*batch, 2)}
    if sensing.observe_human:
        given["human"] = 6 * torch.randn(*batch, 2)
    if sensing.observe_human_velocity:
        given["human_velocity"] = torch.randn(*batch, 2)
    preference, total = torch.rand(*batch, 3), torch.ones(*batch, 1)
    row = torch.cat((*given.values(), preference, total), -1)
    before = row.clone()
    found = RowFeatures(sensing, 3, like=row)(row)
    expected = observation(sensing, **given)
    torch.testing.assert_close(found[..., :-3], expected, rtol=3e-7, atol=3e-7)
    assert torch.equal(found[..., -3:], preference)
    assert torch.equal(row, before)


def test_the_present_weights_count():
    """`act` goes past the modules of its network: whatever is done to them is seen."""
    policy, other = untrained_policy(), untrained_policy()
    given = inputs()
    before = policy.act(**given)
    policy.actor.load_state_dict(other.actor.state_dict(), assign=True)
    assert not np.array_equal(policy.act(**given), before)
    np.testing.assert_array_equal(policy.act(**given), other.act(**given))
    again = copy.deepcopy(policy)
    for parameter in again.actor.parameters():
        parameter.zero_()
    np.testing.assert_allclose(again.act(**given), [0.25, 0.0], atol=1e-7)
    np.testing.assert_array_equal(policy.act(**given), other.act(**given))
    pickled = pickle.loads(pickle.dumps(policy))
    np.testing.assert_array_equal(pickled.act(**given), other.act(**given))


def test_autocast_reaches_the_layers_in_the_middle_alone(policy):
    given = inputs(4)
    with torch.autocast("cpu", torch.bfloat16):
        found = policy.act(**given)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, policy.act(**given), atol=0.1)


@pytest.mark.parametrize("batch", [(), (1,), (5,), (2, 3)])
def test_arrays_lists_and_tensors_of_any_dtype(policy, batch):
    given = inputs(*batch)
    expected = policy.act(**given)
    assert isinstance(expected, np.ndarray) and expected.shape == (*batch, 2)
    for convert in (np.float32, np.float64, torch.tensor):
        found = policy.act(**{name: convert(value) for name, value in given.items()})
        np.testing.assert_allclose(np.asarray(found), expected, atol=1e-5)
    listed = policy.act(**{name: value.tolist() for name, value in given.items()})
    np.testing.assert_allclose(listed, expected, atol=1e-6)
    tensor = policy.act(**given | {"goal": torch.tensor(given["goal"])})
    assert isinstance(tensor, torch.Tensor) and tensor.dtype == torch.float32
    assert not tensor.is_inference() and not tensor.requires_grad


def test_one_by_one_is_all_at_once(policy):
    given = inputs(7)
    rows = [policy.act(**{n: value[i] for n, value in given.items()}) for i in range(7)]
    np.testing.assert_allclose(policy.act(**given), rows, atol=1e-5)


def test_one_preference_for_many(policy):
    given = inputs(7)
    one = given | {"preference": given["preference"][0]}
    many = given | {"preference": np.tile(given["preference"][0], (7, 1))}
    np.testing.assert_array_equal(policy.act(**one), policy.act(**many))


def test_inputs_have_names(policy):
    """They cannot be swapped."""
    kinds = {p.kind for p in inspect.signature(policy.act).parameters.values()}
    assert kinds == {inspect.Parameter.KEYWORD_ONLY}
    with pytest.raises(TypeError, match=r"missing .*'goal'"):
        policy.act(preference=[0, 0, 1], lidar=[4.0] * 30)


def test_inputs_are_not_changed(policy):
    given = inputs(3)
    given["goal"][:, 0] = 40.0
    before = {name: value.copy() for name, value in given.items()}
    policy.act(**given)
    for name, value in given.items():
        np.testing.assert_array_equal(value, before[name])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"preference": [1e6, 0, 0]}, "sums to 1e+06; it must sum to 1 within 0.0001"),
        ({"preference": [-1, 1, 1]}, "preference[0] = -1 for objective 'demo' must be finite"),
        ({"preference": [1, 1, 0]}, "sums to 2"),
        ({"preference": [0.5, 0.5]}, "preference must have shape [..., 3], got [2]"),
        ({"preference": 1.0}, "preference must have shape [..., 3], got []"),
        ({"preference": "demo"}, "preference is no array of numbers"),
        ({"preference": None}, "preference is no array of numbers"),
        ({"preference": [[0, 0, 1]] * 3 + [[0, 1, 1]]}, "preference[3] = [0.0, 1.0, 1.0] over"),
        ({"lidar": [4.0] * 29}, "lidar must have shape [..., 30], got [29]"),
        ({"lidar": [4.0] * 29 + [math.nan]}, "'lidar'[29] = nan must be finite"),
        ({"lidar": [4.0] * 29 + [math.inf]}, "'lidar'[29] = inf must be finite"),
        ({"lidar": [4.0] * 29 + [-1.0]}, "lidar has the length -1 m: it must not be negative"),
        ({"preference": ["0", "0", "1"]}, "preference is no array of numbers: it is <U1"),
        (
            {"preference": torch.tensor([0, 0, 1j])},
            "preference is no array of numbers: it is torch",
        ),
        ({"preference": [[0, 1], [1]]}, "preference is no array of numbers"),
        ({"lidar": np.full(30, 4 + 1j)}, "lidar is no array of numbers"),
        ({"goal": [math.nan, 0]}, "'goal'[0] = nan must be finite"),
        ({"goal": np.ma.masked_array([1.0, 0.0], [True, False])}, "'goal'[0] = nan must be finite"),
        ({"lidar": torch.ones(30).to_sparse()}, "lidar is no array of numbers: it is torch.sparse"),
        ({"goal": torch.ones(2, device="meta")}, "goal is no array of numbers: it is on the meta"),
        (
            {"goal": torch.quantize_per_tensor(torch.ones(2), 0.1, 0, torch.quint8)},
            "goal is no array of numbers: it is torch.quint8",
        ),
        (
            {"goal": torch.nested.nested_tensor([torch.ones(2)])},
            "goal is no array of numbers: it is nested",
        ),
        ({"robot": [0.2, 0.5, 3, 6.28, 4, 0]}, "this policy does not read robot="),
        ({"goal": [-1, 0]}, "goal has the length -1 m"),
        ({"goal": [1, 0, 0]}, "goal must have shape [..., 2], got [3]"),
        ({"human": [1, -math.inf]}, "'human'[1] = -inf must be finite"),
        ({"human": [-0.5, 0]}, "human has the length -0.5 m"),
        ({"goal": [[1, 0]] * 2, "human": [[1, 0]] * 3}, "batch shapes do not go together"),
    ],
)
def test_what_is_refused(policy, changes, message):
    with pytest.raises(ValueError) as error:
        policy.act(**inputs() | changes)
    assert message in str(error.value) and len(str(error.value).splitlines()) == 1


OFF_THE_SIMPLEX = [
    ([1e6, 0.0, 0.0], "sums to 1e+06; it must sum to 1 within 0.0001"),
    ([-1.0, 1.0, 1.0], "= -1 for objective 'demo' must be finite and >= 0"),
    ([1.0, 1.0, 0.0], "sums to 2"),
    ([math.nan, 1.0, 0.0], "= nan for objective 'demo' must be finite"),
]


@pytest.mark.parametrize("batch", [(), (4,)])
@pytest.mark.parametrize(("preference", "message"), OFF_THE_SIMPLEX)
def test_the_actor_refuses_preferences_off_the_simplex(policy, preference, message, batch):
    preference = torch.tensor(preference).expand(*batch, 3)
    features = torch.randn(*batch, 36)
    for call in (
        lambda: policy.actor(features, preference),
        lambda: policy.actor(TensorDict(observation=features, preference=preference)),
        lambda: untrained_policy().actor(features, preference),
    ):
        with pytest.raises(ValueError) as error:
            call()
        assert message in str(error.value)
    swapped = TensorDict(observation=preference, preference=features)
    with pytest.raises(ValueError, match=r"preference must have shape \[..., 3\]"):
        policy.actor(swapped)


def test_what_traces_an_actor_looks_at_no_values(policy):
    features, preference = torch.randn(4, 36), torch.eye(3)[[0, 1, 2, 0]]
    expected = policy.actor(features, preference)[1]
    several = torch.vmap(policy.actor, randomness="error")(features, preference)[1]
    torch.testing.assert_close(several, expected)
    torch.testing.assert_close(
        torch.compile(policy.actor, backend="eager", fullgraph=True)(features, preference)[1],
        expected,
    )
    graph = torch.export.export(policy.actor, (features, preference), strict=False).module()
    torch.testing.assert_close(graph(features, preference)[1], expected)
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        fake = mode.from_tensor(features), mode.from_tensor(preference)
        assert policy.actor(*fake)[1].shape == (4, 2)


def test_a_training_takes_an_actor_that_looks_at_no_values():
    actor = load_policy(POLICIES / "polished_seed0", check_preferences=False).actor
    assert actor(torch.randn(4, 36), torch.zeros(4, 3))[1].isfinite().all()


@pytest.mark.parametrize("batch", [(), (4,)])
def test_distances_beyond_the_trained_range_are_its_end(policy, batch):
    given, sensing = inputs(*batch), policy.sensing
    for name, end in (("goal", sensing.goal_range[1]), ("human", sensing.human_range[1])):
        far, edge = given[name].copy(), given[name].copy()
        far[..., 0], edge[..., 0] = 40.0, end
        np.testing.assert_array_equal(
            policy.act(**given | {name: far}), policy.act(**given | {name: edge})
        )
    np.testing.assert_array_equal(
        policy.act(**given | {"lidar": np.full(30, 30.0)}),
        policy.act(**given | {"lidar": np.full(30, 4.0)}),
    )


def test_nobody(policy):
    given = inputs(4)
    del given["human"]
    expected = policy.act(**given, human=policy.sensing.nobody)
    np.testing.assert_array_equal(policy.act(**given), expected)


def test_a_policy_that_reads_the_velocity_asks_for_it(policy_folders):
    policy = load_policy(policy_folders["walking"])
    with pytest.raises(ValueError, match=r"reads the human's velocity: give human_velocity="):
        policy.act(**inputs())
    assert policy.act(**inputs(), human_velocity=[0.5, 0.0]).shape == (2,)
    given = inputs()
    del given["human"]
    assert policy.act(**given).shape == (2,)  # nobody stands still
    blind = load_policy(POLICIES / "our_nh")  # one that reads no human takes one and ignores them
    np.testing.assert_array_equal(blind.act(**inputs()), blind.act(**given))


def test_weights_of_1e30_do_not_command(policy, tmp_path):
    """They are finite, what comes out is not."""
    huge = load_policy(POLICIES / "polished_seed0")
    for value in huge.actor.parameters():
        value.mul_(1e30)
    with pytest.raises(ValueError, match="the policy's command is not finite"):
        huge.act(**inputs())


# --- the environment and the Gymnasium wrapper know what a policy senses ------------------------


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        (
            "walking",
            {},
            "this policy reads the human's velocity: observe_human_velocity=True",
        ),
        (
            "polished_seed0",
            {"observe_human_velocity": True},
            "this policy does not read the human's velocity: observe_human_velocity=False",
        ),
        ("our_nh", {}, "this policy does not read where the human is: observe_human=False"),
        (
            "polished_seed0",
            {"observe_human": False},
            "reads where the human is: observe_human=True",
        ),
        (
            "polished_seed0",
            {"max_range": 2.0},
            "trained with max_range=4.0, this environment has 2.0: set max_range=4.0",
        ),
        ("polished_seed0", {"max_range": 10}, "set max_range=4.0"),
    ],
)
@pytest.mark.parametrize("make", [make_policy_env, NavigationGymEnv])
def test_an_environment_that_shows_something_else_says_what_to_change(
    policy_folders, make, name, arguments, message
):
    with pytest.raises(ValueError) as error:
        make(policy=load_policy(policy_folders[name]), **arguments)
    assert message in str(error.value)


def test_gymnasium_shows_what_a_policy_senses(policy_folders):
    policy = load_policy(policy_folders["walking"])
    env = NavigationGymEnv(policy=policy, observe_human_velocity=True)
    seen, _ = env.reset(seed=0)
    assert seen.shape == (38,) and (seen[36:] == 0).all()
    seen, *_ = env.step(np.array([0.5, 0.0], dtype=np.float32))
    assert np.isfinite(seen).all()
    blind = NavigationGymEnv(policy=load_policy(POLICIES / "our_nh"), observe_human=False)
    assert blind.reset(seed=0)[0].shape == (33,)


def test_the_contract_of_a_training_is_that_of_its_policy():
    """Of every shipped policy: what it was trained with, and what its card says."""
    folders = sorted(path for path in POLICIES.iterdir() if path.is_dir())
    assert len(folders) > 10
    for folder in folders:
        policy = load_policy(folder)
        expected = contract(policy.card["config"]["env"])
        assert {name: getattr(policy, name) for name in expected} == expected, folder.name


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_sectors": 60}, "num_sectors=30, this robot has 60: set num_sectors=30"),
        ({"goal_scale": 1.0}, "goal_scale=5.0"),
        ({"human_scale": 1.0}, "human_scale=2.0"),
    ],
)
def test_sensing_names_the_first_difference(changes, message):
    with pytest.raises(ValueError) as error:
        Sensing().check(Sensing(**changes), "this robot")
    assert message in str(error.value)
