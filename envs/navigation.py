"""Human-aware navigation: drive to a goal past a human and boxes, under several objectives.

Task of de Heuvel et al., "Demonstration-Enhanced Adaptable Multi-Objective Robot Navigation"
(https://arxiv.org/abs/2404.04857), sections III and IV.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded

from torchrl_morl.arguments import check_flag

from .batched_mujoco import BatchedMujocoEnv, PhysicsState
from .bodies import SceneBodies
from .drive import pose_to_qpos, qpos_to_pose, velocity_to_ctrl
from .faults import Faults, get_faults
from .geometry import cos_sin
from .lidar import Lidar
from .limits import check_senses
from .mjcf import Drive, navigation_mjcf, time_step
from .navigation_specs import observation_spec, snapshot_specs
from .navigation_task import PAPER_OBJECTIVES, NavigationTask
from .objectives import RewardConstants, check_objectives, get_rewards
from .perception import Perception
from .rendering import Camera
from .robot_batch import NUM_REPORTED, RobotBatch
from .robot_ranges import RobotRanges, get_robots
from .robots import Robot
from .scene_files import get_scene
from .scene_stream import SceneStream
from .scenes import Scene
from .substeps import Substeps
from .views import chase_view, episode_view


class NavigationEnv(BatchedMujocoEnv):
    """A robot drives to its goal past a human and boxes; rewards are vectors.

    ======================  ============  =======================================================
    key                     shape         meaning
    ======================  ============  =======================================================
    ``scan``                ``[N, 720]``  lidar ranges in metres, counter-clockwise from the
                                          heading, in (0, 4]; no return is 4.0
    ``goal``                ``[N, 2]``    distance (m) and bearing (rad) of the goal from the robot
    ``human``               ``[N, 2]``    the same for the human's centre
    ``action``              ``[N, 2]``    forward speed (m/s) and turn rate (rad/s)
    ``reward``              ``[N, K]``    one entry per objective: core, distance, efficiency,
                                          unless ``objectives`` says otherwise
    ``success``             ``[N, 1]``    the goal was reached, without a collision
    ``collision_human``     ``[N, 1]``    the episode ended by touching the human
    ``collision_obstacle``  ``[N, 1]``    the episode ended by touching a box
    ``pose``                ``[N, 3]``    ground truth x, y (m), heading (rad): evaluation only
    ``human_pose``          ``[N, 3]``    the same for the human: evaluation only
    ``scene``               nested        ground truth ``goal``, ``human_goal``, ``boxes``, or all
                                          ``people``: snapshots only (not with ``snapshots=False``)
    ``faults``              ``[N, A]``    amounts of the faults of the episode, see
                                          :meth:`Faults.draw`; as ``scene``, if episodes draw them
    ======================  ============  =======================================================

    Objectives (equations 2 to 4 of the paper, the goal's sign corrected; ``rewards`` has the numbers):

    - core: ``125 (d[t-1] - d[t])`` for approaching the goal, ``-1000`` for a collision;
    - distance: ``-10 (2 - d_h)^2 / (2 - 0.3)^2`` while the human's centre is within 2 m;
    - efficiency: ``-10`` a step;
    - clearance, for those who ask: ``-10 (1 - d_b)^2`` while a box is within 1 m of the robot's hull.

    An episode terminates at the goal or in a collision and is truncated after 300 steps of 0.2 s.

    Keyword Args:
        scene: see :func:`envs.get_scene`.
        robot: see :func:`envs.get_robots`. With ``"any"``, or ranges in place of numbers, every episode
            draws its own, and ``action`` is in shares of its limits, from (0, -1) to (1, 1).
        drive: ``"planar"`` (velocity servos) or ``"wheels"`` (rolling contact, several times dearer).
        goal_radius: distance at which the goal is reached, metres.
        num_rays: lidar rays per revolution.
        max_range: range of the lidar, metres.
        repeat_failed: see :class:`envs.scene_stream.SceneStream`; for training.
        report_robot: observe ``robot`` ``[N, 6]``, of :data:`envs.robot_ranges.DRIVEN`; robots that differ are.
        faults: of sensors and actuation, also as a mapping.
        objectives: names from :data:`envs.OBJECTIVES`, one for each entry of the reward.
        rewards: constants of the objectives, also as a mapping.
        max_episode_steps: steps of 0.2 s before truncation.
        camera: ``"top"`` shows the whole scene from above, ``"chase"`` follows the robot.
        **kwargs: see :class:`BatchedMujocoEnv`.

    Raises:
        ValueError: for an unknown scene, robot, drive or objective, sizes that are not positive, a
            described scene that this robot cannot solve, and at a reset for a scene of a
            :class:`envs.Scene` that has something wrong with it.

    Examples:
        >>> env = NavigationEnv(num_envs=4, seed=0)
        >>> rollout = env.rollout(5)
        >>> rollout["next", "reward"].shape
        torch.Size([4, 5, 3])
        >>> env.objectives
        ('core', 'distance', 'efficiency')
    """

    CONTROL_PERIOD: ClassVar[float] = 0.2
    objectives: tuple[str, ...] = PAPER_OBJECTIVES
    """Those of the reward, in their order; of the class, the default."""

    def __init__(
        self,
        *,
        scene: str | Path | Mapping[str, Any] | Scene = "static",
        robot: str | Path | Mapping[str, Any] | Robot | RobotRanges = "turtlebot2",
        drive: Drive = "planar",
        goal_radius: float = 0.3,
        num_rays: int = 720,
        max_range: float = 4.0,
        repeat_failed: float = 0.0,
        report_robot: bool = False,
        faults: Faults | Mapping[str, Any] | None = None,
        objectives: Sequence[str] = PAPER_OBJECTIVES,
        rewards: RewardConstants | Mapping[str, Any] | None = None,
        max_episode_steps: int = 300,
        camera: str | Camera = "top",
        **kwargs: Any,
    ) -> None:
        check_senses(kwargs.get("num_envs", 1), num_rays, max_range, goal_radius)
        check_flag("report_robot", report_robot)
        self.scene = get_scene(scene)
        self.robots = RobotBatch(get_robots(robot), kwargs.get("num_envs", 1), drive)
        self.robot, self.drive = self.robots.largest, drive
        self.report_robot = report_robot or self.robots.varies
        self.goal_radius = goal_radius
        self.num_rays = num_rays
        self.max_range = max_range
        self.faults = get_faults(faults)
        self.objectives = check_objectives(objectives)
        self.rewards = get_rewards(rewards)
        self.repeat_failed = repeat_failed
        # Faults draw from their own generator, so that switching them on leaves scenes unchanged.
        self._fault_rng = torch.Generator()
        super().__init__(
            frame_skip=round(self.CONTROL_PERIOD / time_step(drive)),
            max_episode_steps=max_episode_steps,
            camera=camera,
            **kwargs,
        )
        exact = np.float64 if self.faults.disturb_scans else self._array_dtype
        self._lidar = Lidar(self.robot, num_rays=num_rays, max_range=max_range, dtype=exact)
        absent = self.scene.num_people is not None
        self._perception = Perception(self._lidar, self.faults, self._fault_rng, absent, self.dtype)

    # --- model and specs -----------------------------------------------------------------------

    def _make_model(self) -> mujoco.MjModel:
        self._scenes = SceneStream(
            self.scene,
            self.robot.radius,
            self.num_envs,
            repeat_failed=self.repeat_failed,
            goal_radius=self.goal_radius,
            robots=self.robots.ranges,
        )
        people = self.scene.num_people or 1
        xml = navigation_mjcf(
            self.robot,
            drive=self.drive,
            num_boxes=self.scene.num_boxes,
            num_people=people,
            goal_radius=self.goal_radius,
        )
        model = mujoco.MjModel.from_xml_string(xml)
        self._bodies = SceneBodies(model, num_people=people, num_boxes=self.scene.num_boxes)
        self._substeps = Substeps(
            frame_skip=self.frame_skip,
            period=self.CONTROL_PERIOD,
            human_speed=self.scene.human_speed,
            robot_speed=self.robot.max_speed,
            mocap_people=self._bodies.people,
        )
        return model

    def _open_batch(self) -> None:
        super()._open_batch()
        self.robots.open(self.batch, self.model)
        self._box_sizes = self._bodies.open(self.batch)

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        state.pop("_box_sizes")
        state["robots"] = copy.copy(self.robots)
        state["robots"].close()
        return state

    def simulation_state(self) -> dict[str, Any]:
        return super().simulation_state() | {
            "task": self._task.state_dict(),
            "scenes": self._scenes.state_dict(),
            "pending": self._pending.clone(),
            "robots": self.robots.numbers.copy(),
            "faults": self._faults.clone(),
            "fault_generator": self._fault_rng.get_state(),
            "began": self._began.copy(),
        }

    def load_simulation_state(self, state: Mapping[str, Any]) -> None:
        super().load_simulation_state(state)
        self._task.load_state_dict(state["task"])
        self._scenes.load_state_dict(state["scenes"])
        self.robots.numbers[:] = state["robots"]
        self._fault_rng.set_state(state["fault_generator"])
        drawn, pending = state["faults"], state["pending"]
        if pending.shape != self._pending.shape:
            # Of other faults, which remember another number of commands: those of this environment begin.
            drawn = self.faults.draw(len(drawn), self._fault_rng)
            pending = torch.zeros_like(self._pending)
        self._pending, self._faults = pending.clone(), drawn.clone()
        self._began = state["began"].copy()

    def _make_action_spec(self) -> Bounded:
        self._action_low, self._action_high = self.robots.action_bounds()
        return Bounded(
            low=self._action_low.to(self.dtype).repeat(self.num_envs, 1),
            high=self._action_high.to(self.dtype).repeat(self.num_envs, 1),
            dtype=self.dtype,
        )

    def _make_reward_spec(self) -> Unbounded:
        return Unbounded(shape=(self.num_envs, len(self.objectives)), dtype=self.dtype)

    def _make_obs_spec(self) -> Composite:
        n = self.num_envs
        spec = observation_spec(
            n, self.num_rays, self.max_range, self.dtype, invalid_rays=self.faults.code_beams
        )
        if self.report_robot:
            spec["robot"] = Unbounded(shape=(n, NUM_REPORTED), dtype=self.dtype)
        if self.snapshots:
            spec.update(
                snapshot_specs(n, self.scene, self.faults, robots_differ=self.robots.varies)
            )
        self._task = NavigationTask(
            n,
            self.scene.num_boxes,
            num_people=self.scene.num_people or 1,
            robot_radius=self.robots.radius,
            goal_radius=self.goal_radius,
            objectives=self.objectives,
            rewards=self.rewards,
        )
        self._task.people[..., 5] = self.scene.human_speed
        self._pending = torch.zeros(n, self.faults.memory, 2, dtype=torch.float64)
        self._faults = self.faults.draw(n, torch.Generator())
        self._began = np.zeros((n, 2, 2))  # robot and human at the start, for pictures
        return spec

    def _make_state_spec(self, snapshot: Composite, observation: Composite) -> Composite:
        for key in ("human_pose", "scene", "pending_action", "faults"):
            if key in observation.keys():
                snapshot[key] = observation[key].clone()
        return snapshot

    # --- reset ---------------------------------------------------------------------------------

    def _sample_initial_state(
        self, ids: Tensor, tensordict: TensorDictBase | None
    ) -> tuple[Tensor, Tensor]:
        rows = ids.numpy()
        flags, elapsed = self._task.flags[rows], self._elapsed.numpy()[rows, 0]
        failed = (flags.any(1) | (elapsed >= self.max_episode_steps)) & ~flags[:, 0]
        sampled = self._scenes.deal(rows, failed, self.rng)
        self._set_scene(rows, sampled)
        self._pending.numpy()[rows] = 0.0
        if self.faults.is_random:
            self._faults[ids] = self.faults.draw(len(rows), self._fault_rng)
        qpos = pose_to_qpos(sampled["start"], self.drive, self.model.nq)
        return torch.from_numpy(qpos), torch.zeros(len(rows), self.model.nv, dtype=torch.float64)

    def _load_snapshot(self, ids: Tensor, tensordict: TensorDictBase) -> None:
        super()._load_snapshot(ids, tensordict)
        rows = ids.numpy()
        self._scenes.forget(rows)
        scene = {key: one.cpu().numpy()[rows] for key, one in tensordict.get("scene").items()}
        if self.scene.num_people is None:
            scene["human"] = tensordict.get("human_pose").cpu().numpy()[rows]
        self._set_scene(rows, scene)
        if self.faults.memory:
            pending = tensordict.get("pending_action").cpu()[ids]
            self._pending[ids] = pending.unflatten(-1, (self.faults.memory, 2))
        if self.faults.is_random:
            self._faults[ids] = tensordict.get("faults").cpu()[ids]

    def _set_scene(self, rows: np.ndarray, scene: Mapping[str, np.ndarray]) -> None:
        self._task.place(rows, scene)
        if self.robots.varies:
            self.robots.replace(rows, scene["robot"])

    def _on_reset(self, ids: Tensor) -> None:
        rows, task, robots = ids.numpy(), self._task, self._view["qpos"].numpy()[:, :2]
        task.begin(rows, robots)
        self._began[rows, 0] = robots[rows]
        self._began[rows, 1] = task.human_pose[rows, :2]
        self._bodies.place(self._view, task, rows, self._box_sizes)
        if self._box_sizes is not None or self.robots.varies:
            # Bounding volumes follow the new sizes only through set_const.
            self.batch.set_const(rows)

    # --- step ----------------------------------------------------------------------------------

    def _prepare_ctrl(self, action: Tensor) -> Tensor:
        faults = self.faults
        action = self.robots.velocity(action.double())
        if faults.memory or faults.scale:
            action = faults.executed(action, self._pending, self._faults, self.CONTROL_PERIOD)
        low, high = self.robots.velocity_bounds()
        action = faults.disturb_velocity(action, self._faults, low, high, self._fault_rng)
        velocity = action.numpy().clip(low.numpy(), high.numpy())
        return torch.from_numpy(velocity_to_ctrl(velocity, self.drive))

    def _simulate(self) -> None:
        time = self._time() if self.scene.human_speed else None
        self._substeps.advance(self.batch, self._view, self._task, time)

    def _time(self, rows: slice | np.ndarray = slice(None)) -> np.ndarray:
        return self._elapsed.numpy()[rows, 0] * self.CONTROL_PERIOD

    def _compute_terminated(self, state: PhysicsState, next_state: PhysicsState) -> Tensor:
        self._task.locate(next_state.qpos.numpy()[:, :2])
        return torch.from_numpy(self._task.end())

    def _compute_reward(
        self, state: PhysicsState, action: Tensor, next_state: PhysicsState
    ) -> Tensor:
        return self.reward_from(state.qpos[:, :2])

    def reward_from(self, position: Tensor) -> Tensor:
        """Reward ``[N, K]`` of the step that led the robots to where they are; actions do not matter.

        Args:
            position: where they were before it, ``[N, 2]``, metres.
        """
        reward = self._task.reward(position.numpy())
        return torch.from_numpy(reward.astype(self._array_dtype, copy=False))

    # --- observation ---------------------------------------------------------------------------

    def _make_obs(self, ids: Tensor | None = None) -> dict[str, Tensor | TensorDictBase]:
        ids = None if ids is None else ids.numpy()
        rows, task = slice(None) if ids is None else ids, self._task
        pose = qpos_to_pose(self._view["qpos"].numpy()[rows], self.drive)
        cos, sin = cos_sin(pose[:, 2])
        seen = task.ahead_and_left(cos, sin, ids)
        where = task, seen, cos, sin, ids, self._faults if ids is None else self._faults[rows]
        time = self._time(rows) if self.faults.misreport else None
        goal, human = self._perception.polar(*where, time)
        flags = task.flags[rows].copy()
        out = {
            "scan": self._perception.scan(*where, self.robots.differing(rows)),
            "goal": goal,
            "human": human,
            "success": torch.from_numpy(flags[:, 0:1]),
            "collision_human": torch.from_numpy(flags[:, 1:2]),
            "collision_obstacle": torch.from_numpy(flags[:, 2:3]),
            "pose": torch.from_numpy(pose),
            "human_pose": torch.from_numpy(task.human_pose[rows].copy()),
        }
        if self.report_robot:
            out["robot"] = self.robots.report(rows).to(self.dtype)
        if self.snapshots:
            several = self.scene.num_people is not None
            scene = task.snapshot(rows, several=several) | self.robots.snapshot(rows)
            tensors = {key: torch.from_numpy(one) for key, one in scene.items()}
            out["scene"] = TensorDict(tensors, batch_size=[len(pose)])
            if self.faults.memory:
                out["pending_action"] = self._pending[rows].flatten(1).clone()
            if self.faults.is_random:
                out["faults"] = self._faults[rows].clone()
        return out

    def _camera(self, camera: str | Camera, index: int, aspect: float) -> Camera | str:
        if camera not in ("top", "chase"):
            return super()._camera(camera, index, aspect)
        qpos = self._view["qpos"].numpy()[index : index + 1]
        pose = torch.from_numpy(qpos_to_pose(qpos, self.drive)[0])
        if camera == "chase":
            return chase_view(pose, self.robot)
        return episode_view(self._task, self._began[index], index, pose[:2], aspect)

    def _set_seed(self, seed: int | None) -> None:
        super()._set_seed(seed)
        if seed is not None:
            self._scenes.seed(seed)
            self._fault_rng.manual_seed(seed + 1)
