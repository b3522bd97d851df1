"""Bodies of a scene in the simulator: people, goal and boxes, where the task says."""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np
from mujoco.batch import Batch
from torch import Tensor

from .drive import yaw_quaternion
from .navigation_task import NavigationTask


class SceneBodies:
    """The bodies of a model of :func:`envs.mjcf.navigation_mjcf` that stand where they are put.

    Args:
        model: it.
        num_people: in it.
        num_boxes: in it.
    """

    def __init__(self, model: mujoco.MjModel, *, num_people: int, num_boxes: int) -> None:
        people = ["human", *(f"person{index}" for index in range(1, num_people))]
        boxes = [f"box{index}" for index in range(num_boxes)]
        self.people, (self._goal,), self._boxes = (
            [int(model.body(name).mocapid[0]) for name in names]
            for names in (people, ["goal"], boxes)
        )
        self._geoms = [model.geom(name).id for name in boxes]

    def open(self, batch: Batch) -> np.ndarray | None:
        """Sizes of the geoms of each environment, which :meth:`place` writes; ``None`` without boxes."""
        return batch.expand("geom_size") if self._geoms else None

    def place(
        self,
        view: Mapping[str, Tensor],
        task: NavigationTask,
        rows: np.ndarray,
        sizes: np.ndarray | None,
    ) -> None:
        """Put everything of the environments ``rows`` in its place; ``set_const`` of the batch follows.

        Args:
            view: of the simulations' state.
            task: what is where.
            rows: which environments.
            sizes: see :meth:`open`.
        """
        position, rotation = view["mocap_pos"].numpy(), view["mocap_quat"].numpy()
        each, people, boxes = rows[:, None], task.people[rows], task.boxes[rows]
        position[rows, self._goal, :2] = task.goal[rows]
        position[each, self.people, :2] = people[..., :2]
        rotation[each, self.people] = yaw_quaternion(people[..., 2])
        if sizes is not None:
            position[each, self._boxes, :2] = boxes[..., :2]
            rotation[each, self._boxes] = yaw_quaternion(boxes[..., 2])
            sizes[each, self._geoms, :2] = boxes[..., 3:]
