"""The navigation task as a policy sees it: features instead of sensors, and actions in [-1, 1]."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import ExcludeTransform, TransformedEnv

from torchrl_morl.deploy import LidarGeometry, Limits, Policy, Sensing
from torchrl_morl.deploy.features import observation_parts, policy_transforms
from torchrl_morl.modules import RewardModel
from torchrl_morl.transforms import PreferenceSampler, RewardModelReward

from .layouts import furthest_goal
from .lidar import MIN_RANGE
from .navigation import NavigationEnv
from .robot_ranges import get_robots, largest
from .robots import Robot
from .scene_files import get_scene

SHOWN = ("observe_human", "observe_human_velocity", "observe_nobody", "observe_robot")
"""Arguments of :func:`make_policy_env` that say what a policy observes and demonstrations show. A style is where
and how fast a robot drives, not what it was told to do before."""

OBSERVED = (*SHOWN, "observe_motion")
"""Arguments of :func:`make_policy_env` that say what the policy observes."""


def observed(arguments: Mapping[str, Any], names: Sequence[str] = OBSERVED) -> dict[str, bool]:
    """Those of the arguments of :func:`make_policy_env` that say what the policy observes."""
    return {name: arguments[name] for name in names if name in arguments}


def simulated(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """The other arguments of :func:`make_policy_env`: those of :class:`NavigationEnv`."""
    return {name: value for name, value in arguments.items() if name not in OBSERVED}


def observation_size(arguments: Mapping[str, Any], names: Sequence[str] = OBSERVED) -> int:
    """Entries of the observation under these arguments of :func:`make_policy_env`; of demonstrations
    with the names :data:`SHOWN`.
    """
    return sum(map(len, observation_parts(**observed(arguments, names)).values()))


class WithoutMotion(TensorDictModuleBase):
    """A reward model among observations that end with the robot's own motion, which it does not read.

    Args:
        reward_model: reads ``observation`` ``[*B, size]``.
        size: entries of the observation without the motion.
    """

    def __init__(self, reward_model: TensorDictModuleBase, size: int) -> None:
        super().__init__()
        self.reward_model, self.size = reward_model, size
        self.in_keys, self.out_keys = list(reward_model.in_keys), list(reward_model.out_keys)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the scores."""
        seen = tensordict.copy().set("observation", tensordict["observation"][..., : self.size])
        scores = self.reward_model(seen)
        return tensordict.update(scores.select(*self.out_keys))


def motion_limits(arguments: Mapping[str, Any]) -> tuple[float, float]:
    """What is 1 in an action, in units of the motion in the observation: top speed and turn rate.

    Example:
        >>> motion_limits({"robot": "any", "observe_robot": True}), motion_limits({})[0]
        ((1.0, 1.0), 0.5)
    """
    if arguments.get("observe_robot"):
        return 1.0, 1.0
    robot = largest(get_robots(arguments.get("robot", "turtlebot2")))
    return robot.max_speed, robot.max_turn_rate


def sensing(arguments: Mapping[str, Any]) -> Sensing:
    """What a policy senses under these arguments of :func:`make_policy_env`."""
    robot, max_range = get_robots(arguments.get("robot", "turtlebot2")), arguments.get("max_range")
    scene = get_scene(arguments.get("scene", "static"))
    observation_parts(**observed(arguments))  # refuses what does not go together
    max_range = 4.0 if max_range is None else float(max_range)
    far = furthest_goal(scene)
    # A human who walks towards the robot starts at the goal, one who stands between the two.
    human_range = (0.4, max(far, 12.0) if scene.human_speed else 8.0)
    return Sensing(
        max_range=max_range,
        unknown_range=max_range,
        # Of robots that differ, the policy reads where it is.
        lidar_origin=(robot.lidar_offset if isinstance(robot, Robot) else 0.0, 0.0),
        goal_range=(0.3, max(far, 12.0)),
        human_range=human_range,
        **observed(arguments),
    )


