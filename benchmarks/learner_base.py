"""Learners: what an update is made of, for those of this project and for those of its peers."""

from __future__ import annotations

import abc
from collections.abc import Callable, Iterator

ACTION_SIZE = 2

Stage = tuple[str, Callable[[], None]]


class Learner(abc.ABC):
    """Updates in named stages, so that a profile can tell them apart."""

    policy_delay = 1

    def __init__(self) -> None:
        self.updates = 0

    @abc.abstractmethod
    def critic_stages(self) -> list[Stage]:
        """Of every update."""

    def actor_stages(self) -> list[Stage]:
        """Of every ``policy_delay``-th update; none if the critics' stages see to it."""
        return []

    def stages(self) -> Iterator[Stage]:
        """Those of the next update."""
        self.updates += 1
        yield from self.critic_stages()
        if self.updates % self.policy_delay == 0:
            yield from self.actor_stages()

    def update(self) -> None:
        for _, run in self.stages():
            run()


class TD3Learner(Learner):
    """The stages of TD3: critics at every update, actor and targets at some.

    Gradients are the loss, its backward pass and clipping.
    """

    def critic_stages(self) -> list[Stage]:
        return [
            ("sample, relabel", self._sample),
            ("critic: gradients", self._critic_gradients),
            ("critic: Adam", self._critic_step),
        ]

    def actor_stages(self) -> list[Stage]:
        return [
            ("actor: gradients", self._actor_gradients),
            ("actor: Adam", self._actor_step),
            ("soft update, average", self._follow),
        ]

    @abc.abstractmethod
    def _sample(self) -> None: ...

    @abc.abstractmethod
    def _critic_gradients(self) -> None: ...

    @abc.abstractmethod
    def _critic_step(self) -> None: ...

    @abc.abstractmethod
    def _actor_gradients(self) -> None: ...

    @abc.abstractmethod
    def _actor_step(self) -> None: ...

    @abc.abstractmethod
    def _follow(self) -> None: ...
