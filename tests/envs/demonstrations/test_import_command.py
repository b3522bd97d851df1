"""recipes.import_demonstrations at the command line."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from safetensors import SafetensorError

from recipes import import_demonstrations as recipe
from tests import _bags
from tests._command import run, run_here
from torchrl_morl.data import load_demonstrations

MODULE = "recipes.import_demonstrations"


def drives(path: Path, speeds: tuple[float, ...] = (0.4, 0.5)) -> Path:
    """Straight drives at these speeds to a goal at 4 m."""
    rows = ["trajectory,time,x,y,human_x,human_y,goal_x,goal_y"]
    for drive, speed in enumerate(speeds):
        rows += [f"{drive},{i / 5},{speed * i / 5},0,2,1.5,4,0" for i in range(int(21 / speed))]
    path.write_text("\n".join(rows) + "\n")
    return path


def boxes(path: Path) -> Path:
    path.write_text("trajectory,x,y,yaw,half_length,half_width\n0,2,-1,0.3,0.2,0.2\n")
    return path


@pytest.fixture
def refused(tmp_path, capsys):
    """The one line with which a command ends; it has written nothing."""

    def refused(*arguments: object, code: int = 2) -> str:
        before = sorted(tmp_path.rglob("*"))
        with pytest.raises(SystemExit) as stopped:
            run_here(recipe.main, *map(str, arguments))
        assert stopped.value.code == code
        out, err = capsys.readouterr()
        assert out == ""
        assert err.endswith("\n")
        assert err.count("\n") == 1, err
        assert sorted(tmp_path.rglob("*")) == before
        return err

    return refused


def test_from_the_command_line(tmp_path):
    file = drives(tmp_path / "drives.csv", (0.4, 0.555, 0.7))
    output = tmp_path / "out" / "demos.safetensors"
    options = ("--boxes", boxes(tmp_path / "boxes.csv"), "--output", output, "--max-steps", 60)
    done = run(MODULE, file, *options, "--speed-tolerance", 0.06)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert done.stdout.splitlines() == [
        "2 of 3 drives accepted",
        "  1 of 3 drives faster than turtlebot2's 0.5 m/s (up to 0.7 m/s): --robot, or "
        "--speed-tolerance 0.2",
        f"Demonstrations [2, 47]: {output}",
    ]
    data, metadata = load_demonstrations(output)
    assert data.shape == (2, 47)
    assert metadata["accepted"] == ["0", "1"]
    assert metadata["rejected"]["2"][0].startswith("drives at 0.70 m/s")
    assert (metadata["source"], metadata["boxes"]) == ("drives.csv", "boxes.csv")
    assert (metadata["robot"], metadata["goal_radius"], metadata["max_steps"]) == (
        "turtlebot2",
        0.3,
        60,
    )
    assert metadata["tolerances"]["speed"] == 0.06
    assert metadata["notes"] == []


def test_details_on_wish(tmp_path, capsys):
    file = drives(tmp_path / "drives.csv", (0.4, 0.7, 0.8))
    run_here(recipe.main, str(file), "--output", str(tmp_path / "a.safetensors"), "--verbose")
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" at ")[0] for line in lines[2:4]] == ["  1: drives", "  2: drives"]


def test_details_where_nothing_is_accepted(tmp_path, capsys):
    file = drives(tmp_path / "drives.csv", (0.7, 0.8))
    with pytest.raises(SystemExit):
        run_here(recipe.main, str(file), "--output", str(tmp_path / "a.safetensors"), "--verbose")
    first, *rest = capsys.readouterr().err.splitlines()
    assert "2 of 2 drives faster than turtlebot2's 0.5 m/s" in first
    assert [line.split(" at ")[0] for line in rest] == ["  0: drives", "  1: drives"]


def test_an_output_that_exists_is_left_alone(tmp_path, refused):
    output = tmp_path / "demos.safetensors"
    output.write_text("mine")
    assert "demos.safetensors exists and is not overwritten" in refused("none", "--output", output)
    assert output.read_text() == "mine"


@pytest.mark.parametrize("name", ["demos", "demos.npz", "demos.safetensors.txt", "."])
def test_an_output_of_another_kind(tmp_path, refused, name):
    message = refused(drives(tmp_path / "drives.csv"), "--output", name)
    assert "demonstrations are a .safetensors file" in message


def test_an_output_below_a_file(tmp_path, refused):
    file = drives(tmp_path / "drives.csv")
    message = refused(file, "--output", file / "demos.safetensors")
    assert "drives.csv is not a folder that can be written" in message


def test_an_output_in_a_locked_folder(tmp_path, refused):
    message = refused(drives(tmp_path / "drives.csv"), "--output", "/proc/a/demos.safetensors")
    assert "/proc is not a folder that can be written" in message


@pytest.mark.parametrize(
    "error", [OSError(28, "No space left on device"), SafetensorError("No space left on device")]
)
def test_an_output_that_cannot_be_written_after_all(tmp_path, refused, monkeypatch, error):
    def full(*_: object) -> None:
        raise error

    monkeypatch.setattr(recipe, "save_demonstrations", full)
    message = refused(drives(tmp_path / "drives.csv"), "--output", tmp_path / "a.safetensors")
    assert "No space left on device" in message


def test_ctrl_c(tmp_path, refused, monkeypatch):
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(recipe, "import_demonstrations", interrupted)
    message = refused("drives.csv", "--output", tmp_path / "a.safetensors", code=130)
    assert "interrupted" in message


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--goal-radius", "0", "goal_radius must be positive"),
        ("--goal-radius", "nan", "goal_radius must be positive"),
        ("--goal-radius", "far", "argument --goal-radius: invalid float value: 'far'"),
        ("--max-steps", "0", "max_steps must be a whole number of control steps from 1: 0"),
        ("--max-steps", "1.5", "argument --max-steps: invalid int value: '1.5'"),
        ("--speed-tolerance", "-0.1", "speed tolerance must be finite and not negative: -0.1"),
        ("--turn-rate-tolerance", "inf", "turn_rate tolerance must be finite"),
        ("--gap-tolerance", "0", "gap tolerance must be positive"),
        ("--robot", "turtlebot9", "turtlebot9"),
        ("--robots", "hsr", "unrecognized arguments"),
        ("--boxes", "none.csv", "none.csv does not exist"),
    ],
)
def test_wrong_options_are_one_line(tmp_path, refused, option, value, message):
    file = drives(tmp_path / "drives.csv")
    assert message in refused(file, "--output", tmp_path / "a.safetensors", f"{option}={value}")


def test_missing_and_binary_files_are_one_line(tmp_path, refused):
    output = ("--output", tmp_path / "a.safetensors")
    assert "none.csv does not exist" in refused(tmp_path / "none.csv", *output)
    binary = tmp_path / "drives.csv"
    binary.write_bytes(bytes(range(256)))
    assert "drives.csv is not a text file" in refused(binary, *output)
    assert "is a folder" in refused(tmp_path, *output)


def test_the_other_robot(tmp_path, capsys):
    output = tmp_path / "a.safetensors"
    run_here(
        recipe.main, str(drives(tmp_path / "d.csv")), "--output", str(output), "--robot", "hsr"
    )
    assert load_demonstrations(output)[1]["robot"] == "hsr"


def test_a_bag_from_the_command_line(tmp_path):
    bag = _bags.write_bag(tmp_path / "bag", _bags.drive())
    output = tmp_path / "demos.safetensors"
    done = run(MODULE, "--bag", bag, "--goal-topic", "/goal_pose", "--output", output)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[0] == "1 of 1 drives accepted"
    _, metadata = load_demonstrations(output)
    assert metadata["source"] == "bag"
    assert metadata["topics"]["human"] == "/human"


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ((), "one file of trajectories or one --bag is needed, got none"),
        (
            ("drives.csv", "--bag", "bag"),
            "one file of trajectories or one --bag is needed, got drives",
        ),
        (
            ("drives.csv", "--human-topic", "/a"),
            "--human-topic is for --bag: drives.csv has no topics",
        ),
        (("--bag", "bag", "--stamps", "now"), "stamps must be 'header' or 'received', got 'now'"),
        (("--bag", "bag", "--human-topic", "/odom"), "must be different topics"),
        (("--bag", "nowhere"), "nowhere does not exist"),
        (("--bag", "bag", "--robot-topic", "/pose"), "topic /pose for the robot is not in"),
    ],
)
def test_bags_and_their_topics_are_refused_in_one_line(
    tmp_path, refused, monkeypatch, arguments, line
):
    monkeypatch.chdir(tmp_path)
    drives(tmp_path / "drives.csv")
    _bags.write_bag(tmp_path / "bag", _bags.drive())
    assert line in refused(*arguments, "--output", "demos.safetensors")


def test_without_rosbags_it_says_what_to_install(tmp_path, refused, monkeypatch):
    bag = _bags.write_bag(tmp_path / "bag", _bags.drive())
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    message = refused("--bag", bag, "--output", tmp_path / "demos.safetensors")
    assert "bags need the package rosbags: pip install -c constraints.txt rosbags" in message
