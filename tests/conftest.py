"""Shared test set-up: one thread per process, quiet libraries, and the gpu marker.

The environment variables are set before torch is first imported; a value that is already set is kept.
"""

from __future__ import annotations

import os

for _variable, _value in {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "RL_WARNINGS": "0",  # TorchRL's notice about its compiled extension
    "SDL_VIDEODRIVER": "dummy",  # mo-gymnasium imports pygame
    "PYGAME_HIDE_SUPPORT_PROMPT": "1",
}.items():
    os.environ.setdefault(_variable, _value)

from pathlib import Path  # noqa: E402

import pytest  # noqa: E402
import torch  # noqa: E402

torch.set_num_threads(1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip tests marked gpu where there is no CUDA device."""
    if torch.cuda.is_available():
        return
    skip = pytest.mark.skip(reason="needs a CUDA device")
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(skip)


@pytest.fixture(autouse=True)
def _seed() -> None:
    """Start every test from the same random state."""
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def policy_folders(tmp_path_factory) -> dict[str, Path]:
    """Folders of policies by name: those that ship, and two that nobody has trained.

    ``walking`` reads the human's velocity, and what the shipped ``polished_seed0`` reads; ``hsr`` is of another robot, on wheels.
    """
    from tests import _restless  # most tests need no simulation

    shipped = Path(__file__).resolve().parents[1] / "recipes" / "policies"
    made = tmp_path_factory.mktemp("policies")
    return {
        **{folder.name: folder for folder in shipped.iterdir() if folder.is_dir()},
        "walking": _restless.save(
            made / "walking", {"scene": "moving_human", "observe_human_velocity": True}
        ),
        "hsr": _restless.save(made / "hsr", {"robot": "hsr", "drive": "wheels"}),
    }
