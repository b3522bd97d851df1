"""The command line of a recipe: what is refused, how it ends, and what it leaves behind."""

from __future__ import annotations

import logging
import sys
import warnings
from pathlib import Path

import pytest
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.objectives import BCLoss

from recipes.training import run_folder
from tests._toy import begun, only_line, run, written
from torchrl_morl.testing import VectorRewardMockEnv

# --- where it runs


def test_every_run_has_a_folder_of_its_own(toy, tmp_path, capsys):
    assert [run(toy) for _ in range(3)] == [0, 0, 0]
    folders = list((tmp_path / "runs" / "toy").iterdir())
    assert len(folders) == 3
    assert all((folder / ".hydra" / "config.yaml").is_file() for folder in folders)
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    "name", ["a b", "ä", "a=b", "a,b", "a(b)", "a'b", 'a"b', "a[b]", "1e3", "a\\b", "a:b", "true"]
)
def test_any_path_works(toy, name, tmp_path):
    (tmp_path / name).write_text("")
    seen = []
    toy.act = lambda cfg: seen.append(cfg.source)
    assert run(toy, f"source={name}", f"hydra.run.dir=out/{name}/run") == 0
    assert seen == [name]
    assert (tmp_path / "out" / name / "run" / ".hydra").is_dir()


@pytest.mark.parametrize("given", ["'a b'", '"a b"'])
def test_what_is_quoted_stays_quoted(toy, given):
    seen = []
    toy.act = lambda cfg: seen.append(cfg.source)
    assert run(toy, f"source={given}") == 0
    assert seen == ["a b"]


def test_a_folder_that_holds_something_is_refused(toy, tmp_path, capsys):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    (tmp_path / "empty").mkdir()
    toy.act = lambda cfg: pytest.fail("it runs")
    assert run(toy, "hydra.run.dir=full") == 2
    line = "error: full/notes.txt exists and is not overwritten: choose another hydra.run.dir."
    assert only_line(capsys) == line
    assert run(toy, "hydra.run.dir=full/notes.txt") == 2
    assert "is not overwritten" in only_line(capsys)
    assert written(tmp_path) == ["full/notes.txt"]
    toy.act = lambda cfg: None
    assert run(toy, "hydra.run.dir=empty") == 0


def test_a_run_may_go_on_in_its_own_folder(toy, tmp_path):
    begun(tmp_path / "run")
    assert run(toy, "resume=run", "hydra.run.dir=run") == 0
    assert run(toy, "resume=run", "hydra.run.dir=run") == 0
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "x").write_text("")
    assert run(toy, "resume=run", "hydra.run.dir=other") == 2


def test_a_run_under_way_is_left_alone(toy, tmp_path, capsys):
    begun(tmp_path / "run")
    before = written(tmp_path)
    toy.act = lambda cfg: pytest.fail("it runs")
    with run_folder.held(tmp_path / "run"):
        assert run(toy, "resume=run") == 2
    assert only_line(capsys) == (
        "error: run is being trained by another process: wait until it ends, or stop it."
    )
    assert written(tmp_path) == before

    def goes_on(cfg):
        busy = pytest.raises(ValueError, match="is being trained by another process")
        with busy, run_folder.held(tmp_path / "run"):
            pytest.fail("two at once")

    toy.act = goes_on
    assert run(toy, "resume=run") == 0
    with run_folder.held(tmp_path / "run"):  # it is free again
        pass


def test_a_new_run_is_held_too(toy, tmp_path):
    def act(cfg):
        busy = pytest.raises(ValueError, match="is being trained by another process")
        with busy, run_folder.held(tmp_path / "new"):
            pytest.fail("two at once")

    toy.act = act
    assert run(toy, "hydra.run.dir=new") == 0


def test_plus_resume_is_resume(toy, tmp_path, capsys):
    begun(tmp_path / "run")
    seen = []
    toy.act = lambda cfg: seen.append(cfg.resume)
    assert run(toy, "+resume=run") == 0
    assert seen == ["run"]
    assert run(toy, "+resume=nowhere") == 2
    assert only_line(capsys).startswith("error: resume=nowhere ")


def test_an_optional_field_is_given_as_any_other(toy):
    seen = []
    toy.act = lambda cfg: seen.append(list(cfg.inner.names))
    assert run(toy, "inner.names=[a,b]") == 0
    assert seen == [["a", "b"]]


