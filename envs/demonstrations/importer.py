"""Make a dataset of demonstrations from recorded trajectories: replay every pose in simulation."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ..policy_env import make_policy_env
from ..robots import TURTLEBOT2, Robot, get_robot
from ..scenes import Scene
from .feasibility import TimedPath, Tolerances, check, velocities
from .recordings import read_recordings

# Out of sight of any lidar: where the boxes stand that a scene has less than others, metres.
_FAR = 1000.0
_OBSERVED = ("observation", "goal", "human", "pose", "human_pose")
_OBSERVED_NEXT = ("observation", "pose", "human_pose", "reward")


@dataclasses.dataclass(frozen=True)
class ImportReport:
    """What became of the trajectories of a file.

    Args:
        accepted: names, in the order of the dataset's rows.
        rejected: names and all reasons of each.
    """

    accepted: list[str]
    rejected: dict[str, list[str]]

    def __str__(self) -> str:
        """A line on all of them and one on each rejected trajectory."""
        total = len(self.accepted) + len(self.rejected)
        lines = [f"{len(self.accepted)} of {total} trajectories accepted"]
        lines += [f"  {name}: {'; '.join(reasons)}" for name, reasons in self.rejected.items()]
        return "\n".join(lines)


def import_demonstrations(
    path: str | Path,
    boxes: str | Path | None = None,
    *,
    robot: str | Robot = TURTLEBOT2,
    goal_radius: float = 0.3,
    max_steps: int = 300,
    tolerances: Tolerances | None = None,
    num_threads: int = 0,
) -> tuple[TensorDictBase, ImportReport]:
    r"""Read recorded trajectories and make the dataset that rollouts of a demonstrator give.

    Args:
        path: a ``.csv`` or ``.npz`` file, see ``docs/demonstrations.md``.
        boxes: a ``.csv`` file with the boxes around a ``.csv`` file's trajectories.

    Keyword Args:
        robot: whose limits and lidar count: a name from :data:`envs.ROBOTS` or a
            :class:`envs.Robot`.
        goal_radius: distance from the goal at which it is reached, metres.
        max_steps: longest episode, control steps.
        tolerances: how far recordings may exceed the robot's limits.
        num_threads: native threads of the simulation; 0 uses every CPU.

    Returns:
        The dataset of :func:`replay` with a row for each accepted trajectory, and the report.

    Raises:
        FileNotFoundError: if a file does not exist.
        ValueError: if a file is not of the format, or no trajectory is accepted.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> rows = ["trajectory,time,x,y,human_x,human_y,goal_x,goal_y"]
        >>> rows += [f"good,{i / 5},{i * 0.08},0,2,1.5,4,0" for i in range(50)]
        >>> rows += ["short,0,0,0,2,1.5,4,0"]
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "drives.csv"
        ...     _ = file.write_text("\n".join(rows))
        ...     data, report = import_demonstrations(file)
        >>> print(report)
        1 of 2 trajectories accepted
          short: has 1 point(s), fewer than 2
        >>> data.shape, data["observation"].shape
        (torch.Size([1, 47]), torch.Size([1, 47, 36]))
    """
    paths: list[TimedPath] = []
    rejected: dict[str, list[str]] = {}
    for recording in read_recordings(path, boxes):
        driven, reasons = check(
            recording,
            robot,
            goal_radius=goal_radius,
            max_steps=max_steps,
            tolerances=tolerances,
        )
        if driven is None:
            rejected[recording.name] = reasons
        else:
            paths.append(driven)
    report = ImportReport([driven.name for driven in paths], rejected)
    if not paths:
        raise ValueError(f"{path}: {report}")
    return replay(paths, robot, goal_radius=goal_radius, num_threads=num_threads), report


@torch.no_grad()
def replay(
    paths: Sequence[TimedPath],
    robot: str | Robot = TURTLEBOT2,
    *,
    goal_radius: float = 0.3,
    chunk: int = 256,
    num_threads: int = 0,
) -> TensorDictBase:
    """Put the robot on every point of the paths and record what it sees, and how it got on.

    Nothing is driven: each point is restored as a snapshot, so observations are those of the
    recorded poses exactly. Actions are the constant velocities between points, which is what the
    base executed; where a command changes, a base that lags was told more than that.

    Args:
        paths: of :func:`envs.demonstrations.feasibility.check`: free of contacts, the last point at the goal.
        robot: a name from :data:`envs.ROBOTS` or a :class:`envs.Robot`.

    Keyword Args:
        goal_radius: distance from the goal at which it is reached, metres.
        chunk: how many points are simulated at once.
        num_threads: native threads; 0 uses every CPU.

    Returns:
        ``[N, T]``, ``T`` the most steps of a path, zeros behind the end of each: ``observation``
        [N, T, 36], ``action`` [N, T, 2] in [-1, 1], ``goal`` and ``human`` [N, T, 2] (m, rad),
        ``pose`` and ``human_pose`` [N, T, 3], ``mask`` [N, T], and in ``next`` ``observation``,
        ``pose``, ``human_pose``, ``reward`` [N, T, 3], ``done``, ``terminated``, ``truncated`` and
        ``success`` [N, T, 1].
    """
    robot = get_robot(robot)
    length = torch.tensor([len(path.pose) for path in paths])
    last = torch.zeros(int(length.sum()), dtype=torch.bool)
    last[length.cumsum(0) - 1] = True
    first = last.roll(1)
    pose = torch.cat([path.pose for path in paths])
    points = _observe(paths, pose, robot, goal_radius, chunk, num_threads)

    steps = points[~last].select(*_OBSERVED)
    speed, turn, _ = velocities(pose[~last], pose[~first])
    action = torch.stack((2 * speed / robot.max_speed - 1, turn / robot.max_turn_rate), dim=-1)
    steps["action"] = action.clamp(-1.0, 1.0).to(steps["observation"])
    steps["next"] = points[~first].select(*_OBSERVED_NEXT)
    reached = last[~first][:, None]
    for key in ("done", "terminated", "success"):
        steps["next", key] = reached.clone()
    steps["next", "truncated"] = torch.zeros_like(reached)

    mask = torch.arange(int(length.max()) - 1) < length[:, None] - 1
    data = torch.zeros_like(steps[:1]).expand(*mask.shape).clone()
    data[mask] = steps
    return data.set("mask", mask)


def _observe(
    paths: Sequence[TimedPath],
    pose: Tensor,
    robot: Robot,
    goal_radius: float,
    chunk: int,
    num_threads: int,
) -> TensorDictBase:
    """Observations at all points ``[P]``, and the reward of the step that leads to each."""
    num_boxes = max(len(path.boxes) for path in paths)
    boxes = torch.tensor([_FAR, _FAR, 0.0, 0.1, 0.1], dtype=torch.float64)
    boxes = boxes.repeat(len(paths), num_boxes, 1)
    for row, path in zip(boxes, paths):
        row[: len(path.boxes)] = path.boxes
    goal = torch.stack([path.goal for path in paths])
    human = torch.cat([path.human for path in paths])
    human_pose = torch.cat((human, torch.zeros_like(human[:, :1])), dim=-1)
    owner = torch.arange(len(paths)).repeat_interleave(
        torch.tensor([len(path.pose) for path in paths])
    )
    chunk = min(chunk, len(pose))
    env = make_policy_env(
        keep_simulation=True,
        num_envs=chunk,
        scene=Scene("imported", num_boxes, _sample_nothing),
        robot=robot,
        goal_radius=goal_radius,
        num_threads=num_threads,
        seed=0,
    )
    state = env.base_env.state_spec.zero()
    out = []
    for rows in torch.arange(len(pose)).split(chunk):
        # The last chunk is filled up with its last point.
        filled = torch.cat((rows, rows[-1:].expand(chunk - len(rows))))
        state["qpos"] = pose[filled]
        state["human_pose"] = human_pose[filled]
        state["scene", "goal"] = state["scene", "human_goal"] = goal[owner[filled]]
        state["scene", "boxes"] = boxes[owner[filled]]
        seen = env.reset(state.clone(), set_state=True).select(*_OBSERVED)
        came_from = pose[(filled - 1).clamp_min(0), :2]
        seen["reward"] = env.base_env.reward_from(came_from).to(seen["observation"])
        out.append(seen[: len(rows)].clone())
    env.close()
    return torch.cat(out)


def _sample_nothing(n: int, robot_radius: float, generator: torch.Generator) -> TensorDict:
    raise RuntimeError("Imported scenes come from a file: there is nothing to sample.")
