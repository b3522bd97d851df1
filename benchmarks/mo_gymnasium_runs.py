"""One training on a task of MO-Gymnasium, by this project or by MORL-Baselines, and what its policy returns.

Everybody is evaluated by the same function, in the same episodes, under the same preferences.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import random
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import gymnasium
import mo_gymnasium
import numpy as np
import torch
import tqdm
from omegaconf import OmegaConf
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torchrl.envs import TransformedEnv

from envs.mo_gym import make_mo_gym_env
from recipes.benchmark.fronts import Front
from recipes.benchmark.lattice import LatticeEvaluation, LatticeResult
from recipes.benchmark.problem import BenchmarkProblem
from torchrl_morl.deploy import load_policy
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.transforms import PreferenceSampler

from .peers_morl_baselines import algorithm
from .quality_peers import Watched
from .workload import run_recipe

TASKS = {
    "mo-hopper-2obj-v5": ("velocity", "height"),
    "mo-halfcheetah-v5": ("velocity", "energy"),
    "mo-walker2d-v5": ("velocity", "energy"),
    "mo-ant-2obj-v5": ("x_velocity", "y_velocity"),
    "mo-swimmer-v5": ("velocity", "energy"),
    "mo-hopper-v5": ("velocity", "height", "energy"),
}
"""Names of the entries of their rewards."""

OURS = ("pd_morl", "mo_ppo")
PEERS = ("capql", "gpi-ls-one", "gpi-ls")
ALGORITHMS = (*OURS, *PEERS)
"""``gpi-ls`` makes 20 updates a step, its default; ``gpi-ls-one`` one, as the others do."""

GAMMA = 0.99
REFERENCE = -100.0
"""Of the hypervolume, for every objective: that of MORL-Baselines' examples of hopper and halfcheetah."""

ITERATION = 10_000
"""Steps between two choices of weights of GPI-LS, its default."""
RANDOM_STEPS = 1_000
"""What CAPQL begins with, what PD-MORL begins with, and what standardizes our observations."""
PPO_BATCH = 2_000
"""Half of the recipe's: of so few steps there would be five batches."""
EVALUATION_SEED = 2_000_003


@dataclasses.dataclass(frozen=True)
class Job:
    """A training and how it is evaluated.

    Args:
        task: one of :data:`TASKS`.
        algorithm: one of :data:`ALGORITHMS`.
        steps: of the environment.
        seed: of everything that is trained.
        preferences: points of the lattice at most.
        episodes: under each of them.
    """

    task: str
    algorithm: str
    steps: int
    seed: int
    preferences: int
    episodes: int

    @property
    def space(self) -> PreferenceSpace:
        return PreferenceSpace(TASKS[self.task])


@dataclasses.dataclass(frozen=True)
class Result:
    """What was measured of a job.

    Args:
        job: the training.
        front: mean returns, a row a preference.
        cpu_seconds: of the training, its own evaluations included where it learns from them.
        further_steps: of those evaluations, and random ones that standardize observations.
        episode_steps: of an episode of the evaluation, on average.
    """

    job: Job
    front: Front
    cpu_seconds: float
    further_steps: int
    episode_steps: float

    def front_as_lists(self) -> dict[str, list[list[float]]]:
        """The front for a file; the objectives are those of the task."""
        names = ("preferences", "returns", "discounted")
        return {name: getattr(self.front, name).tolist() for name in names}


class Trained(NamedTuple):
    """The policy without exploration, and what it cost: as in :class:`Result`."""

    actor: TensorDictModuleBase
    cpu_seconds: float
    further_steps: int


def measure(job: Job) -> Result:
    """Train and evaluate; nothing is written."""
    torch.set_num_threads(1)
    train = _train_ours if job.algorithm in OURS else _train_peer
    # CAPQL and GPI-LS write where they are started, and all of them print.
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.chdir(folder),
        contextlib.redirect_stdout(io.StringIO()),
    ):
        trained = train(job, Path(folder) / "run")
        found = evaluate(job, trained.actor)
    return Result(job, found.front, trained.cpu_seconds, trained.further_steps, found.steps)


def evaluate(job: Job, actor: TensorDictModuleBase) -> LatticeResult:
    """What an actor returns: the evaluation of the recipe, in episodes that nobody was trained in."""
    space = job.space
    env = TransformedEnv(
        make_mo_gym_env(job.task, num_envs=job.episodes), PreferenceSampler(space, seed=0)
    )
    cfg = OmegaConf.create(
        {
            "evaluation": {
                "preferences": job.preferences,
                "seed": EVALUATION_SEED,
                "discounted": True,
            },
            "loss": {"gamma": GAMMA},
            "replay_buffer": {"reward_scale": 1.0},
        }
    )
    problem = BenchmarkProblem(
        run_dir=Path(),
        device=torch.device("cpu"),
        preference_space=space,
        env=env,
        eval_env=env,
        reference=(REFERENCE,) * space.num_objectives,
    )
    return LatticeEvaluation(cfg, problem)(actor)


