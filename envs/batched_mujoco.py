"""Many MuJoCo simulations as one TorchRL environment."""

from __future__ import annotations

import abc
import math
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from .actions import refuse_non_finite, refuse_shape
from .forked import native_batch
from .limits import check_seed, check_simulations
from .pixels import PixelsMixin
from .rendering import Camera


class PhysicsState(NamedTuple):
    """Simulator state of every environment: float64 tensors on the CPU."""

    qpos: Tensor
    """``[num_envs, nq]``"""
    qvel: Tensor
    """``[num_envs, nv]``"""


class BatchedMujocoEnv(PixelsMixin, EnvBase):
    """Base class of batched MuJoCo environments over :class:`mujoco.batch.Batch`.

    One instance holds ``num_envs`` simulations and has batch size ``(num_envs,)``. A step is one
    native call for the physics of all of them, on a thread pool; results are bit-equal to a loop
    over ``mj_step`` whatever the number of threads. The hooks carry the names of TorchRL's
    :class:`~torchrl.envs.MujocoEnv`, which runs one process per simulation with the C backend.

    ``qpos``, ``qvel``, ``qacc_warmstart`` and ``elapsed`` are both observed and part of the
    ``state_spec``, so any row of a rollout is a snapshot: ``env.reset(row, set_state=True)``
    continues from it bit for bit, through :class:`~torchrl.envs.TransformedEnv` too.

    Subclasses implement :meth:`_make_model`, :meth:`_sample_initial_state`,
    :meth:`_make_obs_spec`, :meth:`_make_obs`, :meth:`_make_action_spec`,
    :meth:`_make_reward_spec`, :meth:`_compute_terminated` and :meth:`_compute_reward`, and may
    override :meth:`_prepare_ctrl`, :meth:`_on_reset` and :meth:`_simulate`.

    Keyword Args:
        num_envs: number of simulations, 1 to 100,000.
        num_threads: native threads; 0 uses every CPU.
        frame_skip: physics steps in a control step; defaults to :attr:`FRAME_SKIP`.
        max_episode_steps: control steps after which an episode is truncated.
        seed: seed of every random draw of the environment; random if ``None``.
        device: where observations, rewards and flags go. The physics stays on the CPU.
        dtype: floating-point type of observations, actions and rewards.
        snapshots: observe the simulator's state too, as above; ``set_state=True`` needs it.
        from_pixels: observe ``pixels`` too, uint8 ``[num_envs, render_height, render_width, 3]``.
        render_width: width of pictures, pixels.
        render_height: height of pictures, pixels.
        camera: a :class:`envs.Camera`, the name of a camera of the model, or ``"overview"``.

    Raises:
        ValueError: for a size, a seed, a device or a type that no simulation can have.
    """

    FRAME_SKIP: ClassVar[int] = 5

    batch_locked = True
    # The physics steps of a control step are taken in _step, not by repeating it.
    _has_frame_skip = True
    _snapshot_fields: ClassVar[tuple[str, ...]] = ("qpos", "qvel", "qacc_warmstart")

    def __init__(
        self,
        *,
        num_envs: int = 1,
        num_threads: int = 0,
        frame_skip: int | None = None,
        max_episode_steps: int = 1000,
        seed: int | None = None,
        device: torch.device | str | None = None,
        dtype: torch.dtype = torch.float32,
        snapshots: bool = True,
        from_pixels: bool = False,
        render_width: int = 640,
        render_height: int = 360,
        camera: str | Camera = "overview",
    ) -> None:
        frame_skip = self.FRAME_SKIP if frame_skip is None else frame_skip
        check_simulations(
            num_envs=num_envs,
            num_threads=num_threads,
            frame_skip=frame_skip,
            max_episode_steps=max_episode_steps,
            seed=seed,
            device=device,
            dtype=dtype,
            snapshots=snapshots,
            from_pixels=from_pixels,
            render_width=render_width,
            render_height=render_height,
        )
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self.num_envs = num_envs
        self.num_threads = num_threads
        self.frame_skip = frame_skip
        self.max_episode_steps = max_episode_steps
        self.dtype = dtype
        # What NumPy computes results in; PyTorch has types that NumPy lacks.
        self._array_dtype = np.float32 if dtype is torch.float32 else np.float64
        self.snapshots = snapshots
        self._init_pixels(from_pixels, render_width, render_height, camera)
        self.model = self._make_model()
        self._open_batch()
        self._elapsed = torch.zeros(num_envs, 1, dtype=torch.int64)
        self._checked = False
        self.rng = torch.Generator()
        # torch.seed() would reseed the caller's global generator.
        self.set_seed(self.rng.seed() % 2**31 if seed is None else seed)
        self._make_specs()

    # --- hooks ---------------------------------------------------------------------------------

    @abc.abstractmethod
    def _make_model(self) -> mujoco.MjModel:
        """The model that every simulation runs."""

    @abc.abstractmethod
    def _sample_initial_state(
        self, ids: Tensor, tensordict: TensorDictBase | None
    ) -> tuple[Tensor, Tensor]:
        """Draw ``(qpos [n, nq], qvel [n, nv])`` for the ``n`` environments ``ids`` being reset.

        Whatever else an episode needs (a goal, obstacles) is drawn here too.
        """

    @abc.abstractmethod
    def _make_obs_spec(self) -> Composite:
        """Spec of what :meth:`_make_obs` returns, batch shape ``(num_envs,)``."""

    @abc.abstractmethod
    def _make_obs(self, ids: Tensor | None = None) -> dict[str, Tensor | TensorDictBase]:
        """Observations of the environments ``ids`` (``None``: all), leading dimension ``n``."""

    @abc.abstractmethod
    def _make_action_spec(self) -> Bounded:
        """Spec of ``action``, shape ``(num_envs, ...)``."""

    @abc.abstractmethod
    def _make_reward_spec(self) -> Unbounded | Bounded:
        """Spec of ``reward``, shape ``(num_envs, K)``."""

    @abc.abstractmethod
    def _compute_terminated(self, state: PhysicsState, next_state: PhysicsState) -> Tensor:
        """Which episodes end for a reason within the task: bool ``[num_envs, 1]``."""

    @abc.abstractmethod
    def _compute_reward(
        self, state: PhysicsState, action: Tensor, next_state: PhysicsState
    ) -> Tensor:
        """Reward vectors ``[num_envs, K]``; called after :meth:`_compute_terminated`."""

    def _prepare_ctrl(self, action: Tensor) -> Tensor:
        """Map actions to the model's controls, ``[num_envs, nu]``."""
        return action

    def _load_snapshot(self, ids: Tensor, tensordict: TensorDictBase) -> None:
        """Restore the environments ``ids`` from a snapshot; subclasses add their own keys."""
        for name in self._snapshot_fields:
            self._view[name][ids] = tensordict.get(name).cpu()[ids]
        self._elapsed[ids] = tensordict.get("elapsed").cpu()[ids]

    def _on_reset(self, ids: Tensor) -> None:
        """Write mocap bodies, geom sizes and the like of the environments ``ids``.

        Called after their state was sampled or restored.
        """

    def _simulate(self) -> None:
        """The physics of a step; subclasses move mocap bodies, or look in between."""
        self.batch.step(nstep=self.frame_skip)

    # --- native batch --------------------------------------------------------------------------

    def _open_batch(self) -> None:
        """Build the native batch and the live views of its state."""
        self.batch = native_batch(self.model, self.num_envs, self.num_threads)
        self._view = {
            name: torch.from_numpy(self.batch.bind(name))
            for name in (*self._snapshot_fields, "ctrl", "mocap_pos", "mocap_quat")
        }

    def _state(self) -> PhysicsState:
        return PhysicsState(self._view["qpos"], self._view["qvel"])

    def __getstate__(self) -> dict[str, Any]:
        # The native batch cannot be pickled: its rows and per-simulation fields travel instead.
        state = super().__getstate__() if hasattr(super(), "__getstate__") else self.__dict__.copy()
        state = dict(state)
        batch = state.pop("batch")
        state.pop("_view")
        state.pop("_renderer", None)
        state["_rows"] = np.array(batch.state)
        state["_expanded"] = {name: np.array(field) for name, field in batch._expanded.items()}
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        state = dict(state)
        rows, expanded = state.pop("_rows"), state.pop("_expanded")
        if hasattr(super(), "__setstate__"):
            super().__setstate__(state)
        else:
            self.__dict__.update(state)
        self._open_batch()
        for name, values in expanded.items():
            self.batch.expand(name)[...] = values
        if expanded:
            self.batch.set_const()
        self.batch.state[...] = rows
        self.batch.forward()

    # --- checkpoints ---------------------------------------------------------------------------

    def simulation_state(self) -> dict[str, Any]:
        """All that decides how the simulations go on, in the middle of their episodes.

        Unlike a snapshot it is of the whole environment, generators included, and needs no
        ``snapshots``. Subclasses add their own.

        Returns:
            Arrays, tensors, numbers and strings, nested in dictionaries: what a file may hold.
        """
        return {
            "rows": np.array(self.batch.state),
            "expanded": {name: np.array(field) for name, field in self.batch._expanded.items()},
            "elapsed": self._elapsed.clone(),
            "generator": self.rng.get_state(),
        }

    def load_simulation_state(self, state: Mapping[str, Any]) -> None:
        """Go on from :meth:`simulation_state` of an environment with the same arguments.

        Raises:
            ValueError: for the state of another model, or of another number of simulations.
        """
        if state["rows"].shape != self.batch.state.shape:
            raise ValueError(
                f"The state is of {state['rows'].shape[0]} simulations with {state['rows'].shape[1]} "
                f"numbers each, here they are {self.batch.state.shape[0]} with "
                f"{self.batch.state.shape[1]}: give the environment the same arguments."
            )
        for name, values in state["expanded"].items():
            self.batch.expand(name)[...] = values
        if state["expanded"]:
            self.batch.set_const()
        self.batch.state[...] = state["rows"]
        self.batch.forward()
        self._elapsed.copy_(state["elapsed"])
        self.rng.set_state(state["generator"])

    # --- EnvBase -------------------------------------------------------------------------------

    @property
    def _supports_set_state(self) -> bool:
        return self.snapshots

    def _make_specs(self) -> None:
        batch = (self.num_envs,)
        snapshot = Composite(
            {
                name: Unbounded(shape=tuple(self._view[name].shape), dtype=torch.float64)
                for name in self._snapshot_fields
            },
            elapsed=Unbounded(shape=(*batch, 1), dtype=torch.int64),
            shape=batch,
        )
        observation = self._make_obs_spec()
        if self.snapshots:
            observation.update(snapshot)
            self.state_spec = self._make_state_spec(snapshot, observation).to(self.device)
        if self.from_pixels:
            observation["pixels"] = self._pixels_spec()
        self.observation_spec = observation.to(self.device)
        self.action_spec = self._make_action_spec().to(self.device)
        self._action_shape = self.action_spec.shape
        self.reward_spec = self._make_reward_spec().to(self.device)
        self.full_done_spec = Composite(
            {
                name: Binary(n=1, shape=(*batch, 1), dtype=torch.bool)
                for name in ("done", "terminated", "truncated")
            },
            shape=batch,
        ).to(self.device)

    def _make_state_spec(self, snapshot: Composite, observation: Composite) -> Composite:
        """Keys of a snapshot; subclasses add theirs, which must be observations as well."""
        del observation
        return snapshot.clone()

    def _observe(self, ids: Tensor | None = None) -> dict[str, Tensor | TensorDictBase]:
        """Everything observed by the environments ``ids``, as new tensors."""
        out = self._make_obs(ids)
        if self.snapshots:
            state = {name: self._view[name] for name in self._snapshot_fields}
            for name, values in {**state, "elapsed": self._elapsed}.items():
                out[name] = values.clone() if ids is None else values[ids]
        if self.from_pixels:
            out["pixels"] = self._observe_pixels(ids)
        return out

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None or bool(mask.all()):
            ids = torch.arange(self.num_envs)
        else:
            ids = torch.from_numpy(np.flatnonzero(mask.cpu().numpy()))
        set_state = bool(kwargs.get("set_state")) and tensordict is not None
        if set_state:
            given = set(tensordict.keys(include_nested=True, leaves_only=True))
            missing = set(self.state_spec.keys(include_nested=True, leaves_only=True)) - given
            if missing:
                names = sorted(".".join(key) if isinstance(key, tuple) else key for key in missing)
                raise ValueError(
                    f"The snapshot lacks {names}: pass a whole row of a rollout, or set_state=False "
                    "for a new episode."
                )
        self.batch.reset(ids.numpy(), stage=0)
        if set_state:
            self._load_snapshot(ids, tensordict)
        else:
            qpos, qvel = self._sample_initial_state(ids, tensordict)
            self._view["qpos"][ids] = qpos
            self._view["qvel"][ids] = qvel
            self._elapsed[ids] = 0
        self._on_reset(ids)
        rows = self._observe(ids)
        # Given here, they cost TorchRL no specs; an episode never ends at its start.
        for name in ("done", "terminated", "truncated"):
            rows[name] = torch.zeros(len(ids), 1, dtype=torch.bool)
        if ids.numel() != self.num_envs:
            # Only the rows being reset are read from the result.
            rows = {name: self._among_zeros(values, ids) for name, values in rows.items()}
            if self.from_pixels:
                # A VideoRecorder reads the others, too: they keep their last picture.
                rows["pixels"] = self._pixels.clone()
        out = TensorDict(rows, batch_size=self.batch_size)
        return out.to(self.device) if self.device is not None else out

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get(self.action_key, None)
        # Broadcast, one number would be every robot's speed and turn rate.
        if action is None or action.shape != self._action_shape:
            refuse_shape(action, self._action_shape)
        action = action.detach().to("cpu")
        # NaN and infinity survive a sum, which is the cheaper question.
        if not math.isfinite(action.sum()):
            refuse_non_finite(action)
        # On so few numbers, NumPy takes a fraction of PyTorch's time.
        before = PhysicsState(*(torch.from_numpy(view.numpy().copy()) for view in self._state()))
        self._view["ctrl"].copy_(self._prepare_ctrl(action))
        self._simulate()
        elapsed = self._elapsed.numpy()
        elapsed += 1
        after = self._state()
        terminated = self._compute_terminated(before, after)
        ended = terminated.numpy()
        truncated = (elapsed >= self.max_episode_steps) & ~ended
        out = self._observe()
        out["reward"] = self._compute_reward(before, action, after).to(self.dtype)
        out["terminated"] = terminated
        out["truncated"] = torch.from_numpy(truncated)
        out["done"] = torch.from_numpy(truncated | ended)
        if self._checked:
            # Without a look at the shapes, as the environments that TorchRL comes with.
            out = TensorDict._new_unsafe(out, batch_size=self.batch_size)
        else:
            out = TensorDict(out, batch_size=self.batch_size)
            self._checked = True
        return out.to(self.device) if self.device is not None else out

    def _among_zeros(self, values: Tensor | TensorDictBase, ids: Tensor) -> Tensor | TensorDictBase:
        """Rows for the environments ``ids`` in their places, zeros elsewhere."""
        if isinstance(values, TensorDictBase):
            return values.apply(
                lambda leaf: self._among_zeros(leaf, ids), batch_size=self.batch_size
            )
        return values.new_zeros(self.num_envs, *values.shape[1:]).index_copy_(0, ids, values)

    def _set_seed(self, seed: int | None) -> None:
        check_seed(seed)
        if seed is not None:
            self.rng.manual_seed(seed)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Release the graphics memory, if pictures were drawn."""
        self._close_renderer()
        super().close(raise_if_closed=raise_if_closed)
