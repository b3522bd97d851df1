"""The paper's own configuration: what it says, and that it trains."""

from __future__ import annotations

import pytest
import torch
from hydra import compose, initialize_config_module
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict

from envs import NavigationEnv
from recipes.pd_morl import pd_morl
from recipes.pd_morl.schema import Preference
from recipes.training.replay import make_relabel
from tests._command import run_here
from torchrl_morl import PreferenceSpace
from torchrl_morl.deploy import load_policy
from torchrl_morl.transforms import PreferenceExpand, PreferenceRelabel

SPACE = PreferenceSpace(NavigationEnv.objectives, static={"core": 1.0})


def configuration(recipe: str, *overrides: str) -> DictConfig:
    with initialize_config_module(f"recipes.{recipe}", version_base="1.3"):
        return compose("config", overrides=list(overrides))


def test_says_what_the_paper_says():
    cfg = configuration("pd_morl", "preset=paper")
    assert (cfg.loss.gamma, cfg.collector.total_frames, cfg.env.num_envs) == (1.0, 600_000, 3)
    assert (cfg.loss.policy_noise, cfg.loss.noise_clip) == (0.2, 0.5)
    angle = cfg.loss.angle, cfg.loss.angle_coeff_actor, cfg.loss.angle_coeff_critic
    assert angle == ("raw", 10.0, 1.0)
    assert (cfg.optim.final_lr_ratio, cfg.preference.relabel_copies) == (1.0, 3)
    assert cfg.preference.slabs and cfg.demonstrations.dataset is None
    drex = configuration("drex", "preset=paper")
    assert (min(drex.noise.levels), max(drex.noise.levels), drex.noise.hold) == (0.0, 0.2, 1)
    assert (drex.style_negatives.rollouts, drex.tracking.rollouts) == (0, 0)


def test_copies_are_stored_instead_of_relabelled():
    plain = make_relabel(configuration("pd_morl"), SPACE)
    assert isinstance(plain, PreferenceRelabel) and plain.ratio == 0.75
    expand = make_relabel(configuration("pd_morl", "preset=paper"), SPACE)
    assert isinstance(expand, PreferenceExpand)
    data = TensorDict(preference=SPACE.corners(), batch_size=[2])
    stored = expand._inv_call(data)["preference"]
    assert stored.shape == (8, 2)
    torch.testing.assert_close(stored[::4], SPACE.corners())


def test_trains(tmp_path):
    run_here(
        pd_morl.main,
        "preset=paper",
        "compute.compile=false",
        "network.num_cells=[16,16]",
        "env.num_threads=1",
        "collector.frames_per_batch=24",
        "collector.init_random_frames=48",
        "collector.total_frames=96",
        "replay_buffer.size=1000",
        "replay_buffer.batch_size=16",
        "evaluation.interval=96",
        "evaluation.episodes=2",
        "logger.backends=[csv]",
        f"hydra.run.dir={tmp_path / 'run'}",
    )
    policy = load_policy(tmp_path / "run" / "policies" / "000000096")
    assert policy.preference_space == SPACE


def test_refuses_to_relabel_twice():
    cfg = OmegaConf.to_container(configuration("pd_morl", "preference.relabel_copies=3"))
    section = cfg["preference"]
    with pytest.raises(
        ValueError, match=r"relabel_ratio must be 0 with preference\.relabel_copies"
    ):
        Preference.model_validate(section)
    assert Preference.model_validate({**section, "relabel_ratio": 0.0}).relabel_copies == 3
