"""A start from demonstrations: behaviour cloning where the style is preferred."""

from __future__ import annotations

import torch
import tqdm
from omegaconf import DictConfig
from tensordict.nn import TensorDictSequential

from envs.policy_env import motion_limits
from recipes.objectives import DEMO, EFFICIENCY
from recipes.training.task import Task, check_observation
from torchrl_morl.data import load_demonstrations
from torchrl_morl.deploy.sensing import NUM_MOTION
from torchrl_morl.preferences import PreferenceSpace

_BATCH, _LR = 512, 1.0e-3


def clones(cfg: DictConfig) -> bool:
    """Whether a training begins with a clone of demonstrations."""
    return cfg.demonstrations.dataset is not None and cfg.optim.cloning_updates > 0


def clone(cfg: DictConfig, task: Task, actor: TensorDictSequential) -> None:
    """Let an actor imitate the demonstrations, the more the style is preferred; in place.

    The squared error of the action, weighed by the cube of the preference for the style, and that of
    driving straight ahead, weighed by the cube of the rest. Preferences that start in the style are slow
    to get away from it: whoever is to keep his distance passes as near. And who starts slowly finds wider
    ways than who starts at full speed: straight ahead it is half the speed, and
    ``optim.cloning_speed`` of it with all weight on efficiency.

    Args:
        cfg: nothing happens without ``demonstrations.dataset``.
        task: with the objective ``demo``.
        actor: of observation and preference.

    Raises:
        ValueError: for demonstrations of other observations.
    """
    path, updates = cfg.demonstrations.dataset, cfg.optim.cloning_updates
    if not clones(cfg):
        return
    data, _ = load_demonstrations(path)
    check_observation(cfg, path, data["observation"].shape[-1])
    steps = data.select("observation", "action")[data["mask"]].to(task.device)
    space: PreferenceSpace = task.preference_space
    demo = space.tunable.index(DEMO)
    # Actions are in [-1, 1], from standing to top speed.
    faster = 2 * cfg.optim.cloning_speed - 1
    hurry = space.tunable.index(EFFICIENCY) if EFFICIENCY in space.tunable else None
    largest_motion = torch.tensor(motion_limits(cfg.env)).repeat(NUM_MOTION // 2)
    generator = torch.Generator().manual_seed(cfg.seed)
    optimizer = torch.optim.Adam(actor.parameters(), lr=_LR)
    with tqdm.tqdm(total=updates, desc="cloning", unit="update") as progress:
        for update in range(updates):
            for group in optimizer.param_groups:
                group["lr"] = _LR * (1 - update / updates)
            batch = steps[torch.randint(len(steps), (_BATCH,), generator=generator)]
            preference = space.sample(
                _BATCH, distribution=cfg.preference.distribution, generator=generator
            ).to(task.device)
            preference[: _BATCH // 2] = space.corners()[demo]
            if cfg.env.get("observe_motion"):
                # Any: what was demonstrated came of what was seen, not of the last command.
                motion = torch.rand(_BATCH, NUM_MOTION, generator=generator) * 2 - 1
                motion = (motion * largest_motion).to(task.device)
                batch["observation"] = torch.cat((batch["observation"], motion), -1)
            wanted = batch["action"]
            action = actor(batch.select("observation").set("preference", preference))["action"]
            share = preference[..., demo]
            ahead = torch.zeros_like(action)
            if hurry is not None:
                ahead[..., 0] = faster * preference[..., hurry]
            loss = (
                share**3 * (action - wanted).square().sum(-1)
                + (1 - share) ** 3 * (action - ahead).square().sum(-1)
            ).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            progress.update()
            if update % 100 == 0:
                progress.set_postfix(loss=f"{loss.item():.4f}")
