"""Rollouts of one policy under many preferences, over the same episodes."""

from __future__ import annotations

from collections.abc import Callable

import torch
from numpy.typing import ArrayLike
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from .arrays import as_flags, as_numbers

__all__ = ["episode_mask", "rollout_preferences"]


def episode_mask(done: Tensor) -> Tensor:
    """Steps up to and including the first ``done``: ``[*B, T, 1]`` -> ``[*B, T]``.

    Examples:
        >>> import torch
        >>> episode_mask(torch.tensor([False, True, True]).unsqueeze(-1))
        tensor([ True,  True, False])
    """
    done = as_flags(done)
    ended = done.squeeze(-1).cumsum(-1)
    return (ended - done.squeeze(-1).to(ended.dtype)) == 0


@torch.no_grad()
def rollout_preferences(
    env: EnvBase,
    policy: TensorDictModuleBase,
    preferences: Tensor | ArrayLike,
    *,
    max_steps: int,
    seed: int,
    preference_key: NestedKey = "preference",
    keep: Callable[[TensorDictBase], TensorDictBase] | None = None,
    on_preference: Callable[[int], None] | None = None,
) -> TensorDictBase:
    """Roll a policy out once per preference, each time over the same episodes.

    The environment is seeded anew for every preference, so that episode ``i`` starts from the
    same state under all of them: comparisons between preferences are paired.

    Args:
        env: an environment of batch size ``[N]`` that honours ``preference_key`` at reset.
        policy: acts deterministically; on any device.
        preferences: ``[P, T]``, a tensor, a NumPy array or nested lists.

    Keyword Args:
        max_steps: longest episode.
        seed: of the environment.
        preference_key: where the preference is.
        keep: picks what to keep of a rollout (default: everything), to bound memory.
        on_preference: called with the index of each preference when it is done.

    Returns:
        A tensordict of batch size ``[P, N, S]``, ``S`` the longest episode found, with ``mask``
        ``[P, N, S]`` marking the steps that belong to each (first) episode. Shorter rollouts are
        padded with their zeros and a false mask.

    Raises:
        ValueError: if the preferences are no table with at least one row, or not valid.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_morl.preferences import PreferenceSpace
        >>> from torchrl_morl.testing import VectorRewardMockEnv
        >>> from torchrl_morl.transforms import PreferenceSampler
        >>> sampler = PreferenceSampler(PreferenceSpace(("right", "left")))
        >>> env = TransformedEnv(VectorRewardMockEnv(2, batch_size=(4,)), sampler)
        >>> policy = TensorDictModule(lambda p: p, in_keys=["preference"], out_keys=["action"])
        >>> data = rollout_preferences(env, policy, [[1, 0], [0.5, 0.5]], max_steps=3, seed=0)
        >>> data["next", "reward"].shape
        torch.Size([2, 4, 3, 2])
    """
    preferences = as_numbers(preferences).to(torch.get_default_dtype())
    if preferences.ndim != 2 or not len(preferences):
        raise ValueError(
            f"preferences must have shape [P, T], one a row, got {list(preferences.shape)}."
        )
    result, lengths = None, []
    for index, preference in enumerate(preferences):
        env.set_seed(seed)
        start = TensorDict(batch_size=env.batch_size, device=env.device)
        start.set(preference_key, preference.to(env.device).expand(*env.batch_size, -1).clone())
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            rollout = env.rollout(
                max_steps,
                policy,
                auto_reset=False,
                tensordict=env.reset(start, set_state=False),
                break_when_any_done=False,
                break_when_all_done=True,
                # A policy on a GPU drives an environment that is simulated on the CPU.
                auto_cast_to_device=True,
            )
        rollout.set("mask", episode_mask(rollout["next", "done"]))
        if keep is not None:
            mask = rollout["mask"]
            rollout = keep(rollout)
            rollout.set("mask", mask)
        if result is None:
            # For all at once, since small tensors that stay between two rollouts keep the allocator
            # from giving the memory of the first one to the second. Untouched pages cost nothing.
            row = rollout[..., :1].unsqueeze(0)
            shape = (len(preferences), *rollout.shape[:-1], max_steps)
            result = torch.empty_like(row.expand(shape))
        lengths.append(rollout.shape[-1])
        result[index, ..., : lengths[-1]] = rollout
        del rollout
        if on_preference is not None:
            on_preference(index)
    longest = max(lengths)
    for index, length in enumerate(lengths):
        result[index, ..., length:longest].zero_()
    return result[..., :longest].contiguous()
