"""Angle between vectors: values, gradients and the corner cases of both forms."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_morl.objectives import angle_between


def _gradient(u: torch.Tensor, v: torch.Tensor, form: str) -> torch.Tensor:
    v = v.clone().requires_grad_()
    angle_between(u, v, form=form).sum().backward()
    return v.grad


@pytest.mark.parametrize(
    ("v", "degrees"),
    [
        ((3.0, 0.0), 0.0),
        ((1.0, 1.0), 45.0),
        ((0.0, 5.0), 90.0),
        ((-2.0, 2.0), 135.0),
        ((-0.1, 0.0), 180.0),
    ],
)
def test_atan2_is_exact_from_parallel_to_antiparallel(v, degrees):
    angle = angle_between(torch.tensor([2.0, 0.0]), torch.tensor(v))
    torch.testing.assert_close(angle, torch.tensor(math.radians(degrees)))


def test_tiny_angles_are_resolved():
    # acos of a float32 cosine reads zero here.
    angle = angle_between(torch.tensor([1.0, 0.0]), torch.tensor([1.0, 1e-5]))
    torch.testing.assert_close(angle, torch.tensor(1e-5), rtol=1e-3, atol=0.0)


def test_atan2_equals_the_arccosine_where_that_is_well_conditioned():
    u, v = torch.randn(64, 3, dtype=torch.float64), torch.randn(64, 3, dtype=torch.float64)
    expected = torch.acos(torch.nn.functional.cosine_similarity(u, v, dim=-1))
    torch.testing.assert_close(angle_between(u, v), expected)


def test_atan2_gradient_is_correct():
    u = torch.randn(5, 3, dtype=torch.float64)
    v = torch.randn(5, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: angle_between(u, v), v)


@pytest.mark.parametrize("length", [0.1, 1.0, 300.0])
@pytest.mark.parametrize("v", [(1.0, 2.0), (-1.0, 0.5), (-3.0, -4.0)])
def test_atan2_gradient_has_the_inverse_length_of_the_vector(v, length):
    v = torch.nn.functional.normalize(torch.tensor(v), dim=-1) * length
    norm = _gradient(torch.tensor([0.3, 0.7]), v, "atan2").norm()
    torch.testing.assert_close(norm, torch.tensor(1 / length), rtol=1e-4, atol=0.0)


def test_obtuse_angle_of_penalties_is_alive_only_with_atan2():
    preference, penalties = torch.tensor([0.3, 0.7]), torch.tensor([-20.0, -5.0])
    assert angle_between(preference, penalties, form="official") == 90.0
    assert (_gradient(preference, penalties, "official") == 0).all()
    assert angle_between(preference, penalties) > math.pi / 2
    gradient = _gradient(preference, penalties, "atan2")
    closer = angle_between(preference, penalties - gradient)
    assert closer < angle_between(preference, penalties)


@pytest.mark.parametrize("v", [(0.6, 0.8), (-0.6, -0.8)])
def test_gradient_is_finite_for_parallel_and_antiparallel_vectors(v):
    u = torch.tensor([0.6, 0.8])
    gradient = _gradient(u, torch.tensor(v), "atan2")
    assert gradient.isfinite().all()


@pytest.mark.parametrize("u", [(1.0, 0.0), (0.0, 0.0)])
@pytest.mark.parametrize("v", [(0.0, 0.0), (1e-9, 0.0)])
def test_a_zero_vector_is_at_a_right_angle_without_gradient(u, v):
    u, v = torch.tensor(u), torch.tensor(v)
    torch.testing.assert_close(angle_between(u, v), torch.tensor(math.pi / 2))
    assert (_gradient(u, v, "atan2") == 0).all()


def test_a_zero_vector_does_not_spoil_its_neighbours():
    u = torch.tensor([[1.0, 0.0], [1.0, 0.0]])
    v = torch.tensor([[0.0, 0.0], [1.0, 1.0]])
    gradient = _gradient(u, v, "atan2")
    torch.testing.assert_close(gradient, torch.tensor([[0.0, 0.0], [-0.5, 0.5]]))


def test_official_form_is_in_degrees_and_clamps_the_cosine():
    u = torch.tensor([1.0, 0.0])
    v = torch.tensor([[1.0, 0.0], [1.0, math.sqrt(3)], [0.0, 1.0], [-1.0, 0.0]])
    expected = torch.tensor([math.degrees(math.acos(0.9999)), 60.0, 90.0, 90.0])
    angle = angle_between(u, v, form="official")
    torch.testing.assert_close(angle, expected, rtol=1e-4, atol=0.0)


def test_clamp_of_the_official_form_replaces_the_nan_of_acos():
    cosine = torch.ones((), requires_grad=True)
    (cosine * torch.acos(cosine)).backward()
    assert not cosine.grad.isfinite()
    u = torch.tensor([0.6, 0.8])
    assert (_gradient(u, 2 * u, "official") == 0).all()


def test_official_form_is_finite_for_a_zero_vector():
    u, zero = torch.tensor([0.6, 0.8]), torch.zeros(2)
    assert angle_between(u, zero, form="official") == 90.0
    assert _gradient(u, zero, "official").isfinite().all()


@pytest.mark.parametrize("form", ["atan2", "official"])
def test_leading_dimensions_broadcast(form):
    u, v = torch.rand(5, 3), torch.rand(2, 5, 3)
    angle = angle_between(u, v, form=form)
    assert angle.shape == (2, 5)
    torch.testing.assert_close(angle[1], angle_between(u, v[1], form=form))


def test_one_entry_knows_only_same_or_opposite():
    u = torch.ones(2, 1)
    angle = angle_between(u, torch.tensor([[3.0], [-3.0]]))
    torch.testing.assert_close(angle, torch.tensor([0.0, math.pi]))


def test_bad_arguments():
    with pytest.raises(ValueError, match="vectors of one length"):
        angle_between(torch.ones(4, 1), torch.ones(4, 3))
    with pytest.raises(ValueError, match="form must be one of"):
        angle_between(torch.ones(3), torch.ones(3), form="acos")
