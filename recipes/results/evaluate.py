"""Evaluate systems over the paper's 33 preferences, all in the same scenes.

Examples::

    python -m recipes.results.evaluate OUR=recipes/policies/navigation --output runs/results
    python -m recipes.results.evaluate OUR=runs/a,runs/b,runs/c NH=runs/nh straight=reference:straight \\
        --output runs/results --condition static moving_human corridor hsr wheels faults
    python -m recipes.results.evaluate OUR=recipes/policies/navigation orca=reference:orca \\
        --output runs/all --condition all --steps 3 --episodes 50

``all`` is every scene and every change of the static one; ``recipes.results.conditions_table`` makes the
table and the page of pictures of it. Every system and condition becomes a folder with ``episodes.csv`` (a row an episode), ``summary.json``
and ``trajectories.npz``. What is there already is skipped, so the command can be repeated after an
interruption; nothing is overwritten.
"""

from __future__ import annotations

import importlib.metadata
import itertools
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tqdm
from tensordict import TensorDict

from torchrl_morl.evaluation import bootstrap_interval, cluster_rate_interval

from ..arguments import Parser, count, episodes
from ..evaluation.setting import GOAL_RADIUS, scene_seed
from ..evaluation.sweep import sweep
from ..outputs import check_writable
from .conditions import ALL, CHANGES, SCENE_KINDS, condition, conditions
from .episodes import OUTCOMES, episode_values, trajectory_arrays
from .files import SUMMARY, write_evaluation
from .systems import System, load_system


def evaluate(
    system: System,
    name: str,
    output: Path,
    *,
    episodes: int,
    seed: int,
    steps: int = 11,
    progress: bool = True,
) -> Path | None:
    """Evaluate a system under a condition, unless that was done before.

    Args:
        system: what drives.
        name: of the condition.
        output: folder of all evaluations.

    Keyword Args:
        episodes: scenes, the same for every system, preference and training seed.
        seed: of the scenes.
        steps: preferences along an edge of the simplex: with 11 the 33 of the paper.
        progress: show a bar.

    Returns:
        The folder, or ``None`` if it was there.

    Raises:
        ValueError: for an unknown condition.
        FileExistsError: if the folder holds another evaluation.
    """
    arguments = condition(name)
    folder = output / system.name / name
    request = {
        "system": system.name,
        "condition": name,
        "members": [{"seed": m.seed, "source": m.source} for m in system.members],
        "episodes": episodes,
        "scene_seed": seed,
        "edge_steps": steps,
    }
    if folder.exists():
        _check_same(folder, request)
        return None
    started = time.perf_counter()
    preferences = system.preference_space.pairwise_grid(steps)
    if system.ignores_preference:
        preferences = preferences[:1]
    results = []
    total = len(preferences) * len(system.members)
    with tqdm.tqdm(total=total, desc=f"{system.name} {name}", disable=not progress) as bar:
        for member in system.members:
            result = sweep(
                member.actor(arguments["robot"]),
                system.preference_space,
                preferences,
                episodes=episodes,
                seed=seed,
                goal_radius=GOAL_RADIUS,
                demonstrator=system.demonstrator(arguments["robot"]),
                on_preference=lambda _: bar.update(),
                **arguments,
                **member.observed,
            )
            results.append(result)
    scene, robot = arguments["scene"], arguments["robot"]
    values = torch.stack([episode_values(one, scene=scene, robot=robot) for one in results])
    columns = _columns(system, request, scene, preferences, values)
    summary = request | {
        "scene": scene,
        "ignores_preference": system.ignores_preference,
        "objectives": list(system.preference_space.tunable),
        "num_preferences": len(preferences),
        "demonstration": system.demonstration,
        **summarize(values),
        "seconds": round(time.perf_counter() - started, 1),
        "versions": {
            package: importlib.metadata.version(package)
            for package in ("torch", "torchrl", "tensordict", "mujoco", "numpy", "scipy")
        },
    }
    trajectories = {name: value.numpy() for name, value in trajectory_arrays(results).items()}
    write_evaluation(folder, columns, summary, trajectories)
    return folder