def test_a_preset_is_a_group(toy, capsys):
    seen = []
    toy.act = lambda cfg: seen.append(cfg.steps)
    assert run(toy, "+preset=large") == 0
    assert seen == [9]
    assert run(toy, "+preset=larg") == 2
    line = only_line(capsys)
    assert "Could not find 'preset/larg'" in line and line.endswith("large")


# --- what is refused


@pytest.mark.parametrize(
    ("argument", "line"),
    [
        ("steps=0", "steps must be at least 1, got 0."),
        ("stepps=3", "there is no field stepps: did you mean steps?"),
        ("+stepps=3", "there is no field stepps: did you mean steps?"),
        ("size=3", "there is no field size: did you mean inner.size?"),
        ("inner.sizes=3", "there is no field inner.sizes: did you mean inner.size?"),
        ("inner=3", "inner must be a mapping of fields, got 3."),
        ("~steps", "~steps: no field can be left out, null is nothing."),
        ("steps", "'steps' is not field=value; --help lists the fields."),
        ("steps=[1", "steps=[1 cannot be read: "),
        ("steps=1,2", "Ambiguous value for argument 'steps=1,2'"),
        ("--steps", "unrecognized arguments: --steps; fields are given as seed=1"),
        ("steps=${nowhere}", "steps: Interpolation key 'nowhere' not found"),
        ("inner.size=${nowhere}", "inner.size: Interpolation key 'nowhere' not found"),
        ("=3", "'=3' is not field=value; --help lists the fields."),
        ("+=3", "'+=3' is not field=value; --help lists the fields."),
        ("preset=null", "preset=null: preset is one name, one of large."),
        ("preset=", "preset=: preset is one name, one of large."),
        ("preset=[large,large]", "preset=[large,large]: preset is one name, one of large."),
        ("preset=7", "preset=7: preset is one name, one of large."),
        ("hydra.run.dir=", "hydra.run.dir=: it is a folder, which has a name, or . for this one."),
        ("hydra.run.dir=''", "hydra.run.dir='': it is a folder, which has a name"),
        ("hydra.run.dir=null", "hydra.run.dir=null: it is a folder, which has a name"),
        ("--config-name=other", "--config-name must be toy, got 'other'."),
        ("--experimental-rerun=x.pickle", "--experimental-rerun would run a pickle"),
    ],
)
def test_a_mistake_is_one_line_and_writes_nothing(toy, argument, line, tmp_path, capsys):
    toy.act = lambda cfg: pytest.fail("it runs")
    assert run(toy, argument) == 2
    printed = only_line(capsys)
    assert printed.startswith("error: ") and line in printed
    assert written(tmp_path) == []
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("debug", [("--debug",), ()])
def test_the_traceback_is_shown_to_those_who_ask(toy, debug, monkeypatch):
    if not debug:
        monkeypatch.setenv("HYDRA_FULL_ERROR", "1")

    def act(cfg):
        raise ValueError("no")

    toy.act = act
    with pytest.raises(ValueError, match=r"^no$"):
        run(toy, *debug)
    with pytest.raises(ValueError, match="steps must be at least 1"):
        run(toy, "steps=0", *debug)


def test_what_a_recipe_refuses_before_it_writes_leaves_no_folder(toy, tmp_path, capsys):
    def act(cfg):
        raise ValueError("the policy has\nother objectives")

    toy.act = act
    assert run(toy) == 2
    assert only_line(capsys) == "error: the policy has other objectives"
    assert not (tmp_path / "runs").exists()
    (tmp_path / "mine").mkdir()
    assert run(toy, "hydra.run.dir=mine") == 2
    # A folder that was there stays, and can be used.
    assert (tmp_path / "mine").is_dir() and written(tmp_path) == []
    toy.act = lambda cfg: None
    assert run(toy, "hydra.run.dir=mine") == 0


def test_our_own_mistakes_keep_their_traceback(toy):
    def act(cfg):
        raise KeyError("a bug")

    toy.act = act
    with pytest.raises(KeyError):
        run(toy)


def write_and_raise(error: BaseException):
    def act(cfg):
        from hydra.core.hydra_config import HydraConfig

        Path(HydraConfig.get().runtime.output_dir, "run.json").write_text("{}")
        raise error

    return act


