"""The D-REX recipe on recorded demonstrations: a file instead of the scripted circle."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import torch
from torch.testing import assert_close

from recipes.drex import augmentation, drex, styles
from recipes.drex.demonstrations import demonstrator
from recipes.drex.recorded import distance_from_recorded
from recipes.drex.rollouts import rollouts
from recipes.training import task
from tests._command import run
from tests._drex import TINY, config
from torchrl_morl.data import load_demonstrations, save_demonstrations
from torchrl_morl.deploy import load_policy

EMPTY = ("env.scene=empty", "env.num_threads=1")


@pytest.fixture(scope="module")
def circles():
    """What the scripted demonstrator drives without boxes: recorded drives whose style is known."""
    cfg = config(overrides=EMPTY)
    return rollouts(demonstrator(cfg), 4, 3, **cfg.env)


@pytest.fixture(scope="module")
def file(circles, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("recorded") / "drives.safetensors"
    return save_demonstrations(path, circles, {"source": "drives.csv", "robot": "turtlebot2"})


def printed(module: str, *args: object) -> str:
    result = run(module, *args)
    assert result.returncode == 0, result.stderr
    return result.stdout


# --- which styles are other ones


def test_the_distance_from_drives_of_the_same_driver_is_zero(circles):
    cfg = config(overrides=EMPTY)
    same = distance_from_recorded(cfg, demonstrator(cfg), circles, 6)
    assert_close(same, torch.zeros_like(same), atol=1e-3, rtol=0)


def test_the_distance_is_in_the_scenes_of_the_drives_which_take_turns(circles):
    """The mirrored circle is two radii away, a tighter detour less; six comparisons of four drives."""
    cfg = config(overrides=EMPTY)
    mirrored = distance_from_recorded(cfg, demonstrator(cfg, side="right"), circles, 6)
    detour = distance_from_recorded(cfg, styles.detour(cfg, 0.6), circles, 6)
    assert mirrored.shape == (6,)
    assert_close(mirrored[4:], mirrored[:2])
    assert ((mirrored > 1.4) & (mirrored < 2.3)).all(), mirrored
    assert ((detour > 0.3) & (detour < 1.0)).all(), detour


def test_the_driver_that_is_compared_stays_as_it_was(circles):
    cfg = config(overrides=EMPTY)
    driver = demonstrator(cfg)
    distance_from_recorded(cfg, driver, circles, 2)
    assert driver.scaled


def test_styles_that_come_close_to_the_drives_are_no_other_ones(circles):
    """Orbits of 1.15 to 2.2 m: those that come within half a metre of the circle are left out."""
    cfg = config(overrides=EMPTY, style_negatives__rollouts=48)
    everything = styles.other_styles(cfg)
    some = styles.other_styles(cfg, circles)
    assert [len(group) for group in everything] == [8] * 6
    kept = [len(group) for group in some]
    assert len(kept) == 6
    assert 1 < kept[0] < 8  # orbits on the demonstrated side
    assert kept[1:3] == [8, 8]  # all on the other side


def test_where_everything_comes_close_there_is_no_other_style(circles):
    cfg = config(overrides=EMPTY, style_negatives__rollouts=12, style_negatives__min_frechet=100.0)
    assert styles.other_styles(cfg, circles) == []


def test_a_style_that_is_the_recorded_one_is_no_rival(circles):
    rivals = styles.rivals_of_recorded(config(overrides=EMPTY), circles)
    assert "orbit 1.0 m" not in rivals
    assert {"mirrored", "straight", "distance keeping"} <= set(rivals)


# --- from the command line


@pytest.fixture(scope="module")
def distilled(file, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("drex") / "run"
    out = printed(
        "recipes.drex.drex", *TINY, f"demonstrations.dataset={file}", f"hydra.run.dir={folder}"
    )
    assert "lead of the demonstration" in out
    return folder


def test_run_on_recorded_drives(distilled, file):
    """It leaves what a run on scripted ones leaves, but for what is known of the circle alone."""
    pictures = {path.name for path in distilled.glob("*.png")}
    assert pictures == {"degradation.png", "drives.png", "style_contrast.png"}
    card = json.loads((distilled / "reward_model" / "reward_model.json").read_text())["card"]
    assert "demonstrator" not in card
    assert card["config"]["demonstrations"]["dataset"] == str(file)
    assert "orbit 1.0 m" not in card["style_contrast"]
    copied, metadata = load_demonstrations(distilled / "demonstrations.safetensors")
    original, _ = load_demonstrations(file)
    assert_close(copied["observation"], original["observation"])
    assert "demonstrator" not in metadata
    load_policy(distilled / "behaviour_clone")


@pytest.mark.slow
def test_a_policy_learns_from_recorded_drives(distilled, tmp_path):
    """Training, evaluation and demo: no distance to a demonstration that nobody can drive again."""
    tiny = (
        *("collector.total_frames=192", "collector.init_random_frames=96", "env.num_envs=6"),
        *("evaluation.interval=192", "evaluation.episodes=2", "env.max_episode_steps=20"),
        *("network.num_cells=[16]", "replay_buffer.batch_size=16", "optim.updates_per_batch=2"),
        *("compute.compile=false", "logger.backends=[csv]", "demonstrations.prefill=2"),
    )
    out = printed(
        *("recipes.pd_morl.pd_morl", *tiny, f"hydra.run.dir={tmp_path / 'run'}"),
        f"demonstrations.reward_model={distilled / 'reward_model'}",
        f"demonstrations.dataset={distilled / 'demonstrations.safetensors'}",
    )
    assert "frechet" not in out
    (policy,) = (tmp_path / "run" / "policies").iterdir()
    loaded = load_policy(policy)
    assert loaded.preference_space.tunable == ("demo", "distance", "efficiency")
    assert "demonstrator" not in loaded.card
    table = printed(
        "recipes.evaluate", "--policy", policy, "--episodes", 1, "--preferences", "1,0,0"
    )
    assert "success" in table
    assert "Frechet" not in table


def test_the_evaluation_of_a_training_has_nobody_to_follow():
    cfg = config("pd_morl")
    assert task.demonstrated(cfg, {}, task.evaluation_start(cfg)) is None


# --- what is refused


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"env__robot": "hsr"}, ValueError, "was driven by turtlebot2, but env.robot is hsr"),
        ({"env__observe_human": False}, ValueError, "36 entries, here they have 33"),
        ({"demonstrations__dataset": "nowhere.safetensors"}, FileNotFoundError, "nowhere"),
    ],
)
def test_files_that_do_not_fit_are_refused_before_anything_is_run(file, changes, error, message):
    cfg = config(**{"demonstrations__dataset": str(file)} | changes)
    with pytest.raises(error, match=message):
        drex.main.__wrapped__(cfg)


def test_the_study_of_n_d_needs_the_scripted_circle(distilled, tmp_path, monkeypatch, capsys):
    arguments = [str(distilled / "demonstrations.safetensors"), "--output", str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", ["augmentation", *arguments])
    with pytest.raises(SystemExit):
        augmentation.main()
    assert "holds recorded demonstrations" in capsys.readouterr().err
