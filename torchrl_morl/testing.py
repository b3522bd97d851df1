"""What a test of a component needs: a small vector-reward environment, random transitions, a policy.

They are for the tests of your own losses, transforms and policies as well: :class:`VectorRewardMockEnv`
has sensors, nested keys and any batch shape, and :func:`random_transitions` is a batch that every loss of
this library and of TorchRL accepts. :func:`untrained_policy` is what a robot's own code is tested with,
:func:`sensor_readings` what it may be given.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_morl.deploy import LidarGeometry, Limits, Policy, Sensing
from torchrl_morl.modules import make_actor
from torchrl_morl.preferences import PreferenceSpace

__all__ = ["VectorRewardMockEnv", "random_transitions", "sensor_readings", "untrained_policy"]


def random_transitions(
    preference_space: PreferenceSpace,
    *batch: int,
    observation_size: int = 4,
    action_spec: Bounded | None = None,
) -> TensorDict:
    """Transitions of nothing in particular, to call a loss with.

    Rewards and observations are standard normal. Some transitions end, most of those by termination;
    the others are truncated. Draws come from the global generator of torch.

    Args:
        preference_space (PreferenceSpace): gives rewards ``[*batch, K]`` and preferences ``[*batch, T]``.
        *batch (int): the batch shape.

    Keyword Args:
        observation_size (int): entries of the observation.
        action_spec (Bounded, optional): of one action. Defaults to two entries in [-1, 1].

    Returns:
        ``observation``, ``preference``, ``action`` and, in ``"next"``, ``observation``, ``preference``,
        ``reward``, ``done`` and ``terminated``.

    Example:
        A loss of one's own in a test: with weights of zero on an objective, its reward does not count.

        >>> from torchrl_morl.objectives import MultiObjectiveGAE
        >>> space = PreferenceSpace(("distance", "efficiency"))
        >>> batch = random_transitions(space, 3, 5)
        >>> batch["preference"] = torch.tensor([1.0, 0.0]).expand(3, 5, 2)
        >>> batch["state_value"] = batch["next", "state_value"] = torch.zeros(3, 5, 2)
        >>> gae = MultiObjectiveGAE(
        ...     gamma=0.9, lmbda=0.9, value_network=None, preference_space=space
        ... )
        >>> advantage = gae(batch.clone())["advantage"]
        >>> batch["next", "reward"][..., 1] += 7.0
        >>> bool((gae(batch)["advantage"] == advantage).all())
        True

    """
    spec = Bounded(-1.0, 1.0, (2,)) if action_spec is None else action_spec
    preference = preference_space.sample(batch)
    terminated = torch.rand(*batch, 1) < 0.3
    return TensorDict(
        observation=torch.randn(*batch, observation_size),
        preference=preference,
        action=spec.rand(batch),
        next=TensorDict(
            observation=torch.randn(*batch, observation_size),
            preference=preference.clone(),
            reward=torch.randn(*batch, preference_space.num_objectives),
            done=terminated | (torch.rand(*batch, 1) < 0.2),
            terminated=terminated,
            batch_size=batch,
        ),
        batch_size=batch,
    )


def untrained_policy(
    preference_space: PreferenceSpace | None = None,
    sensing: Sensing | None = None,
    *,
    num_cells: tuple[int, ...] = (16, 16),
) -> Policy:
    """A policy that nobody trained: it drives straight on, at half of its speed.

    Its interface is that of a trained one, which :func:`~torchrl_morl.deploy.load_policy` reads.

    Args:
        preference_space: core, demo, distance and efficiency if ``None``, as in the recipes.
        sensing: what it reads; the defaults if ``None``.

    Keyword Args:
        num_cells: sizes of its hidden layers.

    Returns:
        The policy, with random weights: seed PyTorch for the same ones.

    Example:
        >>> policy = untrained_policy(PreferenceSpace(("speed", "comfort")))
        >>> command = policy.act(preference=[0.5, 0.5], lidar=[4.0] * 30, goal=[3.0, 0.0])
        >>> bool(abs(command[0] - 0.25) < 0.05), bool(abs(command[1]) < 0.5)
        (True, True)
    """
    if preference_space is None:
        names = ("core", "demo", "distance", "efficiency")
        preference_space = PreferenceSpace(names, static={"core": 1.0})
    sensing = Sensing() if sensing is None else sensing
    actor = make_actor(
        Bounded(-1.0, 1.0, shape=(2,)),
        in_features=sensing.observation_size + preference_space.num_tunable,
        num_cells=num_cells,
    )
    actor.eval().requires_grad_(False)
    actor[0].module.check_preferences("preference", preference_space)
    return Policy(actor, preference_space, sensing, Limits(), 0.2, "untrained", {})


def sensor_readings(
    policy: Policy, lidar: LidarGeometry, batch: int, *, seed: int = 0
) -> dict[str, np.ndarray]:
    """What a robot may measure, good and bad, all of which a policy drives with.

    Walls are 0.1 m to twice the trained range away, each some beams wide. Of the beams 2 % each are NaN, 0,
    negative, infinite, minus infinity and beyond ``range_max``, and in every fourth scan a third of
    them in a row is invalid. Goals and humans are up to twice as far away as in the training. The first
    preferences are the corners of the simplex, the others are uniform on it.

    Args:
        policy: that will be given them.
        lidar: of the robot.
        batch: how many.

    Keyword Args:
        seed: of the draws.

    Returns:
        ``ranges`` ``[batch, num_beams]``, ``goal`` and ``human`` ``[batch, 2]`` (m, rad), ``human_velocity``
        ``[batch, 2]`` (m/s) and ``preference`` ``[batch, T]``, all float32. ``human`` and ``human_velocity``
        only for policies that read them.

    Example:
        >>> lidar = LidarGeometry(0.0, math.pi / 180, 360, range_min=0.1, range_max=8.0)
        >>> readings = sensor_readings(untrained_policy(), lidar, 8)
        >>> {name: value.shape for name, value in readings.items()}
        {'ranges': (8, 360), 'goal': (8, 2), 'human': (8, 2), 'preference': (8, 3)}
    """
    rng, sensing, beams = np.random.default_rng(seed), policy.sensing, lidar.num_beams
    wall = rng.integers(1, 40, (batch, beams)).cumsum(-1) // 400
    distance = 0.1 * (20 * sensing.max_range) ** rng.random((batch, wall.max() + 1))
    ranges = np.take_along_axis(distance, wall, -1) * rng.uniform(1.0, 1.05, wall.shape)
    bad = np.array([np.nan, 0.0, -1.0, np.inf, -np.inf, lidar.range_max + 0.5])
    kind = (rng.random(ranges.shape) / 0.02).astype(int)
    spoilt = kind < len(bad)
    ranges[spoilt] = bad[kind[spoilt]]
    start = rng.integers(0, beams, (batch, 1))
    hidden = (np.arange(beams) - start) % beams < beams // 3
    ranges[hidden & (rng.random((batch, 1)) < 0.25)] = np.nan

    def positions(furthest: float) -> np.ndarray:
        far = rng.uniform(0.01, 2 * furthest, batch)
        return np.stack((far, rng.uniform(-2 * np.pi, 2 * np.pi, batch)), -1)

    size = policy.preference_space.num_tunable
    preference = np.concatenate((np.eye(size), rng.dirichlet(np.ones(size), batch)))[:batch]
    readings = {"ranges": ranges, "goal": positions(sensing.goal_range[1])}
    if sensing.observe_human:
        readings["human"] = positions(sensing.human_range[1])
    if sensing.observe_human_velocity:
        readings["human_velocity"] = rng.normal(0.0, 1.0, (batch, 2))
    readings["preference"] = preference
    return {name: value.astype(np.float32) for name, value in readings.items()}


class VectorRewardMockEnv(EnvBase):
    """A point in the unit square with one target per objective.

    Actions move the point by at most 0.1 per axis; the reward of objective ``k`` is minus the
    distance to its target, so the best place to be depends on the preference. Targets lie evenly on
    a circle around the origin. Episodes are truncated after ``horizon + i`` steps in environment
    ``i`` of the flattened batch, so that resets are partial.

    Args:
        num_objectives (int): the number ``K`` of objectives.

    Keyword Args:
        batch_size (tuple of int): the batch shape ``*B``; ``()`` for a single environment.
        horizon (int): the number of steps in an episode of the first environment.
        prefix (str, optional): nests ``observation``, ``action``, ``reward`` and the sensors under
            this key.
        polar (bool): adds ``goal`` and ``human``, of shape ``[*B, 2]``: metres in [0, 10] and
            radians in [-pi, pi].
        num_rays (int): adds ``scan``, of shape ``[*B, num_rays]``: metres in [0, 4]. Nothing is
            added for 0.
        seed (int, optional): the seed of the initial positions and the sensors.
        device (torch.device, optional): where tensors live.

    Example:
        >>> env = VectorRewardMockEnv(3, batch_size=(4,), seed=0)
        >>> env.rollout(10, break_when_any_done=False)["next", "reward"].shape
        torch.Size([4, 10, 3])

    """

    def __init__(
        self,
        num_objectives: int = 3,
        *,
        batch_size: tuple[int, ...] = (),
        horizon: int = 5,
        prefix: str | None = None,
        polar: bool = False,
        num_rays: int = 0,
        seed: int | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__(device=device, batch_size=torch.Size(batch_size))
        self.prefix = prefix
        self.polar = polar
        self.num_rays = num_rays
        angle = torch.arange(num_objectives, device=device) * (2 * math.pi / num_objectives)
        self.targets = torch.stack([angle.cos(), angle.sin()], -1)
        num_envs = self.batch_size.numel()
        self.horizon = horizon + torch.arange(num_envs, device=device).reshape(*self.batch_size, 1)
        self._position = torch.zeros(*self.batch_size, 2, device=device)
        self._count = torch.zeros_like(self.horizon)
        self._generator = torch.Generator()
        self._set_seed(seed)

        observations = {"observation": Bounded(-1.0, 1.0, shape=self._shape(2), device=device)}
        if polar:
            low = torch.tensor([0.0, -math.pi], device=device).expand(self._shape(2))
            high = torch.tensor([10.0, math.pi], device=device).expand(self._shape(2))
            observations |= {key: Bounded(low, high, device=device) for key in ("goal", "human")}
        if num_rays:
            observations["scan"] = Bounded(0.0, 4.0, shape=self._shape(num_rays), device=device)
        self.observation_spec = self._composite(observations)
        self.action_spec = self._composite(
            {"action": Bounded(-1.0, 1.0, shape=self._shape(2), device=device)}
        )
        self.reward_spec = self._composite(
            {"reward": Unbounded(self._shape(num_objectives), device=device)}
        )
        flag = Binary(1, shape=self._shape(1), dtype=torch.bool, device=device)
        self.done_spec = Composite(
            {key: flag.clone() for key in ("done", "terminated", "truncated")},
            shape=self.batch_size,
            device=device,
        )

    def key(self, name: str) -> NestedKey:
        """The full key of an observation, the action or the reward.

        Args:
            name (str): its last part.

        Returns:
            The name, behind the prefix if there is one.

        """
        return name if self.prefix is None else (self.prefix, name)

    def _shape(self, size: int) -> tuple[int, ...]:
        return (*self.batch_size, size)

    def _composite(self, specs: dict) -> Composite:
        composite = Composite(specs, shape=self.batch_size, device=self.device)
        if self.prefix is None:
            return composite
        return Composite({self.prefix: composite}, shape=self.batch_size, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._generator.manual_seed(seed)

    def _rand(self, size: int) -> Tensor:
        return torch.rand(self._shape(size), generator=self._generator).to(self.device)

    def _observe(self) -> TensorDict:
        tensordict = TensorDict(batch_size=self.batch_size, device=self.device)
        tensordict.set(self.key("observation"), self._position.clone())
        if self.polar:
            for name in ("goal", "human"):
                distance, turn = self._rand(2).unbind(-1)
                value = torch.stack([10 * distance, math.pi * (2 * turn - 1)], -1)
                tensordict.set(self.key(name), value)
        if self.num_rays:
            tensordict.set(self.key("scan"), 4 * self._rand(self.num_rays))
        return tensordict

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDict:
        reset = None if tensordict is None else tensordict.get("_reset", None)
        if reset is None:
            reset = torch.ones_like(self._count, dtype=torch.bool)
        reset = reset.reshape(self._count.shape)
        self._position = torch.where(reset, 2 * self._rand(2) - 1, self._position)
        self._count = torch.where(reset, torch.zeros_like(self._count), self._count)
        return self._observe()

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self._position = (self._position + 0.1 * tensordict[self.key("action")]).clamp(-1, 1)
        self._count = self._count + 1
        tensordict = self._observe()
        distance = (self._position.unsqueeze(-2) - self.targets).norm(dim=-1)
        tensordict.set(self.key("reward"), -distance)
        truncated = self._count >= self.horizon
        tensordict.update(
            {
                "done": truncated,
                "truncated": truncated.clone(),
                "terminated": torch.zeros_like(truncated),
            }
        )
        return tensordict
