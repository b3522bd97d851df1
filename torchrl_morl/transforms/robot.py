"""Which robot it is: ranges from its hull, speeds in units of its own, and its numbers."""

from __future__ import annotations

import dataclasses
import math

import torch
from tensordict import TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from torchrl_morl.arguments import check_positive
from torchrl_morl.representation import describe
from torchrl_morl.transforms.stored import apart_from_storage

__all__ = [
    "LIDAR_RANGE",
    "ROBOT_SCALES",
    "TOP_SPEED",
    "TOP_TURN_RATE",
    "HullRange",
    "InUnitsOf",
    "IsNobody",
    "MotionInUnits",
    "RobotScale",
    "hull_ranges",
    "motion_in_units",
]

ROBOT_SCALES = (0.25, 1.0, math.pi, 2 * math.pi, 10.0, 0.25)
"""What becomes 1 of radius (m), top speed (m/s), top turn rate (rad/s), the lidar's view (rad), its range
(m), and its distance ahead of the rotation centre (m)."""

TOP_SPEED, TOP_TURN_RATE, LIDAR_RANGE = 1, 2, 4
"""Where these stand in the numbers of a robot."""


def hull_ranges(lidar: Tensor, robot: Tensor) -> Tensor:
    """Free distance from the hull of a round robot, along the middle of each sector.

    Args:
        lidar: shortest range of each sector from the lidar, ``[*B, S]``, metres.
        robot: its six numbers, ``[*B, 6]``, see :meth:`torchrl_morl.deploy.Sensing.robot`.

    Returns:
        ``[*B, S]``, metres, at least a millimetre.

    Example:
        >>> import torch
        >>> robot = torch.tensor([0.2, 0.5, 3.0, 6.28, 4.0, 0.1])
        >>> hull_ranges(torch.full((2,), 1.0), robot)  # to the left and to the right
        tensor([0.8050, 0.8050])
    """
    sectors = lidar.shape[-1]
    angle = (torch.arange(sectors, device=lidar.device, dtype=lidar.dtype) + 0.5) * (
        2 * math.pi / sectors
    )
    radius, offset = robot[..., 0:1], robot[..., 5:6]
    ahead, left = offset + lidar * angle.cos(), lidar * angle.sin()
    return ((ahead.square() + left.square()).sqrt() - radius).clamp_min(1e-3)


def motion_in_units(motion: Tensor, robot: Tensor) -> Tensor:
    """Speeds and turn rates as shares of the robot's largest.

    Args:
        motion: m/s and rad/s in turn, ``[*B, 2 M]``.
        robot: its six numbers, ``[*B, 6]``, see :meth:`torchrl_morl.deploy.Sensing.robot`.

    Returns:
        ``[*B, 2 M]``.

    Example:
        >>> import torch
        >>> robot = torch.tensor([0.2, 0.5, 3.0, 6.28, 4.0, 0.0])
        >>> motion_in_units(torch.tensor([0.5, -1.5, 0.0, 3.0]), robot)
        tensor([ 1.0000, -0.5000,  0.0000,  1.0000])
    """
    largest = robot[..., None, TOP_SPEED : TOP_TURN_RATE + 1]
    return (motion.unflatten(-1, (-1, 2)) / largest).flatten(-2)


@dataclasses.dataclass(frozen=True)
class RobotScale:
    """Maps numbers of robots to numbers of order one.

    Args:
        max_range: that scans are cut off at, metres. A lidar that sees further reads as one that sees
            as far: the scans of both are the same.

    Raises:
        ValueError: unless it is finite and positive.

    Example:
        >>> import torch
        >>> robot = torch.tensor([0.25, 1.0, torch.pi, 2 * torch.pi, 100.0, 0.25])
        >>> RobotScale(max_range=4.0)(robot)
        tensor([1.0000, 1.0000, 1.0000, 1.0000, 0.4000, 1.0000])
    """

    max_range: float

    def __post_init__(self) -> None:
        check_positive("max_range", self.max_range)

    def __call__(self, robot: Tensor) -> Tensor:
        """Six numbers ``[*B, 6]``, see :meth:`torchrl_morl.deploy.Sensing.robot`, to as many."""
        most = [math.inf] * len(ROBOT_SCALES)
        most[LIDAR_RANGE] = self.max_range
        return torch.minimum(robot, robot.new_tensor(most)) / robot.new_tensor(ROBOT_SCALES)


@dataclasses.dataclass(frozen=True)
class IsNobody:
    """Tells from the reported human whether nobody is there.

    Args:
        distance: that is reported of nobody, metres.
        bearing: that is reported of nobody, radians.

    Example:
        >>> import torch
        >>> IsNobody()(torch.tensor([[4.0, torch.pi], [2.0, 0.1]]))
        tensor([[1.],
                [0.]])
    """

    distance: float = 4.0
    bearing: float = math.pi

    def __call__(self, human: Tensor) -> Tensor:
        """``[*B, 2]`` to ``[*B, 1]``: 1 for nobody, else 0."""
        nobody = human.new_tensor((self.distance, self.bearing))
        return (human == nobody).all(-1, keepdim=True).to(human.dtype)


def check_robot(robot: Tensor, key: NestedKey) -> None:
    """Raise ``ValueError`` for what are no numbers of robots ``[*B, 6]``.

    Args:
        robot: to be checked.
        key: where it stands, for the message.
    """
    if robot.shape[-1:] != (len(ROBOT_SCALES),):
        raise ValueError(
            f"{key} must have shape [..., {len(ROBOT_SCALES)}], got {list(robot.shape)}."
        )


