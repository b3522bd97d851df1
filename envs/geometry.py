"""Angles and lengths for the simulation, whose memory is NumPy's.

On so few numbers NumPy is several times faster than PyTorch. Angles are left to PyTorch all the same,
which rounds their last bit differently: a seed should give the same episodes as before. What is batched
in torch is in :mod:`torchrl_morl.geometry`.
"""

from __future__ import annotations

import numpy as np
import torch

__all__ = ["arctan2", "cos_sin", "norm"]


def arctan2(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Angles of the points ``(x, y)``, radians."""
    y, x = (torch.from_numpy(np.ascontiguousarray(values)) for values in (y, x))
    return torch.atan2(y, x).numpy()


def cos_sin(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cosines and sines of radians."""
    angle = torch.from_numpy(angle)
    return angle.cos().numpy(), angle.sin().numpy()


def norm(vector: np.ndarray) -> np.ndarray:
    """Lengths along the last dimension."""
    return np.sqrt(np.vecdot(vector, vector))
