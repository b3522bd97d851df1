"""How many answers are enough? Simulated people answer, and drive in scenes that nobody has seen.

Examples::

    python -m recipes.choices.evidence --output runs/choices/evidence
    python -m recipes.choices.evidence --contexts --output runs/choices/contexts

Writes ``evidence.json`` with all numbers and prints its tables. The drives are made once, as those of
``recipes.choices``. A minute or two on a core once they are there.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import torch
import tqdm

from torchrl_morl.deploy import load_policy
from torchrl_morl.evaluation import bootstrap_interval

from ..arguments import Parser, count, seed
from ..evaluation.setting import Setting, scene_seed
from ..evaluation.sweep import SHIPPED_POLICY, Sweep
from ..outputs import claim_folder
from ..policy_folders import policy_folder
from .people import KINDS, OBJECTIVES, Drives, people
from .rollouts import arrived, joint_outcomes, obtain
from .trials import AFTER, Mind, Place, asked, compared, in_contexts, stated

SHARING = ("one", "separate", "hierarchical")
HOW_ALIKE = 0.5
"""How much of the weights in one context come from the other in the trials of contexts."""


def places(args, scenes: tuple[str, ...]) -> dict[str, Place]:
    """Drives in known and in unseen scenes of every kind."""
    known: dict[str, Sweep] = {}
    unseen: dict[str, Sweep] = {}
    settings: dict[str, Setting] = {}
    for scene in scenes:
        for found, number, start in (
            (known, args.known, args.seed),
            (unseen, args.unseen, args.unseen_seed),
        ):
            found[scene], settings[scene] = obtain(
                args.policy, scene, scenes=number, seed=start, folder=args.drives
            )
    outcomes = joint_outcomes(known)

    def noticed(result: Sweep, scene: str) -> Drives:
        setting = settings[scene]
        return Drives.of(result, max_speed=setting.robot.max_speed, goal_radius=setting.goal_radius)

    return {
        scene: Place(
            outcomes=outcomes[scene],
            valid=arrived(known[scene]),
            preferences=known[scene].preferences,
            known=noticed(known[scene], scene),
            unseen=noticed(unseen[scene], scene),
        )
        for scene in scenes
    }


def one_context(args, place: Place) -> dict:
    """Regret of every way, by kind of person, and calibration."""
    regrets: dict[str, dict[str, list[list[float]]]] = {}
    claims: dict[str, list] = {name: [] for name in ("claimed", "high", "predicted", "happened")}
    with tqdm.tqdm(total=len(KINDS) * args.people, unit="person") as progress:
        for number, kind in enumerate(KINDS):
            generator = torch.Generator().manual_seed(100 * args.people_seed + number)
            rows: dict[str, list[list[float]]] = {}
            for index, person in enumerate(people(kind, args.people, generator)):
                own = 10_000 * args.people_seed + 1000 * number + index
                mind = Mind(person, place)
                trial = asked(person, mind, place, own, informative=True)
                random = asked(person, mind, place, own, informative=False)
                said, exact = (stated(person, mind, own, error=e) for e in (0.5, 0.0))
                ways = {
                    "choices": trial.regret["best"],
                    "their mean weights": trial.regret["weights"],
                    "random questions": random.regret["best"],
                    "Promptable Behaviors, pairs": compared(person, mind, place, own, scenes=1),
                    "Promptable Behaviors, groups of 5": compared(
                        person, mind, place, own, scenes=5
                    ),
                    "stated weights": [said] * len(AFTER),
                    "stated weights, exact": [exact] * len(AFTER),
                    "their utility, known": [mind.floor(answers) for answers in AFTER],
                }
                for way, row in ways.items():
                    rows.setdefault(way, []).append(row)
                if kind != KINDS[-1]:
                    claims["claimed"].append(trial.claimed)
                    claims["high"].append(trial.claimed_high)
                    claims["predicted"] += trial.predicted
                    claims["happened"] += trial.happened
                progress.update()
            regrets[kind] = rows
    counted = {
        way: [row for kind in KINDS[:-1] for row in regrets[kind][way]] for way in regrets[KINDS[0]]
    }
    groups = {way: summary(rows) for way, rows in counted.items()}
    kinds = {kind: summary(rows["choices"]) for kind, rows in regrets.items()}
    return {
        "after": AFTER,
        "ways": groups,
        "kinds": kinds,
        "calibration": calibration(counted["choices"], claims),
    }


def summary(rows: list[list[float]]) -> list[dict[str, float]]:
    """Mean with its 95 % interval, and the median, over people ``[N, len(AFTER)]``, in percent."""
    table = 100 * np.array(rows)
    found = []
    for column in table.T:
        interval = bootstrap_interval(column)
        found.append(
            {
                "mean": interval.estimate,
                "low": interval.low,
                "high": interval.high,
                "median": float(np.median(column)),
                "n": interval.n,
            }
        )
    return found


def calibration(rows: list[list[float]], claims: dict[str, list]) -> dict:
    """What was claimed beside what was true."""
    real, claimed, high = (np.array(x) for x in (rows, claims["claimed"], claims["high"]))
    predicted, happened = np.array(claims["predicted"]), np.array(claims["happened"])
    # The side is random: likes of the more likely one.
    likely, right = np.maximum(predicted, 1 - predicted), happened == (predicted > 0.5)
    tenth = np.digitize(likely, (0.6, 0.7, 0.8, 0.9))
    bins = [
        {
            "predicted": float(likely[tenth == number].mean()),
            "happened": float(right[tenth == number].mean()),
            "n": int((tenth == number).sum()),
        }
        for number in np.unique(tenth)
    ]
    return {
        "claimed_regret": (100 * claimed.mean(0)).tolist(),
        "real_regret": (100 * real.mean(0)).tolist(),
        "within_90_percent_bound": (100 * (real <= high + 1e-9).mean(0)).tolist(),
        "answers": bins,
    }


def several_contexts(args, all_places: dict[str, Place]) -> dict:
    """Regret by what is shared between contexts, for people who are alike and who differ in them."""
    found: dict[str, dict] = {}
    total = 2 * len(SHARING) * args.people
    with tqdm.tqdm(total=total, unit="person") as progress:
        for alike in ("the same", "half different"):
            generator = torch.Generator().manual_seed(100 * args.people_seed + 50)
            persons = people("irregularity", 2 * args.people, generator)
            rows: dict[str, list[list[float]]] = {one: [] for one in SHARING}
            for index in range(args.people):
                first, other = persons[2 * index : 2 * index + 2]
                share = 1.0 if alike == "the same" else HOW_ALIKE
                weights = share * first.weights + (1 - share) * other.weights
                there = dataclasses.replace(first, weights=weights)
                here = dict(zip(all_places, (first, there), strict=True))
                for sharing in SHARING:
                    rows[sharing].append(in_contexts(here, all_places, index, sharing=sharing))
                    progress.update()
            found[alike] = {sharing: summary(row) for sharing, row in rows.items()}
    return {"after": AFTER, "ways": found}


def table(rows: dict[str, list[dict[str, float]]]) -> str:
    """Mean regrets as text."""
    width = max(map(len, rows))
    lines = [f"{'answers':{width}}" + "".join(f"{number:>20}" for number in AFTER)]
    for way, entries in rows.items():
        cells = (f"{e['mean']:.1f} [{e['low']:.1f}, {e['high']:.1f}]" for e in entries)
        lines.append(f"{way:{width}}" + "".join(f"{cell:>20}" for cell in cells))
    return "\n".join(lines)


def main() -> None:
    """Run; ``--help`` lists the options."""
    parser = Parser(description=__doc__)
    parser.add_argument(
        "--policy", type=policy_folder, default=SHIPPED_POLICY, help="folder of the policy"
    )
    parser.add_argument("--people", type=count(2, 10_000), default=40, help="of each kind")
    parser.add_argument("--people-seed", type=seed, default=0, help="of the people")
    parser.add_argument("--known", type=count(2, 1000), default=60, help="scenes of the questions")
    parser.add_argument("--unseen", type=count(2, 1000), default=100, help="scenes of the regret")
    parser.add_argument(
        "--seed", type=scene_seed, default=31, help="of the scenes of the questions"
    )
    parser.add_argument("--unseen-seed", type=scene_seed, default=32, help="of the others")
    parser.add_argument("--contexts", action="store_true", help="two contexts instead of one")
    parser.add_argument("--drives", type=Path, default=Path("runs/choices/drives"), help="folder")
    parser.add_argument("--output", type=Path, help="new folder (default: runs/choices/evidence)")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.seed == args.unseen_seed:
        parser.error(f"--unseen-seed {args.unseen_seed} must not be --seed: nobody has seen them.")
    try:
        tunable = load_policy(args.policy).preference_space.tunable
        if tunable != OBJECTIVES:
            raise ValueError(
                f"--policy {args.policy} weighs {', '.join(tunable)}: the people here see drives of "
                f"policies that weigh {', '.join(OBJECTIVES)}."
            )
        folder = claim_folder(args.output, Path("runs/choices/evidence"))
        found = places(args, ("static", "corridor") if args.contexts else ("static",))
    except (OSError, ValueError) as error:
        parser.error(str(error))
    if args.contexts:
        result = several_contexts(args, found)
        for alike, rows in result["ways"].items():
            print(f"weights in both contexts: {alike}\n{table(rows)}")
    else:
        result = one_context(args, found["static"])
        print(f"{table(result['ways'])}\n\nby kind of person\n{table(result['kinds'])}")
        print(json.dumps(result["calibration"], indent=1))
    result["settings"] = {key: str(value) for key, value in vars(args).items() if key != "output"}
    (folder / "evidence.json").write_text(json.dumps(result, indent=1) + "\n")
    print(f"written: {folder / 'evidence.json'}")


if __name__ == "__main__":
    main()