class _WithRobot(Transform):
    """Adds what follows from one entry and the robot."""

    def __init__(self, in_key: NestedKey, out_key: NestedKey, robot_key: NestedKey) -> None:
        keys = unravel_key(in_key), unravel_key(robot_key)
        super().__init__(in_keys=list(keys), out_keys=[unravel_key(out_key)])

    def compute(self, value: Tensor, robot: Tensor) -> Tensor:
        """The new entry, of the shape of the other."""
        raise NotImplementedError

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        value, robot = (next_tensordict[key] for key in self.in_keys)
        check_robot(robot, self.in_keys[1])
        # The specs say that entries keep their dtype; the robot may have another.
        return next_tensordict.set(self.out_keys[0], self.compute(value, robot.to(value.dtype)))

    @dispatch(source="in_keys", dest="out_keys", auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add the entry to a tensordict.

        Args:
            tensordict (TensorDictBase): holds the ``in_keys``.

        Returns:
            The same tensordict with the ``out_keys``; for a lazy stack, a shallow copy of it.

        """
        return self._call(apart_from_storage(tensordict))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._call(next_tensordict)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        observation_spec = observation_spec.clone()
        spec = observation_spec[self.in_keys[0]]
        observation_spec[self.out_keys[0]] = Unbounded(
            spec.shape, device=spec.device, dtype=spec.dtype
        )
        return observation_spec


class HullRange(_WithRobot):
    """Add the free distance from the robot's hull in each sector: see :func:`hull_ranges`.

    In a replay buffer append one for each time step, with keys such as ``("next", "lidar")``.

    Args:
        in_key (NestedKey): ranges ``[*B, S]``, metres.
        out_key (NestedKey): where distances ``[*B, S]`` are written, metres.
        robot_key (NestedKey): robots ``[*B, 6]``, see :meth:`torchrl_morl.deploy.Sensing.robot`.

    Raises:
        KeyError: at a call without ranges or robots.
        ValueError: at a call with robots of another shape.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> robot = torch.tensor([0.2, 0.5, 3.0, 6.28, 4.0, 0.0])
        >>> HullRange()(TensorDict(lidar=torch.ones(3), robot=robot))["hull_lidar"]
        tensor([0.8000, 0.8000, 0.8000])
    """

    def __init__(
        self,
        in_key: NestedKey = "lidar",
        out_key: NestedKey = "hull_lidar",
        robot_key: NestedKey = "robot",
    ) -> None:
        super().__init__(in_key, out_key, robot_key)

    def compute(self, value: Tensor, robot: Tensor) -> Tensor:
        """See :func:`hull_ranges`."""
        return hull_ranges(value, robot)

    def __repr__(self) -> str:
        in_key, robot_key = self.in_keys
        return describe(self, in_key=in_key, out_key=self.out_keys[0], robot_key=robot_key)


class InUnitsOf(_WithRobot):
    """Turn a velocity in m/s into one in units of the robot's top speed.

    In a replay buffer append one for each time step, with keys such as ``("next", "velocity")``.

    Args:
        key (NestedKey): velocities ``[*B, 2]``, m/s; they are replaced.
        robot_key (NestedKey): robots ``[*B, 6]``, see :meth:`torchrl_morl.deploy.Sensing.robot`.

    Raises:
        KeyError: at a call without velocities or robots.
        ValueError: at a call with robots of another shape.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> robot = torch.tensor([0.2, 0.5, 3.0, 6.28, 4.0, 0.0])
        >>> data = TensorDict(velocity=torch.tensor([1.0, 0.0]), robot=robot)
        >>> InUnitsOf("velocity")(data)["velocity"]
        tensor([2., 0.])
    """

    def __init__(self, key: NestedKey, robot_key: NestedKey = "robot") -> None:
        super().__init__(key, key, robot_key)

    def compute(self, value: Tensor, robot: Tensor) -> Tensor:
        """Over the robot's top speed."""
        return value / robot[..., TOP_SPEED, None]

    def __repr__(self) -> str:
        key, robot_key = self.in_keys
        return describe(self, key=key, robot_key=robot_key)


class MotionInUnits(_WithRobot):
    """Turn speeds and turn rates, one after the other, into shares of the robot's largest.

    In a replay buffer append one for each time step, with keys such as ``("next", "motion")``.

    Args:
        key (NestedKey): ``[*B, 2 M]``, m/s and rad/s in turn, as
            :class:`~torchrl_morl.transforms.OwnMotion` writes them; they stay as they are.
        out_key (NestedKey): where the shares are written.
        robot_key (NestedKey): robots ``[*B, 6]``, see :meth:`torchrl_morl.deploy.Sensing.robot`.

    Raises:
        KeyError: at a call without motions or robots.
        ValueError: at a call with robots of another shape.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> robot = torch.tensor([0.2, 0.5, 3.0, 6.28, 4.0, 0.0])
        >>> data = TensorDict(motion=torch.tensor([0.5, -1.5]), robot=robot)
        >>> MotionInUnits()(data)["own_motion"]
        tensor([ 1.0000, -0.5000])
    """

    def __init__(
        self,
        key: NestedKey = "motion",
        out_key: NestedKey = "own_motion",
        robot_key: NestedKey = "robot",
    ) -> None:
        super().__init__(key, out_key, robot_key)

    def compute(self, value: Tensor, robot: Tensor) -> Tensor:
        """See :func:`motion_in_units`."""
        return motion_in_units(value, robot)

    def __repr__(self) -> str:
        key, robot_key = self.in_keys
        return describe(self, key=key, out_key=self.out_keys[0], robot_key=robot_key)