@pytest.mark.parametrize(
    ("error", "parts"),
    [
        (
            OSError(28, "No space left on device", "run/x"),
            ["run/x: No space left", "MB are free", "free some space"],
        ),
        (OSError(28, "No space left on device"), ["out: No space left", "MB are free"]),
        (RuntimeError("PytorchStreamWriter failed writing file"), ["out: No space left"]),
        (
            PermissionError(13, "Permission denied", "out/x"),
            ["out/x: Permission denied: choose a folder"],
        ),
        (OSError(30, "Read-only file system", "out/x"), ["out/x: Read-only file system: choose"]),
        (ValueError("actions must be finite"), ["actions must be finite; --debug shows where"]),
        (ValueError("they must not differ."), ["they must not differ; --debug shows where"]),
    ],
)
def test_what_fails_while_it_runs_is_one_line_and_keeps_what_is_written(
    toy, error, parts, tmp_path, capsys
):
    toy.act = write_and_raise(error)
    assert run(toy, "hydra.run.dir=out") == 1
    line = only_line(capsys)
    assert all(part in line for part in parts), line
    assert "out/run.json" in written(tmp_path)


def test_a_folder_that_vanishes_is_named(toy, tmp_path, capsys):
    import shutil

    def act(cfg):
        for _ in toy.command.until_stopped(range(cfg.steps)):
            shutil.rmtree(tmp_path / "out", ignore_errors=True)
            (tmp_path / "out" / "scalars.csv").write_text("")

    toy.act = act
    assert run(toy, "hydra.run.dir=out") == 1
    assert "out/scalars.csv: the run folder out has vanished" in only_line(capsys)


# --- several runs at once


def test_a_multirun_checks_all_its_jobs_before_the_first(toy, tmp_path, capsys):
    seen = []
    toy.act = lambda cfg: seen.append(cfg.steps)
    assert run(toy, "--multirun", "steps=1,2", "inner.size=3") == 0
    assert seen == [1, 2]
    (folder,) = (tmp_path / "runs" / "toy").iterdir()
    assert sorted(path.name for path in folder.iterdir() if path.is_dir()) == ["0", "1"]
    printed = capsys.readouterr()
    assert printed.err == ""
    assert [line.split(" ->")[0] for line in printed.out.splitlines()] == [
        f"--- job {number}: steps={number + 1} inner.size=3" for number in range(2)
    ]
    assert run(toy, "-m", "steps=1,0") == 2
    assert only_line(capsys) == "error: steps must be at least 1, got 0."
    assert len(list((tmp_path / "runs" / "toy").iterdir())) == 1


@pytest.mark.parametrize(
    "given",
    [
        ("--multirun", "resume=begun"),
        ("-m", "resume=begun,begun"),
        ("-m", "steps=1,2", "resume=nowhere"),
        ("hydra.mode=MULTIRUN", "resume=begun"),
    ],
)
def test_a_multirun_goes_on_with_nothing(toy, given, tmp_path, capsys):
    begun(tmp_path / "begun")
    before = written(tmp_path)
    assert run(toy, *given) == 2
    (resume,) = (one for one in given if one.startswith("resume"))
    line = only_line(capsys)
    assert "resume=" in line and line.endswith(
        "goes on with one run, where it is: leave out --multirun."
    )
    assert resume.split(",")[0][:12] in line
    assert written(tmp_path) == before


@pytest.mark.parametrize("value", ["5", "[begun]", "{begun: 1}", "true", "begun,begun", "glob(*)"])
def test_what_is_no_folder_of_a_run_is_refused(toy, value, tmp_path, capsys):
    begun(tmp_path / "begun")
    assert run(toy, f"resume={value}") == 2
    assert "resume" in only_line(capsys)
    assert not (tmp_path / "runs").exists()


def test_a_multirun_of_no_job_says_so(toy, tmp_path, capsys):
    assert run(toy, "-m", "steps=range(3,1)") == 2
    assert only_line(capsys) == "error: --multirun steps=range(3,1): that is no run at all."
    assert not (tmp_path / "runs").exists()


def test_a_run_folder_below_a_file_is_refused(toy, tmp_path, capsys):
    (tmp_path / "mine").write_text("mine")
    assert run(toy, "hydra.run.dir=mine/run") == 2
    assert "mine" in only_line(capsys)
    assert (tmp_path / "mine").read_text() == "mine"


