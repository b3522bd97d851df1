"""The drives that ship as recorded on the page are what its simulation gives to a scripted hand, and they are imported."""

from __future__ import annotations

import io
import subprocess

import numpy as np
import pytest

from envs.demonstrations import import_demonstrations
from recipes.evaluation.style import of_demonstrations
from tests._command import ROOT

from ._node import needs_node

SHIPPED = ROOT / "examples" / "drives_page.csv"


def numbers(text: str) -> np.ndarray:
    return np.genfromtxt(io.StringIO(text), delimiter=",", skip_header=1)[:, 1:]


@needs_node
def test_a_scripted_hand_drives_them_again(page_file):
    script = ROOT / "examples" / "drive_the_page.mjs"
    run = subprocess.run(
        ["node", script, page_file, "3"], capture_output=True, text=True, timeout=60, check=False
    )
    assert run.returncode == 0, run.stderr
    assert "seed 10000: Kept drive 1" in run.stderr
    again = numbers(run.stdout)
    assert np.abs(again - numbers(SHIPPED.read_text())[: len(again)]).max() <= 2e-4


def test_all_are_imported_and_pass_on_the_right_at_a_metre_and_a_half():
    drives, report = import_demonstrations(SHIPPED)
    assert len(drives) == 10, str(report)
    shown = of_demonstrations(drives)
    assert shown.on("right") == 1.0
    assert shown.nearest.mean().item() == pytest.approx(1.5, abs=0.1)
