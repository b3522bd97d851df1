"""Stages of the D-REX recipe."""

from __future__ import annotations

from typing import Any

import torch
import tqdm
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import BCLoss

from envs.demonstrator import CircleDemonstrator, StraightDriver
from envs.policy_env import OBSERVATION_SIZE, make_policy_env
from torchrl_morl.data import RankedSnippets
from torchrl_morl.evaluation import episode_mask
from torchrl_morl.modules import RewardModel, make_actor
from torchrl_morl.modules.exploration import HeldEGreedyModule
from torchrl_morl.objectives import BradleyTerryLoss

ACTION_SPEC = Bounded(-1.0, 1.0, (2,))
_KEPT = ("observation", "action", "goal", "human", "pose", "human_pose")
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
    **env_kwargs: Any,
) -> TensorDictBase:
    """``count`` first episodes ``[N, T]`` of a policy with ``mask``, in one batch."""
    env = make_policy_env(num_envs=count, seed=seed, **env_kwargs)
    exploration = ExplorationType.RANDOM if random else ExplorationType.DETERMINISTIC
    with set_exploration_type(exploration):
        data = env.rollout(max_steps, policy, break_when_any_done=False, break_when_all_done=True)
    env.close()
    data.set("mask", episode_mask(data["next", "done"]))
    return data.select(*_KEPT, "mask", *(("next", key) for key in _KEPT_NEXT))


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


def collect_demonstrations(cfg: DictConfig) -> TensorDictBase:
    """``N_D`` collision-free rollouts of the scripted pattern in random scenes."""
    demonstrator = CircleDemonstrator(
        cfg.demonstrations.radius,
        cfg.demonstrations.side,
        cfg.demonstrations.speed,
        cfg.env.robot,
        scaled=True,
    )
    kept: list[TensorDictBase] = []
    wanted, seed = cfg.demonstrations.count, cfg.seed
    with tqdm.tqdm(total=wanted, desc="demonstrations", unit="rollout") as progress:
        while progress.n < wanted:
            data = rollouts(demonstrator, cfg.demonstrations.batch, seed, **cfg.env)
            data = data[succeeded(data)][: wanted - progress.n]
            kept.append(data)
            progress.update(len(data))
            seed += 1
    longest = max(data.shape[1] for data in kept)
    return torch.cat([pad(data, longest) for data in kept])


def clone_behaviour(
    cfg: DictConfig, demonstrations: TensorDictBase
) -> tuple[TensorDictSequential, float]:
    """Behaviour cloning with early stopping on held-out trajectories; returns the best policy."""
    generator = torch.Generator().manual_seed(cfg.seed)
    policy = make_actor(
        ACTION_SPEC,
        in_features=OBSERVATION_SIZE,
        in_keys=("observation",),
        num_cells=cfg.cloning.num_cells,
    )
    loss = BCLoss(policy, loss_function="l2")
    optimizer = torch.optim.Adam(loss.parameters(), lr=cfg.cloning.lr)
    order = torch.randperm(len(demonstrations), generator=generator)
    held_out = max(1, round(cfg.cloning.held_out * len(order)))

    def steps(rows: Tensor) -> TensorDictBase:
        part = demonstrations[rows].select("observation", "action", "mask")
        return part[part["mask"]]

    train, test = steps(order[held_out:]), steps(order[:held_out])
    best, best_state, waited = float("inf"), None, 0
    with tqdm.tqdm(total=cfg.cloning.updates, desc="cloning", unit="update") as progress:
        for update in range(1, cfg.cloning.updates + 1):
            rows = torch.randint(len(train), (cfg.cloning.batch_size,), generator=generator)
            value = loss(train[rows])["loss_bc"]
            optimizer.zero_grad()
            value.backward()
            optimizer.step()
            progress.update()
            if update % 250 == 0:
                with torch.no_grad():
                    check = loss(test)["loss_bc"].item()
                progress.set_postfix(train=f"{value.item():.4f}", held_out=f"{check:.4f}")
                waited += 1
                if check < best:
                    best, waited = check, 0
                    state = loss.actor_network_params.data.clone()
                    best_state = state
                if waited >= cfg.cloning.patience:
                    break
    best_state.to_module(policy)
    return policy.requires_grad_(False), best


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


