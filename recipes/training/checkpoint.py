"""Checkpoints from which a training goes on as if it had never stopped.

They are TorchRL's (:class:`torchrl.checkpoint.Checkpoint`: whole or not at all, the last one is kept), but
what they hold is safetensors and JSON: TorchRL's own payload reads pickles that somebody puts beside it.
"""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.checkpoint import (
    Checkpoint,
    CheckpointAdapter,
    CheckpointError,
    CheckpointRotation,
    GlobalRNGState,
)
from torchrl.collectors import Collector
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import Transform, TransformedEnv

from .validation import ConfigurationError

_UNFIT = (
    *(CheckpointError, OSError, RuntimeError, ValueError, LookupError, TypeError),
    *(AttributeError, ArithmeticError, AssertionError),
)
"""What loading raises for files that somebody else has made, which may say anything."""


class SafeStateAdapter(CheckpointAdapter):
    """State dicts as safetensors and JSON, whatever is nested in them; nothing else is ever read.

    Tensors, NumPy arrays, mappings, lists, tuples, numbers, strings, booleans and ``None`` come back as
    they were, bit by bit.

    Raises:
        TypeError: when saving anything else.
        ValueError: when loading files that are not of this kind.
    """

    adapter_id = "torchrl_morl.safe_state"
    format_version = 1
    _TENSORS, _SCHEMA = "state.safetensors", "state.json"

    def save(self, component: Any, path: Path, *, args: tuple, kwargs: Mapping[str, Any]) -> None:
        tensors: dict[str, Tensor] = {}
        schema = _encode(component.state_dict(*args, **kwargs), tensors)
        path.mkdir(parents=True, exist_ok=True)
        try:
            save_file(tensors, path / self._TENSORS)
        except SafetensorError as error:
            # Its own kind of error also for a full disk.
            raise OSError(errno.EIO, f"{error}", str(path / self._TENSORS)) from error
        (path / self._SCHEMA).write_text(json.dumps(schema, separators=(",", ":")))

    def load(
        self,
        component: Any,
        path: Path,
        *,
        map_location: Any,
        tensor_load_kwargs: Mapping[str, Any],
        args: tuple,
        kwargs: Mapping[str, Any],
    ) -> None:
        del map_location, tensor_load_kwargs
        file = path / self._TENSORS
        try:
            tensors = load_file(file)
            file = path / self._SCHEMA
            state = _decode(json.loads(file.read_text()), tensors)
        except (SafetensorError, *_UNFIT) as error:
            raise ValueError(f"{file} holds no state: {error}.") from error
        component.load_state_dict(state, *args, **kwargs)


def _encode(value: Any, tensors: dict[str, Tensor]) -> Any:
    if isinstance(value, (Tensor, np.ndarray)):
        kind = "tensor" if isinstance(value, Tensor) else "array"
        key = f"{len(tensors):06d}"
        # A copy: the file format refuses tensors that share memory.
        tensors[key] = torch.as_tensor(value).detach().cpu().contiguous().clone()
        return {kind: key}
    if isinstance(value, Mapping):
        return {"dict": [[_encode(k, tensors), _encode(v, tensors)] for k, v in value.items()]}
    if isinstance(value, (list, tuple)):
        kind = "list" if isinstance(value, list) else "tuple"
        return {kind: [_encode(entry, tensors) for entry in value]}
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"A checkpoint cannot hold a {type(value).__name__}.")


def _decode(value: Any, tensors: dict[str, Tensor]) -> Any:
    if not isinstance(value, dict):
        return value
    ((kind, content),) = value.items()
    if kind in ("tensor", "array"):
        return tensors[content] if kind == "tensor" else tensors[content].numpy()
    if kind == "dict":
        return {_decode(k, tensors): _decode(v, tensors) for k, v in content}
    entries = [_decode(entry, tensors) for entry in content]
    return {"list": list, "tuple": tuple}[kind](entries)


