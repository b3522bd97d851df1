"""Ctrl-C and SIGTERM: a training finishes its step, everything else ends at once."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from types import FrameType
from typing import TypeVar

T = TypeVar("T")

IS_STAGE = "TORCHRL_MORL_IS_STAGE"
"""In the environment of a recipe that another command runs, which says itself how to go on."""


@dataclasses.dataclass
class StopRequested:
    """Whether somebody has asked a training to stop.

    Args:
        signal: that asked; ``None`` if nobody has.
        waits: whether something is under way that is finished first.
        begun: whether a step has been taken, or anything written.
    """

    signal: int | None = None
    waits: bool = False
    begun: bool = False


class Stopped(Exception):
    """Raised by a training that was asked to stop and has finished its step.

    Args:
        done: what it has done, "after 960 steps".
    """

    def __init__(self, done: str) -> None:
        super().__init__(done)
        self.done = done


class Interrupted(KeyboardInterrupt):
    """Raised where nothing is worth finishing."""


_request = StopRequested()


def stop_requested() -> bool:
    """Whether to finish the step, save, and raise :class:`Stopped`."""
    return _request.signal is not None


def has_begun() -> bool:
    """Whether a training has taken a step, or a recipe has written something."""
    return _request.begun


def exit_code() -> int:
    """Of a process that was asked to stop: 130 for Ctrl-C, 143 for SIGTERM."""
    return 128 + (_request.signal or signal.SIGINT)


def until_stopped(batches: Iterable[T]) -> Iterator[T]:
    """Batches of a training up to the one in which somebody asks it to stop.

    From the first on, a request waits for the end of the step. Then the iteration ends; the caller asks
    :func:`stop_requested`, saves and raises :class:`Stopped`, for which the request waits as well.

    Examples:
        >>> list(until_stopped(range(3)))
        [0, 1, 2]
    """
    for batch in batches:
        _request.waits = _request.begun = True
        yield batch
        if stop_requested():
            return
    _request.waits = stop_requested()


@contextlib.contextmanager
def stop_signals(
    handler: Callable[[int, FrameType | None], object] | signal.Handlers | None = None,
) -> Iterator[None]:
    """A block behind which Ctrl-C and SIGTERM have the handlers that they had before it.

    Python gives signals to the main thread alone: elsewhere this does nothing.

    Args:
        handler: of both in the block; ``None`` leaves those that are there, for code that sets its own.

    Examples:
        >>> before = signal.getsignal(signal.SIGTERM)
        >>> with stop_signals(signal.SIG_IGN):
        ...     signal.getsignal(signal.SIGTERM).name
        'SIG_IGN'
        >>> signal.getsignal(signal.SIGTERM) == before
        True
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {one: signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)}
    try:
        if handler is not None:
            for one in before:
                signal.signal(one, handler)
        yield
    finally:
        for one, old in before.items():
            if old is not None:  # else it is not one of Python's, which cannot put it back
                signal.signal(one, old)


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """A block that a request waits for, such as the writing of a file; it ends the process behind it.

    Raises:
        Interrupted: at the end of the block, if somebody has asked in it.
    """
    before, _request.waits, _request.begun = _request.waits, True, True
    try:
        yield
    finally:
        _request.waits = before
    if stop_requested() and not before:
        raise Interrupted


@contextlib.contextmanager
def handled() -> Iterator[StopRequested]:
    """Turns Ctrl-C and SIGTERM into requests, in the main thread, as long as the block lasts."""
    _request.signal, _request.waits, _request.begun = None, False, False
    try:
        with stop_signals(_ask):
            yield _request
    finally:
        _request.waits = False


def _ask(number: int, frame: object) -> None:
    # A scheduler may send SIGTERM to a process and its children, who forward it: once is enough.
    again = stop_requested() and number == signal.SIGINT
    if not stop_requested() or again:
        _request.signal = number
    if again or not _request.waits:
        raise Interrupted
    if sys.stderr.isatty():
        print("\nfinishing the step; Ctrl-C again ends at once", file=sys.stderr)
