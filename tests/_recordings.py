"""Recorded drives, in memory and as files."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDictBase

from envs.demonstrations.recordings import BOX_COLUMNS, COLUMNS, Recording

HEADER = ("trajectory", "time", "x", "y", "heading", *COLUMNS[3:])


def write_csv(path: Path, header: tuple[str, ...], rows: list) -> Path:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])
    return path


def tracks(data: TensorDictBase) -> list[dict[str, np.ndarray]]:
    """What somebody would have recorded of the episodes ``[N, T]`` of a rollout."""
    out = []
    for row in data:
        steps = int(row["mask"].sum())
        pose = torch.cat((row["pose"][:1], row["next", "pose"][:steps])).numpy()
        human = torch.cat((row["human_pose"][:1], row["next", "human_pose"][:steps])).numpy()
        goal = row["scene", "goal"][0].expand(steps + 1, 2).numpy()
        out.append(
            {
                "time": 7.0 + 0.2 * np.arange(steps + 1),
                **dict(zip(("x", "y", "heading"), pose.T)),
                **dict(zip(("human_x", "human_y"), human.T[:2])),
                **dict(zip(("goal_x", "goal_y"), goal.T)),
                "boxes": row["scene", "boxes"][0].numpy(),
            }
        )
    return out


def save_csv(folder: Path, recorded: list[dict[str, np.ndarray]], columns=HEADER[1:]):
    rows, boxes = [], []
    for index, track in enumerate(recorded):
        name = f"drive {index}"
        rows += [[name, *point] for point in zip(*(track[column].tolist() for column in columns))]
        boxes += [[name, *box] for box in track["boxes"].tolist()]
    return (
        write_csv(folder / "drives.csv", ("trajectory", *columns), rows),
        write_csv(folder / "boxes.csv", ("trajectory", *BOX_COLUMNS), boxes),
    )


def save_npz(folder: Path, recorded: list[dict[str, np.ndarray]], **extra) -> Path:
    longest = max(len(track["time"]) for track in recorded)
    arrays = {
        column: np.stack(
            [
                np.pad(track[column], (0, longest - len(track["time"])), constant_values=np.nan)
                for track in recorded
            ]
        )
        for column in HEADER[1:]
    }
    boxes = np.stack([track["boxes"] for track in recorded])
    path = folder / "drives.npz"
    np.savez(path, **({**arrays, "boxes": boxes} | extra))
    return path


def line(speed: float = 0.4, time: np.ndarray | None = None, **changes) -> Recording:
    """A drive along x to a goal at (4, 0) past a human at (2, 1.5)."""
    time = np.arange(0.0, 12.0, 0.2) if time is None else time
    ones = np.ones_like(time)
    values = {
        "name": "line",
        "time": time,
        "position": np.stack((speed * time, 0 * time), axis=-1),
        "heading": 0 * time,
        "human": np.stack((2 * ones, 1.5 * ones), axis=-1),
        "goal": np.stack((4 * ones, 0 * ones), axis=-1),
        "boxes": np.zeros((0, 5)),
        "rows": np.arange(len(time)),
    }
    return Recording(**(values | changes))
