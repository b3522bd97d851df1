"""One policy, six ways to run it: whether they command the same, and what a command costs.

    python -m benchmarks.parity                                # the table of docs/how_to/export.md
    python -m benchmarks.parity --inputs 1000 --episodes 5     # a first look

The environment's transforms and actor, ``policy.act``, the runner, the exported ONNX graph, its runner, and
the C++ header. They are compared on random inputs as in the training (all of them, with the environment), on
random inputs as a robot has them (all others, with ``policy.act``), and by where the robot drives in the
same scenes. Needs the extra ``export`` and a C++ compiler.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
import tqdm
from tensordict import TensorDict

from benchmarks import POLICY
from benchmarks.cpp_library import CppRunner, build_library
from envs import NavigationEnv
from envs.policy_env import make_policy_env
from envs.robots import get_robot
from recipes.arguments import Parser, count, episodes
from recipes.evaluation.setting import scene_seed
from recipes.policy_folders import policy_folder
from torchrl_morl._extras import from_extra
from torchrl_morl.deploy import (
    LidarGeometry,
    Policy,
    PolicyRunner,
    Runner,
    export_onnx,
    load_policy,
    training_lidar,
)
from torchrl_morl.deploy.features import policy_transforms
from torchrl_morl.deploy.onnx_runner import OnnxRunner
from torchrl_morl.testing import sensor_readings

Readings = Mapping[str, np.ndarray]
_MAX_STEPS = 300


@dataclasses.dataclass(frozen=True)
class Way:
    """A way to run a policy.

    Args:
        name: of the row.
        commands: of a batch of readings, ``[B, 2]``, m/s and rad/s.
    """

    name: str
    commands: Callable[[Readings], np.ndarray]


def environment(policy: Policy) -> Callable[[Readings], np.ndarray]:
    """Transforms and actor of a training, without the simulator."""
    # Without the first, which scales actions and needs an environment for it.
    transforms = policy_transforms(policy.sensing.max_range)[1:]
    low, high = np.transpose((policy.limits.speed, policy.limits.turn_rate))

    @torch.no_grad()
    def commands(readings: Readings) -> np.ndarray:
        tensors = {key: torch.from_numpy(value) for key, value in readings.items()}
        data = TensorDict(tensors, batch_size=len(readings["goal"]))
        data["scan"] = data.pop("ranges")
        action = policy.actor(transforms(data))["action"].numpy()
        return low + (action.astype(np.float64) + 1) / 2 * (high - low)

    return commands


def act(policy: Policy, lidar: LidarGeometry) -> Callable[[Readings], np.ndarray]:
    sensing = policy.sensing

    def commands(readings: Readings) -> np.ndarray:
        given = dict(readings)
        sectors = lidar.sectors(
            given.pop("ranges"), sensing.num_sectors, sensing.max_range, sensing.lidar_origin
        )
        sectors = np.where(np.isnan(sectors), sensing.unknown_range, sectors)
        return policy.act(lidar=sectors, **given)

    return commands


def graph(file: Path) -> Callable[[Readings], np.ndarray]:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    return lambda readings: session.run(["command"], dict(readings))[0]


def stepped(runner: Runner | CppRunner) -> Callable[[Readings], np.ndarray]:
    """A runner asked for one observation after the other, each later than the last."""
    clock = itertools.count()

    def commands(readings: Readings) -> np.ndarray:
        found = np.empty((len(readings["goal"]), 2))
        for index in range(len(found)):
            row, now = {name: value[index] for name, value in readings.items()}, float(next(clock))
            command = runner.step(row.pop("ranges"), **row, stamp=now, time=now)
            if command.reason != "drive":
                raise RuntimeError(f"{type(runner).__name__} stops: {command.detail}.")
            found[index] = command.speed, command.turn_rate
        return found

    return commands


def ways(policy: Policy, folder: Path, lidar: LidarGeometry, work: Path) -> list[Way]:
    """All of them; what has to be built is built in ``work``."""
    file = export_onnx(policy, work / "policy.onnx", lidar=lidar)
    library = build_library(work)
    given = {"lidar": lidar, "goal_radius": 1e-6}  # the environment says when it is reached
    return [
        Way("environment", environment(policy)),
        Way("`policy.act`", act(policy, lidar)),
        Way("`PolicyRunner`", stepped(PolicyRunner(policy, **given))),
        Way("ONNX graph", graph(file)),
        Way("`OnnxRunner`", stepped(OnnxRunner(file, goal_radius=1e-6))),
        Way("C++", stepped(CppRunner(library, folder, **given))),
    ]


def as_in_training(readings: Readings, policy: Policy) -> dict[str, np.ndarray]:
    """The readings without what no simulator has: invalid beams, and distances never trained."""
    sensing, out = policy.sensing, dict(readings)
    ranges = np.where(np.isfinite(out["ranges"]), out["ranges"], sensing.max_range)
    out["ranges"] = ranges.clip(1e-3, sensing.max_range)
    for name, (low, high) in (("goal", sensing.goal_range), ("human", sensing.human_range)):
        if name in out:
            out[name] = np.stack((out[name][:, 0].clip(low, high), out[name][:, 1]), -1)
    return out


def largest(found: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Largest difference of speed and of turn rate."""
    return abs(found.astype(np.float64) - expected).max(0)


