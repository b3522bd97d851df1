"""A policy that nobody has trained, and that turns this way and that, by all that it reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from envs.policy_env import contract
from torchrl_morl.deploy import Policy, Sensing, save_policy
from torchrl_morl.testing import untrained_policy


def restless(sensing: Sensing, seed: int = 1) -> Policy:
    with torch.random.fork_rng(devices=()):  # the draws of a test are its own
        torch.manual_seed(seed)
        policy = untrained_policy(sensing=sensing)
    policy.actor[0].module[-1].weight.mul_(100.0)  # a new network hardly turns
    return policy


def save(folder: Path, trained: dict[str, Any], *, seed: int = 1, **card: Any) -> Path:
    """The folder of one whose card says that it was trained so.

    Args:
        folder: new.
        trained: arguments of its environment: scene, robot, drive, what it observes.

    Keyword Args:
        seed: of its weights.
        **card: more of its card.
    """
    trained = {"scene": "static", "robot": "turtlebot2"} | trained
    facts = contract(trained)
    policy = restless(facts["sensing"], seed)
    card = {"config": {"env": trained, "evaluation": {"scene": trained["scene"]}}} | card
    return save_policy(
        folder, policy.actor, preference_space=policy.preference_space, card=card, **facts
    )
