"""Short trainings of MO-PPO for its tests."""

from __future__ import annotations

from pathlib import Path

import torch
from torchrl.data import Bounded

from envs import NavigationEnv
from recipes.mo_ppo import mo_ppo
from tests._command import run_here
from torchrl_morl import PreferenceSpace
from torchrl_morl.deploy import save_policy
from torchrl_morl.deploy.features import OBSERVATION_SIZE
from torchrl_morl.modules import make_actor

SPACE = PreferenceSpace(NavigationEnv.objectives, static={"core": 1.0})
SHIPPED = Path(mo_ppo.__file__).parents[1] / "policies" / "polished_seed0"
CONFIG = {
    "seed": 7,
    "env": {
        "scene": "exploring",
        "robot": "turtlebot2",
        "goal_radius": 0.3,
        "max_episode_steps": 20,
        "num_envs": 24,
    },
    "evaluation": {"scene": "static", "episodes": 50},
}
TINY = (
    # Settings of the process: other tests run in it.
    "compute.torch_threads=1",
    "compute.bfloat16=false",
    "env.num_threads=1",
    "env.num_envs=4",
    "collector.frames_per_batch=32",
    "collector.total_frames=128",
    "optim.batch_size=16",
    "optim.critic_batches=1",
    "network.num_cells=[16,16]",
    "evaluation.interval=64",
    "evaluation.episodes=2",
    "logger.backends=[csv]",
)


def small_policy(folder: Path, preference_space: PreferenceSpace = SPACE) -> Path:
    torch.manual_seed(0)
    spec = Bounded(-1.0, 1.0, (2,))
    size = OBSERVATION_SIZE + preference_space.num_tunable
    actor = make_actor(spec, in_features=size, num_cells=(8,), last_layer_gain=1.0)
    return save_policy(
        folder,
        actor,
        preference_space=preference_space,
        card={"config": CONFIG},
    )


def run(folder: Path, policy: Path, *overrides: str) -> Path:
    run_here(
        mo_ppo.main,
        f"policy={policy}",
        *TINY,
        *overrides,
        f"hydra.run.dir={folder}",
    )
    return folder


def go_on(folder: Path, *overrides: str) -> None:
    run_here(mo_ppo.main, f"resume={folder}", *overrides)


def nothing(folder: Path, *overrides: str) -> Path:
    run_here(mo_ppo.main, "preset=nothing", *TINY, *overrides, f"hydra.run.dir={folder}")
    return folder
