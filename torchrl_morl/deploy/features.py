"""What a navigation policy observes: the features between sensors and its network."""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.envs import ActionScaling, CatTensors, Compose, RenameTransform, UnaryTransform
from torchrl.envs.transforms import Transform

from torchrl_morl.transforms import (
    CheckFinite,
    LidarMinPool,
    LogRange,
    OwnMotion,
    PolarFeatures,
    VelocityInFrame,
)
from torchrl_morl.transforms.polar import polar_features
from torchrl_morl.transforms.robot import (
    LIDAR_RANGE,
    ROBOT_SCALES,
    TOP_SPEED,
    HullRange,
    InUnitsOf,
    IsNobody,
    MotionInUnits,
    RobotScale,
    hull_ranges,
    motion_in_units,
)

from .onnx_runner import FASTEST_HUMAN, NUM_COMMANDS
from .sensing import NUM_MOTION, NUM_ROBOT, Sensing

__all__ = [
    "GOAL_SCALE",
    "HUMAN_SCALE",
    "NUM_SECTORS",
    "OBSERVATION_SIZE",
    "PARTS",
    "RowFeatures",
    "observation",
    "observation_parts",
    "policy_transforms",
]

NUM_SECTORS = 30
GOAL_SCALE = 5.0
HUMAN_SCALE = 2.0
PARTS = {
    "lidar": NUM_SECTORS,
    "goal": 3,
    "human": 3,
    "human_velocity": 2,
    "nobody": 1,
    "robot": NUM_ROBOT,
    "motion": NUM_MOTION,
}
"""What the observation can have, in this order, and how many entries each part takes."""

_AS_THEY_ARE = ("human_velocity", "nobody")

OBSERVATION_SIZE = PARTS["lidar"] + PARTS["goal"] + PARTS["human"]
"""Entries of the observation, unless arguments of :func:`policy_transforms` change it."""


def observation_parts(
    *,
    observe_human: bool = True,
    observe_human_velocity: bool = False,
    observe_nobody: bool = False,
    observe_robot: bool = False,
    observe_motion: bool = False,
) -> dict[str, range]:
    """Where the parts of the observation of :func:`policy_transforms` lie.

    Raises:
        ValueError: for an argument that is neither true nor false, or for the velocity of a human
            who is not observed.
    """
    optional = {
        "human": observe_human,
        "human_velocity": observe_human_velocity,
        "nobody": observe_nobody,
        "robot": observe_robot,
        "motion": observe_motion,
    }
    for name, value in optional.items():
        if not isinstance(value, bool):
            raise ValueError(f"observe_{name} must be true or false, got {value!r}.")
    for name in ("human_velocity", "nobody"):
        if optional[name] and not observe_human:
            raise ValueError(f"observe_{name} needs observe_human.")
    parts, end = {}, 0
    for name, size in PARTS.items():
        if optional.get(name, True):
            parts[name] = range(end, end := end + size)
    return parts


