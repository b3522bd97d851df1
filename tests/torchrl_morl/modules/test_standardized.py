"""Networks that see their inputs in units of their spread."""

from __future__ import annotations

import pytest
import torch
from torchrl.data import Bounded

from torchrl_morl.modules import (
    StandardizedLinear,
    fold_standardization,
    make_actor,
    make_vector_critic,
    standardize_inputs,
)

LOC, SCALE = torch.tensor([5.0, -1.0, 0.0]), torch.tensor([2.0, 0.5, 10.0])


def actor():
    return make_actor(
        Bounded(-1.0, 1.0, (2,)), in_features=5, num_cells=(16, 16), last_layer_gain=1.0
    )


def critic():
    return make_vector_critic(2, in_features=7, num_cells=(16,))


def test_by_hand():
    layer = StandardizedLinear(3, 1, LOC[:2], SCALE[:2])
    with torch.no_grad():
        layer.weight.copy_(torch.tensor([[1.0, 10.0, 100.0]]))
        layer.bias.fill_(0.25)
    # (9 - 5) / 2, (0 + 1) / 0.5, and the third as it is.
    assert layer(torch.tensor([9.0, 0.0, 7.0])).item() == pytest.approx(2 + 20 + 700 + 0.25)


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
@pytest.mark.parametrize("make", [actor, critic])
def test_the_same_network_of_standardized_inputs(make, batch):
    plain, network = make(), make()
    network.load_state_dict(plain.state_dict())
    standardize_inputs(network, LOC, SCALE)
    observation, rest = torch.randn(*batch, 3) * SCALE + LOC, torch.rand(*batch, 2)
    given = (rest, torch.rand(*batch, 2)) if make is critic else (rest,)
    wanted = plain((observation - LOC) / SCALE, *given)
    found = network(observation, *given)
    folded = fold_standardization(network)(observation, *given)
    for one, other, third in zip(
        *(x if isinstance(x, tuple) else (x,) for x in (wanted, found, folded))
    ):
        torch.testing.assert_close(other, one)
        torch.testing.assert_close(third, one, atol=1e-5, rtol=1e-4)


def test_folding_leaves_the_network_alone_and_makes_a_plain_one():
    network = actor()
    standardize_inputs(network, LOC, SCALE)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    folded = fold_standardization(network)
    with torch.no_grad():
        for parameter in folded.parameters():
            parameter.zero_()
    for name, value in network.state_dict().items():
        assert torch.equal(value, before[name])
    assert folded.state_dict().keys() == actor().state_dict().keys()
    assert fold_standardization(folded).state_dict().keys() == folded.state_dict().keys()


def test_statistics_are_state_and_no_parameters():
    network, other = actor(), actor()
    standardize_inputs(network, LOC, SCALE)
    standardize_inputs(other, torch.zeros(3), torch.ones(3))
    assert len(list(network.parameters())) == len(list(actor().parameters()))
    other.load_state_dict(network.state_dict())
    observation, preference = torch.randn(4, 3), torch.rand(4, 2)
    assert torch.equal(other(observation, preference)[1], network(observation, preference)[1])


def test_compiled():
    network = actor()
    standardize_inputs(network, LOC, SCALE)
    layer = network[0].module[0]
    given = torch.randn(6, 5)
    torch.testing.assert_close(
        torch.compile(layer, backend="eager", fullgraph=True)(given), layer(given)
    )


@pytest.mark.parametrize(
    ("loc", "scale", "message"),
    [
        (torch.zeros(2), torch.ones(3), "both have shape"),
        (torch.zeros(6), torch.ones(6), "F at most 5"),
        (torch.zeros(2, 1), torch.ones(2, 1), "both have shape"),
        (torch.zeros(2), torch.tensor([1.0, 0.0]), "scale positive"),
        (torch.tensor([0.0, float("nan")]), torch.ones(2), "loc must be finite"),
        (torch.zeros(2), torch.tensor([1.0, float("inf")]), "scale positive"),
    ],
)
def test_statistics_that_are_refused(loc, scale, message):
    network = actor()
    before = network.state_dict()
    with pytest.raises(ValueError, match=message) as caught:
        standardize_inputs(network, loc, scale)
    assert "\n" not in str(caught.value)
    assert network.state_dict().keys() == before.keys()


def test_networks_that_are_refused():
    network = actor()
    standardize_inputs(network, LOC, SCALE)
    with pytest.raises(ValueError, match="standardized already"):
        standardize_inputs(network, LOC, SCALE)
    with pytest.raises(ValueError, match="make_actor or make_vector_critic, got a Linear"):
        standardize_inputs(torch.nn.Linear(3, 2), LOC, SCALE)
