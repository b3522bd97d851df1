"""What a configuration allows of the processes that collect, in this machine or in others."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, StringConstraints, model_validator

from .fields import Allows, Section

Address = Annotated[str, StringConstraints(pattern=r"^(auto|.+:\d+)$"), Allows("auto or HOST:PORT")]


_WITHOUT_WORKERS = {"num_workers": 1, "worker_cpus": 1, "ray_address": None}
"""What only workers of Ray read, and what it is where there are none."""


class Workers(Section):
    """Who collects: the process of the training, or workers of Ray."""

    backend: Literal["direct", "ray"] = Field(
        description="Who collects: the process of the training, or workers of Ray."
    )
    num_workers: int = Field(
        ge=1,
        le=1024,
        description="Workers of Ray; each has its part of the environments.",
    )
    worker_cpus: int = Field(
        ge=1,
        le=1024,
        description="CPUs that each worker reserves: threads of its simulator and of PyTorch.",
    )
    ray_address: Address | None = Field(
        description="Ray cluster to join; null is that of RAY_ADDRESS, or one on this machine alone."
    )

    @model_validator(mode="after")
    def _workers_have_an_effect(self) -> Workers:
        if self.backend == "direct":
            for name, default in _WITHOUT_WORKERS.items():
                if (value := getattr(self, name)) != default:
                    raise ValueError(
                        f"collector.{name} must be {'null' if default is None else default} with "
                        "collector.backend=direct, where the process of the training collects, "
                        f"got {value}: give collector.backend=ray."
                    )
        return self


def check_workers(
    collector: Workers, num_envs: int, num_segments: int | None, field: str = "env.num_envs"
) -> None:
    """Refuse environments that cannot be shared among the workers.

    Args:
        collector: that section of the configuration.
        num_envs: all of them.
        num_segments: of the preferences, each of which needs an environment of every worker.
        field: that says how many environments there are.

    Raises:
        ValueError: unless every worker has as many, and one for each segment.
    """
    each, rest = divmod(num_envs, collector.num_workers)
    if rest:
        raise ValueError(
            f"collector.num_workers must divide {field}, {num_envs}, got {collector.num_workers}."
        )
    if num_segments is not None and num_segments > each:
        raise ValueError(
            f"preference.num_segments must be at most {field} of each worker, {each}, got {num_segments}."
        )