def policy_transforms(
    max_range: float = 4.0,
    *,
    period: float = 0.2,
    observe_human: bool = True,
    observe_human_velocity: bool = False,
    observe_nobody: bool = False,
    observe_robot: bool = False,
    observe_motion: bool = False,
    actions_are_shares: bool = False,
    range_min: float | None = None,
) -> Compose:
    """Transforms that build the policy's ``observation`` ``[*B, 36]`` and scale its action.

    ==========  =====================================================================
    entries     meaning
    ==========  =====================================================================
    0 to 29     ``log(lidar / max_range) / 3`` of each 12 degree sector: 0 is no return, -1 is 0.2 m.
                The logarithm keeps centimetres apart where they matter
    30 to 32    goal: distance / 5 m, sine and cosine of its bearing
    33 to 35    human: distance / 2 m, sine and cosine of its bearing
    ==========  =====================================================================

    The policy's ``action`` is in [-1, 1]; the environment gets it in m/s and rad/s. A sensor value
    that is not finite raises ``ValueError``.

    Args:
        max_range: of the lidar, metres.

    Keyword Args:
        period: of a control step, seconds.
        observe_human: without it the observation ends with the goal, ``[*B, 33]``; the lidar still
            sees the human, as an obstacle like any other.
        observe_human_velocity: two more entries, 36 and 37: the human's velocity over the ground in
            the last step, ahead and to the left, m/s.
        observe_nobody: one more entry: 1 where nobody is, else 0.
        observe_robot: six more entries say which robot it is, see :func:`observation`; ranges are then
            those to its hull, and the human's velocity is in units of its top speed. Reads ``robot``.
        observe_motion: ten more entries: the speed and the turn rate of the last step, and the last
            four commands, see :class:`~torchrl_morl.transforms.OwnMotion`; with ``observe_robot`` as
            shares of the robot's largest. Reads ``pose``.
        actions_are_shares: the environment's actions are shares of the limits of its ``robot``, not in
            m/s and rad/s.
        range_min: for scans of a real lidar, which may be invalid or infinite: see
            :class:`~torchrl_morl.transforms.LidarMinPool`. Without it they are refused.

    Raises:
        ValueError: see :func:`observation_parts`.
    """
    parts = observation_parts(
        observe_human=observe_human,
        observe_human_velocity=observe_human_velocity,
        observe_nobody=observe_nobody,
        observe_robot=observe_robot,
        observe_motion=observe_motion,
    )
    in_keys = [name if name in _AS_THEY_ARE else f"{name}_features" for name in parts]
    scales = {"goal": GOAL_SCALE} | ({"human": HUMAN_SCALE} if observe_human else {})
    return Compose(
        ActionScaling(),
        # First, so that an error names the sensor and the ray.
        CheckFinite([*(["scan"] if range_min is None else []), *scales]),
        LidarMinPool(
            NUM_SECTORS, range_min=range_min, range_max=None if range_min is None else max_range
        ),
        *([HullRange()] if observe_robot else []),
        UnaryTransform(
            in_keys=["hull_lidar" if observe_robot else "lidar"],
            out_keys=["lidar_features"],
            fn=LogRange(max_range),
        ),
        PolarFeatures(
            in_keys=list(scales),
            out_keys=[f"{name}_features" for name in scales],
            scale=list(scales.values()),
        ),
        # Metres per second are of order one as they are.
        *(
            [VelocityInFrame(period=period, max_speed=FASTEST_HUMAN)]
            if observe_human_velocity
            else []
        ),
        *([InUnitsOf("human_velocity")] if observe_human_velocity and observe_robot else []),
        *([UnaryTransform(["human"], ["nobody"], fn=IsNobody())] if observe_nobody else []),
        *(
            [UnaryTransform(["robot"], ["robot_features"], fn=RobotScale(max_range))]
            if observe_robot
            else []
        ),
        *(
            _motion_transforms(period, in_units=observe_robot, in_shares=actions_are_shares)
            if observe_motion
            else []
        ),
        CatTensors(
            in_keys=in_keys,
            out_key="observation",
            dim=-1,
            sort=False,
        ),
    )


def _motion_transforms(period: float, *, in_units: bool, in_shares: bool) -> list[Transform]:
    key, features = "motion", "motion_features"
    robot_key = "robot" if in_shares else None
    return [
        OwnMotion(out_key=key, robot_key=robot_key, period=period, num_commands=NUM_COMMANDS),
        MotionInUnits(key, features)
        if in_units
        # A copy: the next step needs the motion, of which the observation takes the features.
        else RenameTransform([key], [features], create_copy=True),
    ]


def observation(
    sensing: Sensing,
    *,
    lidar: Tensor,
    goal: Tensor,
    human: Tensor | None = None,
    human_velocity: Tensor | None = None,
    nobody: Tensor | None = None,
    robot: Tensor | None = None,
    motion: Tensor | None = None,
) -> Tensor:
    """What the network reads: the same features as those of :func:`policy_transforms`.

    Nothing is checked or clamped. Traceable by :func:`torch.compile` and :func:`torch.export`.

    Args:
        sensing: of the policy.

    Keyword Args:
        lidar: shortest range of each sector, ``[*B, num_sectors]``, metres.
        goal: distance (m) and bearing (rad), ``[*B, 2]``.
        human: the same, for policies that read it.
        human_velocity: over the ground, ahead and to the left, m/s, ``[*B, 2]``, likewise.
        nobody: 1 where nobody is, else 0, ``[*B, 1]``, likewise.
        robot: likewise, ``[*B, 6]``: radius (m), top speed (m/s), top turn rate (rad/s), view of the
            lidar (rad), its range (m), and how far ahead of the rotation centre it is (m).
        motion: likewise, ``[*B, 10]``: measured speed (m/s) and turn rate (rad/s), and those of the last
            four commands, the latest first.

    Returns:
        ``[*B, observation_size]``.

    Example:
        >>> import torch
        >>> nothing_near = torch.full((30,), 4.0)
        >>> goal = human = torch.tensor([5.0, 0.0])
        >>> observation(Sensing(), lidar=nothing_near, goal=goal, human=human)[30:]
        tensor([1.0000, 0.0000, 1.0000, 2.5000, 0.0000, 1.0000])
    """
    if sensing.observe_robot:
        lidar = hull_ranges(lidar, robot)
    parts = [LogRange(sensing.max_range)(lidar), polar_features(goal, sensing.goal_scale)]
    if sensing.observe_human:
        parts.append(polar_features(human, sensing.human_scale))
    if sensing.observe_human_velocity:
        parts.append(
            human_velocity / robot[..., TOP_SPEED, None]
            if sensing.observe_robot
            else human_velocity
        )
    if sensing.observe_nobody:
        parts.append(nobody)
    if sensing.observe_robot:
        parts.append(RobotScale(sensing.max_range)(robot))
    if sensing.observe_motion:
        parts.append(motion_in_units(motion, robot) if sensing.observe_robot else motion)
    return torch.cat(parts, dim=-1)


