"""Short trainings of every recipe give the policies that they gave before version 0.2.0.

The numbers are those of the last commit of 0.1 (docs/history/releases.md) with the versions of constraints.txt
on x86-64, where the weights are the same bit by bit. Elsewhere sums round differently, hence the tolerance. A
change of the training that is meant changes them: print ``fingerprint`` anew, and say why in the changelog.
Those of the reward model are of contacts that count at every substep, which end some noisy rollouts sooner.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from recipes.drex import drex
from recipes.mo_ppo import mo_ppo
from recipes.pd_morl import pd_morl
from recipes.scalarized import sac, td3
from tests._command import run_here
from tests._drex import TINY

OFF_POLICY = [
    "collector.total_frames=960",
    "collector.init_random_frames=480",
    "collector.frames_per_batch=96",
    "evaluation.interval=576",
    "evaluation.episodes=3",
    "replay_buffer.batch_size=16",
    "replay_buffer.size=2000",
    "network.num_cells=[16,16]",
    "logger.interval=96",
    "env.max_episode_steps=30",
    "optim.updates_per_batch=4",
]
UNCOMPILED = ["compute.compile=false", "compute.bfloat16=false"]
DREX = [*TINY, "tracking.rollouts=0", "bfloat16=false"]
MO_PPO = [
    "compute.torch_threads=1",
    "compute.bfloat16=false",
    "env.num_threads=1",
    "env.num_envs=4",
    "collector.frames_per_batch=32",
    "collector.total_frames=128",
    "optim.batch_size=16",
    "optim.critic_batches=1",
    "network.num_cells=[16,16]",
    "evaluation.interval=64",
    "evaluation.episodes=2",
    "logger.backends=[csv]",
]
BEFORE = {
    "drex": [-0.49259144, 1.0074312, -0.0014608184, -0.021893891],
    "clone": [-0.055013006, 1.5258548, 0.029648502, 0.043182092],
    "pd_morl": [0.053731115, 0.98067677, 0.3947929, -0.11246087, -4.4106249e-05, 0.009999958],
    "pd_morl_demo": [
        -0.26902291,
        -0.98237434,
        0.14285549,
        0.51891508,
        3.7915292e-05,
        -0.0034163889,
    ],
    "mo_ppo": [-0.26685446, -0.98021591, 0.14320226, 0.51763347, 9.3572229e-05, -0.0026016798],
    "td3": [0.053366519, 0.98004044, 0.3942297, -0.11190735, -0.00029827464, 0.0095496489],
    "core": [0.053673198, 1.5735774, 0.39424333, -0.1115527, -0.00029780608, 0.0087644712],
    "sac": [-0.26966454, -0.97982345, 0.14097426, 0.52704885, 0.00031555531, -0.0035678433],
}


def fingerprint(path: Path) -> list[float]:
    """One number a parameter, that any entry and any exchange of two changes."""
    weights = load_file(path)
    numbers = []
    for name in sorted(name for name in weights if "action_" not in name):
        values = weights[name].double().flatten()
        numbers.append((values * torch.arange(1, len(values) + 1).double().cos()).sum().item())
    return numbers


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("same")


@pytest.fixture(scope="module")
def demonstrations(folder) -> list[str]:
    """What D-REX leaves, as overrides of the others."""
    run_here(drex.main, *DREX, f"hydra.run.dir={folder}/drex")
    return [
        f"demonstrations.reward_model={folder}/drex/reward_model",
        f"demonstrations.dataset={folder}/drex/demonstrations.safetensors",
    ]


@pytest.fixture(scope="module")
def with_demonstrations(folder, demonstrations) -> Path:
    run_here(
        pd_morl.main,
        *OFF_POLICY,
        *UNCOMPILED,
        *demonstrations,
        f"hydra.run.dir={folder}/pd_morl_demo",
    )
    return folder / "pd_morl_demo" / "policies" / "000000960"


def check(name: str, path: Path) -> None:
    assert fingerprint(path) == pytest.approx(BEFORE[name], rel=1e-4, abs=1e-6)


def test_drex(folder, demonstrations):
    check("clone", folder / "drex" / "behaviour_clone" / "policy.safetensors")
    check("drex", folder / "drex" / "reward_model" / "reward_model.safetensors")


def test_pd_morl(tmp_path):
    run_here(pd_morl.main, *OFF_POLICY, *UNCOMPILED, f"hydra.run.dir={tmp_path}/run")
    check("pd_morl", tmp_path / "run" / "policies" / "000000960" / "policy.safetensors")


def test_pd_morl_with_demonstrations(with_demonstrations):
    check("pd_morl_demo", with_demonstrations / "policy.safetensors")


def test_mo_ppo(with_demonstrations, demonstrations, tmp_path):
    run_here(
        mo_ppo.main,
        f"policy={with_demonstrations}",
        *MO_PPO,
        demonstrations[0],
        f"hydra.run.dir={tmp_path}/run",
    )
    check("mo_ppo", tmp_path / "run" / "policies" / "000000128" / "policy.safetensors")


def test_scalarized_td3(tmp_path):
    run_here(td3.main, *OFF_POLICY, f"hydra.run.dir={tmp_path}/run")
    check("td3", tmp_path / "run" / "policies" / "000000960" / "policy.safetensors")


def test_td3_of_the_core_alone(tmp_path):
    run_here(td3.main, *OFF_POLICY, "objective=core", f"hydra.run.dir={tmp_path}/run")
    check("core", tmp_path / "run" / "policies" / "000000960" / "policy.safetensors")


def test_scalarized_sac(demonstrations, tmp_path):
    run_here(sac.main, *OFF_POLICY, *demonstrations, f"hydra.run.dir={tmp_path}/run")
    check("sac", tmp_path / "run" / "policies" / "000000960" / "policy.safetensors")


def test_the_fingerprint_sees_one_entry(tmp_path):
    weights = {"a": torch.arange(6.0).reshape(2, 3), "action_high": torch.ones(2)}
    save_file(weights, tmp_path / "one.safetensors")
    weights["a"][1, 2] += 1e-3
    save_file(weights, tmp_path / "two.safetensors")
    one, two = (fingerprint(tmp_path / f"{name}.safetensors") for name in ("one", "two"))
    assert len(one) == 1
    assert one != pytest.approx(two, rel=1e-4, abs=1e-6)
