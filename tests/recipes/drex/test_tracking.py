"""Drives along the demonstrated paths under noise, paths with a bulge, and what R learns from both."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

from recipes.drex import ranking, tracking
from recipes.drex.demonstrations import demonstrator
from recipes.drex.rollouts import rollouts, succeeded
from tests._drex import TINY, config
from torchrl_morl.objectives import BradleyTerryLoss

EMPTY = ("env.scene=empty", "env.num_threads=1", "tracking.rollouts=4")


def test_a_bulge_by_hand():
    """Half a metre to the left in the middle of a line along y; the ends stay, the rest falls off."""
    path = torch.stack((torch.zeros(41), torch.linspace(0, 4, 41)), -1)[None]
    mask = torch.ones(1, 41, dtype=torch.bool)
    numbers = {"height": 0.5, "width": 0.4, "place": 0.5}
    other = tracking.bulge(path, mask, **{k: torch.tensor([v]) for k, v in numbers.items()})
    away = other[0, :, 0]
    assert_close(other[..., 1], path[..., 1])
    assert away[20] == pytest.approx(-0.5)
    assert away[24] == pytest.approx(-0.5 * torch.tensor(-0.5).exp().item(), abs=1e-5)
    assert_close(away[[0, 40]], torch.zeros(2))


def test_a_bulge_ends_with_its_path():
    path = torch.stack((torch.linspace(0, 4, 41), torch.zeros(41)), -1)[None]
    mask = torch.arange(41)[None] < 21
    numbers = {"height": 0.5, "width": 0.4, "place": 0.5}
    other = tracking.bulge(path, mask, **{k: torch.tensor([v]) for k, v in numbers.items()})
    assert other[0, 10, 1] == pytest.approx(0.5)
    # Points behind the end are the end.
    assert_close(other[0, 20:], path[0, 20:21].expand(21, 2))


@pytest.fixture(scope="module", params=["scripted", "recorded"])
def driven(request):
    cfg = config(overrides=(*TINY, *EMPTY))
    recorded = None
    if request.param == "recorded":
        recorded = rollouts(demonstrator(cfg), 3, 3, **cfg.env)
    paths = tracking.demonstrated(cfg, recorded)
    return cfg, recorded, tracking.tracked(cfg, paths), tracking.bulging(cfg, paths)


def test_drives_along_what_was_demonstrated(driven):
    cfg, _, tracked, bulging = driven
    assert succeeded(tracked).all()
    assert len(tracked) == len(bulging) == cfg.tracking.rollouts
    # An orbit around the human at a metre, with noise.
    nearest = tracked["human"][..., 0].masked_fill(~tracked["mask"], 9.0).amin(-1)
    assert (nearest > 0.8).all()
    assert (nearest < 1.1).all()
    assert not torch.equal(tracked["action"][0], tracked["action"][1])


def test_shows_what_leads_back_to_the_path(driven):
    """Pure pursuit turns smoothly: what it intended is steadier than what noise made of it."""
    _, _, tracked, _ = driven
    shown = tracking.shown(tracked)
    mask = shown["mask"]
    assert_close(shown["observation"], tracked["observation"])
    change, noisy = (
        (data["action"][:, 1:, 1] - data["action"][:, :-1, 1])[mask[:, 1:]].abs().median()
        for data in (shown, tracked)
    )
    assert change < noisy
    gap = (shown["action"] - tracked["action"])[mask]
    assert gap.abs().max() > 0.1
    assert gap[..., 1].mean().abs() < 0.02
    assert "next" not in shown.keys()


def test_bulges_start_where_the_path_is_left(driven):
    _, _, tracked, bulging = driven
    focused = bulging["near"] & bulging["mask"]
    # All but those whose bulge is hardly wider than the tolerance, or lies at an end.
    assert focused.any(-1).sum() >= len(bulging) - 1
    assert focused.sum() < bulging["mask"].sum() / 2
    assert "near" not in tracked.keys()


def test_the_same_seed_drives_the_same(driven):
    cfg, recorded, tracked, bulging = driven
    paths = tracking.demonstrated(cfg, recorded)
    assert_close(tracking.tracked(cfg, paths)["action"], tracked["action"])
    assert_close(tracking.bulging(cfg, paths)["action"], bulging["action"])


def test_pairs_of_paths_are_a_source_of_their_own(driven):
    cfg, _, tracked, bulging = driven
    noisy = [(0.0, tracked), (-0.5, bulging.exclude("near"))]
    cfg.reward_model.snippet_length = 10
    sources = ranking.ranked_snippets(cfg, noisy, [], tracked, bulging)
    assert list(sources) == ["noise pairs", "path pairs"]
    assert sources["path pairs"].sample(8)["gap"].tolist() == [1.0] * 8


def test_noise_on_what_r_reads_stays_within_the_limits():
    generator = torch.Generator().manual_seed(0)
    data = TensorDict(
        observation=torch.ones(500, 20, 3), action=torch.ones(500, 20, 2), batch_size=[500, 20]
    )
    ranking.prepare(data, 0.25, [1], generator)
    assert data["observation"][..., 1].eq(0).all()
    assert data["observation"][..., [0, 2]].eq(1).all()
    assert data["action"].max() == 1.0
    # Half of the noise is cut off at 1. Each snippet has its own: from none to 0.25.
    spread = (1 - data["action"]).flatten(1).amax(-1)
    assert spread.min() < 0.05
    assert 0.4 < spread.max() < 1.2
    again = data.clone()
    ranking.prepare(again, 0.0, [], generator)
    assert_close(again["action"], data["action"])


def test_r_of_demonstrated_steps_is_drawn_to_one():
    """With the term R of what is shown everywhere rises, which pairs of the same leave at a half."""
    cfg = config(overrides=TINY, reward_model__updates=150, reward_model__lr=3e-3)
    torch.manual_seed(0)
    group = TensorDict(
        observation=torch.randn(6, 40, 36), action=torch.zeros(6, 40, 2), batch_size=[6, 40]
    ).set("mask", torch.ones(6, 40, dtype=torch.bool))
    noisy = [(0.0, group), (-0.5, group.clone())]
    scores = {}
    for coefficient in (0.0, 1.0):
        cfg.reward_model.demonstration_coeff = coefficient
        torch.manual_seed(0)
        model, _ = ranking.train_reward_model(cfg, ranking.ranked_snippets(cfg, noisy, []), [group])
        scores[coefficient] = ranking.step_scores(model, group).mean().item()
    assert scores[0.0] < 0.7
    assert scores[1.0] > 0.9


def test_scores_keep_their_gradients():
    cfg = config(overrides=TINY)
    loss = BradleyTerryLoss(ranking.make_reward_model(cfg))
    data = TensorDict(observation=torch.randn(5, 36), action=torch.zeros(5, 2), batch_size=[5])
    ranking.scored(loss, data).log().mean().backward()
    gradients = [value.grad for value in loss.parameters()]
    assert all(gradient is not None for gradient in gradients)
