"""The main job: watch one policy change its behaviour as the preference changes.

``make demo`` runs the shipped policy over a sweep of preferences, in one fixed scene and in 100
random ones, prints a table and writes pictures and a film to ``runs/demo``, or to ``runs/demo-2``
where that exists.
"""

from __future__ import annotations

import math
from pathlib import Path

import torch
import tqdm

from envs.rendering import gl_context_type
from recipes.arguments import Parser, count
from recipes.evaluation.setting import demonstrator, reads_preference, scene_seed, trained_in
from recipes.evaluation.sweep import SHIPPED_POLICY, edge, sweep
from recipes.objectives import known
from recipes.outputs import claim_folder
from recipes.policy_folders import policy_folder
from torchrl_morl.deploy import load_policy
from torchrl_morl.evaluation import steerability

from .figures import Row, sweep_figure, switch_figure
from .film import film
from .switch import switch


def main() -> None:
    """Run the demo; ``--help`` lists the options."""
    parser = Parser(description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "--policy", type=policy_folder, default=SHIPPED_POLICY, help="folder of the policy"
    )
    parser.add_argument(
        "--output", type=Path, help="new folder (default: runs/demo, else runs/demo-2 and so on)"
    )
    for name, default, numbers, text in (
        ("--episodes", 100, count(1, 10_000), "random scenes"),
        ("--steps", 11, count(2, 1_000), "preferences in a sweep"),
        ("--seed", 7, scene_seed, "of the random scenes"),
    ):
        parser.add_argument(name, type=numbers, default=default, metavar="N", help=text)
    args = parser.parse_args()

    torch.set_num_threads(1)
    try:
        policy = load_policy(args.policy)
        known(policy.preference_space.tunable)
        if policy.preference_space.num_tunable < 2:
            raise ValueError(
                f"{args.policy} weighs {policy.preference_space.tunable[0]} alone: a demo of preferences "
                "needs a policy of two objectives or more."
            )
        # Who walks was not part of what was demonstrated, and no path shows where they were.
        setting = trained_in(policy.card).with_one_robot.with_one_human
        shown = demonstrator(policy.card, setting.robot)
        gl_context_type()  # without it there is no film: better said now than at the end
        output = claim_folder(args.output, Path("runs/demo"))
    except (OSError, RuntimeError, ValueError) as error:
        parser.error(str(error))
    print(f"output {output}\n{setting}")
    showroom = {**setting.arguments, "scene": "showcase"}
    if not reads_preference(policy.card):
        print(
            "this policy does not read the preference: it drives the same under all, one row here"
        )
        any_one = policy.preference_space.corners().mean(0, keepdim=True)
        result = sweep(
            policy.actor,
            policy.preference_space,
            any_one,
            episodes=args.episodes,
            seed=args.seed,
            demonstrator=shown,
            **setting.arguments,
        )
        print(result.table())
        movie = film(
            output / "drive.gif",
            policy.actor,
            policy.preference_space,
            any_one,
            demonstrator=shown,
            **showroom,
        )
        print(f"film: {movie}")
        return

    # The rows of the paper: each trades two objectives off, the others have no weight.
    edges = policy.preference_space.pairwise_grid(args.steps).unflatten(0, (-1, args.steps))
    rows = []
    print(f"{len(edges)} sweeps of {args.steps} preferences x {args.episodes} scenes")
    with tqdm.tqdm(total=len(edges) * args.steps, unit="preference") as progress:
        for preferences in edges:
            statistics = sweep(
                policy.actor,
                policy.preference_space,
                preferences,
                episodes=args.episodes,
                seed=args.seed,
                demonstrator=shown,
                on_preference=lambda _: progress.update(),
                **setting.arguments,
            )
            showcase = sweep(
                policy.actor,
                policy.preference_space,
                preferences,
                episodes=1,
                seed=0,
                demonstrator=shown,
                **showroom,
            )
            first, second = (
                policy.preference_space.tunable[preferences[i].argmax()] for i in (0, -1)
            )
            rows.append(Row(first, second, showcase, statistics))
    for row in rows:
        print(f"\nfrom {row.first} to {row.second}")
        print(row.statistics.table())
        print(steered(row))

    figure = output / "trajectories.png"
    sweep_figure(figure, rows, goal_radius=setting.goal_radius)
    # From the last objective to the one before it: quick, then wide.
    before, after = policy.preference_space.tunable[-1], policy.preference_space.tunable[-2:][0]
    change = switch(
        policy.actor,
        policy.preference_space,
        edge(policy.preference_space, before, after, 2),
        **showroom,
    )
    switched = output / "switch.png"
    switch_figure(
        switched,
        change.paths,
        change.actions,
        rows[0].showcase.scenes[0],
        names=(before, after),
        switch_step=change.switch_step,
        goal_radius=setting.goal_radius,
    )
    changed = f"\nPreference changed after {change.switch_step * 0.2:.1f} s: "
    if math.isnan(change.separation):
        print(changed + "an episode ended less than one second later, nothing to compare")
    else:
        print(
            f"{changed}one second later the robot heads {change.turned:.0f} degrees elsewhere, "
            f"{change.separation:.2f} m off the old path"
        )
    movie = film(
        output / "sweep.gif",
        policy.actor,
        policy.preference_space,
        policy.preference_space.corners(),
        demonstrator=shown,
        **showroom,
    )
    print(f"Pictures: {figure}, {switched}; film: {movie}")


def steered(row: Row) -> str:
    """Rank correlations between a weight and the metric that it steers."""
    parts = []
    for objective in known((row.first, row.second)):
        if objective.metric not in row.statistics.metrics.keys():
            parts.append(f"{objective.name}: no {objective.metric}, nobody drives what was shown")
            continue
        tunable = row.statistics.preference_space.tunable
        weight = row.statistics.preferences[:, tunable.index(objective.name)]
        rho = steerability(weight, row.statistics.mean(objective.metric))
        how = "no change" if math.isnan(rho) else f"{rho:+.2f}"
        parts.append(f"{objective.name} -> {objective.metric}: {how}")
    return "Spearman rho of weight and mean metric: " + ", ".join(parts)


if __name__ == "__main__":
    main()
