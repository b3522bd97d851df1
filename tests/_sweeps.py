"""Small policies and spaces for tests of what is done with sweeps."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tensordict.nn import TensorDictModule

from envs.rendering import gl_context_type
from torchrl_morl import PreferenceSpace

SPACE = PreferenceSpace(("core", "distance", "efficiency"), static={"core": 1.0})
DEMO_SPACE = PreferenceSpace(("core", "demo", "distance", "efficiency"), static={"core": 1.0})

try:
    gl_context_type()
    NO_GL = ""
except RuntimeError as error:
    NO_GL = str(error)
needs_gl = pytest.mark.skipif(bool(NO_GL), reason=NO_GL)


def bend(preference: torch.Tensor) -> torch.Tensor:
    """Full speed; the first objective asks for a left bend."""
    turn = 0.1 * preference[..., 0]
    return torch.stack((torch.ones_like(turn), turn), dim=-1)


BEND = TensorDictModule(bend, in_keys=["preference"], out_keys=["action"])


def is_png(path: Path) -> bool:
    return path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 20_000
