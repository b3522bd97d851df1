"""A run folder that somebody else has made: a resume refuses it in one line, and nothing outside is touched."""

from __future__ import annotations

import json
import os
import shutil
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from recipes.pd_morl import pd_morl
from recipes.record import Record, lock, to_resume, unfinished
from recipes.training.checkpoint import Counters
from recipes.training.foreign import refuse_foreign
from recipes.training.run_folder import is_over, score
from tests._command import run_here

from .test_checkpoint_pickles import TINY, resume


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("hostile") / "run"
    run_here(pd_morl.main, *TINY, f"hydra.run.dir={folder}")
    return folder


def checkpoint(run: Path) -> Path:
    (found,) = (run / "checkpoints").glob("checkpoint-*")
    return found


def part(run: Path, name: str) -> Path:
    """The folder of a component."""
    manifest = json.loads((checkpoint(run) / "manifest.json").read_text())
    return checkpoint(run) / manifest["components"][name]["path"]


def state(name: str, text: str) -> Callable[[Path], None]:
    return lambda run: (part(run, name) / "state.json").write_text(text)


def tensors(name: str, data: bytes) -> Callable[[Path], None]:
    return lambda run: (part(run, name) / "state.safetensors").write_bytes(data)


def header(said: dict, size: int | None = None) -> bytes:
    text = json.dumps(said).encode()
    return struct.pack("<Q", len(text) if size is None else size) + text


def manifest(change: Callable[[dict], object]) -> Callable[[Path], None]:
    def spoil(run: Path) -> None:
        file = checkpoint(run) / "manifest.json"
        values = json.loads(file.read_text())
        file.write_text(json.dumps(change(values) or values))

    return spoil


def raw_manifest(text: str) -> Callable[[Path], None]:
    return lambda run: (checkpoint(run) / "manifest.json").write_text(text)


def component(**entries: object) -> Callable[[Path], None]:
    return manifest(lambda values: values["components"]["loss"].update(entries))


def count(**numbers: object) -> Callable[[Path], None]:
    def spoil(run: Path) -> None:
        file = part(run, "count") / "state.json"
        values = json.loads(file.read_text())
        values["dict"] = [[k, numbers.get(k, v)] for k, v in values["dict"] if k not in ("gone",)]
        file.write_text(json.dumps(values))

    return spoil


def elsewhere(inside: str, target: str = "victim") -> Callable[[Path], None]:
    """What lies there is a link to a folder or a file of the user."""

    def spoil(run: Path) -> None:
        place = run / inside
        if place.is_dir():
            shutil.rmtree(place)
        else:
            place.unlink(missing_ok=True)
        place.symlink_to(run.parent / target)

    return spoil


def kind(inside: str, make: Callable[[Path], None]) -> Callable[[Path], None]:
    def spoil(run: Path) -> None:
        place = next(iter(run.glob(inside)))
        place.unlink()
        make(place)

    return spoil


def archive(run: Path) -> None:
    """Of which nobody knows how large it is inside."""
    folder = checkpoint(run)
    with zipfile.ZipFile(run / "checkpoints" / "checkpoint-999999999999.torchrl", "w") as file:
        for path in folder.rglob("*"):
            file.write(path, path.relative_to(folder))


def link_to_zero(path: Path) -> None:
    path.symlink_to("/dev/zero")


def link_to_itself(path: Path) -> None:
    path.symlink_to(path.name)


