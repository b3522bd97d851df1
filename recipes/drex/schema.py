"""What the configuration of D-REX allows; ``config.yaml`` has the defaults."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from envs import get_robots
from envs.policy_env import observed
from envs.robot_ranges import largest
from recipes.training.fields import (
    Allows,
    Count,
    CountOrNone,
    DemonstrationFile,
    Layers,
    NotNegative,
    PartialShare,
    Positive,
    Range,
    RobotField,
    RunFolder,
    SceneField,
    Section,
    Seed,
    Share,
    Size,
    different,
)
from torchrl_morl.deploy.features import observation_parts

from .styles import NUM_STYLES

Input = Literal["lidar", "goal", "human", "human_velocity", "nobody", "robot", "action"]


class Env(Section):
    """Where is driven."""

    scene: SceneField = Field(description="Where demonstrations and rollouts take place.")
    robot: RobotField = Field(description="The robot that drives; any draws one for every episode.")
    observe_human: bool = Field(description="Whether clone and R know where the human is.")
    observe_human_velocity: bool = Field(
        description="Whether clone and R know the human's velocity."
    )
    observe_nobody: bool = Field(description="Whether clone and R know that nobody is there.")
    observe_robot: bool = Field(description="Whether clone and R know which robot it is.")
    num_threads: CountOrNone = Field(description="Threads of the simulator; 0 is every CPU.")


class Demonstrations(Section):
    """What is demonstrated."""

    dataset: DemonstrationFile | None = Field(
        description="Your own: a file of recipes.import_demonstrations; null is the scripted circle."
    )
    count: Size = Field(description="How many the scripted circle gives.")
    batch: Size = Field(description="Rollouts at once; those that collide are dropped.")
    radius: Positive = Field(description="Radius of the circle around the human, metres.")
    side: Literal["left", "right"] = Field(description="Side on which the human is passed.")
    speed: Positive = Field(description="Speed of the demonstrator, m/s, at most the robot's.")


class Cloning(Section):
    """The behaviour clone."""

    num_cells: Layers = Field(description="Neurons of each hidden layer.")
    lr: Positive = Field(description="Learning rate of Adam.")
    batch_size: Size = Field(description="Steps of an update.")
    updates: Count = Field(description="Updates at most.")
    held_out: PartialShare = Field(description="Share of the demonstrations that check it.")
    patience: Count = Field(description="Checks of 250 updates without a better loss.")


class Noise(Section):
    """Rollouts of the clone under noise."""

    levels: Annotated[
        list[Share],
        Field(min_length=1, max_length=100),
        AfterValidator(different),
        Allows("a list of shares in [0, 1]"),
    ] = Field(description="Shares of the steps that are random.")
    rollouts: int = Field(ge=2, le=100_000, description="Rollouts of each level.")
    hold: Count = Field(description="Steps that a random action lasts.")


class StyleNegatives(Section):
    """Other ways to drive."""

    rollouts: CountOrNone = Field(
        description=f"Shared by {NUM_STYLES} styles, at least {2 * NUM_STYLES}; 0 is plain D-REX."
    )
    radii: Annotated[list[Range], Field(min_length=1), Allows("a list of pairs of radii")] = Field(
        description="Ranges of the radii of other orbits, metres."
    )
    detours: Range = Field(description="Range of the radii of the shortest ways around, metres.")
    min_frechet: NotNegative = Field(
        description="Frechet distance below which a drive is no other style, metres."
    )

    @model_validator(mode="after")
    def _has_some_of_each(self) -> StyleNegatives:
        if 0 < self.rollouts < 2 * NUM_STYLES:
            raise ValueError(
                f"style_negatives.rollouts must be 0 or at least {2 * NUM_STYLES}, one to train on "
                f"and one to hold out for each of {NUM_STYLES} styles, got {self.rollouts}."
            )
        return self


class Tracking(Section):
    """Drives along the demonstrated paths, and beside them, under the noise of a learner."""

    rollouts: CountOrNone = Field(
        description="Drives along the paths, and as many beside them; 0 is plain D-REX, else at least 2."
    )
    noise: Annotated[list[NotNegative], Field(min_length=2, max_length=2)] = Field(
        description="Standard deviation of the most noise on speed and turn rate, of actions in [-1, 1]."
    )
    heights: Range = Field(
        description="Range of how far a path beside them is pushed away, metres."
    )
    widths: Range = Field(description="Range of how long that is, standard deviations, metres.")

    @model_validator(mode="after")
    def _has_some_to_hold_out(self) -> Tracking:
        if self.rollouts == 1:
            raise ValueError(
                "tracking.rollouts must be 0 or at least 2, one to train on and one to hold out, got 1."
            )
        return self


class RewardModel(Section):
    """R."""

    inputs: Annotated[list[Input], Field(min_length=1), AfterValidator(different)] = Field(
        description="What R knows of what is observed."
    )
    num_cells: Layers = Field(description="Neurons of each hidden layer.")
    num_members: int = Field(ge=1, le=100, description="Networks whose mean R is.")
    snippet_length: int = Field(
        ge=1, le=300, description="Steps of 0.2 s that are compared at once."
    )
    min_gap: float = Field(
        gt=0, le=1, description="Least distance of two noise levels that are compared."
    )
    near_human: Positive = Field(
        description="Distance from the human within which pairs of styles start, metres."
    )
    batch_size: int = Field(ge=2, le=100_000, description="Pairs of an update.")
    updates: Count = Field(description="Updates of R.")
    lr: Positive = Field(description="Learning rate of AdamW at the start.")
    final_lr_ratio: Share = Field(
        description="Learning rate at the end as a share of that at the start; a cosine between."
    )
    weight_decay: NotNegative = Field(description="Weight decay of AdamW.")
    label_smoothing: float = Field(
        ge=0, lt=1, description="How much of a label is given to the other side."
    )
    demonstration_coeff: NotNegative = Field(
        description="How much it costs that R of a demonstrated step is not 1; 0 is plain D-REX."
    )
    action_noise: NotNegative = Field(
        description="Standard deviation of the most noise on the actions that R reads while it learns."
    )
    held_out: PartialShare = Field(description="Share of the rollouts that check R.")


class Diagnostics(Section):
    """What is measured at the end."""

    rollouts: int = Field(ge=2, le=100_000, description="Rollouts of each style and level.")


class Config(Section):
    """D-REX."""

    resume: RunFolder | None = Field(
        description="Folder of a run that did not end; it goes on there, as it was configured."
    )
    seed: Seed = Field(description="Seed of networks, scenes and noise.")
    torch_threads: int = Field(ge=1, le=1024, description="Threads that PyTorch computes with.")
    bfloat16: bool | None = Field(
        description="Mixed precision of R's updates; null is where the processor multiplies bfloat16."
    )
    env: Env
    demonstrations: Demonstrations
    cloning: Cloning
    noise: Noise
    style_negatives: StyleNegatives
    tracking: Tracking
    reward_model: RewardModel
    diagnostics: Diagnostics

    @model_validator(mode="after")
    def _fits_together(self) -> Config:
        fastest = largest(get_robots(self.env.robot)).max_speed
        if self.demonstrations.speed > fastest:
            raise ValueError(
                f"demonstrations.speed must be in (0, {fastest}] m/s, the robot's, "
                f"got {self.demonstrations.speed}."
            )
        if max(self.noise.levels) < self.reward_model.min_gap:
            raise ValueError(
                "noise.levels must have one of at least reward_model.min_gap, "
                f"{self.reward_model.min_gap}, got {self.noise.levels}: demonstrations are only "
                "compared with those."
            )
        seen = {
            *observation_parts(**observed(self.env.model_dump())),
            "action",
        }
        if not seen & set(self.reward_model.inputs):
            raise ValueError(
                f"reward_model.inputs must be some of {sorted(seen)}, which env lets it observe, "
                f"got {self.reward_model.inputs}."
            )
        return self
