"""The run folder: what made a training, and the policies that it saves."""

from __future__ import annotations

import importlib.metadata
import json
import platform
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictModule

from envs.policy_env import observation_size
from torchrl_morl.deploy import save_policy
from torchrl_morl.preferences import PreferenceSpace

from .evaluation import Evaluation


def check_run_dir(run_dir: Path) -> None:
    """Refuse a folder that another training has left policies in, before hours of training."""
    policies = run_dir / "policies"
    if policies.exists():
        raise FileExistsError(
            f"{policies} exists and is not overwritten: choose another hydra.run.dir."
        )


def write_run_info(run_dir: Path) -> None:
    """Versions and git state, beside the resolved configuration that Hydra writes."""
    packages = ("torch", "torchrl", "tensordict", "mujoco", "numpy")
    info = {
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "python": platform.python_version(),
        "versions": {name: importlib.metadata.version(name) for name in packages},
        "git": _git_state(run_dir),
    }
    (run_dir / "run.json").write_text(json.dumps(info, indent=2) + "\n")


def _git_state(run_dir: Path) -> dict[str, Any] | None:
    if shutil.which("git") is None:
        return None

    def git(*arguments: str) -> subprocess.CompletedProcess:
        where = Path(__file__).parent
        return subprocess.run(["git", *arguments], cwd=where, capture_output=True, text=True)

    commit = git("rev-parse", "HEAD")
    if commit.returncode:
        return None
    diff = git("diff", "HEAD").stdout
    if diff:
        (run_dir / "uncommitted.diff").write_text(diff)
    return {"commit": commit.stdout.strip(), "uncommitted_changes": bool(diff)}


def save_training_policy(
    folder: Path,
    cfg: DictConfig,
    actor: TensorDictModule,
    preference_space: PreferenceSpace,
    result: Evaluation,
    demo_card: dict[str, Any] | None,
    *,
    num_cells: tuple[int, ...] | None = None,
    **facts: Any,
) -> None:
    """Save a policy whose card tells what made it, how it did, and other ``facts``.

    Its hidden sizes are those of the configuration unless ``num_cells`` says otherwise.
    """
    card = {
        **facts,
        "config": OmegaConf.to_container(cfg, resolve=True),
        "evaluation": {"preferences": result.names, **result.columns},
        "score": result.score,
    }
    if demo_card is not None and "demonstrator" in demo_card:
        card["demonstrator"] = demo_card["demonstrator"]
    save_policy(
        folder,
        actor,
        preference_space=preference_space,
        observation_size=observation_size(cfg.env),
        action_size=2,
        num_cells=num_cells or tuple(cfg.network.num_cells),
        card=card,
    )


def finish(run_dir: Path, cfg: DictConfig) -> None:
    """Point to the results."""
    policies = sorted((run_dir / "policies").glob("*"))

    def score(folder: Path) -> float:
        return json.loads((folder / "policy.json").read_text())["card"]["score"]

    if policies:
        best = max(policies, key=score)
        print(f"best policy: {best} (score {score(best):.2f}); last policy: {policies[-1]}")
