"""The preference interpolator: agreement with scipy, the normalised space and the state."""

from __future__ import annotations

import pytest
import torch
from scipy.interpolate import RBFInterpolator
from torch.nn import functional as F

from torchrl_morl.modules import PreferenceInterpolator


def _simplex(*shape: int) -> torch.Tensor:
    return torch.distributions.Dirichlet(torch.ones(shape[-1])).sample(shape[:-1])


@pytest.mark.parametrize("space", ["normalized", "raw"])
@pytest.mark.parametrize(("num_keys", "num_tunable"), [(2, 2), (3, 2), (3, 3), (10, 3), (30, 4)])
def test_equals_the_scipy_interpolator(num_keys, num_tunable, space):
    keys = _simplex(num_keys, num_tunable)
    # What a policy trades: more weight, a smaller penalty. No key is then worst in everything.
    solutions = 300 * (keys - 1) - 20 * torch.rand(num_keys, num_tunable)
    interpolator = PreferenceInterpolator(keys, value_space=space)
    interpolator.refit(solutions)
    points = solutions
    if space == "normalized":
        points = (points - points.amin(0)) / (points.amax(0) - points.amin(0))
    reference = RBFInterpolator(
        keys.double(), F.normalize(points.double(), dim=-1), kernel="linear"
    )
    preference = _simplex(50, num_tunable)
    expected = F.normalize(torch.as_tensor(reference(preference.double())), dim=-1)
    direction = interpolator(preference)
    torch.testing.assert_close(direction.double(), expected, rtol=0.0, atol=1e-5)


def test_two_objectives_are_interpolated_linearly():
    # Known in closed form for two keys: a straight line between the unit vectors.
    interpolator = PreferenceInterpolator(torch.eye(2), value_space="raw")
    interpolator.refit(torch.tensor([[3.0, 4.0], [0.0, 2.0]]))
    direction = interpolator(torch.tensor([0.25, 0.75]))
    expected = F.normalize(
        0.25 * torch.tensor([0.6, 0.8]) + 0.75 * torch.tensor([0.0, 1.0]), dim=-1
    )
    torch.testing.assert_close(direction, expected)


def test_keys_map_to_their_solutions():
    interpolator = PreferenceInterpolator(torch.eye(3))
    solutions = torch.tensor(
        [[-20.0, -300.0, -200.0], [-90.0, -40.0, -250.0], [-80.0, -200.0, -10.0]]
    )
    interpolator.refit(solutions)
    expected = F.normalize(interpolator.normalize(solutions), dim=-1)
    torch.testing.assert_close(interpolator(torch.eye(3)), expected, atol=1e-6, rtol=0.0)
    # The point of the normalised space: the objective a key policy is best at is its longest entry.
    assert interpolator(torch.eye(3)).argmax(-1).tolist() == [0, 1, 2]


def test_is_not_rounded_under_autocast():
    interpolator = PreferenceInterpolator(torch.eye(3))
    interpolator.refit(-100 * torch.rand(3, 3))
    preference = _simplex(50, 3)
    exact = interpolator(preference)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(interpolator(preference), exact)


def test_one_objective():
    interpolator = PreferenceInterpolator(torch.ones(1, 1))
    preference = torch.ones(5, 1)
    assert (interpolator(preference) == 1).all()
    interpolator.refit(torch.tensor([[-7.0]]))
    torch.testing.assert_close(interpolator(preference), preference)
    torch.testing.assert_close(interpolator.normalize(torch.tensor([-5.0])), torch.tensor([2.0]))


def test_is_the_identity_before_the_first_refit():
    interpolator = PreferenceInterpolator(torch.eye(3))
    preference = _simplex(7, 3)
    torch.testing.assert_close(interpolator(preference), F.normalize(preference, dim=-1))
    values = torch.randn(7, 3)
    assert torch.equal(interpolator.normalize(values), values)


def test_identity_keeps_the_direction_and_moves_the_space():
    interpolator = PreferenceInterpolator(torch.eye(2), identity=True)
    interpolator.refit(torch.tensor([[-2.0, -9.0], [-6.0, -1.0]]))
    preference = _simplex(7, 2)
    torch.testing.assert_close(interpolator(preference), F.normalize(preference, dim=-1))
    values = torch.tensor([[-4.0, -1.0], [-6.0, -13.0]])
    expected = torch.tensor([[0.5, 1.0], [0.0, -0.5]])
    torch.testing.assert_close(interpolator.normalize(values), expected)


def test_raw_space_never_normalises():
    interpolator = PreferenceInterpolator(torch.eye(2), value_space="raw")
    interpolator.refit(torch.tensor([[-2.0, -9.0], [-6.0, -1.0]]))
    values = torch.randn(4, 2)
    assert torch.equal(interpolator.normalize(values), values)


def test_objectives_without_a_range_are_shifted_only():
    interpolator = PreferenceInterpolator(torch.eye(2))
    # Two neighbouring float32 numbers.
    interpolator.refit(torch.tensor([[-300.0, -1.0], [-300.00003, -2.0]]))
    assert interpolator.low[0] < interpolator.high[0]
    normalized = interpolator.normalize(torch.tensor([-299.0, -1.5]))
    torch.testing.assert_close(normalized, torch.tensor([1.0, 0.5]), atol=1e-4, rtol=0.0)