def summarize(values: TensorDict) -> dict[str, Any]:
    """Rates over all episodes, and every metric for every preference.

    Args:
        values: ``[S, P, N]``: training seeds, preferences, scenes.

    Returns:
        ``rates`` with their intervals over scenes (:func:`cluster_rate_interval`), the one of each
        training seed, and ``metrics``: for each a list with mean, 95 % bootstrap interval over scenes
        and, of several, training seeds, and n for every preference; of times to collision, which may be
        infinite, the median.
    """
    rates = {}
    for name in OUTCOMES:
        outcomes = values[name].double().numpy()
        interval = cluster_rate_interval(np.moveaxis(outcomes, 2, 0).reshape(values.shape[2], -1))
        rates[name] = vars(interval) | {"per_seed": outcomes.mean((1, 2)).tolist()}
    metrics: dict[str, list[dict[str, Any]]] = {}
    for name in values.keys():
        if name in OUTCOMES or name == "demonstration_free":
            continue
        table = values[name].double().numpy()
        if name == "min_time_to_collision":  # infinite for a robot that is never on course for one
            metrics[name] = [{"median": float(np.median(one))} for one in np.moveaxis(table, 1, 0)]
            continue
        metrics[name] = [
            vars(bootstrap_interval(table[:, row], shared_episodes=True, resamples=500))
            for row in range(table.shape[1])
        ]
    return {"rates": rates, "metrics": metrics}


def _columns(
    system: System,
    request: dict[str, Any],
    scene: str,
    preferences: torch.Tensor,
    values: TensorDict,
) -> dict[str, list[Any]]:
    seeds = [member["seed"] for member in request["members"]]
    _, num_preferences, num_scenes = values.shape
    shown = preferences.double()
    if system.ignores_preference:
        shown = torch.full_like(shown, torch.nan)
    # A tenth is 0.1, without the rounding of single precision.
    shown = shown.mul(1e6).round().div(1e6).tolist()
    places = list(itertools.product(seeds, range(num_preferences), range(num_scenes)))
    columns: dict[str, list[Any]] = {
        "system": [system.name] * len(places),
        "condition": [request["condition"]] * len(places),
        "seed": [seed for seed, _, _ in places],
        "scene": [scene] * len(places),
        "scene_index": [index for _, _, index in places],
        "preference_index": [row for _, row, _ in places],
    }
    for entry, name in enumerate(system.preference_space.tunable):
        columns[f"preference_{name}"] = [shown[row][entry] for _, row, _ in places]
    return columns | {name: value.flatten().tolist() for name, value in values.items()}


def _check_same(folder: Path, request: dict[str, Any]) -> None:
    try:
        found = json.loads((folder / SUMMARY).read_text())
    except (OSError, ValueError, RecursionError):  # none, or what nobody here has written
        found = {}
    found = found if isinstance(found, dict) else {}
    different = [key for key, value in request.items() if found.get(key) != value]
    if different:
        raise FileExistsError(
            f"{folder} holds another evaluation (different {', '.join(different)}) and is not "
            "overwritten: remove it or choose another --output."
        )


def main() -> None:
    """Evaluate; ``--help`` lists the options."""
    parser = Parser(description=__doc__)
    parser.add_argument(
        "systems",
        nargs="+",
        metavar="NAME=FOLDER[,FOLDER...]",
        help="policies of one system, one folder per training seed; or NAME=reference:REFERENCE",
    )
    parser.add_argument("--output", type=Path, required=True, help="folder of all evaluations")
    parser.add_argument(
        "--condition",
        nargs="+",
        default=["static"],
        help=f"{ALL}, a scene ({', '.join(SCENE_KINDS)}), a change of the static one "
        f"({', '.join(CHANGES)}), or both: moving_human+faults (default: static)",
    )
    parser.add_argument("--episodes", type=episodes, default=100, help="scenes per preference")
    parser.add_argument("--seed", type=scene_seed, default=7, help="of the scenes")
    parser.add_argument(
        "--steps",
        type=count(2, 1000),
        default=11,
        help="preferences along each edge: 33 in all with 11",
    )
    args = parser.parse_args()
    torch.set_num_threads(1)
    try:
        systems = [load_system(text) for text in args.systems]
        names = [system.name for system in systems]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"{name} names two systems: each needs a folder of its own.")
        for name in args.condition:
            if args.condition.count(name) > 1:
                raise ValueError(f"--condition names {name} twice: once is enough.")
        chosen = conditions(args.condition)
        for system, name in itertools.product(systems, chosen):
            system.demonstrator(condition(name)["robot"])
        check_writable(args.output, args.output)
    except (ImportError, OSError, ValueError) as error:
        parser.error(str(error))
    options = {"episodes": args.episodes, "seed": args.seed, "steps": args.steps}
    for name, system in itertools.product(chosen, systems):
        try:
            folder = evaluate(system, name, args.output, **options)
        except OSError as error:
            parser.error(str(error))
        print(f"{system.name} {name}: {folder or 'there already'}", flush=True)


if __name__ == "__main__":
    main()
