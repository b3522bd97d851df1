"""What every configuration of MO-PPO allows, on navigation and on any other problem."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from . import schema
from .fields import (
    Allows,
    Count,
    CountOrNone,
    Decay,
    Discount,
    Distribution,
    Positive,
    Section,
    Share,
    Size,
)


class Compute(schema.Compute):
    """With mixed precision."""

    bfloat16: bool | None = Field(
        description="Mixed precision of the updates; null is where the processor multiplies bfloat16."
    )


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


class ReplayBuffer(Section):
    """How experience is kept."""

    reward_scale: Positive = Field(description="Factor on the rewards; keeps returns within tens.")


class Loss(Section):
    """PPO's."""

    gamma: Discount = Field(description="Discount of a step.")
    lmbda: Share = Field(description="Lambda of generalized advantage estimation.")
    final_lmbda: Share | None = Field(
        description="The same at the end, linearly between them; null is no change."
    )
    level_preferences: bool = Field(
        description="Whether advantages are divided by their usual size at a preference."
    )
    truncation_is_terminal: bool = Field(description="Whether returns end where the time is up.")
    clip_epsilon: float = Field(
        gt=0, lt=1, description="How far the likelihood of an action may move, as a share."
    )


class Optim(Section):
    """How networks are updated."""

    critic_batches: CountOrNone = Field(
        description="Batches of frames at the start for the critic alone."
    )
    critic_epochs: Count = Field(description="Passes over each of those.")
    epochs: Count = Field(description="Passes over each batch of frames after them.")
    batch_size: Annotated[int, Allows("a whole number from 1 to collector.frames_per_batch")] = (
        Field(description="Transitions of an update.")
    )
    lr: Positive = Field(description="Learning rate of the actor; falls to a twentieth.")
    critic_lr: Positive = Field(description="Learning rate of the critic.")
    max_grad_norm: Positive = Field(description="Where the norm of a gradient is cut.")
    actor_average: Decay = Field(
        description="What the averaged actor, which is saved, keeps of itself at an update."
    )


def check_batch_size(batch_size: int, frames_per_batch: int) -> None:
    """Refuse small batches that a batch of frames does not have.

    Raises:
        ValueError: for fewer than one or more than those.
    """
    if not 1 <= batch_size <= frames_per_batch:
        raise ValueError(
            "optim.batch_size must lie between 1 and collector.frames_per_batch, "
            f"{frames_per_batch}, got {batch_size}."
        )
