"""Behaviour cloning: the policy under whose noise demonstrations are ranked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
import tqdm
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torch.nn import functional as F
from torchrl.objectives import BCLoss

from envs.policy_env import contract, observation_size
from recipes.training.checkpoint import Checkpoints, Counters
from recipes.training.diverged import refuse_diverged
from recipes.training.task import make_preference_space
from torchrl_morl.deploy import save_policy
from torchrl_morl.modules import make_actor

from .cards import metadata
from .rollouts import ACTION_SPEC


def make_clone(cfg: DictConfig) -> TensorDictSequential:
    """A policy of the observation alone, as it is before it has learned anything."""
    return make_actor(
        ACTION_SPEC,
        in_features=observation_size(cfg.env),
        in_keys=("observation",),
        num_cells=cfg.cloning.num_cells,
    )


def clone_behaviour(
    cfg: DictConfig, demonstrations: TensorDictBase, checkpoints: Path | None = None
) -> tuple[TensorDictSequential, float]:
    """Behaviour cloning with early stopping on held-out trajectories.

    Args:
        cfg: of the recipe; with ``resume`` a clone that was finished is taken from its checkpoint.
        demonstrations: ``[N, T]``.
        checkpoints: folder for that; ``None`` keeps none.

    Returns:
        The best policy and its loss. A single demonstration leaves nothing to hold out: then the
        loss is that of the training.
    """
    policy, cloning = make_clone(cfg), Counters(loss=float("nan"))
    finished = None
    if checkpoints is not None:
        finished = Checkpoints(checkpoints, policy=policy, cloning=cloning)
        if cfg.resume is not None and finished.load():
            return policy.requires_grad_(False), cloning.loss
    cloning.loss = _clone(cfg, policy, demonstrations)
    if finished is not None:
        finished.save(cfg.cloning.updates)
    return policy.requires_grad_(False), cloning.loss


def _clone(cfg: DictConfig, policy: TensorDictSequential, demonstrations: TensorDictBase) -> float:
    """Train the policy; returns its loss."""
    generator = torch.Generator().manual_seed(cfg.seed)
    loss = BCLoss(policy, loss_function="l2")
    optimizer = torch.optim.Adam(loss.parameters(), lr=cfg.cloning.lr)
    order = torch.randperm(len(demonstrations), generator=generator)
    held_out = max(1, round(cfg.cloning.held_out * len(order)))

    def steps(rows: Tensor) -> TensorDictBase:
        part = demonstrations[rows].select("observation", "action", "mask")
        return part[part["mask"]]

    train = steps(order[held_out:] if len(order) > 1 else order)
    test = steps(order[:held_out])
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
                    checked = loss(test)["loss_bc"]
                refuse_diverged(
                    {"loss_bc": checked},
                    f"in update {update:,} of the cloning",
                    f"lower cloning.lr, {cfg.cloning.lr:g}, or look for NaN in the demonstrations",
                )
                check = checked.item()
                progress.set_postfix(train=f"{value.item():.4f}", held_out=f"{check:.4f}")
                waited += 1
                if check < best:
                    best, waited = check, 0
                    state = loss.actor_network_params.data.clone()
                    best_state = state
                if waited >= cfg.cloning.patience:
                    break
    best_state.to_module(policy)
    return best


def save_clone(
    folder: Path, cfg: DictConfig, policy: TensorDictSequential, card: dict[str, Any]
) -> None:
    """Write the clone as a policy that every evaluation opens: it does the same for all preferences."""
    preference_space = make_preference_space(with_demonstrations=True)
    size = observation_size(cfg.env)
    num_cells = tuple(cfg.cloning.num_cells)
    actor = make_actor(
        ACTION_SPEC, in_features=size + preference_space.num_tunable, num_cells=num_cells
    )
    weights = policy.state_dict()
    first = "module.0.module.0.weight"
    weights[first] = F.pad(weights[first], (0, preference_space.num_tunable))
    actor.load_state_dict(weights)
    save_policy(
        folder,
        actor,
        preference_space=preference_space,
        **contract(cfg.env),
        card=metadata(cfg) | card | {"preference": "ignored"},
    )
