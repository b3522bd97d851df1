"""Types of command-line arguments."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from recipes import arguments


@pytest.mark.parametrize(
    ("parse", "text", "value"),
    [
        (arguments.positive_int, "1", 1),
        (arguments.seed, "0", 0),
        (arguments.seed, "2147483647", 2**31 - 1),
        (arguments.episodes, "100000", 100_000),
        (arguments.count(0), "0", 0),
        (arguments.positive, "1e-3", 1e-3),
        (arguments.share, "1", 1.0),
        (arguments.number(), "-3", -3.0),
    ],
)
def test_accepts(parse, text, value):
    assert parse(text) == value


@pytest.mark.parametrize(
    ("parse", "text", "allowed"),
    [
        (arguments.positive_int, "0", "must be a whole number at least 1, got '0'"),
        (arguments.positive_int, "1.0", "must be a whole number at least 1, got '1.0'"),
        (arguments.positive_int, "x", "must be a whole number at least 1, got 'x'"),
        (arguments.seed, "-1", "must be a whole number from 0 to 2147483647, got '-1'"),
        (
            arguments.episodes,
            "999999999",
            "must be a whole number from 1 to 100000, got '999999999'",
        ),
        (arguments.positive, "0", "must be a number above 0, got '0'"),
        (arguments.positive, "nan", "must be a number above 0, got 'nan'"),
        (arguments.share, "1.1", "must be a number from 0 to 1, got '1.1'"),
        (arguments.number(), "inf", "must be a number, got 'inf'"),
    ],
)
def test_refuses_with_the_value_and_what_is_allowed(parse, text, allowed):
    with pytest.raises(argparse.ArgumentTypeError) as refused:
        parse(text)
    assert str(refused.value) == allowed


def test_paths(tmp_path):
    file, folder, empty = tmp_path / "file", tmp_path, tmp_path / "empty"
    file.write_text("")
    empty.mkdir()
    new = tmp_path / "new"
    assert arguments.existing_file(str(file)) == file
    assert arguments.existing_folder(str(folder)) == folder
    assert arguments.new_folder(str(new)) == new
    assert arguments.new_folder(str(empty)) == empty
    assert arguments.new_file(str(new)) == new
    for parse, path, message in (
        (arguments.existing_file, folder, "must be a file, .* is a folder"),
        (arguments.existing_file, new, "must be a file, .* does not exist"),
        (arguments.existing_folder, file, "must be a folder, .* is a file"),
        (arguments.existing_folder, new, "must be a folder, .* does not exist"),
        (arguments.new_folder, folder, "exists and is not overwritten: choose another folder"),
        (arguments.new_folder, file, "exists and is not overwritten: choose another folder"),
        (arguments.new_file, file, "exists and is not overwritten: choose another"),
    ):
        with pytest.raises(argparse.ArgumentTypeError, match=message):
            parse(str(path))


@pytest.mark.parametrize("kind", [Path, arguments.existing_folder, arguments.new_folder])
def test_an_empty_path_is_not_the_current_folder(kind, capsys):
    parser = arguments.Parser(prog="evaluate")
    parser.add_argument("--output", type=kind)
    with pytest.raises(SystemExit) as stop:
        parser.parse_args(["--output", ""])
    assert stop.value.code == 2
    line = "evaluate: error: argument --output: must be a path, got '': . is the current folder\n"
    assert capsys.readouterr() == ("", line)


def test_a_mistake_is_one_line(capsys):
    parser = arguments.Parser(prog="evaluate", description="Long text.")
    parser.add_argument("--episodes", type=arguments.episodes)
    with pytest.raises(SystemExit) as stop:
        parser.parse_args(["--episodes", "0"])
    assert stop.value.code == 2
    assert capsys.readouterr() == (
        "",
        "evaluate: error: argument --episodes: must be a whole number from 1 to 100000, got '0'\n",
    )
