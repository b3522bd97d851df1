"""One robot in MuJoCo that a policy drives, while preference, person, goal and boxes are changed."""

from __future__ import annotations

import dataclasses
from typing import Literal, get_args

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import step_mdp

from envs import NavigationEnv, Scene
from envs.fields import shown
from envs.policy_env import simulated
from recipes.evaluation.setting import Setting
from torchrl_morl.deploy import Policy
from torchrl_morl.deploy.onnx_runner import FASTEST_HUMAN, NUM_COMMANDS
from torchrl_morl.evaluation.rollout import episode_mask
from torchrl_morl.transforms import LidarMinPool, OwnMotion, VelocityInFrame

WALKING_SPEED = 0.5
CROSSING = 2.5
"""Metres to either side of somebody who crosses."""

_velocity = VelocityInFrame(period=NavigationEnv.CONTROL_PERIOD)
_own_motion = OwnMotion(period=NavigationEnv.CONTROL_PERIOD, num_commands=NUM_COMMANDS)

Motion = Literal["stands", "walks", "crosses"]
ENDINGS = ("success", "collision_human", "collision_obstacle", "truncated")


def one_human(scene: Scene) -> bool:
    """Whether a scene has one human, in place of people with ways of their own."""
    return scene.num_people is None


class LiveSimulation:
    """A :class:`envs.NavigationEnv` of one robot, under a policy and somebody's hands.

    Positions are in metres, headings in radians, in the frame of the scene.

    Args:
        policy: that drives.
        setting: scene, robot, drive and goal radius.
        seed: of the scene.
    """

    def __init__(self, policy: Policy, setting: Setting, *, seed: int = 0) -> None:
        self.policy, self.seed = policy, seed
        # The policy reads of these what it was trained with.
        names = ["preference", "lidar", "goal", "human", "human_velocity"]
        names += ["robot"] if policy.sensing.observe_robot else []
        names += ["motion"] if policy.sensing.observe_motion else []
        self._actor = TensorDictModule(
            policy.act,
            in_keys={name: name for name in names},
            out_keys=["action"],
            out_to_in_map=False,
        )
        self._arguments = simulated(setting.arguments)
        self._arguments["report_robot"] = policy.sensing.observe_robot
        count = policy.preference_space.num_tunable
        self.preference = np.full(count, 1 / count)
        self.enter(setting.scene)

    def enter(self, scene: Scene) -> None:
        """Another scene, from its start.

        Raises:
            ValueError: for a scene of people with ways of their own.
        """
        if not one_human(scene):
            raise ValueError(
                f"--scene {scene.name} has people with ways of their own, and here one human is in your "
                "hands: choose one with a human, such as static, moving_human or a .yaml file with human."
            )
        # Whoever stands has arrived. With a speed of its own the scene can begin to move at any time.
        walking = dataclasses.replace(scene, human_speed=scene.human_speed or WALKING_SPEED)
        count = self.policy.preference_space.num_tunable
        arguments = {**self._arguments, "scene": walking, "num_threads": 1}
        env, ahead = (
            TransformedEnv(
                NavigationEnv(num_envs=n, **arguments),
                Compose(
                    LidarMinPool(self.policy.sensing.num_sectors),
                    _velocity.clone(),
                    _own_motion.clone(),
                ),
            )
            for n in (1, count)
        )
        if hasattr(self, "env"):
            self.close()
        self.scene, self.env, self._ahead = walking, env, ahead
        self._own_way = scene.human_speed > 0
        self.motion: Motion = "walks" if self._own_way else "stands"
        self.restart()

    def restart(self, seed: int | None = None) -> None:
        """The scene of a seed, from its start."""
        self.seed = self.seed if seed is None else seed
        self.env.set_seed(self.seed)
        self._now = self.env.reset()
        self._start = self._now.clone()
        self.seconds, self.ending, self.path = 0.0, None, [self.pose[:2]]
        self.nearest = self.human_distance
        self._human_before: Tensor | None = None
        self.set_motion(self.motion)

    @property
    def pose(self) -> np.ndarray:
        """Of the robot, x, y and heading."""
        return self._now["pose"][0].numpy().astype(np.float64)

    @property
    def human(self) -> np.ndarray:
        """Where the person is, x, y."""
        return self._now["human_pose"][0, :2].numpy().astype(np.float64)

    @property
    def goal(self) -> np.ndarray:
        return self._now["scene", "goal"][0].numpy().astype(np.float64)

    @property
    def boxes(self) -> np.ndarray:
        """``[B, 5]``: x, y, yaw, half length, half width."""
        return self._now["scene", "boxes"][0].numpy().astype(np.float64)

    @property
    def scan(self) -> np.ndarray:
        """Ranges, metres, counter-clockwise from the heading."""
        return self._now["scan"][0].numpy()

    @property
    def human_distance(self) -> float:
        """Between the centres, metres."""
        return float(np.hypot(*(self.human - self.pose[:2])))

    @property
    def start(self) -> TensorDictBase:
        """A snapshot of the first moment of the episode."""
        return self._start

    def step(self) -> None:
        """One control step; none after the end."""
        if self.ending is not None:
            return
        self._now["human_velocity"] = self._human_velocity()
        self._now["preference"] = torch.as_tensor(self.preference)[None]
        self._human_before = self._now["human_pose"].clone()
        after = self.env.step(self._actor(self._now))
        self.ending = next((name for name in ENDINGS if after["next", name][0]), None)
        self._now = step_mdp(after)
        self.seconds += self.env.CONTROL_PERIOD
        self.path.append(self.pose[:2])
        self.nearest = min(self.nearest, self.human_distance)
        if self.motion == "crosses" and np.allclose(self.human, self._crossing[0], atol=1e-6):
            self._crossing = self._crossing[::-1]
            self._send(self._crossing[0])

    def move(self, name: str, x: float, y: float) -> None:
        """Put ``"human"``, ``"goal"`` or ``"box0"`` to a place; a person who would touch the robot beside it.

        Raises:
            ValueError: for another name, or a place that is none.
        """
        if not np.isfinite([x, y]).all():
            raise ValueError(f"x and y must be finite numbers of metres, got {x} and {y}.")
        place = np.array([x, y])
        if name == "human":
            room = self.env.robot.radius + 0.3
            way = place - self.pose[:2]
            if np.hypot(*way) < room:
                heading = np.arctan2(way[1], way[0]) if way.any() else self.pose[2]
                place = self.pose[:2] + room * np.array([np.cos(heading), np.sin(heading)])
            self._now["human_pose"][0, :2] = torch.as_tensor(place)
        elif name == "goal":
            self._now["scene", "goal"][0] = torch.as_tensor(place)
        elif name in {f"box{index}" for index in range(self.scene.num_boxes)}:
            self._now["scene", "boxes"][0, int(name[3:]), :2] = torch.as_tensor(place)
        else:
            raise ValueError(
                f"there is no {shown(name)} to move: human, goal and box0 to box{self.scene.num_boxes - 1}."
            )
        if name == "human":
            self.set_motion(self.motion)
        else:
            self._restore()

    def set_motion(self, motion: Motion) -> None:
        """Let the person stand, walk to where they are going, or towards the robot's start, or cross its way.

        Raises:
            ValueError: for something else.
        """
        if motion not in get_args(Motion):
            raise ValueError(
                f"motion must be one of {', '.join(get_args(Motion))}, got {shown(motion)}."
            )
        self.motion = motion
        if motion == "stands":
            self._send(self.human)
        elif motion == "walks":
            own = (
                self._start["scene", "human_goal"] if self._own_way else self._start["pose"][:, :2]
            )
            self._send(own[0].numpy().astype(np.float64))
        else:
            way = self.goal - self._start["pose"][0, :2].numpy()
            across = CROSSING * np.array([-way[1], way[0]]) / max(np.hypot(*way), 1e-6)
            self._crossing = (self.human + across, self.human - across)
            self._send(self._crossing[0])

    def ways_ahead(self, steps: int = 60) -> np.ndarray:
        """Where the robot would go from here under each preference for one objective alone.

        Returns:
            ``[T, steps + 1, 2]``, metres; a way that has ended stays at its end.
        """
        count = self._ahead.num_envs
        now = self._ahead.reset(self._now.expand(count).clone(), set_state=True)
        now["human_velocity"] = self._human_velocity().expand(count, 2)
        now["motion"] = self._now["motion"].expand(count, -1)
        now["preference"] = torch.eye(count)
        rollout = self._ahead.rollout(
            steps,
            self._actor,
            auto_reset=False,
            tensordict=now,
            break_when_any_done=False,
            break_when_all_done=True,
        )
        length = episode_mask(rollout["next", "done"]).sum(-1, keepdim=True)
        points = torch.cat((now["pose"][:, None, :2], rollout["next", "pose"][..., :2]), 1)
        at = torch.arange(steps + 1).minimum(length)
        return points.gather(1, at[..., None].expand(-1, -1, 2)).numpy()

    def close(self) -> None:
        self.env.close()
        self._ahead.close()

    def _send(self, place: np.ndarray) -> None:
        self._now["scene", "human_goal"][0] = torch.as_tensor(place)
        self._restore()

    def _restore(self) -> None:
        if self.ending is None:
            # Hands move things, not the robot: it goes on as it moves.
            motion = self._now["motion"]
            self._now = self.env.reset(self._now, set_state=True).set("motion", motion)

    def _human_velocity(self) -> Tensor:
        """Ahead and to the left, ``[1, 2]``, m/s. Hands move people, too, but as in PolicyRunner:
        who moves too fast was put elsewhere, and is seen there for the first time.
        """
        if self._human_before is None:
            return torch.zeros(1, 2)
        seen = TensorDict(
            {"human_pose": self._human_before, "next": self._now.select("human_pose", "pose")}
        )
        velocity = _velocity(seen)["next", "human_velocity"]
        return velocity * (velocity.norm() <= FASTEST_HUMAN)
