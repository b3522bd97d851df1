"""The replay buffer of off-policy agents: vector rewards, preferences redrawn when sampled."""

from __future__ import annotations

import torch
from omegaconf import DictConfig, OmegaConf
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, RewardScaling

from torchrl_morl.data import load_demonstrations
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.transforms import PreferenceExpand, PreferenceRelabel, RewardModelReward

from .evaluation import Problem
from .task import Task, check_observation

TRANSITION = (
    "observation",
    "preference",
    "action",
    *(
        ("next", key)
        for key in ("observation", "preference", "reward", "done", "terminated", "truncated")
    ),
)
"""What the replay buffer keeps."""


def make_replay_buffer(cfg: DictConfig, task: Problem) -> TensorDictReplayBuffer:
    """A buffer that relabels what it gives out, with demonstrations in it if there are any.

    A sample is for all updates of a batch of frames at once: it costs hardly more than one for one.
    """
    replay_buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(cfg.replay_buffer.size, device=task.device),
        batch_size=cfg.optim.updates_per_batch * cfg.replay_buffer.batch_size,
        transform=Compose(
            RewardScaling(0.0, cfg.replay_buffer.reward_scale, in_keys=[("next", "reward")]),
            make_relabel(cfg, task.preference_space),
        ),
    )
    if OmegaConf.select(cfg, "demonstrations.dataset"):  # of navigation alone
        prefill(cfg, task, replay_buffer)
    return replay_buffer


def make_relabel(
    cfg: DictConfig, preference_space: PreferenceSpace
) -> PreferenceRelabel | PreferenceExpand:
    """Hindsight: in what is sampled, or, as in PD-MORL's code, in copies of what is stored."""
    section = cfg.preference
    drawn = {"distribution": section.relabel_distribution, "seed": cfg.seed}
    if copies := section.get("relabel_copies", 0):
        return PreferenceExpand(preference_space, copies, **drawn)
    return PreferenceRelabel(preference_space, ratio=section.relabel_ratio, **drawn)


def prefill(cfg: DictConfig, task: Task, replay_buffer: TensorDictReplayBuffer) -> None:
    """Put demonstrations into the buffer: vector rewards make them experience like any other.

    Raises:
        ValueError: for drives without rewards, whose actions are not those that were driven.
    """
    preference_space = task.preference_space
    data, _ = load_demonstrations(cfg.demonstrations.dataset)
    if ("next", "reward") not in data.keys(True):
        raise ValueError(
            f"demonstrations.dataset {cfg.demonstrations.dataset!r} has no rewards: give the "
            "demonstrations.safetensors of recipes.drex. Its tracked.safetensors is what "
            "recipes.mo_ppo preset=nothing clones."
        )
    check_observation(cfg, cfg.demonstrations.dataset, data["observation"].shape[-1])
    data = data[: cfg.demonstrations.prefill]
    data = data[data["mask"]]
    preference = torch.zeros(len(data), preference_space.num_tunable)
    preference[:, preference_space.tunable.index("demo")] = 1.0
    data["preference"] = preference
    data["next", "preference"] = preference.clone()
    data = RewardModelReward(task.reward_model, position=preference_space.objectives.index("demo"))(
        data
    )
    replay_buffer.extend(data.select(*TRANSITION))
