"""What the configuration of MO-PPO allows; ``config.yaml`` has the defaults."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from recipes.training import ppo_schema, schema, worker_schema
from recipes.training.fields import (
    Allows,
    Count,
    CountOrNone,
    DemonstrationFile,
    Device,
    NotNegative,
    NotPositive,
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
)


def _some_noise(sigma: list[float]) -> list[float]:
    if len(sigma) != 2 or min(sigma) <= 0:
        raise ValueError(
            "must be positive, for speed and turn rate, since without noise there is nothing to "
            f"compare, got {sigma}."
        )
    return sigma


class Env(schema.Env):
    """Null is as in the training of the policy."""

    scene: SceneField | None = Field(
        description="Scenes in which it trains; null is where the policy was evaluated."
    )
    robot: RobotField | None = Field(
        description="The robot, any draws one for every episode; null is that of the policy."
    )
    observe_human: bool | None = Field(
        description="Whether the policy knows where the human is; null is as it was trained."
    )
    observe_human_velocity: bool | None = Field(
        description="Whether the policy knows the human's velocity; null is as it was trained."
    )
    observe_nobody: bool | None = Field(
        description="Whether the policy knows that nobody is there; null is as it was trained."
    )
    observe_robot: bool | None = Field(
        description="Whether the policy knows which robot it drives; null is as it was trained."
    )
    observe_motion: bool | None = Field(
        description="Whether the policy knows how it moves, and its last commands; null is as it was trained."
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
    standing_only: bool = Field(
        description="Whether the style pays only where somebody stands, as in what was demonstrated."
    )
    collision_reward: NotPositive = Field(
        description="Added to the objective demo for a collision, if there is one, beside what all preferences pay."
    )

    @model_validator(mode="after")
    def _have_an_objective(self) -> Demonstrations:
        if self.dataset is not None and self.reward_model is None:
            raise ValueError(
                f"demonstrations.dataset needs demonstrations.reward_model, got {self.dataset!r} and "
                'None: without one there is no objective "demo" for them.'
            )
        return self


class Collector(worker_schema.Workers, ppo_schema.Collector):
    """With noise on each entry of the action."""

    exploration_sigma: Annotated[
        list[float], AfterValidator(_some_noise), Allows("two positive numbers")
    ] = Field(
        description="Standard deviation of the noise on speed and turn rate, of actions in [-1, 1]."
    )
    final_exploration_sigma: Annotated[
        list[float], AfterValidator(_some_noise), Allows("two positive numbers")
    ] = Field(description="The same at the end; between them it falls geometrically.")


class Loss(ppo_schema.Loss):
    """With what the actor pays for beside its returns."""

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
    mirror_coeff: NotNegative = Field(
        description="Cost of doing otherwise in the mirror image, where the style is not preferred."
    )
    elsewhere_coeff: NotNegative = Field(
        description="Cost of following a style where nobody stands; needs demonstrations.standing_only."
    )
    final_elsewhere_coeff: NotNegative | None = Field(
        description="In the end, where it goes linearly to another one; null: the same throughout."
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


class Optim(ppo_schema.Optim):
    """With cloning, and penalties on a part of a batch."""

    cloning_updates: CountOrNone = Field(
        description="Updates of behaviour cloning before everything else, of a training from nothing."
    )
    cloning_speed: Share = Field(
        description="Share of the top speed at which the clone drives with all weight on efficiency."
    )
    penalty_batch_size: Count = Field(
        description="Transitions of an update that anchor and smoothness are taken of."
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
    compute: ppo_schema.Compute
    env: Env
    demonstrations: Demonstrations
    preference: ppo_schema.Preference
    collector: Collector
    replay_buffer: ppo_schema.ReplayBuffer
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
        worker_schema.check_workers(self.collector, self.env.num_envs, self.preference.num_segments)
        ppo_schema.check_batch_size(self.optim.batch_size, frames)
        for name in ("elsewhere_coeff", "final_elsewhere_coeff"):
            value = getattr(self.loss, name)
            if value and not self.demonstrations.standing_only:
                raise ValueError(
                    f"loss.{name} must be 0 without demonstrations.standing_only=true, got {value}: the "
                    "style pays everywhere."
                )
        return self
