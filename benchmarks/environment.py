"""Environment steps per second, ours and TorchRL's own MuJoCo environment on the same task.

Everything is measured in one run and in turns, so that a busy machine slows all of it alike.

Examples::

    python -m benchmarks.environment
    python -m benchmarks.environment --sizes 1 16 --repetitions 2 --num-threads 1
"""

from __future__ import annotations

import argparse
import csv
import functools
import math
import os
import platform
import statistics
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple, Protocol
from xml.etree import ElementTree

import mujoco
import numpy as np
import torch
import tqdm
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, MujocoEnv, ParallelEnv, SerialEnv

from envs import NavigationEnv, get_robot, get_scene
from envs.mjcf import LIDAR_HEIGHT, navigation_mjcf
from envs.navigation import (
    COLLISION_REWARD,
    DISTANCE_MINIMUM,
    DISTANCE_THRESHOLD,
    GOAL_REWARD,
    SCENE_BLOCK,
    STYLE_PENALTY,
)
from envs.scenes import HUMAN_RADIUS

SCENE = "static"
ROBOT = "turtlebot2"
GOAL_RADIUS = 0.3
NUM_RAYS = 720
MAX_RANGE = 4.0
MAX_EPISODE_STEPS = 300
FRAME_SKIP = 4  # x 0.05 s

# Steps after which the bare simulation goes back to its start: without episodes, robots would
# push against boxes for ever.
_BATCH_HORIZON = 50
_WARM_UP_STEPS = 3
_SENSORS_OFF = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
_LIDAR_GROUPS = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)


