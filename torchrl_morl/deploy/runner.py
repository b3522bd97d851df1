"""What a robot runs: from a scan to a command, without a simulator, and when to stop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .lidar import LidarGeometry
from .onnx_runner import Command, Reason, Runner
from .policy import Policy
from .sensing import Limits

__all__ = ["Command", "PolicyRunner", "Reason", "Runner"]


class PolicyRunner(Runner):
    """Drives a robot with a policy: one :meth:`~Runner.step` a control period.

    It stops, with speed and turn rate 0, for these reasons:

    =================  =================================================================================
    reason             when
    =================  =================================================================================
    ``goal reached``   the goal is within ``goal_radius``
    ``clock``          ``time`` is not later than at the last step, or not a number, or ``stamp`` is later
                       than ``time`` by more than ``timeout``
    ``stale``          ``stamp`` is older than ``timeout``
    ``no scan``        the scan is ``None``, or has no valid beam
    ``no goal``        the goal is ``None``
    ``refused``        an input is not finite, of another shape or negative; the human is at 0 m; the
                       preference is off the simplex; the policy's own output is not finite
    =================  =================================================================================

    Otherwise it drives, and what the policy was not trained with reads as the nearest thing that it
    knows: a goal or human beyond the trained distances as the furthest of those; nobody as
    ``sensing.nobody``; a sector without a valid beam as ``sensing.unknown_range``. A sector is unknown
    also where something is nearer than the lidar's ``range_min``: it is no safety function, and a
    bumper or a safety lidar stays necessary.

    Args:
        policy: from :func:`load_policy`.

    Keyword Args:
        lidar: of the robot.
        goal_radius: distance at which the goal is reached, metres; that of the training if ``None``.
        timeout: age at which an input is too old, seconds; one period if ``None``.
        robot: which robot it is, six numbers as of :meth:`Policy.act`, for policies that read it.
        max_speed: of the robot, m/s, if lower than the policy's.
        max_turn_rate: likewise, rad/s. Speed and turn rate are lowered together, so that the robot
            follows the same arc, more slowly.

    Raises:
        ValueError: for limits that are not positive, a lidar too coarse for the policy's sectors, a
            robot that is refused, or a policy whose file does not tell what it senses.

    Example:
        In a clone ``load_policy("recipes/policies/navigation")`` is a trained one.

        >>> import numpy as np
        >>> from torchrl_morl.deploy import LidarGeometry, PolicyRunner
        >>> from torchrl_morl.testing import untrained_policy
        >>> lidar = LidarGeometry(-np.pi, np.pi / 180, 360, range_min=0.12, range_max=3.5)
        >>> policy = untrained_policy()
        >>> runner = PolicyRunner(policy, lidar=lidar)
        >>> scan = np.full(360, np.inf)
        >>> preference = (0.0, 0.5, 0.5)  # demo, distance, efficiency
        >>> command = runner.step(
        ...     scan, goal=(3.0, 0.1), preference=preference, stamp=0.0, time=0.05
        ... )
        >>> command.reason, command.speed > 0.1
        ('drive', True)
        >>> command = runner.step(
        ...     scan, goal=(3.0, 0.1), preference=preference, stamp=0.0, time=0.25
        ... )
        >>> command.reason, command.speed, command.detail
        ('stale', 0.0, 'the inputs are 0.25 s old, at most 0.2 s are allowed')
    """

    def __init__(
        self,
        policy: Policy,
        *,
        lidar: LidarGeometry,
        goal_radius: float | None = None,
        timeout: float | None = None,
        robot: Sequence[float] | None = None,
        max_speed: float | None = None,
        max_turn_rate: float | None = None,
    ) -> None:
        if not isinstance(policy, Policy):
            raise ValueError(f"policy must be a Policy, from load_policy, got {policy!r}.")
        if not isinstance(lidar, LidarGeometry):
            raise ValueError(f"lidar must be a LidarGeometry, got {lidar!r}.")
        if policy.sensing is None:
            raise ValueError("the file of this policy does not tell what it senses.")
        lidar.check(policy.sensing)
        self.robot = lidar.robot(policy.sensing, robot)
        sensing, limits = policy.sensing, policy.limits
        if self.robot is not None:
            # Of such a policy, ranges are those of the lidar where it is, and limits those of the robot.
            sensing, limits = sensing.of_robot(self.robot), Limits.of_robot(*self.robot[1:3])
        self._origin = sensing.lidar_origin
        self.policy, self.lidar = policy, lidar
        nearest_goal, _ = policy.sensing.goal_range
        given = goal_radius, timeout, max_speed, max_turn_rate
        super().__init__(
            policy.period,
            nearest_goal,
            limits.to_json(),
            given,
            reads_motion=sensing.observe_motion,
        )

    def _scan(self, ranges: ArrayLike) -> tuple[np.ndarray, bool]:
        sensing = self.policy.sensing
        lidar = self.lidar.sectors(ranges, sensing.num_sectors, sensing.max_range, self._origin)
        if lidar.ndim != 1:
            raise ValueError(f"one scan at a time, got {len(lidar)}")
        unknown = np.isnan(lidar)
        return np.where(unknown, sensing.unknown_range, lidar), not unknown.all()

    def _command(self, scan: np.ndarray, inputs: dict[str, Any]) -> tuple[float, float]:
        command = self.policy.act(lidar=scan, robot=self.robot, **inputs)
        if command.shape != (2,):
            raise ValueError(f"one preference at a time, got {len(command)}")
        return float(command[0]), float(command[1])
