"""PD-MORL or MO-PPO on any environment with a vector reward, of MO-Gymnasium, of Gymnasium, or your own.

Run it with ``python -m recipes.benchmark.train algorithm=pd_morl env=mo-halfcheetah-v5``; every field of
``pd_morl.yaml`` or ``mo_ppo.yaml`` and of ``common.yaml`` can be overridden on the command line.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import yaml
from omegaconf import DictConfig

from recipes.training import vector_td3
from recipes.training.command import recipe

from . import mo_ppo
from .lattice import LatticeEvaluation
from .problem import make_problem
from .schema import MOPPOConfig, PDMORLConfig


@recipe("pd_morl", PDMORLConfig)
def train_pd_morl(cfg: DictConfig) -> None:
    """Train by PD-MORL, evaluate while training, and save the last and the best policy.

    Raises:
        ValueError: for discrete actions.
    """
    problem = make_problem(cfg)
    if problem.num_actions is not None:
        raise ValueError(
            f"algorithm=pd_morl needs continuous actions, {cfg.env} has {problem.num_actions} to choose "
            "from: give algorithm=mo_ppo."
        )
    vector_td3.train(cfg, problem, evaluation=LatticeEvaluation(cfg, problem))


@recipe("mo_ppo", MOPPOConfig)
def train_mo_ppo(cfg: DictConfig) -> None:
    """The same by MO-PPO."""
    mo_ppo.train(cfg, make_problem(cfg))


_ALGORITHMS = {"pd_morl": train_pd_morl, "mo_ppo": train_mo_ppo}


def main() -> None:
    """The command of the algorithm that is asked for: each has fields of its own."""
    _ALGORITHMS.get(asked_for(sys.argv[1:]), train_pd_morl)()


def asked_for(arguments: Sequence[str]) -> str:
    """The algorithm of a command line, or that of the run that goes on.

    Examples:
        >>> asked_for(["env=minecart-v0", "algorithm=mo_ppo"]), asked_for(["--help"])
        ('mo_ppo', 'pd_morl')
    """
    given = {key: value for key, _, value in (one.partition("=") for one in arguments) if value}
    if "algorithm" in given:
        return given["algorithm"]
    kept = Path(given.get("resume", "")) / ".hydra" / "overrides.yaml"
    if "resume" in given and kept.is_file():
        try:
            overrides = yaml.safe_load(kept.read_text())
        except (OSError, ValueError, RecursionError, yaml.YAMLError):
            overrides = None
        # What is wrong with them is said where the run goes on.
        if isinstance(overrides, list) and all(isinstance(one, str) for one in overrides):
            return asked_for([one for one in overrides if not one.startswith("resume=")])
    return "pd_morl"


if __name__ == "__main__":
    main()
