"""Evaluations made by hand: their numbers are known, and no simulator runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from recipes.results.files import write_evaluation
from recipes.results.systems import SPACE

STEPS, SCENES = 3, 4
CONTACT = 0.5
"""Of robot and human, metres between their centres."""


def preferences(ignored: bool) -> np.ndarray:
    grid = SPACE.pairwise_grid(STEPS).double().numpy()
    return np.full((1, 3), np.nan) if ignored else grid


def fabricate(
    output: Path,
    system: str = "OUR",
    condition: str = "static",
    *,
    seeds: tuple[int, ...] = (0, 1),
    ignored: bool = False,
    shift: float = 0.0,
    failures: int = 0,
    scene_seed: int = 7,
) -> Path:
    """Write an evaluation: time 20 + scene + shift - 2 efficiency, and so on for other metrics.

    The first ``failures`` episodes of all end in a timeout. Demonstrations of odd scenes are free.
    """
    grid = preferences(ignored)
    weights = np.nan_to_num(grid)
    shape = (len(seeds), len(grid), SCENES)
    scene = np.broadcast_to(np.arange(SCENES, dtype=float), shape)
    spread = np.array(seeds)[:, None, None] * 0.01  # between training seeds
    demo, distance, efficiency = (weights[None, :, entry, None] for entry in range(3))
    success = np.ones(shape)
    success.reshape(-1)[:failures] = 0
    human = 0.8 + 0.1 * scene + shift + spread + 0.5 * distance
    values = {
        "success": success,
        "collision_human": np.zeros(shape),
        "collision_obstacle": np.zeros(shape),
        "timeout": 1 - success,
        "time": np.where(success == 1, 20 + scene + shift + spread - 2 * efficiency, np.nan),
        "frechet": 1.5 + 0.1 * scene + shift + spread - demo,
        "demonstration_free": scene % 2,
        "min_human_distance": human,
        "min_surface_distance": human - CONTACT,
        "human_exposure": 60 + scene + spread - 40 * distance,
        "min_clearance": 0.3 + 0.1 * scene + spread,
        "direct_distance": 8.3 + scene,
        "straight_time": 16 + 2 * scene,
        "shortest_time": 17 + 2 * scene,
    }
    index = np.indices(shape)
    columns = {
        "system": np.full(shape, system).ravel().tolist(),
        "condition": np.full(shape, condition).ravel().tolist(),
        "seed": np.array(seeds)[index[0]].ravel().tolist(),
        "scene": np.full(shape, condition).ravel().tolist(),
        "scene_index": index[2].ravel().tolist(),
        "preference_index": index[1].ravel().tolist(),
    }
    for entry, name in enumerate(SPACE.tunable):
        columns[f"preference_{name}"] = grid[index[1], entry].ravel().tolist()
    values = {name: np.broadcast_to(value, shape) for name, value in values.items()}
    columns |= {name: value.ravel().tolist() for name, value in values.items()}
    summary = {
        "system": system,
        "condition": condition,
        "members": [{"seed": seed, "source": "made by hand"} for seed in seeds],
        "episodes": SCENES,
        "scene_seed": scene_seed,
        "edge_steps": STEPS,
        "ignores_preference": ignored,
        "objectives": list(SPACE.tunable),
        "num_preferences": len(grid),
    }
    folder = output / system / condition
    write_evaluation(folder, columns, summary, trajectories(shape))
    return folder


def trajectories(shape: tuple[int, int, int]) -> dict[str, np.ndarray]:
    """Straight lines along x, further to the left for each preference; the human walks at them."""
    time = torch.linspace(0, 8, 20)
    position = torch.zeros(*shape, 20, 2)
    position[..., 0] = time
    position[..., 1] = 0.1 * torch.arange(shape[1])[None, :, None, None]
    human = torch.zeros(*shape, 20, 2)
    human[..., 0] = 8 - time
    rows = shape[2]
    return {
        "position": position.numpy(),
        "human": human.numpy(),
        "mask": np.ones((*shape, 20), dtype=bool),
        "start": np.zeros((rows, 3)),
        "goal": np.tile([8.0, 0.0], (rows, 1)),
        "human_start": np.tile([8.0, 0.0, np.pi], (rows, 1)),
        "boxes": np.tile([4.0, 2.0, 0.3, 0.5, 0.3], (rows, 2, 1)),
        "demonstration": position[0, 0].numpy(),
        "demonstration_mask": np.ones((rows, 20), dtype=bool),
    }
