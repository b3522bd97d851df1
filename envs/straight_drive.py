"""The value of a way without obstacles, in closed form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_morl.deploy.features import GOAL_SCALE, observation_parts
from torchrl_morl.transforms.robot import ROBOT_SCALES, TOP_SPEED

from .navigation import NavigationEnv
from .objectives import RewardConstants, get_rewards
from .robot_ranges import RobotRanges, get_robots, largest
from .robots import Robot


class StraightDriveValue(nn.Module):
    r"""Return of the straight way to the goal at full speed, one value per objective.

    With :math:`n = (d_\mathrm{goal} - r_\mathrm{goal}) / (v_\mathrm{max} \Delta t)` steps to go and a
    reward :math:`r` in each of them,

    .. math::
        V = r \, (1 + \gamma + \dots + \gamma^{n-1}) = r \, \frac{1 - \gamma^n}{1 - \gamma}.

    A step earns progress (core) and costs time (efficiency); nothing is lost to collisions, to the
    demonstrated style or to closeness. Added to the output of a critic it leaves to the network what
    obstacles, people and style change, which is small beside the progress. The policies that are
    best stay the same, as with shaping by a potential (Ng, Harada and Russell, ICML 1999), to which
    initial Q-values are equivalent (Wiewiora, https://arxiv.org/abs/1106.5267).

    There are no parameters and no buffers.

    Args:
        objectives: names of the objectives, in the order of the values.

    Keyword Args:
        gamma: discount per step, in (0, 1].
        reward_scale: factor on all rewards, as in the replay buffer.
        robot: whose full speed it is; of ranges the fastest.
        observed: what the policy observes, arguments of
            :func:`~torchrl_morl.deploy.features.observation_parts`: with ``observe_robot`` the speed is that
            of the robot in the observation.
        goal_radius: of the task, metres.
        rewards: constants of the objectives, as in :class:`NavigationEnv`.

    Shape:
        ``observation`` ``[*B, D]`` of :func:`~torchrl_morl.deploy.features.policy_transforms` to ``[*B, K]``.

    Raises:
        ValueError: for a ``gamma`` outside (0, 1].

    Examples:
        Two metres before the goal, 0.1 m a step: 17 steps to its radius of 0.3 m.

        >>> import torch
        >>> from torchrl_morl.deploy.features import OBSERVATION_SIZE
        >>> observation = torch.zeros(OBSERVATION_SIZE)
        >>> observation[30] = 2.0 / 5.0
        >>> value = StraightDriveValue(("core", "demo", "distance", "efficiency"), gamma=1.0)
        >>> value(observation)
        tensor([ 212.5000,    0.0000,    0.0000, -170.0000])
    """

    def __init__(
        self,
        objectives: Sequence[str],
        *,
        gamma: float,
        reward_scale: float = 1.0,
        robot: str | Path | Mapping[str, Any] | Robot | RobotRanges = "turtlebot2",
        observed: Mapping[str, bool] | None = None,
        goal_radius: float = 0.3,
        rewards: RewardConstants | Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        if not 0 < gamma <= 1:
            raise ValueError(f"gamma must be in (0, 1], got {gamma}.")
        step = largest(get_robots(robot)).max_speed * NavigationEnv.CONTROL_PERIOD
        constants = get_rewards(rewards)
        earned = {"core": constants.goal_reward * step, "efficiency": constants.style_penalty}
        self.rewards = tuple(reward_scale * earned.get(name, 0.0) for name in objectives)
        self.gamma, self.step, self.goal_radius = gamma, step, goal_radius
        parts = observation_parts(**(observed or {}))
        self.goal_distance = parts["goal"][0]
        self.speed = parts["robot"][TOP_SPEED] if "robot" in parts else None
        self.of_progress = tuple(name == "core" for name in objectives)

    def forward(self, observation: Tensor) -> Tensor:
        """Values ``[*B, K]`` of observations ``[*B, D]``."""
        distance = GOAL_SCALE * observation[..., self.goal_distance]
        step = self.step
        if self.speed is not None:
            speed = ROBOT_SCALES[TOP_SPEED] * observation[..., self.speed]
            step = (speed * NavigationEnv.CONTROL_PERIOD).clamp_min(1e-3)
        steps = ((distance - self.goal_radius) / step).clamp_min(0.0)
        if self.gamma < 1:
            steps = (1 - self.gamma**steps) / (1 - self.gamma)
        if self.speed is None:
            return torch.stack([reward * steps for reward in self.rewards], dim=-1)
        # A slower robot earns less of what is paid for progress in a step.
        progress = steps * (step / self.step)
        values = [
            reward * (progress if is_progress else steps)
            for reward, is_progress in zip(self.rewards, self.of_progress)
        ]
        return torch.stack(values, dim=-1)
