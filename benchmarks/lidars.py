"""What other lidars than that of the training cost: the table of docs/deploy.md.

A policy drives through :class:`torchrl_morl.deploy.PolicyRunner` in MuJoCo; the beams are cast at the
angles of the lidar that is tried. At every visited state its command is compared with that of the
native scan of 720 beams.

    python -m benchmarks.lidars                       # 100 scenes, 4 preferences, about ten minutes
    python -m benchmarks.lidars --episodes 10 --only 360 clockwise
    python -m benchmarks.lidars --policy recipes/policies/navigation

A policy that reads which robot it drives is told that of each row: a TurtleBot 2 with that lidar.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import torch
import tqdm

from benchmarks import POLICY
from envs import NavigationEnv
from envs.lidar import MIN_RANGE, Lidar
from envs.robots import Robot
from envs.scene_files import get_scene
from envs.scenes import HUMAN_RADIUS, Scene
from recipes.arguments import Parser, episodes
from recipes.evaluation.setting import scene_seed, trained_in
from recipes.policy_folders import policy_folder
from torchrl_morl.deploy import LidarGeometry, Policy, PolicyRunner, load_policy

FULL = 2 * math.pi
FAR_AWAY = 500.0


@dataclasses.dataclass(frozen=True)
class Case:
    """A row of the table.

    Args:
        name: of the row.
        beams: in the field of view.
        per_revolution: beams a revolution, of which those in view are reported.
        clockwise: the other direction.
        start: angle of the first beam, radians.
        range_max: metres.
        mount: of the lidar, x, y, yaw.
        spoil: what happens to the ranges.
        scene: where to drive.
        nobody: without a human.
        frozen: the inputs stay those of one moment for four seconds, once an episode.
        max_steps: of an episode.
    """

    name: str
    beams: int = 720
    per_revolution: int = 720
    clockwise: bool = False
    start: float = 0.0
    range_max: float = 4.0
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    spoil: Callable[[np.ndarray, np.random.Generator], None] | None = None
    scene: str | Scene = "static"
    nobody: bool = False
    frozen: bool = False
    max_steps: int = 300

    @property
    def geometry(self) -> LidarGeometry:
        increment = FULL / self.per_revolution * (-1 if self.clockwise else 1)
        near = MIN_RANGE / 2
        return LidarGeometry(self.start, increment, self.beams, near, self.range_max, self.mount)

    @property
    def view(self) -> float:
        """From the first beam to the last, radians."""
        if self.beams == self.per_revolution:
            return FULL
        return FULL * (self.beams - 1) / self.per_revolution


def some(value: float, share: float = 0.05) -> Callable:
    """Readings that are replaced by a value, others at every step."""

    def spoil(ranges: np.ndarray, rng: np.random.Generator) -> None:
        ranges[rng.random(ranges.shape) < share] = value

    return spoil


def one_dead(ranges: np.ndarray, rng: np.random.Generator) -> None:
    ranges[:, 7] = 0.0


def changed(name: str, change: Callable) -> Scene:
    """The scene ``static`` after a change of what is sampled."""
    static = get_scene("static")

    def sample(n: int, robot_radius: float, rng: torch.Generator):
        sampled = static.sample(n, robot_radius, rng)
        change(sampled)
        return sampled

    return Scene(name, static.num_boxes, sample)


def no_human(sampled) -> None:
    for key in ("human", "human_goal"):
        sampled[key][:, :2] = -FAR_AWAY


def far_goal(sampled) -> None:
    sampled["goal"][:, 0] += 28.0


HALF = math.radians(135.0)
CASES = (
    Case("native: 720 beams"),
    Case("90 beams", 90, 90),
    Case("180 beams", 180, 180),
    Case("360 beams", 360, 360),
    Case("360 beams, range_max 3.5 m", 360, 360, range_max=3.5),
    Case("667 beams", 667, 667),
    Case("1440 beams", 1440, 1440),
    Case("541 beams over 270 degrees", 541, 720, start=-HALF),
    Case("1081 beams over 270 degrees", 1081, 1440, start=-HALF),
    Case("720 beams, clockwise", clockwise=True),
    Case("667 beams, clockwise from behind", 667, 667, clockwise=True, start=math.pi),
    Case("541 beams over 270 degrees, clockwise", 541, 720, clockwise=True, start=HALF),
    Case("5 % of the beams 0", spoil=some(0.0)),
    Case("5 % of the beams -1", spoil=some(-1.0)),
    Case("5 % of the beams NaN", spoil=some(math.nan)),
    Case("5 % of the beams inf", spoil=some(math.inf)),
    Case("5 % of the beams above range_max", spoil=some(5.0)),
    Case("one beam always 0", spoil=one_dead),
    Case("360 beams, 5 % of them NaN", 360, 360, spoil=some(math.nan)),
    Case("mounted 0.1 m ahead", mount=(0.1, 0.0, 0.0)),
    Case("mounted 0.1 m behind and to the left, turned by 90 degrees", mount=(-0.1, 0.1, FULL / 4)),
    Case("nobody there", scene=changed("nobody", no_human), nobody=True),
    Case("goal 34 to 40 m away", scene=changed("far", far_goal), max_steps=700),
    Case("inputs frozen for 4 s", frozen=True),
)


def cast(data, robot: Robot, num_rays: int, mount: tuple[float, float, float]) -> np.ndarray:
    """Ranges ``[N, num_rays]`` in all directions, counter-clockwise from the lidar's x axis."""
    pose, human = data["pose"].numpy(), data["human_pose"].numpy()
    goal, boxes = data["scene", "goal"].numpy(), data["scene", "boxes"].numpy()
    points = np.concatenate((goal[:, None], human[:, None, :2], boxes[..., :2]), axis=1)
    x, y, yaw = mount
    cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    place = pose[:, :2] + np.stack((cos * x - sin * y, sin * x + cos * y), axis=-1)
    cos, sin = np.cos(pose[:, 2] + yaw), np.sin(pose[:, 2] + yaw)
    ahead, left = (points - place[:, None]).transpose(2, 1, 0)
    seen = np.stack((cos * ahead + sin * left, cos * left - sin * ahead))
    radius = np.hypot(boxes[..., 3], boxes[..., 4]).T
    radius = np.concatenate((np.full((1, len(pose)), HUMAN_RADIUS), radius))
    centred = dataclasses.replace(robot, lidar_offset=0.0, lidar_fov=FULL)
    lidar = Lidar(centred, num_rays=num_rays, max_range=10.0)
    return lidar.cast(seen, cos, sin, boxes, radius)


