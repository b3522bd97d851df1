"""Types of the fields of a configuration: what each allows, said once for the check, the error and the help."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StringConstraints

from envs import get_robots, get_scene
from envs.faults import get_faults
from envs.objectives import check_objectives, get_rewards
from envs.splits import VALIDATION_SEEDS
from recipes.objectives import reward_objectives
from recipes.policy_folders import no_policy


class Section(BaseModel):
    """A part of a configuration: no field but its own, no number given as text, neither NaN nor infinity."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


@dataclasses.dataclass(frozen=True)
class Allows:
    """What a field allows, where its type and range do not say so."""

    text: str


@dataclasses.dataclass(frozen=True)
class MayImport:
    """A value with a colon imports a module: the user says so, no folder that somebody else has made."""


@dataclasses.dataclass(frozen=True)
class IsPath:
    """The field is a path; if there is a ``kind``, something of that kind must be there.

    Args:
        kind: "policy" and "reward_model" are folders with weights and card, "run" is a folder with
            what a recipe wrote, "file" is a file; ``None`` is not looked for.
    """

    kind: Literal["policy", "reward_model", "run", "file"] | None = None

    def check(self, field: str, value: str) -> None:
        """Look for it.

        Raises:
            ValueError: if it is not there; names the field and the path.
        """
        path = Path(value)
        if self.kind == "policy" and (why := no_policy(path)):
            raise ValueError(f"{field}={value}: {why}.")
        if self.kind == "reward_model":
            weights, card = (f"{self.kind}.{ending}" for ending in ("safetensors", "json"))
            for file in (path / weights, path / card):
                if not file.is_file():
                    raise ValueError(
                        f"{field}={value}: {file} not found: a {self.kind.replace('_', ' ')} is a "
                        f"folder with {weights} and {card}."
                    )
        elif self.kind == "run" and not (path / ".hydra" / "overrides.yaml").is_file():
            raise ValueError(
                f"{field}={value} is no run: it must be the folder of one that has begun."
            )
        elif self.kind == "file" and not path.is_file():
            raise ValueError(f"{field}={value}: there is no such file.")


def _known(get: Callable[[Any], object]) -> AfterValidator:
    """Accepts what a function accepts, whatever it raises otherwise."""

    def check(value: Any) -> Any:
        if isinstance(value, bool) or not isinstance(value, str | dict):
            raise ValueError(f"must be a name, a .yaml file or a mapping, got {value!r}.")
        try:
            get(value)
        except (ValueError, TypeError, KeyError, AttributeError, OSError) as error:
            raise ValueError(str(error)) from error
        return value

    return AfterValidator(check)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _number_or_pair(value: Any) -> Any:
    ends = value if isinstance(value, list) else [value, value]
    if len(ends) != 2 or not all(map(_is_number, ends)) or not ends[0] <= ends[1]:
        raise ValueError(f"must be a number or a pair in ascending order, got {value!r}.")
    return value


def _in_float32(value: float) -> float:
    """Beyond it tensors would hold zero or infinity."""
    if not 1.2e-38 <= value <= 3.4e38:
        raise ValueError(
            f"must be a positive number that float32 holds, 1.2e-38 to 3.4e+38, got {value!r}."
        )
    return value


def _zero_or_in_float32(value: float) -> float:
    """The same of a number that may be zero, or negative."""
    if value and not 1.2e-38 <= abs(value) <= 3.4e38:
        raise ValueError(
            f"must be 0 or a number that float32 holds, 1.2e-38 to 3.4e+38, got {value!r}."
        )
    return value


def _ascending(value: list[float]) -> list[float]:
    if value[0] > value[1]:
        raise ValueError(f"must be a pair in ascending order, got {value!r}.")
    return value


def _objectives(names: list[str]) -> list[str]:
    reward_objectives(check_objectives(names), with_demonstrations=False)
    return names


def _rewards(constants: dict[str, Any]) -> dict[str, Any]:
    get_rewards(constants)
    return constants


