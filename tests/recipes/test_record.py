"""What of a training is finished, and who works on it."""

from __future__ import annotations

import json

import pytest

from recipes.record import Record, lock, unfinished


def test_a_record_is_what_was_saved(tmp_path):
    record = Record(tmp_path, {"drex": ["seed=1"], "episodes": 5})
    record.begin("D-REX", ["recipes.drex.drex", "seed=1"], "drex")
    read = Record.load(tmp_path)
    assert read == record
    assert read.folder_of("D-REX") == tmp_path / "drex"
    assert not read.is_finished("D-REX") and not read.is_finished("PD-MORL")
    assert read.folder_of("PD-MORL") is None
    record.finish("D-REX", 1.5)
    assert Record.load(tmp_path).is_finished("D-REX")
    assert [path.name for path in tmp_path.iterdir()] == ["stages.json"]


@pytest.mark.parametrize(
    "content", ["", "[]", "{}", '{"options": [], "stages": {}, "finished": false}', "[" * 100_000]
)
def test_a_record_that_cannot_be_read_is_named(content, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "stages.json").write_text(content)
    with pytest.raises(ValueError, match=r"stages\.json cannot be read: "):
        Record.load(tmp_path / "run")
    assert unfinished(tmp_path) is None


def test_the_latest_unfinished_training_that_nobody_works_on(tmp_path):
    assert unfinished(tmp_path) is None
    for name, finished in (("1", False), ("2", False), ("3", True)):
        (tmp_path / name).mkdir()
        content = {"options": {}, "stages": {}, "finished": finished}
        (tmp_path / name / "stages.json").write_text(json.dumps(content))
    assert unfinished(tmp_path) == tmp_path / "2"
    with lock(tmp_path / "2"):
        assert lock(tmp_path / "2") is None
        assert unfinished(tmp_path) == tmp_path / "1"
    assert unfinished(tmp_path) == tmp_path / "2"