# --- this project --------------------------------------------------------------------------------


def overrides(job: Job) -> list[str]:
    """Of the recipe: what the steps of the job ask for; the rest is as it ships.

    Nobody compiles. A training evaluates the corners alone, PD-MORL ten times, as its recipe does:
    it learns from them.
    """
    ours = [
        f"algorithm={job.algorithm}",
        f"env={job.task}",
        f"objectives=[{','.join(TASKS[job.task])}]",
        f"seed={job.seed}",
        f"collector.total_frames={job.steps}",
        f"loss.gamma={GAMMA}",
        f"network.standardize_frames={RANDOM_STEPS}",
        f"evaluation.preferences={job.space.num_objectives}",
        "logger.backends=[csv]",
    ]
    if job.algorithm == "mo_ppo":
        return [
            *ours,
            f"collector.frames_per_batch={min(PPO_BATCH, job.steps)}",
            f"evaluation.interval={job.steps}",
        ]
    return [
        *ours,
        "compute.compile=false",
        f"collector.init_random_frames={min(RANDOM_STEPS, job.steps // 2)}",
        f"evaluation.interval={max(1, job.steps // 10)}",
    ]


def _train_ours(job: Job, folder: Path) -> Trained:
    with _watched_evaluations() as spent:
        run_recipe("recipes.benchmark.train", *overrides(job), f"hydra.run.dir={folder}")
    policy = load_policy(max((folder / "policies").iterdir()))
    seconds, evaluated = spent
    return Trained(policy.actor, seconds, evaluated + RANDOM_STEPS)


@contextlib.contextmanager
def _watched_evaluations() -> Iterator[list[float]]:
    """What was spent up to the last evaluation, which is nobody's training; pictures are never paid for.

    Yields:
        Seconds on the processor and steps of the evaluations before the last; empty before there is one.
    """
    spent: list[float] = []
    begin, drawing, steps = time.process_time(), 0.0, 0
    plain_call, plain_save = LatticeEvaluation.__call__, LatticeEvaluation.save

    def call(self: LatticeEvaluation, actor: TensorDictModuleBase) -> LatticeResult:
        nonlocal steps
        spent[:] = [time.process_time() - begin - drawing, steps]
        result = plain_call(self, actor)
        steps += round(result.steps * len(self.preferences) * self.cfg.evaluation.episodes)
        return result

    def save(self: LatticeEvaluation, *args: Any, **kwargs: Any) -> None:
        nonlocal drawing
        start = time.process_time()
        plain_save(self, *args, **kwargs)
        drawing += time.process_time() - start

    with (
        mock.patch.object(LatticeEvaluation, "__call__", call),
        mock.patch.object(LatticeEvaluation, "save", save),
    ):
        yield spent


# --- MORL-Baselines ------------------------------------------------------------------------------


def _train_peer(job: Job, folder: Path) -> Trained:
    random.seed(job.seed)
    np.random.seed(job.seed)
    torch.manual_seed(job.seed)
    further_steps = 0

    def count(steps: int) -> None:
        nonlocal further_steps
        further_steps = steps

    with tqdm.tqdm(total=job.steps, unit="step", smoothing=0.05) as progress:
        env = _peer_env(job.task, job.seed, lambda _: progress.update())
        options = {"gamma": GAMMA, "log": False, "seed": job.seed, "device": "cpu"}
        start = time.process_time()
        if job.algorithm == "capql":
            agent = algorithm("capql.capql").CAPQL(env, **options)
            act, iterations = agent.policy.get_action, {}
        else:
            updates = {"gradient_updates": 1} if job.algorithm == "gpi-ls-one" else {}
            module = algorithm("gpi_pd.gpi_pd_continuous_action")
            agent = module.GPILSContinuousAction(env, **options, **updates)
            act, iterations = agent.policy, {"timesteps_per_iter": min(ITERATION, job.steps)}
        agent.train(
            total_timesteps=job.steps,
            # GPI-LS chooses its next weights by what it returns there.
            eval_env=_peer_env(job.task, job.seed + 1000, count),
            ref_point=np.full(job.space.num_objectives, REFERENCE),
            checkpoints=False,
            **iterations,
        )
        seconds = time.process_time() - start
    # A preference over all objectives is what they call weights.
    actor = TensorDictModule(act, in_keys=["observation", "preference"], out_keys=["action"])
    return Trained(actor, seconds, further_steps)


def _peer_env(task: str, seed: int, after_step: Callable[[int], None]) -> gymnasium.Env:
    env = gymnasium.wrappers.RescaleAction(mo_gymnasium.make(task), np.float32(-1), np.float32(1))
    env.reset(seed=seed)
    env.action_space.seed(seed)
    return Watched(env, 1.0, after_step)