def test_a_key_policy_that_is_worst_in_everything_keeps_its_preference():
    interpolator = PreferenceInterpolator(torch.tensor([[1.0, 0.0], [0.25, 0.75], [0.0, 1.0]]))
    interpolator.refit(torch.tensor([[-1.0, -5.0], [-9.0, -9.0], [-5.0, -1.0]]))
    direction = interpolator(torch.tensor([0.25, 0.75]))
    expected = F.normalize(torch.tensor([0.25, 0.75]), dim=-1)
    torch.testing.assert_close(direction, expected, atol=1e-6, rtol=0.0)


def test_refit_is_a_running_estimate_after_the_first_call():
    interpolator = PreferenceInterpolator(torch.eye(2))
    first = torch.tensor([[-2.0, -8.0], [-6.0, -4.0]])
    interpolator.refit(first, momentum=0.9)
    torch.testing.assert_close(interpolator.key_solutions, first)
    second = torch.tensor([[-4.0, -8.0], [-10.0, 0.0]])
    interpolator.refit(second, momentum=0.75)
    expected = torch.tensor([[-2.5, -8.0], [-7.0, -3.0]])
    torch.testing.assert_close(interpolator.key_solutions, expected)
    torch.testing.assert_close(interpolator.low, torch.tensor([-7.0, -8.0]))
    torch.testing.assert_close(interpolator.high, torch.tensor([-2.5, -3.0]))


def test_state_dict_round_trip_and_no_parameters():
    interpolator = PreferenceInterpolator(_simplex(5, 3))
    interpolator.refit(-torch.rand(5, 3))
    assert list(interpolator.parameters()) == []
    restored = PreferenceInterpolator(_simplex(5, 3))
    restored.load_state_dict(interpolator.state_dict())
    preference = _simplex(9, 3)
    assert torch.equal(restored(preference), interpolator(preference))
    values = torch.randn(9, 3)
    assert torch.equal(restored.normalize(values), interpolator.normalize(values))


@pytest.mark.parametrize("batch", [(), (0,), (4,), (2, 3, 4)])
def test_any_batch_shape(batch):
    interpolator = PreferenceInterpolator(torch.eye(3))
    interpolator.refit(-torch.rand(3, 3))
    preference = _simplex(*batch, 3)
    direction = interpolator(preference)
    assert direction.shape == (*batch, 3)
    torch.testing.assert_close(direction.norm(dim=-1), torch.ones(batch))
    flat = interpolator(preference.reshape(-1, 3))
    torch.testing.assert_close(direction.reshape(-1, 3), flat)


@pytest.mark.parametrize("identity", [False, True])
def test_compiles_to_one_graph_that_sees_a_refit(identity):
    interpolator = PreferenceInterpolator(torch.eye(2), identity=identity)
    compiled = torch.compile(
        lambda preference, values: (interpolator(preference), interpolator.normalize(values)),
        fullgraph=True,
        backend="eager",
    )
    preference, values = _simplex(4, 2), torch.randn(4, 2)
    before = compiled(preference, values)
    interpolator.refit(torch.tensor([[-2.0, -9.0], [-6.0, -1.0]]))
    after = compiled(preference, values)
    torch.testing.assert_close(after[0], interpolator(preference))
    torch.testing.assert_close(after[1], interpolator.normalize(values))
    assert not torch.allclose(before[1], after[1])


@pytest.mark.parametrize(
    ("solutions", "message"),
    [
        (torch.zeros(2, 2), "must have shape"),
        (torch.zeros(3), "must have shape"),
        (torch.tensor([[1.0, 2.0], [float("nan"), 1.0], [0.0, 0.0]]), "must be finite"),
        (torch.tensor([[1.0, 2.0], [float("inf"), 1.0], [0.0, 0.0]]), "must be finite"),
    ],
)
def test_bad_key_solutions_leave_the_state_alone(solutions, message):
    interpolator = PreferenceInterpolator(_simplex(3, 2))
    before = {name: value.clone() for name, value in interpolator.state_dict().items()}
    with pytest.raises(ValueError, match=message):
        interpolator.refit(solutions)
    for name, value in interpolator.state_dict().items():
        assert torch.equal(value, before[name]), name


@pytest.mark.parametrize("momentum", [-0.1, 1.0])
def test_bad_momentum(momentum):
    with pytest.raises(ValueError, match=r"momentum must be in \[0, 1\)"):
        PreferenceInterpolator(torch.eye(2)).refit(torch.zeros(2, 2), momentum=momentum)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (torch.ones(3), "non-empty"),
        (torch.ones(0, 3), "non-empty"),
        (torch.tensor([[0.5, 0.5], [0.5, 0.5]]), "distinct"),
        (torch.tensor([[0.5, 0.5], [0.0, 0.0]]), "no row zero"),
        (torch.tensor([[0.5, float("nan")]]), "finite"),
    ],
)
def test_bad_keys(keys, message):
    with pytest.raises(ValueError, match=message):
        PreferenceInterpolator(keys)


def test_other_bad_arguments():
    with pytest.raises(ValueError, match="space must be one of"):
        PreferenceInterpolator(torch.eye(2), value_space="unit")
    interpolator = PreferenceInterpolator(torch.eye(3))
    with pytest.raises(ValueError, match="preference must have 3 entries"):
        interpolator(torch.ones(4, 1))
    with pytest.raises(ValueError, match="values must have 3 entries"):
        interpolator.normalize(torch.ones(4, 1))
