"""What the configuration of PD-MORL allows; ``config.yaml`` has the defaults."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from recipes.training import schema
from recipes.training.fields import CountOrNone, Decay, NotNegative


class Compute(schema.Compute):
    """With compilation and mixed precision."""

    compile: bool = Field(description="Whether losses and their gradients are compiled.")
    compile_mode: Literal[
        "default", "lite", "reduce-overhead", "max-autotune-no-cudagraphs", "max-autotune"
    ] = Field(description="Mode of torch.compile; on a GPU reduce-overhead is CUDA graphs.")
    bfloat16: bool | None = Field(
        description="Mixed precision of the updates; null is where the processor multiplies bfloat16."
    )


class Preference(schema.Preference):
    """With the forms of PD-MORL's code."""

    slabs: bool = Field(
        description="Whether those parts are slabs of the first weight, as in PD-MORL's code."
    )
    relabel_copies: CountOrNone = Field(
        description="Copies with other preferences that the buffer keeps of a transition, as in "
        "PD-MORL's code; 0 relabels at sample time."
    )

    @model_validator(mode="after")
    def _relabels_once(self) -> Preference:
        if self.relabel_copies and self.relabel_ratio:
            raise ValueError(
                "preference.relabel_ratio must be 0 with preference.relabel_copies, which relabel "
                f"what is stored, got {self.relabel_ratio} and {self.relabel_copies}."
            )
        return self


class Network(schema.Network):
    """With a head start."""

    straight_drive: bool = Field(
        description="Whether critics learn what is left of the value of driving straight."
    )


class Loss(schema.TD3Loss):
    """The vector-Q loss of TD3 with the angle term."""

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
    def _angle_has_an_effect(self) -> Loss:
        coefficients = self.angle_coeff_actor, self.angle_coeff_critic
        if self.angle is None and any(coefficients):
            raise ValueError(
                "an angle coefficient has no effect without loss.angle: loss.angle_coeff_actor and "
                f"loss.angle_coeff_critic must be 0 with loss.angle=null, got {coefficients}."
            )
        return self


class Evaluation(schema.Evaluation):
    """With the key solutions of the interpolator."""

    refit_momentum: Decay = Field(
        description="What the interpolator keeps of its key solutions at an evaluation."
    )


class Config(schema.OffPolicy):
    """PD-MORL."""

    compute: Compute
    preference: Preference
    collector: schema.NoisyCollector
    network: Network
    loss: Loss
    optim: schema.TD3Optim
    evaluation: Evaluation
