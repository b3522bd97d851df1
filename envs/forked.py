"""Native batches in processes that were forked."""

from __future__ import annotations

import os
import weakref

import mujoco
from mujoco.batch import Batch

_batches: weakref.WeakSet[Batch] = weakref.WeakSet()
_of_the_parent: list[Batch] = []


def native_batch(model: mujoco.MjModel, num_envs: int, num_threads: int) -> Batch:
    """A native batch that no forked process ends.

    The end of a batch waits for its threads, which only the parent has: a child that collected one would
    hang. So a child keeps those that there were.

    Example:
        >>> model = mujoco.MjModel.from_xml_string("<mujoco/>")
        >>> type(native_batch(model, 2, 1)).__name__
        'Batch'
    """
    batch = Batch(model, num_envs, num_threads)
    _batches.add(batch)
    return batch


os.register_at_fork(after_in_child=lambda: _of_the_parent.extend(_batches))
