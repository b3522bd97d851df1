"""Metrics of navigation rollouts: one cause per episode, and numbers worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from envs import NavigationEnv
from envs.metrics import episode_metrics, trajectories
from torchrl_morl.evaluation import episode_mask

CAUSES = ("success", "collision_human", "collision_obstacle", "timeout")
STEPS = 4
# Every robot drives along x, half a metre a step; the episodes end after 2, 3, 1 and 4 steps.
ENDS = {"success": 2, "collision_human": 3, "collision_obstacle": 1, "truncated": 4}


def hand_made(ends: dict[str, int] | None = None) -> TensorDict:
    """One episode per cause ``[4, 4]``, with rubbish behind the end of each."""
    ends = ENDS if ends is None else ends
    steps = torch.arange(STEPS + 1, dtype=torch.float64)
    pose = torch.zeros(len(ends), STEPS + 1, 3, dtype=torch.float64)
    pose[..., 0] = 0.5 * steps
    pose[..., 2] = 0.1 * steps
    human = torch.zeros_like(pose)
    human[..., :2] = torch.tensor([3.0, 1.0])
    flags = {name: torch.zeros(len(ends), STEPS, 1, dtype=torch.bool) for name in ENDS}
    done = torch.zeros(len(ends), STEPS, 1, dtype=torch.bool)
    for row, (name, end) in enumerate(ends.items()):
        flags[name][row, end - 1] = True
        done[row, end - 1] = True
        # What the simulator did after the episode's end: right through the human, and more flags.
        pose[row, end + 1 :, :2] = torch.tensor([3.0, 1.0])
        flags["collision_human"][row, end:] = True
    goal = torch.tensor([[6.0, 0.0]]).repeat(len(ends), STEPS, 1)
    goal[:, 0, 0] = torch.arange(7.0, 7.0 + len(ends))
    rollout = TensorDict(
        pose=pose[:, :-1],
        human_pose=human[:, :-1],
        goal=goal,
        next=TensorDict(pose=pose[:, 1:], human_pose=human[:, 1:], **flags),
        mask=episode_mask(done),
    )
    return rollout.auto_batch_size_(2)


def test_exactly_one_cause_per_episode():
    metrics = episode_metrics(hand_made())
    causes = torch.stack([metrics[name] for name in CAUSES])
    assert torch.equal(causes, torch.eye(4, dtype=torch.bool))


def test_numbers_by_hand():
    metrics = episode_metrics(hand_made())
    assert metrics.batch_size == (4,)
    assert metrics["time"][0].item() == pytest.approx(2 * 0.2)
    assert metrics["time"][1:].isnan().all()
    assert metrics["path_length"].tolist() == pytest.approx([1.0, 1.5, 0.5, 2.0])
    # At the end the robot is nearest: x = 1, 1.5, 0.5 and 2 against a human at (3, 1).
    nearest = [math.hypot(3.0 - x, 1.0) for x in (1.0, 1.5, 0.5, 2.0)]
    assert metrics["min_human_distance"].tolist() == pytest.approx(nearest)
    assert metrics["direct_distance"].tolist() == [7.0, 8.0, 9.0, 10.0]


def test_start_counts_for_the_distance_to_the_human():
    rollout = hand_made()
    rollout["human_pose"][:, 0, :2] = torch.tensor([0.0, 0.3])
    nearest = episode_metrics(rollout)["min_human_distance"]
    assert nearest.tolist() == pytest.approx([0.3] * 4)


def test_trajectories_start_with_the_start():
    path = trajectories(hand_made())
    assert path.batch_size == (4,)
    assert path["position"].shape == (4, 5, 2)
    assert path["position"][3, :, 0].tolist() == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert path["heading"][3].tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert path["human"][3].tolist() == [[3.0, 1.0]] * 5
    assert path["mask"].sum(-1).tolist() == [3, 4, 2, 5]


def test_any_batch_shape():
    rollout = hand_made()
    folded = episode_metrics(rollout.reshape(2, 2, STEPS))
    assert folded.batch_size == (2, 2)
    flat = episode_metrics(rollout)
    for name, value in flat.items():
        assert torch.allclose(folded[name].flatten(), value, equal_nan=True), name


def test_episode_without_an_end_is_refused():
    rollout = hand_made()
    rollout["next", "truncated"][:] = False
    with pytest.raises(RuntimeError, match="1 of 4 episodes have no single cause"):
        episode_metrics(rollout)


def test_episode_with_two_causes_is_refused():
    rollout = hand_made()
    rollout["next", "collision_human"][0, 1] = True
    with pytest.raises(RuntimeError, match="1 of 4 episodes have no single cause"):
        episode_metrics(rollout)


def test_simulated_episodes_have_one_cause_each():
    env = NavigationEnv(num_envs=32, num_threads=1, seed=3, max_episode_steps=120)
    start = env.reset()
    distance = start["goal"][:, 0].clone()

    def straight_ahead(goal: torch.Tensor) -> torch.Tensor:
        """Turns towards the goal and drives: reaches it, unless something is in the way."""
        bearing = goal[:, 1]
        return torch.stack((torch.full_like(bearing, 0.5), bearing.clamp(-1, 1)), -1)

    rollout = env.rollout(
        120,
        TensorDictModule(straight_ahead, in_keys=["goal"], out_keys=["action"]),
        auto_reset=False,
        tensordict=start,
        break_when_any_done=False,
        break_when_all_done=True,
    )
    rollout["mask"] = episode_mask(rollout["next", "done"])
    metrics = episode_metrics(rollout)
    causes = torch.stack([metrics[name] for name in CAUSES])
    assert (causes.sum(0) == 1).all()
    assert causes.any(1).sum() >= 3  # this policy fails in more than one way
    assert torch.equal(metrics["time"].isfinite(), metrics["success"])
    assert torch.equal(metrics["direct_distance"], distance)
    solved = metrics["success"]
    assert (metrics["path_length"] + env.goal_radius >= distance - 1e-6)[solved].all()
    env.close()
