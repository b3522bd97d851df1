"""Human-aware navigation: drive to a goal past a human and boxes, under several objectives.

Task of de Heuvel et al., "Demonstration-Enhanced Adaptable Multi-Objective Robot Navigation"
(https://arxiv.org/abs/2404.04857), sections III and IV.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import mujoco
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded

from .batched_mujoco import BatchedMujocoEnv, PhysicsState
from .drive import pose_to_qpos, qpos_to_pose, velocity_to_ctrl, yaw_quaternion
from .lidar import Lidar
from .mjcf import Drive, navigation_mjcf, time_step
from .perturbation import Perturbation
from .rendering import Camera
from .robots import Robot, get_robot
from .scenes import HUMAN_RADIUS, Scene, get_scene
from .views import chase_view, top_view

GOAL_REWARD = 125.0
COLLISION_REWARD = -1000.0
STYLE_PENALTY = -10.0
DISTANCE_THRESHOLD = 2.0
DISTANCE_MINIMUM = 0.3
SCENE_BLOCK = 64


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
        return model

    def _open_batch(self) -> None:
        super()._open_batch()
        self._box_sizes = self.batch.expand("geom_size") if self._box_geoms else None
        self._lidar = Lidar(
            self.batch,
            self.robot,
            body=self._robot_body,
            num_rays=self.num_rays,
            max_range=self.max_range,
        )

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        for name in ("_box_sizes", "_lidar"):
            state.pop(name)
        return state

    def _make_action_spec(self) -> Bounded:
        turn = self.robot.max_turn_rate
        self._action_low = torch.tensor([0.0, -turn], dtype=torch.float64)
        self._action_high = torch.tensor([self.robot.max_speed, turn], dtype=torch.float64)
        return Bounded(
            low=self._action_low.to(self.dtype).repeat(self.num_envs, 1),
            high=self._action_high.to(self.dtype).repeat(self.num_envs, 1),
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
        # The episode's task, as ground truth on the CPU: plain tensors, which cost less to index.
        self._human_pose = spec["human_pose"].zero()
        self._goal, self._human_goal, self._boxes = (
            scene[key].zero() for key in ("goal", "human_goal", "boxes")
        )
        self._box_axes = torch.zeros(n, self.scene.num_boxes, 2, 2, dtype=torch.float64)
        # From the robot to goal and human, and how far they are.
        self._way = torch.zeros(2, n, 2, dtype=torch.float64)
        self._distance = torch.zeros(2, n, dtype=torch.float64)
        self._flags = torch.zeros(n, 3, dtype=torch.bool)
        self._pending = torch.zeros(n, 2, dtype=torch.float64)
        # Where robot and human were at the start: pictures show it.
        self._began = torch.zeros(n, 2, 2, dtype=torch.float64)
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
        sampled = self._next_scenes(ids.numel())
        self._human_pose[ids] = sampled["human"]
        self._goal[ids] = sampled["goal"]
        self._human_goal[ids] = sampled["human_goal"]
        self._boxes[ids] = sampled["boxes"]
        self._pending[ids] = 0.0
        qpos = pose_to_qpos(sampled["start"], self.drive, self.model.nq)
        return qpos, torch.zeros(ids.numel(), self.model.nv, dtype=torch.float64)

    def _next_scenes(self, n: int) -> TensorDictBase:
        """The next ``n`` scenes of the stream that the seed fixes.

        They are drawn in blocks, since a block costs little more than a single scene.
        """
        while self._scenes is None or len(self._scenes) < n:
            block = self.scene.sample(SCENE_BLOCK, self.robot.radius, self.rng)
            self._scenes = block if self._scenes is None else torch.cat((self._scenes, block))
        taken, self._scenes = self._scenes[:n], self._scenes[n:]
        return taken

    def _load_snapshot(self, ids: Tensor, tensordict: TensorDictBase) -> None:
        super()._load_snapshot(ids, tensordict)
        for key, values in (
            ("human_pose", self._human_pose),
            (("scene", "goal"), self._goal),
            (("scene", "human_goal"), self._human_goal),
            (("scene", "boxes"), self._boxes),
        ):
            values[ids] = tensordict.get(key).cpu()[ids]
        if self.perturbation.latency:
            self._pending[ids] = tensordict.get("pending_action").cpu()[ids]

    def _on_reset(self, ids: Tensor) -> None:
        self._flags[ids] = False
        self._began[ids, 0] = self._view["qpos"][ids, :2]
        self._began[ids, 1] = self._human_pose[ids, :2]
        self._locate()
        # Mocap bodies of all environments: what has not changed is written again, which costs
        # less than picking rows.
        self._view["mocap_pos"][:, self._mocap_goal, :2] = self._goal
        self._place_human()
        if not self._box_geoms:
            return
        yaw = self._boxes[..., 2]
        cos, sin = yaw.cos(), yaw.sin()
        torch.stack((cos, sin, -sin, cos), dim=-1, out=self._box_axes.flatten(-2))
        self._view["mocap_pos"][:, self._mocap_boxes, :2] = self._boxes[..., :2]
        self._view["mocap_quat"][:, self._mocap_boxes] = yaw_quaternion(yaw)
        # Bounding volumes follow the new sizes only through set_const.
        rows = ids.numpy()
        self._box_sizes[rows[:, None], self._box_geoms, :2] = self._boxes[ids, :, 3:].numpy()
        self.batch.set_const(rows)

    def _place_human(self) -> None:
        x_y, yaw = self._human_pose[:, :2], self._human_pose[:, 2]
        self._view["mocap_pos"][:, self._mocap_human, :2] = x_y
        self._view["mocap_quat"][:, self._mocap_human] = yaw_quaternion(yaw)

    # --- step ----------------------------------------------------------------------------------

    def _prepare_ctrl(self, action: Tensor) -> Tensor:
        action = action.double()
        if self.perturbation.latency:
            action, self._pending = self._pending, action.clone()
        low, high = self._action_low, self._action_high
        action = self.perturbation.disturb_velocity(action, low, high, self._fault_rng)
        return velocity_to_ctrl(action.clamp(low, high), self.drive, self.robot)

    def _before_physics(self) -> None:
        if not self.scene.human_speed:
            return
        human = self._human_pose
        way = self._human_goal - human[:, :2]
        left = way.norm(dim=-1, keepdim=True)
        step = torch.minimum(left, torch.full_like(left, self.scene.human_speed * 0.2))
        human[:, :2] += torch.where(left > 0, way / left.clamp_min(1e-9) * step, 0.0)
        self._place_human()

    def _locate(self) -> None:
        """Where goal and human are, for the ends of episodes, rewards and observations alike."""
        points = torch.stack((self._goal, self._human_pose[:, :2]))
        torch.sub(points, self._view["qpos"][:, :2], out=self._way)
        torch.linalg.vector_norm(self._way, dim=-1, out=self._distance)

    def _compute_terminated(self, state: PhysicsState, next_state: PhysicsState) -> Tensor:
        self._locate()
        goal, human = self._distance
        hit_human = human <= self.robot.radius + HUMAN_RADIUS
        hit_box = self._touches_box(next_state.qpos[:, :2]) & ~hit_human
        reached = (goal <= self.goal_radius) & ~(hit_human | hit_box)
        torch.stack((reached, hit_human, hit_box), dim=-1, out=self._flags)
        return self._flags.any(-1, keepdim=True)

    def _touches_box(self, position: Tensor) -> Tensor:
        """Whether robots at ``[n, 2]`` overlap a box of theirs."""
        centre, half = self._boxes[..., :2], self._boxes[..., 3:]
        local = (self._box_axes * (position[:, None] - centre)[..., None, :]).sum(-1)
        outside = (local.abs() - half).clamp_min(0.0)
        return (torch.linalg.vector_norm(outside, dim=-1) <= self.robot.radius).any(-1)

    def _compute_reward(
        self, state: PhysicsState, action: Tensor, next_state: PhysicsState
    ) -> Tensor:
        before = torch.linalg.vector_norm(self._goal - state.qpos[:, :2], dim=-1)
        after, human = self._distance
        collided = self._flags[:, 1:].any(-1)
        core = GOAL_REWARD * (before - after) + COLLISION_REWARD * collided
        closeness = (DISTANCE_THRESHOLD - human).clamp_min(0.0)
        distance = STYLE_PENALTY * (closeness / (DISTANCE_THRESHOLD - DISTANCE_MINIMUM)) ** 2
        efficiency = torch.full_like(core, STYLE_PENALTY)
        return torch.stack((core, distance, efficiency), dim=-1)

    # --- observation ---------------------------------------------------------------------------

    def _make_obs(self, ids: Tensor | None = None) -> dict[str, Tensor | TensorDictBase]:
        rows = slice(None) if ids is None else ids
        pose = qpos_to_pose(self._view["qpos"][rows], self.drive)
        cos, sin = pose[:, 2].cos(), pose[:, 2].sin()
        x, y = self._way[:, rows].unbind(-1)
        bearing = torch.atan2(cos * y - sin * x, cos * x + sin * y)
        goal, human = torch.stack((self._distance[:, rows], bearing), dim=-1).to(self.dtype)
        flags = self._flags[rows].clone()
        ranges = self._lidar.cast(pose[:, :2], cos, sin, ids)
        ranges = self.perturbation.disturb_ranges(ranges, self.max_range, self._fault_rng)
        out = {
            "scan": self._lidar.scan(ranges).to(self.dtype),
            "goal": goal,
            "human": human,
            "success": flags[:, 0:1],
            "collision_human": flags[:, 1:2],
            "collision_obstacle": flags[:, 2:3],
            "pose": pose,
            "human_pose": self._human_pose[rows].clone(),
        }
        if self.snapshots:
            scene = {"goal": self._goal, "human_goal": self._human_goal, "boxes": self._boxes}
            out["scene"] = TensorDict(
                {key: values[rows].clone() for key, values in scene.items()},
                batch_size=pose.shape[:1],
            )
        if self.snapshots and self.perturbation.latency:
            out["pending_action"] = self._pending[rows].clone()
        return out

    def _camera(self, camera: str | Camera, index: int, aspect: float) -> Camera | str:
        if camera not in ("top", "chase"):
            return super()._camera(camera, index, aspect)
        pose = qpos_to_pose(self._view["qpos"][index : index + 1], self.drive)[0]
        if camera == "chase":
            return chase_view(pose, self.robot)
        points = torch.stack((*self._began[index], self._goal[index], self._human_goal[index]))
        return top_view(points, self._boxes[index], pose[:2], aspect)

    def _set_seed(self, seed: int | None) -> None:
        super()._set_seed(seed)
        if seed is not None:
            self._scenes: TensorDictBase | None = None
            self._fault_rng.manual_seed(seed + 1)
