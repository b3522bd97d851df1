"""The value of an action where nothing is in the way, in closed form."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from .navigation import NavigationEnv
from .policy_env import GOAL_SCALE, observation_parts
from .robots import Robot, get_robot
from .task import GOAL_REWARD, STYLE_PENALTY


class StraightDriveValue(nn.Module):
    r"""Return of one action and the straight way to the goal after it, one value per objective.

    The robot drives an arc for one step, from distance :math:`d` of the goal to :math:`d'`, and then
    :math:`n = (d' - r_\mathrm{goal}) / (v_\mathrm{max} \Delta t)` steps straight at full speed, in
    each of which it earns :math:`r`:

    .. math::
        Q = r_\mathrm{arc} + \gamma\, r \, (1 + \gamma + \dots + \gamma^{n-1})
          = r_\mathrm{arc} + \gamma\, r \, \frac{1 - \gamma^n}{1 - \gamma}.

    Progress counts for the core objective, time for efficiency; nothing is lost to collisions, to the
    demonstrated style or to closeness, and turning is free. Added to the output of a critic it leaves
    to the network what obstacles, people and style change, which is small beside the progress; what
    a step lost costs, a hundredth of the value, is exact from the start. As initial Q-values do not
    change what TD learning converges to, nor does this (Wiewiora, https://arxiv.org/abs/1106.5267).

    There are no parameters and no buffers.

    Args:
        objectives: names of the objectives, in the order of the values.

    Keyword Args:
        gamma: discount per step, in (0, 1].
        reward_scale: factor on all rewards, as in the replay buffer.
        robot: whose speed and turn rate it is.
        goal_radius: of the task, metres.

    Shape:
        ``observation`` ``[*B, D]`` of :func:`~envs.policy_env.policy_transforms` and ``action``
        ``[*B, 2]`` in [-1, 1] to ``[*B, K]``.

    Raises:
        ValueError: for a ``gamma`` outside (0, 1].

    Examples:
        Two metres before the goal: 17 steps of 0.1 m to its radius of 0.3 m, or 18 after a rest.

        >>> import torch
        >>> from envs.policy_env import OBSERVATION_SIZE
        >>> observation = torch.zeros(2, OBSERVATION_SIZE)
        >>> observation[:, 30], observation[:, 32] = 2.0 / 5.0, 1.0
        >>> action = torch.tensor([[1.0, 0.0], [-1.0, 0.0]])
        >>> value = StraightDriveValue(("core", "demo", "distance", "efficiency"), gamma=1.0)
        >>> value(observation, action).round()
        tensor([[ 212.,    0.,    0., -170.],
                [ 212.,    0.,    0., -180.]])
    """

    def __init__(
        self,
        objectives: Sequence[str],
        *,
        gamma: float,
        reward_scale: float = 1.0,
        robot: str | Robot = "turtlebot2",
        goal_radius: float = 0.3,
    ) -> None:
        super().__init__()
        if not 0 < gamma <= 1:
            raise ValueError(f"gamma must be in (0, 1], got {gamma}.")
        self.objectives = tuple(objectives)
        self.gamma, self.reward_scale, self.goal_radius = gamma, reward_scale, goal_radius
        robot = get_robot(robot)
        # Of one step, metres and radians.
        self.step = robot.max_speed * NavigationEnv.CONTROL_PERIOD
        self.turn = robot.max_turn_rate * NavigationEnv.CONTROL_PERIOD
        goal = observation_parts()["goal"]
        self.goal = slice(goal.start, goal.stop)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """Values ``[*B, K]`` of observations ``[*B, D]`` and actions ``[*B, 2]``."""
        distance, sine, cosine = observation[..., self.goal].unbind(-1)
        distance = GOAL_SCALE * distance
        speed, turn = action.unbind(-1)
        # The chord of the arc: torch.sinc(x) is sin(pi x) / (pi x).
        bearing = self.turn * turn / 2
        chord = self.step * (speed + 1) / 2 * torch.sinc(bearing / torch.pi)
        ahead = distance * (cosine * bearing.cos() + sine * bearing.sin())
        after = (distance.square() - 2 * chord * ahead + chord.square()).clamp_min(1e-12).sqrt()
        steps = ((after - self.goal_radius) / self.step).clamp_min(0.0)
        if self.gamma < 1:
            steps = (1 - self.gamma**steps) / (1 - self.gamma)
        values = {
            "core": GOAL_REWARD * (distance - after + self.gamma * self.step * steps),
            "efficiency": STYLE_PENALTY * (1 + self.gamma * steps),
        }
        nothing = torch.zeros_like(distance)
        value = torch.stack([values.get(name, nothing) for name in self.objectives], dim=-1)
        return self.reward_scale * value
