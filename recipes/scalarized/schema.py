"""What the configurations of the baselines allow; ``common.yaml``, ``td3.yaml``, ``sac.yaml`` have the defaults."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from recipes.training import schema
from recipes.training.fields import Allows, Positive


class TD3Config(schema.OffPolicy):
    """TD3-PR and CORE."""

    objective: Literal["preference", "core"] = Field(
        description="All objectives as the preference weighs them, or the core reward alone."
    )
    compute: schema.Compute
    collector: schema.NoisyCollector
    network: schema.Network
    loss: schema.TD3Loss
    optim: schema.TD3Optim


class SACLoss(schema.Loss):
    """With a temperature."""

    alpha_init: Positive = Field(description="Temperature of the entropy at the start.")


class SACNetwork(schema.Network):
    """With a standard deviation."""

    initial_scale: Positive = Field(
        description="Standard deviation of the untrained policy before its tanh."
    )
    min_scale: Annotated[float, Allows("a number in (0, network.initial_scale)")] = Field(
        description="The smallest standard deviation."
    )

    @model_validator(mode="after")
    def _starts_above_the_smallest(self) -> SACNetwork:
        if not 0 < self.min_scale < self.initial_scale:
            raise ValueError(
                "network.min_scale must be in (0, network.initial_scale), "
                f"(0, {self.initial_scale}), got {self.min_scale}."
            )
        return self


class SACConfig(schema.OffPolicy):
    """SAC-PR."""

    compute: schema.Compute
    network: SACNetwork
    loss: SACLoss
    optim: schema.Optim
