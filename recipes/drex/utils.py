"""Rollouts of the D-REX recipe: demonstrations, their clone, and the clone under noise."""

from __future__ import annotations

import importlib.metadata
from pathlib import Path
from typing import Any

import torch
import tqdm
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torch.nn import functional as F
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import BCLoss

from envs import NavigationEnv
from envs.demonstrations import CircleDemonstrator, demonstrated_paths
from envs.metrics import trajectories
from envs.policy_env import make_policy_env, observation_size, simulated
from torchrl_morl.data import load_demonstrations
from torchrl_morl.deploy import save_policy
from torchrl_morl.evaluation import discrete_frechet, episode_mask
from torchrl_morl.modules import make_actor
from torchrl_morl.modules.exploration import HeldEGreedyModule

from ..pd_morl.utils import check_observation, make_preference_space

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


def read_demonstrations(cfg: DictConfig) -> TensorDictBase | None:
    """Somebody's own demonstrations ``[N, T]``; ``None`` where the scripted ones are asked for.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no file of demonstrations, of another robot, or of another observation.
    """
    path = cfg.demonstrations.dataset
    if path is None:
        return None
    data, metadata = load_demonstrations(path)
    robot = metadata.get("robot") or metadata["config"]["env"]["robot"]
    if robot != cfg.env.robot:
        raise ValueError(
            f"{path} was driven by {robot}, but env.robot is {cfg.env.robot}: set env.robot={robot}, "
            "or import the recordings again with --robot."
        )
    check_observation(cfg, path, data["observation"].shape[-1])
    return data


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
    """Behaviour cloning with early stopping on held-out trajectories.

    Returns:
        The best policy and its loss. A single demonstration leaves nothing to hold out: then the
        loss is that of the training.
    """
    generator = torch.Generator().manual_seed(cfg.seed)
    policy = make_actor(
        ACTION_SPEC,
        in_features=observation_size(cfg.env),
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
        observation_size=size,
        action_size=ACTION_SPEC.shape[-1],
        num_cells=num_cells,
        card=metadata(cfg) | card | {"preference": "ignored"},
    )


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


@torch.no_grad()
def demonstrated(cfg: DictConfig, count: int, seed: int) -> TensorDict:
    """What the demonstrator drives in the scenes of :func:`rollouts`, as if there were no boxes."""
    kwargs = simulated(cfg.env)
    env = NavigationEnv(num_envs=count, seed=seed, **kwargs)
    start = env.reset()
    env.close()
    driver = CircleDemonstrator(**demonstrator_arguments(cfg))
    return demonstrated_paths(driver, start, **kwargs)


def core_return(data: TensorDictBase) -> Tensor:
    """Of trajectories ``[N, T]``, as a share of what the way to the goal pays: 1 at best."""
    reward = data["next", "reward"][..., 0] * data["mask"]
    return reward.sum(-1) / (125 * data["goal"][:, 0, 0])


def frechet(data: TensorDictBase, reference: TensorDictBase) -> Tensor:
    """Distance of trajectories ``[N, T]`` from what is :func:`demonstrated` in their scenes, metres."""
    path = trajectories(data)
    return discrete_frechet(
        path["position"], path["mask"], reference["position"], reference["mask"]
    )


def mean_and_error(values: Tensor) -> tuple[Tensor, Tensor]:
    """Mean over the last dimension and its standard error; NaN where there are too few values."""
    mean = values.mean(-1)
    variance = (values - mean.unsqueeze(-1)).square().mean(-1)
    return mean, (variance / (values.shape[-1] - 1)).sqrt()


def metadata(cfg: DictConfig) -> dict[str, Any]:
    """What made the demonstrations."""
    packages = ("torch", "torchrl", "tensordict", "mujoco", "torchrl-morl")
    made = {
        "config": OmegaConf.to_container(cfg, resolve=True),
        "versions": {name: importlib.metadata.version(name) for name in packages},
    }
    if cfg.demonstrations.dataset is None:
        # Whoever finds it drives it, to measure how close a policy comes.
        made["demonstrator"] = demonstrator_arguments(cfg)
    return made


def demonstrator(cfg: DictConfig, **changes: Any) -> CircleDemonstrator:
    """Drives what is demonstrated, or what differs from it by other arguments."""
    return CircleDemonstrator(**demonstrator_arguments(cfg) | changes, scaled=True)


def demonstrator_arguments(cfg: DictConfig) -> dict[str, Any]:
    """Of :class:`envs.demonstrations.CircleDemonstrator`."""
    section = cfg.demonstrations
    return {
        "radius": section.radius,
        "side": section.side,
        "speed": section.speed,
        "robot": cfg.env.robot,
    }
