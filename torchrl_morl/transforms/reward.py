"""Scalarization of vector rewards."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from torchrl_morl.arguments import key_list
from torchrl_morl.preferences import PreferenceSpace, check_preference_space
from torchrl_morl.representation import describe
from torchrl_morl.transforms.stored import apart_from_storage

__all__ = ["ScalarizeReward"]


class ScalarizeReward(Transform):
    """Weigh a vector reward with the preference under which the action was taken.

    The scalar reward of a transition is ``weights(preference_t) . reward``: the preference is read
    at the root, so a change between two steps affects the next reward only. In an environment place
    it after the :class:`~torchrl_morl.transforms.PreferenceSampler`; to compare with a scalar
    algorithm, give its loss the new key (``loss.set_keys(reward="scalar_reward")``).

    As a module or in a replay buffer it scalarizes ``("next", reward)`` into ``("next",
    scalar_reward)``; a tensordict without that entry is treated as a flat one, with the reward at
    the root. Behind a :class:`~torchrl_morl.transforms.PreferenceRelabel` it thus follows the new
    preferences.

    Args:
        preference_space (PreferenceSpace): gives the weights.
        in_keys (Sequence[NestedKey]): vector rewards of shape ``[*B, K]``.
        out_keys (Sequence[NestedKey]): where to write scalar rewards of shape ``[*B, 1]``.

    Keyword Args:
        preference_key (NestedKey): preferences of shape ``[*B, T]``.

    Raises:
        ValueError: if the numbers of keys differ or a reward does not have ``K`` entries.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> space = PreferenceSpace(("core", "distance", "efficiency"), static={"core": 1.0})
        >>> data = TensorDict(
        ...     preference=torch.tensor([0.5, 0.5]),
        ...     next=TensorDict(reward=torch.tensor([3.0, -2.0, -4.0])),
        ... )
        >>> ScalarizeReward(space)(data)["next", "scalar_reward"]
        tensor([0.])

    """

    def __init__(
        self,
        preference_space: PreferenceSpace,
        in_keys: Sequence[NestedKey] = ("reward",),
        out_keys: Sequence[NestedKey] = ("scalar_reward",),
        *,
        preference_key: NestedKey = "preference",
    ) -> None:
        in_keys, out_keys = key_list(in_keys), key_list(out_keys)
        if len(in_keys) != len(out_keys):
            raise ValueError(f"got {len(in_keys)} in_keys but {len(out_keys)} out_keys.")
        super().__init__(in_keys=in_keys, out_keys=out_keys)
        check_preference_space(preference_space)
        self.preference_space = preference_space
        self.preference_key = unravel_key(preference_key)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add scalar rewards to recorded transitions.

        Args:
            tensordict (TensorDictBase): holds the preference and, in ``"next"`` or at the root, the
                rewards.

        Returns:
            The same tensordict with the ``out_keys`` next to the ``in_keys``; for a lazy stack, a
            shallow copy of it.

        """
        tensordict = apart_from_storage(tensordict)
        weights = self.preference_space.weights(tensordict[self.preference_key])
        for in_key, out_key in zip(self.in_keys, self.out_keys):
            reward = tensordict.get(("next", in_key), None)
            if reward is None:
                reward = tensordict[in_key]
            else:
                out_key = unravel_key(("next", out_key))
            tensordict.set(out_key, self._scalarize(weights, reward))
        return tensordict

    def __repr__(self) -> str:
        return describe(
            self,
            preference_space=self.preference_space,
            in_keys=self.in_keys,
            out_keys=self.out_keys,
            preference_key=self.preference_key,
        )

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        weights = self.preference_space.weights(tensordict[self.preference_key])
        for in_key, out_key in zip(self.in_keys, self.out_keys):
            next_tensordict.set(out_key, self._scalarize(weights, next_tensordict[in_key]))
        return next_tensordict

    def _scalarize(self, weights: Tensor, reward: Tensor) -> Tensor:
        # Checked here too, as a reward of one entry would silently broadcast.
        self._check_size("reward", reward.shape[-1])
        return (weights * reward).sum(-1, keepdim=True)

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        reward_spec = reward_spec.clone()
        for in_key, out_key in zip(self.in_keys, self.out_keys):
            spec = reward_spec[in_key]
            self._check_size(in_key, spec.shape[-1])
            # Unbounded even for bounded rewards: rounding can take a weighted sum over the exact
            # bound.
            reward_spec[out_key] = Unbounded(
                (*spec.shape[:-1], 1), device=spec.device, dtype=spec.dtype
            )
        return reward_spec

    def _check_size(self, key: NestedKey, size: int) -> None:
        if size != self.preference_space.num_objectives:
            raise ValueError(
                f"{key!r} has {size} entries, but there are {self.preference_space.num_objectives} "
                f"objectives: {self.preference_space.objectives}."
            )
