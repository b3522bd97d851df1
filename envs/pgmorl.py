"""The tasks of PGMORL (https://proceedings.mlr.press/v119/xu20h.html), on the models of Gymnasium.

PD-MORL and Hyper-MORL report their hypervolumes on these. Importing this module registers them::

    python -m recipes.benchmark.train env=envs.pgmorl:MO-HalfCheetah-v2 evaluation.reference=0

Rewards, ends of episodes, observations and starts are those of PGMORL's code, and so is what its models change:
strengths, damping and masses. They were written for MuJoCo 2.0, and a newer one simulates otherwise in
detail. Every episode starts alike, so that one of a policy without noise is all of them; ``reset_noise`` varies
the start.
"""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.spaces import Box

__all__ = ["MOAnt", "MOHalfCheetah", "MOHopper", "MOSwimmer", "MOWalker2d"]

_ALIVE = 1.0
_Step = tuple[np.ndarray, np.ndarray, bool, bool, dict[str, Any]]


class _Task(MujocoEnv):
    """What all have in common.

    Keyword Args:
        reset_noise: half of the range that is added to every position and velocity of the start.
        **kwargs: of :class:`gymnasium.envs.mujoco.MujocoEnv`, such as ``render_mode``.

    Raises:
        ValueError: if ``reset_noise`` is negative.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["human", "rgb_array", "depth_array"]}
    model_file: ClassVar[str]
    frames: ClassVar[int]
    """Steps of the simulation in one of the task."""
    num_objectives: ClassVar[int] = 2
    hidden: ClassVar[int] = 1
    """Positions at the beginning that no policy sees."""
    fastest: ClassVar[float] = np.inf
    """Speeds beyond are seen as this."""

    def __init__(self, *, reset_noise: float = 0.0, **kwargs: Any) -> None:
        if not reset_noise >= 0:
            raise ValueError(f"reset_noise must not be negative, got {reset_noise}.")
        self.reset_noise = reset_noise
        super().__init__(self.model_file, self.frames, observation_space=None, **kwargs)
        size = self.model.nq - self.hidden + self.model.nv
        self.observation_space = Box(-np.inf, np.inf, (size,))
        self.reward_space = Box(-np.inf, np.inf, (self.num_objectives,))

    def step(self, action: np.ndarray) -> _Step:
        action = np.clip(action, self.action_space.low, self.action_space.high)
        before = self._position()
        self.do_simulation(action, self.frame_skip)
        velocity = (self._position() - before) / self.dt
        reward = np.array(self._rewards(velocity, np.asarray(action, float)), np.float32)
        return self._observation(), reward, self._fallen(), False, {}

    def reset_model(self) -> np.ndarray:
        low, high = -self.reset_noise, self.reset_noise
        self.set_state(
            self.init_qpos + self.np_random.uniform(low, high, self.model.nq),
            self.init_qvel + self.np_random.uniform(low, high, self.model.nv),
        )
        return self._observation()

    def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        model, data = super()._initialize_simulation()
        self._change(model)
        mujoco.mj_setConst(model, data)
        return model, mujoco.MjData(model)

    def _change(self, model: mujoco.MjModel) -> None:
        """Make Gymnasium's model that of PGMORL, in place."""

    def _position(self) -> np.ndarray:
        return self.data.qpos[:2].copy()

    def _observation(self) -> np.ndarray:
        velocity = np.clip(self.data.qvel, -self.fastest, self.fastest)
        return np.concatenate((self.data.qpos[self.hidden :], velocity)).astype(np.float32)

    def _rewards(self, velocity: np.ndarray, action: np.ndarray) -> tuple[float, ...]:
        raise NotImplementedError

    def _fallen(self) -> bool:
        return False