STATE = "checkpoints/*/**/state.json"
HOSTILE = {
    "checkpoints elsewhere": elsewhere("checkpoints"),
    "policies elsewhere": elsewhere("policies"),
    "a log elsewhere": elsewhere("log_csv"),
    "pictures elsewhere": elsewhere("pictures"),
    "the configuration elsewhere": elsewhere(".hydra/config.yaml", "victim/.ssh/key"),
    "run.json elsewhere": elsewhere("run.json", "victim/.ssh/key"),
    "a state that is a pipe": kind(STATE, os.mkfifo),
    "tensors that are a pipe": kind("checkpoints/*/**/state.safetensors", os.mkfifo),
    "a manifest that is a pipe": kind("checkpoints/*/manifest.json", os.mkfifo),
    "run.json is a pipe": kind("run.json", os.mkfifo),
    "a log that is a pipe": kind("log_csv/scalars/**/*.csv", os.mkfifo),
    "a card that is a pipe": kind("policies/*/policy.json", os.mkfifo),
    "a state without an end": kind(STATE, link_to_zero),
    "a state that is a loop of links": kind(STATE, link_to_itself),
    "a state as deep as memory": state("loss", "[" * 200_000),
    "a state of braces": state("loss", '{"dict":' * 100_000),
    "a state that is empty": state("loss", ""),
    "a state that is a list": state("loss", "[]"),
    "a state that is a number": state("loss", "1"),
    "a state of NaN": state("loss", "NaN"),
    "a state of 5000 digits": state("loss", "9" * 5000),
    "a state of another kind": state("loss", '{"pickle": "000000"}'),
    "a state of two kinds": state("loss", '{"dict": [], "list": []}'),
    "a state of no kind": state("loss", "{}"),
    "tensors that are not there": state("loss", '{"tensor": "999999"}'),
    "keys that are no keys": state("loss", '{"dict": [[{"list": []}, 1]]}'),
    "entries that are no pairs": state("loss", '{"dict": [[1], [2, 3, 4]]}'),
    "no tensors": tensors("loss", b""),
    "a header of 2**62 bytes": tensors("loss", header({}, 2**62)),
    "a tensor of four terabytes": tensors(
        "loss",
        header({"000000": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}}),
    ),
    "a tensor of a negative size": tensors(
        "loss", header({"000000": {"dtype": "F32", "shape": [-1], "data_offsets": [0, 4]}})
    ),
    "other tensors": tensors("loss", header({})),
    "generators that are none": state("generators", '{"dict": [["torch_cpu", 7]]}'),
    "the state of a list for a collector": state("collector", '{"list": []}'),
    "a buffer that is none": state("replay_buffer", '{"dict": []}'),
    "a count below zero": count(frames=-(10**18)),
    "a count that is no number": count(frames=float("nan")),
    "a count that is text": count(frames="many"),
    "a count that is true": count(updates=True),
    "another adapter": component(adapter="torchrl.state_dict"),
    "a component elsewhere": component(path="../../../victim"),
    "a component at the root": component(path="/etc"),
    "a component that is none": manifest(lambda v: v["components"].update(loss=[])),
    "no components": manifest(lambda v: v.update(components=[])),
    "a component less": manifest(lambda v: v["components"].pop("loss") and None),
    "a manifest that is a list": raw_manifest("[]"),
    "a manifest that is a number": raw_manifest("7"),
    "a manifest as deep as memory": raw_manifest("[" * 200_000),
    "a manifest of the future": manifest(lambda v: v.update(format_version=10**6)),
    "an archive": archive,
    "a number that is none": lambda run: checkpoint(run).rename(run / "checkpoints/checkpoint-²"),
    "checkpoints that are a file": lambda run: (
        shutil.rmtree(run / "checkpoints"),
        (run / "checkpoints").write_text(""),
    ),
    "overrides of a date": lambda run: (run / ".hydra/overrides.yaml").write_text("- 2001-99-99"),
    "overrides as deep as memory": lambda run: (run / ".hydra/overrides.yaml").write_text(
        "[" * 100_000
    ),
    "overrides of 2 MB": lambda run: (run / ".hydra/overrides.yaml").write_text(
        "- a=1\n" * 400_000
    ),
    "overrides that repeat themselves": lambda run: (run / ".hydra/overrides.yaml").write_text(
        "- &a [x]\n- &b [*a, *a, *a]\n- [*b, *b, *b]\n"
    ),
    "run.json as deep as memory": lambda run: (run / "run.json").write_text("[" * 200_000),
    "run.json is a list": lambda run: (run / "run.json").write_text("[]"),
}


