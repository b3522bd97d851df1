"""Whether somebody stands there, as in what was demonstrated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_morl.transforms.robot import ROBOT_SCALES, TOP_SPEED

_STANDS = 0.3
"""Speed below which a human stands, m/s; the noise of reported positions gives them some."""


def human_speed(observation: Tensor, parts: Mapping[str, Sequence[int]]) -> Tensor | None:
    """How fast the human walks, m/s, ``[*B]``; ``None`` where that is not observed.

    Args:
        observation: ``[*B, D]``, see :func:`~torchrl_morl.deploy.features.policy_transforms`.
        parts: of it, see :func:`~torchrl_morl.deploy.features.observation_parts`.
    """
    if "human_velocity" not in parts:
        return None
    ahead, left = parts["human_velocity"]
    speed = torch.hypot(observation[..., ahead], observation[..., left])
    if "robot" in parts:  # velocities are in units of its top speed
        speed = speed * ROBOT_SCALES[TOP_SPEED] * observation[..., parts["robot"][TOP_SPEED]]
    return speed


def somebody_stands(observation: Tensor, parts: Mapping[str, Sequence[int]]) -> Tensor | None:
    """Where somebody is there and stands, bool ``[*B]``; ``None`` where neither is observed.

    Args:
        observation: ``[*B, D]``, see :func:`~torchrl_morl.deploy.features.policy_transforms`.
        parts: of it, see :func:`~torchrl_morl.deploy.features.observation_parts`.
    """
    speed = human_speed(observation, parts)
    stands = None if speed is None else speed < _STANDS
    if "nobody" in parts:
        somebody = observation[..., parts["nobody"][0]] == 0
        stands = somebody if stands is None else stands & somebody
    return stands


class WhereSomebodyStands(TensorDictModuleBase):
    """A reward model that likes nothing where nobody stands.

    People are demonstrated standing. What a reward model makes of others, or of an empty room, it has
    not learned; there the demonstration says nothing, and each step costs what it costs in efficiency.

    Args:
        reward_model: reads ``observation``, writes one score a step, ``[*B, 1]``.
        parts: of the observation, see :func:`~torchrl_morl.deploy.features.observation_parts`.

    Raises:
        ValueError: for observations that do not tell.
    """

    def __init__(
        self, reward_model: TensorDictModuleBase, parts: Mapping[str, Sequence[int]]
    ) -> None:
        super().__init__()
        if not {"human_velocity", "nobody"} & set(parts):
            raise ValueError(
                "demonstrations.standing_only needs env.observe_human_velocity or env.observe_nobody: "
                "without them nothing tells who stands."
            )
        self.reward_model, self._parts = reward_model, dict(parts)
        self.in_keys, self.out_keys = list(reward_model.in_keys), list(reward_model.out_keys)
        if "observation" not in self.in_keys:
            self.in_keys.append("observation")

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the scores."""
        stands = somebody_stands(tensordict["observation"], self._parts)
        tensordict = self.reward_model(tensordict)
        for key in self.out_keys:
            score = tensordict.get(key)
            tensordict.set(key, score * stands.unsqueeze(-1))
        return tensordict
