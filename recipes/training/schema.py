"""What the configurations of the trainings share: every section with its fields, their ranges and what they mean.

The YAML files beside the recipes hold the defaults; here stands what is allowed.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from .fields import (
    Amount,
    Backend,
    Count,
    CountOrNone,
    Decay,
    DemonstrationFile,
    Device,
    Discount,
    Distribution,
    Layers,
    LoggerArguments,
    LossFunction,
    NotNegative,
    Objectives,
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
    ValidationSeed,
    checked_faults,
    different,
)

Threads = Count


class Faults(Section):
    """Of sensors and actuation; see :class:`envs.Faults`."""

    range_noise: Amount = Field(
        0.0, description="Standard deviation of each lidar range, metres, not negative."
    )
    dropout: Amount = Field(0.0, description="Probability that a lidar ray reports no return.")
    velocity_noise: Amount = Field(
        0.0, description="Standard deviation of the executed velocities, as a share of their range."
    )
    latency: Amount = Field(
        0, description="Control steps of 0.2 s between a command and its execution, 0 to 3."
    )
    invalid_beams: Amount = Field(
        0.0, description="Probability that a lidar ray is invalid, coded otherwise in each episode."
    )
    unknown_angle: Amount = Field(
        0.0, description="Part of the view whose rays are all invalid, radians."
    )
    speed_scale: Amount = Field(1.0, description="Executed over commanded speed, at most 2.")
    turn_scale: Amount = Field(1.0, description="Executed over commanded turn rate, at most 2.")
    lag: Amount = Field(
        0.0, description="Time constant with which the base follows a command, seconds."
    )
    goal_drift: Amount = Field(0.0, description="How far the reported goal strays, metres.")
    human_noise: Amount = Field(
        0.0, description="Standard deviation of each coordinate of the reported human, metres."
    )
    human_bias: Amount = Field(
        0.0, description="How far all reports of an episode are off to one side, metres."
    )
    human_lost: Amount = Field(0.0, description="Share of the time in which nobody is reported.")

    @model_validator(mode="after")
    def _in_their_ranges(self) -> Faults:
        checked_faults(self.model_dump(exclude_unset=True))
        return self


class Env(Section):
    """Where an agent trains."""

    scene: SceneField = Field(description="Scenes in which it trains.")
    robot: RobotField = Field(
        description="The robot that is trained; any draws one for every episode."
    )
    observe_human: bool = Field(description="Whether the policy knows where the human is.")
    observe_human_velocity: bool = Field(
        description="Whether the policy knows the human's velocity, for humans who walk."
    )
    observe_nobody: bool = Field(
        description="Whether the policy knows that nobody is there, for scenes without anybody."
    )
    observe_robot: bool = Field(
        description="Whether the policy knows which robot it drives, for robots that differ."
    )
    drive: Literal["planar", "wheels"] = Field(
        description="Velocity servos, or wheels with rolling contact, several times dearer."
    )
    goal_radius: Positive = Field(description="Distance at which the goal is reached, metres.")
    max_episode_steps: Count = Field(description="Steps of 0.2 s before an episode is truncated.")
    num_envs: Size = Field(description="Robots that drive at once.")
    num_threads: CountOrNone = Field(description="Threads of the simulator; 0 is every CPU.")
    faults: Faults = Field(description="Faults of sensors and actuation.")
    objectives: Objectives = Field(
        description="Objectives of the reward, the one that always counts once first."
    )
    rewards: Rewards = Field(description="Constants of the rewards that differ from the defaults.")


class Demonstrations(Section):
    """What was demonstrated."""

    reward_model: RewardModelFolder | None = Field(
        description='Folder of a reward model of recipes.drex, which adds the objective "demo".'
    )
    dataset: DemonstrationFile | None = Field(
        description="Demonstrations of recipes.drex, put into the replay buffer before training."
    )
    prefill: Count = Field(description="How many of those demonstrations.")

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
    relabel_distribution: Distribution = Field(
        description="Distribution from which relabelled transitions draw their preference."
    )
    relabel_ratio: Share = Field(
        description="Share of a batch whose preference is redrawn at sample time."
    )


class Collector(Section):
    """How experience is collected."""

    total_frames: Count = Field(
        description="Steps of the whole training; the last batch is a whole one."
    )
    frames_per_batch: Size = Field(description="Steps between updates, over all environments.")
    init_random_frames: CountOrNone = Field(
        description="Steps of random actions before the first update."
    )


class NoisyCollector(Collector):
    """The same with noise on the actions."""

    exploration_sigma: NotNegative = Field(
        description="Standard deviation of the noise at the start, of actions in [-1, 1]."
    )
    final_exploration_sigma: NotNegative = Field(
        description="The same at the end of the training; between them it falls linearly."
    )

    @model_validator(mode="after")
    def _falls(self) -> NoisyCollector:
        if self.final_exploration_sigma > self.exploration_sigma:
            raise ValueError(
                "collector.final_exploration_sigma must be at most collector.exploration_sigma, "
                f"{self.exploration_sigma}, got {self.final_exploration_sigma}."
            )
        return self


class ReplayBuffer(Section):
    """What is kept of the experience."""

    size: int = Field(ge=1, le=1_000_000_000, description="Transitions that it keeps.")
    batch_size: Size = Field(description="Transitions of an update.")
    reward_scale: Positive = Field(description="Factor on the rewards; keeps returns within tens.")


class Network(Section):
    """Sizes of the networks."""

    num_cells: Layers = Field(description="Neurons of each hidden layer.")
    critic_layer_norm: bool = Field(description="Whether the critics normalise their layers.")


class Loss(Section):
    """What critics learn."""

    gamma: Discount = Field(description="Discount of a step of 0.2 s.")
    truncation_is_terminal: bool = Field(
        description="Whether returns end where the time is up, as in PD-MORL's code."
    )
    loss_function: LossFunction = Field(description="Between values and their targets.")


class TD3Loss(Loss):
    """Target smoothing beside it."""

    policy_noise: NotNegative = Field(
        description="Standard deviation of the target smoothing, in units of half the action's range."
    )
    noise_clip: NotNegative = Field(description="Where that noise is cut, in the same units.")


class AngleLoss(TD3Loss):
    """The vector-Q loss of PD-MORL: with the angle term."""

    target_selection: Literal["utility", "elementwise"] = Field(
        description="The smaller of two target critics, by utility or entry by entry."
    )
    angle: Literal["normalized", "raw"] | None = Field(
        description="Space of the values between which the angle is taken; null is no angle."
    )
    interpolated: bool = Field(
        description="Angle to the interpolated solutions, or straight along the preference."
    )
    angle_coeff_actor: NotNegative = Field(description="Factor on the angle in the actor's loss.")
    angle_coeff_critic: NotNegative = Field(description="The same in the critics' loss.")
    pre_tanh_coeff: NotNegative = Field(
        description="Factor on the square of the actor's output before its tanh, at the start."
    )
    final_pre_tanh_coeff: NotNegative = Field(
        description="The same at the end; between them it falls geometrically."
    )

    @model_validator(mode="after")
    def _angle_has_an_effect(self) -> AngleLoss:
        coefficients = self.angle_coeff_actor, self.angle_coeff_critic
        if self.angle is None and any(coefficients):
            raise ValueError(
                "an angle coefficient has no effect without loss.angle: loss.angle_coeff_actor and "
                f"loss.angle_coeff_critic must be 0 with loss.angle=null, got {coefficients}."
            )
        return self


class Optim(Section):
    """How networks are updated."""

    updates_per_batch: Size = Field(description="Updates after a batch of frames.")
    lr: Positive = Field(description="Learning rate of Adam at the start.")
    final_lr_ratio: Share = Field(
        description="Learning rate at the end as a share of that at the start; a cosine between."
    )
    polyak: Decay = Field(description="What the target networks keep of themselves at an update.")
    max_grad_norm: Positive = Field(description="Where the norm of a gradient is cut.")
    actor_average: Decay = Field(
        description="What the averaged actor, which is saved, keeps of itself at an update."
    )


class TD3Optim(Optim):
    """The actor waits for the critics."""

    policy_delay: Count = Field(description="Updates of the critics for each of the actor.")


class Evaluation(Section):
    """Evaluations while training."""

    interval: Count = Field(description="Frames between evaluations.")
    scene: SceneField = Field(description="Scenes in which evaluations take place.")
    episodes: Size = Field(description="Episodes of each preference.")
    seed: ValidationSeed = Field(description="Seed of the scenes of evaluations.")


class Backends(Section):
    """Where scalars are written."""

    backends: Annotated[list[Backend], AfterValidator(different)] = Field(
        description="Loggers that record the training."
    )
    arguments: LoggerArguments = Field(
        description="Arguments of loggers, such as {wandb: {offline: true, project: mine}}."
    )

    @model_validator(mode="after")
    def _arguments_of_backends(self) -> Backends:
        if other := [name for name in self.arguments if name not in self.backends]:
            raise ValueError(
                f"logger.arguments are for {other[0]}, which is not among logger.backends, "
                f"{self.backends}: add it there."
            )
        return self


class Logger(Backends):
    """The same, and how often."""

    interval: Count = Field(description="Frames between records of the training.")


class Compute(Section):
    """What a training computes with."""

    torch_threads: int = Field(ge=1, le=1024, description="Threads that PyTorch computes with.")


class CompiledCompute(Compute):
    """With compilation and mixed precision."""

    compile: bool = Field(description="Whether losses and their gradients are compiled.")
    compile_mode: Literal[
        "default", "lite", "reduce-overhead", "max-autotune-no-cudagraphs", "max-autotune"
    ] = Field(description="Mode of torch.compile; on a GPU reduce-overhead is CUDA graphs.")
    bfloat16: bool | None = Field(
        description="Mixed precision of the updates; null is where the processor multiplies bfloat16."
    )


class OffPolicy(Section):
    """What all off-policy trainings share."""

    resume: RunFolder | None = Field(
        description="Folder of a run that did not end; it goes on there, as it was configured."
    )
    seed: Seed = Field(description="Seed of networks, environments and preferences.")
    device: Device = Field(description="Where networks are trained.")
    env: Env
    demonstrations: Demonstrations
    preference: Preference
    collector: Collector
    replay_buffer: ReplayBuffer
    evaluation: Evaluation
    logger: Logger

    @model_validator(mode="after")
    def _fits_together(self) -> OffPolicy:
        check_batches(self.collector.frames_per_batch, self.env.num_envs)
        check_segments(self.preference.num_segments, self.env.num_envs)
        check_experience(self.collector, self.replay_buffer)
        return self


def check_batches(frames_per_batch: int, num_envs: int) -> None:
    """Refuse batches that some environments would not fill.

    Raises:
        ValueError: unless every environment takes as many steps.
    """
    if frames_per_batch % num_envs:
        raise ValueError(
            f"collector.frames_per_batch must be a multiple of env.num_envs, {num_envs}, "
            f"got {frames_per_batch}."
        )


def check_segments(num_segments: int | None, num_envs: int) -> None:
    """Refuse segments that no environment would draw from.

    Raises:
        ValueError: for more segments than environments.
    """
    if num_segments is not None and num_segments > num_envs:
        raise ValueError(
            f"preference.num_segments must be at most env.num_envs, {num_envs}, got {num_segments}."
        )


def check_experience(collector: Collector, replay_buffer: ReplayBuffer) -> None:
    """Refuse a training that learns nothing, or a buffer that does not hold a batch.

    Raises:
        ValueError: if there are no steps behind the random ones, or for too small a buffer.
    """
    if collector.total_frames <= collector.init_random_frames:
        raise ValueError(
            "collector.total_frames must be greater than collector.init_random_frames, "
            f"{collector.init_random_frames}, got {collector.total_frames}: nothing is learned "
            "before."
        )
    if replay_buffer.size < collector.frames_per_batch:
        raise ValueError(
            "replay_buffer.size must be at least collector.frames_per_batch, "
            f"{collector.frames_per_batch}, got {replay_buffer.size}."
        )
