"""The preference, shown in the pictures of an environment."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from numpy.typing import ArrayLike
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs.transforms import Transform

from torchrl_morl.evaluation.overlay import bar_colors, draw_preference
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.representation import describe
from torchrl_morl.transforms.stored import apart_from_storage

__all__ = ["PreferenceOverlay"]


class PreferenceOverlay(Transform):
    """Draw the preference into the pictures of an environment.

    A :class:`~torchrl.record.VideoRecorder` placed after it records pictures that say which
    preference was followed. Place it after the
    :class:`~torchrl_morl.transforms.PreferenceSampler`. In a partial reset, the environments that
    are not being reset keep their last picture.

    Args:
        preference_space: the objectives; the chart names the tunable ones.

    Keyword Args:
        in_keys: pictures, ``uint8 [*B, H, W, 3]``.
        out_keys: where to write; defaults to ``in_keys``.
        preference_key: the preference, ``[*B, T]``.
        colors: of the bars, ``[T, 3]``, red, green and blue from 0 to 1; defaults to colour-blind
            safe ones.

    Raises:
        ValueError: for colours of a wrong shape or range.
        KeyError: in an environment without preferences.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> space = PreferenceSpace(("core", "distance", "efficiency"), static={"core": 1.0})
        >>> overlay = PreferenceOverlay(space)
        >>> data = TensorDict(
        ...     pixels=torch.zeros(4, 120, 200, 3, dtype=torch.uint8),
        ...     preference=torch.full((4, 2), 0.5),
        ...     batch_size=4,
        ... )
        >>> bool(overlay(data)["pixels"].any())
        True

    """

    def __init__(
        self,
        preference_space: PreferenceSpace,
        *,
        in_keys: Sequence[NestedKey] = ("pixels",),
        out_keys: Sequence[NestedKey] | None = None,
        preference_key: NestedKey = "preference",
        colors: ArrayLike | None = None,
    ) -> None:
        in_keys = [unravel_key(key) for key in in_keys]
        super().__init__(in_keys=in_keys, out_keys=list(in_keys if out_keys is None else out_keys))
        self.preference_space = preference_space
        self.preference_key = unravel_key(preference_key)
        bar_colors(colors, preference_space.tunable)  # refused here, not at the first picture
        self.colors = colors
        self._last: dict[NestedKey, Tensor] = {}

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Draw into the pictures of data, for instance of a replay buffer."""
        tensordict = apart_from_storage(tensordict)
        return self._draw(tensordict, tensordict)

    def __repr__(self) -> str:
        return describe(
            self,
            objectives=self.preference_space.tunable,
            in_keys=self.in_keys,
            out_keys=self.out_keys,
            preference_key=self.preference_key,
        )

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._remember(self._draw(next_tensordict, tensordict))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self._draw(tensordict_reset, tensordict)
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is not None and not mask.all():
            # A sampler draws a preference for every row, but the others go on with theirs.
            for key, last in self._last.items():
                frames = tensordict_reset.get(key)
                if last.shape == frames.shape:
                    chosen = mask.reshape(*mask.shape[: frames.ndim - 3], 1, 1, 1)
                    tensordict_reset.set(key, torch.where(chosen, frames, last))
        return self._remember(tensordict_reset)

    def _remember(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._last = {key: tensordict.get(key) for key in self.out_keys}
        return tensordict

    def _draw(self, target: TensorDictBase, fallback: TensorDictBase | None) -> TensorDictBase:
        preference = target.get(self.preference_key, None)
        if preference is None and fallback is not None:
            preference = fallback.get(self.preference_key, None)
        if preference is None:
            raise KeyError(
                f"PreferenceOverlay found no {self.preference_key!r}: place it after the "
                "PreferenceSampler."
            )
        names = self.preference_space.tunable
        for in_key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            frames = target.get(in_key)
            target.set(out_key, draw_preference(frames, preference, names, colors=self.colors))
        return target

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        observation_spec = observation_spec.clone()
        for in_key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            observation_spec[out_key] = observation_spec[in_key].clone()
        return observation_spec
