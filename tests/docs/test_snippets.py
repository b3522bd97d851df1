"""Every snippet of README and docs runs, and every command is taken.

Pages of ``docs/history`` are of their time and are left out.
"""

from __future__ import annotations

import contextlib
import io
import re

import matplotlib
import pytest
import torch

from ._commands import Command, commands, known_place, make_targets, problem
from ._pages import ROOT, blocks, name, pages

matplotlib.use("Agg")

PAGES = pages(history=False)
WITH_PYTHON = [page for page in PAGES if blocks(page.read_text(), "python")]
WITH_SHELL = [page for page in PAGES if blocks(page.read_text(), "bash")]

NO_TREES = "SumSegmentTree"
"""What TorchRL says where its compiled part does not load."""

PRIORITIZED = "TensorDictPrioritizedReplayBuffer"
"""What needs those trees."""


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A folder to write in, with everything of the checkout in its place."""
    for entry in ROOT.iterdir():
        if entry.name not in {".git", ".venv", "runs", "outputs"}:
            (tmp_path / entry.name).symlink_to(entry)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def files(text: str) -> dict[str, str]:
    """Files that a page shows: YAML whose first line is a comment with a name."""
    found = {}
    for block in blocks(text, "yaml"):
        if match := re.match(r"# ([\w-]+\.yaml)\n", block.code):
            found[match[1]] = block.code
    return found


@pytest.mark.parametrize("page", WITH_PYTHON, ids=name)
def test_the_python_of_a_page_runs(page, checkout):
    """Its blocks one after the other, as a reader would type them."""
    names: dict = {"__name__": "page"}
    for place, block in enumerate(blocks(page.read_text(), "python")):
        torch.manual_seed(0)
        code = compile(block.code, f"{name(page)}, block {place + 1}", "exec")
        with contextlib.redirect_stdout(io.StringIO()):
            try:
                exec(code, names)
            except RuntimeError as error:
                # Nothing else may fail, nor where the compiled part loads: there is no such error then.
                if NO_TREES not in str(error) or PRIORITIZED not in block.code:
                    raise


@pytest.mark.parametrize("page", WITH_SHELL, ids=name)
def test_the_commands_of_a_page_are_taken(page, checkout):
    text = page.read_text()
    for file, content in files(text).items():
        (checkout / file).write_text(content)
    found = [
        one
        for block in blocks(text, "bash")
        for command in commands(block.code)
        if (one := problem(command))
    ]
    assert found == []


@pytest.mark.parametrize("page", WITH_SHELL, ids=name)
def test_the_targets_and_the_places_of_a_page_are_there(page):
    makefile = (ROOT / "Makefile").read_text()
    for block in blocks(page.read_text(), "bash"):
        for target in make_targets(block.code):
            assert re.search(rf"^{target}:", makefile, re.MULTILINE), target
        for path in re.findall(
            r"(?:recipes/policies|examples|tests|docs)/\w[\w./-]+\w", block.code
        ):
            assert known_place(path), path


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_programs_named_in_the_text_are_there(page):
    modules = re.findall(r"`[^`\n]*python -m ([\w.]+)", page.read_text())
    # What a command must be given is said by its own errors.
    found = [problem(Command(module, [])) for module in modules]
    assert [one for one in found if one and "env\n  Field required" not in one] == []


def test_wrong_commands_are_found():
    code = """
R="optim.lr=1e-4 \\
  optim.nothing=2"
python -m recipes.pd_morl.pd_morl $R   # a comment
OMP_NUM_THREADS=1 python -m recipes.evaluate --grid --sedd 3
python -m recipes.train --without-mo-ppo --pd-morl seed=1 env.drive=wings
python -m recipes.nothing && make demo
python -m recipes.pd_morl.pd_morl --multirun seed=0,1,2 | tee log
python -m recipes.evaluate --grid
"""
    found = [problem(command) for command in commands(code)]
    assert "optim.nothing" in found[0] or "nothing" in found[0]
    assert found[1] == "recipes.evaluate has no option --sedd"
    assert "wings" in found[2]
    assert found[3] == "there is no module recipes.nothing"
    assert found[4:] == [None, None]
    assert make_targets(code) == {"demo"}
