"""Hindsight preferences: replay-buffer transforms that let a transition teach other preferences.

Rewards are vectors, so a transition is valid for every preference: only the preference has to
change.
"""

from __future__ import annotations

import numbers

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import TensorSpec

from torchrl_morl.arguments import check_count
from torchrl_morl.generators import rand
from torchrl_morl.preferences import PreferenceSpace, SamplingDistribution
from torchrl_morl.representation import describe
from torchrl_morl.transforms.preference import _RandomPreferences
from torchrl_morl.transforms.stored import apart_from_storage

__all__ = ["PreferenceExpand", "PreferenceRelabel"]


class _HindsightPreferences(_RandomPreferences):
    """What the two ways of relabelling share: keys, and no life in an environment."""

    def __init__(
        self,
        preference_space: PreferenceSpace,
        distribution: SamplingDistribution,
        preference_key: NestedKey,
        seed: int | None,
    ) -> None:
        super().__init__(
            preference_space,
            distribution,
            seed,
            in_keys=[preference_key],
            out_keys=[preference_key],
        )
        self.preference_key = unravel_key(preference_key)
        self.next_key = unravel_key(("next", preference_key))

    def _describe(self, **settings: float) -> str:
        return describe(
            self,
            preference_space=self.preference_space,
            **settings,
            distribution=self.distribution,
            seed=self._seed,
            preference_key=self.preference_key,
        )

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        # Every environment asks for its specs before its first reset; replay buffers never do.
        raise RuntimeError(f"{type(self).__name__} is for replay buffers, not for environments.")

    def _replace(self, tensordict: TensorDictBase, mask: Tensor) -> TensorDictBase:
        """Draw one new preference for the root and "next" of every transition in the mask."""
        tensordict = apart_from_storage(tensordict)
        current = tensordict[self.preference_key]
        mask = mask.to(current.device).unsqueeze(-1)
        drawn = self._sample(current.shape[:-1], like=current)
        tensordict.set(self.preference_key, torch.where(mask, drawn, current))
        # Elsewhere "next" keeps its own value: the user may have changed it between the steps.
        following = tensordict.get(self.next_key, None)
        if following is not None:
            tensordict.set(self.next_key, torch.where(mask, drawn, following))
        return tensordict