class RowFeatures:
    """What the network reads of inputs that stand in a row: :func:`observation`, then the preference.

    The same numbers in half of the operations: on one observation their count is what costs.

    Args:
        sensing: of the policy.
        num_tunable: entries of the preference.
        like: has the dtype and the device.

    Example:
        >>> import torch
        >>> sensing = Sensing(num_sectors=2)
        >>> row = torch.tensor([4.0, 4.0, 5.0, 0.0, 5.0, 0.0, 0.3, 0.7])
        >>> RowFeatures(sensing, 2, like=row)(row)
        tensor([0.0000, 0.0000, 1.0000, 0.0000, 1.0000, 2.5000, 0.0000, 1.0000, 0.3000,
                0.7000])
    """

    def __init__(self, sensing: Sensing, num_tunable: int, like: Tensor) -> None:
        self.num_sectors, self.max_range = sensing.num_sectors, sensing.max_range
        sources, scales = list(range(self.num_sectors)), [self.max_range] * self.num_sectors
        self.num_positions = 1 + sensing.observe_human
        for scale in (sensing.goal_scale, sensing.human_scale)[: self.num_positions]:
            distance = sources[-1] + 1
            # The bearing twice, for its sine and its cosine.
            sources += [distance, distance + 1, distance + 1]
            scales += [scale, 1.0, 1.0]
        self.observe_robot = sensing.observe_robot
        self.observe_human_velocity = sensing.observe_human_velocity
        robot = ROBOT_SCALES if sensing.observe_robot else ()
        rest = [1.0] * (2 * sensing.observe_human_velocity + sensing.observe_nobody)
        rest += [*robot, *([1.0] * (NUM_MOTION * sensing.observe_motion + num_tunable))]
        sources += range(sources[-1] + 1, sources[-1] + 1 + len(rest))
        scales += rest
        # In the row, where bearings stand once.
        self._motion = sources[-1] + 1 - num_tunable - NUM_MOTION * sensing.observe_motion
        self._robot = self._motion - len(robot)
        self.observe_motion = sensing.observe_motion
        self._velocity = self.num_sectors + 2 * self.num_positions
        self._human = self.num_sectors + 2
        self._mark = self._velocity + 2 * sensing.observe_human_velocity
        distance, bearing = sensing.nobody
        # Distances beyond those of the training read as the furthest of them.
        self._is_nobody = IsNobody(min(distance, sensing.human_range[1]), bearing)
        self._sources = torch.tensor(sources, device=like.device)
        self._scales, self._three = like.new_tensor(scales), like.new_tensor(3.0)

    def __call__(self, row: Tensor) -> Tensor:
        """Features ``[*B, observation_size + T]``.

        Args:
            row: lidar, goal, human, human_velocity, nobody, robot and motion, as far as the policy reads
                them, and preference, ``[*B, R]``. What stands behind them is ignored.
        """
        if self.observe_robot:
            row = self._of_hull(row)
        features = row.index_select(-1, self._sources).div_(self._scales)
        lidar = features.narrow(-1, 0, self.num_sectors)
        lidar.clamp_min_(1e-3 / self.max_range).log_().div_(self._three)
        _, sine, cosine = (
            features.narrow(-1, self.num_sectors, 3 * self.num_positions)
            .unflatten(-1, (self.num_positions, 3))
            .unbind(-1)
        )
        sine.sin_()
        cosine.cos_()
        return features

    def mark_nobody(self, row: Tensor) -> None:
        """Write the mark of a policy that reads it into a row, in place, from the human in it."""
        row[..., self._mark : self._mark + 1] = self._is_nobody(row.narrow(-1, self._human, 2))

    def robot_of(self, row: Tensor) -> Tensor:
        """The robot in a row of a policy that reads it, ``[*B, 6]``."""
        return row.narrow(-1, self._robot, len(ROBOT_SCALES))

    def _of_hull(self, row: Tensor) -> Tensor:
        """The same row with ranges to the hull, velocities in units of the top speed, and a lidar that
        sees no further than scans do.
        """
        row = row.clone()
        robot = self.robot_of(row)
        lidar = row.narrow(-1, 0, self.num_sectors)
        lidar.copy_(hull_ranges(lidar, robot))
        if self.observe_human_velocity:
            row.narrow(-1, self._velocity, 2).div_(robot[..., TOP_SPEED, None])
        if self.observe_motion:
            motion = row.narrow(-1, self._motion, NUM_MOTION)
            motion.copy_(motion_in_units(motion, robot))
        robot.narrow(-1, LIDAR_RANGE, 1).clamp_max_(self.max_range)
        return row
