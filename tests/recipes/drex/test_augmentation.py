"""Clones of one to many demonstrations: what the study measures, and its command line."""

from __future__ import annotations

import sys

import pytest
import torch
from tensordict import TensorDictBase

from recipes.drex import augmentation
from recipes.drex.cards import metadata
from recipes.drex.demonstrations import collect_demonstrations, demonstrated, demonstrator
from recipes.drex.rollouts import mean_and_error
from tests._drex import TINY, config
from torchrl_morl.data import save_demonstrations


@pytest.fixture(scope="module")
def demonstrations() -> TensorDictBase:
    return collect_demonstrations(config(overrides=TINY))


@pytest.fixture
def file(demonstrations, tmp_path):
    cfg = config(overrides=TINY)
    return save_demonstrations(
        tmp_path / "demonstrations.safetensors", demonstrations, metadata(cfg)
    )


def run(monkeypatch, *args: object) -> None:
    monkeypatch.setattr(sys, "argv", ["augmentation", *map(str, args)])
    augmentation.main()


def test_a_perfect_clone_is_measured_as_such(demonstrations, monkeypatch):
    """It drives as demonstrated: 0 m off, and there where no box stands in its way."""
    cfg = config(overrides=TINY)
    counts = []

    def clone(cfg, data):
        counts.append(len(data))
        return demonstrator(cfg), 0.0

    monkeypatch.setattr(augmentation, "clone_behaviour", clone)
    results = augmentation.study(cfg, demonstrations, [1, 4], 12)
    assert counts == [1, 4]
    free = demonstrated(cfg, 12, cfg.seed + 40_000)["free"]
    assert 2 < free.sum() < 12
    for row in range(2):
        assert torch.equal(results["success"][row].bool(), free)
        # What is left is the goal radius, 0.3 m of 6 to 12 m, and up to a step.
        paid = results["core"][row]
        assert ((paid[free] > 0.93) & (paid[free] < 1.0)).all()
        assert paid[~free].max() < 0.5
        assert results["frechet"][row].shape == (free.sum(),)
        assert results["frechet"][row].max() < 1e-4
    line = augmentation.table([1, 4], results).splitlines()[-1]
    assert line.split()[0] == "4"
    mean, error = mean_and_error(free.float())
    assert line.endswith(f"{mean:.2f} +- {error:.2f}")


def test_from_one_demonstration_on(file, monkeypatch, tmp_path, capsys):
    output = tmp_path / "augmentation"
    args = (file, "--output", output, "--counts", 1, 6, "--scenes", 6)
    run(monkeypatch, *args)
    printed = capsys.readouterr()
    assert [line.split()[0] for line in printed.out.splitlines()[-3:-1]] == ["1", "6"]
    assert "core (n = 6)" in printed.out
    assert "2/2" in printed.err  # the progress bar
    picture = output / "augmentation.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
    before = picture.stat().st_mtime_ns
    with pytest.raises(SystemExit):
        run(monkeypatch, *args)
    assert "augmentation.png exists and is not overwritten" in capsys.readouterr().err
    assert picture.stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--counts", 1, 7), "--counts must be from 1 to 6, got 7"),
        (("--counts", 0), "--counts must be from 1 to 6, got 0"),
        (("--scenes", 1), "--scenes must be at least 2, for a standard error, got 1"),
        ((), "--counts must be from 1 to 6, got 10"),
    ],
)
def test_bad_options_are_one_message(file, options, message, monkeypatch, tmp_path, capsys):
    with pytest.raises(SystemExit):
        run(monkeypatch, file, "--output", tmp_path / "augmentation", *options)
    assert message in capsys.readouterr().err
    assert not (tmp_path / "augmentation").exists()


def test_files_that_it_cannot_use(demonstrations, monkeypatch, tmp_path, capsys):
    imported = save_demonstrations(tmp_path / "imported.safetensors", demonstrations, {})
    for file, message in (
        (imported, "was not written by recipes.drex.drex"),
        (tmp_path / "nowhere.safetensors", "nowhere.safetensors not found"),
    ):
        with pytest.raises(SystemExit):
            run(monkeypatch, file, "--output", tmp_path / "augmentation")
        assert message in capsys.readouterr().err