class PreferenceRelabel(_HindsightPreferences):
    """Replace the preferences of a share of every sampled batch by random ones.

    The sample-time form of PD-MORL's hindsight (https://arxiv.org/abs/2208.07914): the cost is that
    of the batch, the storage keeps each transition once, with the preference that it was collected
    under, and the random preferences are new each time. Its default ratio is the share that the
    three copies of :class:`PreferenceExpand` make up.

    Rewards are left alone: place a :class:`~torchrl_morl.transforms.ScalarizeReward` behind it if a
    scalar reward is needed.

    Every element of the batch is drawn on its own, and the root and ``"next"`` of a relabelled
    transition get one value. This suits one-step losses, and multi-step returns that were computed
    before storing. In a batch of trajectory slices the preference would change from step to step
    within a slice; do not use it there.

    Args:
        preference_space (PreferenceSpace): the preferences to draw from.
        ratio (float): the probability in [0, 1] that a transition is relabelled.

    Keyword Args:
        distribution (str): see :meth:`PreferenceSpace.sample`.
        preference_key (NestedKey): preferences of shape ``[*B, T]`` at the root and, optionally, in
            ``"next"``.
        seed (int, optional): the seed of the transform's own generator, whose state is in the state
            dict. Without one, draws come from the global generator of torch, which, unlike a
            generator of one's own, :func:`torch.compile` can trace.

    Raises:
        ValueError: if the ratio is outside of [0, 1] or the distribution is unknown.
        RuntimeError: if it is used in an environment.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> space = PreferenceSpace(("distance", "efficiency"))
        >>> preference = torch.tensor([[1.0, 0.0]]).repeat(1000, 1)
        >>> batch = TensorDict(preference=preference, batch_size=[1000])
        >>> relabelled = PreferenceRelabel(space, ratio=0.75, seed=0)(batch)["preference"][:, 0] < 1
        >>> 0.7 < relabelled.float().mean() < 0.8
        tensor(True)

    """

    def __init__(
        self,
        preference_space: PreferenceSpace,
        ratio: float = 0.75,
        *,
        distribution: SamplingDistribution = "dirichlet",
        preference_key: NestedKey = "preference",
        seed: int | None = None,
    ) -> None:
        if not (isinstance(ratio, numbers.Real) and 0 <= ratio <= 1):
            raise ValueError(f"ratio must be in [0, 1], got {ratio!r}.")
        super().__init__(preference_space, distribution, preference_key, seed)
        self.ratio = ratio

    def __repr__(self) -> str:
        return self._describe(ratio=self.ratio)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Relabel a batch.

        Args:
            tensordict (TensorDictBase): transitions of shape ``[*B]``.

        Returns:
            The same tensordict with new tensors for the preferences; for a lazy stack, a shallow
            copy of it.

        """
        batch = tensordict[self.preference_key].shape[:-1]
        mask = rand(batch, self.generator, "cpu") < self.ratio
        return self._replace(tensordict, mask)


class PreferenceExpand(_HindsightPreferences):
    """Store every transition once as it is and several times with random preferences.

    PD-MORL's own form of hindsight (https://arxiv.org/abs/2208.07914, N_w copies), kept for
    comparison: it costs ``1 + copies`` times the storage, and a transition's random preferences
    never change. See :class:`PreferenceRelabel` for the alternative.

    It acts on ``rb.extend``; ``rb.add``, which stores one element, cannot hold the copies. A
    transition and its copies are neighbours in the first dimension, so that a full buffer drops
    them together. Copies are drawn per transition, as in :class:`PreferenceRelabel`, and
    interleaved: the storage is not for sampling trajectory slices.

    Args:
        preference_space (PreferenceSpace): the preferences to draw from.
        copies (int): the number of copies with random preferences, at least one.

    Keyword Args:
        distribution (str): see :meth:`PreferenceSpace.sample`; PD-MORL's code uses ``"abs_normal"``.
        preference_key (NestedKey): preferences of shape ``[N, *B, T]`` at the root and, optionally,
            in ``"next"``.
        seed (int, optional): the seed of the transform's own generator, whose state is in the state
            dict. Without one, draws come from the global generator of torch.

    Raises:
        ValueError: if there is less than one copy, if the distribution is unknown, or if the data has no
            batch dimension.
        RuntimeError: if it is used in an environment.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> space = PreferenceSpace(("distance", "efficiency"))
        >>> buffer = TensorDictReplayBuffer(
        ...     storage=LazyTensorStorage(100),
        ...     transform=PreferenceExpand(space, copies=3),
        ...     batch_size=4,
        ... )
        >>> data = TensorDict(preference=space.corners(), batch_size=[2])
        >>> _ = buffer.extend(data)
        >>> len(buffer), buffer[::4]["preference"]
        (8, tensor([[1., 0.],
                [0., 1.]]))

    """

    def __init__(
        self,
        preference_space: PreferenceSpace,
        copies: int = 3,
        *,
        distribution: SamplingDistribution = "dirichlet",
        preference_key: NestedKey = "preference",
        seed: int | None = None,
    ) -> None:
        check_count("copies", copies)
        super().__init__(preference_space, distribution, preference_key, seed)
        self.copies = copies

    def __repr__(self) -> str:
        return self._describe(copies=self.copies)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return what was sampled: the expansion took place when it was stored.

        Args:
            tensordict (TensorDictBase): a sampled batch.

        Returns:
            The same tensordict.

        """
        return tensordict

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if not tensordict.ndim:
            raise ValueError(
                "PreferenceExpand stores several entries per transition: use rb.extend with a "
                "batch, not rb.add."
            )
        group = 1 + self.copies
        index = torch.arange(len(tensordict) * group)
        expanded = tensordict[index // group]
        mask = (index % group != 0).reshape(-1, *[1] * (expanded.ndim - 1))
        return self._replace(expanded, mask)
