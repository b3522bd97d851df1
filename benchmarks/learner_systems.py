"""What the learner benchmark measures: this project's update, and what it is compared with.

All of them learn from the same transitions, held in their own kind of replay buffer; sampling is
part of an update. ``SYSTEMS`` names them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from tensordict import TensorDict

from .bare_loop import BareLoop
from .learner_base import Learner
from .ours import Ours
from .peers_learner import OfficialUpdate, StockTD3
from .peers_morl_baselines import capql, gpi_ls
from .workload import EQUAL_WORK, config


@dataclasses.dataclass(frozen=True)
class System:
    """One row of the table."""

    make: Callable[[TensorDict, bool], Learner]
    """From the transitions, and whether to compile what can be."""
    compiled: bool = False
    precision: str = "float32"
    """Of the matrix products."""
    requires: tuple[str, ...] = ()
    """Optional modules."""


def _ours(data: TensorDict, compiled: bool, *overrides: str) -> Learner:
    return Ours(config(f"compute.compile={compiled}".lower(), *overrides), data)


def _bare(data: TensorDict, compiled: bool, *overrides: str) -> Learner:
    cfg = config("compute.compile=false", *overrides)
    return BareLoop(Ours(cfg, data[:1]), data, compiled=compiled)


def _official(data: TensorDict, compiled: bool, delay: int) -> Learner:
    return OfficialUpdate(data, policy_delay=delay)


def _stock(data: TensorDict, compiled: bool) -> Learner:
    return StockTD3(data)


def _capql(data: TensorDict, compiled: bool) -> Learner:
    return capql(data)


def _gpi_ls(data: TensorDict, compiled: bool, batch_size: int) -> Learner:
    return gpi_ls(data, batch_size)


def _with(make: Callable[..., Learner], *arguments) -> Callable[[TensorDict, bool], Learner]:
    return lambda data, compiled: make(data, compiled, *arguments)


OURS = "ours"
OURS_EQUAL = "ours, equal work"

_SHIPPED = config()
_BFLOAT16 = "compute.bfloat16=true"
_DELAY_10 = (*EQUAL_WORK, "optim.policy_delay=10")
_PEERS = ("morl_baselines",)

SYSTEMS: dict[str, System] = {
    OURS: System(_ours, _SHIPPED.compute.compile),
    "ours, bfloat16": System(_with(_ours, _BFLOAT16), _SHIPPED.compute.compile, "bfloat16"),
    "ours, eager": System(_ours),
    OURS_EQUAL: System(_with(_ours, *EQUAL_WORK), _SHIPPED.compute.compile),
    "ours, equal work, eager": System(_with(_ours, *EQUAL_WORK)),
    "ours, equal work, delay 10": System(_with(_ours, *_DELAY_10), _SHIPPED.compute.compile),
    "bare loop": System(_bare, True),
    "bare loop, eager": System(_bare),
    "bare loop, equal work": System(_with(_bare, *EQUAL_WORK), True),
    "bare loop, equal work, eager": System(_with(_bare, *EQUAL_WORK)),
    "bare loop, equal work, delay 10": System(_with(_bare, *_DELAY_10), True),
    "TorchRL TD3Loss": System(_stock),
    "PD-MORL, delay 10": System(_with(_official, 10)),
    "PD-MORL, delay 2": System(_with(_official, 2)),
    "CAPQL": System(_capql, requires=_PEERS),
    "GPI-LS": System(_with(_gpi_ls, 256), requires=_PEERS),
    "GPI-LS, half the batch": System(_with(_gpi_ls, 128), requires=_PEERS),
}
"""What is measured. "Equal work" is without LayerNorm, angle, penalties and average."""
