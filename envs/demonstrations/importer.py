"""Make a dataset of demonstrations from recorded trajectories: replay every pose in simulation."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ..policy_env import make_policy_env
from ..robots import TURTLEBOT2, Robot, get_robot
from ..scenes import Scene
from .bag_topics import BagTopics
from .feasibility import Tolerances, check, check_limits
from .reading import open_recordings, silent
from .report import ImportReport, NoDriveAcceptedError, Reason
from .timed_path import TimedPath, velocities

# Out of sight of any lidar: where the boxes stand that a scene has less than others, metres.
_FAR = 1000.0
_OBSERVED = ("observation", "goal", "human", "pose", "human_pose")
_OBSERVED_NEXT = ("observation", "pose", "human_pose", "reward")


def import_demonstrations(
    path: str | Path,
    boxes: str | Path | None = None,
    *,
    robot: str | Robot = TURTLEBOT2,
    goal_radius: float = 0.3,
    max_steps: int = 300,
    tolerances: Tolerances | None = None,
    topics: BagTopics | None = None,
    num_threads: int = 0,
    progress: Callable[..., Iterable[Any]] = silent,
) -> tuple[TensorDictBase, ImportReport]:
    r"""Read recorded trajectories and make the dataset that rollouts of a demonstrator give.

    Args:
        path: a ``.csv`` or ``.npz`` file, a ROS bag or a folder of bags, see
            ``docs/demonstrations.md``.
        boxes: a ``.csv`` file with the boxes around the trajectories of a ``.csv`` file or a bag.

    Keyword Args:
        robot: whose limits and lidar count: what :func:`envs.get_robot` takes.
        goal_radius: distance from the goal at which it is reached, metres.
        max_steps: longest episode, control steps.
        tolerances: how far recordings may exceed the robot's limits.
        topics: of a bag; default :class:`BagTopics`.
        num_threads: native threads of the simulation; 0 uses every CPU.
        progress: shows how far it is: ``tqdm.tqdm``, or anything that takes an iterable with a
            length and ``desc``.

    Returns:
        The dataset of :func:`replay` with a row for each accepted trajectory, and the report.

    Raises:
        FileNotFoundError: if a file does not exist.
        ImportError: for a bag, without ``rosbags``.
        NoDriveAcceptedError: a :class:`ValueError`, if all trajectories are rejected.
        ValueError: if a file is not of the format, or an argument makes no sense.

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
        1 of 2 drives accepted
          1 of 2 drives of fewer than 2 points (short: has 1 point(s), fewer than 2)
        >>> data.shape, data["observation"].shape
        (torch.Size([1, 47]), torch.Size([1, 47, 36]))
    """
    robot = get_robot(robot)
    check_limits(goal_radius, max_steps)
    gap = (tolerances or Tolerances()).gap
    file = open_recordings(
        path, boxes, topics=topics, gap=gap, goal_radius=goal_radius, progress=progress
    )
    paths: list[TimedPath] = []
    rejected: dict[str, list[Reason]] = {}
    repeated: list[int] = []
    for recording in progress(file, desc="reading"):
        if recording.repeated:
            repeated.append(recording.repeated)
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
    notes = list(file.notes)
    if repeated:
        notes.append(f"left out {sum(repeated)} repeated point(s) of {len(repeated)} drive(s)")
    report = ImportReport([driven.name for driven in paths], rejected, notes)
    if not paths:
        raise NoDriveAcceptedError(path, report)
    del file
    data = replay(paths, robot, goal_radius=goal_radius, num_threads=num_threads, progress=progress)
    return data, report


@torch.no_grad()
def replay(
    paths: Sequence[TimedPath],
    robot: str | Robot = TURTLEBOT2,
    *,
    goal_radius: float = 0.3,
    chunk: int = 256,
    num_threads: int = 0,
    progress: Callable[..., Iterable[Any]] = silent,
) -> TensorDictBase:
    """Put the robot on every point of the paths and record what it sees, and how it got on.

    Nothing is driven: each point is restored as a snapshot, so observations are those of the
    recorded poses exactly. Actions are the constant velocities between points, which is what the
    base executed; where a command changes, a base that lags was told more than that.

    Args:
        paths: of :func:`envs.demonstrations.feasibility.check`: free of contacts, the last point
            at the goal.
        robot: what :func:`envs.get_robot` takes.

    Keyword Args:
        goal_radius: distance from the goal at which it is reached, metres.
        chunk: how many points are simulated at once.
        num_threads: native threads; 0 uses every CPU.
        progress: see :func:`import_demonstrations`.

    Returns:
        ``[N, T]``, ``T`` the most steps of a path, zeros behind the end of each: ``observation``
        [N, T, 36], ``action`` [N, T, 2] in [-1, 1], ``goal`` and ``human`` [N, T, 2] (m, rad),
        ``pose`` and ``human_pose`` [N, T, 3], ``mask`` [N, T], and in ``next`` ``observation``,
        ``pose``, ``human_pose``, ``reward`` [N, T, 3], ``done``, ``terminated``, ``truncated`` and
        ``success`` [N, T, 1].
    """
    robot = get_robot(robot)
    length = torch.tensor([len(path.pose) for path in paths])
    owner = torch.arange(len(paths)).repeat_interleave(length)
    step = torch.arange(len(owner)) - (length.cumsum(0) - length)[owner]
    last = step == length[owner] - 1
    chunk = min(chunk, len(owner))
    mask = torch.arange(int(length.max()) - 1) < length[:, None] - 1
    data = None
    chunks = torch.arange(len(owner)).split(chunk)
    points = _observe(paths, owner, chunks, robot, goal_radius, num_threads)
    for rows, seen in zip(progress(chunks, desc="replay"), points):
        if data is None:
            data = _empty(seen, mask)
        # A point is where one step begins, and where the one before has led.
        drive, index, now, after = owner[rows], step[rows], ~last[rows], step[rows] > 0
        root, led_to = data.select(*_OBSERVED), data["next"].select(*_OBSERVED_NEXT)
        root[drive[now], index[now]] = seen.select(*_OBSERVED)[now]
        led_to[drive[after], index[after] - 1] = seen.select(*_OBSERVED_NEXT)[after]
    pose = torch.cat([path.pose for path in paths])
    begins = (~last).nonzero()[:, 0]
    speed, turn, _ = velocities(pose[begins], pose[begins + 1])
    action = torch.stack((2 * speed / robot.max_speed - 1, turn / robot.max_turn_rate), dim=-1)
    data["action"][mask] = action.clamp(-1.0, 1.0).to(data["action"])
    ends = torch.arange(len(paths)), length - 2
    for key in ("done", "terminated", "success"):
        data["next", key][ends] = True
    return data


def _empty(seen: TensorDictBase, mask: Tensor) -> TensorDictBase:
    """A dataset of zeros ``[N, T]`` with the keys of what is seen and done."""

    def zeros(*shape: int, like: Tensor | None = None) -> Tensor:
        dtype = torch.bool if like is None else like.dtype
        return torch.zeros(*mask.shape, *shape, dtype=dtype)

    size = mask.shape
    root = {key: zeros(*seen[key].shape[1:], like=seen[key]) for key in _OBSERVED}
    after = {key: zeros(*seen[key].shape[1:], like=seen[key]) for key in _OBSERVED_NEXT}
    after |= {key: zeros(1) for key in ("done", "terminated", "success", "truncated")}
    root["action"] = zeros(2, like=seen["observation"])
    return TensorDict({**root, "next": TensorDict(after, size), "mask": mask}, size)


def _observe(
    paths: Sequence[TimedPath],
    owner: Tensor,
    chunks: Sequence[Tensor],
    robot: Robot,
    goal_radius: float,
    num_threads: int,
) -> Iterator[TensorDictBase]:
    """Observations at the points of each chunk, and the reward of the step that leads to each."""
    pose = torch.cat([path.pose for path in paths])
    human = torch.cat([path.human for path in paths])
    human_pose = torch.cat((human, torch.zeros_like(human[:, :1])), dim=-1)
    goal = torch.stack([path.goal for path in paths])
    num_boxes = max(len(path.boxes) for path in paths)
    boxes = torch.tensor([_FAR, _FAR, 0.0, 0.1, 0.1], dtype=torch.float64)
    boxes = boxes.repeat(len(paths), num_boxes, 1)
    for row, path in zip(boxes, paths):
        row[: len(path.boxes)] = path.boxes
    env = make_policy_env(
        keep_simulation=True,
        num_envs=len(chunks[0]),
        scene=Scene("imported", num_boxes, _sample_nothing),
        robot=robot,
        goal_radius=goal_radius,
        num_threads=num_threads,
        seed=0,
    )
    try:
        state = env.base_env.state_spec.zero()
        for rows in chunks:
            # The last chunk is filled up with its last point.
            filled = torch.cat((rows, rows[-1:].expand(len(chunks[0]) - len(rows))))
            state["qpos"] = pose[filled]
            state["human_pose"] = human_pose[filled]
            state["scene", "goal"] = state["scene", "human_goal"] = goal[owner[filled]]
            state["scene", "boxes"] = boxes[owner[filled]]
            seen = env.reset(state.clone(), set_state=True).select(*_OBSERVED)
            came_from = pose[(filled - 1).clamp_min(0), :2]
            seen["reward"] = env.base_env.reward_from(came_from).to(seen["observation"])
            yield seen[: len(rows)]
    finally:
        env.close()


def _sample_nothing(n: int, robot_radius: float, generator: torch.Generator) -> TensorDict:
    raise RuntimeError("Imported scenes come from a file: there is nothing to sample.")
