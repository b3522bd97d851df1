"""The pages of the recipes explain what is logged, all of it and nothing else: after tiny trainings."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from recipes.benchmark import train
from recipes.drex import drex
from recipes.mo_ppo import mo_ppo
from recipes.pd_morl import pd_morl
from recipes.scalarized import sac, td3
from tests._command import ROOT, run_here
from tests._drex import TINY as DREX

SEEN = "env.observe_nobody=true"
"""Costs of MO-PPO ask who stands there."""
ELSEWHERE = ("demonstrations.standing_only=true", "loss.elsewhere_coeff=1", "loss.mirror_coeff=1")
OBJECTIVES = ("core", "demo", "distance", "efficiency", "clearance")
PREFERENCES = (*OBJECTIVES[1:], "balanced")
TRAINING = (
    # Settings of the process: other tests run in it.
    "compute.torch_threads=1",
    "env.num_threads=1",
    "env.objectives=[core,distance,efficiency,clearance]",
    "env.max_episode_steps=20",
    SEEN,
    "evaluation.episodes=2",
    "network.num_cells=[16,16]",
    "logger.backends=[csv]",
)
OFF_POLICY = (
    *TRAINING,
    "collector.total_frames=192",
    "collector.init_random_frames=96",
    "evaluation.interval=192",
    "replay_buffer.batch_size=16",
    "replay_buffer.size=192",
    "logger.interval=96",
    "optim.updates_per_batch=4",
)
ON_POLICY = (
    *TRAINING,
    "compute.bfloat16=false",
    "env.num_envs=4",
    "collector.frames_per_batch=96",
    "collector.total_frames=288",
    "optim.batch_size=16",
    "optim.critic_batches=1",
    "evaluation.interval=192",
)
BENCHMARK = (
    "compute.torch_threads=1",
    "num_envs=4",
    "network.num_cells=[16,16]",
    "evaluation.preferences=3",
    "evaluation.episodes=1",
    "logger.backends=[csv]",
)
"""Trainings on environments with two objectives."""
ELSEWHERE_TRAINED = {
    "pd_morl": (
        "env=examples.my_environment:Cart-v0",
        "compute.compile=false",
        "preference.num_segments=2",
        "collector.total_frames=80",
        "collector.frames_per_batch=20",
        "collector.init_random_frames=40",
        "optim.updates_per_batch=2",
        "replay_buffer.batch_size=16",
        "replay_buffer.size=200",
        "evaluation.interval=80",
        "logger.interval=20",
    ),
    "mo_ppo": (
        "env=deep-sea-treasure-v0",
        "max_episode_steps=30",
        "collector.total_frames=96",
        "collector.frames_per_batch=32",
        "optim.batch_size=16",
        "optim.epochs=1",
        "evaluation.interval=96",
    ),
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> dict[str, Path]:
    """The folder of a run of each recipe."""
    folder = tmp_path_factory.mktemp("runs")
    model = f"demonstrations.reward_model={folder}/drex/reward_model"
    policy = f"policy={folder}/pd_morl/policies/000000192"
    run_here(drex.main, *DREX, SEEN, "bfloat16=false", f"hydra.run.dir={folder}/drex")
    for name, main, given in (
        ("pd_morl", pd_morl.main, (*OFF_POLICY, "compute.compile=false")),
        ("td3", td3.main, OFF_POLICY),
        ("sac", sac.main, OFF_POLICY),
        ("mo_ppo", mo_ppo.main, (policy, *ELSEWHERE, *ON_POLICY)),
    ):
        run_here(main, *given, model, f"hydra.run.dir={folder}/{name}")
    names = ("drex", "pd_morl", "mo_ppo", "td3", "sac")
    return {name: folder / name for name in names}


def logged(run: Path, objectives: tuple[str, ...] = OBJECTIVES) -> set[str]:
    """Names of what a run has logged, of each group of objectives or preferences one."""
    scalars = run / "log_csv" / "scalars"
    names = {str(file.relative_to(scalars).with_suffix("")) for file in scalars.rglob("*.csv")}
    groups: dict[str, set[str]] = {}
    for name in names:
        *group, last = name.split("/")
        groups.setdefault("/".join(group), set()).add(last)
    found = set()
    for group, ends in groups.items():
        if group in ("train", "eval"):
            found |= {f"{group}/{end}" for end in ends}
        elif ends == set(objectives):
            found.add(f"{group}/<objective>")
        else:
            assert ends == set(PREFERENCES), (group, ends)
            found.add(f"{group}/<preference>")
    return found


def explained(page: str, heading: str) -> set[str]:
    """Names in the first column of the tables of a section; each has a sentence beside it."""
    text = (ROOT / "docs" / page).read_text()
    _, _, section = text.partition(f"\n## {heading}\n")
    assert section, f"{page} has no section {heading!r}"
    section = section.partition("\n## ")[0]
    names = set()
    for line in section.splitlines():
        if row := re.match(r"\| (`[^|]*`) \| ([^|]+) \|", line):
            cell, meaning = row.groups()
            assert len(meaning.split()) > 2, line
            names |= set(re.findall(r"`([^`]+)`", cell))
    return names


@pytest.mark.parametrize(
    ("recipe", "page", "heading"),
    [
        ("pd_morl", "pd_morl.md", "Logged metrics"),
        ("mo_ppo", "mo_ppo.md", "Logged metrics"),
        ("td3", "results/baselines.md", "Logged metrics of TD3"),
        ("sac", "results/baselines.md", "Logged metrics of SAC"),
    ],
)
def test_page_explains_what_is_logged(runs, recipe, page, heading):
    names = explained(page, heading)
    # What an evaluation logs is the same for all and stands once.
    names |= {name for name in explained("pd_morl.md", "Logged metrics") if "eval/" in name}
    assert names == logged(runs[recipe])


def test_page_explains_the_card_and_the_pictures_of_a_reward_model(runs):
    folder = runs["drex"]
    card = json.loads((folder / "reward_model" / "reward_model.json").read_text())["card"]
    reported = set(card) - {"config", "versions", "demonstrator"}  # what made it
    reported |= {picture.name for picture in folder.glob("*.png")}
    assert explained("drex.md", "What a run reports") == reported


@pytest.mark.parametrize("algorithm", ELSEWHERE_TRAINED)
def test_page_explains_what_a_training_on_another_environment_logs(algorithm, tmp_path):
    """Evaluations have names of their own, updates those of the method; discrete actions add some."""
    given = (*BENCHMARK, *ELSEWHERE_TRAINED[algorithm], "objectives=[first,second]")
    run_here(train.main, f"algorithm={algorithm}", *given, f"hydra.run.dir={tmp_path}/run")
    page = "how_to/environment.md"
    found = logged(tmp_path / "run", ("first", "second"))
    updates = {name for name in found if name.startswith("train/")}
    assert found - updates == explained(page, "What an evaluation measures")
    added = explained(page, "What a training logs") if algorithm == "mo_ppo" else set()
    assert updates - explained(f"{algorithm}.md", "Logged metrics") == added
