"""The navigation task as a policy sees it: features instead of sensors, and actions in [-1, 1]."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import ExcludeTransform, TransformedEnv

from torchrl_morl.deploy.features import observation_parts, policy_transforms
from torchrl_morl.transforms import PreferenceSampler, RewardModelReward

from .navigation import NavigationEnv

_OBSERVED = ("observe_human", "observe_human_velocity")


def observed(arguments: Mapping[str, Any]) -> dict[str, bool]:
    """Those of the arguments of :func:`make_policy_env` that say what the policy observes."""
    return {name: arguments[name] for name in _OBSERVED if name in arguments}


def simulated(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """The other arguments of :func:`make_policy_env`: those of :class:`NavigationEnv`."""
    return {name: value for name, value in arguments.items() if name not in _OBSERVED}


def observation_size(arguments: Mapping[str, Any]) -> int:
    """Entries of the observation under these arguments of :func:`make_policy_env`."""
    return sum(map(len, observation_parts(**observed(arguments)).values()))


def make_policy_env(
    sampler: PreferenceSampler | None = None,
    *,
    reward_model: TensorDictModuleBase | None = None,
    keep_simulation: bool = False,
    observe_human: bool = True,
    observe_human_velocity: bool = False,
    **kwargs: Any,
) -> TransformedEnv:
    """A :class:`NavigationEnv` as a preference-conditioned policy sees it.

    Args:
        sampler: gives every episode its preference; without one there is no preference.

    Keyword Args:
        reward_model: scores demonstration-likeness of ``observation`` and ``action``; it becomes
            the objective "demo", in second place of the reward.
        keep_simulation: keep raw scans and the simulator's state in the rollouts, for figures and
            snapshots; without them a transition takes 1 kB instead of 13 kB.
        observe_human: see :func:`policy_transforms`; the human's position itself stays in the
            rollouts, under keys that a policy does not read.
        observe_human_velocity: see :func:`policy_transforms`; for humans who walk.
        **kwargs: see :class:`NavigationEnv`.

    Returns:
        An environment with ``observation`` ``[N, 36]`` and ``preference`` ``[N, T]``, whose
        ``action`` is in [-1, 1].
    """
    base = NavigationEnv(snapshots=keep_simulation, **kwargs)
    transforms = policy_transforms(
        base.max_range,
        period=base.CONTROL_PERIOD,
        observe_human=observe_human,
        observe_human_velocity=observe_human_velocity,
    )
    if sampler is not None:
        transforms.append(sampler)
    if reward_model is not None:
        transforms.append(RewardModelReward(reward_model, position=1))
    if not keep_simulation:
        transforms.append(ExcludeTransform("scan", "lidar"))
    env = TransformedEnv(base, transforms)
    # ActionScaling (https://github.com/pytorch/rl/pull/3765) fills its buffers when its bounds are first
    # asked for. Until then `env.state_dict()` and a deep copy raise.
    _ = env.action_spec
    return env
