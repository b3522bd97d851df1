"""The page about MO-Gymnasium: what it shows runs, and what it quotes is said."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from torchrl.envs import MOGymEnv, TransformedEnv

from torchrl_morl import PreferenceSpace
from torchrl_morl.modules import make_actor
from torchrl_morl.transforms import PreferenceSampler

pytest.importorskip("imageio", reason="MO-Gymnasium's MuJoCo tasks import it")
PAGE = (Path(__file__).parents[2] / "docs" / "mo_gymnasium.md").read_text()


def test_the_page_runs():
    code = re.search(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)[1]
    names: dict = {}
    exec(compile(code, "docs/mo_gymnasium.md", "exec"), names)
    assert names["returns"].shape == (3, 3)
    assert names["returns"].isfinite().all()
    assert len(names["buffer"]) == names["steps"]


def test_without_the_conversion_the_quoted_line_appears():
    quoted = re.search(r"`('observation' is float64.*?)`", PAGE)[1]
    space = PreferenceSpace(("forward", "jump", "control"))
    env = TransformedEnv(MOGymEnv("mo-hopper-v5"), PreferenceSampler(space))
    assert env.observation_spec["observation"].dtype == torch.float64
    actor = make_actor(env.action_spec, env.observation_spec)
    with pytest.raises(ValueError, match=re.escape(quoted)):
        env.rollout(2, actor)
