"""What the configuration of MO-PPO allows; ``config.yaml`` has the defaults."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from recipes.training import schema
from recipes.training.fields import (
    Allows,
    Count,
    CountOrNone,
    Decay,
    DemonstrationFile,
    Device,
    Discount,
    Distribution,
    NotNegative,
    Objectives,
    PolicyFolder,
    Positive,
    RewardModelFolder,
    Rewards,
    RobotField,
    RunFolder,
    SceneField,
    Section,
    Seed,
    Share,
    Size,
)


def _some_noise(sigma: list[float]) -> list[float]:
    if len(sigma) != 2 or min(sigma) <= 0:
        raise ValueError(
            "must be positive, for speed and turn rate, since without noise there is nothing to "
            f"compare, got {sigma}."
        )
    return sigma


class Compute(schema.Compute):
    """With mixed precision."""

    bfloat16: bool | None = Field(
        description="Mixed precision of the updates; null is where the processor multiplies bfloat16."
    )


class Env(schema.Env):
    """Null is as in the training of the policy."""

    scene: SceneField | None = Field(
        description="Scenes in which it trains; null is where the policy was evaluated."
    )
    robot: RobotField | None = Field(description="The robot; null is that of the policy.")
    observe_human: bool | None = Field(
        description="Whether the policy knows where the human is; null is as it was trained."
    )
    observe_human_velocity: bool | None = Field(
        description="Whether the policy knows the human's velocity; null is as it was trained."
    )
    drive: Literal["planar", "wheels"] | None = Field(
        description="Velocity servos, or wheels with rolling contact; null is as it was trained."
    )
    goal_radius: Positive | None = Field(
        description="Distance at which the goal is reached, metres; null is as it was trained."
    )
    max_episode_steps: Count | None = Field(
        description="Steps of 0.2 s before an episode is truncated; null is as it was trained."
    )
    objectives: Objectives | None = Field(
        description="Objectives of the reward; null is as it was trained."
    )
    rewards: Rewards | None = Field(
        description="Constants of the rewards that differ; null is as it was trained."
    )
    faults: schema.Faults | None = Field(
        description="Faults of sensors and actuation; null is as it was trained."
    )
    repeat_failed: Share = Field(
        description="Share of the episodes that take place in scenes in which one has failed."
    )


class Demonstrations(Section):
    """What was demonstrated."""

    reward_model: RewardModelFolder | None = Field(
        description='Folder of a reward model, which adds the objective "demo"; that of the policy.'
    )
    dataset: DemonstrationFile | None = Field(
        description="Demonstrations that a training from nothing clones first, where they are wished."
    )

    @model_validator(mode="after")
    def _have_an_objective(self) -> Demonstrations:
        if self.dataset is not None and self.reward_model is None:
            raise ValueError(
                f"demonstrations.dataset needs demonstrations.reward_model, got {self.dataset!r} and "
                'None: without one there is no objective "demo" for them.'
            )
        return self


class Preference(Section):
    """How preferences are drawn."""

    num_segments: Size | None = Field(
        description="Groups of environments, each with its part of the simplex; null is one."
    )
    distribution: Distribution = Field(
        description="Distribution from which every episode draws its preference."
    )


class Collector(Section):
    """How experience is collected."""

    total_frames: Count = Field(
        description="Steps of the whole training; the last batch is a whole one."
    )
    frames_per_batch: int = Field(
        ge=1, le=100_000_000, description="Steps between updates, over all environments."
    )
    exploration_sigma: Annotated[
        list[float], AfterValidator(_some_noise), Allows("two positive numbers")
    ] = Field(
        description="Standard deviation of the noise on speed and turn rate, of actions in [-1, 1]."
    )
    final_exploration_sigma: Annotated[
        list[float], AfterValidator(_some_noise), Allows("two positive numbers")
    ] = Field(description="The same at the end; between them it falls geometrically.")


class ReplayBuffer(Section):
    """How experience is kept."""

    reward_scale: Positive = Field(description="Factor on the rewards; keeps returns within tens.")


class Loss(Section):
    """PPO's, and what the actor pays for beside its returns."""

    gamma: Discount = Field(description="Discount of a step of 0.2 s.")
    lmbda: Share = Field(description="Lambda of generalized advantage estimation.")
    final_lmbda: Share | None = Field(
        description="The same at the end, linearly between them; null is no change."
    )
    level_preferences: bool = Field(
        description="Whether advantages are divided by their usual size at a preference."
    )
    truncation_is_terminal: bool = Field(
        description="Whether returns end where the time is up, as in the training."
    )
    clip_epsilon: float = Field(
        gt=0, lt=1, description="How far the likelihood of an action may move, as a share."
    )
    anchor_coeff: NotNegative = Field(
        description="Cost of leaving the policy at the start, where the style is preferred."
    )
    anchor_radius: NotNegative = Field(
        description="Distance from the human within which that is held, metres."
    )
    anchor_clearance: NotNegative = Field(
        description="Range to the nearest box below which that is not held, metres; 0 holds everywhere."
    )
    anchor_window: Annotated[int, Allows("an odd whole number at least 1")] = Field(
        description="Steps over which the actions of the policy at the start are averaged, odd."
    )
    smoothness_coeff: NotNegative = Field(
        description="Cost of the squared change of the turn rate from a step to the next."
    )
    standing_coeff: NotNegative = Field(description="Cost of neither driving nor turning.")

    @model_validator(mode="after")
    def _window_has_a_middle(self) -> Loss:
        if self.anchor_window < 1 or self.anchor_window % 2 == 0:
            raise ValueError(
                "loss.anchor_window must be an odd number of steps, 1 for no average, "
                f"got {self.anchor_window}."
            )
        return self


