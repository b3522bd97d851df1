"""Preferences drawn at reset."""

from __future__ import annotations

from collections.abc import Sequence
from multiprocessing import parent_process

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Bounded, Composite
from torchrl.envs.transforms import Transform

from torchrl_morl.arguments import check_count, check_seed
from torchrl_morl.generators import generator_from, generator_state
from torchrl_morl.preferences import (
    PreferenceSpace,
    SamplingDistribution,
    check_distribution,
    check_preference_space,
)
from torchrl_morl.representation import describe
from torchrl_morl.segments import PreferenceSegments
from torchrl_morl.transforms.holder import is_in_environment
from torchrl_morl.transforms.stored import apart_from_storage

__all__ = ["PreferenceSampler"]


class _RandomPreferences(Transform):
    """A transform that draws preferences from a generator of its own, kept in the state dict."""

    def __init__(
        self,
        preference_space: PreferenceSpace,
        distribution: SamplingDistribution,
        seed: int | None,
        **keys: list[NestedKey],
    ) -> None:
        super().__init__(**keys)
        check_distribution(distribution)
        check_preference_space(preference_space)
        self.preference_space = preference_space
        self.distribution = distribution
        check_seed(seed)
        self.generator = None if seed is None else torch.Generator().manual_seed(seed)

    def clone(self) -> Transform:
        clone = super().clone()
        if self.generator is not None:
            # The base class shares attributes: a clone would take draws away from the original.
            clone.generator = self.generator.clone_state()
        return clone

    def get_extra_state(self) -> Tensor:
        """The state of the generator; empty if the global one is used."""
        return generator_state(self.generator)

    def set_extra_state(self, state: Tensor) -> None:
        """Restore the state of the generator."""
        self.generator = generator_from(state, self.generator)

    @property
    def _seed(self) -> int | None:
        """What the generator started from; ``None`` for the global one."""
        return None if self.generator is None else self.generator.initial_seed()

    def _sample(self, shape: Sequence[int], like: Tensor) -> Tensor:
        # Drawn on the CPU, where the generator lives, so that one seed gives one stream on any
        # device.
        drawn = self.preference_space.sample(shape, self.distribution, self.generator, "cpu")
        return drawn.to(device=like.device, dtype=like.dtype)


