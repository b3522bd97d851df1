"""What a command prints of what its libraries say."""

from __future__ import annotations

import contextlib
import logging
import warnings
from collections.abc import Iterator
from typing import Any
from unittest import mock

# What libraries say to their own developers. tensordict, while PyTorch compiles: that it reads a setting of
# PyTorch which does nothing any more, and that it locks a tensordict in a graph, where nothing unlocks it.
# TorchRL: that its BCLoss does not declare the target of its actor, of which it has none; and that the last
# batch of a training is a whole one, which our pages say.
_AMONG_LIBRARIES = (
    r"torch\._dynamo\.config\.inline_inbuilt_nn_modules is deprecated",
    r"Using lock_\(\) inside a compiled graph",
    r"The name target_actor_network_params wasn't part of the annotations",
    r"total_frames \(\d+\) is not exactly divisible by frames_per_batch",
)


@contextlib.contextmanager
def plain_warnings(*, keep: bool) -> Iterator[None]:
    """Warnings without the line of a library that they come from, but for those who ask for it.

    What libraries warn each other of is left out.
    """

    def plain(message: Warning | str, *_: Any) -> str:
        return f"warning: {' '.join(str(message).split())}\n"

    if keep:
        yield
        return
    with (
        warnings.catch_warnings(),
        mock.patch.object(warnings, "formatwarning", plain),
    ):
        for message in _AMONG_LIBRARIES:
            warnings.filterwarnings("ignore", message)
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
