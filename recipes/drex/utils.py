"""Stages of the D-REX recipe."""

from __future__ import annotations

import importlib.metadata
from pathlib import Path
from typing import Any

import torch
import tqdm
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import BCLoss

from envs.demonstrator import CircleDemonstrator, StraightDriver
from envs.policy_env import OBSERVATION_SIZE, make_policy_env
from torchrl_morl.data import RankedSnippets
from torchrl_morl.deploy import save_reward_model
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
    kept: list[TensorDictBase] = []
    wanted, seed = cfg.demonstrations.count, cfg.seed
    with tqdm.tqdm(total=wanted, desc="demonstrations", unit="rollout") as progress:
        while progress.n < wanted:
            data = rollouts(demonstrator(cfg), cfg.demonstrations.batch, seed, **cfg.env)
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
            if update % 250 == 0 or update == cfg.cloning.updates:
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
        demonstrator(cfg, radius=radii()),
        demonstrator(cfg, radius=radii(), side=mirror),
        demonstrator(cfg, side=mirror),
        StraightDriver(cfg.demonstrations.speed, cfg.env.robot, scaled=True),
    )
    return [
        rollouts(policy, count, cfg.seed + 20_000 + index, **cfg.env)
        for index, policy in enumerate(policies)
    ]


def ranked_snippets(
    cfg: DictConfig,
    noisy: list[tuple[float, TensorDictBase]],
    styles: list[TensorDictBase],
) -> list[RankedSnippets]:
    """Pairs within the levels of noise and, for the extension, between demonstrated and other styles.

    Approach and departure are common to all styles: those pairs start close to the human, where
    styles differ. Noise disturbs the whole way.
    """
    section = cfg.reward_model
    length, seed = section.snippet_length, cfg.seed
    snippets = [RankedSnippets(noisy, length=length, min_gap=section.min_gap, seed=seed)]
    if styles:
        undisturbed = [(0.0, data) for quality, data in noisy if quality == 0.0]
        groups = undisturbed + [(-1.0, data) for data in styles]
        for _, data in groups:
            data.set("near", data["human"][..., 0] < section.near_human)
        snippets.append(RankedSnippets(groups, length=length, focus_key="near", seed=seed + 1))
    return snippets


def train_reward_model(
    cfg: DictConfig, snippets: list[RankedSnippets]
) -> tuple[RewardModel, dict[str, float]]:
    """Bradley-Terry on ranked snippets; every source of pairs has the same share of a batch."""
    section = cfg.reward_model
    train, held_out = zip(*(source.split(section.held_out) for source in snippets), strict=True)
    model = RewardModel(
        in_features=OBSERVATION_SIZE + 2,
        num_cells=section.num_cells,
        num_members=section.num_members,
    )
    loss = BradleyTerryLoss(model, label_smoothing=section.label_smoothing)
    optimizer = torch.optim.AdamW(
        loss.parameters(), lr=section.lr, weight_decay=section.weight_decay
    )
    share = section.batch_size // len(snippets)
    with tqdm.tqdm(total=section.updates, desc="reward model", unit="update") as progress:
        for update in range(1, section.updates + 1):
            out = loss(torch.cat([source.sample(share) for source in train]))
            optimizer.zero_grad()
            out["loss_bradley_terry"].backward()
            optimizer.step()
            progress.update()
            if update % 100 == 0:
                progress.set_postfix(accuracy=f"{out['accuracy'].item():.2f}")
    names = ("noise pairs", "style pairs")
    with torch.no_grad():
        scores = {
            f"held_out_accuracy {name}": loss(source.sample(1024))["accuracy"].item()
            for name, source in zip(names, held_out, strict=False)
        }
    loss.reward_network_params.data.to_module(model)
    return model.requires_grad_(False), scores


def contrast_styles(cfg: DictConfig) -> dict[str, TensorDictModuleBase]:
    """The demonstration and what it must be told from."""
    mirror = "right" if cfg.demonstrations.side == "left" else "left"
    styles: dict[str, TensorDictModuleBase] = {"demonstration": demonstrator(cfg)}
    for factor in (0.7, 1.3, 1.6):
        other = factor * cfg.demonstrations.radius
        styles[f"orbit {other:.1f} m"] = demonstrator(cfg, radius=other)
    styles["mirrored"] = demonstrator(cfg, side=mirror)
    styles["distance keeping"] = demonstrator(cfg, radius=1.9)
    styles["straight"] = StraightDriver(cfg.demonstrations.speed, cfg.env.robot, scaled=True)
    return styles


@torch.no_grad()
def style_contrast(cfg: DictConfig, model: RewardModel, within: float = 2.0) -> dict[str, float]:
    """Mean R of each style over its steps within 2 m of the human, on fresh scenes."""
    result = {}
    for name, policy in contrast_styles(cfg).items():
        data = rollouts(policy, cfg.diagnostics.rollouts, cfg.seed + 30_000, **cfg.env)
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


def metadata(cfg: DictConfig) -> dict[str, Any]:
    """What made the demonstrations."""
    packages = ("torch", "torchrl", "tensordict", "mujoco", "torchrl-morl")
    return {
        "config": OmegaConf.to_container(cfg, resolve=True),
        "demonstrator": demonstrator_arguments(cfg),
        "versions": {name: importlib.metadata.version(name) for name in packages},
    }


def demonstrator(cfg: DictConfig, **changes: Any) -> CircleDemonstrator:
    """Drives what is demonstrated, or what differs from it by other arguments."""
    return CircleDemonstrator(**demonstrator_arguments(cfg) | changes, scaled=True)


def demonstrator_arguments(cfg: DictConfig) -> dict[str, Any]:
    """Of :class:`envs.demonstrator.CircleDemonstrator`."""
    section = cfg.demonstrations
    return {
        "radius": section.radius,
        "side": section.side,
        "speed": section.speed,
        "robot": cfg.env.robot,
    }


def save_model(folder: Path, cfg: DictConfig, model: RewardModel, card: dict[str, Any]) -> None:
    """Write the reward model and its card."""
    save_reward_model(
        folder,
        model,
        in_features=OBSERVATION_SIZE + 2,
        num_cells=tuple(cfg.reward_model.num_cells),
        num_members=cfg.reward_model.num_members,
        card=metadata(cfg) | card,
    )
