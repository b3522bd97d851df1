"""The scripted demonstration: a circle around the human on the way to the goal."""

from __future__ import annotations

import abc
import math
from typing import Any, ClassVar, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_morl.evaluation import episode_mask
from torchrl_morl.geometry import cartesian, point_box_distance, wrap_angle

from ..navigation import NavigationEnv
from ..perception import NOBODY
from ..robot_ranges import RobotRanges, get_robots, largest
from ..robots import TURTLEBOT2, Robot


class Driver(TensorDictModuleBase):
    """Turns towards a bearing and drives on: what scripted drivers have in common.

    Args:
        speed: forward speed, m/s; robots that are slower drive their own.
        robot: whose limits it respects; of ranges each robot's own, from ``robot`` ``[*B, 6]``, see
            :class:`~envs.NavigationEnv`. What is not scaled is then in shares of them.
        in_keys: what it reads.
        action_key: where the action ``[*B, 2]`` is written.
        scaled: in [-1, 1] instead of m/s and rad/s.

    Raises:
        ValueError: for a speed that is not positive or above the robot's.
    """

    # Turn rate per radian that the robot heads off: four fifths of it are gone a step later.
    _GAIN = 0.8 / NavigationEnv.CONTROL_PERIOD

    _ROBOT: ClassVar[tuple[list[NestedKey], list[NestedKey]]] = ([], ["robot"])
    """What is read besides, of one robot and of robots that differ."""

    def __init__(
        self,
        speed: float,
        robot: str | Robot | RobotRanges,
        in_keys: list[NestedKey],
        action_key: NestedKey,
        scaled: bool,
    ) -> None:
        super().__init__()
        robot = get_robots(robot)
        self.robots_differ = isinstance(robot, RobotRanges)
        robot = largest(robot)
        if not 0 < speed <= robot.max_speed:
            raise ValueError(f"speed must be in (0, {robot.max_speed}] m/s, got {speed}.")
        self.in_keys, self.out_keys = [*in_keys, *self._ROBOT[self.robots_differ]], [action_key]
        self.speed, self.scaled = speed, scaled
        self.max_speed, self.max_turn_rate = robot.max_speed, robot.max_turn_rate

    def _limits(self, tensordict: TensorDictBase) -> tuple[float | Tensor, float | Tensor]:
        """Top speed and turn rate, m/s and rad/s: one, or one a robot ``[*B]``."""
        if not self.robots_differ:
            return self.max_speed, self.max_turn_rate
        return tensordict.get("robot")[..., 1:3].unbind(-1)

    def _forward_speed(self, bearing: Tensor) -> Tensor:
        """Slow in corners: they are sharp in the demonstration."""
        return self.speed * bearing.cos().clamp_min(0.0) ** 2

    def _write(self, tensordict: TensorDictBase, forward: Tensor, turn: Tensor) -> TensorDictBase:
        """Set the action from m/s and rad/s, within the robot's limits."""
        fastest, sharpest = self._limits(tensordict)
        if self.robots_differ:
            # A slower robot takes the same arc, more slowly, as far as it can.
            slower = (fastest / forward.clamp_min(1e-9)).clamp_max(1.0)
            forward, turn = forward * slower, turn * slower
            turn = turn.maximum(-sharpest).minimum(sharpest)
        else:
            turn = turn.clamp(-sharpest, sharpest)
        if self.scaled:
            forward, turn = 2 * forward / fastest - 1, turn / sharpest
        elif self.robots_differ:
            forward, turn = forward / fastest, turn / sharpest
        return tensordict.set(self.out_keys[0], torch.stack((forward, turn), dim=-1))


