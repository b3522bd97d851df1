"""Train a policy from nothing as the shipped one: demonstrations, D-REX, PD-MORL, MO-PPO, evaluation.

``make train`` runs this. Every stage is a recipe of its own; options are passed on to them::

    python -m recipes.train                                   # the shipped configuration
    python -m recipes.train --pd-morl seed=1 collector.total_frames=100000
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path


def main() -> None:
    """Run the stages one after the other; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, help="folder to write; must not exist")
    parser.add_argument("--drex", nargs="*", default=[], help="overrides of recipes/drex")
    parser.add_argument("--pd-morl", nargs="*", default=[], help="overrides of recipes/pd_morl")
    parser.add_argument("--mo-ppo", nargs="*", default=[], help="overrides of recipes/mo_ppo")
    parser.add_argument("--without-mo-ppo", action="store_true", help="end with PD-MORL's policy")
    parser.add_argument("--episodes", type=int, default=100, help="of the final evaluation")
    args = parser.parse_args()
    output = args.output or Path("runs/train") / time.strftime("%Y-%m-%d_%H-%M-%S")
    if output.exists():
        parser.error(f"{output} exists and is not overwritten: choose another folder.")
    output = output.resolve()
    drex, morl, ppo = (output / name for name in ("drex", "pd_morl", "mo_ppo"))

    # The stages take turns: a second thread makes 1.36 times PD-MORL's updates on an idle machine.
    threads = min(2, len(os.sched_getaffinity(0)))
    stages = {
        "D-REX": [
            "recipes.drex.drex",
            f"hydra.run.dir={drex}",
            f"torch_threads={threads}",
            *args.drex,
        ],
        "PD-MORL": [
            "recipes.pd_morl.pd_morl",
            f"hydra.run.dir={morl}",
            f"demonstrations.reward_model={drex / 'reward_model'}",
            f"demonstrations.dataset={drex / 'demonstrations.safetensors'}",
            f"compute.torch_threads={threads}",
            *args.pd_morl,
        ],
    }
    seconds = {name: run(name, command) for name, command in stages.items()}
    policy = final_policy(morl)
    if not args.without_mo_ppo:
        command = [
            "recipes.mo_ppo.mo_ppo",
            f"hydra.run.dir={ppo}",
            f"policy={policy}",
            f"demonstrations.reward_model={drex / 'reward_model'}",
            *args.mo_ppo,
        ]
        seconds["MO-PPO"] = run("MO-PPO", command)
        policy = final_policy(ppo)
    command = ["recipes.evaluate", "--policy", str(policy), "--episodes", str(args.episodes)]
    seconds["evaluation"] = run("evaluation", [*command, "--grid"])
    for name, value in seconds.items():
        print(f"{name:>12}: {value / 60:6.1f} min")
    print(f"policy: {policy}\ntry it: python -m recipes.demo --policy {policy}")


def run(name: str, command: list[str]) -> float:
    """Run a recipe and return its wall time in seconds."""
    print(f"--- {name}: python -m {' '.join(command)}", flush=True)
    started = time.perf_counter()
    result = subprocess.run([sys.executable, "-m", *command])
    if result.returncode:
        sys.exit(f"{name} failed with exit code {result.returncode}; see above.")
    return time.perf_counter() - started


def final_policy(run_dir: Path) -> Path:
    """The policy with the best score among those saved in the last fifth of the training."""
    policies = sorted((run_dir / "policies").glob("[!.]*"))
    if not policies:
        sys.exit(
            f"{run_dir / 'policies'} holds no policy: the training ended before its first update. "
            "It must last longer than collector.init_random_frames steps: raise "
            "--pd-morl collector.total_frames=..."
        )
    late = policies[-max(1, len(policies) // 5) :]

    def score(folder: Path) -> float:
        return json.loads((folder / "policy.json").read_text())["card"]["score"]

    return max(late, key=score)


if __name__ == "__main__":
    main()
