"""What the actor of MO-PPO pays for, by hand: the anchor, the mean that it holds, and smoothness."""

from __future__ import annotations

import math

import torch
from omegaconf import OmegaConf
from tensordict import TensorDict
from torchrl.data import Bounded

from recipes.mo_ppo import penalties
from torchrl_morl.modules import make_actor
from torchrl_morl.transforms import LogRange


def test_anchor_by_hand():
    def policy(turn: float):
        actor = make_actor(Bounded(-1.0, 1.0, (2,)), in_features=4 + 2, num_cells=(8,))
        with torch.no_grad():
            actor[0].module[-1].weight.zero_()
            actor[0].module[-1].bias.copy_(torch.tensor([0.0, turn]).atanh())
        return actor

    batch = TensorDict(
        observation=torch.randn(4, 4),
        preference=torch.tensor([[1.0, 0.0], [0.5, 0.5], [1.0, 0.0], [1.0, 0.0]]),
        human=torch.tensor([[2.4, 1.0], [0.5, -2.0], [2.6, 1.0], [1.0, 0.0]]),
        fails=torch.tensor([False, False, False, True]),
        batch_size=[4],
    )
    # 0.2 apart, a standard deviation of 0.1: 2 nats, of which ln(1 + 2), weighed by 1, 1/8 and, where
    # nobody is near or what leads to a failure, 0.
    batch["start_action"] = policy(0.1)(batch.clone())["action"].detach()
    action = policy(0.3)(batch.clone())["action"]
    sigma = torch.tensor([0.5, 0.1])
    distance = penalties.anchor(batch, action, sigma=sigma, objective=0, radius=2.5)
    torch.testing.assert_close(distance, torch.tensor(math.log(3) * 1.125 / 4))
    # Ten times as far is a hundred times as many nats, and costs less than five times as much.
    far = penalties.anchor(
        batch, 10 * action - 9 * batch["start_action"], sigma=sigma, objective=0, radius=2.5
    )
    torch.testing.assert_close(far / distance, torch.tensor(math.log(201) / math.log(3)))


def in_front(*ranges: float) -> torch.Tensor:
    """Observations with a lidar that sees something straight ahead, behind, and to the left."""
    lidar = torch.full((len(ranges), 30), 4.0)
    for row, near in enumerate(ranges):
        lidar[row, (0, 15, 7)[row]] = near
    return torch.cat((LogRange(4.0)(lidar), torch.zeros(len(ranges), 6)), dim=-1)


def test_the_nearest_box_is_not_the_human():
    observation = in_front(0.5, 0.6, 0.7)
    far = torch.tensor([[3.0, 1.0]]).expand(3, 2)
    found = penalties.nearest_box(observation, far)
    torch.testing.assert_close(found, torch.tensor([0.5, 0.6, 0.7]))
    # Who stands ahead, behind and to the left is what the lidar sees there; no box is near.
    people = torch.tensor([[0.75, 0.0], [0.85, math.pi], [0.95, math.pi / 2]])
    torch.testing.assert_close(penalties.nearest_box(observation, people), torch.full((3,), 4.0))
    # A box to the left of them is one, on whatever side of the first ray it lies.
    beside = observation.clone()
    beside[:, [3, 12, 10]] = LogRange(4.0)(torch.tensor([0.8, 0.8, 0.8]))
    torch.testing.assert_close(penalties.nearest_box(beside, people), torch.full((3,), 0.8))


def test_anchor_lets_go_beside_a_box():
    batch = TensorDict(
        observation=in_front(0.5, 0.8),
        preference=torch.tensor([[1.0, 0.0], [1.0, 0.0]]),
        human=torch.tensor([[3.0, 1.0], [3.0, 1.0]]),
        fails=torch.tensor([False, False]),
        start_action=torch.zeros(2, 2),
        batch_size=[2],
    )
    sigma, action = torch.tensor([0.1, 0.1]), torch.tensor([[0.0, 0.2], [0.0, 0.2]])

    def cost(clearance: float) -> torch.Tensor:
        return penalties.anchor(
            batch, action, sigma=sigma, objective=0, radius=9.0, clearance=clearance
        )

    for clearance, held in ((0.0, 2), (0.6, 1), (0.9, 0)):
        torch.testing.assert_close(cost(clearance), torch.tensor(math.log(3) * held / 2))