class MujocoNavigationEnv(MujocoEnv):
    """The task of :class:`envs.NavigationEnv` as one would write it for TorchRL's ``MujocoEnv``.

    Model, scenes, frame skip, lidar, rewards and ends of episodes are the same; the test compares
    them. It holds one simulation, so everything but the lidar is arithmetic on single numbers, and
    it observes one tensor (scan, goal, human) where ``NavigationEnv`` has eight: what is left is
    the cost of the framework, and the comparison errs in this environment's favour.

    Keyword Args:
        elapsed: steps by which the first episode is shorter, to keep environments out of step.
        **kwargs: see :class:`torchrl.envs.MujocoEnv`.
    """

    DEFAULT_BACKEND = "mujoco"
    FRAME_SKIP = FRAME_SKIP

    def __init__(
        self, *, elapsed: int = 0, max_episode_steps: int = MAX_EPISODE_STEPS, **kwargs
    ) -> None:
        self._first_elapsed = elapsed
        self._scenes: list[TensorDictBase] = []
        self._robot, self._scene = get_robot(ROBOT), get_scene(SCENE)
        self._ray_angles = 2 * np.pi * np.arange(NUM_RAYS) / NUM_RAYS
        self._rays = np.zeros((NUM_RAYS, 3))
        self._hit_geom = np.zeros(NUM_RAYS, dtype=np.int32)
        self._hit_distance = np.zeros(NUM_RAYS)
        super().__init__(backend="mujoco", max_episode_steps=max_episode_steps, **kwargs)
        self._robot_body = self._backend.mj_model.body("robot").id

    @property
    def data(self) -> mujoco.MjData:
        # Rays need it, and the public state is rounded to float32.
        return self._backend._d

    def _load_xml(self, xml_path, *, patch_xml=True) -> str:
        return navigation_mjcf(
            self._robot, drive="planar", num_boxes=self._scene.num_boxes, goal_radius=GOAL_RADIUS
        )

    def _make_specs(self) -> None:
        super()._make_specs()
        low = torch.tensor([[0.0, -self._robot.max_turn_rate]], dtype=self.dtype)
        high = torch.tensor([[self._robot.max_speed, self._robot.max_turn_rate]], dtype=self.dtype)
        self.action_spec = Bounded(low=low, high=high, dtype=self.dtype)
        self.reward_spec = Unbounded(shape=(1, 3), dtype=self.dtype)

    def _make_obs_spec(self) -> Composite:
        shape = (1, NUM_RAYS + 4)
        return Composite(observation=Unbounded(shape=shape, dtype=self.dtype), shape=(1,))

    # --- reset ---------------------------------------------------------------------------------

    def _sample_initial_state(
        self, n: int, tensordict: TensorDictBase | None = None
    ) -> tuple[Tensor, Tensor]:
        model, data = self._backend.mj_model, self.data
        if not self._scenes:
            # In blocks as ours: a block costs little more than a single scene.
            block = self._scene.sample(SCENE_BLOCK, self._robot.radius, self.rng)
            self._scenes = list(block.unbind(0))
        sampled = self._scenes.pop(0)
        self._goal = sampled["goal"].tolist()
        self._human = sampled["human"].tolist()
        self._boxes = sampled["boxes"].tolist()
        for index, box in enumerate(self._boxes):
            model.geom(f"box{index}").size[:2] = box[3:]
        # Bounding volumes follow the new sizes only through mj_setConst.
        mujoco.mj_setConst(model, data)
        mujoco.mj_resetData(model, data)
        self._place("goal", *self._goal)
        self._place("human", *self._human)
        for index, box in enumerate(self._boxes):
            self._place(f"box{index}", *box[:3])
        start = sampled["start"]
        self._goal_distance = math.dist(start[:2].tolist(), self._goal)
        return start[None], torch.zeros(1, model.nv, dtype=torch.float64)

    def _place(self, body: str, x: float, y: float, yaw: float = 0.0) -> None:
        mocap = self._backend.mj_model.body(body).mocapid[0]
        self.data.mocap_pos[mocap, :2] = x, y
        self.data.mocap_quat[mocap] = math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)

    def _on_reset_all(self, tensordict: TensorDictBase | None = None) -> None:
        self._step_count += self._first_elapsed
        self._first_elapsed = 0

    # --- step ----------------------------------------------------------------------------------

    def _prepare_ctrl(self, action: Tensor) -> Tensor:
        speed, turn = action[0].tolist()
        speed = min(max(speed, 0.0), self._robot.max_speed)
        turn = min(max(turn, -self._robot.max_turn_rate), self._robot.max_turn_rate)
        return torch.tensor([[speed, turn, 0.0]], dtype=torch.float64)

    def _compute_reward(
        self, state: TensorDictBase, action: Tensor, next_state: TensorDictBase
    ) -> Tensor:
        position = self.data.qpos[:2].tolist()
        human = math.dist(position, self._human[:2])
        goal = math.dist(position, self._goal)
        collided = human <= self._robot.radius + HUMAN_RADIUS or any(
            _box_distance(position, box) <= self._robot.radius for box in self._boxes
        )
        self._ended = collided or goal <= GOAL_RADIUS
        core = GOAL_REWARD * (self._goal_distance - goal) + COLLISION_REWARD * collided
        self._goal_distance = goal
        closeness = max(DISTANCE_THRESHOLD - human, 0.0)
        distance = STYLE_PENALTY * (closeness / (DISTANCE_THRESHOLD - DISTANCE_MINIMUM)) ** 2
        return torch.tensor([[core, distance, STYLE_PENALTY]], dtype=self.dtype)

    def _compute_done(self, state: TensorDictBase, next_state: TensorDictBase) -> Tensor:
        return torch.tensor([[self._ended]])

    # --- observation ---------------------------------------------------------------------------

    def _make_obs(self, state: TensorDictBase) -> Tensor:
        x, y, yaw = self.data.qpos.tolist()
        row = np.empty((1, NUM_RAYS + 4))
        row[0, :NUM_RAYS] = self._scan(x, y, yaw)
        row[0, NUM_RAYS:] = *_polar(self._goal, x, y, yaw), *_polar(self._human, x, y, yaw)
        return torch.from_numpy(row).to(self.dtype)

    def _scan(self, x: float, y: float, yaw: float) -> np.ndarray:
        # No mj_kinematics after the physics: nothing that the lidar sees has moved.
        angle = yaw + self._ray_angles
        np.cos(angle, out=self._rays[:, 0])
        np.sin(angle, out=self._rays[:, 1])
        mujoco.mj_multiRay(
            self._backend.mj_model,
            self.data,
            np.array([x, y, LIDAR_HEIGHT]),
            self._rays.reshape(-1),
            _LIDAR_GROUPS,
            True,
            self._robot_body,
            self._hit_geom,
            self._hit_distance,
            None,
            NUM_RAYS,
            MAX_RANGE,
        )
        hit = np.where(self._hit_distance < 0, MAX_RANGE, self._hit_distance)
        return hit.clip(1e-3, MAX_RANGE)


