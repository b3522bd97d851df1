"""Metrics of navigation rollouts: from the environment's keys to the pure functions."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_morl.evaluation import min_human_distance, path_length, time_to_goal

from .navigation import NavigationEnv
from .people import FAR


def trajectories(rollout: TensorDictBase) -> TensorDict:
    """Padded trajectories of a rollout: one point more than it has steps, the start.

    Args:
        rollout: ``[*B, S]`` with ``mask`` as of
            :func:`~torchrl_morl.evaluation.rollout_preferences`.

    Returns:
        Batch size ``[*B]``: ``position`` ``[*B, S+1, 2]``, ``heading`` ``[*B, S+1]``, ``human``
        ``[*B, S+1, 2]`` and ``mask`` ``[*B, S+1]``.
    """

    def with_start(key: str) -> torch.Tensor:
        return torch.cat((rollout[key][..., :1, :], rollout["next", key]), dim=-2)

    pose = with_start("pose")
    mask = rollout["mask"]
    return TensorDict(
        {
            "position": pose[..., :2],
            "heading": pose[..., 2],
            "human": with_start("human_pose")[..., :2],
            "mask": torch.cat((torch.ones_like(mask[..., :1]), mask), dim=-1),
        },
        batch_size=mask.shape[:-1],
    )


def episode_metrics(rollout: TensorDictBase) -> TensorDict:
    """One value per episode of a rollout ``[*B, S]`` with ``mask``.

    Returns:
        Batch size ``[*B]``. Bool: ``success``, ``collision_human``, ``collision_obstacle``,
        ``timeout``, of which exactly one is true. Float: ``time`` (s, NaN unless successful),
        ``min_human_distance`` (m, between centres, NaN where nobody is), ``path_length`` (m),
        ``direct_distance`` (m, from the start to the goal).

    Raises:
        RuntimeError: if an episode of the rollout did not end.
    """
    mask = rollout["mask"]
    end = mask.sum(-1, keepdim=True) - 1

    def at_end(key: str) -> torch.Tensor:
        return rollout["next", key].squeeze(-1).gather(-1, end).squeeze(-1)

    causes = {
        "success": at_end("success"),
        "collision_human": at_end("collision_human"),
        "collision_obstacle": at_end("collision_obstacle"),
        "timeout": at_end("truncated"),
    }
    ended = torch.stack([cause.long() for cause in causes.values()]).sum(0)
    if (ended != 1).any():
        raise RuntimeError(
            f"{int((ended != 1).sum())} of {ended.numel()} episodes have no single cause of their "
            "end: roll out until every episode is done."
        )
    path = trajectories(rollout)
    nearest = min_human_distance(path["position"], path["human"], path["mask"])
    return TensorDict(
        {
            **causes,
            "time": time_to_goal(causes["success"], path["mask"], NavigationEnv.CONTROL_PERIOD),
            "min_human_distance": nearest.masked_fill(nearest > FAR / 2, torch.nan),
            "path_length": path_length(path["position"], path["mask"]),
            "direct_distance": rollout["goal"][..., 0, 0],
        },
        batch_size=mask.shape[:-1],
    )
