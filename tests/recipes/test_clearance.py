"""The objective that ships switched off, chosen by one field, moves its metric."""

from __future__ import annotations

import subprocess
import sys

import pytest

from recipes.evaluation.setting import choose
from recipes.evaluation.sweep import sweep
from recipes.training.run_folder import final_policy
from torchrl_morl.deploy import load_policy


@pytest.mark.slow
def test_a_quick_training_keeps_away_from_boxes_if_asked_to(tmp_path):
    """About five minutes; seed 0 gave 0.44 m at efficiency = 1 and 0.76 m at clearance = 1."""

    objectives = "env.objectives=[core,distance,efficiency,clearance]"
    command = [
        "recipes.pd_morl.pd_morl",
        "preset=quick",
        objectives,
        f"hydra.run.dir={tmp_path}/run",
    ]
    subprocess.run([sys.executable, "-m", *command], check=True, cwd=tmp_path, timeout=3600)
    policy = load_policy(final_policy(tmp_path / "run"))
    corners = policy.preference_space.corners()
    result = sweep(
        policy.actor,
        policy.preference_space,
        corners,
        episodes=60,
        seed=7,
        **choose(policy.card).arguments,
    )
    clearance = dict(
        zip(
            policy.preference_space.tunable,
            result.metrics["min_clearance"].nanmean(-1).tolist(),
            strict=True,
        )
    )
    assert clearance["clearance"] > clearance["efficiency"] + 0.1
