"""Small files of run folders that somebody else has written: whatever they say is one line, or nothing."""

from __future__ import annotations

from pathlib import Path

import pytest

from recipes.benchmark.front import configuration
from recipes.benchmark.train import asked_for
from recipes.results.runs import read_run
from torchrl_morl.choices import PreferencePosterior

TEXTS = [
    b"",
    b"[]",
    b"7",
    b"[" * 200_000,
    b'{"a":' * 100_000,
    b"- 2001-99-99",
    b"\xff\xfe",
    b"\0",
    b"!!python/object/apply:os.system [true]",
    b"9" * 5000,
    b"&a [*a]",
]
NAMES = [text[:12].decode("latin-1").encode("unicode-escape").decode() for text in TEXTS]


@pytest.fixture(params=TEXTS, ids=NAMES)
def text(request) -> bytes:
    return request.param


def put(file: Path, text: bytes) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(text)
    return file


def test_what_a_run_was_configured_as(text, tmp_path):
    put(tmp_path / ".hydra" / "config.yaml", text)
    assert configuration(tmp_path) == {}


def test_which_algorithm_goes_on(text, tmp_path):
    put(tmp_path / ".hydra" / "overrides.yaml", text)
    assert asked_for([f"resume={tmp_path}"]) == "pd_morl"


def test_the_card_of_a_run(text, tmp_path):
    put(tmp_path / "policies" / "000000001" / "policy.json", text)
    with pytest.raises(ValueError, match=r"policy\.json is no card of a training") as refused:
        read_run(tmp_path, "last")
    assert len(str(refused.value).splitlines()) == 1


def test_the_overrides_of_a_run(text, tmp_path):
    card = b'{"card": {"score": 1.0}}'
    put(tmp_path / "policies" / "000000001" / "policy.json", card)
    put(tmp_path / ".hydra" / "overrides.yaml", text)
    if text == b"[]":
        assert read_run(tmp_path, "last").setting == ()
        return
    with pytest.raises(ValueError, match=r"overrides\.yaml (cannot be read|is no list of)") as no:
        read_run(tmp_path, "last")
    assert len(str(no.value).splitlines()) == 1


def test_answers(text, tmp_path):
    file = put(tmp_path / "answers.json", text)
    with pytest.raises(ValueError, match=r"answers\.json: ") as refused:
        PreferencePosterior.load(file)
    assert len(str(refused.value).splitlines()) == 1