def scan(data, case: Case, robot: Robot) -> np.ndarray:
    """What the lidar of a case reports, ``[N, beams]``; ``range_max`` is no return."""
    ranges = cast(data, robot, case.per_revolution, case.mount)
    step = -1 if case.clockwise else 1
    first = round(case.start / FULL * case.per_revolution)
    if not math.isclose(first * FULL / case.per_revolution, case.start, abs_tol=1e-9):
        # Beams between those of a revolution: turn the lidar under them.
        turned = (*case.mount[:2], case.mount[2] + case.start)
        ranges, first = cast(data, robot, case.per_revolution, turned), 0
    index = (first + step * np.arange(case.beams)) % case.per_revolution
    return np.minimum(ranges[:, index], case.range_max)


def told(policy: Policy, case: Case, robot: Robot) -> tuple[float, ...] | None:
    """What a policy is told of the robot with the lidar of a case, as ``robot=``; ``None`` if it reads none."""
    if not policy.sensing.observe_robot:
        return None
    base = robot.radius, robot.max_speed, robot.max_turn_rate
    return (*base, case.view, case.range_max, case.mount[0])


class WatchedRunner(PolicyRunner):
    """Keeps what its policy read beside the scan: ``inputs``, arguments of :meth:`Policy.act`."""

    def _command(self, scan: np.ndarray, inputs: dict) -> tuple[float, float]:
        self.inputs = inputs
        return super()._command(scan, inputs)


def native_commands(
    policy: Policy, native: Case, robot: Robot, ranges: np.ndarray, runners: list[WatchedRunner]
) -> np.ndarray:
    """What the policy commands where the runners are if it sees the native scans ``[N, 720]`` instead."""
    numbers = told(policy, native, robot)
    sensing = policy.sensing if numbers is None else policy.sensing.of_robot(numbers)
    shape = sensing.num_sectors, sensing.max_range, sensing.lidar_origin
    read = [{k: v for k, v in runner.inputs.items() if v is not None} for runner in runners]
    inputs = {name: np.stack([one[name] for one in read]) for name in read[0]}
    if numbers is not None:
        inputs["robot"] = np.tile(numbers, (len(runners), 1))
    return policy.act(lidar=native.geometry.sectors(ranges, *shape), **inputs)