def test_anchor_lets_go_where_nobody_stands():
    batch = TensorDict(
        preference=torch.tensor([[1.0, 0.0]]).expand(3, 2),
        human=torch.tensor([[3.0, 1.0]]).expand(3, 2),
        fails=torch.zeros(3, dtype=torch.bool),
        start_action=torch.zeros(3, 2),
        batch_size=[3],
    )
    action = torch.tensor([0.0, 0.2]).expand(3, 2)
    for stands, held in ((None, 3), (torch.tensor([True, True, False]), 2)):
        cost = penalties.anchor(
            batch,
            action,
            sigma=torch.tensor([0.1, 0.1]),
            objective=0,
            radius=9.0,
            stands=stands,
        )
        torch.testing.assert_close(cost, torch.tensor(math.log(3) * held / 3))


def test_what_a_clone_would_do_is_asked_at_one_preference():
    """A clone knows the style at its corner alone, whatever an episode prefers."""
    actor = make_actor(Bounded(-1.0, 1.0, (2,)), in_features=1 + 2, num_cells=())
    with torch.no_grad():  # the first weight is the action
        actor[0].module[-1].weight.copy_(torch.tensor([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0]]))
    data = TensorDict(
        observation=torch.zeros(2, 3, 1),
        preference=torch.tensor([0.5, 0.5]).expand(2, 3, 2),
        collector=TensorDict(traj_ids=torch.tensor([[0, 0, 0], [1, 1, 1]]), batch_size=[2, 3]),
        batch_size=[2, 3],
    )
    cfg = OmegaConf.create({"loss": {"anchor_window": 1}})
    for preference, first in ((None, 0.5), (torch.tensor([1.0, 0.0]), 1.0)):
        action = penalties.start_action(cfg, actor, data, envs_at_once=1, preference=preference)
        torch.testing.assert_close(action, torch.full((2, 3, 2), first).tanh())
    assert (data["preference"] == 0.5).all()


def test_averages_over_the_steps_of_an_episode():
    # Steps 0 to 2 belong to one episode, 3 and 4 to the next.
    action = torch.tensor([[1.0, -1.0, 3.0, 10.0, 20.0]]).unsqueeze(-1)
    action = torch.cat([action, -action])  # and of another environment
    episode = torch.tensor([[0, 0, 0, 2, 2], [1, 1, 1, 3, 3]])
    mean = penalties.average_over_time(action, episode, window=3)
    expected = torch.tensor([[0.0, 1.0, 1.0, 15.0, 15.0]]).unsqueeze(-1)
    torch.testing.assert_close(mean, torch.cat([expected, -expected]))
    torch.testing.assert_close(penalties.average_over_time(action, episode, window=1), action)
    # Longer than the row: the mean of each episode.
    longest = penalties.average_over_time(action, episode, window=9)
    torch.testing.assert_close(longest[0, :, 0], torch.tensor([1.0, 1.0, 1.0, 15.0, 15.0]))


