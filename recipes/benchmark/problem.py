"""What an agent is given: environments with a vector reward, and preferences over its entries."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from torch import Tensor
from torchrl.data import Categorical
from torchrl.envs import Compose, EnvBase, TransformedEnv

from envs.mo_gym import VectorMOGymEnv, make_mo_gym_env
from recipes.training.gradients import use_bfloat16
from recipes.training.run_folder import check_run_dir
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.transforms import PreferenceSampler

SMALLEST_SPREAD = 0.1
"""Standard deviation of an observation below which it is not scaled up further."""


@dataclasses.dataclass(frozen=True)
class BenchmarkProblem:
    """A :class:`~recipes.training.evaluation.Problem` that anybody may have written."""

    run_dir: Path
    device: torch.device
    preference_space: PreferenceSpace
    env: EnvBase
    """Where it trains."""
    eval_env: EnvBase
    reference: tuple[float, ...]
    """Of the hypervolume, one entry per objective."""
    make_env: Callable[[int, int], EnvBase] | None = None
    """Another one to train in, of a seed and a number of environments; it can be pickled."""
    statistics: tuple[Tensor, Tensor] | None = None
    """Means and deviations of observations, ``[F]`` each."""
    facts: dict[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def num_actions(self) -> int | None:
        """How many there are to choose from; ``None`` where actions are continuous."""
        spec = self.env.action_spec_unbatched
        return spec.space.n if isinstance(spec, Categorical) else None

    @property
    def max_episode_steps(self) -> int:
        """Steps before an episode is truncated."""
        return self.env.base_env.max_episode_steps


def make_problem(cfg: DictConfig) -> BenchmarkProblem:
    """Environments and preferences of a configuration; nothing is written yet.

    Raises:
        FileExistsError: if the run folder holds policies.
        ValueError: in one line, for an environment that cannot be made or does not fit the other fields.
    """
    torch.set_num_threads(cfg.compute.torch_threads)
    torch.manual_seed(cfg.seed)
    run_dir = Path(HydraConfig.get().runtime.output_dir)
    if cfg.resume is None:
        check_run_dir(run_dir)
    device = torch.device(cfg.device)
    base = _make_base(cfg, cfg.num_envs)
    num_objectives = base.reward_spec.shape[-1]
    names = cfg.objectives or [f"objective_{index}" for index in range(1, num_objectives + 1)]
    if len(names) != num_objectives:
        raise ValueError(
            f"objectives must name the {num_objectives} entries of the reward of {cfg.env}, in its "
            f"order, got {list(names)}."
        )
    preference_space = PreferenceSpace(tuple(names))
    return BenchmarkProblem(
        run_dir=run_dir,
        device=device,
        preference_space=preference_space,
        env=_transformed(cfg, preference_space, base, cfg.seed),
        eval_env=TransformedEnv(
            _make_base(cfg, cfg.evaluation.episodes), PreferenceSampler(preference_space)
        ),
        reference=_reference(cfg, num_objectives),
        make_env=functools.partial(make_train_env, cfg, preference_space),
        statistics=observation_statistics(cfg),
        facts={"env": cfg.env, "bfloat16": use_bfloat16(cfg.compute.bfloat16, device)},
    )


def make_train_env(
    cfg: DictConfig, preference_space: PreferenceSpace, seed: int, num_envs: int
) -> EnvBase:
    """Environments to train in, with preferences of their own."""
    return _transformed(cfg, preference_space, _make_base(cfg, num_envs), seed)


def observation_statistics(cfg: DictConfig) -> tuple[Tensor, Tensor] | None:
    """Means and standard deviations ``[F]`` of what random actions lead to.

    What hardly varies then is not blown up: no deviation is below :data:`SMALLEST_SPREAD`.
    """
    steps = cfg.network.standardize_frames // cfg.num_envs
    if not steps:
        return None
    env = _make_base(cfg, cfg.num_envs)
    env.set_seed(cfg.seed)
    observation = env.rollout(steps, break_when_any_done=False)["observation"].flatten(0, -2)
    scale, loc = torch.std_mean(observation, 0)
    return loc, scale.clamp_min(SMALLEST_SPREAD)


def _transformed(
    cfg: DictConfig, preference_space: PreferenceSpace, base: VectorMOGymEnv, seed: int
) -> TransformedEnv:
    sampler = PreferenceSampler(
        preference_space,
        distribution=cfg.preference.distribution,
        num_segments=cfg.preference.num_segments,
        seed=seed,
    )
    env = TransformedEnv(base, Compose(sampler))
    # Environments of neighbouring seeds would otherwise share all but one of their starts.
    env.set_seed(int(np.random.SeedSequence(seed).generate_state(1)[0] >> 1))
    return env


def _make_base(cfg: DictConfig, num_envs: int) -> VectorMOGymEnv:
    try:
        return make_mo_gym_env(
            cfg.env,
            num_envs=num_envs,
            max_episode_steps=cfg.max_episode_steps,
            **OmegaConf.to_container(cfg.env_kwargs),
        )
    except ValueError as error:
        raise ValueError(f"env={error}") from error


def _reference(cfg: DictConfig, num_objectives: int) -> tuple[float, ...]:
    given = OmegaConf.to_container(cfg.evaluation)["reference"]
    reference = given if isinstance(given, list) else [given] * num_objectives
    if len(reference) != num_objectives:
        raise ValueError(
            f"evaluation.reference must have {num_objectives} entries, one per objective of {cfg.env}, "
            f"or be a single number, got {reference}."
        )
    return tuple(map(float, reference))
