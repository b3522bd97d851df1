"""Curves of trainings from their logs."""

from __future__ import annotations

import pytest
from torch.utils.tensorboard import SummaryWriter

from recipes.results.learning_curves import PANELS, main, read_run


@pytest.fixture
def run(tmp_path):
    """A training whose evaluations come after 60 and 180 seconds."""
    folder = tmp_path / "seed0"
    writer = SummaryWriter(str(folder / "log_tensorboard"))
    writer.add_scalar("train/updates", 0, 0, walltime=1000.0)
    for tag in PANELS:
        for step, seconds in ((24_000, 60.0), (48_000, 180.0)):
            writer.add_scalar(tag, seconds / 2, step, walltime=1000.0 + seconds)
    writer.close()
    return folder


def test_minutes_and_values(run):
    start = read_run(run)["eval/success"][0][0]
    # The file itself is opened now, long after the events' invented times.
    minutes, values = read_run(run)["eval/time/efficiency"]
    assert minutes[1] - minutes[0] == pytest.approx(2.0)
    assert minutes[0] == start
    assert values == [30.0, 90.0]


def test_picture_is_written_once(run, tmp_path, capsys):
    picture = tmp_path / "curves.png"
    main([str(run), "--output", str(picture)])
    assert picture.stat().st_size > 10_000
    with pytest.raises(SystemExit):
        main([str(run), "--output", str(picture)])
    assert "is not overwritten" in capsys.readouterr().err


def test_folder_without_a_log_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main([str(tmp_path), "--output", str(tmp_path / "curves.png")])
    assert "has no evaluations" in capsys.readouterr().err
