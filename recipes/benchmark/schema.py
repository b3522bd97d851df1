"""What the configurations allow; ``common.yaml``, ``pd_morl.yaml`` and ``mo_ppo.yaml`` have the defaults."""

from __future__ import annotations

import difflib
import importlib
from typing import Annotated, Any, Literal

import gymnasium
import mo_gymnasium  # noqa: F401, registers its environments
from pydantic import AfterValidator, Field, model_validator

from recipes.training import ppo_schema, schema, worker_schema
from recipes.training.fields import (
    Allows,
    Count,
    CountOrNone,
    Decay,
    Device,
    Discount,
    MayImport,
    Names,
    NotNegative,
    Positive,
    RunFolder,
    Section,
    Seed,
    Size,
)


def _registered(name: str) -> str:
    module, colon, identifier = name.rpartition(":")
    if colon:
        try:
            importlib.import_module(module)
        except ImportError as error:
            raise ValueError(f"{name}: {module} cannot be imported: {error}.") from error
    try:
        gymnasium.spec(identifier)
    except gymnasium.error.Error as error:
        near = difflib.get_close_matches(identifier, gymnasium.registry, 1)
        hint = f"did you mean {near[0]}?" if near else "module:Name-v0 imports what registers it."
        raise ValueError(f"{name!r} is not registered with Gymnasium: {hint}") from error
    return name


def _numbers(value: Any) -> Any:
    entries = value if isinstance(value, list) else [value]
    if not entries or any(
        isinstance(one, bool) or not isinstance(one, int | float) for one in entries
    ):
        raise ValueError(f"must be a number, or a list of one for each objective, got {value!r}.")
    return value


Environment = Annotated[
    str,
    AfterValidator(_registered),
    Allows("an id of Gymnasium, module:Name-v0 with an import"),
    MayImport(),
]
Reference = Annotated[
    Any, AfterValidator(_numbers), Allows("a number, or a list of one for each objective")
]


class Network(schema.Network):
    """What they see."""

    standardize_frames: CountOrNone = Field(
        description="Steps of random actions before the training, whose means and deviations standardize "
        "observations; 0: networks see them as they are."
    )


class Evaluation(Section):
    """Evaluations while training, over a lattice of preferences."""

    interval: Count = Field(description="Frames between evaluations.")
    preferences: Size = Field(
        description="Points of the lattice at most; it holds the corners at least."
    )
    episodes: Size = Field(description="Episodes of each preference.")
    reference: Reference = Field(
        description="Reference point of the hypervolume, in units of the returns."
    )
    discounted: bool = Field(
        description="Whether indicators are of discounted returns, as in MORL-Baselines, or of sums."
    )
    seed: Seed = Field(description="Seed of the episodes of evaluations.")


class PDMORLEvaluation(Evaluation):
    """With the key solutions of the interpolator."""

    refit_momentum: Decay = Field(
        description="What the interpolator keeps of its key solutions at an evaluation."
    )


class Benchmark(Section):
    """What both algorithms share."""

    env: Environment = Field(description="The environment, whose reward is a vector.")
    env_kwargs: Annotated[dict[str, Any], Allows("arguments of the environment")] = Field(
        description="Arguments of the environment, such as {cost_objective: false}."
    )
    objectives: Names | None = Field(
        description="Names of the entries of the reward, in its order; null numbers them."
    )
    num_envs: Size = Field(description="Environments that are stepped together.")
    max_episode_steps: Count | None = Field(
        description="Steps before an episode is truncated; null is the environment's own."
    )
    resume: RunFolder | None = Field(
        description="Folder of a run that did not end; it goes on there, as it was configured."
    )
    seed: Seed = Field(description="Seed of networks, environments and preferences.")
    device: Device = Field(description="Where networks are trained.")
    network: Network


class PDMORLLoss(schema.AngleLoss):
    """Of any environment."""

    gamma: Discount = Field(description="Discount of a step.")


class PDMORLCollector(worker_schema.Workers, schema.NoisyCollector):
    """With workers."""


class PDMORLConfig(Benchmark):
    """PD-MORL."""

    algorithm: Literal["pd_morl"] = Field(description="What trains; mo_ppo has other fields.")
    compute: schema.CompiledCompute
    preference: schema.Preference
    collector: PDMORLCollector
    replay_buffer: schema.ReplayBuffer
    loss: PDMORLLoss
    optim: schema.TD3Optim
    evaluation: PDMORLEvaluation
    logger: schema.Logger

    @model_validator(mode="after")
    def _fits_together(self) -> PDMORLConfig:
        _check_envs(self.collector, self.num_envs, self.preference.num_segments)
        schema.check_experience(self.collector, self.replay_buffer)
        return self


class Collector(worker_schema.Workers, ppo_schema.Collector):
    """With noise on continuous actions."""

    exploration_sigma: Positive = Field(
        description="Standard deviation of the noise on continuous actions, which are in [-1, 1]."
    )
    final_exploration_sigma: Positive = Field(
        description="The same at the end; between them it falls geometrically."
    )


class Loss(ppo_schema.Loss):
    """With a reward of entropy."""

    entropy_coeff: NotNegative = Field(
        description="Reward of the entropy where actions are discrete; elsewhere the noise is fixed."
    )


class MOPPOConfig(Benchmark):
    """MO-PPO."""

    algorithm: Literal["mo_ppo"] = Field(description="What trains; pd_morl has other fields.")
    compute: ppo_schema.Compute
    preference: ppo_schema.Preference
    collector: Collector
    replay_buffer: ppo_schema.ReplayBuffer
    loss: Loss
    optim: ppo_schema.Optim
    evaluation: Evaluation
    logger: schema.Backends

    @model_validator(mode="after")
    def _fits_together(self) -> MOPPOConfig:
        _check_envs(self.collector, self.num_envs, self.preference.num_segments)
        ppo_schema.check_batch_size(self.optim.batch_size, self.collector.frames_per_batch)
        return self


def _check_envs(
    collector: Collector | PDMORLCollector, num_envs: int, num_segments: int | None
) -> None:
    if collector.frames_per_batch % num_envs:
        raise ValueError(
            f"collector.frames_per_batch must be a multiple of num_envs, {num_envs}, "
            f"got {collector.frames_per_batch}."
        )
    if num_segments is not None and num_segments > num_envs:
        raise ValueError(
            f"preference.num_segments must be at most num_envs, {num_envs}, got {num_segments}."
        )
    worker_schema.check_workers(collector, num_envs, num_segments, field="num_envs")
