"""What a command prints of what its libraries say."""

from __future__ import annotations

import contextlib
import logging
import warnings
from collections.abc import Iterator
from typing import Any
from unittest import mock


@contextlib.contextmanager
def plain_warnings(*, keep: bool) -> Iterator[None]:
    """Warnings without the line of a library that they come from, but for those who ask for it."""

    def plain(message: Warning | str, *_: Any) -> str:
        return f"warning: {' '.join(str(message).split())}\n"

    with mock.patch.object(warnings, "formatwarning", warnings.formatwarning if keep else plain):
        yield


@contextlib.contextmanager
def torchrl() -> Iterator[None]:
    """What TorchRL notes for its developers is no news to those who train; its warnings are."""
    logger = logging.getLogger("torchrl")
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(level)