def everything(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_resume_refuses_it_in_one_line(name, trained, tmp_path, capsys):
    victim = tmp_path / "victim"
    (victim / ".ssh").mkdir(parents=True)
    (victim / ".ssh" / "key").write_text("mine")
    (victim / "checkpoint-1").mkdir()
    (victim / "checkpoint-1" / "mine").write_text("mine")
    before = everything(victim)
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    HOSTILE[name](run)
    with pytest.raises(SystemExit) as stop:
        resume(run)
    assert stop.value.code in (1, 2)
    *_, line = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ") and str(run) in line and len(line) < 900
    assert everything(victim) == before


def test_links_within_a_run_and_to_the_run_are_left_alone(tmp_path):
    run = tmp_path / "run"
    (run / "wandb").mkdir(parents=True)
    (run / "wandb" / "latest").symlink_to("../wandb")
    (tmp_path / "link").symlink_to("run")
    refuse_foreign(run)
    refuse_foreign(tmp_path / "link")


RECORD = '{"options": {}, "stages": {}, "finished": false}'


@pytest.mark.parametrize(
    "content",
    [
        '{"options": {}, "stages": {"D-REX": {"folder": ".."}}, "finished": false}',
        '{"options": {}, "stages": {"D-REX": {"folder": "a\\u0000b"}}, "finished": false}',
        '{"options": {}, "stages": {"D-REX\\n": {"folder": "."}}, "finished": false}',
        '{"options": {}, "stages": {}, "finished": "no"}',
        '{"options": {}, "stages": {}, "finished": 0}',
    ],
)
def test_a_record_that_leads_elsewhere_is_refused(content, tmp_path):
    (tmp_path / "stages.json").write_text(content)
    with pytest.raises(ValueError, match=r"stages\.json cannot be read: ") as refused:
        to_resume(tmp_path)
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize("name", ["mo_ppo", "stages.json", ".lock", "drex"])
def test_a_training_in_stages_goes_on_in_files_of_its_own(name, tmp_path):
    mine, run = tmp_path / "mine", tmp_path / "runs" / "theirs"
    mine.write_text(RECORD)
    run.mkdir(parents=True)
    (run / "stages.json").write_text(RECORD)
    (run / name).unlink(missing_ok=True)
    (run / name).symlink_to(mine)
    with pytest.raises(ValueError, match=r"is a link out of the folder, to .*mine"):
        to_resume(run)


def test_a_lock_empties_no_file_of_others(tmp_path):
    mine, run = tmp_path / "mine", tmp_path / "runs" / "theirs"
    mine.write_text("mine")
    run.mkdir(parents=True)
    (run / ".lock").symlink_to(mine)
    with pytest.raises(ValueError, match=r"\.lock is a link, where a training has a file"):
        lock(run)
    (run / "stages.json").write_text(RECORD)
    assert unfinished(tmp_path / "runs") is None  # a new training looks at those beside it
    assert mine.read_text() == "mine"
    (run / ".lock").unlink()
    os.mkfifo(run / ".lock")
    with lock(run):
        assert lock(run) is None


def test_counters_take_what_they_count():
    counters = Counters(frames=0, score=float("nan"))
    counters.load_state_dict({"frames": 96, "score": float("nan")})
    for wrong in ({"frames": -1}, {"frames": 1.0}, {"frames": True}, {"frames": 10**30, "more": 1}):
        with pytest.raises(ValueError, match="it must say frames, score, it says"):
            counters.load_state_dict({"score": 0.0, **wrong})
    assert counters.frames == 96


def test_a_checkpoint_with_a_number_that_is_none_is_no_end(tmp_path):
    (tmp_path / "checkpoints" / "checkpoint-²").mkdir(parents=True)
    assert not is_over(tmp_path)


@pytest.mark.parametrize("value", ["NaN", "Infinity", "1e999"])
def test_a_score_is_a_number(value, tmp_path):
    (tmp_path / "policy.json").write_text('{"card": {"score": ' + value + "}}")
    with pytest.raises(ValueError, match=r"policy\.json does not say the score of the policy"):
        score(tmp_path)


def test_a_record_of_a_command_is_still_taken(tmp_path):
    record = Record(tmp_path, {})
    record.begin("D-REX", ["recipes.drex.drex"], "drex")
    assert to_resume(tmp_path) == record
