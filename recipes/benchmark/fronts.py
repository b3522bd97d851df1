"""``front.csv``: what a policy returns under each preference of a lattice."""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recipes.training.run_folder import write_atomically
from torchrl_morl.evaluation import (
    expected_utility,
    hypervolume,
    non_dominated,
    sparsity,
    steerability,
)

FILE = "front.csv"
_PREFERENCE, _RETURN, _DISCOUNTED = "preference_", "return_", "discounted_"


@dataclasses.dataclass(frozen=True)
class Front:
    """Mean returns of one policy, a row a preference.

    Args:
        objectives: their names, in the order of the reward.
        preferences: ``[P, K]``.
        returns: sums of rewards, means over episodes, ``[P, K]``.
        discounted: the same, discounted.
    """

    objectives: tuple[str, ...]
    preferences: NDArray[np.float64]
    returns: NDArray[np.float64]
    discounted: NDArray[np.float64]

    def values(self, *, discounted: bool) -> NDArray[np.float64]:
        """The returns that indicators are of, ``[P, K]``."""
        return self.discounted if discounted else self.returns

    def indicators(
        self, reference: Sequence[float], *, discounted: bool = False
    ) -> dict[str, float]:
        """What fronts are compared by.

        Args:
            reference: of the hypervolume, ``[K]``.

        Keyword Args:
            discounted: whether of discounted returns.

        Returns:
            ``hypervolume``; ``expected_utility``, of the best point for each preference;
            ``commanded_utility``, of the point that it gave; ``non_dominated``, how many points are;
            ``sparsity``, which misleads (see :func:`torchrl_morl.evaluation.sparsity`); and
            ``steerability/<objective>``, the rank correlation of weight and return.

        Examples:
            >>> import numpy as np
            >>> front = Front(
            ...     ("a", "b"), np.eye(2), np.array([[3.0, 0.0], [0.0, 2.0]]), np.zeros((2, 2))
            ... )
            >>> found = front.indicators((-1.0, -1.0))
            >>> found["hypervolume"], found["expected_utility"], round(found["steerability/a"], 3)
            (6.0, 2.5, 1.0)
        """
        values = self.values(discounted=discounted)
        return {
            "hypervolume": hypervolume(values, np.asarray(reference)),
            "expected_utility": expected_utility(self.preferences, values),
            "commanded_utility": expected_utility(self.preferences, values, choice="commanded"),
            "non_dominated": float(non_dominated(values).sum()),
            "sparsity": sparsity(values),
            **{
                f"steerability/{name}": steerability(self.preferences[:, index], values[:, index])
                for index, name in enumerate(self.objectives)
            },
        }

    def write(self, path: Path) -> None:
        """Write it, whole or not at all; what was there is replaced."""
        groups = (_PREFERENCE, _RETURN, _DISCOUNTED)
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(
            [*(prefix + name for prefix in groups for name in self.objectives), "non_dominated"]
        )
        table = np.concatenate((self.preferences, self.returns, self.discounted), axis=1)
        for row, best in zip(table, non_dominated(self.returns), strict=True):
            writer.writerow([*(f"{value:.9g}" for value in row), int(best)])
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, text.getvalue())


def read_front(path: Path) -> Front:
    """Read what :meth:`Front.write` wrote.

    Raises:
        ValueError: in one line, if it is no such file.
    """
    try:
        with path.open(newline="") as file:
            header, *rows = csv.reader(file)
        table = np.array(rows, dtype=float)
    except (ValueError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} is no front: {error}") from error
    names = tuple(name.removeprefix(_PREFERENCE) for name in header if name.startswith(_PREFERENCE))
    size = len(names)
    groups = (_PREFERENCE, _RETURN, _DISCOUNTED)
    expected = [*(prefix + name for prefix in groups for name in names), "non_dominated"]
    if not names or header != expected or table.shape != (len(rows), 3 * size + 1):
        raise ValueError(f"{path} is no front: its columns are {header}.")
    if not np.isfinite(table).all() or not len(table):
        raise ValueError(f"{path} is no front: it must have rows of finite numbers.")
    return Front(names, table[:, :size], table[:, size : 2 * size], table[:, 2 * size : 3 * size])
