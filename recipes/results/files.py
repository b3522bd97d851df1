"""Files of an evaluation: ``OUTPUT/<system>/<condition>/`` with episodes, summary and trajectories.

A folder appears whole or not at all, and is never changed afterwards.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import os
import reprlib
import shutil
import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_morl.deploy.entries import Entries, null_for_nan, one_line, parse_json

EPISODES, SUMMARY, TRAJECTORIES = "episodes.csv", "summary.json", "trajectories.npz"
TEXT_COLUMNS = ("system", "condition", "scene")
MAY_BE_INFINITE = ("min_time_to_collision",)
"""Of a robot that is never on course for a collision."""


def write_evaluation(
    folder: Path,
    columns: Mapping[str, Sequence[Any]],
    summary: Mapping[str, Any],
    trajectories: Mapping[str, NDArray],
) -> None:
    """Write a folder: first beside its place, then moved there in one step.

    Args:
        folder: must not exist.
        columns: of equal length, one entry an episode; NaN becomes an empty field.
        summary: JSON values; NaN becomes null.
        trajectories: plain arrays.

    Raises:
        FileExistsError: if the folder exists.
        ValueError: for columns of different lengths.
    """
    if folder.exists():
        raise FileExistsError(f"{folder} exists and is not overwritten.")
    partial = folder.with_name(f".{folder.name}.{os.getpid()}")
    partial.mkdir(parents=True)
    try:
        with (partial / EPISODES).open("w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(columns)
            for row in zip(*columns.values(), strict=True):
                writer.writerow(map(_field, row))
        text = json.dumps(null_for_nan(dict(summary)), indent=2, allow_nan=False)
        (partial / SUMMARY).write_text(text + "\n")
        np.savez_compressed(partial / TRAJECTORIES, **trajectories)
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """One system under one condition, read from its folder.

    Args:
        folder: where it lies.
        summary: of the evaluation, see :func:`recipes.results.evaluate.summarize`.
        columns: of ``episodes.csv``: float arrays of one value an episode.
    """

    folder: Path
    summary: dict[str, Any]
    columns: dict[str, NDArray[np.float64]]

    @property
    def system(self) -> str:
        return self.summary["system"]

    @property
    def condition(self) -> str:
        return self.summary["condition"]

    @property
    def objectives(self) -> list[str]:
        """The tunable ones, in the order of :attr:`preferences`."""
        return self.summary["objectives"]

    @property
    def seeds(self) -> list[int]:
        """Of the trainings."""
        return [member["seed"] for member in self.summary["members"]]

    @property
    def edge_steps(self) -> int:
        """Preferences along an edge; the edges follow each other in :attr:`preferences`."""
        return self.summary["edge_steps"]

    @property
    def preferences(self) -> NDArray[np.float64]:
        """``[P, K]``; a single row of NaN if the system ignores them."""
        names = [f"preference_{name}" for name in self.objectives]
        return np.stack([self.values(name)[0, :, 0] for name in names], axis=-1)

    def values(self, name: str) -> NDArray[np.float64]:
        """A column as ``[S, P, N]``: training seeds, preferences, scenes.

        Raises:
            ValueError: if there is no such column.
        """
        if name not in self.columns:
            raise ValueError(f"{self.folder / EPISODES} has no column {name!r}.")
        return self.columns[name].reshape(len(self.seeds), -1, self.summary["episodes"])

    def corner(self, objective: str) -> int | None:
        """Where this objective has all the weight, first; ``None`` if it has none anywhere."""
        if self.summary["ignores_preference"]:
            return 0
        if objective not in self.objectives:
            return None
        hits = np.flatnonzero(self.preferences[:, self.objectives.index(objective)] == 1)
        return int(hits[0]) if hits.size else None

    @cached_property
    def trajectories(self) -> dict[str, NDArray]:
        """See :func:`recipes.results.episodes.trajectory_arrays`."""
        path = self.folder / TRAJECTORIES
        try:
            with np.load(path, allow_pickle=False) as arrays:
                return dict(arrays)
        except (OSError, EOFError, ValueError, TypeError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path} cannot be read: {one_line(error)}.") from error


def read_evaluation(folder: Path) -> Evaluation:
    """Read what :func:`write_evaluation` wrote.

    Raises:
        FileNotFoundError: if it is no such folder.
        ValueError: if the files do not belong together.
    """
    for name in (EPISODES, SUMMARY):
        if not (folder / name).is_file():
            raise FileNotFoundError(f"{folder / name} not found: no evaluation.")
    summary = _read_summary(folder / SUMMARY)
    header, rows = _read_table(folder / EPISODES)
    expected = len(summary["members"]) * summary["num_preferences"] * summary["episodes"]
    if len(rows) != expected:
        raise ValueError(f"{folder / EPISODES} has {len(rows)} rows, {SUMMARY} says {expected}.")
    columns = {
        name: np.array(
            [
                _number(row[index], f"{folder / EPISODES}: line {line}: {name}", name)
                for line, row in enumerate(rows, start=2)
            ]
        )
        for index, name in enumerate(header)
        if name not in TEXT_COLUMNS
    }
    _check_order(folder / EPISODES, columns, summary)
    return Evaluation(folder, summary, columns)


def read_evaluations(directory: Path, condition: str) -> dict[str, Evaluation]:
    """All systems evaluated under a condition, by name.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if they did not drive in the same scenes.
    """
    folders = sorted(path.parent for path in directory.glob(f"[!.]*/{condition}/{SUMMARY}"))
    if not folders:
        raise FileNotFoundError(
            f"No evaluation of {condition!r} in {directory}: make one with "
            f"python -m recipes.results.evaluate NAME=FOLDER --output {directory} "
            f"--condition {condition}"
        )
    found = {folder.parent.name: read_evaluation(folder) for folder in folders}
    first = next(iter(found.values()))
    for other in found.values():
        for name in ("episodes", "scene_seed", "edge_steps"):
            if other.summary[name] != first.summary[name]:
                raise ValueError(
                    f"{other.folder} and {first.folder} differ in {name} "
                    f"({other.summary[name]} and {first.summary[name]}): comparisons need the same "
                    "scenes."
                )
    return found


def _read_summary(path: Path) -> dict[str, Any]:
    """What tables and figures read of it has the type that they expect."""
    summary = parse_json(path.read_bytes(), str(path))
    if not isinstance(summary, dict):
        raise ValueError(f"{path} must be an object, got {reprlib.repr(summary)}.")
    entries = Entries(summary, str(path))
    for name in ("system", "condition"):
        entries.text(name)
    for name, least in (("episodes", 1), ("num_preferences", 1), ("edge_steps", 2)):
        entries.integer(name, least)
    entries.integer("scene_seed", 0, 2**63)
    entries.flag("ignores_preference")
    entries.texts("objectives")
    members = entries["members"]
    if not isinstance(members, list) or not members:
        raise entries.refused("members", "a list of trainings, at least one")
    for index, member in enumerate(members):
        if not isinstance(member, dict):
            raise entries.refused("members", "a list of objects")
        Entries(member, f"{path}: members[{index}]").integer("seed", 0, 2**63)
    return summary


def _read_table(path: Path) -> tuple[list[str], list[list[str]]]:
    """Names of the columns, and rows of as many cells."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            lines = list(csv.reader(file))
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} holds no text: {one_line(error)}.") from error
    if not lines:
        raise ValueError(f"{path} is empty.")
    header, *rows = lines
    (name, times), *_ = Counter(header).most_common(1) or [("", 0)]
    if times > 1:
        raise ValueError(f"{path} has the column {name!r} twice.")
    for line, row in enumerate(rows, start=2):
        if len(row) != len(header):
            raise ValueError(f"{path}: line {line} has {len(row)} cells, must have {len(header)}.")
    return header, rows


