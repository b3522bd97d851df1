"""The demo as a user runs it."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import imageio.v2 as imageio
import pytest
import torch
from torchrl.data import Bounded

from recipes import film
from tests._command import run
from tests._sweeps import DEMO_SPACE, is_png, needs_gl
from torchrl_morl.deploy import save_policy
from torchrl_morl.deploy.features import OBSERVATION_SIZE
from torchrl_morl.modules import make_actor


@pytest.fixture(scope="module")
def policy(tmp_path_factory) -> Path:
    """Drives ahead at full speed, into the human of the showcase."""
    torch.manual_seed(0)
    preference_space, cells = DEMO_SPACE, (8,)
    actor = make_actor(
        Bounded(-1.0, 1.0, (2,)),
        in_features=OBSERVATION_SIZE + preference_space.num_tunable,
        num_cells=cells,
    )
    with torch.no_grad():
        actor[0].module[-1].bias.copy_(torch.tensor([5.0, 0.0]))
    return save_policy(
        tmp_path_factory.mktemp("policies") / "tiny",
        actor,
        preference_space=preference_space,
        card={"demonstrator": {"radius": 1.0, "side": "left", "speed": 0.5}},
    )


@needs_gl
def test_demo_leaves_pictures_and_a_film(policy, tmp_path):
    arguments = ("--policy", policy, "--output", tmp_path, "--episodes", 2, "--steps", 2)
    result = run("recipes.demo", *arguments)
    assert result.returncode == 0, result.stderr
    assert "Warning" not in result.stderr
    names = ["sweep.gif", "switch.png", "trajectories.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert all(name in result.stdout for name in names)
    for first, second in (("efficiency", "distance"), ("demo", "distance")):
        pair = f"from {first} to {second}", f"from {second} to {first}"
        assert any(text in result.stdout for text in pair)
    assert result.stdout.count("Spearman rho of weight and mean metric") == 3
    assert "demo -> frechet" in result.stdout
    assert is_png(tmp_path / "trajectories.png") and is_png(tmp_path / "switch.png")
    # Each of the three corners drives for about 40 steps before it hits the human.
    assert 30 < len(imageio.mimread(tmp_path / "sweep.gif")) < 50


CORE = Path(film.__file__).parent / "policies" / "core"


@needs_gl
def test_the_demo_of_a_policy_without_preferences_is_one_row(tmp_path):
    arguments = ("--policy", CORE, "--output", tmp_path, "--episodes", 2, "--steps", 3)
    result = run("recipes.demo", *arguments)
    assert result.returncode == 0, result.stderr
    assert "nan" not in result.stdout and "Spearman" not in result.stdout
    assert result.stdout.count("does not read the preference") == 1
    rows = [line for line in result.stdout.splitlines() if " % " in line]
    assert len(rows) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["drive.gif"]


def test_there_is_nothing_to_choose_of_a_policy_without_preferences(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["choices", "--policy", str(CORE)])
    with pytest.raises(SystemExit):
        importlib.import_module("recipes.choices.__main__").main()
    printed = capsys.readouterr()
    assert printed.out == "" and len(printed.err.splitlines()) == 1
    assert "does not read the preference" in printed.err
    assert not list(tmp_path.iterdir())


@needs_gl
@pytest.mark.slow
def test_a_film_of_another_scene(policy, tmp_path):
    film = tmp_path / "walking.gif"
    arguments = ("--policy", policy, "--scene", "moving_human", "--output", film)
    result = run("recipes.film", *arguments)
    assert result.returncode == 0, result.stderr
    assert len(imageio.mimread(film)) > 5
    again = run("recipes.film", *arguments)
    assert again.returncode == 2
    assert "is not overwritten" in again.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--output", "film.avi"), "must end in .gif or .mp4, got 'film.avi'"),
        (("--output", "film.gif", "--policy", "nowhere"), "nowhere"),
    ],
)
def test_a_film_that_cannot_be_made(arguments, message, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["film", *arguments])
    with pytest.raises(SystemExit):
        film.main()
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("module", ["recipes.film", "recipes.demo"])
def test_without_graphics_a_command_says_so_and_nothing_else(module, monkeypatch, tmp_path):
    monkeypatch.setenv("MUJOCO_GL", "off")
    result = run(module, "--output", tmp_path / "film.gif")
    assert result.returncode == 2
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert "error: No OpenGL backend works (MUJOCO_GL='off')" in line
    assert not list(tmp_path.iterdir())


def test_a_name_of_graphics_that_mujoco_does_not_know_is_one_line(monkeypatch, tmp_path):
    """MuJoCo raises it when it is imported: in every command, also in those that draw nothing."""
    monkeypatch.setenv("MUJOCO_GL", "foo")
    for module in ("recipes.evaluate", "recipes.train", "recipes.pd_morl.pd_morl"):
        result = run(module, *(["--output", tmp_path / "x"] if module == "recipes.train" else []))
        assert result.returncode != 0
        (line,) = result.stderr.splitlines()
        assert line.startswith("error: MUJOCO_GL='foo': MuJoCo cannot be imported with it")
        assert "egl, osmesa or glfw" in line
    assert not list(tmp_path.iterdir())
