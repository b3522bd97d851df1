"""What stands between the simulation and a policy: observation scaling and action bounds."""

from __future__ import annotations

import dataclasses
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import (
    ActionScaling,
    CatTensors,
    Compose,
    ExcludeTransform,
    TransformedEnv,
    UnaryTransform,
)

from torchrl_morl.transforms import (
    CheckFinite,
    LidarMinPool,
    PolarFeatures,
    PreferenceSampler,
    RewardModelReward,
)

from .navigation import NavigationEnv

NUM_SECTORS = 30
GOAL_SCALE = 5.0
HUMAN_SCALE = 2.0
OBSERVATION_SIZE = NUM_SECTORS + 3 + 3


@dataclasses.dataclass(frozen=True)
class LogRange:
    """Maps ranges in metres to ``log(range / max_range) / 3``."""

    max_range: float

    def __call__(self, ranges: Tensor) -> Tensor:
        """Ranges of any shape, at least a millimetre."""
        return (ranges / self.max_range).clamp_min(1e-3 / self.max_range).log() / 3


def policy_transforms(max_range: float = 4.0) -> Compose:
    """Transforms that build the policy's ``observation`` ``[*B, 36]`` and scale its action.

    ==========  =====================================================================
    entries     meaning
    ==========  =====================================================================
    0 to 29     ``log(lidar / max_range) / 3`` of each 12 degree sector: 0 is no return, -1 is 0.2 m.
                The logarithm keeps centimetres apart where they matter
    30 to 32    goal: distance / 5 m, sine and cosine of its bearing
    33 to 35    human: distance / 2 m, sine and cosine of its bearing
    ==========  =====================================================================

    The policy's ``action`` is in [-1, 1]; the environment gets it in m/s and rad/s. A sensor value
    that is not finite raises ``ValueError``.
    """
    return Compose(
        ActionScaling(),
        # First, so that an error names the sensor and the ray.
        CheckFinite(["scan", "goal", "human"]),
        LidarMinPool(NUM_SECTORS),
        UnaryTransform(in_keys=["lidar"], out_keys=["lidar_features"], fn=LogRange(max_range)),
        PolarFeatures(
            in_keys=["goal", "human"],
            out_keys=["goal_features", "human_features"],
            scale=[GOAL_SCALE, HUMAN_SCALE],
        ),
        CatTensors(
            in_keys=["lidar_features", "goal_features", "human_features"],
            out_key="observation",
            dim=-1,
            sort=False,
        ),
    )


def make_policy_env(
    sampler: PreferenceSampler | None = None,
    *,
    reward_model: TensorDictModuleBase | None = None,
    keep_simulation: bool = False,
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
        **kwargs: see :class:`NavigationEnv`.

    Returns:
        An environment with ``observation`` ``[N, 36]`` and ``preference`` ``[N, T]``, whose
        ``action`` is in [-1, 1].
    """
    base = NavigationEnv(snapshots=keep_simulation, **kwargs)
    transforms = policy_transforms(base.max_range)
    if sampler is not None:
        transforms.append(sampler)
    if reward_model is not None:
        transforms.append(RewardModelReward(reward_model, position=1))
    if not keep_simulation:
        transforms.append(ExcludeTransform("scan", "lidar"))
    return TransformedEnv(base, transforms)
