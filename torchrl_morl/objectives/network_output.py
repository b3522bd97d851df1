"""What a network wrote, or a line about why it is not there."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

__all__ = ["read_output"]


def read_output(
    tensordict: TensorDictBase,
    key: NestedKey,
    name: str,
    role: str,
    network: TensorDictModuleBase,
) -> Tensor:
    """Read an entry that a network is expected to have written.

    Args:
        tensordict (TensorDictBase): what the network returned.
        key (NestedKey): where the entry is expected.
        name (str): what ``set_keys`` calls the key.
        role (str): what to call the network in the message.
        network (TensorDictModuleBase): the network.

    Returns:
        The entry.

    Raises:
        KeyError: if the network wrote something else; the message says how to rename it.
    """
    value = tensordict.get(key, None)
    if value is None:
        written = list(network.out_keys)
        raise KeyError(
            f"the {role} writes {written}, not {key!r}: tell the loss with "
            f"set_keys({name}={written[-1]!r})."
        )
    return value
