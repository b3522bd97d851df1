"""D-REX: demonstrations distilled into a reward model that a preference can weigh.

Method of Brown et al. (https://arxiv.org/abs/1907.03976) as used by de Heuvel et al.
(https://arxiv.org/abs/2404.04857), from nothing to a saved reward model with its diagnostics. Run it
with ``python -m recipes.drex.drex``; every field of ``config.yaml`` can be overridden.
"""

from __future__ import annotations

from pathlib import Path

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from torchrl._utils import timeit

from recipes.training.command import recipe, undisturbed
from recipes.training.gradients import use_bfloat16
from recipes.training.logs import time_shares
from torchrl_morl.data import load_demonstrations, save_demonstrations

from . import ranking, styles, tracking
from .cards import metadata
from .cloning import clone_behaviour, save_clone
from .demonstrations import collect_demonstrations, read_demonstrations
from .report import write_report
from .rollouts import noisy_rollouts
from .schema import Config


@recipe("config", Config)
def main(cfg: DictConfig) -> None:
    """Demonstrations, behaviour cloning, noisy rollouts, ranking, diagnostics."""
    # Nothing is run before the configuration has been accepted.
    ranking.hidden_entries(cfg)
    styles.rollouts_per_style(cfg)
    recorded = read_demonstrations(cfg)
    bfloat16 = use_bfloat16(cfg.bfloat16, torch.device("cpu"))
    torch.set_num_threads(cfg.torch_threads)
    torch.manual_seed(cfg.seed)
    run_dir = Path(HydraConfig.get().runtime.output_dir)
    checkpoints = run_dir / "checkpoints"
    if (run_dir / "reward_model").exists():
        raise FileExistsError(
            f"{run_dir / 'reward_model'} exists and is not overwritten: choose another hydra.run.dir."
        )

    with timeit("demonstrations"):
        dataset = run_dir / "demonstrations.safetensors"
        if cfg.resume is not None and dataset.exists():
            demonstrations, _ = load_demonstrations(dataset)
        else:
            demonstrations = collect_demonstrations(cfg) if recorded is None else recorded
            with undisturbed():
                save_demonstrations(dataset, demonstrations, metadata(cfg))
    with timeit("behaviour cloning"):
        policy, cloning_loss = clone_behaviour(cfg, demonstrations, checkpoints / "cloning")
    with timeit("noisy rollouts"):
        # The demonstrations stand beside the clone without noise: neither is better.
        noisy = [(0.0, demonstrations), *noisy_rollouts(cfg, policy)]
    with timeit("other styles"):
        # The extension to D-REX: other ways to drive rank below the demonstrations.
        others = styles.other_styles(cfg, recorded) if cfg.style_negatives.rollouts else []
    with timeit("tracking"):
        # And to its noise: a learner disturbs whatever it drives.
        tracked = bulging = None
        if cfg.tracking.rollouts:
            paths = tracking.demonstrated(cfg, recorded)
            tracked, bulging = tracking.tracked(cfg, paths), tracking.bulging(cfg, paths)
            if not (run_dir / tracking.FILE).exists():
                with undisturbed():
                    save_demonstrations(
                        run_dir / tracking.FILE, tracking.shown(tracked), metadata(cfg)
                    )
    with timeit("reward model"):
        snippets = ranking.ranked_snippets(cfg, noisy, others, tracked, bulging)
        model, scores = ranking.train_reward_model(
            cfg,
            snippets,
            [demonstrations] if tracked is None else [demonstrations, tracked],
            bfloat16=bfloat16,
            checkpoints=checkpoints / "reward_model",
        )
    with timeit("diagnostics"):
        report = write_report(run_dir, cfg, model, noisy, scores)
    card = {"bfloat16": bfloat16, "behaviour_cloning_loss": cloning_loss, **scores, **report}
    with undisturbed():
        if not (run_dir / "behaviour_clone").exists():
            facts = {"behaviour_cloning_loss": cloning_loss}
            save_clone(run_dir / "behaviour_clone", cfg, policy, facts)
        # Last: a run with a reward model is over.
        ranking.save_model(run_dir / "reward_model", cfg, model, card)
    print(time_shares())
    print(f"reward model, report and behaviour clone: {run_dir}")


if __name__ == "__main__":
    main()
