"""The styles of the D-REX recipe: what ranks below the demonstrations, and what they are told from."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from envs.demonstrations import CircleDemonstrator
from recipes.drex import styles
from tests._drex import config

# --- ranked below the demonstrations


@pytest.fixture(scope="module", params=["left", "right"])
def groups(request) -> tuple[float, list[TensorDict]]:
    """The bearing of the human beside the demonstration, and three rollouts of each style."""
    cfg = config(style_negatives__rollouts=18, env__num_threads=1, env__scene="empty")
    cfg.demonstrations.side = request.param
    bearing = -math.pi / 2 if request.param == "left" else math.pi / 2
    return bearing, styles.other_styles(cfg)


def nearest(data: TensorDict) -> tuple[torch.Tensor, torch.Tensor]:
    """Distance and bearing of the human where each trajectory is closest to it."""
    distance, bearing = data["human"].unbind(-1)
    least, step = torch.where(data["mask"], distance, torch.inf).min(1)
    return least, bearing.gather(1, step[:, None]).squeeze(1)


def test_other_styles_are_none_of_the_demonstration(groups):
    beside, (other, mirrored, opposite, detour, mirrored_detour, straight) = groups
    for data in (other, mirrored, opposite, detour, mirrored_detour, straight):
        assert data["mask"].any(-1).tolist() == [True] * 3
    for data, side in (
        (other, beside),
        (mirrored, -beside),
        (opposite, -beside),
        (detour, beside),
        (mirrored_detour, -beside),
    ):
        assert (nearest(data)[1] - side).abs().max() < 0.5
    for data in (other, mirrored):
        # Radii within 0.6 ... 0.85 or 1.15 ... 2.2 m.
        assert ((nearest(data)[0] - 1.0).abs() > 0.1).all()
    assert (nearest(opposite)[0] - 1.0).abs().max() < 0.05
    for data in (detour, mirrored_detour):
        assert ((nearest(data)[0] > 0.45) & (nearest(data)[0] < 2.25)).all()
    settled = straight["goal"][:, 5:, 1][straight["mask"][:, 5:]]
    assert settled.abs().max() < 0.02
    assert nearest(straight)[0].max() < 0.6


def test_a_share_for_every_style():
    for total, share in ((0, 0), (12, 2), (17, 2), (600, 100)):
        assert styles.rollouts_per_style(config(style_negatives__rollouts=total)) == share


@pytest.mark.parametrize("total", [1, 5, 11, -6])
def test_a_style_needs_two_rollouts(total):
    cfg = config(style_negatives__rollouts=total)
    with pytest.raises(ValueError, match=f"must be 0 or at least 12, .*, got {total}"):
        styles.other_styles(cfg)


# --- told from the demonstration

AHEAD = torch.tensor([[5.0, 0.1], [4.0, 0.0], [4.0, 0.0]])
BESIDE = torch.tensor([[2.0, 0.2], [1.0, -math.pi / 2], [1.0, math.pi / 2]])


@pytest.mark.parametrize("side", ["left", "right"])
def test_contrast_is_with_the_demonstration_that_was_given(side):
    section = {"radius": 1.2, "side": side, "speed": 0.3}
    cfg = config(**{f"demonstrations__{key}": value for key, value in section.items()})
    seen = TensorDict(goal=AHEAD, human=BESIDE, batch_size=[3])
    expected = CircleDemonstrator(**section, scaled=True)(seen.clone())["action"]
    contrast = styles.contrast_styles(cfg)
    assert torch.equal(contrast.pop("demonstration")(seen.clone())["action"], expected)
    for name, policy in contrast.items():
        action = policy(seen.clone())["action"]
        assert not torch.equal(action, expected), name
        # As fast as demonstrated: what tells styles apart must be the way that they take.
        assert ((action[:, 0] + 1) / 4).max() <= 0.3 + 1e-6, name


def test_contrast_counts_the_steps_near_the_human(monkeypatch):
    """R is whether the human is within a metre and a half: its mean over the steps within two."""
    cfg = config(diagnostics__rollouts=3, env__num_threads=1, env__scene="empty")
    pair = {"demonstration": styles.demonstrator(cfg), "wide": styles.detour(cfg, 1.9)}
    monkeypatch.setattr(styles, "contrast_styles", lambda _: pair)

    def score(data: TensorDict) -> TensorDict:
        near = data["observation"][..., 33:34] * 2.0 < 1.5
        return data.set("demo_score", near.float())

    contrast = styles.style_contrast(cfg, score)
    assert contrast["wide"] == 0.0
    data = styles.rollouts(pair["demonstration"], 3, cfg.seed + 30_000, **cfg.env)
    distance = data["human"][..., 0][data["mask"]]
    expected = (distance < 1.5).sum() / (distance < 2.0).sum()
    assert contrast["demonstration"] == pytest.approx(expected.item())
