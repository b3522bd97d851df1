"""What is evaluated: a name, and one actor per training seed."""

from __future__ import annotations

import dataclasses
import hashlib
import reprlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModuleBase

from envs.demonstrations import CircleDemonstrator
from torchrl_morl.deploy import load_policy
from torchrl_morl.preferences import PreferenceSpace

from ..evaluation.references import make_reference
from ..evaluation.setting import demonstration, demonstration_on, trained_in
from ..policy_folders import no_policy

_REFERENCE = "reference:"

SPACE = PreferenceSpace(("core", "demo", "distance", "efficiency"), static={"core": 1.0})
"""Of systems that were not trained, and so have no space of their own."""


@dataclasses.dataclass(frozen=True)
class Member:
    """One training of a system, or the only one of what was not trained.

    Args:
        seed: of the training; of a polished policy, of the training that it started from, or of the
            polishing where several started from one.
        actor: makes the actor for a robot of that name, writing actions in [-1, 1].
        source: where it comes from, for the record: a folder and a hash of the weights.
        observed: what it observes, arguments of :func:`envs.policy_env.make_policy_env`.
    """

    seed: int
    actor: Callable[[str], TensorDictModuleBase]
    source: str
    observed: dict[str, bool] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class System:
    """Trainings that differ in their seed alone.

    Args:
        name: of the folder and in tables.
        members: at least one, with different seeds.
        preference_space: of the preferences.
        demonstration: arguments of :class:`envs.demonstrations.CircleDemonstrator`, to which the
            Frechet distance is measured; the default is the circle of the paper.
        ignores_preference: the preference changes nothing, as for a policy of the core reward.
    """

    name: str
    members: tuple[Member, ...]
    preference_space: PreferenceSpace = SPACE
    demonstration: dict[str, Any] = dataclasses.field(default_factory=dict)
    ignores_preference: bool = False

    def __post_init__(self) -> None:
        if not self.name or not self.name.replace("-", "").replace("_", "").isalnum():
            raise ValueError(f"A name is made of letters, digits, - and _, got {self.name!r}.")
        seeds = [member.seed for member in self.members]
        if not seeds or len(set(seeds)) != len(seeds):
            raise ValueError(
                f"{self.name} needs members with different training seeds, got {seeds}: the same "
                "policy twice is no second training."
            )

    def demonstrator(self, robot: str) -> CircleDemonstrator:
        """On a robot, with actions in m/s and rad/s; a slower one shows it at its own speed."""
        return CircleDemonstrator(**demonstration_on(self.demonstration, robot))


def untrained(
    name: str, actor: Callable[[str], TensorDictModuleBase], *, ignores_preference: bool = True
) -> System:
    """A system without a policy folder, such as a scripted driver.

    Args:
        name: of the system.
        actor: makes it for a robot of that name, writing actions in [-1, 1].

    Keyword Args:
        ignores_preference: whether it does.

    Examples:
        >>> from envs.demonstrations import StraightDriver
        >>> untrained("straight", lambda robot: StraightDriver(robot=robot, scaled=True)).name
        'straight'
    """
    member = Member(seed=0, actor=actor, source=name)
    return System(name, (member,), ignores_preference=ignores_preference)


def load_system(argument: str) -> System:
    """Read ``NAME=FOLDER``, ``NAME=FOLDER1,FOLDER2,...`` or ``NAME=reference:REFERENCE``.

    Several folders are the same training with other seeds; references are those of
    :mod:`recipes.evaluation.references`.

    Raises:
        ImportError: for a reference that needs a package that is not installed.
        ValueError: if it is not written so, or the policies do not belong together.
        FileNotFoundError: if a folder holds no policy.
    """
    name, equals, folders = argument.partition("=")
    if not equals or not all(folders.split(",")):
        raise ValueError(f"Write NAME=FOLDER or NAME=FOLDER1,FOLDER2, got {argument!r}.")
    if folders.startswith(_REFERENCE):
        reference = folders.removeprefix(_REFERENCE)
        make_reference(reference)  # an unknown one is an error now, not hours later
        return untrained(name, lambda robot: make_reference(reference, robot))
    paths = [Path(folder) for folder in folders.split(",")]
    for path in paths:
        if why := no_policy(path):
            raise FileNotFoundError(f"{name}: {why}.")
    policies = [load_policy(path) for path in paths]
    seeds = _seeds([policy.card for policy in policies])
    members, facts = [], []
    for folder, seed, policy in zip(paths, seeds, policies, strict=True):
        card = policy.card
        digest = hashlib.sha256((folder / "policy.safetensors").read_bytes()).hexdigest()
        source = f"{folder} sha256 {digest[:16]}"
        members.append(
            Member(seed, lambda _, actor=policy.actor: actor, source, trained_in(card).observed)
        )
        facts.append(
            (policy.preference_space, demonstration(card), card.get("preference") == "ignored")
        )
    if any(fact != facts[0] for fact in facts):
        raise ValueError(
            f"{name}: the policies differ in more than their seed (objectives, demonstration)."
        )
    preference_space, shown, ignored = facts[0]
    return System(name, tuple(members), preference_space, shown, ignored)


def _seeds(cards: list[dict[str, Any]]) -> list[int]:
    """The seeds of the first stage in which the trainings differ; of their start, if in none.

    A polished policy has two stages, the polishing and the training that it started from. One
    without a seed counts as its place.
    """
    histories = []
    for place, card in enumerate(cards):
        stages = [card]
        while "start" in stages[-1]:
            start = stages[-1]["start"]
            if not isinstance(start, Mapping):
                raise ValueError(f"card: start must be an object, got {reprlib.repr(start)}.")
            stages.append(start)
        histories.append([_seed(stage, place) for stage in stages[::-1]])
    stages = [list(seeds) for seeds in zip(*histories)]
    return next((seeds for seeds in stages if len(set(seeds)) == len(seeds)), stages[0])


def _seed(card: Mapping[str, Any], place: int) -> int:
    config = card.get("config", {})
    if not isinstance(config, Mapping):
        raise ValueError(f"card: config must be an object, got {reprlib.repr(config)}.")
    seed = config.get("seed", place)
    if not isinstance(seed, int):
        raise ValueError(f"card: config.seed must be a whole number, got {reprlib.repr(seed)}.")
    return seed