def other_styles(cfg: DictConfig) -> list[TensorDictBase]:
    """Orbits at other radii, mirrored orbits and straight driving, in random scenes."""
    count = cfg.style_negatives.rollouts // 4
    generator = torch.Generator().manual_seed(cfg.seed)
    ranges = torch.tensor([list(pair) for pair in cfg.style_negatives.radii])

    def radii() -> Tensor:
        pick = ranges[torch.randint(len(ranges), (count,), generator=generator)]
        return pick[:, 0] + (pick[:, 1] - pick[:, 0]) * torch.rand(count, generator=generator)

    mirror = "right" if cfg.demonstrations.side == "left" else "left"
    policies = (
        CircleDemonstrator(radii(), cfg.demonstrations.side, scaled=True),
        CircleDemonstrator(radii(), mirror, scaled=True),
        CircleDemonstrator(cfg.demonstrations.radius, mirror, scaled=True),
        StraightDriver(scaled=True),
    )
    return [
        rollouts(policy, count, cfg.seed + 20_000 + index, **cfg.env)
        for index, policy in enumerate(policies)
    ]


def train_reward_model(
    cfg: DictConfig, groups: list[tuple[float, TensorDictBase]]
) -> tuple[RewardModel, dict[str, float]]:
    """Bradley-Terry on ranked snippets."""
    section = cfg.reward_model
    for _, data in groups:
        data.set("near", data["human"][..., 0] < section.near_human)
    snippets = RankedSnippets(
        groups,
        length=section.snippet_length,
        min_gap=section.min_gap,
        focus_key="near",
        focus_probability=0.7,
        seed=cfg.seed,
    )
    train, held_out = snippets.split(section.held_out)
    model = RewardModel(
        in_features=OBSERVATION_SIZE + 2,
        num_cells=section.num_cells,
        num_members=section.num_members,
    )
    loss = BradleyTerryLoss(model, label_smoothing=section.label_smoothing)
    optimizer = torch.optim.AdamW(
        loss.parameters(), lr=section.lr, weight_decay=section.weight_decay
    )
    with tqdm.tqdm(total=section.updates, desc="reward model", unit="update") as progress:
        for update in range(1, section.updates + 1):
            out = loss(train.sample(section.batch_size))
            optimizer.zero_grad()
            out["loss_bradley_terry"].backward()
            optimizer.step()
            progress.update()
            if update % 100 == 0:
                with torch.no_grad():
                    check = loss(held_out.sample(512))
                progress.set_postfix(
                    train=f"{out['accuracy'].item():.2f}",
                    held_out=f"{check['accuracy'].item():.2f}",
                )
    with torch.no_grad():
        check = loss(held_out.sample(2048))
    loss.reward_network_params.data.to_module(model)
    return model.requires_grad_(False), {"held_out_accuracy": check["accuracy"].item()}


def contrast_styles(cfg: DictConfig) -> dict[str, TensorDictModuleBase]:
    """The demonstration and what it must be told from."""
    mirror = "right" if cfg.demonstrations.side == "left" else "left"
    side, radius = cfg.demonstrations.side, cfg.demonstrations.radius
    styles: dict[str, TensorDictModuleBase] = {
        "demonstration": CircleDemonstrator(radius, side, scaled=True)
    }
    for factor in (0.7, 1.3, 1.6):
        other = factor * radius
        styles[f"orbit {other:.1f} m"] = CircleDemonstrator(other, side, scaled=True)
    styles["mirrored"] = CircleDemonstrator(radius, mirror, scaled=True)
    styles["distance keeping"] = CircleDemonstrator(2.1, side, scaled=True)
    styles["straight"] = StraightDriver(scaled=True)
    return styles


@torch.no_grad()
def style_contrast(
    cfg: DictConfig, model: RewardModel, count: int = 200, within: float = 2.0
) -> dict[str, float]:
    """Mean R of each style over its steps within 2 m of the human, on fresh scenes."""
    result = {}
    for name, policy in contrast_styles(cfg).items():
        data = rollouts(policy, count, cfg.seed + 30_000, **cfg.env)
        score = model(data.select("observation", "action"))["demo_score"].squeeze(-1)
        near = data["mask"] & (data["human"][..., 0] < within)
        result[name] = score[near].mean().item()
    return result


@torch.no_grad()
def mean_scores(model: RewardModel, groups: list[tuple[float, TensorDictBase]]) -> list[float]:
    """Mean R over the steps of each group."""
    return [
        model(data.select("observation", "action"))["demo_score"]
        .squeeze(-1)[data["mask"]]
        .mean()
        .item()
        for _, data in groups
    ]


def as_dict(data: TensorDictBase) -> TensorDict:
    return data.to_tensordict()
