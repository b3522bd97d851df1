"""Rollouts of any driver, and how well they did."""

from __future__ import annotations

from typing import Any

import torch
import tqdm
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.data import Bounded
from torchrl.envs import ExcludeTransform
from torchrl.envs.utils import ExplorationType, set_exploration_type

from envs.metrics import trajectories
from envs.objectives import RewardConstants
from envs.policy_env import make_policy_env
from envs.splits import training_seed
from torchrl_morl.evaluation import discrete_frechet, episode_mask
from torchrl_morl.modules.exploration import HeldEGreedyModule

ACTION_SPEC = Bounded(-1.0, 1.0, (2,))
INTENDED = "intended_action"
"""What a driver under noise would have done without it."""

_KEPT = ("observation", "action", INTENDED, "goal", "human", "pose", "human_pose")
_KEPT_NEXT = (
    "observation",
    "reward",
    "done",
    "terminated",
    "truncated",
    "success",
    "pose",
    "human_pose",
)


@torch.no_grad()
def rollouts(
    policy: TensorDictModuleBase,
    count: int,
    seed: int,
    *,
    random: bool = False,
    max_steps: int = 300,
    start: TensorDictBase | None = None,
    **env_kwargs: Any,
) -> TensorDictBase:
    """``count`` first episodes ``[N, T]`` of a policy with ``mask``, in one batch.

    From ``start``, snapshots ``[N]`` of a :class:`~envs.NavigationEnv`, instead of scenes of the seed.
    """
    env = make_policy_env(
        num_envs=count,
        seed=training_seed(seed),
        keep_simulation=start is not None,
        **env_kwargs,
    )
    if start is None:
        begun = env.reset()
    else:
        # Without the scans, which are many times what is kept.
        env = env.append_transform(ExcludeTransform("scan", "lidar"))
        state = start.select(*env.base_env.state_spec.keys(True, True))
        begun = env.reset(state.clone(), set_state=True)
    exploration = ExplorationType.RANDOM if random else ExplorationType.DETERMINISTIC
    with set_exploration_type(exploration):
        data = env.rollout(
            max_steps,
            policy,
            auto_reset=False,
            tensordict=begun,
            break_when_any_done=False,
            break_when_all_done=True,
        )
    env.close()
    data.set("mask", episode_mask(data["next", "done"]))
    return data.select(*_KEPT, "mask", *(("next", key) for key in _KEPT_NEXT), strict=False)


def succeeded(data: TensorDictBase) -> Tensor:
    """Which trajectories ``[N, T]`` reached the goal."""
    return (data["next", "success"].squeeze(-1) & data["mask"]).any(-1)


def pad(data: TensorDictBase, steps: int) -> TensorDictBase:
    """Repeat zeros, with a false mask, behind trajectories ``[N, T]`` up to ``steps``."""
    missing = steps - data.shape[1]
    if missing <= 0:
        return data
    tail = torch.zeros_like(data[:, :1]).expand(data.shape[0], missing)
    return torch.cat((data, tail), dim=1)


def noisy_rollouts(
    cfg: DictConfig, policy: TensorDictModuleBase
) -> list[tuple[float, TensorDictBase]]:
    """Rollouts ``(quality, [N, T])`` under each level of noise, in the same scenes."""
    groups = []
    for level in tqdm.tqdm(cfg.noise.levels, desc="noisy rollouts", unit="level"):
        noise = HeldEGreedyModule(ACTION_SPEC, level, cfg.noise.hold, seed=cfg.seed)
        noisy = TensorDictSequential(policy, noise)
        data = rollouts(noisy, cfg.noise.rollouts, cfg.seed + 10_000, random=True, **cfg.env)
        groups.append((-level, data))
    return groups


def core_return(data: TensorDictBase) -> Tensor:
    """Of trajectories ``[N, T]``, as a share of what the way to the goal pays: 1 at best."""
    reward = data["next", "reward"][..., 0] * data["mask"]
    return reward.sum(-1) / (RewardConstants().goal_reward * data["goal"][:, 0, 0])


def frechet(data: TensorDictBase, reference: TensorDictBase) -> Tensor:
    """Distance of trajectories ``[N, T]`` from what is :func:`demonstrated` in their scenes, metres."""
    path = trajectories(data)
    return discrete_frechet(
        path["position"], path["mask"], reference["position"], reference["mask"]
    )


def mean_and_error(values: Tensor) -> tuple[Tensor, Tensor]:
    """Mean over the last dimension and its standard error; NaN where there are too few values."""
    mean = values.mean(-1)
    variance = (values - mean.unsqueeze(-1)).square().mean(-1)
    return mean, (variance / (values.shape[-1] - 1)).sqrt()