@torch.no_grad()
def drive(policy: Policy, way: Way | None, preferences: np.ndarray, scenes: int, seed: int) -> dict:
    """Where the robot drives in the same scenes; without a way, the environment's own loop.

    Returns:
        ``path`` ``[preferences x scenes, steps, 2]``, NaN after the end, and the ``end`` of each.
    """
    shared = {"scene": "static", "robot": policy.robot, "seed": seed, "num_threads": 1}
    shared |= {"num_envs": scenes, "max_episode_steps": _MAX_STEPS}
    paths, ends = [], []
    for preference in preferences.astype(np.float32):
        if way is None:
            env = make_policy_env(policy=policy, keep_simulation=True, **shared)
        else:
            env = NavigationEnv(**shared)
        data, alive = env.reset(), np.ones(scenes, dtype=bool)
        path, end = np.full((scenes, _MAX_STEPS, 2), np.nan), np.full(scenes, "timeout", object)
        for index in range(_MAX_STEPS):
            if way is None:
                data["preference"] = torch.from_numpy(np.tile(preference, (scenes, 1)))
                data = policy.actor(data)
            else:
                readings = {
                    "ranges": data["scan"].numpy()[alive],
                    "goal": data["goal"].numpy()[alive],
                    "human": data["human"].numpy()[alive],
                    "preference": np.tile(preference, (alive.sum(), 1)),
                }
                action = np.zeros((scenes, 2))
                action[alive] = way.commands(readings)
                data["action"] = torch.from_numpy(action).to(env.dtype)
            data = env.step(data)["next"]
            path[alive, index] = data["pose"].numpy()[alive, :2]
            for name in ("success", "collision_human", "collision_obstacle"):
                end[alive & data[name].numpy()[:, 0]] = name
            alive &= ~data["done"].numpy()[:, 0]
            if not alive.any():
                break
            data = data.exclude("reward")
        env.close()
        paths.append(path)
        ends.append(end)
    return {"path": np.concatenate(paths), "end": np.concatenate(ends)}


def latency(way: Way, readings: Readings, calls: int) -> float:
    """Median of one observation, microseconds."""
    rows = [{n: value[index : index + 1] for n, value in readings.items()} for index in range(100)]
    taken = []
    for index in range(calls + 200):
        start = time.perf_counter()
        way.commands(rows[index % 100])
        taken.append(time.perf_counter() - start)
    return 1e6 * float(np.median(taken[200:]))


def main() -> None:
    parser = Parser(prog="parity", description=__doc__)
    parser.add_argument("--policy", type=policy_folder, default=POLICY, help="folder of the policy")
    parser.add_argument("--inputs", type=count(100), default=10_000, help="random inputs")
    parser.add_argument("--episodes", type=episodes, default=50, help="scenes for each preference")
    parser.add_argument("--calls", type=count(10), default=5_000, help="timed calls of each way")
    parser.add_argument("--seed", type=scene_seed, default=7, help="of inputs and scenes")
    args = parser.parse_args()
    torch.set_num_threads(1)
    try:
        policy = load_policy(args.policy)
        sensing = policy.sensing
        if sensing is None or not sensing.observe_human or sensing.observe_human_velocity:
            raise ValueError(
                f"{args.policy} does not read the human's position alone: this compares no other one."
            )
        get_robot(policy.robot)
        with from_extra("export", "parity"):
            import onnxruntime  # noqa: F401
        with tempfile.TemporaryDirectory() as work:
            measure(policy, args, training_lidar(policy), Path(work))
    except (OSError, ValueError, ImportError, RuntimeError) as error:
        parser.error(str(error).splitlines()[0])


def measure(policy: Policy, args: argparse.Namespace, lidar: LidarGeometry, work: Path) -> None:
    environment, first, *others = ways(policy, args.policy, lidar, work)
    readings = sensor_readings(policy, lidar, args.inputs, seed=args.seed)
    trained = as_in_training(readings, policy)
    space = policy.preference_space
    equal = np.full((1, space.num_tunable), 1 / space.num_tunable)
    scenes = np.concatenate((space.corners().numpy(), equal)), args.episodes, args.seed
    as_trained, on_robot = environment.commands(trained), first.commands(readings)
    driven = drive(policy, None, *scenes)
    number = len(driven["end"])
    rows = {environment: ["reference", "-", "reference", f"{number} of {number}"]}
    with tqdm.tqdm([first, *others], unit="way") as progress:
        for way in progress:
            rows[way] = [
                cell(largest(way.commands(trained), as_trained)),
                "reference" if way is first else cell(largest(way.commands(readings), on_robot)),
                *compared(drive(policy, way, *scenes), driven),
            ]
    print("| way | as trained | on a robot | path | same end | one command |")
    print("|---|---|---|---|---|---|")
    for way, cells in rows.items():
        taken = f"{latency(way, trained, args.calls):.0f} us"
        print("| " + " | ".join([way.name, *cells, taken]) + " |")
    ends, numbers = np.unique(driven["end"].astype(str), return_counts=True)
    print(
        f"\n{args.inputs} inputs; {len(scenes[0])} preferences x {args.episodes} scenes: "
        + ", ".join(f"{number} {end}" for end, number in zip(ends, numbers))
    )


def compared(driven: dict, reference: dict) -> list[str]:
    """Largest distance between two paths, and how many end alike in the same step."""
    apart = np.linalg.norm(driven["path"] - reference["path"], axis=-1)
    steps = [np.isfinite(one["path"][..., 0]).sum(-1) for one in (driven, reference)]
    same = (driven["end"] == reference["end"]) & (steps[0] == steps[1])
    return [f"{np.nanmax(apart):.1e} m", f"{same.sum()} of {len(same)}"]


def cell(difference: np.ndarray) -> str:
    return f"{difference[0]:.1e} m/s, {difference[1]:.1e} rad/s"


if __name__ == "__main__":
    main()