def test_smoothness_by_hand():
    actor = make_actor(Bounded(-1.0, 1.0, (2,)), in_features=1 + 2, num_cells=())
    with torch.no_grad():
        actor[0].module[-1].weight.copy_(torch.tensor([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    seen = torch.tensor([[0.1], [0.1], [0.5], [0.0]]).atanh()
    later = torch.tensor([[0.4], [0.4], [0.5], [-0.1]]).atanh()
    batch = TensorDict(
        observation=seen,
        preference=torch.rand(4, 2),
        next=TensorDict(
            observation=later,
            done=torch.tensor([[False], [True], [False], [False]]),
            batch_size=[4],
        ),
        batch_size=[4],
    )
    # The second episode ends: what follows is another one.
    change = penalties.smoothness(batch, actor(batch.clone())["action"], actor)
    torch.testing.assert_close(change, torch.tensor((0.09 + 0.01) / 4))
    assert "action" not in batch.keys()


def test_standing_by_hand():
    # Stands; drives at 5 % of the speed; turns at 2.5 % of the rate; does both; drives; turns back.
    action = torch.tensor([[-1, 0], [-0.9, 0], [-1, 0.025], [-0.9, -0.025], [0.5, 0], [-1, -0.3]])
    torch.testing.assert_close(penalties.standing(action), torch.tensor((1 + 0.25 + 0.25) / 6))
    for each, cost in zip(action, (1, 0.25, 0.25, 0, 0, 0), strict=True):
        torch.testing.assert_close(penalties.standing(each), torch.tensor(float(cost)))
    # Where it stands it is pushed to drive; where it drives it is left alone.
    action.requires_grad_(True)
    penalties.standing(action).backward()
    assert action.grad[0, 0] < 0
    assert not action.grad[3:].any()


def test_elsewhere_by_hand():
    """The action is the preference for style and for hurry: one moved to the other is (0, sum)."""
    actor = make_actor(Bounded(-1.0, 1.0, (2,)), in_features=1 + 3, num_cells=())
    with torch.no_grad():
        actor[0].module[-1].weight.copy_(torch.tensor([[0.0, 1, 0, 0], [0, 0, 0, 1]]))
        actor[0].module[-1].bias.zero_()
    batch = TensorDict(
        observation=torch.zeros(3, 1),
        preference=torch.tensor([[0.5, 0.2, 0.3], [0.5, 0.2, 0.3], [0.0, 0.7, 0.3]]),
        batch_size=[3],
    )
    before = batch.clone()
    action = actor(batch.clone())["action"]

    def cost(stands: list[bool]) -> torch.Tensor:
        return penalties.elsewhere(
            batch, action, actor, stands=torch.tensor(stands), demo=0, efficiency=2
        )

    half, most, third = (torch.tensor(value).tanh() for value in (0.5, 0.8, 0.3))
    apart = half**2 + (most - third) ** 2
    torch.testing.assert_close(cost([True, False, False]), apart / 3)
    torch.testing.assert_close(cost([False, False, False]), 2 * apart / 3)
    torch.testing.assert_close(cost([True, True, True]), torch.tensor(0.0))
    assert (batch == before).all() and set(batch.keys()) == set(before.keys())


def test_mirror_by_hand():
    """The speed is the goal's distance; the turn rate the sine of its bearing, and a tenth to the left."""
    actor = make_actor(Bounded(-1.0, 1.0, (2,)), in_features=5 + 2, num_cells=())
    with torch.no_grad():
        actor[0].module[-1].weight.zero_()
        actor[0].module[-1].bias.zero_()
        actor[0].module[-1].weight[0, 2] = actor[0].module[-1].weight[1, 3] = 1.0
    batch = TensorDict(
        observation=torch.rand(3, 5),
        preference=torch.tensor([[0.0, 1.0], [0.5, 0.5], [1.0, 0.0]]),
        batch_size=[3],
    )
    parts = {"lidar": range(2), "goal": range(2, 5)}

    def cost(demo: int | None) -> torch.Tensor:
        action = actor(batch.clone())["action"]
        return penalties.mirror(batch, action, actor, parts=parts, demo=demo)

    torch.testing.assert_close(cost(None), torch.tensor(0.0))
    with torch.no_grad():
        actor[0].module[-1].bias[1] = 0.1
        batch["observation"][:, 3] = 0.0
    # tanh(0.1) to the left in the world and in its image: twice as much to the other side is missing.
    asymmetry = (2 * torch.tensor(0.1).tanh()) ** 2
    torch.testing.assert_close(cost(None), asymmetry)
    # The first entry demonstrates: of 1, 1/8 and 0.
    torch.testing.assert_close(cost(0), asymmetry * 1.125 / 3)
    assert "action" not in batch.keys()
