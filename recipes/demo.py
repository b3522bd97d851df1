"""The main job: watch one policy change its behaviour as the preference changes.

``make demo`` runs the shipped policy over a sweep of preferences, in one fixed scene and in 100
random ones, prints a table and writes pictures and a film to ``runs/demo``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
import tqdm

from torchrl_morl.deploy import load_policy
from torchrl_morl.evaluation import steerability

from .figures import sweep_figure, switch_figure
from .film import film
from .sweep import edge, sweep
from .switch import switch

SHIPPED_POLICY = Path(__file__).parent / "policies" / "navigation"
GOAL_RADIUS = 0.3


def main() -> None:
    """Run the demo; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--policy", type=Path, default=SHIPPED_POLICY, help="folder of the policy")
    parser.add_argument("--output", type=Path, default=Path("runs/demo"), help="folder to write")
    parser.add_argument("--episodes", type=int, default=100, help="random scenes")
    parser.add_argument("--steps", type=int, default=11, help="preferences in the sweep")
    parser.add_argument("--seed", type=int, default=7, help="of the random scenes")
    args = parser.parse_args()

    torch.set_num_threads(1)
    actor, space, _ = load_policy(args.policy)
    first, second = "efficiency", "distance"
    preferences = edge(space, first, second, args.steps)
    args.output.mkdir(parents=True, exist_ok=True)

    print(f"Sweep from {first} to {second}: {args.steps} preferences x {args.episodes} scenes")
    with tqdm.tqdm(total=args.steps, unit="preference") as progress:
        statistics = sweep(
            actor,
            space,
            preferences,
            episodes=args.episodes,
            seed=args.seed,
            scene="static",
            goal_radius=GOAL_RADIUS,
            on_preference=lambda _: progress.update(),
        )
    print(statistics.table())
    column = space.tunable.index(second)
    for name in ("min_human_distance", "time"):
        rho = steerability(preferences[:, column], statistics.mean(name))
        print(f"Spearman rho between the weight of {second} and mean {name}: {rho:.3f}")

    showcase = sweep(
        actor, space, preferences, episodes=1, seed=0, scene="showcase", goal_radius=GOAL_RADIUS
    )
    figure = args.output / "trajectories.png"
    sweep_figure(figure, showcase, statistics, first=first, second=second, goal_radius=GOAL_RADIUS)
    change = switch(actor, space, edge(space, first, second, 2), goal_radius=GOAL_RADIUS)
    switched = args.output / "switch.png"
    switch_figure(
        switched,
        change.paths,
        change.actions,
        showcase.scenes[0],
        names=(first, second, f"{first}, then {second}"),
        switch_step=change.switch_step,
        goal_radius=GOAL_RADIUS,
    )
    print(
        f"Preference changed after {change.switch_step * 0.2:.1f} s: {change.separation:.2f} m off "
        "the old path one second later"
    )
    movie = film(args.output / "sweep.gif", actor, space, edge(space, first, second, 3))
    print(f"Pictures: {figure}, {switched}; film: {movie}")


if __name__ == "__main__":
    main()
