"""Numbers of a loss: fixed, or going to another one."""

from __future__ import annotations

import pytest
from omegaconf import OmegaConf

from recipes.training.ppo_optimizers import scheduled


@pytest.mark.parametrize(
    ("loss", "frames", "expected"),
    [
        ({"style_coeff": 3.0}, 50, 3.0),
        ({"style_coeff": 0.9, "final_style_coeff": 0.7}, 100, 0.7),
        ({"style_coeff": 3.0, "final_style_coeff": None}, 50, 3.0),
        ({"style_coeff": 0.0, "final_style_coeff": 2.0}, 0, 0.0),
        ({"style_coeff": 0.0, "final_style_coeff": 2.0}, 25, 0.5),
        ({"style_coeff": 3.0, "final_style_coeff": 1.0}, 50, 2.0),
        ({"style_coeff": 3.0, "final_style_coeff": 0.0}, 130, 0.0),
    ],
)
def test_a_number_goes_linearly_to_the_final_one(loss, frames, expected):
    cfg = OmegaConf.create({"loss": loss, "collector": {"total_frames": 100}})
    assert scheduled(cfg, "style_coeff", frames) == pytest.approx(expected)
