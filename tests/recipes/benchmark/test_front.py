"""Fronts: their file, their indicators by hand, and the command that draws them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from recipes.benchmark.front import main
from recipes.benchmark.fronts import Front, read_front
from recipes.benchmark.lattice import lattice
from torchrl_morl import PreferenceSpace


def front(size: int, shift: float = 0.0) -> Front:
    names = ("fast", "high", "sparing", "quiet", "smooth")[:size]
    preferences = lattice(PreferenceSpace(names), 15).double().numpy()
    returns = 100 * np.sqrt(preferences) + shift
    return Front(names, preferences, returns, returns / 10)


def test_a_front_comes_back_as_it_was(tmp_path):
    written = front(3)
    written.write(tmp_path / "new" / "front.csv")
    read = read_front(tmp_path / "new" / "front.csv")
    assert read.objectives == written.objectives
    for name in ("preferences", "returns", "discounted"):
        np.testing.assert_allclose(getattr(read, name), getattr(written, name), rtol=1e-8)


def test_indicators_by_hand():
    preferences = np.array([[1.0, 0.0], [0.5, 0.5], [0.0, 1.0]])
    # Under the middle preference it does worse than at either end.
    returns = np.array([[4.0, 0.0], [1.0, 1.0], [0.0, 2.0]])
    found = Front(("a", "b"), preferences, returns, 2 * returns).indicators((0.0, 0.0))
    assert found["hypervolume"] == 1.0  # the other two touch the reference
    assert found["commanded_utility"] == pytest.approx((4 + 1 + 2) / 3)
    assert found["expected_utility"] == pytest.approx((4 + 2 + 2) / 3)
    assert found["non_dominated"] == 3
    assert found["sparsity"] == pytest.approx((1 + 9 + 1 + 1) / 2)
    assert found["steerability/a"] == pytest.approx(1.0)
    assert found["steerability/b"] == pytest.approx(1.0)
    later = Front(("a", "b"), preferences, returns, 2 * returns).indicators((0, 0), discounted=True)
    assert later["hypervolume"] == 4.0


def test_a_policy_that_its_preference_does_not_steer_shows():
    preferences = np.array([[1.0, 0.0], [0.5, 0.5], [0.0, 1.0]])
    turned = Front(("a", "b"), preferences, preferences[::-1].copy(), preferences)
    found = turned.indicators((-1.0, -1.0))
    assert found["steerability/a"] == pytest.approx(-1.0)
    assert found["commanded_utility"] < found["expected_utility"]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "a,b\n1,2\n",
        "preference_a,return_a,discounted_a,non_dominated\n1,2,3\n",
        "preference_a,return_a,discounted_a,non_dominated\n1,x,3,1\n",
        "preference_a,return_a,discounted_a,non_dominated\n1,nan,3,1\n",
    ],
)
def test_what_is_no_front_is_refused_in_one_line(text, tmp_path):
    file = tmp_path / "front.csv"
    file.write_text(text)
    with pytest.raises(ValueError, match="is no front") as refused:
        read_front(file)
    assert "\n" not in str(refused.value)


def run(folder: Path, size: int, seed: int = 0, reference: object = -100) -> Path:
    front(size, shift=seed).write(folder / "front.csv")
    config = {
        "algorithm": "pd_morl",
        "env": "mo-hopper-v5",
        "seed": seed,
        "evaluation": {"reference": reference, "discounted": False},
    }
    (folder / ".hydra").mkdir()
    (folder / ".hydra" / "config.yaml").write_text(yaml.safe_dump(config))
    return folder


@pytest.mark.parametrize("size", [2, 3, 4, 5])
def test_the_front_of_a_run_is_drawn(size, tmp_path, capsys):
    picture = tmp_path / "front.png"
    main([str(run(tmp_path / "run", size)), "--output", str(picture)])
    printed = capsys.readouterr().out
    assert f"hypervolume: {', '.join(['-100'] * size)}." in printed
    assert "sparsity (misleading)" in printed and "| pd_morl, seed 0 |" in printed
    pixels = np.asarray(Image.open(picture).convert("RGB")).reshape(-1, 3)
    # Points in the colours of the weight, from dark violet to yellow.
    for color in ((68, 1, 84), (253, 231, 37)):
        assert (np.abs(pixels.astype(int) - color).max(1) <= 2).any()
    with pytest.raises(SystemExit):
        main([str(tmp_path / "run"), "--output", str(picture)])
    assert "exists and is not overwritten" in capsys.readouterr().err


def test_several_runs_and_the_folder_of_a_multirun(tmp_path, capsys):
    for seed in range(3):
        run(tmp_path / "many" / str(seed), 2, seed)
    main([str(tmp_path / "many"), "--output", str(tmp_path / "all.png"), "--reference", "0", "-1"])
    printed = capsys.readouterr().out
    assert [f"pd_morl, seed {seed}" in printed for seed in range(3)] == [True] * 3
    assert "hypervolume: 0, -1." in printed


def test_mistakes_are_one_line(tmp_path, capsys):
    two, three = run(tmp_path / "two", 2), run(tmp_path / "three", 3, 1)
    other = run(tmp_path / "other", 2, 2, reference=[0, 0])
    (tmp_path / "empty").mkdir()
    for given, message in (
        ([two, three], "one picture is of one environment"),
        ([two, other], "--reference must be given: the runs have [-100, [0, 0]]"),
        ([tmp_path / "empty"], "has no front.csv"),
        ([two, "--reference", "1", "2", "3"], "--reference must have 2 entries"),
        ([tmp_path / "nothing"], "does not exist"),
    ):
        with pytest.raises(SystemExit) as left:
            main([*map(str, given), "--output", str(tmp_path / "new.png")])
        (line,) = capsys.readouterr().err.splitlines()
        assert left.value.code == 2 and message in line
    assert not (tmp_path / "new.png").exists()
