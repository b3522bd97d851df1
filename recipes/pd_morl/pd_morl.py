"""PD-MORL on the navigation task: one TD3 agent with vector values, trained over all preferences at once.

Method of Basaklar et al. (https://arxiv.org/abs/2208.07914) as used by de Heuvel et al.
(https://arxiv.org/abs/2404.04857); :mod:`recipes.training.vector_td3` reads like its method section. Run it
with ``python -m recipes.pd_morl.pd_morl``; every field of ``config.yaml`` can be overridden on the command
line.
"""

from __future__ import annotations

from omegaconf import DictConfig

from recipes.training import vector_td3
from recipes.training.command import recipe
from recipes.training.corner_evaluation import CornerEvaluation
from recipes.training.task import make_task

from .schema import Config


@recipe("config", Config)
def main(cfg: DictConfig) -> None:
    """Train, evaluate while training, and save the last and the best policy."""
    task = make_task(cfg)
    vector_td3.train(cfg, task, evaluation=CornerEvaluation(cfg, task))


if __name__ == "__main__":
    main()
