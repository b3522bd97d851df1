"""Counts of what a piece of code asks of PyTorch: operators, new tensors, and waits for a device.

They are the same on every machine and under any load, unlike times.
"""

from __future__ import annotations

import contextlib
import sys
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

ROOT = Path(__file__).parents[1]

_aten = torch.ops.aten

# On an accelerator each of these stops the host until the device is done, since the size of the result
# or the way on depends on values. `item`, `bool`, `float` and `int` all end in the first one.
_WAITS = {
    _aten._local_scalar_dense,
    _aten.nonzero,
    _aten.masked_select,
    _aten.equal,
    _aten._unique2,
    _aten.unique_dim,
    _aten.repeat_interleave,
}
_INDEXING = {_aten.index, _aten.index_put, _aten.index_put_}

# On the CPU these read the memory without an operator.
_READS = {
    torch.Tensor.tolist,
    torch.Tensor.numpy,
    torch.Tensor.__array__,
    torch.Tensor.cpu,
}


class Tally:
    """What was counted."""

    def __init__(self) -> None:
        self.operators: Counter[str] = Counter()
        self.allocations = 0
        """Operators with a result of their own, which is no view and not written in place."""
        self.waits: list[str] = []
        """Each with the line of this project that it comes from."""

    @property
    def total(self) -> int:
        """Of all operators."""
        return self.operators.total()

    def _waited(self, what: str) -> None:
        frames = traceback.extract_stack()
        # The innermost one that is neither a library's nor one of this file.
        own = [f for f in frames if ROOT in Path(f.filename).parents and f.filename != __file__]
        own = [frame for frame in own if "site-packages" not in frame.filename] or frames[:1]
        path = Path(own[-1].filename)
        self.waits.append(f"{what} at {path.name}:{own[-1].lineno}: {own[-1].line}")


class _Dispatched(TorchDispatchMode):
    def __init__(self, tally: Tally) -> None:
        super().__init__()
        self.tally = tally

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        packet = func.overloadpacket
        self.tally.operators[str(packet)] += 1
        if any(result.alias_info is None for result in func._schema.returns):
            self.tally.allocations += 1
        masks = packet in _INDEXING and any(
            index is not None and index.dtype == torch.bool for index in args[1]
        )
        if packet in _WAITS or masks:
            self.tally._waited(str(packet))
        return func(*args, **(kwargs or {}))


class _Asked(TorchFunctionMode):
    def __init__(self, tally: Tally) -> None:
        super().__init__()
        self.tally = tally

    def __torch_function__(self, func, types, args=(), kwargs=None):
        if func in _READS:
            self.tally._waited(func.__name__)
        return func(*args, **(kwargs or {}))


@contextlib.contextmanager
def counted() -> Iterator[Tally]:
    """Counts for as long as the context lasts."""
    tally = Tally()
    with _Asked(tally), _Dispatched(tally):
        yield tally


def count(run: Callable[[], object]) -> Tally:
    """Counts of the second call: the first one may fill caches."""
    run()
    with counted() as tally:
        run()
    return tally


def python_calls(run: Callable[[], object]) -> int:
    """Functions called, of Python and of C: also sees loops that do not reach PyTorch."""
    run()
    calls = 0

    def called(frame, event, argument) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")

    before = sys.getprofile()
    sys.setprofile(called)
    try:
        run()
    finally:
        sys.setprofile(before)
    return calls
