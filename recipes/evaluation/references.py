"""References without reinforcement learning, for the tables beside the trained policies.

============  ==============================================================================  ======
name          what it does                                                                    sees
============  ==============================================================================  ======
demonstrator  the demonstrated circle around the human; drives through boxes                  goal, human
straight      turns to the goal and drives there; drives through everything                   goal
orca          the velocity that avoids collisions and is closest to the way to the goal       ground truth
dwa           the arc that touches nothing and is the best of heading, clearance and speed    lidar, goal, human
============  ==============================================================================  ======

All are deterministic and ignore the preference, so one preference tells everything about them. The
behaviour clone, a fourth reference, is learned: ``recipes.drex`` saves it as a policy.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from envs import NavigationEnv
from envs.demonstrations import CircleDemonstrator, Driver, StraightDriver
from envs.robots import TURTLEBOT2, Robot, get_robot
from envs.scenes import HUMAN_RADIUS
from torchrl_morl.geometry import box_corners, wrap_angle

from .dwa import DwaPlanner

_has_pyrvo = importlib.util.find_spec("pyrvo") is not None


class OrcaPlanner(Driver):
    """Optimal reciprocal collision avoidance: a planner that knows the scene and has no style.

    Each step solves the linear programs of van den Berg et al., "Reciprocal n-Body Collision
    Avoidance" (2011), by the authors' RVO2 library through ``pyrvo``, for the velocity closest to
    driving straight at the goal. Robot and human are discs whose velocities come from their last
    two positions, boxes are polygons. The robot turns towards that velocity and slows down until it
    heads there, as ORCA's robots could drive sideways.

    What it does not do: it has no path beyond the time horizons, so that it can stop for good before
    a box that is broad enough; and each of two agents takes half of the evasion, but the human of
    this environment takes none.

    Beside the polar ``goal`` ``[N, 2]`` it reads the ground truth that policies do not see: ``pose``
    and ``human_pose`` ``[N, 3]``, and ``("scene", "boxes")`` ``[N, M, 5]``, which a policy
    environment writes with ``keep_simulation=True``. The positions of the last step travel under
    ``orca`` ``[N, 4]``.

    Args:
        speed: preferred speed, m/s.
        robot: whose size and limits it respects.

    Keyword Args:
        margin: added to the robot's radius, metres; it pays for the turning. The narrowest gaps
            between boxes leave 0.05 m on either side.
        human_horizon: how far ahead collisions with the human are avoided, seconds.
        box_horizon: the same for boxes.
        scaled: write the action in [-1, 1] instead of in m/s and rad/s.

    Raises:
        ImportError: without ``pyrvo``.
        ValueError: for sizes or horizons that are not positive, or a speed above the robot's.
    """

    # Faster than anyone moves here: another episode has begun.
    _JUMP = 2.0

    def __init__(
        self,
        speed: float = 0.5,
        robot: str | Robot = TURTLEBOT2,
        *,
        margin: float = 0.05,
        human_horizon: float = 4.0,
        box_horizon: float = 2.0,
        scaled: bool = False,
    ) -> None:
        if not _has_pyrvo:
            raise ImportError(
                "the reference 'orca' needs the package pyrvo: pip install -c constraints.txt pyrvo."
            )
        in_keys = ["pose", "human_pose", "goal", ("scene", "boxes")]
        super().__init__(speed, robot, in_keys, "action", scaled)
        self.out_keys = ["action", "orca"]
        if margin < 0:
            raise ValueError(f"margin must not be negative, got {margin} m.")
        for name, value in (("human_horizon", human_horizon), ("box_horizon", box_horizon)):
            if not value > 0:
                raise ValueError(f"{name} must be positive, got {value} s.")
        self.radius = get_robot(robot).radius + margin
        self.human_horizon, self.box_horizon = human_horizon, box_horizon

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action of every robot ``[N]``."""
        pose, human, goal, boxes = (tensordict.get(key).double() for key in self.in_keys)
        seen = torch.cat((pose[:, :2], human[:, :2]), dim=-1)
        before = tensordict.get("orca", seen)
        velocity = (seen - before).unflatten(-1, (2, 2)) / NavigationEnv.CONTROL_PERIOD
        moved_on = velocity.norm(dim=-1, keepdim=True) <= self._JUMP
        velocity = torch.where(moved_on.all(1, keepdim=True), velocity, 0.0)
        tensordict.set("orca", seen)

        way = pose[:, 2] + goal[:, 1]
        preferred = self.speed * torch.stack((way.cos(), way.sin()), dim=-1)
        # The library wants them counter-clockwise.
        corners = box_corners(boxes).flip(-2)
        chosen = self._avoid(seen, velocity.flatten(-2), preferred, corners)
        bearing = wrap_angle(torch.atan2(chosen[:, 1], chosen[:, 0]) - pose[:, 2])
        speed = chosen.norm(dim=-1)
        # A robot that stands has no direction to turn to.
        turn = torch.where(speed > 1e-3, self._GAIN * bearing, 0.0)
        forward = speed * self._forward_speed(bearing) / self.speed
        dtype = tensordict.get(self.in_keys[2]).dtype
        return self._write(tensordict, forward.to(dtype), turn.to(dtype))

    def _avoid(
        self, position: Tensor, velocity: Tensor, preferred: Tensor, corners: Tensor
    ) -> Tensor:
        """Velocities ``[N, 2]`` in m/s from positions and velocities ``[N, 4]`` of robot and human."""
        import pyrvo

        chosen = []
        rows = zip(position.tolist(), velocity.tolist(), preferred.tolist(), corners.tolist())
        for where, moving, wish, polygons in rows:
            simulator = pyrvo.RVOSimulator()
            simulator.set_time_step(NavigationEnv.CONTROL_PERIOD)
            for disc, radius in ((slice(0, 2), self.radius), (slice(2, 4), HUMAN_RADIUS)):
                simulator.add_agent(
                    where[disc],
                    10.0,  # metres within which others count
                    1,  # of them at most
                    self.human_horizon,
                    self.box_horizon,
                    radius,
                    self.max_speed,
                    moving[disc],
                )
            for polygon in polygons:
                simulator.add_obstacle(polygon)
            simulator.process_obstacles()
            simulator.set_agent_pref_velocity(0, wish)
            simulator.do_step()
            chosen.append(simulator.get_agent_velocity(0).to_tuple())
        return position.new_tensor(chosen)


REFERENCES: dict[str, Callable[..., TensorDictModuleBase]] = {
    "demonstrator": CircleDemonstrator,
    "straight": StraightDriver,
    "orca": OrcaPlanner,
    "dwa": DwaPlanner,
}


def make_reference(
    name: str, robot: str | Robot = TURTLEBOT2, **arguments: Any
) -> TensorDictModuleBase:
    """A reference as :func:`recipes.evaluation.sweep.sweep` drives it: its actions are in [-1, 1].

    Args:
        name: from :data:`REFERENCES`.
        robot: whose limits it respects.
        **arguments: of its class; the demonstrator's are in the card of a policy that was trained
            with demonstrations.

    Raises:
        ImportError: if it needs a package that is not installed.
        ValueError: for an unknown name, or arguments that it refuses.
    """
    if name not in REFERENCES:
        raise ValueError(f"unknown reference {name!r}: choose among {sorted(REFERENCES)}.")
    return REFERENCES[name](**{**arguments, "robot": robot, "scaled": True})
