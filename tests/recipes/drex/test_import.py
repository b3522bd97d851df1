"""Somebody else's demonstrations: from a CSV file to a reward model that prefers their style."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase

from envs.demonstrations.importer import import_demonstrations
from recipes.drex import ranking, styles
from recipes.drex.cloning import clone_behaviour
from recipes.drex.rollouts import noisy_rollouts
from tests._drex import config
from torchrl_morl.modules import RewardModel

HEADER = ("trajectory", "time", "x", "y", "human_x", "human_y", "goal_x", "goal_y")
SMALL = (
    "env.scene=empty",
    "env.num_threads=1",
    "cloning.num_cells=[64,64]",
    "cloning.batch_size=256",
    "cloning.updates=400",
    "noise.levels=[0.0,0.2,0.5]",
    "noise.rollouts=16",
    "style_negatives.rollouts=48",
    "reward_model.num_cells=[64,64]",
    "reward_model.batch_size=32",
    "reward_model.updates=200",
    "reward_model.lr=1e-3",
    "diagnostics.rollouts=8",
)


def imported(file: Path, count: int, seed: int, side: float = 1.0) -> TensorDictBase:
    """Drives that bow around the human, 1.4 m to the left of it, at 0.4 m/s; ten points a second.

    Nobody here drives like that. Headings are left to the import.
    """
    generator = np.random.default_rng(seed)
    with file.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(HEADER)
        for drive in range(count):
            goal = generator.uniform(6.0, 10.0)
            human = generator.uniform((0.4 * goal, -0.3), (0.6 * goal, 0.3))
            x = np.linspace(0.0, goal, 4000)
            y = (human[1] + 1.4 * side) * np.exp(-(((x - human[0]) / 1.2) ** 2))
            way = np.append(0.0, np.cumsum(np.hypot(np.diff(x), np.diff(y))))
            for step in range(int(way[-1] / 0.04) + 1):
                point = (np.interp(0.04 * step, way, values) for values in (x, y))
                writer.writerow([drive, 0.1 * step, *point, *human, goal, 0.0])
    data, report = import_demonstrations(file, num_threads=1)
    assert not report.rejected, report
    return data


@pytest.fixture(scope="module")
def driven(tmp_path_factory) -> dict[str, TensorDictBase]:
    folder = tmp_path_factory.mktemp("recorded")
    return {
        "demonstrations": imported(folder / "left.csv", 24, seed=0),
        "more": imported(folder / "more.csv", 8, seed=1),
        "mirrored": imported(folder / "right.csv", 8, seed=1, side=-1.0),
    }


def distill(cfg: DictConfig, demonstrations: TensorDictBase) -> RewardModel:
    """The stages of the recipe."""
    policy, _ = clone_behaviour(cfg, demonstrations)
    noisy = [(0.0, demonstrations), *noisy_rollouts(cfg, policy)]
    others = styles.other_styles(cfg) if cfg.style_negatives.rollouts else []
    model, _ = ranking.train_reward_model(cfg, ranking.ranked_snippets(cfg, noisy, others))
    return model


def mean_score(model: RewardModel, data: TensorDictBase) -> float:
    """Over the steps within 2 m of the human."""
    score = model(data.select("observation", "action"))["demo_score"].squeeze(-1)
    return score[data["mask"] & (data["human"][..., 0] < 2.0)].mean().item()


@pytest.mark.parametrize("negatives", [0, 48], ids=["plain", "extended"])
def test_the_reward_model_prefers_the_style_of_the_file(driven, negatives):
    """On drives that it has not seen: to the same ones mirrored, and to all that we drive."""
    cfg = config(overrides=SMALL, style_negatives__rollouts=negatives)
    torch.manual_seed(0)
    model = distill(cfg, driven["demonstrations"])
    own = mean_score(model, driven["more"])
    assert own - mean_score(model, driven["mirrored"]) > 0.1
    if negatives:
        # D-REX alone tells the sides apart, but hardly how wide or how bent somebody passes.
        contrast = styles.style_contrast(cfg, model)
        assert own - max(contrast.values()) > 0.25, (own, contrast)
