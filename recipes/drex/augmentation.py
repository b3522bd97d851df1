"""How many demonstrations does the clone need? Fig. 2b of de Heuvel et al. (arXiv:2404.04857).

Clones the behaviour from the first 1, 10, 100 and 1,000 demonstrations of a file that
``recipes.drex.drex`` has written, and drives each clone without noise in the same fresh scenes::

    python -m recipes.drex.augmentation demonstrations.safetensors --output runs/augmentation
"""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import torch
import tqdm
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torch import Tensor

from recipes.arguments import Parser
from torchrl_morl.data import load_demonstrations

from .cloning import clone_behaviour
from .demonstrations import demonstrated
from .rollouts import core_return, frechet, mean_and_error, rollouts, succeeded

_LABELS = {
    "core": "core return, as a share of what the way to the goal pays",
    "frechet": "Frechet distance to the demonstration / m",
    "success": "success rate",
}


def main() -> None:
    """Clone, drive and compare; ``--help`` lists the options."""
    parser = Parser(description=__doc__)
    parser.add_argument("file", type=Path, help="demonstrations of recipes.drex.drex")
    parser.add_argument("--output", type=Path, required=True, help="folder for the picture")
    parser.add_argument(
        "--counts", type=int, nargs="+", default=[1, 10, 100, 1000], help="N_D of each clone"
    )
    parser.add_argument("--scenes", type=int, default=20, help="the same ones for every clone")
    args = parser.parse_args()
    picture = args.output / "augmentation.png"
    if picture.exists():
        parser.error(f"{picture} exists and is not overwritten: choose another folder.")
    if args.scenes < 2:
        parser.error(f"--scenes must be at least 2, for a standard error, got {args.scenes}.")
    try:
        demonstrations, metadata = load_demonstrations(args.file)
    except (ValueError, FileNotFoundError) as error:
        parser.error(str(error))
    if "config" not in metadata:
        parser.error(f"{args.file} was not written by recipes.drex.drex: it has no configuration.")
    if "demonstrator" not in metadata:
        parser.error(
            f"{args.file} holds recorded demonstrations: nobody drives them in the scenes of this "
            "study, so that the distance to them is unknown. It needs those of the scripted circle."
        )
    for count in args.counts:
        if not 1 <= count <= len(demonstrations):
            parser.error(f"--counts must be from 1 to {len(demonstrations)}, got {count}.")

    cfg = OmegaConf.create(metadata["config"])
    torch.set_num_threads(cfg.torch_threads)
    results = study(cfg, demonstrations, args.counts, args.scenes)
    print(table(args.counts, results))
    args.output.mkdir(parents=True, exist_ok=True)
    figure(picture, args.counts, results)
    print(f"picture: {picture}")


def study(
    cfg: DictConfig, demonstrations: TensorDictBase, counts: list[int], num_scenes: int
) -> dict[str, Tensor]:
    """Clones of the first demonstrations, each in the same scenes.

    Args:
        cfg: of the recipe.
        demonstrations: ``[N, T]``.
        counts: from how many of them each clone learns, ``[C]``.
        num_scenes: ``S``.

    Returns:
        ``core`` and ``success`` ``[C, S]``, and ``frechet`` ``[C, F]``, metres, in those ``F``
        scenes whose demonstrated path is free of boxes: no other path can be followed.
    """
    seed = cfg.seed + 40_000
    reference = demonstrated(cfg, num_scenes, seed)
    results: dict[str, list[Tensor]] = {name: [] for name in _LABELS}
    for count in tqdm.tqdm(counts, desc="augmentation", unit="clone"):
        torch.manual_seed(cfg.seed)  # clones start from the same weights
        policy, _ = clone_behaviour(cfg, demonstrations[:count])
        data = rollouts(policy, num_scenes, seed, **cfg.env)
        results["core"].append(core_return(data))
        results["frechet"].append(frechet(data, reference)[reference["free"]])
        results["success"].append(succeeded(data).float())
    return {name: torch.stack(values) for name, values in results.items()}


def table(counts: list[int], results: dict[str, Tensor]) -> str:
    """One line per clone: means and standard errors."""
    lines = [f"{name}: {label}" for name, label in _LABELS.items()]
    heads = [f"{name} (n = {values.shape[1]})" for name, values in results.items()]
    lines.append(f"{'N_D':>6}" + "".join(f"{head:>22}" for head in heads))
    columns = [torch.stack(mean_and_error(values), -1) for values in results.values()]
    for count, *cells in zip(counts, *(column.tolist() for column in columns), strict=True):
        numbers = (f"{mean:.2f} +- {error:.2f}" for mean, error in cells)
        lines.append(f"{count:>6}" + "".join(f"{number:>22}" for number in numbers))
    return "\n".join(lines)


def figure(path: Path, counts: list[int], results: dict[str, Tensor]) -> None:
    """The same as a picture."""
    fig, axes = plt.subplots(1, len(results), figsize=(12, 3.6), layout="constrained")
    for ax, (name, values) in zip(axes, results.items(), strict=True):
        mean, error = mean_and_error(values)
        ax.errorbar(counts, mean, error, marker="o", capsize=3, color="#0072b2")
        ax.set_xscale("log")
        ax.set_xlabel("demonstrations $N_D$")
        ax.set_ylabel(_LABELS[name])
        ax.set_title(f"n = {values.shape[1]}", fontsize=9)
        ax.grid(alpha=0.3)
    fig.suptitle("cloned policies without noise, means and standard errors", fontsize=10)
    fig.savefig(path, dpi=120)
    plt.close(fig)


if __name__ == "__main__":
    main()
