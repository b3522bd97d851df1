"""Sampled batches that are still what is stored."""

from __future__ import annotations

from tensordict import LazyStackedTensorDict, TensorDictBase

__all__ = ["apart_from_storage"]


def apart_from_storage(tensordict: TensorDictBase) -> TensorDictBase:
    """A batch whose entries may be exchanged without exchanging those of a replay buffer.

    Samples of a :class:`~torchrl.data.LazyStackStorage` are lazy stacks of the stored transitions
    themselves, one of them possibly several times. TorchRL hands them to sample-time transforms as
    they are, its own included, which scale a stored reward once more with every sample.

    Args:
        tensordict (TensorDictBase): a sampled batch, or any other data.

    Returns:
        For a lazy stack a shallow copy, which shares its tensors; otherwise the argument.
    """
    if isinstance(tensordict, LazyStackedTensorDict):
        return tensordict.clone(recurse=False)
    return tensordict
