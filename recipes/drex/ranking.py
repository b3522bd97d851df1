"""From ranked rollouts to a reward model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import tqdm
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor

from envs.policy_env import observation_size, observed
from recipes.training.checkpoint import Checkpoints, Counters, GeneratorStates
from torchrl_morl.data import RankedSnippets
from torchrl_morl.deploy import save_reward_model
from torchrl_morl.deploy.features import PARTS, observation_parts
from torchrl_morl.modules import RewardModel
from torchrl_morl.objectives import BradleyTerryLoss

from .cards import metadata
from .rollouts import ACTION_SPEC

CHECKPOINT_INTERVAL = 500
"""Updates of the reward model."""


def hidden_entries(cfg: DictConfig) -> list[int]:
    """Entries of the observation that the reward model must not know.

    Raises:
        ValueError: for an input that does not exist, or none that the environment has.
    """
    parts = observation_parts(**observed(cfg.env))
    inputs, known = list(cfg.reward_model.inputs), [*PARTS, "action"]
    if not set(inputs) & {*parts, "action"} or not set(inputs) <= set(known):
        raise ValueError(f"reward_model.inputs must be some of {known}, got {inputs}.")
    return [entry for part, entries in parts.items() if part not in inputs for entry in entries]


def make_reward_model(cfg: DictConfig) -> RewardModel:
    """R of the inputs in the configuration.

    The action is an input of its own. The observation is one vector, for robots, files and replay
    buffers alike: a part that R must not know keeps its place, and the weights behind it are zero.
    """
    section, hidden = cfg.reward_model, hidden_entries(cfg)
    sizes = {"observation": observation_size(cfg.env)}
    if "action" in section.inputs:
        sizes["action"] = ACTION_SPEC.shape[-1]
    model = RewardModel(
        in_features=sum(sizes.values()),
        in_keys=list(sizes),
        num_cells=section.num_cells,
        num_members=section.num_members,
    )
    for member in model.module.members:
        member[0].weight.data[:, hidden] = 0.0
    return model


def ranked_snippets(
    cfg: DictConfig,
    noisy: list[tuple[float, TensorDictBase]],
    styles: list[TensorDictBase],
) -> list[RankedSnippets]:
    """Pairs within the levels of noise and, for the extension, between demonstrated and other styles.

    Departure and a long approach are common to all styles: those pairs start close to the human,
    where styles differ. Noise disturbs the whole way.
    """
    section = cfg.reward_model
    length, seed = section.snippet_length, cfg.seed
    snippets = [RankedSnippets(noisy, length=length, min_gap=section.min_gap, seed=seed)]
    if styles:
        undisturbed = [(0.0, data) for quality, data in noisy if quality == 0.0]
        groups = undisturbed + [(-1.0, data) for data in styles]
        groups = [
            (quality, data.copy().set("near", data["human"][..., 0] < section.near_human))
            for quality, data in groups
        ]
        snippets.append(RankedSnippets(groups, length=length, focus_key="near", seed=seed + 1))
    return snippets


def train_reward_model(
    cfg: DictConfig,
    snippets: list[RankedSnippets],
    *,
    bfloat16: bool = False,
    checkpoints: Path | None = None,
) -> tuple[RewardModel, dict[str, Any]]:
    """Bradley-Terry on ranked snippets; every source of pairs has the same share of a batch.

    Args:
        cfg: of the recipe; with ``resume`` it goes on from its last checkpoint.
        snippets: sources of pairs.

    Keyword Args:
        bfloat16: whether updates compute in it.
        checkpoints: folder for those; ``None`` keeps none.
    """
    section, hidden = cfg.reward_model, hidden_entries(cfg)
    train, held_out = zip(*(source.split(section.held_out) for source in snippets), strict=True)
    model = make_reward_model(cfg)
    loss = BradleyTerryLoss(model, label_smoothing=section.label_smoothing)
    optimizer = torch.optim.AdamW(
        loss.parameters(), lr=section.lr, weight_decay=section.weight_decay, fused=True
    )
    precision = torch.autocast("cpu", torch.bfloat16, enabled=bfloat16)
    share = section.batch_size // len(snippets)
    count, kept = Counters(updates=0), None
    if checkpoints is not None:
        sources = GeneratorStates(*(source.generator for source in (*train, *held_out)))
        kept = Checkpoints(
            checkpoints, loss=loss, optimizer=optimizer, sources=sources, count=count
        )
        if cfg.resume is not None:
            kept.load()
    bar = {"total": section.updates, "initial": count.updates}
    with tqdm.tqdm(desc="reward model", unit="update", **bar) as progress:
        for update in range(count.updates + 1, section.updates + 1):
            pairs = torch.cat([source.sample(share) for source in train])
            for side in ("preferred", "other"):
                # Weights behind zeros have no gradient: those that are zero stay so.
                pairs[side, "observation"][..., hidden] = 0.0
            with precision:
                out = loss(pairs)
            optimizer.zero_grad()
            out["loss_bradley_terry"].backward()
            optimizer.step()
            progress.update()
            if update % 100 == 0:
                progress.set_postfix(accuracy=f"{out['accuracy'].item():.2f}")
            count.updates = update
            if kept is not None and update % CHECKPOINT_INTERVAL == 0:
                kept.save(update)
    scores = held_out_accuracy(loss, held_out)
    loss.reward_network_params.data.to_module(model)
    return model.requires_grad_(False), scores


@torch.no_grad()
def held_out_accuracy(
    loss: BradleyTerryLoss, held_out: Sequence[RankedSnippets], num_pairs: int = 8192
) -> dict[str, Any]:
    """Share of held-out pairs that R ranks right: of each source, and per gap between noise levels."""
    names = ("noise pairs", "style pairs")
    scores: dict[str, Any] = {
        f"held_out_accuracy {name}": loss(source.sample(1024))["accuracy"].item()
        for name, source in zip(names, held_out, strict=False)
    }
    pairs = held_out[0].sample(num_pairs)
    gap = pairs["gap"].round(decimals=4)  # 0.5 - 0.35 and 0.35 - 0.2 are the same
    scores["held_out_accuracy per noise gap"] = {
        f"{value:g}": loss(pairs[gap == value])["accuracy"].item() for value in gap.unique()
    }
    return scores


@torch.no_grad()
def step_scores(model: RewardModel, data: TensorDictBase) -> Tensor:
    """R of every step of trajectories ``[N, T]``, also of those behind an end."""
    return model(data.select("observation", "action"))["demo_score"].squeeze(-1)


def mean_scores(model: RewardModel, groups: list[tuple[float, TensorDictBase]]) -> list[float]:
    """Mean R over the steps of each group."""
    return [step_scores(model, data)[data["mask"]].mean().item() for _, data in groups]


def save_model(folder: Path, cfg: DictConfig, model: RewardModel, card: dict[str, Any]) -> None:
    """Write the reward model and its card."""
    save_reward_model(
        folder,
        model,
        card=metadata(cfg) | card,
    )