class BufferState:
    """What a replay buffer holds, and no more: its storage has room for a whole training."""

    def __init__(self, buffer: TensorDictReplayBuffer) -> None:
        self.buffer = buffer

    def state_dict(self) -> dict[str, Any]:
        """Transitions so far, where the next one goes, and the generators of its transforms."""
        count = len(self.buffer.storage)
        data = self.buffer.storage[:count].flatten_keys("/").to_dict() if count else {}
        return {
            "data": data,
            "writer": self.buffer.writer.state_dict(),
            "sampler": self.buffer.sampler.state_dict(),
            "transforms": [transform.state_dict() for transform in self.buffer.transform],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put them back, into a buffer of the same kind, in the place of what it holds."""
        # A storage counts what it is given on top: demonstrations that are in it already would leave as
        # many rows behind the saved ones that nobody has written, and samples would hold them.
        self.buffer.empty()
        if state["data"]:
            data = TensorDict(state["data"]).unflatten_keys("/").auto_batch_size_(1)
            self.buffer.storage.set(range(len(data)), data)
        self.buffer.writer.load_state_dict(state["writer"])
        self.buffer.sampler.load_state_dict(state["sampler"])
        for transform, saved in zip(self.buffer.transform, state["transforms"], strict=True):
            transform.load_state_dict(saved)


class CollectorState:
    """Where a collector stands in the middle of its episodes: the simulation, and what is seen of it.

    TorchRL's own state of a collector begins new episodes, as simulations in general cannot be saved. So
    does this one in an environment without ``simulation_state``.

    Args:
        collector: of one process.
        policy: that collects, whose exploration may be annealed.
    """

    def __init__(self, collector: Collector, policy: nn.Module) -> None:
        self.collector, self.policy = collector, policy

    def state_dict(self) -> dict[str, Any]:
        """The environment and its transforms, what was seen last, exploration, counters."""
        collector = self.collector
        state = {
            "frames": collector._frames,
            "iterations": collector._iter,
            "trajectories": collector._traj_pool.state_dict(),
            "policy": self.policy.state_dict(),
            "transforms": [one.state_dict() for one in _stateful(collector.env)],
        }
        if hasattr(collector.env.base_env, "simulation_state"):
            state["carrier"] = collector._carrier.flatten_keys("/").to_dict()
            state["simulation"] = collector.env.base_env.simulation_state()
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on there, in an environment of the same configuration."""
        collector = self.collector
        if "trajectories" not in state:
            raise ValueError(
                "It was written with collector.backend=ray, and holds no episodes: go on with that, "
                "collector.num_workers=1 will do."
            )
        collector._traj_pool.load_state_dict(state["trajectories"])
        if "simulation" in state:
            collector.env.base_env.load_simulation_state(state["simulation"])
            carrier = TensorDict(state["carrier"], batch_size=collector._carrier.batch_size)
            collector._carrier.update(carrier.unflatten_keys("/"))
        else:
            # Not the episodes that the training began with once more.
            collector.env.set_seed(state["frames"])
            collector.reset()
        for transform, saved in zip(_stateful(collector.env), state["transforms"], strict=True):
            transform.load_state_dict(saved)
        self.policy.load_state_dict(state["policy"])
        collector._frames, collector._iter = state["frames"], state["iterations"]


def _stateful(env: TransformedEnv) -> list[Transform]:
    """The transforms with a generator of their own; the others remember nothing that changes."""
    return [
        one for one in env.transform if type(one).get_extra_state is not nn.Module.get_extra_state
    ]


class Counters:
    """Numbers of a training loop, as attributes.

    Examples:
        >>> counters = Counters(frames=0, score=float("nan"))
        >>> counters.frames += 96
        >>> counters.state_dict()
        {'frames': 96, 'score': nan}
    """

    def __init__(self, **values: float) -> None:
        self.__dict__.update(values)

    def state_dict(self) -> dict[str, float]:
        """By name."""
        return dict(vars(self))

    def load_state_dict(self, state: Mapping[str, float]) -> None:
        """Take them over.

        Raises:
            ValueError: unless they are the same numbers: one that is missing would stand at its start.
        """
        if state.keys() != vars(self).keys() or not all(
            _counts_as(now, state[name]) for name, now in vars(self).items()
        ):
            raise ValueError(f"it must say {', '.join(vars(self))}, it says {state}.")
        self.__dict__.update(state)


def _counts_as(now: float, saved: Any) -> bool:
    """Whether a saved number can take the place of one: a count is whole, and not below zero."""
    if isinstance(now, float):
        return isinstance(saved, int | float)
    return isinstance(saved, int) and not isinstance(saved, bool) and saved >= 0


class GeneratorStates:
    """Generators of their own, beside those of the process."""

    def __init__(self, *generators: torch.Generator) -> None:
        self.generators = generators

    def state_dict(self) -> dict[str, list[Tensor]]:
        """Their states, in order."""
        return {"states": [generator.get_state() for generator in self.generators]}

    def load_state_dict(self, state: Mapping[str, list[Tensor]]) -> None:
        """Take them over."""
        for generator, saved in zip(self.generators, state["states"], strict=True):
            generator.set_state(saved)


class Checkpoints:
    """The last checkpoint of a run, or of a part of it.

    Args:
        folder: that holds it, in the run folder.
        components: what it holds, by name: anything with ``state_dict`` and ``load_state_dict``. The
            generators of the process are added.
    """

    def __init__(self, folder: Path, **components: Any) -> None:
        self.folder = folder
        self.rotation = CheckpointRotation(self.folder, keep_last=1)
        self.checkpoint = Checkpoint()
        for name, component in {**components, "generators": GlobalRNGState()}.items():
            self.checkpoint.register(name, component, adapter=SafeStateAdapter())

    def save(self, step: int) -> None:
        """Replace the last checkpoint by one after so many frames, or updates."""
        self.rotation.save(self.checkpoint, step=step)

    def load(self) -> bool:
        """Load the last one, if there is one.

        Returns:
            Whether there was.

        Raises:
            ValueError: if it is broken, or of another configuration.
        """
        # What a killed process was writing.
        for unfinished in self.folder.glob(".*"):
            shutil.rmtree(unfinished, ignore_errors=True)
        latest = self._latest()
        if latest is None:
            # TorchRL passes over what it cannot read: the training would begin anew, in this folder.
            if unreadable := sorted(self.folder.glob("checkpoint-*")):
                raise ValueError(
                    f"{unreadable[-1]} is no checkpoint that can be read: remove it to begin anew."
                )
            return False
        try:
            self.checkpoint.load(latest)
        except _UNFIT as error:
            raise ValueError(
                f"{latest} does not fit this training: {_first_line(error)} Resume with the "
                "configuration and the versions that wrote it, or start anew in another folder."
            ) from error
        return True

    def _latest(self) -> Path | None:
        """The last one that can be read. It is a folder: how large an archive is inside, nobody knows."""
        try:
            latest = self.rotation.latest()
        except _UNFIT as error:  # a name or a manifest that TorchRL does not expect
            raise ValueError(
                f"{self.folder} holds what is no checkpoint ({_first_line(error)}): remove it to begin "
                "anew."
            ) from error
        if latest is not None and not latest.is_dir():
            raise ValueError(f"{latest} is no folder, as checkpoints are: remove it.")
        return latest


def _first_line(error: BaseException) -> str:
    """What it says, in one line, whatever it is."""
    return next(iter(str(error).splitlines()), type(error).__name__)


def check_frames_left(cfg: DictConfig, frames: int) -> None:
    """Refuse to go on with a training that is over, unless it is given more frames.

    Raises:
        ConfigurationError: if nothing is left to be done.
    """
    if frames >= cfg.collector.total_frames:
        raise ConfigurationError(
            f"resume={cfg.resume} has seen {frames} frames already: collector.total_frames must be "
            f"greater, got {cfg.collector.total_frames}."
        )