class MOHalfCheetah(_Task):
    """Run, at most 4 m/s count, and spare the motors.

    Example:
        >>> env = gymnasium.make("MO-HalfCheetah-v2")
        >>> _ = env.reset(seed=0)
        >>> reward = env.step(np.ones(6))[1]
        >>> bool(reward[1] == -1)  # 5 - 6 full actions
        True
    """

    model_file, frames = "half_cheetah.xml", 5

    def _rewards(self, velocity, action):
        return min(4.0, velocity[0]) + _ALIVE, 4.0 - np.square(action).sum() + _ALIVE

    def _fallen(self):
        return not abs(self.data.qpos[2]) < np.deg2rad(50)


class MOWalker2d(_Task):
    """Walk fast, and spare the motors. Heavier and more damped than Gymnasium's."""

    model_file, frames, fastest = "walker2d.xml", 4, 10.0

    def _change(self, model):
        model.dof_damping[3:] = 3.0
        model.body_mass *= 1.5
        model.body_inertia *= 1.5

    def _rewards(self, velocity, action):
        return velocity[0] + _ALIVE, 4.0 - np.square(action).sum() + _ALIVE

    def _fallen(self):
        height, angle = self.data.qpos[1:3]
        return not (0.8 < height < 2.0 and -1.0 < angle < 1.0)


class MOAnt(_Task):
    """Run along x, and along y. Its motors are weaker than Gymnasium's."""

    model_file, frames, hidden = "ant.xml", 5, 2

    def _change(self, model):
        model.actuator_gear[:, 0] = 100.0

    def _position(self):
        return self.data.body("torso").xpos[:2].copy()

    def _rewards(self, velocity, action):
        other = _ALIVE - 0.5 * np.square(action).sum()
        return velocity[0] + other, velocity[1] + other

    def _fallen(self):
        return not np.isfinite(self.data.qpos).all() or not np.isfinite(self.data.qvel).all()


class MOSwimmer(_Task):
    """Swim forwards, and spare the motors. They are twice as strong as Gymnasium's."""

    model_file, frames, hidden = "swimmer.xml", 4, 2

    def _change(self, model):
        model.actuator_gear[:, 0] = 300.0

    def _rewards(self, velocity, action):
        return velocity[0], 0.3 - 0.15 * np.square(action).sum()


class MOHopper(_Task):
    """Run, jump, and with three objectives spare the motors. Stronger and more damped than Gymnasium's."""

    model_file, frames, fastest = "hopper.xml", 5, 10.0

    def __init__(self, *, num_objectives: int = 2, **kwargs: Any) -> None:
        if num_objectives not in (2, 3):
            raise ValueError(f"num_objectives must be 2 or 3, got {num_objectives}.")
        self.num_objectives = num_objectives
        super().__init__(**kwargs)

    def _change(self, model):
        model.dof_armature[3:] = 1.0
        model.dof_damping[3:] = 40.0
        model.jnt_limited[3:] = 0
        model.actuator_ctrlrange[:] = [(-2.0, 2.0), (-2.0, 2.0), (-4.0, 4.0)]
        model.actuator_gear[:, 0] = (200.0, 200.0, 300.0)

    def _rewards(self, velocity, action):
        run, jump = 1.5 * velocity[0], 12.0 * (self.data.qpos[1] - self.init_qpos[1])
        effort = np.square(action).sum()
        if self.num_objectives == 3:
            return run + _ALIVE, jump + _ALIVE, 4.0 - effort + _ALIVE
        return run + _ALIVE - 2e-4 * effort, jump + _ALIVE - 2e-4 * effort

    def _fallen(self):
        position = self.data.qpos
        return not (position[1] > 0.4 and np.all(np.abs(position[2:6]) < np.deg2rad(90)))


for _name, _task, _arguments in (
    ("MO-HalfCheetah-v2", MOHalfCheetah, {}),
    ("MO-Walker2d-v2", MOWalker2d, {}),
    ("MO-Ant-v2", MOAnt, {}),
    ("MO-Swimmer-v2", MOSwimmer, {}),
    ("MO-Hopper-v2", MOHopper, {}),
    ("MO-Hopper-v3", MOHopper, {"num_objectives": 3}),
):
    gymnasium.register(_name, _task, max_episode_steps=500, kwargs=_arguments)