class PreferenceSampler(_RandomPreferences):
    """Draw a preference for every episode and carry it through the episode.

    - At reset each environment that is being reset gets a new preference; partial resets leave the
      others alone.
    - A preference in the tensordict given to ``env.reset(tensordict)`` is validated and used
      instead of a draw, also where :meth:`fixed` was asked for. Automatic resets (rollouts,
      collectors) hide the old preference, so they draw.
    - During the episode the preference of the next step is that of the current one. Writing
      ``tensordict["preference"]`` between two steps changes it from that step on, until the episode
      ends. ``env.step`` refuses one off the simplex before anything moves. It looks at the values only
      where the preference is another tensor than the last one handed out or stepped with, or was
      written to; not under :func:`torch.compile`.

    The key is in the observation and in the state specs, with entries in [0, 1]. As a module or in
    a replay buffer the transform adds a preference where there is none, at the root and in
    ``"next"``, and leaves a given one alone.

    Place it outside of a :class:`~torchrl.envs.SerialEnv` or :class:`~torchrl.envs.ParallelEnv` if
    you can: inside, every worker has a sampler of its own, and those with the same seed draw the
    same preferences.

    Args:
        preference_space (PreferenceSpace): the preferences to draw from.

    Keyword Args:
        distribution (str): see :meth:`PreferenceSpace.sample`.
        num_segments (int, optional): the environment of index ``i`` in the flattened batch draws
            from cell ``i % num_segments`` of :class:`~torchrl_morl.segments.PreferenceSegments`,
            as in PD-MORL (https://arxiv.org/abs/2208.07914). Defaults to the whole simplex.
        slabs (bool): those cells are slabs of the first entry, as in PD-MORL's code.
        preference_key (NestedKey): where to write preferences, of shape ``[*B, T]``.
        reset_key (NestedKey, optional): the reset mask. Only environments that reset themselves and
            have several masks need it; others may leave it out.
        seed (int, optional): the seed of the transform's own generator, whose state is in the state
            dict. Without one, draws come from the global generator of torch or, in a worker
            process, from a generator seeded by the operating system. ``env.set_seed`` does not
            reach transforms in TorchRL 0.14.

    Raises:
        ValueError: if the distribution is unknown, there is less than one segment, or slabs without segments;
            at a reset or a step, if a given preference is invalid; at reset, if the fixed preferences do not
            fit the batch.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_morl.testing import VectorRewardMockEnv
        >>> space = PreferenceSpace(("distance", "efficiency"))
        >>> sampler = PreferenceSampler(space, seed=0)
        >>> env = TransformedEnv(VectorRewardMockEnv(2, batch_size=(4,)), sampler)
        >>> tensordict = env.reset()
        >>> tensordict["preference"].shape
        torch.Size([4, 2])
        >>> tensordict["preference"] = space.validate([[0.25, 0.75]] * 4)
        >>> env.reset(tensordict)["preference"][0]
        tensor([0.2500, 0.7500])

    """

    def __init__(
        self,
        preference_space: PreferenceSpace,
        *,
        distribution: SamplingDistribution = "dirichlet",
        num_segments: int | None = None,
        slabs: bool = False,
        preference_key: NestedKey = "preference",
        reset_key: NestedKey | None = None,
        seed: int | None = None,
    ) -> None:
        super().__init__(
            preference_space, distribution, seed, in_keys=[], out_keys=[preference_key]
        )
        self.segments = None
        if num_segments is not None:
            check_count("num_segments", num_segments)
            self.segments = PreferenceSegments(preference_space, num_segments, slabs)
        elif slabs:
            raise ValueError("slabs cut the segments of num_segments=, which is None.")
        self.preference_key = unravel_key(preference_key)
        self.reset_key = None if reset_key is None else unravel_key(reset_key)
        self.register_buffer("preferences", None)
        # Tensors that were valid, with their versions then: handed out last, and last stepped with.
        self._handed_out: tuple[Tensor, int] | None = None
        self._stepped_with: tuple[Tensor, int] | None = None

    @classmethod
    def fixed(
        cls,
        preference_space: PreferenceSpace,
        preferences: Tensor | Sequence,
        *,
        preference_key: NestedKey = "preference",
        reset_key: NestedKey | None = None,
    ) -> PreferenceSampler:
        """Give the same preference at every reset, for instance one per environment of a test grid.

        Args:
            preference_space (PreferenceSpace): the space that the preferences belong to.
            preferences (Tensor or nested sequence): one preference for all, of shape ``[T]``, or
                one row per environment in the order of the flattened batch, of shape ``[N, T]``.

        Keyword Args:
            preference_key (NestedKey): see the class.
            reset_key (NestedKey, optional): see the class.

        Returns:
            A sampler that draws nothing.

        Raises:
            ValueError: if a preference is invalid.

        Example:
            >>> from torchrl.envs import TransformedEnv
            >>> from torchrl_morl.testing import VectorRewardMockEnv
            >>> space = PreferenceSpace(("distance", "efficiency"))
            >>> grid = space.pairwise_grid(3)
            >>> sampler = PreferenceSampler.fixed(space, grid)
            >>> env = TransformedEnv(VectorRewardMockEnv(2, batch_size=(3,)), sampler)
            >>> bool((env.reset()["preference"] == grid).all())
            True

        """
        sampler = cls(preference_space, preference_key=preference_key, reset_key=reset_key)
        sampler.preferences = preference_space.validate(preferences).to(torch.get_default_dtype())
        return sampler

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add a preference to a tensordict that has none.

        Args:
            tensordict (TensorDictBase): data of shape ``[*B]``.

        Returns:
            The same tensordict; ``"next"``, if it is there, holds the preference of the root. For a
            lazy stack, a shallow copy of it.

        """
        tensordict = apart_from_storage(tensordict)
        preference = tensordict.get(self.preference_key, None)
        if preference is None:
            preference = self._draw(tensordict)
            tensordict.set(self.preference_key, preference)
            if "next" in tensordict:
                tensordict.set(("next", self.preference_key), preference.clone())
        return tensordict

    def __repr__(self) -> str:
        settings = {"preference_space": self.preference_space}
        if self.preferences is not None:
            settings["preferences"] = self.preferences.tolist()
        else:
            settings["distribution"] = self.distribution
            settings["seed"] = self._seed
            if self.segments is not None:
                settings["num_segments"] = self.segments.num_segments
                settings["slabs"] = self.segments.slabs
        return describe(self, **settings, preference_key=self.preference_key)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        # TorchRL calls this before it steps the environment.
        preference = tensordict.get(self.preference_key, None)
        if preference is None or torch.compiler.is_compiling():
            return tensordict
        if _is(preference, self._stepped_with):
            return tensordict
        if not _is(preference, self._handed_out):
            if not is_in_environment(self):
                return tensordict
            self.preference_space.validate(preference)
        # Past Module.__setattr__, which takes longer than the check.
        object.__setattr__(self, "_stepped_with", _now(preference))
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        # A clone, so that writing to the next preference in place cannot alter what is stored of
        # this step.
        self._hand_out(tensordict[self.preference_key].clone(), next_tensordict)
        return next_tensordict

    def _hand_out(self, preference: Tensor, tensordict: TensorDictBase) -> None:
        """Set a valid preference, and remember that it is."""
        tensordict.set(self.preference_key, preference)
        if not torch.compiler.is_compiling():
            object.__setattr__(self, "_handed_out", _now(preference))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # There is a row for every environment; `env.reset` keeps those that the mask selects.
        preference = tensordict.get(self.preference_key, None)
        if preference is None:
            preference = self._draw(tensordict_reset)
        else:
            expected = (*tensordict_reset.batch_size, self.preference_space.num_tunable)
            if preference.shape != expected:
                raise ValueError(
                    f"{self.preference_key!r} must have shape {list(expected)} at reset, got "
                    f"{list(preference.shape)}."
                )
            preference = self.preference_space.validate(preference).to(torch.get_default_dtype())
        self._hand_out(preference, tensordict_reset)
        return tensordict_reset

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # Here the tensordict holds the preference of the episode that has ended.
        reset_key = self.reset_key
        if reset_key is None:
            reset_keys = self.parent.reset_keys
            if len(reset_keys) > 1:
                raise ValueError(f"reset_key must be one of the reset keys {reset_keys}.")
            reset_key = reset_keys[0]
        current = tensordict[self.preference_key]
        mask = tensordict[reset_key].reshape(*tensordict.batch_size, -1).any(-1, keepdim=True)
        preference = torch.where(mask, self._draw(tensordict_reset), current)
        self._hand_out(preference, tensordict_reset)
        return tensordict_reset

    def _draw(self, tensordict: TensorDictBase) -> Tensor:
        batch, device = tensordict.batch_size, tensordict.device
        if self.preferences is not None:
            fixed = self.preferences.to(device)
            if fixed.ndim == 1:
                return fixed.repeat(*batch, 1) if batch else fixed.clone()
            if fixed[..., 0].numel() != batch.numel():
                raise ValueError(
                    f"{fixed[..., 0].numel()} fixed preferences do not fit a batch of "
                    f"{batch.numel()} environments."
                )
            return fixed.reshape(*batch, -1).clone()
        if self.generator is None and parent_process() is not None:
            # Forked or spawned, all workers start with the same global state: without this they
            # would go through the same preferences in lockstep.
            self.generator = torch.Generator()
            self.generator.seed()
        if self.segments is None:
            preference = self.preference_space.sample(
                batch, self.distribution, self.generator, "cpu"
            )
        else:
            index = torch.arange(batch.numel()).reshape(batch) % self.segments.num_segments
            preference = self.segments.sample(index, self.distribution, self.generator)
        return preference.to(device)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        return self._add_spec(observation_spec)

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        # Only keys of the state spec reach `_reset`, and the workers of a batched environment.
        return self._add_spec(state_spec)

    def _add_spec(self, spec: Composite) -> Composite:
        spec = spec.clone()
        shape = (*spec.shape, self.preference_space.num_tunable)
        spec[self.preference_key] = Bounded(0.0, 1.0, shape=shape, device=spec.device)
        return spec

    def _check_batched_worker_compat(self) -> None:
        num_envs = self.parent.batch_size.numel()
        if self.segments is not None and num_envs < self.segments.num_segments:
            raise ValueError(
                f"a worker of {num_envs} environment(s) never reaches the last of "
                f"{self.segments.num_segments} segments: place the PreferenceSampler outside of "
                "the batched environment."
            )


def _now(tensor: Tensor) -> tuple[Tensor, int] | None:
    """The tensor and how often it was written to, which those of inference mode do not count."""
    return None if tensor.is_inference() else (tensor, tensor._version)


def _is(tensor: Tensor, then: tuple[Tensor, int] | None) -> bool:
    """Whether it is that tensor, and nobody has written to it."""
    return then is not None and tensor is then[0] and tensor._version == then[1]
