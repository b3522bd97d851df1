"""The navigation task as a Gymnasium environment with MO-Gymnasium's conventions.

Importing this module registers one id per kind of scene::

    torchrl_morl/Navigation-v0              static human and boxes
    torchrl_morl/Navigation-MovingHuman-v0  the human walks towards the robot
    torchrl_morl/Navigation-Corridor-v0     an intersection of two corridors
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict
from torchrl.envs import ActionScaling, Compose, TransformedEnv

from torchrl_morl.deploy import Policy, load_reward_model
from torchrl_morl.deploy.features import policy_transforms
from torchrl_morl.modules import RewardModel
from torchrl_morl.transforms import RewardModelReward

from .faults import get_faults
from .lidar import MIN_RANGE
from .navigation import NavigationEnv
from .policy_env import check_policy, observed_size

# Steps: longer than anything runs.
_NO_LIMIT = 2**62


class NavigationGymEnv(gymnasium.Env):
    """One :class:`NavigationEnv` simulation for Gymnasium, MO-Gymnasium and their wrappers.

    Observations are the features of :func:`torchrl_morl.deploy.features.policy_transforms`: 36 of
    them, 38 with the human's velocity, 33 without the human. Rewards are
    vectors, one entry per objective, as in `MO-Gymnasium <https://mo-gymnasium.farama.org>`_.
    ``info`` says in ``success``, ``collision_human`` and ``collision_obstacle`` why an episode
    terminated.

    Actions are physical: forward speed in m/s and turn rate in rad/s, clamped to the robot's
    limits. The range is neither symmetric nor [-1, 1]; MORL-Baselines' continuous algorithms
    (CAPQL, GPI-LS, GPI-PD, MOSAC) shift and scale their actors to the bounds of any box. Their
    critics take the action as it is, so compare methods, or drive with a policy of this project,
    under ``gymnasium.wrappers.RescaleAction(env, -1.0, 1.0)``.

    Episodes of the registered ids are truncated after 300 steps by Gymnasium, so that
    ``make(..., max_episode_steps=600)`` has the usual meaning. ``make(..., render_mode="human")`` opens
    Gymnasium's window, which cannot be recorded; to watch and record at once, wrap
    ``HumanRendering(RecordVideo(make(..., render_mode="rgb_array"), folder))``.

    Args:
        render_mode: ``"rgb_array"`` or ``None``.

    Keyword Args:
        policy: that is to drive here: refused if it was trained to sense something else. It drives
            under ``gymnasium.wrappers.RescaleAction(env, -1.0, 1.0)``.
        observe_human: without it the observation ends with the goal.
        observe_human_velocity: the human's velocity too, ahead and to the left, m/s.
        max_episode_steps: steps of 0.2 s before truncation; ``None`` leaves that to a
            :class:`gymnasium.wrappers.TimeLimit`, whose time-outs ``repeat_failed`` does not see.
        reward_model: scores demonstration-likeness, a :class:`~torchrl_morl.modules.RewardModel` or the
            folder of one: it becomes the objective "demo", in second place of the reward.
        camera: what :meth:`render` shows, ``"top"`` or ``"chase"``.
        width: of rendered frames, pixels.
        height: of rendered frames, pixels.
        **kwargs: see :class:`NavigationEnv`; ``num_envs`` is 1.

    Raises:
        ValueError: for an unknown ``render_mode``, from :class:`NavigationEnv`, or for the velocity of a
            human who is not observed.
        FileNotFoundError: if the folder holds no reward model.
        ValueError: for a reward model or a policy of another observation; the message says what to
            change.

    Examples:
        >>> import mo_gymnasium
        >>> import envs.gym
        >>> env = mo_gymnasium.make("torchrl_morl/Navigation-v0")
        >>> observation, info = env.reset(seed=0)
        >>> observation.shape
        (36,)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> dict(zip(env.unwrapped.objectives, reward))["efficiency"]
        np.float32(-10.0)
    """

    metadata: ClassVar[dict[str, Any]] = {
        "render_modes": ["rgb_array"],
        "render_fps": round(1 / NavigationEnv.CONTROL_PERIOD),
    }

    def __init__(
        self,
        render_mode: str | None = None,
        *,
        policy: Policy | None = None,
        observe_human: bool = True,
        observe_human_velocity: bool = False,
        max_episode_steps: int | None = 300,
        reward_model: RewardModel | str | Path | None = None,
        camera: str = "top",
        width: int = 640,
        height: int = 360,
        **kwargs: Any,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(
                f"render_mode must be 'rgb_array' or None, got {render_mode!r}; for a window wrap the "
                "environment in gymnasium.wrappers.HumanRendering."
            )
        # Before the simulation, as it refuses what does not go together.
        observed = policy_transforms(
            kwargs.get("max_range", 4.0),
            period=NavigationEnv.CONTROL_PERIOD,
            observe_human=observe_human,
            observe_human_velocity=observe_human_velocity,
            range_min=MIN_RANGE if get_faults(kwargs.get("faults")).code_beams else None,
        )
        if isinstance(reward_model, (str, Path)):
            reward_model, _ = load_reward_model(reward_model)
        observes = {
            "observe_human": observe_human,
            "observe_human_velocity": observe_human_velocity,
        }
        if policy is not None:
            check_policy(policy, {**observes, **kwargs})
        # One simulation has no use for a pool of threads, nor Gymnasium for snapshots.
        options = {"num_threads": 1, "snapshots": False, **kwargs}
        self._navigation = NavigationEnv(
            num_envs=1,
            max_episode_steps=_NO_LIMIT if max_episode_steps is None else max_episode_steps,
            camera=camera,
            render_width=width,
            render_height=height,
            **options,
        )
        features = [
            transform.clone() for transform in observed if not isinstance(transform, ActionScaling)
        ]
        self._env = TransformedEnv(self._navigation, Compose(*features))
        self.render_mode = render_mode
        self.objectives = self._navigation.objectives
        self._demo = None
        if reward_model is not None:
            self._demo = RewardModelReward(reward_model, position=1)
            self._check(reward_model)
            self.objectives = (self.objectives[0], "demo", *self.objectives[1:])
        self.reward_dim = len(self.objectives)
        size = self._env.observation_spec["observation"].shape[-1]
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        low, high = self._env.action_spec.space.low, self._env.action_spec.space.high
        self.action_space = gymnasium.spaces.Box(low[0].numpy(), high[0].numpy(), dtype=np.float32)
        self.reward_space = gymnasium.spaces.Box(-np.inf, np.inf, (self.reward_dim,), np.float32)
        self._current = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode in a new scene.

        Args:
            seed: seeds this and, through the scenes' random stream, all episodes that follow.
            options: not used.

        Returns:
            Observation and info.
        """
        super().reset(seed=seed)
        if seed is not None or self._current is None:
            # np_random is the one source of randomness, as Gymnasium asks.
            self._navigation.set_seed(int(self.np_random.integers(2**31)))
        self._current = self._env.reset()
        return self._observation(), self._info()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool, bool, dict[str, Any]]:
        """Drive for 0.2 s.

        Args:
            action: forward speed (m/s) and turn rate (rad/s).

        Returns:
            Observation, reward ``[K]``, terminated, truncated and info.

        Raises:
            RuntimeError: before the first reset.
            ValueError: for an action of another shape, or one that is not finite.
        """
        if self._current is None:
            raise RuntimeError("Call reset before the first step.")
        action = np.asarray(action, dtype=np.float32)
        if action.shape != self.action_space.shape:
            raise ValueError(f"An action is {self.action_space.shape}, got {action.shape}.")
        before = self._current.set("action", torch.tensor(action)[None])
        self._current = self._env.step(before)["next"]
        reward = self._reward(before)[0].numpy().astype(np.float32)
        terminated, truncated = (bool(self._current[key]) for key in ("terminated", "truncated"))
        return self._observation(), reward, terminated, truncated, self._info()

    def render(self) -> np.ndarray | None:
        """The scene as an image, uint8 ``[height, width, 3]``; ``None`` without a render mode."""
        return None if self.render_mode is None else self._navigation.render()[0].cpu().numpy()

    def close(self) -> None:
        if not self._env.is_closed:
            self._env.close()

    def _observation(self) -> np.ndarray:
        return self._current["observation"][0].numpy().astype(np.float32)

    def _check(self, reward_model: RewardModel) -> None:
        expected = self._env.observation_spec["observation"].shape[-1]
        size = observed_size(reward_model)
        if size != expected:
            raise ValueError(
                f"The reward model is about observations of {size} entries, here they have {expected}."
            )

    def _reward(self, before: TensorDict) -> torch.Tensor:
        reward = self._current["reward"]
        if self._demo is None:
            return reward
        space = self._env.action_spec.space
        # The reward model knows a policy's actions, in [-1, 1].
        scaled = 2 * (before["action"].clamp(space.low, space.high) - space.low)
        scaled = scaled / (space.high - space.low) - 1
        step = {"observation": before["observation"], "action": scaled, "reward": reward}
        return self._demo(TensorDict(step, batch_size=[1]))["reward"]

    def _info(self) -> dict[str, Any]:
        keys = ("success", "collision_human", "collision_obstacle")
        return {key: bool(self._current[key]) for key in keys}


for _name, _scene in (
    ("Navigation", "static"),
    ("Navigation-MovingHuman", "moving_human"),
    ("Navigation-Corridor", "corridor"),
):
    _id = f"torchrl_morl/{_name}-v0"
    if _id not in gymnasium.registry:
        gymnasium.register(
            _id,
            "envs.gym:NavigationGymEnv",
            max_episode_steps=300,
            kwargs={"scene": _scene, "max_episode_steps": None},
        )
