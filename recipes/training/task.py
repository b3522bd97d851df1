"""What an agent is given: environments, preferences, demonstrations."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs import EnvBase

from envs import NavigationEnv, RobotRanges, get_robots
from envs.demonstrations import CircleDemonstrator, demonstrated_paths
from envs.policy_env import (
    SHOWN,
    make_policy_env,
    observation_size,
    observed,
    observed_size,
    simulated,
)
from envs.splits import check_validation_seed, training_seed
from recipes.evaluation.setting import demonstration_on
from recipes.evaluation.sweep import scene_layout
from recipes.objectives import DEMO, reward_objectives
from torchrl_morl.deploy import load_reward_model
from torchrl_morl.deploy.features import observation_parts
from torchrl_morl.modules import RewardModel
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.transforms import PreferenceSampler

from .collisions import CollisionReward
from .gradients import use_bfloat16
from .people import WhereSomebodyStands
from .run_folder import check_run_dir


@dataclasses.dataclass(frozen=True)
class Task:
    """What every agent is given."""

    run_dir: Path
    device: torch.device
    preference_space: PreferenceSpace
    env: EnvBase
    """Where it trains."""
    eval_env: EnvBase
    reward_model: TensorDictModuleBase | None
    demo_card: dict[str, Any] | None
    demonstration: TensorDict | None
    """What the demonstrator does in the scenes of the evaluation."""
    scenes: TensorDict
    """Those scenes, see :func:`recipes.evaluation.sweep.scene_layout`."""
    make_env: Callable[[int, int], EnvBase] | None = None
    """Another one to train in, of a seed and a number of environments; it can be pickled."""
    statistics: None = None
    """Networks see observations as they are: their transforms have brought them to units."""
    facts: dict[str, Any] = dataclasses.field(default_factory=dict)
    """For the cards of its policies."""


def make_task(cfg: DictConfig, run_dir: Path | None = None) -> Task:
    """Environments, preferences and demonstrations as in PD-MORL; nothing is written yet.

    Args:
        cfg: the configuration.
        run_dir: where the training will write; Hydra's output folder if ``None``.

    Raises:
        FileExistsError: if the run folder holds policies.
        ValueError: for a configuration that the environment refuses.
    """
    torch.set_num_threads(cfg.compute.torch_threads)
    torch.manual_seed(cfg.seed)
    if run_dir is None:
        run_dir = Path(HydraConfig.get().runtime.output_dir)
    if cfg.get("resume") is None:
        check_run_dir(run_dir)
    device = torch.device(cfg.device)
    demo = load_demonstration_objective(cfg)
    reward_model, demo_card = demo if demo else (None, None)
    if demo and cfg.demonstrations.get("standing_only"):
        reward_model = WhereSomebodyStands(reward_model, observation_parts(**observed(cfg.env)))
    preference_space = make_preference_space(
        cfg.env.get("objectives"), with_demonstrations=demo is not None
    )
    start = evaluation_start(cfg)
    return Task(
        run_dir=run_dir,
        device=device,
        preference_space=preference_space,
        env=make_train_env(cfg, preference_space, reward_model),
        eval_env=make_eval_env(cfg, preference_space, reward_model),
        reward_model=reward_model,
        demo_card=demo_card,
        demonstration=demonstrated(cfg, demo_card, start) if demo else None,
        scenes=scene_layout(start),
        make_env=functools.partial(make_worker_env, cfg, preference_space, reward_model),
        # What null in the configuration became; scalarised agents have no such field.
        facts={"bfloat16": use_bfloat16(cfg.compute.get("bfloat16", False), device)},
    )


def load_demonstration_objective(cfg: DictConfig) -> tuple[RewardModel, dict] | None:
    """The reward model that adds the objective "demo", and its card; ``None`` without one."""
    folder = cfg.demonstrations.reward_model
    if folder is None and cfg.demonstrations.get("dataset") is not None:
        raise ValueError(
            "demonstrations.dataset needs demonstrations.reward_model: without one there is no "
            'objective "demo" for them.'
        )
    if folder is None:
        return None
    model, card = load_reward_model(folder)
    # Agents are drawn behind a reward model of that size: a seed gives the policy that it always gave.
    members = model.module.members
    sizes = [layer.out_features for layer in members[0] if isinstance(layer, nn.Linear)]
    RewardModel(in_features=model.in_features, num_cells=sizes[:-1], num_members=len(members))
    check_observation(cfg, folder, observed_size(model))
    return model, card


def check_observation(
    cfg: DictConfig, source: str, size: int, names: Sequence[str] = SHOWN
) -> None:
    """Refuse what was made with another observation than the one of this training.

    Args:
        cfg: the configuration.
        source: what messages call that.
        size: of its observation.
        names: of what it should be, from ``env``.

    Raises:
        ValueError: in one line.
    """
    expected = observation_size(cfg.env, names)
    if size != expected:
        raise ValueError(
            f"{source} is about observations of {size} entries, here they have {expected}: both recipes "
            f"must be given the same {', '.join(f'env.{name}' for name in names)}."
        )


def make_preference_space(
    names: Sequence[str] | None = None, *, with_demonstrations: bool
) -> PreferenceSpace:
    """The first objective always counts once; the user weighs the others.

    Args:
        names: of the environment's objectives; its defaults if ``None``.
    """
    names = reward_objectives(
        NavigationEnv.objectives if names is None else names,
        with_demonstrations=with_demonstrations,
    )
    return PreferenceSpace(names, static={names[0]: 1.0})


def make_train_env(
    cfg: DictConfig, preference_space: PreferenceSpace, reward_model: TensorDictModuleBase | None
) -> EnvBase:
    sampler = PreferenceSampler(
        preference_space,
        distribution=cfg.preference.distribution,
        num_segments=cfg.preference.num_segments,
        slabs=cfg.preference.get("slabs", False),
        seed=cfg.seed,
    )
    # Never the scenes of an evaluation.
    seed = training_seed(cfg.seed)
    env = make_policy_env(sampler, reward_model=reward_model, seed=seed, **cfg.env)
    cost = cfg.demonstrations.get("collision_reward")
    if cost and reward_model is not None:
        env.append_transform(CollisionReward(cost, entry=preference_space.objectives.index(DEMO)))
    return env


def make_worker_env(
    cfg: DictConfig,
    preference_space: PreferenceSpace,
    reward_model: TensorDictModuleBase | None,
    seed: int,
    num_envs: int,
) -> EnvBase:
    """As :func:`make_train_env`, for a worker: fewer environments, of another seed, on its threads."""
    env = {"num_envs": num_envs, "num_threads": cfg.collector.worker_cpus}
    cfg = OmegaConf.merge(cfg, {"seed": seed, "env": env})
    return make_train_env(cfg, preference_space, reward_model)


def make_eval_env(
    cfg: DictConfig, preference_space: PreferenceSpace, reward_model: TensorDictModuleBase | None
) -> EnvBase:
    sampler = PreferenceSampler(preference_space)
    return make_policy_env(sampler, reward_model=reward_model, **evaluation_arguments(cfg))


def evaluation_start(cfg: DictConfig) -> TensorDictBase:
    """How the scenes of the evaluation start, snapshots ``[N]``."""
    env = NavigationEnv(**simulated(evaluation_arguments(cfg)))
    start = env.reset()
    env.close()
    return start


def demonstrated(cfg: DictConfig, card: dict[str, Any], start: TensorDictBase) -> TensorDict | None:
    """What the demonstrator does in the scenes of the evaluation.

    ``None`` for the reward model of recorded demonstrations: nobody drives them in other scenes.
    """
    if "demonstrator" not in card:
        return None
    kwargs = simulated(evaluation_arguments(cfg))
    del kwargs["num_envs"], kwargs["seed"]
    return demonstrated_paths(
        CircleDemonstrator(**demonstrator_of(card, cfg.env.robot)), start, **kwargs
    )


def demonstrator_of(card: dict[str, Any], robot: Any) -> dict[str, Any]:
    """Arguments of what a reward model's card was shown, for another robot where robots differ."""
    given = dict(card["demonstrator"])
    shown, here = get_robots(given.get("robot", "turtlebot2")), get_robots(robot)
    if isinstance(shown, RobotRanges) or isinstance(here, RobotRanges):
        return demonstration_on(given, robot)
    return given


def evaluation_arguments(cfg: DictConfig) -> dict[str, Any]:
    """Of :func:`make_policy_env`: the training's own but for the scenes."""
    changed = cfg.evaluation
    return {
        **cfg.env,
        "num_envs": changed.episodes,
        "scene": changed.scene,
        "seed": check_validation_seed(changed.seed),
        "repeat_failed": 0.0,
    }