class _PassingDriver(Driver, abc.ABC):
    """Passes the human on a side; ``_steer`` says how, for the left one."""

    def __init__(
        self,
        radius: float | Tensor = 1.0,
        side: Literal["left", "right"] = "left",
        speed: float = 0.5,
        robot: str | Robot | RobotRanges = TURTLEBOT2,
        *,
        goal_key: NestedKey = "goal",
        human_key: NestedKey = "human",
        action_key: NestedKey = "action",
        scaled: bool = False,
    ) -> None:
        super().__init__(speed, robot, [goal_key, human_key], action_key, scaled)
        if not (torch.as_tensor(radius) > 0).all():
            raise ValueError(f"radius must be positive, got {radius} m.")
        if side not in ("left", "right"):
            raise ValueError(f"side must be 'left' or 'right', got {side!r}.")
        self.radius, self.side = radius, side

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action for every robot."""
        mirror = 1.0 if self.side == "left" else -1.0
        goal, human = (
            polar * polar.new_tensor([1.0, mirror])
            for polar in (tensordict.get(key) for key in self.in_keys[:2])
        )
        forward, turn = self._steer(goal, human)
        return self._write(tensordict, forward, mirror * turn)

    @abc.abstractmethod
    def _steer(self, goal: Tensor, human: Tensor) -> tuple[Tensor, Tensor]:
        """Speed and turn rate, m/s and rad/s, from polar positions ``[*B, 2]``."""


class CircleDemonstrator(_PassingDriver):
    """Drive the pattern that de Heuvel et al. demonstrate (arXiv:2404.04857, section III-D).

    The robot drives straight at the human; at ``radius`` it turns by 90 degrees to the left and
    orbits the human clockwise; once it is between human and goal it turns left again and drives
    straight to the goal. With ``side="right"`` the pattern is mirrored.

    The policy is a function of the present observation alone: the phase follows from the angle
    between human-to-goal and human-to-robot and from the distance to the human. It does not avoid
    boxes.

    Args:
        radius: of the orbit around the human's centre, metres; or one per robot, ``[*B]``.
        side: on which side of the human the robot passes, seen from its start.
        speed: forward speed, m/s.
        robot: whose limits it respects.

    Keyword Args:
        goal_key: polar goal ``[*B, 2]`` (m, rad).
        human_key: polar human ``[*B, 2]``.
        action_key: where the action ``[*B, 2]`` is written.
        scaled: write the action in [-1, 1], as :class:`torchrl.envs.ActionScaling` expects it,
            instead of in m/s and rad/s.

    Raises:
        ValueError: for a radius or speed that is not positive, a speed above the robot's or an
            unknown side.

    Examples:
        >>> from envs import NavigationEnv
        >>> env = NavigationEnv(scene="empty", num_envs=2, seed=0)
        >>> rollout = env.rollout(
        ...     300, CircleDemonstrator(), break_when_any_done=False, break_when_all_done=True
        ... )
        >>> bool(rollout["next", "success"].any(1).all())
        True
        >>> bool((rollout["human"][..., 0].amin(1) - 1.0).abs().max() < 0.05)
        True
    """

    def _steer(self, goal: Tensor, human: Tensor) -> tuple[Tensor, Tensor]:
        human_distance, human_bearing = human.unbind(-1)
        # Angle from human->goal to human->robot: pi before the human, falling to 0 on the orbit.
        towards_goal = cartesian(goal) - cartesian(human)
        towards_robot = -cartesian(human)
        phase = wrap_angle(_angle(towards_robot) - _angle(towards_goal))
        phase = torch.where(phase < -math.pi / 2, phase + 2 * math.pi, phase)
        # The robot leaves when the straight way out to the goal opens: turning takes it another
        # tenth of a radian along the orbit. Where nobody is it has left already.
        nobody = human.abs() == human.new_tensor(NOBODY)
        leaving = (phase <= 0.1) | nobody.all(-1)
        # The corner into the orbit starts early enough to be round at the radius, not inside it.
        orbiting = ~leaving & (human_distance <= self.radius + 0.1)
        inwards = (2.0 * (human_distance - self.radius)).clamp(-0.6, 0.6)
        tangent = wrap_angle(human_bearing + math.pi / 2 - inwards)
        heading = torch.where(leaving, goal[..., 1], torch.where(orbiting, tangent, human_bearing))
        forward = self._forward_speed(heading)
        curve = torch.where(orbiting, -forward / self.radius, torch.zeros_like(forward))
        return forward, self._GAIN * heading + curve


class DetourDriver(_PassingDriver):
    """Drive the shortest way to the goal that keeps a distance from the human.

    Straight at the goal where that way is clear, else along the tangent to the circle around the
    human: what a robot does that has no style but a berth. It does not avoid boxes.

    Args:
        radius: of the circle around the human's centre, metres; or one per robot, ``[*B]``.
        side: on which side of the human the robot passes, seen from its start.
        speed: forward speed, m/s.
        robot: whose limits it respects.

    Keyword Args:
        goal_key: polar goal ``[*B, 2]`` (m, rad).
        human_key: polar human ``[*B, 2]``.
        action_key: where the action ``[*B, 2]`` is written.
        scaled: see :class:`CircleDemonstrator`.

    Raises:
        ValueError: as :class:`CircleDemonstrator`.

    Examples:
        >>> from envs import NavigationEnv
        >>> env = NavigationEnv(scene="empty", num_envs=2, seed=0)
        >>> rollout = env.rollout(
        ...     300, DetourDriver(0.8), break_when_any_done=False, break_when_all_done=True
        ... )
        >>> bool((rollout["human"][..., 0].amin(1) > 0.75).all())
        True
    """

    def _steer(self, goal: Tensor, human: Tensor) -> tuple[Tensor, Tensor]:
        distance, bearing = human.unbind(-1)
        off = wrap_angle(bearing - goal[..., 1])
        # The human is behind, or beside the straight way and far enough from it.
        clear = (off.cos() <= 0) | (distance * off.sin() <= -self.radius)
        inwards = (2.0 * (distance - self.radius)).clamp(-0.6, 0.0)
        tangent = bearing + (self.radius / distance).clamp_max(1.0).asin() - inwards
        heading = torch.where(clear, goal[..., 1], wrap_angle(tangent))
        return self._forward_speed(heading), self._GAIN * heading


class StraightDriver(Driver):
    """Turn towards the goal and drive at full speed, whatever stands in the way.

    Args:
        speed: forward speed, m/s.
        robot: whose limits it respects.

    Keyword Args:
        goal_key: polar goal ``[*B, 2]`` (m, rad).
        action_key: where the action ``[*B, 2]`` is written.
        scaled: see :class:`CircleDemonstrator`.

    Raises:
        ValueError: for a speed that is not positive or above the robot's.
    """

    def __init__(
        self,
        speed: float = 0.5,
        robot: str | Robot | RobotRanges = TURTLEBOT2,
        *,
        goal_key: NestedKey = "goal",
        action_key: NestedKey = "action",
        scaled: bool = False,
    ) -> None:
        super().__init__(speed, robot, [goal_key], action_key, scaled)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action for every robot."""
        bearing = tensordict.get(self.in_keys[0])[..., 1]
        return self._write(tensordict, self._forward_speed(bearing), self._GAIN * bearing)