@pytest.mark.parametrize("given", [[], ["hydra.run.dir=new/deep/er"]])
def test_a_start_that_its_recipe_refuses_leaves_no_folders(toy, given, tmp_path, capsys):
    def refuse(cfg):
        raise ValueError("not so")

    toy.act = refuse
    before = sorted(tmp_path.rglob("*"))
    assert run(toy, *given) == 2
    assert capsys.readouterr().err == "error: not so\n"
    assert [
        path
        for path in sorted(tmp_path.rglob("*"))
        if path not in before and "preset" not in str(path) and "__pycache__" not in str(path)
    ] == []
    (tmp_path / "runs" / "toy").mkdir(parents=True)  # those of the user stay
    (tmp_path / "new").mkdir()
    assert run(toy, *given) == 2
    assert sorted(path.name for path in tmp_path.iterdir() if "Käfer" not in path.name) == [
        "new",
        "runs",
    ]
    assert list((tmp_path / "new").iterdir()) == [] and [
        path.name for path in (tmp_path / "runs").iterdir()
    ] == ["toy"]


# --- what it prints


def test_help_lists_every_field(toy, tmp_path, capsys):
    assert run(toy, "--help") == 0
    text = capsys.readouterr().out
    assert "Toy: counts." in text and "More about it" not in text
    for name, default, sentence, allowed in (
        ("steps", "3", "Steps to take.", "a whole number at least 1"),
        ("source", "null", "File to read.", "a file, or null"),
        ("inner.size", "1", "Size of it, metres.", "a whole number at least 1"),
        ("inner.names", "null", "Names of it.", "a list, each a text, or null"),
    ):
        assert f"  {name}={default}\n      {sentence} ({allowed})\n" in text
    assert "preset=" in text and "hydra.run.dir" in text and "--debug" in text
    assert "python -m toy --multirun seed=0,1,2" in text
    assert written(tmp_path) == [] and not (tmp_path / "runs").exists()


@pytest.mark.parametrize("what", ["job", "hydra"])
def test_to_show_the_configuration_makes_no_folder(toy, what, tmp_path, capsys):
    assert run(toy, "--cfg", what, "--resolve", "steps=7") == 0
    assert ("steps: 7" if what == "job" else "runs/toy/") in capsys.readouterr().out
    assert not (tmp_path / "runs").exists()


def test_torchrl_notes_are_left_out_and_its_warnings_are_not(toy):
    logger, seen = logging.getLogger("torchrl"), []
    before = logger.level
    toy.act = lambda cfg: seen.extend(map(logger.isEnabledFor, (logging.INFO, logging.WARNING)))
    assert run(toy) == 0
    assert seen == [False, True]
    assert logger.level == before


@pytest.mark.parametrize("debug", [False, True])
def test_warnings_are_a_line_each(toy, debug, capsys, recwarn):
    def act(cfg):
        shown = warnings.formatwarning("much\n  more", UserWarning, "/lib/file.py", 3)
        print(shown, end="", file=sys.stderr)

    toy.act = act
    assert run(toy, *(["--debug"] if debug else [])) == 0
    printed = capsys.readouterr().err
    assert printed == "warning: much more\n" or (debug and "/lib/file.py:3" in printed)
    assert warnings.formatwarning("x", UserWarning, "/lib/file.py", 3).startswith("/lib/file.py")


def test_what_libraries_say_to_each_other_is_left_out_and_nothing_else(toy, recwarn, monkeypatch):
    """The first are raised where the libraries raise them."""

    def act(cfg):
        network = TensorDictModule(nn.Linear(1, 1), ["observation"], ["action"])
        BCLoss(network, loss_function="l2")
        env = VectorRewardMockEnv(2, batch_size=(2,))
        Collector(env, frames_per_batch=4, total_frames=6).shutdown()
        Collector(env, frames_per_batch=5, total_frames=10).shutdown()

    toy.act = act
    monkeypatch.setattr("torchrl.collectors._single.RL_WARNINGS", True)  # off in our tests
    warnings.simplefilter("always", UserWarning)  # not those of pyproject.toml for these modules
    assert run(toy) == 0
    said = [str(one.message).split()[0] for one in recwarn if one.category is UserWarning]
    assert said == ["frames_per_batch"]


def test_a_recipe_takes_a_configuration_as_an_argument(toy):
    seen = []
    toy.act = seen.append
    toy.main({"steps": 1})
    assert seen == [{"steps": 1}]
