"""A small multi-objective TD3 loss and batches for it."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torchrl.data import Bounded

from torchrl_morl.modules import (
    PreferenceInterpolator,
    ValueSpace,
    make_actor,
    make_vector_critic,
)
from torchrl_morl.objectives import MOTD3Loss
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.testing import random_transitions

OBS, ACT = 4, 2
SPEC = Bounded(torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 3.0]))
SPACE = PreferenceSpace(("core", "distance", "efficiency"), static={"core": 1.0})


def make_networks(
    num_objectives: int = 3, num_tunable: int = 2, num_cells: tuple[int, ...] = (16,)
):
    size = OBS + num_tunable
    actor = make_actor(SPEC, in_features=size, num_cells=num_cells, last_layer_gain=1.0)
    critic = make_vector_critic(num_objectives, in_features=size + ACT, num_cells=num_cells)
    return actor, critic


def make_interpolator(value_space: ValueSpace = "normalized") -> PreferenceInterpolator:
    interpolator = PreferenceInterpolator(torch.eye(2), value_space=value_space)
    interpolator.refit(torch.tensor([[0.1, -2.0], [-3.0, 0.2]]))
    return interpolator


def make_loss(num_cells: tuple[int, ...] = (16,), **kwargs) -> MOTD3Loss:
    """A loss with every term on."""
    defaults = {
        "preference_space": SPACE,
        "interpolator": make_interpolator("raw" if kwargs.get("angle") == "raw" else "normalized"),
        "angle": "normalized",
        "angle_coeff_actor": 0.3,
        "angle_coeff_critic": 0.2,
        "pre_tanh_coeff": 0.1,
        "action_spec": SPEC,
    }
    return MOTD3Loss(*make_networks(num_cells=num_cells), **(defaults | kwargs))


def make_batch(*batch: int, num_objectives: int = 3, num_tunable: int = 2) -> TensorDict:
    # Rewards and preferences of sizes that need not go together: some tests want them not to.
    rewards, wishes = (
        PreferenceSpace(tuple(f"objective {i}" for i in range(size)))
        for size in (num_objectives, num_tunable)
    )
    data = random_transitions(rewards, *batch, observation_size=OBS, action_spec=SPEC)
    data["preference"] = wishes.sample(batch)
    data["next", "preference"] = data["preference"].clone()
    return data


def seeded(loss, batch: TensorDict, seed: int = 1) -> TensorDict:
    torch.manual_seed(seed)
    return loss(batch.clone())
