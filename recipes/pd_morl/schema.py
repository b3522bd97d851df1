"""What the configuration of PD-MORL allows; ``config.yaml`` has the defaults."""

from __future__ import annotations

from pydantic import Field, model_validator

from recipes.training import schema, worker_schema
from recipes.training.fields import CountOrNone, Decay


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


class Collector(worker_schema.Workers, schema.NoisyCollector):
    """With workers."""


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
    preference: Preference
    collector: Collector
    network: Network
    loss: schema.AngleLoss
    optim: schema.TD3Optim
    evaluation: Evaluation

    @model_validator(mode="after")
    def _workers_share_the_environments(self) -> Config:
        worker_schema.check_workers(self.collector, self.env.num_envs, self.preference.num_segments)
        return self
