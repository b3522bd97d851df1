"""How fast something moves, from where it is seen."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from torchrl_morl.representation import describe
from torchrl_morl.transforms.stored import apart_from_storage

__all__ = ["VelocityInFrame"]


class VelocityInFrame(Transform):
    r"""Add the velocity of something that moves in the plane, along the axes of something else.

    One position says nothing about where a person is going. With positions :math:`p` in a fixed
    frame, a step of length :math:`\Delta t`, and the heading :math:`\theta` of the robot,

    .. math::
        v_{t+1} = R(-\theta_{t+1})\, (p_{t+1} - p_t) / \Delta t

    is the velocity over the ground, ahead and to the left. A real robot gets both positions from its
    odometry and what it sees of the person.

    The transform itself remembers nothing: the previous position is that of the tensordict that is
    stepped. It therefore becomes part of the state spec, so that batched environments hand it on to
    their workers. A reset is a first sight: the velocity is zero, also after a snapshot is restored.

    Args:
        in_key (NestedKey): positions ``[*B, >= 2]``, metres: x and y come first.
        frame_key (NestedKey): poses ``[*B, >= 3]`` of the robot: the heading in radians is third.
        out_key (NestedKey): where the velocity ``[*B, 2]`` is written, m/s.

    Keyword Args:
        period (float): length of a step, seconds.
        max_speed (float): of what moves, m/s: what is faster are the positions of two people, of whom
            now the one and now the other is the nearest; it reads 0.
        dtype (torch.dtype): of the velocity.

    Raises:
        ValueError: if the period is not finite and positive, or the speed not positive.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> facing_left = torch.tensor([0.0, 0.0, torch.pi / 2])
        >>> later = TensorDict(human_pose=torch.tensor([4.0, 1.1]), pose=facing_left)
        >>> data = TensorDict(human_pose=torch.tensor([4.0, 1.0]), next=later)
        >>> VelocityInFrame(period=0.2)(data)["next", "human_velocity"].round(decimals=3) + 0.0
        tensor([0.5000, 0.0000])

    """

    def __init__(
        self,
        in_key: NestedKey = "human_pose",
        frame_key: NestedKey = "pose",
        out_key: NestedKey = "human_velocity",
        *,
        period: float,
        max_speed: float = math.inf,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        if not max_speed > 0:
            raise ValueError(f"max_speed must be > 0 m/s, got {max_speed}.")
        if not (math.isfinite(period) and period > 0):
            raise ValueError(f"period must be finite and > 0 seconds, got {period}.")
        super().__init__(
            in_keys=[unravel_key(in_key), unravel_key(frame_key)], out_keys=[unravel_key(out_key)]
        )
        self.period, self.max_speed = period, max_speed
        self.dtype = dtype

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the velocity of recorded transitions to their ``"next"``.

        Args:
            tensordict (TensorDictBase): holds the position at the root, position and pose in
                ``"next"``.

        Returns:
            The same tensordict; for a lazy stack, a shallow copy of it.

        """
        tensordict = apart_from_storage(tensordict)
        self._step(tensordict, tensordict.get("next"))
        return tensordict

    def __repr__(self) -> str:
        position, frame = self.in_keys
        return describe(
            self, in_key=position, frame_key=frame, out_key=self.out_keys[0], period=self.period
        )

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        position, frame = self.in_keys
        moved = next_tensordict.get(position)[..., :2] - tensordict.get(position)[..., :2]
        x, y = moved.unbind(-1)
        heading = next_tensordict.get(frame)[..., 2]
        cos, sin = heading.cos(), heading.sin()
        velocity = torch.stack((cos * x + sin * y, cos * y - sin * x), dim=-1) / self.period
        if self.max_speed < math.inf:
            too_fast = velocity.norm(dim=-1, keepdim=True) > self.max_speed
            velocity = velocity.masked_fill(too_fast, 0.0)
        return next_tensordict.set(self.out_keys[0], velocity.to(self.dtype))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        position = tensordict_reset.get(self.in_keys[0])
        velocity = torch.zeros_like(position[..., :2], dtype=self.dtype)
        return tensordict_reset.set(self.out_keys[0], velocity)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        observation_spec = observation_spec.clone()
        spec = observation_spec[self.in_keys[0]]
        observation_spec[self.out_keys[0]] = Unbounded(
            (*spec.shape[:-1], 2), device=spec.device, dtype=self.dtype
        )
        return observation_spec

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        state_spec = state_spec.clone()
        position = self.in_keys[0]
        if position not in state_spec.keys(True, True):
            state_spec[position] = self.parent.full_observation_spec[position].clone()
        return state_spec