def _angle(vector: Tensor) -> Tensor:
    return torch.atan2(vector[..., 1], vector[..., 0])


@torch.no_grad()
def demonstrated_paths(
    demonstrator: CircleDemonstrator, start: TensorDictBase, **env_kwargs: Any
) -> TensorDict:
    """What the demonstrator drives in given scenes, as if there were no boxes in its way.

    Args:
        demonstrator: writes actions in m/s and rad/s.
        start: snapshots ``[N]`` of a :class:`NavigationEnv`, such as the first step of a rollout.
        **env_kwargs: of that environment: its scene, robot and so on; faults do not count.

    Returns:
        Batch size ``[N]``: ``position`` [N, T, 2], ``mask`` [N, T], and ``free`` [N], whether the
        path touches none of the boxes of the scene.
    """
    # It is shown by a robot without faults.
    env = NavigationEnv(num_envs=len(start), **{**env_kwargs, "faults": None})
    state = start.select(*env.state_spec.keys(True, True)).clone()
    boxes = state["scene", "boxes"].clone()
    state["scene", "boxes"][..., :2] += 1e3
    rollout = env.rollout(
        env.max_episode_steps,
        demonstrator,
        auto_reset=False,
        tensordict=env.reset(state, set_state=True),
        break_when_any_done=False,
        break_when_all_done=True,
    )
    env.close()
    radius = robot_radius(start, env.robot)
    mask = episode_mask(rollout["next", "done"])
    mask = torch.cat((torch.ones_like(mask[:, :1]), mask), dim=-1)
    position = torch.cat((rollout["pose"][:, :1], rollout["next", "pose"]), dim=1)[..., :2]
    clearance = point_box_distance(position[:, :, None], boxes[:, None])
    touches = (
        ((clearance <= torch.as_tensor(radius)[..., None, None]) & mask[..., None])
        .flatten(1)
        .any(-1)
    )
    return TensorDict(
        {"position": position, "mask": mask, "free": ~touches}, batch_size=position.shape[:1]
    )


def robot_radius(start: TensorDictBase, robot: Robot) -> float | Tensor:
    """Of the robots of snapshots ``[N]``, metres: one, or ``[N]`` where they differ."""
    scene = start["scene"]
    return scene["robot"][..., 0] if "robot" in scene.keys() else robot.radius
