"""What agents other than PD-MORL's are given: environments, preferences, demonstrations."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torchrl.envs import EnvBase

from recipes.pd_morl import evaluation, files, utils
from torchrl_morl.modules import RewardModel
from torchrl_morl.preferences import PreferenceSpace


@dataclasses.dataclass(frozen=True)
class Task:
    """What every agent is given."""

    run_dir: Path
    device: torch.device
    preference_space: PreferenceSpace
    env: EnvBase
    eval_env: EnvBase
    reward_model: RewardModel | None
    demo_card: dict[str, Any] | None
    demonstration: TensorDict | None
    """What the demonstrator does in the scenes of the evaluation."""
    facts: dict[str, str] = dataclasses.field(default_factory=dict)
    """For the cards of its policies."""


def make_task(cfg: DictConfig) -> Task:
    """Environments, preferences and demonstrations as in PD-MORL; nothing is written yet.

    Raises:
        FileExistsError: if the run folder holds policies.
        ValueError: for a configuration that the environment refuses.
    """
    torch.set_num_threads(cfg.compute.torch_threads)
    torch.manual_seed(cfg.seed)
    run_dir = Path(HydraConfig.get().runtime.output_dir)
    files.check_run_dir(run_dir)
    if not 0 < cfg.loss.gamma <= 1:
        raise ValueError(f"loss.gamma must be in (0, 1], got {cfg.loss.gamma}.")
    demo = utils.load_demonstration_objective(cfg)
    reward_model, demo_card = demo if demo else (None, None)
    preference_space = utils.make_preference_space(with_demonstrations=demo is not None)
    return Task(
        run_dir=run_dir,
        device=torch.device(cfg.device),
        preference_space=preference_space,
        env=utils.make_train_env(cfg, preference_space, reward_model),
        eval_env=utils.make_eval_env(cfg, preference_space, reward_model),
        reward_model=reward_model,
        demo_card=demo_card,
        demonstration=evaluation.demonstrated(cfg, demo_card) if demo else None,
    )


def make_averaged(cfg: DictConfig, actor: TensorDictModule) -> AveragedModel:
    """The policy that is evaluated and saved."""
    return AveragedModel(
        actor, multi_avg_fn=get_ema_multi_avg_fn(cfg.optim.actor_average), use_buffers=False
    )