class RangefinderNavigationEnv(MujocoNavigationEnv):
    """The same environment without a ray call of its own: MuJoCo's ``rangefinder`` sensors.

    One sensor for each ray, on as many sites of the robot. ``mj_step`` evaluates sensors at the
    start of every substep, so what it leaves in ``sensordata`` is from one substep before the
    robot's new position: this scan is 0.05 s old.

    Keyword Args:
        once: switch the sensors off during the physics and evaluate them once, after it: a current
            scan, equal to that of the other environments, for a quarter of the rays.
        **kwargs: see :class:`MujocoNavigationEnv`.
    """

    def __init__(self, *, once: bool = False, **kwargs) -> None:
        self._once = once
        super().__init__(**kwargs)
        model = self._backend.mj_model
        # Sensors see every geom but an invisible one: the marker of the goal is in their way.
        model.geom_rgba[model.geom_group == 1, 3] = 0
        if once:
            model.opt.disableflags |= _SENSORS_OFF

    def _load_xml(self, xml_path, *, patch_xml=True) -> str:
        root = ElementTree.fromstring(super()._load_xml(xml_path, patch_xml=patch_xml))
        (robot,) = root.iterfind("worldbody/body[@name='robot']")
        sensors = ElementTree.SubElement(root, "sensor")
        height = LIDAR_HEIGHT - self._robot.height / 2
        for index, angle in enumerate(self._ray_angles.tolist()):
            site = f"ray{index}"
            axis = f"{math.cos(angle)!r} {math.sin(angle)!r} 0"
            ElementTree.SubElement(robot, "site", name=site, pos=f"0 0 {height!r}", zaxis=axis)
            ElementTree.SubElement(sensors, "rangefinder", site=site, cutoff=str(MAX_RANGE))
        return ElementTree.tostring(root, encoding="unicode")

    def _scan(self, x: float, y: float, yaw: float) -> np.ndarray:
        if self._once:
            model = self._backend.mj_model
            model.opt.disableflags &= ~_SENSORS_OFF
            mujoco.mj_kinematics(model, self.data)
            mujoco.mj_sensorPos(model, self.data)
            model.opt.disableflags |= _SENSORS_OFF
        hit = np.where(self.data.sensordata < 0, MAX_RANGE, self.data.sensordata)
        return hit.clip(1e-3, MAX_RANGE)


def _polar(point: list[float], x: float, y: float, yaw: float) -> tuple[float, float]:
    """Distance and bearing of a world point seen from a pose."""
    dx, dy = point[0] - x, point[1] - y
    return math.hypot(dx, dy), math.remainder(math.atan2(dy, dx) - yaw, 2 * math.pi)


def _box_distance(point: list[float], box: list[float]) -> float:
    """Distance from a point to a box, zero inside."""
    x, y, yaw, half_length, half_width = box
    dx, dy = point[0] - x, point[1] - y
    cos, sin = math.cos(yaw), math.sin(yaw)
    return math.hypot(
        max(abs(cos * dx + sin * dy) - half_length, 0.0),
        max(abs(cos * dy - sin * dx) - half_width, 0.0),
    )


# --- what is measured ----------------------------------------------------------------------------


class Loop(Protocol):
    """Something that steps all of its environments once at a time."""

    def step(self) -> None: ...

    def close(self) -> None: ...


class TorchRLLoop:
    """Random actions and real resets through the TorchRL API: a collector without its policy."""

    def __init__(self, env: EnvBase) -> None:
        self.env = env
        self.data = env.reset()

    def step(self) -> None:
        _, self.data = self.env.step_and_maybe_reset(self.env.rand_action(self.data))

    def close(self) -> None:
        self.env.close()