@torch.no_grad()
def drive(case: Case, policy: Policy, preference: np.ndarray, episodes: int, seed: int) -> dict:
    """Drive all scenes under one preference; which ended how, and the largest difference."""
    robot = trained_in(policy.card).with_one_robot.robot
    env = NavigationEnv(
        num_envs=episodes,
        scene=case.scene,
        robot=robot,
        seed=seed,
        max_episode_steps=case.max_steps,
    )
    native = dataclasses.replace(CASES[0], mount=(robot.lidar_offset, 0.0, 0.0))
    if case.mount == (0.0, 0.0, 0.0):
        case = dataclasses.replace(case, mount=native.mount)
    rng = np.random.default_rng(seed)
    freezes = rng.integers(10, 40, episodes) if case.frozen else np.full(episodes, case.max_steps)
    numbers = told(policy, case, robot)
    runners = [WatchedRunner(policy, lidar=case.geometry, robot=numbers) for _ in range(episodes)]
    sensing = policy.sensing
    moves = sensing.observe_motion or sensing.observe_human_velocity
    data, done = env.reset(), np.zeros(episodes, dtype=bool)
    ends = {name: np.zeros(episodes, dtype=bool) for name in ("success", "collision")}
    steps, difference, held = np.full(episodes, np.nan), np.zeros(2), [None] * episodes
    for step in range(case.max_steps):
        ranges = scan(data, case, robot)
        if case.spoil is not None:
            case.spoil(ranges, rng)
        goal, human = data["goal"].numpy(), data["human"].numpy()
        poses = data["pose"].numpy()
        commands = np.zeros((episodes, 2))
        driving = np.zeros(episodes, dtype=bool)
        for index in np.flatnonzero(~done):
            now = step * policy.period
            odometry = poses[index] if moves else None
            inputs = (now, ranges[index], goal[index], human[index], odometry)
            if freezes[index] < step <= freezes[index] + 20:
                inputs = held[index]
            held[index] = inputs
            command = runners[index].step(
                inputs[1],
                goal=inputs[2],
                human=None if case.nobody else inputs[3],
                odometry=inputs[4],
                preference=preference,
                stamp=inputs[0],
                time=now,
            )
            commands[index] = command.speed, command.turn_rate
            driving[index] = command.reason == "drive"
        if driving.any() and not (case.nobody or case.frozen):
            reference = native_commands(
                policy,
                native,
                robot,
                scan(data, native, robot)[driving],
                [runners[index] for index in np.flatnonzero(driving)],
            )
            difference = np.maximum(difference, abs(commands[driving] - reference).max(0))
        data["action"] = torch.from_numpy(commands).to(env.dtype)
        data = env.step(data)["next"]
        ended = data["done"].numpy()[:, 0] & ~done
        ends["success"] |= ended & data["success"].numpy()[:, 0]
        hit = data["collision_human"] | data["collision_obstacle"]
        ends["collision"] |= ended & hit.numpy()[:, 0]
        steps[ended] = step + 1
        done |= ended
        if done.all():
            break
    env.close()
    return ends | {"time": steps * policy.period, "difference": difference}


def row(case: Case, parts: list[dict], same: bool) -> str:
    """A line of the table."""
    success = np.concatenate([part["success"] for part in parts])
    collision = np.concatenate([part["collision"] for part in parts])
    time = np.concatenate([part["time"] for part in parts])[success]
    speed, turn_rate = np.max([part["difference"] for part in parts], axis=0)
    shown = f"{speed:.3f} m/s, {turn_rate:.3f} rad/s" if same else "-"
    mean = f"{time.mean():.1f} s" if success.any() else "-"
    return (
        f"| {case.name} | {100 * success.mean():.1f} % | {100 * collision.mean():.1f} % | {mean} "
        f"| {shown} |"
    )


def main() -> None:
    parser = Parser(prog="lidars", description=__doc__)
    parser.add_argument("--policy", type=policy_folder, default=POLICY, help="folder of the policy")
    parser.add_argument("--episodes", type=episodes, default=100, help="scenes for each preference")
    parser.add_argument("--seed", type=scene_seed, default=7, help="of the scenes")
    parser.add_argument("--only", nargs="+", help="rows whose name holds one of these words")
    args = parser.parse_args()
    torch.set_num_threads(1)
    cases = [case for case in CASES if not args.only or any(w in case.name for w in args.only)]
    if not cases:
        names = ", ".join(case.name for case in CASES)
        parser.error(f"--only {' '.join(args.only)}: no row is called so; there are {names}.")
    try:
        policy = load_policy(args.policy)
        if policy.sensing is None:
            raise ValueError(f"{args.policy} does not tell what it senses.")
        trained_in(policy.card)  # what it refuses is refused before anything is driven
    except (OSError, ValueError) as error:
        parser.error(str(error))
    space = policy.preference_space
    preferences = [*space.corners().numpy(), np.full(space.num_tunable, 1 / space.num_tunable)]
    lines = [
        "| lidar, or what is given | success | collisions | time | largest difference of a command |",
        "|---|---|---|---|---|",
    ]
    with tqdm.tqdm(total=len(cases) * len(preferences), unit="sweep") as progress:
        for case in cases:
            parts = []
            for preference in preferences:
                parts.append(drive(case, policy, preference, args.episodes, args.seed))
                progress.update()
            lines.append(row(case, parts, not (case.nobody or case.frozen)))
            tqdm.tqdm.write(lines[-1])
    print(f"\n{len(preferences)} preferences x {args.episodes} scenes\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
