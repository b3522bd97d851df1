"""The navigation task as one would write it for TorchRL's own ``MujocoEnv``, with three lidars."""

from __future__ import annotations

import math
from xml.etree import ElementTree

import mujoco
import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import MujocoEnv

from envs import RewardConstants, get_robot, get_scene
from envs.mjcf import LIDAR_HEIGHT, navigation_mjcf
from envs.scene_stream import SCENE_BLOCK
from envs.scenes import HUMAN_RADIUS

SCENE = "static"
ROBOT = "turtlebot2"
REWARDS = RewardConstants()
GOAL_RADIUS = 0.3
NUM_RAYS = 720
MAX_RANGE = 4.0
MAX_EPISODE_STEPS = 300
FRAME_SKIP = 4  # x 0.05 s
LIDAR_GROUPS = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)

_SENSORS_OFF = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)


class MujocoNavigationEnv(MujocoEnv):
    """The task of :class:`envs.NavigationEnv` as one would write it for TorchRL's ``MujocoEnv``.

    Model, scenes, frame skip, lidar, rewards and ends of episodes are the same; the test compares
    them. It holds one simulation, so everything but the lidar is arithmetic on single numbers, and
    it observes one tensor (scan, goal, human) where ``NavigationEnv`` has eight: what is left is
    the cost of the framework, and the comparison errs in this environment's favour.

    Keyword Args:
        elapsed: steps by which the first episode is shorter, to keep environments out of step.
        **kwargs: see :class:`torchrl.envs.MujocoEnv`.
    """

    DEFAULT_BACKEND = "mujoco"
    FRAME_SKIP = FRAME_SKIP

    def __init__(
        self, *, elapsed: int = 0, max_episode_steps: int = MAX_EPISODE_STEPS, **kwargs
    ) -> None:
        self._first_elapsed = elapsed
        self._scenes: list[TensorDictBase] = []
        self._robot, self._scene = get_robot(ROBOT), get_scene(SCENE)
        self._ray_angles = 2 * np.pi * np.arange(NUM_RAYS) / NUM_RAYS
        self._rays = np.zeros((NUM_RAYS, 3))
        self._hit_geom = np.zeros(NUM_RAYS, dtype=np.int32)
        self._hit_distance = np.zeros(NUM_RAYS)
        super().__init__(backend="mujoco", max_episode_steps=max_episode_steps, **kwargs)
        self._robot_body = self._backend.mj_model.body("robot").id

    @property
    def data(self) -> mujoco.MjData:
        # Rays need it, and the public state is rounded to float32.
        return self._backend._d

    def _load_xml(self, xml_path, *, patch_xml=True) -> str:
        return navigation_mjcf(
            self._robot, drive="planar", num_boxes=self._scene.num_boxes, goal_radius=GOAL_RADIUS
        )

    def _make_specs(self) -> None:
        super()._make_specs()
        low = torch.tensor([[0.0, -self._robot.max_turn_rate]], dtype=self.dtype)
        high = torch.tensor([[self._robot.max_speed, self._robot.max_turn_rate]], dtype=self.dtype)
        self.action_spec = Bounded(low=low, high=high, dtype=self.dtype)
        self.reward_spec = Unbounded(shape=(1, 3), dtype=self.dtype)

    def _make_obs_spec(self) -> Composite:
        shape = (1, NUM_RAYS + 4)
        return Composite(observation=Unbounded(shape=shape, dtype=self.dtype), shape=(1,))

    # --- reset ---------------------------------------------------------------------------------

    def _sample_initial_state(
        self, n: int, tensordict: TensorDictBase | None = None
    ) -> tuple[Tensor, Tensor]:
        model, data = self._backend.mj_model, self.data
        if not self._scenes:
            # In blocks as ours: a block costs little more than a single scene.
            block = self._scene.sample(SCENE_BLOCK, self._robot.radius, self.rng)
            self._scenes = list(block.unbind(0))
        sampled = self._scenes.pop(0)
        self._goal = sampled["goal"].tolist()
        self._human = sampled["human"].tolist()
        self._boxes = sampled["boxes"].tolist()
        for index, box in enumerate(self._boxes):
            model.geom(f"box{index}").size[:2] = box[3:]
        # Bounding volumes follow the new sizes only through mj_setConst.
        mujoco.mj_setConst(model, data)
        mujoco.mj_resetData(model, data)
        self._place("goal", *self._goal)
        self._place("human", *self._human)
        for index, box in enumerate(self._boxes):
            self._place(f"box{index}", *box[:3])
        start = sampled["start"]
        self._goal_distance = math.dist(start[:2].tolist(), self._goal)
        return start[None], torch.zeros(1, model.nv, dtype=torch.float64)

    def _place(self, body: str, x: float, y: float, yaw: float = 0.0) -> None:
        mocap = self._backend.mj_model.body(body).mocapid[0]
        self.data.mocap_pos[mocap, :2] = x, y
        self.data.mocap_quat[mocap] = math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)

    def _on_reset_all(self, tensordict: TensorDictBase | None = None) -> None:
        self._step_count += self._first_elapsed
        self._first_elapsed = 0

    # --- step ----------------------------------------------------------------------------------

    def _prepare_ctrl(self, action: Tensor) -> Tensor:
        speed, turn = action[0].tolist()
        speed = min(max(speed, 0.0), self._robot.max_speed)
        turn = min(max(turn, -self._robot.max_turn_rate), self._robot.max_turn_rate)
        return torch.tensor([[speed, turn, 0.0]], dtype=torch.float64)

    def _compute_reward(
        self, state: TensorDictBase, action: Tensor, next_state: TensorDictBase
    ) -> Tensor:
        position = self.data.qpos[:2].tolist()
        human = math.dist(position, self._human[:2])
        goal = math.dist(position, self._goal)
        collided = human <= self._robot.radius + HUMAN_RADIUS or any(
            _box_distance(position, box) <= self._robot.radius for box in self._boxes
        )
        self._ended = collided or goal <= GOAL_RADIUS
        core = REWARDS.goal_reward * (self._goal_distance - goal)
        core += REWARDS.collision_reward * collided
        self._goal_distance = goal
        closeness = max(REWARDS.distance_threshold - human, 0.0)
        closeness /= REWARDS.distance_threshold - REWARDS.distance_minimum
        distance = REWARDS.style_penalty * closeness**2
        return torch.tensor([[core, distance, REWARDS.style_penalty]], dtype=self.dtype)

    def _compute_done(self, state: TensorDictBase, next_state: TensorDictBase) -> Tensor:
        return torch.tensor([[self._ended]])

    # --- observation ---------------------------------------------------------------------------

    def _make_obs(self, state: TensorDictBase) -> Tensor:
        x, y, yaw = self.data.qpos.tolist()
        row = np.empty((1, NUM_RAYS + 4))
        row[0, :NUM_RAYS] = self._scan(x, y, yaw)
        row[0, NUM_RAYS:] = *_polar(self._goal, x, y, yaw), *_polar(self._human, x, y, yaw)
        return torch.from_numpy(row).to(self.dtype)

    def _scan(self, x: float, y: float, yaw: float) -> np.ndarray:
        # No mj_kinematics after the physics: nothing that the lidar sees has moved.
        angle = yaw + self._ray_angles
        np.cos(angle, out=self._rays[:, 0])
        np.sin(angle, out=self._rays[:, 1])
        mujoco.mj_multiRay(
            self._backend.mj_model,
            self.data,
            np.array([x, y, LIDAR_HEIGHT]),
            self._rays.reshape(-1),
            LIDAR_GROUPS,
            True,
            self._robot_body,
            self._hit_geom,
            self._hit_distance,
            None,
            NUM_RAYS,
            MAX_RANGE,
        )
        hit = np.where(self._hit_distance < 0, MAX_RANGE, self._hit_distance)
        return hit.clip(1e-3, MAX_RANGE)


