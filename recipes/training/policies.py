"""The policies that a training saves in its run folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictSequential

from envs.fields import portable
from envs.policy_env import contract
from envs.scene_files import portable_scene
from torchrl_morl.deploy import save_policy

from .corners import CornerResult
from .run_folder import score
from .task import Task


def save_training_policy(
    folder: Path,
    cfg: DictConfig,
    actor: TensorDictSequential,
    task: Task,
    result: CornerResult,
    **facts: Any,
) -> None:
    """Save a policy whose card tells what made it, how it did, and other ``facts``.

    One that is there stays: a training that was killed before its checkpoint makes the same once more.
    """
    if folder.exists():
        return
    card = {
        **task.facts,
        **facts,
        "config": card_config(cfg),
        "evaluation": {"preferences": result.names, **result.columns},
        "score": result.score,
    }
    if task.demo_card is not None and "demonstrator" in task.demo_card:
        card["demonstrator"] = task.demo_card["demonstrator"]
    save_policy(
        folder,
        actor,
        preference_space=task.preference_space,
        **contract(cfg.env),
        card=card,
    )


def card_config(cfg: DictConfig) -> dict[str, Any]:
    """The configuration as others can read it: files of scenes and robots by what they say."""
    config = OmegaConf.to_container(cfg, resolve=True)
    for section in ("env", "evaluation"):
        if "scene" in config.get(section, {}):  # demonstrations have no evaluation
            config[section]["scene"] = portable_scene(config[section]["scene"])
    config["env"]["robot"] = portable(config["env"]["robot"])
    return config


def finish(run_dir: Path, cfg: DictConfig) -> None:
    """Point to the results."""
    policies = sorted((run_dir / "policies").glob("[!.]*"))
    if policies:
        best = max(policies, key=score)
        print(f"best policy: {best} (score {score(best):.2f}); last policy: {policies[-1]}")
