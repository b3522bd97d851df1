"""How a robot moves, and what it was told to do."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from torchrl_morl.arguments import check_count
from torchrl_morl.representation import describe
from torchrl_morl.transforms.robot import TOP_SPEED, TOP_TURN_RATE, check_robot
from torchrl_morl.transforms.stored import apart_from_storage

__all__ = ["OwnMotion"]


class OwnMotion(Transform):
    r"""Add a robot's measured speeds and its last commands.

    A command takes effect later than it is given. Who knows the last ones and how the robot moves can
    tell how much later. With poses :math:`(p, \theta)`, a step of length :math:`\Delta t` and
    commands :math:`a`, the entry is

    .. math::
        \big(R(-\theta_{t+1})_x\, (p_{t+1} - p_t) / \Delta t,\;
        (\theta_{t+1} - \theta_t) / \Delta t,\; a_t,\; a_{t-1},\; \dots\big)

    The transform itself remembers nothing: the previous pose and commands are those of the tensordict
    that is stepped. Both therefore become part of the state spec. After a reset the robot stands, and
    has been told to: all entries are zero.

    In an environment a step reads the action that the base environment gets: in m/s and rad/s, if
    :class:`~torchrl.envs.ActionScaling` is part of the chain.

    Args:
        pose_key (NestedKey): poses ``[*B, >= 3]`` of the robot: x and y in metres, the heading in
            radians.
        action_key (NestedKey): commands ``[*B, 2]``: speed and turn rate.
        out_key (NestedKey): where ``[*B, 2 + 2 * num_commands]`` is written, m/s and rad/s in turn.
        robot_key (NestedKey): where commands are shares of a robot's limits: robots ``[*B, 6]``, see
            :meth:`torchrl_morl.deploy.Sensing.robot`. ``None``: commands are in m/s and rad/s.

    Keyword Args:
        period (float): length of a step, seconds.
        num_commands (int): commands that are kept, the latest first.
        dtype (torch.dtype): of what is written.

    Raises:
        KeyError: at a call without the robots that ``robot_key`` names.
        ValueError: if the period is not finite and positive, or the number of commands below 1; at a call
            with robots of another shape.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> data = TensorDict(
        ...     pose=torch.tensor([1.0, 2.0, 0.0]),
        ...     motion=torch.tensor([0.0, 0.0, 0.4, 0.1, 0.0, 0.0]),
        ...     action=torch.tensor([0.5, 0.0]),
        ...     next=TensorDict(pose=torch.tensor([1.1, 2.0, 0.0])),
        ... )
        >>> OwnMotion(period=0.2, num_commands=2)(data)["next", "motion"]
        tensor([0.5000, 0.0000, 0.5000, 0.0000, 0.4000, 0.1000])

    """

    def __init__(
        self,
        pose_key: NestedKey = "pose",
        action_key: NestedKey = "action",
        out_key: NestedKey = "motion",
        robot_key: NestedKey | None = None,
        *,
        period: float,
        num_commands: int = 4,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        if not (math.isfinite(period) and period > 0):
            raise ValueError(f"period must be finite and > 0 seconds, got {period}.")
        check_count("num_commands", num_commands)
        super().__init__(in_keys=[unravel_key(pose_key)], out_keys=[unravel_key(out_key)])
        self.action_key = unravel_key(action_key)
        self.robot_key = None if robot_key is None else unravel_key(robot_key)
        self.period, self.num_commands, self.dtype = period, num_commands, dtype

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the motion of recorded transitions to their ``"next"``.

        Args:
            tensordict (TensorDictBase): holds pose, action and motion at the root, the pose in
                ``"next"``.

        Returns:
            The same tensordict; for a lazy stack, a shallow copy of it.

        """
        tensordict = apart_from_storage(tensordict)
        self._step(tensordict, tensordict.get("next"))
        return tensordict

    def __repr__(self) -> str:
        return describe(
            self,
            pose_key=self.in_keys[0],
            action_key=self.action_key,
            out_key=self.out_keys[0],
            robot_key=self.robot_key,
            period=self.period,
            num_commands=self.num_commands,
        )

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        (pose_key,), (out_key,) = self.in_keys, self.out_keys
        pose, last = next_tensordict.get(pose_key), tensordict.get(pose_key)
        (x, y), heading = (pose[..., :2] - last[..., :2]).unbind(-1), pose[..., 2]
        turned = heading - last[..., 2]
        turned = torch.atan2(turned.sin(), turned.cos())  # the shorter way round
        speed = heading.cos() * x + heading.sin() * y
        measured = torch.stack((speed, turned), dim=-1) / self.period
        commands = tensordict[out_key][..., 2 : 2 * self.num_commands]
        action = tensordict.get(self.action_key)
        if self.robot_key is not None:
            robot = tensordict[self.robot_key]
            check_robot(robot, self.robot_key)
            action = action * robot[..., TOP_SPEED : TOP_TURN_RATE + 1]
        motion = torch.cat((measured.to(self.dtype), action.to(self.dtype), commands), dim=-1)
        return next_tensordict.set(out_key, motion)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        pose = tensordict_reset.get(self.in_keys[0])
        shape = (*pose.shape[:-1], self._size)
        motion = torch.zeros(shape, device=pose.device, dtype=self.dtype)
        return tensordict_reset.set(self.out_keys[0], motion)

    @property
    def _size(self) -> int:
        return 2 + 2 * self.num_commands

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        observation_spec = observation_spec.clone()
        observation_spec[self.out_keys[0]] = self._spec(observation_spec[self.in_keys[0]])
        return observation_spec

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        state_spec = state_spec.clone()
        observed = self.parent.full_observation_spec
        pose = observed[self.in_keys[0]]
        known = state_spec.keys(True, True)
        for key in (self.in_keys[0], self.robot_key):
            if key is not None and key not in known:
                state_spec[key] = observed[key].clone()
        if self.out_keys[0] not in known:
            state_spec[self.out_keys[0]] = self._spec(pose)
        return state_spec

    def _spec(self, pose: TensorSpec) -> Unbounded:
        shape = (*pose.shape[:-1], self._size)
        return Unbounded(shape, device=pose.device, dtype=self.dtype)
