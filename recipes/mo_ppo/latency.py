"""What is judged of a command that takes effect late: the state in which it is done."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_morl.transforms import RewardModelReward

_FOLLOWS = 0.3
"""Share of a step in which a base follows a command, between none and one that lags by half a step."""


def latency(
    data: TensorDictBase, parts: Mapping[str, Sequence[int]], limits: Sequence[float]
) -> Tensor:
    """How many steps after it was given a command is done, integers ``[E, T]``: one number for an episode.

    The one at which what was measured is nearest to what was told, by least squares over the steps of the
    episode in this batch. A base needs a part of a step to follow, in which it still does what it was told
    before that.

    Args:
        data: steps in a row, ``[E, T]``. An observation after a step says what was measured, then the last
            commands, the one of the step first.
        parts: of the observation, see :func:`~torchrl_morl.deploy.features.observation_parts`.
        limits: top speed and turn rate, in units of the observation.
    """
    motion = data["next", "observation"][..., list(parts["motion"])]
    motion = motion.unflatten(-1, (-1, 2)) / motion.new_tensor(limits)
    measured, told = motion[..., :1, :], motion[..., 1:, :]
    before = torch.cat((told[..., 1:, :], told[..., -1:, :]), -2)
    off = (told.lerp(before, _FOLLOWS) - measured).square().sum(-1)
    episodes, episode = data["collector", "traj_ids"].unique(return_inverse=True)
    total = off.new_zeros(len(episodes), off.shape[-1])
    total.index_add_(0, episode.flatten(), off.flatten(0, -2))
    return total.argmin(-1)[episode]


def done_at(late: Tensor, episode: Tensor) -> Tensor:
    """The step at which each command is done, ``[E, T]``; the last of the episode in the batch at most.

    Args:
        late: by how many steps, ``[E, T]``.
        episode: which one a step belongs to, ``[E, T]``; those of an episode are in a row.
    """
    steps = torch.arange(episode.shape[-1], device=episode.device)
    ends = steps.expand(episode.shape).clone()
    ends[..., :-1][episode[..., 1:] == episode[..., :-1]] = len(steps)  # not an end: no bound
    ends = ends.flip(-1).cummin(-1).values.flip(-1)
    return torch.minimum(steps + late, ends)


def rows_at(values: Tensor, step: Tensor) -> Tensor:
    """Of each environment the entries of other steps.

    Args:
        values: ``[E, T, *F]``.
        step: which one instead, ``[E, T]``.
    """
    index = step.reshape(*step.shape, *(1 for _ in values.shape[2:])).expand_as(values)
    return values.gather(1, index)


@torch.no_grad()
def judge_when_done(
    data: TensorDictBase,
    step: Tensor,
    judge: RewardModelReward,
    *,
    reward_scale: float,
    envs_at_once: int,
) -> None:
    """Judge each command in the state in which it is done, and pay for it when it is given.

    What a reward model has learned is commands that are done at once. A late one changes nothing before it is
    done, and what it is then worth depends on where the robot is by then. So the sum over an episode is that
    of what the robot does, and each command still gets its own share.

    Args:
        data: ``[E, T]``; the reward of the style in it is changed in place.
        step: at which each command is done, ``[E, T]``.
        judge: of the environment; its model reads ``observation`` and perhaps ``action``.

    Keyword Args:
        reward_scale: by which the rewards in ``data`` were multiplied.
        envs_at_once: whose steps are evaluated in one go.
    """
    later = rows_at(data["observation"], step)
    changes = []
    for part, seen in zip(data.split(envs_at_once), later.split(envs_at_once), strict=True):
        now = part.select("observation", "action")
        then = now.copy().set("observation", seen)
        score = judge.reward_model(then)[judge.score_key] - judge.reward_model(now)[judge.score_key]
        changes.append(reward_scale * judge.scale * score.squeeze(-1))
    reward = data["next", "reward"].clone()
    reward[..., judge.position] += torch.cat(changes)
    data["next", "reward"] = reward
