"""MO-PPO without a policy to start from."""

from __future__ import annotations

import shutil

import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict
from torchrl.checkpoint import CheckpointRotation

from recipes.training.ppo_optimizers import noise
from tests._mo_ppo import SPACE, go_on, nothing
from torchrl_morl.data import save_demonstrations
from torchrl_morl.deploy import load_policy, save_reward_model
from torchrl_morl.deploy.features import OBSERVATION_SIZE
from torchrl_morl.modules import RewardModel


@pytest.mark.slow
def test_learns_without_a_policy(tmp_path):
    folder = nothing(tmp_path / "run")
    policy = load_policy(folder / "policies" / "000000128")
    assert policy.preference_space == SPACE
    assert "start" not in policy.card
    config = policy.card["config"]
    assert (config["env"]["scene"], config["evaluation"]["scene"]) == ("static", "static")
    # Null is what PD-MORL trains with.
    assert (config["env"]["goal_radius"], config["env"]["max_episode_steps"]) == (0.3, 300)
    again = nothing(tmp_path / "again")
    name = "policies/000000128/policy.safetensors"
    assert (again / name).read_bytes() == (folder / name).read_bytes()


def test_goes_on_without_a_policy(tmp_path, demonstrated):
    """What was cloned is not cloned again: the actor, which waits, is what was saved."""
    folder = nothing(tmp_path / "run", *demonstrated, "optim.critic_batches=100")
    go_on(folder, "collector.total_frames=192")
    names = ["000000128", "000000192"]
    before, after = (load_policy(folder / "policies" / name).actor.state_dict() for name in names)
    for name, value in before.items():
        torch.testing.assert_close(after[name], value, rtol=0, atol=0)


def test_the_noise_goes_on_where_it_was(tmp_path, monkeypatch):
    """Killed behind its first checkpoint, it ends as the training that nobody stopped."""
    killed, save = tmp_path / "killed", CheckpointRotation.save

    def record(self, *args, **kwargs):
        path = save(self, *args, **kwargs)
        if not killed.exists():
            shutil.copytree(folder, killed)
        return path

    monkeypatch.setattr(CheckpointRotation, "save", record)
    folder = tmp_path / "run"
    nothing(folder)
    assert [path.name for path in (killed / "policies").iterdir()] == ["000000064"]
    go_on(killed)
    name = "policies/000000128/policy.safetensors"
    assert (killed / name).read_bytes() == (folder / name).read_bytes()


@pytest.fixture
def demonstrated(tmp_path) -> tuple[str, str]:
    """Options for a style that holds one action everywhere, and a reward model."""
    torch.manual_seed(0)
    data = TensorDict(
        observation=torch.randn(4, 30, OBSERVATION_SIZE),
        action=torch.tensor([0.5, -0.25]).expand(4, 30, 2).clone(),
        mask=torch.ones(4, 30, dtype=torch.bool),
        batch_size=[4, 30],
    )
    file = save_demonstrations(tmp_path / "drives.safetensors", data, {})
    model = RewardModel(in_features=OBSERVATION_SIZE + 2, num_cells=(8,), num_members=1)
    save_reward_model(tmp_path / "model", model, card={})
    return (
        f"demonstrations.reward_model={tmp_path / 'model'}",
        f"demonstrations.dataset={file}",
    )


def test_clones_demonstrations_first(tmp_path, demonstrated):
    """The actor waits for the critic: what is saved is the clone."""
    errors, elsewhere = [], {}
    for updates in (0, 1000):
        folder = nothing(
            tmp_path / str(updates),
            *demonstrated,
            f"optim.cloning_updates={updates}",
            "optim.critic_batches=100",
            "optim.cloning_speed=0.8",
        )
        policy = load_policy(folder / "policies" / "000000128")
        corner = policy.preference_space.corners()[policy.preference_space.tunable.index("demo")]
        inputs = TensorDict(
            observation=torch.randn(50, OBSERVATION_SIZE, generator=torch.manual_seed(1)),
            preference=corner.expand(50, -1),
            batch_size=[50],
        )
        action = policy.actor(inputs)["action"]
        errors.append((action - torch.tensor([0.5, -0.25])).square().mean().item())
        for name, speed in (("distance", 0.0), ("efficiency", 0.6)):
            corner = policy.preference_space.corners()[policy.preference_space.tunable.index(name)]
            inputs["preference"] = corner.expand(50, -1)
            action = policy.actor(inputs)["action"]
            elsewhere[name] = (action - torch.tensor([speed, 0.0])).square().mean().item()
    assert errors[1] < 0.02 < errors[0]
    # Where the style is not wished nothing is imitated: half the speed for distance, 0.8 for efficiency.
    assert max(elsewhere.values()) < 0.03, elsewhere


def test_the_noise_falls_geometrically():
    cfg = OmegaConf.create(
        {
            "collector": {
                "exploration_sigma": [0.2, 0.4],
                "final_exploration_sigma": [0.05, 0.1],
                "total_frames": 100,
            }
        }
    )
    torch.testing.assert_close(noise(cfg, 0), torch.tensor([0.2, 0.4]))
    torch.testing.assert_close(noise(cfg, 50), torch.tensor([0.1, 0.2]))
    torch.testing.assert_close(noise(cfg, 100), torch.tensor([0.05, 0.1]))
    torch.testing.assert_close(noise(cfg, 150), torch.tensor([0.05, 0.1]))


@pytest.mark.parametrize(("updates", "anchored"), [(1, True), (0, False)])
def test_a_clone_is_an_anchor_and_what_has_learned_nothing_is_none(
    updates, anchored, tmp_path, demonstrated
):
    folder = nothing(tmp_path / "run", *demonstrated, f"optim.cloning_updates={updates}")
    assert (folder / "log_csv/scalars/train/anchor.csv").exists() == anchored


def test_refuses_demonstrations_without_their_objective(tmp_path, demonstrated):
    with pytest.raises(ValueError, match=r"dataset needs demonstrations\.reward_model"):
        nothing(tmp_path / "run", demonstrated[1])
    assert not (tmp_path / "run").exists()