class BatchLoop:
    """The native calls of a step, physics and rays, with random controls: no TorchRL, no task."""

    def __init__(self, env: NavigationEnv) -> None:
        env.reset()
        self.batch = env.batch
        self.start = self.batch.state.copy()
        self.qpos, self.ctrl = self.batch.bind("qpos"), self.batch.bind("ctrl")
        self.high = np.array([env.robot.max_speed, env.robot.max_turn_rate])
        self.low = np.array([0.0, -env.robot.max_turn_rate])
        angles = 2 * np.pi * np.arange(NUM_RAYS) / NUM_RAYS
        self.rays = np.stack((np.cos(angles), np.sin(angles)), axis=-1)
        self.turn = np.zeros((self.batch.nsim, 2, 3))
        self.origin = np.full((self.batch.nsim, NUM_RAYS, 3), LIDAR_HEIGHT)
        self.direction = np.zeros_like(self.origin)
        self.robot = env.model.body("robot").id
        self.rng = np.random.default_rng(0)
        self.steps = 0

    def step(self) -> None:
        if self.steps % _BATCH_HORIZON == 0:
            self.batch.state[...] = self.start
        self.steps += 1
        self.ctrl[:, :2] = self.rng.uniform(self.low, self.high, (self.batch.nsim, 2))
        self.batch.step(nstep=FRAME_SKIP)
        cos, sin = np.cos(self.qpos[:, 2]), np.sin(self.qpos[:, 2])
        self.turn[:, 0, 0] = self.turn[:, 1, 1] = cos
        self.turn[:, 0, 1], self.turn[:, 1, 0] = sin, -sin
        np.matmul(self.rays, self.turn, out=self.direction)
        self.origin[..., :2] = self.qpos[:, None, :2]
        self.batch.ray(self.origin, self.direction, geomgroup=_LIDAR_GROUPS, bodyexclude=self.robot)

    def close(self) -> None:
        pass


