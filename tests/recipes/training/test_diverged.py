"""Numbers that no training survives: refused, or the run stops with one line that says what became NaN."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from envs.policy_env import observation_size
from recipes.drex.cloning import clone_behaviour
from recipes.drex.ranking import ranked_snippets, train_reward_model
from recipes.mo_ppo import mo_ppo
from recipes.pd_morl import pd_morl
from recipes.training.diverged import refuse_diverged
from tests._drex import config
from tests._mo_ppo import TINY as TINY_PPO

from .test_checkpoint_pickles import TINY


def last_line(main, *arguments: object, capsys: pytest.CaptureFixture) -> str:
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("HYDRA_FULL_ERROR", raising=False)
        patch.setattr(sys, "argv", ["recipe.py", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            main()
    assert stop.value.code == 1
    *_, line = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    return line


@pytest.mark.parametrize("absurd", ["optim.lr=1e30", "replay_buffer.reward_scale=1e38"])
def test_pd_morl_stops_and_names_what_became_nan(absurd, tmp_path, capsys):
    run = f"hydra.run.dir={tmp_path / 'run'}"
    line = last_line(pd_morl.main, *TINY, "optim.policy_delay=1", absurd, run, capsys=capsys)
    assert "loss_" in line or "grad_norm_" in line
    assert "in the updates before step" in line and "lower optim.lr" in line


@pytest.mark.parametrize("absurd", ["optim.lr=1e30", "optim.critic_lr=1e30"])
def test_mo_ppo_stops_and_names_what_became_nan(absurd, tmp_path, capsys):
    given = ["preset=nothing", *TINY_PPO, absurd, f"hydra.run.dir={tmp_path / 'run'}"]
    line = last_line(mo_ppo.main, *given, capsys=capsys)
    assert "loss_" in line
    assert "in the updates before step" in line and "lower optim.lr" in line
    saved = [path.name for path in (Path(tmp_path) / "run" / "policies").glob("*")]
    assert "000000128" not in saved


def data(bad: float = 0.0) -> TensorDict:
    size = observation_size(config().env)
    steps = TensorDict(
        observation=torch.rand(6, 30, size),
        action=torch.rand(6, 30, 2) * 2 - 1,
        human=torch.rand(6, 30, 2),
        mask=torch.ones(6, 30, dtype=torch.bool),
        batch_size=[6, 30],
    )
    steps["observation"][0, 3, 0] = bad
    return steps


@pytest.mark.parametrize(("rate", "bad"), [(1e30, 0.0), (1e-3, float("nan"))])
def test_a_clone_stops_and_names_its_update(rate, bad):
    cfg = config(cloning__lr=rate, cloning__updates=20, cloning__num_cells=[16])
    with pytest.raises(ValueError, match=r"loss_bc became (nan|inf) in update 20 of the cloning"):
        clone_behaviour(cfg, data(bad))


def test_a_reward_model_stops_and_names_its_update():
    cfg = config(
        reward_model__updates=5, reward_model__batch_size=8, reward_model__snippet_length=10
    )
    groups = [(0.0, data(float("nan"))), (-0.5, data(float("nan")))]
    snippets = ranked_snippets(cfg, groups, [])
    with pytest.raises(ValueError, match="loss_bradley_terry became nan in update 5 of the rew"):
        train_reward_model(cfg, snippets)


def test_what_is_no_loss_may_be_what_it_is():
    refuse_diverged({"failed": torch.tensor(torch.nan), "loss_actor": torch.ones(3)}, "", "")
    refuse_diverged({}, "", "")
    with pytest.raises(ValueError, match="grad_norm_actor became inf"):
        refuse_diverged({"grad_norm_actor": torch.tensor(torch.inf)}, "before", "lower it")
