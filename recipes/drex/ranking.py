"""From ranked rollouts to a reward model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
import tqdm
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor

from envs.policy_env import observation_size, observed
from recipes.training.checkpoint import Checkpoints, Counters, GeneratorStates
from recipes.training.diverged import refuse_diverged
from torchrl_morl.data import RankedSnippets
from torchrl_morl.deploy import save_reward_model
from torchrl_morl.deploy.features import PARTS, observation_parts
from torchrl_morl.modules import RewardModel
from torchrl_morl.objectives import BradleyTerryLoss

from .cards import metadata
from .rollouts import ACTION_SPEC

CHECKPOINT_INTERVAL = 500
"""Updates of the reward model."""

DEMONSTRATED_STEPS = 512
"""Steps of an update whose R should be 1."""


def hidden_entries(cfg: DictConfig) -> list[int]:
    """Entries of the observation that the reward model must not know.

    Raises:
        ValueError: for an input that does not exist, or none that the environment has.
    """
    parts = observation_parts(**observed(cfg.env))
    # How a robot moves is no style: demonstrations do without it.
    known = [*(part for part in PARTS if part != "motion"), "action"]
    inputs = list(cfg.reward_model.inputs)
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
    tracked: TensorDictBase | None = None,
    bulging: TensorDictBase | None = None,
) -> dict[str, RankedSnippets]:
    """Pairs within the levels of noise and, for the extensions, between demonstrated and other ways.

    Departure and a long approach are common to all styles: those pairs start close to the human,
    where styles differ. Noise disturbs the whole way.

    Args:
        cfg: of the recipe.
        noisy: demonstrations, and rollouts of their clone, with their quality.
        styles: other ones; without any they have no source.
        tracked: what was demonstrated under a learner's noise, as good as the demonstrations.
        bulging: paths beside it under the same noise, with ``near`` where.

    Returns:
        The sources of pairs, by name.
    """
    section = cfg.reward_model
    if tracked is not None:
        noisy = [*noisy, (0.0, tracked)]
    length, seed = section.snippet_length, cfg.seed
    snippets = {
        "noise pairs": RankedSnippets(noisy, length=length, min_gap=section.min_gap, seed=seed)
    }
    if styles:
        undisturbed = [(0.0, data) for quality, data in noisy if quality == 0.0]
        groups = undisturbed + [(-1.0, data) for data in styles]
        groups = [
            (quality, data.copy().set("near", data["human"][..., 0] < section.near_human))
            for quality, data in groups
        ]
        snippets["style pairs"] = RankedSnippets(
            groups, length=length, focus_key="near", seed=seed + 1
        )
    if bulging is not None:
        groups = [(q, data.copy().set("near", data["mask"])) for q, data in noisy if q == 0.0]
        groups.append((-1.0, bulging))
        snippets["path pairs"] = RankedSnippets(
            groups, length=length, focus_key="near", seed=seed + 2
        )
    return snippets


def train_reward_model(
    cfg: DictConfig,
    snippets: Mapping[str, RankedSnippets],
    demonstrated: Sequence[TensorDictBase] = (),
    *,
    bfloat16: bool = False,
    checkpoints: Path | None = None,
) -> tuple[RewardModel, dict[str, Any]]:
    """Bradley-Terry on ranked snippets; every source of pairs has the same share of a batch.

    Args:
        cfg: of the recipe; with ``resume`` it goes on from its last checkpoint.
        snippets: sources of pairs, by name.
        demonstrated: trajectories ``[N, T]`` whose steps are as they should be.

    Keyword Args:
        bfloat16: whether updates compute in it.
        checkpoints: folder for those; ``None`` keeps none.
    """
    section, hidden = cfg.reward_model, hidden_entries(cfg)
    parts = {name: source.split(section.held_out) for name, source in snippets.items()}
    train = [part for part, _ in parts.values()]
    held_out = {name: part for name, (_, part) in parts.items()}
    model = make_reward_model(cfg)
    loss = BradleyTerryLoss(model, label_smoothing=section.label_smoothing)
    optimizer = torch.optim.AdamW(
        loss.parameters(), lr=section.lr, weight_decay=section.weight_decay, fused=True
    )
    precision = torch.autocast("cpu", torch.bfloat16, enabled=bfloat16)
    share = section.batch_size // len(snippets)
    shown = [data.select("observation", "action")[data["mask"]] for data in demonstrated]
    steps = torch.cat(shown) if shown and section.demonstration_coeff else None
    generator = torch.Generator().manual_seed(cfg.seed + 3)
    count, kept = Counters(updates=0), None
    if checkpoints is not None:
        sources = GeneratorStates(
            generator, *(source.generator for source in (*train, *held_out.values()))
        )
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
                prepare(pairs[side], section.action_noise, hidden, generator)
            with precision:
                out = loss(pairs)
                value = out["loss_bradley_terry"]
                if steps is not None:
                    drawn = torch.randint(len(steps), (DEMONSTRATED_STEPS,), generator=generator)
                    batch = prepare(steps[drawn], section.action_noise, hidden, generator)
                    score = scored(loss, batch)
                    value = value - section.demonstration_coeff * score.log().mean()
            decayed = 0.5 * (1 + math.cos(math.pi * update / section.updates))
            rate = section.final_lr_ratio + (1 - section.final_lr_ratio) * decayed
            for group in optimizer.param_groups:
                group["lr"] = section.lr * rate
            optimizer.zero_grad()
            value.backward()
            optimizer.step()
            progress.update()
            if update % 100 == 0 or update == section.updates:
                refuse_diverged(
                    {"loss_bradley_terry": value},
                    f"in update {update:,} of the reward model",
                    f"lower reward_model.lr, {section.lr:g}, or look for NaN in the demonstrations",
                )
                progress.set_postfix(accuracy=f"{out['accuracy'].item():.2f}")
            count.updates = update
            if kept is not None and update % CHECKPOINT_INTERVAL == 0:
                kept.save(update)
    scores = held_out_accuracy(loss, held_out)
    loss.reward_network_params.data.to_module(model)
    return model.requires_grad_(False), scores


def prepare(
    data: TensorDictBase, noise: float, hidden: list[int], generator: torch.Generator
) -> TensorDictBase:
    """Steps ``[*B]`` or snippets ``[*B, L]`` as R reads them while it learns; in place.

    Each has noise of its own on the actions, of a standard deviation up to ``noise``, and zeros for
    the entries of the observation that R must not know.
    """
    # Weights behind zeros have no gradient: those that are zero stay so.
    data["observation"][..., hidden] = 0.0
    if noise:
        action = data["action"]
        sigma = noise * torch.rand(len(action), *[1] * (action.ndim - 1), generator=generator)
        disturbed = action + sigma * torch.randn(action.shape, generator=generator)
        data["action"] = disturbed.clamp(-1.0, 1.0)
    return data


def scored(loss: BradleyTerryLoss, data: TensorDictBase) -> Tensor:
    """R of steps ``[B]`` with its gradients, ``[B, 1]``, away from 0, whose logarithm is infinite."""
    network, params = loss.reward_network, loss.reward_network_params
    with params.to_module(network, preserve_module_state=False):
        return network(data)["demo_score"].float().clamp_min(1e-4)


@torch.no_grad()
def held_out_accuracy(
    loss: BradleyTerryLoss, held_out: Mapping[str, RankedSnippets], num_pairs: int = 8192
) -> dict[str, Any]:
    """Share of held-out pairs that R ranks right: of each source, and per gap between noise levels."""
    scores: dict[str, Any] = {
        f"held_out_accuracy {name}": loss(source.sample(1024))["accuracy"].item()
        for name, source in held_out.items()
    }
    pairs = held_out["noise pairs"].sample(num_pairs)
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