def different(value: list) -> list:
    if repeated := [one for place, one in enumerate(value) if one in value[:place]]:
        raise ValueError(f"must not repeat {repeated[0]!r}, got {value!r}.")
    return value


Count = Annotated[int, Field(ge=1)]
"""A whole number from one."""

CountOrNone = Annotated[int, Field(ge=0)]
"""A whole number from zero."""

Size = Annotated[int, Field(ge=1, le=100_000)]
"""How many of something that takes memory."""

Seed = Annotated[int, Field(ge=0, le=2**31 - 1)]
"""Of random generators; stages and workers add to it."""

ValidationSeed = Annotated[int, Field(ge=VALIDATION_SEEDS.start, le=VALIDATION_SEEDS[-1])]
"""Its scenes are neither those of trainings nor those of results."""

Positive = Annotated[float, Field(gt=0), AfterValidator(_in_float32)]
NotNegative = Annotated[float, Field(ge=0), AfterValidator(_zero_or_in_float32)]
NotPositive = Annotated[float, Field(le=0), AfterValidator(_zero_or_in_float32)]

Share = Annotated[float, Field(ge=0, le=1)]
"""From nothing to all."""

PartialShare = Annotated[float, Field(gt=0, lt=1)]
"""Neither nothing nor all."""

Decay = Annotated[float, Field(ge=0, lt=1)]
"""Of a moving average: what is kept at a step."""

Discount = Annotated[float, Field(gt=0, le=1)]

Layers = Annotated[list[Annotated[int, Field(ge=1, le=16_384)]], Field(min_length=1, max_length=64)]
"""Sizes of hidden layers."""

Range = Annotated[
    list[Positive],
    Field(min_length=2, max_length=2),
    AfterValidator(_ascending),
    Allows("two positive numbers, ascending"),
]

Amount = Annotated[
    Any, AfterValidator(_number_or_pair), Allows("a number, or a pair in ascending order")
]
"""Of a fault: the same in every episode, or the range from which each draws."""

Name = Annotated[str, StringConstraints(min_length=1), Allows("a name")]

Names = Annotated[
    list[Name], Field(min_length=1), AfterValidator(different), Allows("a list of names")
]

Objectives = Annotated[
    list[Name], AfterValidator(_objectives), Allows("names of objectives, the static one first")
]

Rewards = Annotated[
    dict[str, Any], AfterValidator(_rewards), Allows("constants of envs.RewardConstants")
]

Device = Annotated[str, StringConstraints(pattern=r"^(cpu|cuda(:\d+)?)$"), Allows("cpu or cuda")]

RobotField = Annotated[
    Any,
    _known(get_robots),
    IsPath(),
    Allows(
        "a name, any, a .yaml file, or a mapping, also with ranges that every episode draws from"
    ),
]
SceneField = Annotated[
    Any, _known(get_scene), IsPath(), Allows("a name, a .yaml file or a mapping")
]

PolicyFolder = Annotated[str, IsPath("policy"), Allows("a folder")]
RewardModelFolder = Annotated[str, IsPath("reward_model"), Allows("a folder")]
RunFolder = Annotated[str, IsPath("run"), Allows("a folder")]
DemonstrationFile = Annotated[str, IsPath("file"), Allows("a file")]

Distribution = Literal["jeffreys", "dirichlet", "abs_normal"]
LossFunction = Literal["smooth_l1", "l2", "l1"]
Backend = Literal["csv", "tensorboard", "wandb", "mlflow", "trackio"]

LoggerArguments = Annotated[
    dict[Literal["wandb", "mlflow", "trackio"], dict[str, Any]],
    Allows("arguments of wandb, mlflow or trackio by its name"),
]


def checked_faults(faults: dict[str, Any]) -> None:
    """Refuse faults that the environment refuses.

    Raises:
        ValueError: for amounts out of their ranges.
    """
    try:
        get_faults(faults)
    except ValueError as error:
        raise ValueError(f"env.faults: {error}") from error
