"""MO-PPO of a policy that reads how its robot moves: what was demonstrated does not tell."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from envs.policy_env import SHOWN, observation_size
from recipes.mo_ppo import mo_ppo
from tests._command import ROOT, run_here
from tests._mo_ppo import TINY, go_on, nothing
from torchrl_morl.data import save_demonstrations
from torchrl_morl.deploy import load_policy, save_reward_model
from torchrl_morl.modules import RewardModel

ANY_ROBOT = {"observe_human_velocity": True, "observe_nobody": True, "observe_robot": True}


@pytest.mark.parametrize("observed", [{}, ANY_ROBOT], ids=["one robot", "any robot"])
def test_it_learns_with_a_style_shown_without_motion(tmp_path, observed):
    size = observation_size(observed, SHOWN)
    torch.manual_seed(0)
    data = TensorDict(
        observation=torch.randn(4, 30, size),
        action=torch.tensor([0.5, -0.25]).expand(4, 30, 2).clone(),
        mask=torch.ones(4, 30, dtype=torch.bool),
        batch_size=[4, 30],
    )
    file = save_demonstrations(tmp_path / "drives.safetensors", data, {})
    model = RewardModel(in_features=size + 2, num_cells=(8,), num_members=1)
    save_reward_model(tmp_path / "model", model, card={})
    options = (
        f"demonstrations.reward_model={tmp_path / 'model'}",
        f"demonstrations.dataset={file}",
        "env.observe_motion=true",
        *(f"env.{name}=true" for name in observed),
        *(["env.robot=any", "env.faults.latency=[0,3]"] if observed else []),
        "optim.cloning_updates=1000",
        "optim.critic_batches=100",
    )
    folder = nothing(tmp_path / "run", *options)
    policy = load_policy(folder / "policies" / "000000128")
    assert policy.sensing.observe_motion
    # The clone imitates whatever it was told before.
    seen = torch.randn(50, size, generator=torch.manual_seed(1))
    corner = policy.preference_space.corners()[policy.preference_space.tunable.index("demo")]
    actions = []
    for motion in (-0.5, 0.5):
        inputs = TensorDict(
            observation=torch.cat((seen, torch.full((50, 10), motion)), -1),
            preference=corner.expand(50, -1),
            batch_size=[50],
        )
        actions.append(policy.actor(inputs)["action"])
    assert (actions[0] - torch.tensor([0.5, -0.25])).square().mean() < 0.02
    assert (actions[1] - actions[0]).square().mean() < 0.01
    go_on(folder, "collector.total_frames=160")
    assert load_policy(folder / "policies" / "000000160").sensing == policy.sensing


def test_the_policy_for_everything_goes_on_in_a_scene_of_ones_own(tmp_path, monkeypatch):
    """preset=further names what ships: from the checkout it needs nothing else."""
    monkeypatch.chdir(ROOT)
    scene = tmp_path / "mine.yaml"
    scene.write_text("mixture: {everyday: 1, corridor: 1}\n")
    folder = tmp_path / "run"
    own = (f"env.scene={scene}", "evaluation.scene=corridor", f"hydra.run.dir={folder}")
    run_here(mo_ppo.main, "preset=further", *TINY, *own)
    before = load_policy("recipes/policies/navigation")
    after = load_policy(folder / "policies" / "000000128")
    assert after.sensing == before.sensing
    # So few steps change it, and hardly.
    changes = [
        (one - other).abs().max()
        for one, other in zip(after.actor.parameters(), before.actor.parameters(), strict=True)
    ]
    assert 0 < max(changes) < 0.01
