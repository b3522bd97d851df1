"""The examples run as they stand, and so does what the pages about them show."""

from __future__ import annotations

import inspect
import re
from importlib import import_module
from pathlib import Path
from runpy import run_path

import pytest
from omegaconf import OmegaConf

import envs.objectives
import recipes.objectives
from envs import NavigationEnv
from examples import (
    choices,
    doorway,
    my_environment,
    my_robot,
    numpy_controller,
    objective,
    preferences,
    record_drives,
    unit_test_a_loss,
    vector_td3,
)


def _arrived(printed: str) -> list[int]:
    return [int(number) for number in re.findall(r"(\d+) of 6 at the goal", printed)]


def test_doorway(capsys):
    doorway.main(episodes=6)
    assert min(_arrived(capsys.readouterr().out)) >= 5


def test_my_robot(capsys):
    my_robot.main(episodes=6)
    printed = capsys.readouterr().out
    assert re.match(r"my_robot: \d+ of its 541 beams meet something", printed)
    # The policy was trained with a smaller and slower one.
    assert sum(_arrived(printed)) >= 14


def test_an_objective(capsys, monkeypatch):
    # What the script declares is for its process.
    monkeypatch.setattr("envs.objectives.OBJECTIVES", dict(envs.objectives.OBJECTIVES))
    monkeypatch.setattr("recipes.objectives.OBJECTIVES", dict(recipes.objectives.OBJECTIVES))
    monkeypatch.setattr("envs.navigation_task.OBJECTIVES", envs.objectives.OBJECTIVES)
    objective.main()
    printed = capsys.readouterr().out
    assert [line.split(":")[0].strip() for line in printed.splitlines()] == [
        "core",
        "distance",
        "ahead",
    ]


def test_a_controller_in_numpy(capsys):
    shown, wide, quick = (numpy_controller.drive(one) for one in ((1, 0, 0), (0, 1, 0), (0, 0, 1)))
    assert capsys.readouterr().out.count("goal reached") == 3
    assert quick[0] < min(shown[0], wide[0])
    # Who stands may set out: it hurries past him at a distance.
    assert shown[1] < quick[1] < wide[1]


def test_unit_tests_of_a_loss_pass():
    for name, test in vars(unit_test_a_loss).items():
        if name.startswith("test_"):
            test()


def test_preferences_in_a_foreign_environment(capsys):
    preferences.main()
    assert "kept through the episode: [0.2, 0.8]" in capsys.readouterr().out


@pytest.mark.parametrize(
    "name", ["doorway", "my_robot", "numpy_controller", "preferences", "record_drives"]
)
def test_a_script_says_what_it_does_and_takes_no_more(name, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    title = import_module(f"examples.{name}").__doc__.split()[:4]
    for arguments, code in ((["--help"], 0), (["--bogus"], 2), (["a.csv", "b.csv"], 2)):
        monkeypatch.setattr("sys.argv", [f"{name}.py", *arguments])
        with pytest.raises(SystemExit) as stop:
            run_path(Path(doorway.__file__).with_name(f"{name}.py"), run_name="__main__")
        printed = capsys.readouterr()
        assert stop.value.code == code
        assert (" ".join(title) in " ".join(printed.out.split())) == (code == 0)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("file", "message"),
    [(".", "exists and is not overwritten"), ("none/a.csv", "No such file or directory")],
)
def test_drives_are_recorded_in_a_new_file(file, message, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["record_drives.py", file])
    with pytest.raises(SystemExit) as stop:
        run_path(record_drives.__file__, run_name="__main__")
    (line,) = capsys.readouterr().err.splitlines()
    assert stop.value.code == 2 and message in line and file in line


def test_choices_of_a_foreign_policy(capsys):
    much, little = choices.main(0.95), choices.main(0.1)
    assert much[0] > little[0]
    assert capsys.readouterr().out.count("after answer") == 10


def test_the_shipped_drives_are_what_their_script_records(tmp_path):
    file = tmp_path / "drives.csv"
    record_drives.main(str(file))
    shipped = Path(record_drives.__file__).with_name("drives_right.csv")
    assert file.read_text() == shipped.read_text()


def test_an_environment_of_ones_own():
    source = inspect.getsource(my_environment)
    assert len(source.splitlines()) <= 30
    shown, *_ = _blocks("environment.md", "python")
    assert inspect.getsource(my_environment.Cart) in shown
    cart = my_environment.Cart()
    cart.reset(seed=0)
    for _ in range(100):
        _, reward, *_ = cart.step([0.5])
    # At rest between force and friction the speed is the force.
    assert reward == pytest.approx([0.5, -0.25], abs=1e-6)


def test_training_with_the_parts_alone(capsys):
    assert len(inspect.getsource(vector_td3).splitlines()) < 80
    returns = vector_td3.main(steps=100, episode=20)
    assert returns.shape == (5, 2) and returns.isfinite().all()
    printed = capsys.readouterr().out
    assert "hypervolume above (-1000, -1000): " in printed and "expected utility: " in printed


PAGES = Path(doorway.__file__).parents[1] / "docs" / "how_to"


def _blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (PAGES / page).read_text(), re.DOTALL)


def test_the_files_of_the_pages_are_taken(tmp_path):
    for text in (*_blocks("scene.md", "yaml"), *_blocks("robot.md", "yaml")):
        # Its first line is a comment with its name.
        (tmp_path / text.split()[1]).write_text(text)
    found = {}
    for scene in ("doorway.yaml", "hall.yaml", "mine.yaml"):
        env = NavigationEnv(
            scene=tmp_path / scene,
            robot=tmp_path / "my_robot.yaml",
            num_envs=2,
            num_threads=1,
            seed=0,
        )
        assert env.robot.max_speed == 0.8
        env.rollout(3)
        found[scene] = (env.scene.num_boxes, env.scene.num_people)
    assert found["doorway.yaml"][0] == 2 and found["hall.yaml"] == (1, 2)


def test_the_refusals_of_the_page_are_those_of_the_reader(tmp_path):
    text, *_ = _blocks("scene.md", "yaml")
    shown = re.findall(r"^doorway\.yaml: .*$", (PAGES / "scene.md").read_text(), re.MULTILINE)
    fixed = OmegaConf.to_container(OmegaConf.create(text))
    fixed |= {"start": [0, 0, 0], "goal": [8, 0], "human": [5, 0]}
    closed = [{"at": [x, y], "size": [a, b]} for x, y, a, b in _ROOM]
    changes = [
        ({"start": [0, 0, 90]}, 0.177),
        ({"goal": [3, -1]}, 0.177),
        ({"human": [6, 0.0], "boxes": closed}, 0.45),
        ({"humna": [1, 2]}, 0.177),
    ]
    path = tmp_path / "doorway.yaml"
    for line, (change, radius) in zip(shown, changes, strict=True):
        OmegaConf.save(OmegaConf.create({**fixed, **change}), path)
        with pytest.raises(ValueError) as error:
            NavigationEnv(scene=path, robot={"radius": radius})
        assert str(error.value).replace(str(path), "doorway.yaml") == line


# Around the goal, with a door of 0.8 m.
_ROOM = [
    (3, 2.9, 0.2, 5),
    (3, -2.9, 0.2, 5),
    (7, 5, 8.2, 0.2),
    (7, -5, 8.2, 0.2),
    (11, 0, 0.2, 10.2),
]