class Optim(Section):
    """How networks are updated."""

    cloning_updates: CountOrNone = Field(
        description="Updates of behaviour cloning before everything else, of a training from nothing."
    )
    critic_batches: CountOrNone = Field(
        description="Batches of frames at the start for the critic alone."
    )
    critic_epochs: Count = Field(description="Passes over each of those.")
    epochs: Count = Field(description="Passes over each batch of frames after them.")
    batch_size: Annotated[int, Allows("a whole number from 1 to collector.frames_per_batch")] = (
        Field(description="Transitions of an update.")
    )
    penalty_batch_size: Count = Field(
        description="Transitions of an update that anchor and smoothness are taken of."
    )
    lr: Positive = Field(description="Learning rate of the actor; falls to a twentieth.")
    critic_lr: Positive = Field(description="Learning rate of the critic.")
    max_grad_norm: Positive = Field(description="Where the norm of a gradient is cut.")
    actor_average: Decay = Field(
        description="What the averaged actor, which is saved, keeps of itself at an update."
    )


class Evaluation(schema.Evaluation):
    """Where the policy was evaluated, unless it is said."""

    scene: SceneField | None = Field(
        description="Scenes in which evaluations take place; null is as for the policy."
    )


class Config(Section):
    """MO-PPO."""

    policy: PolicyFolder | None = Field(
        description="Folder of the policy to start from; null starts from nothing."
    )
    resume: RunFolder | None = Field(
        description="Folder of a run that did not end; it goes on there, as it was configured."
    )
    seed: Seed = Field(description="Seed of networks, environments and preferences.")
    device: Device = Field(description="Where networks are trained.")
    compute: Compute
    env: Env
    demonstrations: Demonstrations
    preference: Preference
    collector: Collector
    replay_buffer: ReplayBuffer
    network: schema.Network
    loss: Loss
    optim: Optim
    evaluation: Evaluation
    logger: schema.Backends

    @model_validator(mode="after")
    def _fits_together(self) -> Config:
        frames = self.collector.frames_per_batch
        schema.check_batches(frames, self.env.num_envs)
        schema.check_segments(self.preference.num_segments, self.env.num_envs)
        if not 1 <= self.optim.batch_size <= frames:
            raise ValueError(
                "optim.batch_size must lie between 1 and collector.frames_per_batch, "
                f"{frames}, got {self.optim.batch_size}."
            )
        return self
