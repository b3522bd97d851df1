"""What the configuration of PD-MORL allows; ``config.yaml`` has the defaults."""

from __future__ import annotations

from pydantic import Field

from recipes.training import schema
from recipes.training.fields import Decay


class Network(schema.Network):
    """With a head start."""

    straight_drive: bool = Field(
        description="Whether critics learn what is left of the value of driving straight."
    )


class Evaluation(schema.Evaluation):
    """With the key solutions of the interpolator."""

    refit_momentum: Decay = Field(
        description="What the interpolator keeps of its key solutions at an evaluation."
    )


class Config(schema.OffPolicy):
    """PD-MORL."""

    compute: schema.CompiledCompute
    collector: schema.NoisyCollector
    network: Network
    loss: schema.AngleLoss
    optim: schema.TD3Optim
    evaluation: Evaluation