def first_elapsed(num_envs: int) -> list[int]:
    """First episodes of evenly spread lengths: resets come one by one, as in a long training."""
    return [index * MAX_EPISODE_STEPS // num_envs for index in range(num_envs)]


def _navigation(num_envs: int, num_threads: int, *, snapshots: bool = False) -> NavigationEnv:
    return NavigationEnv(
        scene=SCENE,
        robot=ROBOT,
        goal_radius=GOAL_RADIUS,
        num_rays=NUM_RAYS,
        max_range=MAX_RANGE,
        max_episode_steps=MAX_EPISODE_STEPS,
        num_envs=num_envs,
        num_threads=num_threads,
        snapshots=snapshots,
        seed=0,
    )


def navigation_loop(num_envs: int, num_threads: int, *, snapshots: bool) -> Loop:
    env = _navigation(num_envs, num_threads, snapshots=snapshots)
    loop = TorchRLLoop(env)
    env._elapsed[:, 0] = torch.tensor(first_elapsed(num_envs))
    return loop


def mujoco_envs(
    num_envs: int, make: Callable[..., EnvBase] = MujocoNavigationEnv
) -> list[Callable[[], EnvBase]]:
    return [
        functools.partial(make, seed=seed, elapsed=elapsed)
        for seed, elapsed in enumerate(first_elapsed(num_envs))
    ]


def _mujoco_loop(num_envs: int, num_threads: int) -> Loop:
    (make_env,) = mujoco_envs(num_envs)
    return TorchRLLoop(make_env())


def _serial_loop(make: Callable[..., EnvBase], num_envs: int, num_threads: int) -> Loop:
    return TorchRLLoop(SerialEnv(num_envs, mujoco_envs(num_envs, make)))


def _parallel_loop(make: Callable[..., EnvBase], num_envs: int, num_threads: int) -> Loop:
    envs = mujoco_envs(num_envs, make)
    return TorchRLLoop(ParallelEnv(num_envs, envs, mp_start_method="fork"))


def _batch_loop(num_envs: int, num_threads: int) -> Loop:
    return BatchLoop(_navigation(num_envs, num_threads))


OURS = "NavigationEnv"

_COMPETITORS: dict[str, Callable[..., EnvBase]] = {
    "one mj_multiRay": MujocoNavigationEnv,
    "rangefinders": RangefinderNavigationEnv,
    "rangefinders once": functools.partial(RangefinderNavigationEnv, once=True),
}
"""Ways to a lidar in ``MujocoEnv``."""

SERIAL = {f"MujocoEnv, {name}, SerialEnv": make for name, make in _COMPETITORS.items()}
PARALLEL = {f"MujocoEnv, {name}, ParallelEnv": make for name, make in _COMPETITORS.items()}

VARIANTS: dict[str, Callable[[int, int], Loop]] = {
    OURS: functools.partial(navigation_loop, snapshots=False),
    "NavigationEnv, snapshots": functools.partial(navigation_loop, snapshots=True),
    "MujocoEnv, one mj_multiRay": _mujoco_loop,
    **{name: functools.partial(_serial_loop, make) for name, make in SERIAL.items()},
    **{name: functools.partial(_parallel_loop, make) for name, make in PARALLEL.items()},
    "Batch without TorchRL": _batch_loop,
}
"""What is measured: name, and ``make(num_envs, num_threads)``."""


class Case(NamedTuple):
    """One cell of the table."""

    variant: str
    num_envs: int


def steps_per_second(loop: Loop, num_envs: int, seconds: float) -> float:
    """Environment steps per second over at least that many seconds."""
    steps = 0
    start = time.perf_counter()
    while (spent := time.perf_counter() - start) < seconds or not steps:
        loop.step()
        steps += num_envs
    return steps / spent


def measure(
    cases: list[Case], *, repetitions: int, seconds: float, num_threads: int
) -> dict[Case, list[float]]:
    """Steps per second of every case and repetition, taking turns within each repetition."""
    loops: dict[Case, Loop] = {}
    rates: dict[Case, list[float]] = {case: [] for case in cases}
    total = len(cases) * (1 + repetitions)
    with tqdm.tqdm(total=total, unit="measurement", desc="start") as progress:
        try:
            # Workers are forked before this process has native threads, which a fork would lose.
            for case in sorted(cases, key=lambda case: case.variant not in PARALLEL):
                loops[case] = VARIANTS[case.variant](case.num_envs, num_threads)
                for _ in range(_WARM_UP_STEPS):
                    loops[case].step()
                progress.update()
            for repetition in range(repetitions):
                progress.set_description(f"repetition {repetition + 1}/{repetitions}")
                for case in cases:
                    rates[case].append(steps_per_second(loops[case], case.num_envs, seconds))
                    progress.update()
        finally:
            for loop in loops.values():
                loop.close()
    return rates


# --- report --------------------------------------------------------------------------------------


def speed_up(rates: dict[Case, list[float]], case: Case) -> float:
    """How many times faster ours is at that size: median over repetitions of the ratio in each."""
    ours = rates[Case(OURS, case.num_envs)]
    return statistics.median(a / b for a, b in zip(ours, rates[case], strict=True))


def machine(num_threads: int) -> dict[str, str]:
    """What the numbers depend on."""
    batch_threads = _navigation(2, num_threads).batch.nthread
    variables = [
        f"{name}={os.environ[name]}"
        for name in ("OMP_NUM_THREADS", "OMP_WAIT_POLICY")
        if name in os.environ
    ]
    packages = ("torch", "torchrl", "tensordict", "mujoco", "numpy")
    return {
        "versions": ", ".join(
            [f"python {platform.python_version()}"]
            + [f"{name} {version(name)}" for name in packages]
        ),
        "cpus": f"{len(os.sched_getaffinity(0))}",
        "load": f"{os.getloadavg()[0]:.1f}",
        "threads": ", ".join([f"physics {batch_threads}", f"torch {torch.get_num_threads()}"])
        + "".join(f", {variable}" for variable in variables),
    }


def report(
    rates: dict[Case, list[float]], skipped: dict[Case, str], info: dict[str, str], repetitions: int
) -> str:
    """The table, one line for each variant, and what it depends on."""
    sizes = sorted({case.num_envs for case in rates})
    rows = [["environments", *map(str, sizes)]]
    for variant in VARIANTS:
        row = [variant]
        for size in sizes:
            case = Case(variant, size)
            if case in rates:
                rate = f"{statistics.median(rates[case]):,.0f}"
                row.append(rate if variant == OURS else f"{rate} ({speed_up(rates, case):.2f}x)")
            else:
                row.append("not run")
        rows.append(row)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        f"Environment steps per second, median of {repetitions}; in brackets how many times faster "
        f"{OURS} is.",
        "",
    ]
    for row in rows:
        cells = [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        lines.append("  ".join([row[0].ljust(widths[0]), *cells]))
    reasons: dict[tuple[str, str], list[str]] = {}
    for case, reason in skipped.items():
        reasons.setdefault((case.variant, reason), []).append(str(case.num_envs))
    lines.append("")
    for (variant, reason), numbers in reasons.items():
        lines.append(f"not run: {variant} with {', '.join(numbers)}: {reason}")
    lines.append(info["versions"])
    lines.append(
        f"{info['cpus']} CPUs, load {info['load']} before the start; threads: {info['threads']}"
    )
    return "\n".join(lines)


def write_csv(path: Path, rates: dict[Case, list[float]], info: dict[str, str]) -> None:
    """Every single measurement, one a line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["variant", "num_envs", "repetition", "steps_per_second", *info])
        for case, values in rates.items():
            for repetition, value in enumerate(values):
                writer.writerow([*case, repetition, f"{value:.1f}", *info.values()])


def plan(
    sizes: list[int], *, serial_max: int, parallel_max: int
) -> tuple[list[Case], dict[Case, str]]:
    """Which cases to measure, and why not the others."""
    serial = (serial_max, "it steps one simulation after the other (--serial-max)")
    parallel = (parallel_max, "it takes a process for each environment (--parallel-max)")
    limits = {
        "MujocoEnv, one mj_multiRay": (1, "it holds one simulation"),
        **dict.fromkeys(SERIAL, serial),
        **dict.fromkeys(PARALLEL, parallel),
    }
    cases, skipped = [], {}
    for size in sorted(set(sizes)):
        for variant in VARIANTS:
            limit, reason = limits.get(variant, (math.inf, ""))
            if size <= limit:
                cases.append(Case(variant, size))
            else:
                skipped[Case(variant, size)] = reason
    return cases, skipped


def main(arguments: list[str] | None = None) -> None:
    """Measure; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sizes", type=int, nargs="+", default=[1, 16, 64, 256, 1024], metavar="N")
    parser.add_argument("--repetitions", type=int, default=5, help="rounds over all cases")
    parser.add_argument("--seconds", type=float, default=1.0, help="of each measurement")
    parser.add_argument("--serial-max", type=int, default=64, help="largest SerialEnv")
    parser.add_argument("--parallel-max", type=int, default=16, help="largest ParallelEnv")
    parser.add_argument(
        "--num-threads", type=int, default=0, help="of NavigationEnv's physics (default: every CPU)"
    )
    parser.add_argument("--torch-threads", type=int, default=1, help="of PyTorch, in all variants")
    parser.add_argument("--output", type=Path, default=Path("runs/benchmarks/environment.csv"))
    args = parser.parse_args(arguments)
    if min(args.sizes) < 1 or args.repetitions < 1:
        parser.error("--sizes and --repetitions must be at least 1.")

    torch.set_num_threads(args.torch_threads)
    torch.manual_seed(0)
    load = f"{os.getloadavg()[0]:.1f}"
    cases, skipped = plan(args.sizes, serial_max=args.serial_max, parallel_max=args.parallel_max)
    rates = measure(
        cases, repetitions=args.repetitions, seconds=args.seconds, num_threads=args.num_threads
    )
    info = {**machine(args.num_threads), "load": load}
    print(report(rates, skipped, info, args.repetitions))
    write_csv(args.output, rates, info)
    print(f"every measurement: {args.output}")


if __name__ == "__main__":
    main()