def contract(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """What :func:`~torchrl_morl.deploy.save_policy` is told of a policy trained with these arguments.

    Example:
        >>> contract({"scene": "static", "robot": "hsr"})["sensing"].lidar_origin
        (0.15, 0.0)
    """
    robot = get_robots(arguments.get("robot", "turtlebot2"))
    fastest = largest(robot)
    return {
        "sensing": sensing(arguments),
        "limits": Limits.of_robot(fastest.max_speed, fastest.max_turn_rate),
        "period": NavigationEnv.CONTROL_PERIOD,
        "robot": robot.name,
    }


def check_policy(policy: Policy, arguments: Mapping[str, Any]) -> None:
    """Refuse a policy that senses something else than these arguments of :func:`make_policy_env` show.

    Raises:
        ValueError: the message says what to change.
    """
    if policy.sensing is not None:
        policy.sensing.check(sensing(arguments))


def lidar_geometry(env: NavigationEnv) -> LidarGeometry:
    """The lidar of an environment, for :class:`~torchrl_morl.deploy.PolicyRunner`.

    Of robots that differ it is that of the largest.
    """
    return LidarGeometry(
        first_angle=0.0,
        increment=2 * math.pi / env.num_rays,
        num_beams=env.num_rays,
        range_min=MIN_RANGE / 2,
        range_max=env.max_range,
        mount=(env.robot.lidar_offset, 0.0, 0.0),
    )


def make_policy_env(
    sampler: PreferenceSampler | None = None,
    *,
    policy: Policy | None = None,
    reward_model: TensorDictModuleBase | None = None,
    keep_simulation: bool = False,
    observe_human: bool = True,
    observe_human_velocity: bool = False,
    observe_nobody: bool = False,
    observe_robot: bool = False,
    observe_motion: bool = False,
    **kwargs: Any,
) -> TransformedEnv:
    """A :class:`NavigationEnv` as a preference-conditioned policy sees it.

    Args:
        sampler: gives every episode its preference; without one there is no preference.

    Keyword Args:
        policy: that is to drive here: refused if it was trained to sense something else.
        reward_model: scores demonstration-likeness of ``observation`` and ``action``; it becomes
            the objective "demo", in second place of the reward.
        keep_simulation: keep raw scans and the simulator's state in the rollouts, for figures and
            snapshots; without them a transition takes 1 kB instead of 13 kB.
        observe_human: see :func:`policy_transforms`; the human's position itself stays in the
            rollouts, under keys that a policy does not read.
        observe_human_velocity: see :func:`policy_transforms`; for humans who walk.
        observe_nobody: see :func:`policy_transforms`; for scenes without anybody.
        observe_robot: see :func:`policy_transforms`; for robots that differ.
        observe_motion: see :func:`policy_transforms`; for commands that take effect late. A reward model
            does not read it.
        **kwargs: see :class:`NavigationEnv`.

    Returns:
        An environment with ``observation`` ``[N, 36]`` and ``preference`` ``[N, T]``, whose
        ``action`` is in [-1, 1].

    Raises:
        ValueError: for a policy that senses something else; the message says what to change.
    """
    observes = {
        "observe_human": observe_human,
        "observe_human_velocity": observe_human_velocity,
        "observe_nobody": observe_nobody,
        "observe_robot": observe_robot,
        "observe_motion": observe_motion,
    }
    if policy is not None:
        check_policy(policy, {**observes, **kwargs})
    base = NavigationEnv(snapshots=keep_simulation, report_robot=observe_robot, **kwargs)
    transforms = policy_transforms(
        base.max_range,
        period=base.CONTROL_PERIOD,
        **observes,
        actions_are_shares=base.robots.varies,
        # Invalid rays are then part of the scans.
        range_min=MIN_RANGE if base.faults.code_beams else None,
    )
    if sampler is not None:
        transforms.append(sampler)
    if reward_model is not None:
        if observe_motion:
            reward_model = WithoutMotion(reward_model, observation_size(observes, SHOWN))
        transforms.append(RewardModelReward(reward_model, position=1))
    if not keep_simulation:
        transforms.append(ExcludeTransform("scan", "lidar"))
    env = TransformedEnv(base, transforms)
    # ActionScaling (https://github.com/pytorch/rl/pull/3765) fills its buffers when its bounds are first
    # asked for. Until then `env.state_dict()` and a deep copy raise.
    _ = env.action_spec
    return env


def observed_size(model: RewardModel) -> int:
    """Entries of the observation that a reward model reads, without the action's two."""
    return model.in_features - 2 * ("action" in model.in_keys)