class RangefinderNavigationEnv(MujocoNavigationEnv):
    """The same environment without a ray call of its own: MuJoCo's ``rangefinder`` sensors.

    One sensor for each ray, on as many sites of the robot. ``mj_step`` evaluates sensors at the
    start of every substep, so what it leaves in ``sensordata`` is from one substep before the
    robot's new position: this scan is 0.05 s old.

    Keyword Args:
        once: switch the sensors off during the physics and evaluate them once, after it: a current
            scan, equal to that of the other environments, for a quarter of the rays.
        **kwargs: see :class:`MujocoNavigationEnv`.
    """

    def __init__(self, *, once: bool = False, **kwargs) -> None:
        self._once = once
        super().__init__(**kwargs)
        model = self._backend.mj_model
        # Sensors see every geom but an invisible one: the marker of the goal is in their way.
        model.geom_rgba[model.geom_group == 1, 3] = 0
        if once:
            model.opt.disableflags |= _SENSORS_OFF

    def _load_xml(self, xml_path, *, patch_xml=True) -> str:
        root = ElementTree.fromstring(super()._load_xml(xml_path, patch_xml=patch_xml))
        (robot,) = root.iterfind("worldbody/body[@name='robot']")
        sensors = ElementTree.SubElement(root, "sensor")
        height = LIDAR_HEIGHT - self._robot.height / 2
        for index, angle in enumerate(self._ray_angles.tolist()):
            site = f"ray{index}"
            axis = f"{math.cos(angle)!r} {math.sin(angle)!r} 0"
            ElementTree.SubElement(robot, "site", name=site, pos=f"0 0 {height!r}", zaxis=axis)
            ElementTree.SubElement(sensors, "rangefinder", site=site, cutoff=str(MAX_RANGE))
        return ElementTree.tostring(root, encoding="unicode")

    def _scan(self, x: float, y: float, yaw: float) -> np.ndarray:
        if self._once:
            model = self._backend.mj_model
            model.opt.disableflags &= ~_SENSORS_OFF
            mujoco.mj_kinematics(model, self.data)
            mujoco.mj_sensorPos(model, self.data)
            model.opt.disableflags |= _SENSORS_OFF
        hit = np.where(self.data.sensordata < 0, MAX_RANGE, self.data.sensordata)
        return hit.clip(1e-3, MAX_RANGE)


def _polar(point: list[float], x: float, y: float, yaw: float) -> tuple[float, float]:
    """Distance and bearing of a world point seen from a pose."""
    dx, dy = point[0] - x, point[1] - y
    return math.hypot(dx, dy), math.remainder(math.atan2(dy, dx) - yaw, 2 * math.pi)


def _box_distance(point: list[float], box: list[float]) -> float:
    """Distance from a point to a box, zero inside."""
    x, y, yaw, half_length, half_width = box
    dx, dy = point[0] - x, point[1] - y
    cos, sin = math.cos(yaw), math.sin(yaw)
    return math.hypot(
        max(abs(cos * dx + sin * dy) - half_length, 0.0),
        max(abs(cos * dy - sin * dx) - half_width, 0.0),
    )