def _number(text: str, where: str, column: str) -> float:
    try:
        value = float(text or "nan")
    except ValueError:
        value = None
    if value is None or (math.isinf(value) and column not in MAY_BE_INFINITE):
        raise ValueError(f"{where} must be a finite number, or empty, got {reprlib.repr(text)}.")
    return value


def _check_order(
    path: Path, columns: Mapping[str, NDArray[np.float64]], summary: Mapping[str, Any]
) -> None:
    """Rows are told apart by their place alone: in another order they are other episodes."""
    seeds = [member["seed"] for member in summary["members"]]
    shape = (len(seeds), summary["num_preferences"], summary["episodes"])
    member, preference, scene = (index.ravel() for index in np.indices(shape))
    right = {
        "seed": np.array(seeds, dtype=float)[member],
        "preference_index": preference,
        "scene_index": scene,
    }
    for name, values in right.items():
        if name not in columns:
            raise ValueError(f"{path} has no column {name!r}.")
        wrong = np.flatnonzero(columns[name] != values)
        if wrong.size:
            row = wrong[0]
            raise ValueError(
                f"{path}: line {row + 2}: {name} must be {values[row]:g}, got "
                f"{columns[name][row]:g}: keep the order in which rows were written."
            )


def _field(value: Any) -> Any:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.9g}"
    return int(value) if isinstance(value, bool) else value
