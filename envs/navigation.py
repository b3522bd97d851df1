"""Human-aware navigation: drive to a goal past a human and boxes, under several objectives.

Task of de Heuvel et al., "Demonstration-Enhanced Adaptable Multi-Objective Robot Navigation"
(https://arxiv.org/abs/2404.04857), sections III and IV.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded

from .batched_mujoco import BatchedMujocoEnv, PhysicsState
from .geometry import point_box_distance, rotate, wrap_angle
from .mjcf import LIDAR_HEIGHT, Drive, navigation_mjcf, time_step
from .rendering import Camera
from .robots import Robot, get_robot
from .scenes import HUMAN_RADIUS, Scene, get_scene

GOAL_REWARD = 125.0
COLLISION_REWARD = -1000.0
STYLE_PENALTY = -10.0
DISTANCE_THRESHOLD = 2.0
DISTANCE_MINIMUM = 0.3

# Pictures from above: what surrounds the scene, and how large a box is a wall, metres.
_MARGIN = 0.6
_WALL = 2.0

_LIDAR_GROUPS = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)


@dataclasses.dataclass(frozen=True)
class Perturbation:
    """Sensor and actuation faults, for robust training and transfer checks; all off by default.

    Args:
        range_noise: standard deviation of each lidar range, metres.
        dropout: probability that a lidar ray reports no return.
        velocity_noise: standard deviation of the executed velocities, as a share of their range.
        latency: control steps (0 or 1) between a command and its execution.

    Raises:
        ValueError: for values outside these ranges.
    """

    range_noise: float = 0.0
    dropout: float = 0.0
    velocity_noise: float = 0.0
    latency: int = 0

    def __post_init__(self) -> None:
        if not (self.range_noise >= 0 and self.velocity_noise >= 0):
            raise ValueError(f"Noise must not be negative, got {self}.")
        if not 0 <= self.dropout <= 1:
            raise ValueError(f"dropout is a probability in [0, 1], got {self.dropout}.")
        if self.latency not in (0, 1):
            raise ValueError(f"latency must be 0 or 1 control steps, got {self.latency}.")


class NavigationEnv(BatchedMujocoEnv):
    """A robot drives to its goal past a human and boxes; rewards are vectors.

    =====================  ============  =======================================================
    key                    shape         meaning
    =====================  ============  =======================================================
    ``scan``               ``[N, 720]``  lidar ranges in metres, counter-clockwise from the
                                         heading, in (0, 4]; no return is 4.0
    ``goal``               ``[N, 2]``    distance (m) and bearing (rad) of the goal from the robot
    ``human``              ``[N, 2]``    the same for the human's centre
    ``action``             ``[N, 2]``    forward speed (m/s) and turn rate (rad/s)
    ``reward``             ``[N, 3]``    one entry per objective: core, distance, efficiency
    ``success``            ``[N, 1]``    the goal was reached, without a collision
    ``collision_human``    ``[N, 1]``    the episode ended by touching the human
    ``collision_obstacle`` ``[N, 1]``    the episode ended by touching a box
    ``pose``               ``[N, 3]``    ground truth x, y (m), heading (rad): evaluation only
    ``human_pose``         ``[N, 3]``    the same for the human: evaluation only
    ``scene``              nested        ground truth ``goal``, ``human_goal``, ``boxes``:
                                         snapshots and figures only (not with
                                         ``snapshots=False``)
    =====================  ============  =======================================================

    Objectives (equations 2 to 4 of the paper, with the sign of the goal term corrected):

    - core: ``125 (d[t-1] - d[t])`` for approaching the goal, ``-1000`` for a collision;
    - distance: ``-10 (2 - d_h)^2 / (2 - 0.3)^2`` while the human's centre is within 2 m;
    - efficiency: ``-10`` a step.

    An episode terminates at the goal or in a collision and is truncated after 300 steps of 0.2 s.

    Keyword Args:
        scene: a name from :data:`envs.SCENES` or a :class:`envs.Scene`.
        robot: a name from :data:`envs.ROBOTS` or a :class:`envs.Robot`.
        drive: ``"planar"`` (velocity servos) or ``"wheels"`` (rolling contact, 15 times dearer,
            for sim-to-sim checks).
        goal_radius: distance between the robot's centre and the goal at which it is reached, m.
        num_rays: lidar rays per revolution.
        max_range: range of the lidar, metres.
        perturbation: sensor and actuation faults.
        max_episode_steps: steps of 0.2 s before truncation.
        camera: ``"top"`` shows the whole scene from above, ``"chase"`` follows the robot.
        **kwargs: see :class:`BatchedMujocoEnv`.

    Raises:
        ValueError: for an unknown scene, robot or drive, or sizes that are not positive.

    Examples:
        >>> env = NavigationEnv(num_envs=4, seed=0)
        >>> rollout = env.rollout(5)
        >>> rollout["next", "reward"].shape
        torch.Size([4, 5, 3])
        >>> env.objectives
        ('core', 'distance', 'efficiency')
    """

    CONTROL_PERIOD: ClassVar[float] = 0.2
    objectives: ClassVar[tuple[str, ...]] = ("core", "distance", "efficiency")

    def __init__(
        self,
        *,
        scene: str | Scene = "static",
        robot: str | Robot = "turtlebot2",
        drive: Drive = "planar",
        goal_radius: float = 0.3,
        num_rays: int = 720,
        max_range: float = 4.0,
        perturbation: Perturbation | None = None,
        max_episode_steps: int = 300,
        camera: str | Camera = "top",
        **kwargs: Any,
    ) -> None:
        for name, value in (
            ("goal_radius", goal_radius),
            ("num_rays", num_rays),
            ("max_range", max_range),
        ):
            if not value > 0:
                raise ValueError(f"{name} must be positive, got {value}.")
        self.scene = get_scene(scene)
        self.robot = get_robot(robot)
        self.drive = drive
        self.goal_radius = goal_radius
        self.num_rays = num_rays
        self.max_range = max_range
        self.perturbation = perturbation or Perturbation()
        # Faults draw from their own generator, so that switching them on leaves scenes unchanged.
        self._fault_rng = torch.Generator()
        super().__init__(
            frame_skip=round(self.CONTROL_PERIOD / time_step(drive)),
            max_episode_steps=max_episode_steps,
            camera=camera,
            **kwargs,
        )

    # --- model and specs -----------------------------------------------------------------------

    def _make_model(self) -> mujoco.MjModel:
        xml = navigation_mjcf(
            self.robot,
            drive=self.drive,
            num_boxes=self.scene.num_boxes,
            goal_radius=self.goal_radius,
        )
        model = mujoco.MjModel.from_xml_string(xml)
        self._robot_body = model.body("robot").id
        self._mocap_human = int(model.body("human").mocapid[0])
        self._mocap_goal = int(model.body("goal").mocapid[0])
        boxes = [f"box{i}" for i in range(self.scene.num_boxes)]
        self._mocap_boxes = [int(model.body(name).mocapid[0]) for name in boxes]
        self._box_geoms = [model.geom(name).id for name in boxes]
        angles = 2 * math.pi * torch.arange(self.num_rays, dtype=torch.float64) / self.num_rays
        in_view = wrap_angle(angles).abs() <= self.robot.lidar_fov / 2 + 1e-9
        self._ray_ids = in_view.nonzero().squeeze(-1)
        self._ray_angles = angles[self._ray_ids].numpy()
        return model

    def _open_batch(self) -> None:
        super()._open_batch()
        self._box_sizes = self.batch.expand("geom_size") if self._box_geoms else None

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        state.pop("_box_sizes")
        return state

    def _make_action_spec(self) -> Bounded:
        low = torch.tensor([0.0, -self.robot.max_turn_rate], dtype=self.dtype)
        high = torch.tensor([self.robot.max_speed, self.robot.max_turn_rate], dtype=self.dtype)
        return Bounded(
            low=low.expand(self.num_envs, 2).clone(),
            high=high.expand(self.num_envs, 2).clone(),
            dtype=self.dtype,
        )

    def _make_reward_spec(self) -> Unbounded:
        return Unbounded(shape=(self.num_envs, len(self.objectives)), dtype=self.dtype)

    def _make_obs_spec(self) -> Composite:
        n = self.num_envs
        low = torch.tensor([0.0, -math.pi], dtype=self.dtype).expand(n, 2).clone()
        high = torch.tensor([math.inf, math.pi + 1e-6], dtype=self.dtype).expand(n, 2).clone()
        spec = Composite(
            scan=Bounded(0.0, self.max_range, shape=(n, self.num_rays), dtype=self.dtype),
            goal=Bounded(low=low, high=high, dtype=self.dtype),
            human=Bounded(low=low.clone(), high=high.clone(), dtype=self.dtype),
            success=Binary(n=1, shape=(n, 1), dtype=torch.bool),
            collision_human=Binary(n=1, shape=(n, 1), dtype=torch.bool),
            collision_obstacle=Binary(n=1, shape=(n, 1), dtype=torch.bool),
            pose=Unbounded(shape=(n, 3), dtype=torch.float64),
            human_pose=Unbounded(shape=(n, 3), dtype=torch.float64),
            shape=(n,),
        )
        scene = Composite(
            goal=Unbounded(shape=(n, 2), dtype=torch.float64),
            human_goal=Unbounded(shape=(n, 2), dtype=torch.float64),
            boxes=Unbounded(shape=(n, self.scene.num_boxes, 5), dtype=torch.float64),
            shape=(n,),
        )
        if self.snapshots:
            spec["scene"] = scene
            if self.perturbation.latency:
                spec["pending_action"] = Unbounded(shape=(n, 2), dtype=torch.float64)
        # The episode's task, as ground truth on the CPU.
        self._task = Composite(human_pose=spec["human_pose"], scene=scene, shape=(n,)).zero()
        self._flags = torch.zeros(n, 3, dtype=torch.bool)
        self._pending = torch.zeros(n, 2, dtype=torch.float64)
        self._extent = torch.zeros(n, 2, 2, dtype=torch.float64)
        return spec

    def _make_state_spec(self, snapshot: Composite, observation: Composite) -> Composite:
        keys = ("human_pose", "scene", *(("pending_action",) if self.perturbation.latency else ()))
        for key in keys:
            snapshot[key] = observation[key].clone()
        return snapshot

    # --- reset ---------------------------------------------------------------------------------

    def _sample_initial_state(
        self, ids: Tensor, tensordict: TensorDictBase | None
    ) -> tuple[Tensor, Tensor]:
        sampled = self.scene.sample(ids.numel(), self.robot.radius, self.rng)
        self._task[ids] = TensorDict(
            {
                "human_pose": sampled["human"],
                "scene": sampled.select("goal", "human_goal", "boxes"),
            },
            batch_size=ids.shape,
        )
        self._pending[ids] = 0.0
        start = sampled["start"]
        qvel = torch.zeros(ids.numel(), self.model.nv, dtype=torch.float64)
        if self.drive == "planar":
            return start, qvel
        qpos = torch.zeros(ids.numel(), self.model.nq, dtype=torch.float64)
        qpos[:, :2] = start[:, :2]
        qpos[:, 3:7] = _yaw_quaternion(start[:, 2])
        return qpos, qvel

    def _load_snapshot(self, ids: Tensor, tensordict: TensorDictBase) -> None:
        super()._load_snapshot(ids, tensordict)
        self._task[ids] = tensordict.select("human_pose", "scene").to("cpu")[ids]
        if self.perturbation.latency:
            self._pending[ids] = tensordict.get("pending_action").cpu()[ids]

    def _on_reset(self, ids: Tensor) -> None:
        self._flags[ids] = False
        self._extent[ids] = self._scene_extent(ids)
        position, quaternion = self._view["mocap_pos"], self._view["mocap_quat"]
        goal, boxes = self._task["scene", "goal"][ids], self._task["scene", "boxes"][ids]
        position[ids, self._mocap_goal, :2] = goal
        self._place_human(ids)
        for slot, (mocap, geom) in enumerate(zip(self._mocap_boxes, self._box_geoms, strict=True)):
            box = boxes[:, slot]
            position[ids, mocap, :2] = box[:, :2]
            quaternion[ids, mocap] = _yaw_quaternion(box[:, 2])
            self._box_sizes[ids.numpy(), geom, :2] = box[:, 3:].numpy()
        if self._box_geoms:
            # Bounding volumes follow the new sizes only through set_const.
            self.batch.set_const(ids.numpy())

    def _place_human(self, ids: Tensor | slice) -> None:
        human = self._task["human_pose"][ids]
        self._view["mocap_pos"][ids, self._mocap_human, :2] = human[:, :2]
        self._view["mocap_quat"][ids, self._mocap_human] = _yaw_quaternion(human[:, 2])

    # --- step ----------------------------------------------------------------------------------

    def _prepare_ctrl(self, action: Tensor) -> Tensor:
        action = action.double()
        if self.perturbation.latency:
            action, self._pending = self._pending, action.clone()
        low = torch.tensor([0.0, -self.robot.max_turn_rate], dtype=torch.float64)
        high = torch.tensor([self.robot.max_speed, self.robot.max_turn_rate], dtype=torch.float64)
        if self.perturbation.velocity_noise:
            noise = torch.randn(action.shape, generator=self._fault_rng, dtype=torch.float64)
            action = action + self.perturbation.velocity_noise * (high - low) * noise
        speed, turn = action.clamp(low, high).unbind(-1)
        if self.drive == "planar":
            return torch.stack((speed, turn, torch.zeros_like(speed)), dim=-1)
        half = self.robot.wheel_separation / 2
        wheels = torch.stack((speed - half * turn, speed + half * turn), dim=-1)
        return wheels / self.robot.wheel_radius

    def _before_physics(self) -> None:
        if not self.scene.human_speed:
            return
        human, target = self._task["human_pose"], self._task["scene", "human_goal"]
        way = target - human[:, :2]
        left = way.norm(dim=-1, keepdim=True)
        step = torch.minimum(left, torch.full_like(left, self.scene.human_speed * 0.2))
        human[:, :2] += torch.where(left > 0, way / left.clamp_min(1e-9) * step, 0.0)
        self._place_human(slice(None))

    def _pose(self, qpos: Tensor) -> Tensor:
        """Pose (x, y, heading in (-pi, pi]) of every robot in ``qpos`` [n, nq]."""
        if self.drive == "planar":
            yaw = qpos[:, 2]
        else:
            w, x, y, z = qpos[:, 3:7].unbind(-1)
            yaw = torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return torch.cat((qpos[:, :2], wrap_angle(yaw)[:, None]), dim=-1)

    def _compute_terminated(self, state: PhysicsState, next_state: PhysicsState) -> Tensor:
        position = next_state.qpos[:, :2]
        human = (position - self._task["human_pose"][:, :2]).norm(dim=-1)
        hit_human = human <= self.robot.radius + HUMAN_RADIUS
        boxes = self._task["scene", "boxes"]
        hit_box = (point_box_distance(position[:, None], boxes) <= self.robot.radius).any(-1)
        hit_box &= ~hit_human
        reached = (position - self._task["scene", "goal"]).norm(dim=-1) <= self.goal_radius
        reached &= ~(hit_human | hit_box)
        self._flags = torch.stack((reached, hit_human, hit_box), dim=-1)
        return self._flags.any(-1, keepdim=True)

    def _compute_reward(
        self, state: PhysicsState, action: Tensor, next_state: PhysicsState
    ) -> Tensor:
        goal, human = self._task["scene", "goal"], self._task["human_pose"][:, :2]
        before = (state.qpos[:, :2] - goal).norm(dim=-1)
        position = next_state.qpos[:, :2]
        after = (position - goal).norm(dim=-1)
        collided = self._flags[:, 1:].any(-1)
        core = GOAL_REWARD * (before - after) + COLLISION_REWARD * collided
        closeness = (DISTANCE_THRESHOLD - (position - human).norm(dim=-1)).clamp_min(0.0)
        distance = STYLE_PENALTY * (closeness / (DISTANCE_THRESHOLD - DISTANCE_MINIMUM)) ** 2
        efficiency = torch.full_like(core, STYLE_PENALTY)
        return torch.stack((core, distance, efficiency), dim=-1)

    # --- observation ---------------------------------------------------------------------------

    def _make_obs(self, ids: Tensor | None = None) -> dict[str, Tensor | TensorDictBase]:
        rows = slice(None) if ids is None else ids
        pose = self._pose(self._view["qpos"][rows])
        human, scene = self._task["human_pose"][rows], self._task["scene"][rows]
        flags = self._flags[rows]
        out = {
            "scan": self._scan(pose, ids).to(self.dtype),
            "goal": _polar(scene["goal"], pose).to(self.dtype),
            "human": _polar(human[:, :2], pose).to(self.dtype),
            "success": flags[:, 0:1],
            "collision_human": flags[:, 1:2],
            "collision_obstacle": flags[:, 2:3],
            "pose": pose,
            "human_pose": human.clone(),
        }
        if self.snapshots:
            out["scene"] = scene.clone()
        if self.snapshots and self.perturbation.latency:
            out["pending_action"] = self._pending[rows].clone()
        return out

    def _scan(self, pose: Tensor, ids: Tensor | None) -> Tensor:
        """Lidar ranges ``[n, num_rays]``: one native call casts the rays of all environments."""
        pose = pose.numpy()
        angle = pose[:, 2:] + self._ray_angles
        direction = np.stack((np.cos(angle), np.sin(angle), np.zeros_like(angle)), axis=-1)
        origin = np.zeros((len(pose), 1, 3))
        heading = np.stack((np.cos(pose[:, 2]), np.sin(pose[:, 2])), axis=-1)
        origin[:, 0, :2] = pose[:, :2] + self.robot.lidar_offset * heading
        origin[:, 0, 2] = LIDAR_HEIGHT
        distance, _ = self.batch.ray(
            origin,
            direction,
            geomgroup=_LIDAR_GROUPS,
            bodyexclude=self._robot_body,
            ids=None if ids is None else ids.numpy(),
        )
        hit = torch.from_numpy(distance)
        hit = torch.where(hit < 0, self.max_range, hit)
        fault = self.perturbation
        if fault.range_noise:
            noise = torch.randn(hit.shape, generator=self._fault_rng, dtype=hit.dtype)
            hit = hit + torch.where(hit < self.max_range, fault.range_noise * noise, 0.0)
        if fault.dropout:
            lost = torch.rand(hit.shape, generator=self._fault_rng, dtype=hit.dtype) < fault.dropout
            hit = hit.masked_fill(lost, self.max_range)
        scan = torch.full((len(pose), self.num_rays), self.max_range, dtype=torch.float64)
        # Zero would mean "no reading" to many drivers: the nearest range is a millimetre.
        scan[:, self._ray_ids] = hit.clamp(1e-3, self.max_range)
        return scan

    # --- rendering -----------------------------------------------------------------------------

    def _scene_extent(self, ids: Tensor) -> Tensor:
        """Lower and upper corner ``[n, 2, 2]`` of what a picture from above should contain."""
        scene, boxes = self._task["scene"][ids], self._task["scene", "boxes"][ids]
        robot, human = self._view["qpos"][ids, :2], self._task["human_pose"][ids, :2]
        points = torch.stack((robot, human, scene["goal"], scene["human_goal"]), dim=1)
        radius = boxes[..., 3:].norm(dim=-1, keepdim=True)
        # Walls reach far beyond the way: they may be cut.
        radius = radius.masked_fill(radius > _WALL, -math.inf)
        low = torch.cat((points, boxes[..., :2] - radius), dim=1).amin(1)
        high = torch.cat((points, boxes[..., :2] + radius), dim=1).amax(1)
        return torch.stack((low - _MARGIN, high + _MARGIN), dim=1)

    def _camera(self, camera: str | Camera, index: int, aspect: float) -> Camera | str:
        if camera not in ("top", "chase"):
            return super()._camera(camera, index, aspect)
        x, y, yaw = self._pose(self._view["qpos"][index : index + 1])[0].tolist()
        if camera == "chase":
            ahead, height = 1.5, 0.5 * self.robot.height + 0.3
            lookat = (x + ahead * math.cos(yaw), y + ahead * math.sin(yaw), height)
            distance = 3.6 + self.robot.height
            return Camera(lookat, math.degrees(yaw), -24.0, distance)
        (left, bottom), (right, top) = self._extent[index].tolist()
        # Fixed during an episode, unless the robot leaves.
        left, right = min(left, x - _MARGIN), max(right, x + _MARGIN)
        bottom, top = min(bottom, y - _MARGIN), max(top, y + _MARGIN)
        centre = ((left + right) / 2, (bottom + top) / 2, 0.0)
        return Camera(centre, height=max(top - bottom, (right - left) / aspect))

    def _set_seed(self, seed: int | None) -> None:
        super()._set_seed(seed)
        if seed is not None:
            self._fault_rng.manual_seed(seed + 1)


def _yaw_quaternion(yaw: Tensor) -> Tensor:
    zero = torch.zeros_like(yaw)
    return torch.stack(((yaw / 2).cos(), zero, zero, (yaw / 2).sin()), dim=-1)


def _polar(point: Tensor, pose: Tensor) -> Tensor:
    """Distance and bearing of world points ``[n, 2]`` seen from poses ``[n, 3]``."""
    local = rotate(point - pose[:, :2], -pose[:, 2])
    return torch.stack((local.norm(dim=-1), torch.atan2(local[:, 1], local[:, 0])), dim=-1)
