"""Who stands, as in what was demonstrated: by hand."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict

from recipes.training.people import WhereSomebodyStands, human_speed, somebody_stands
from torchrl_morl.deploy import Sensing
from torchrl_morl.deploy.features import observation, observation_parts
from torchrl_morl.modules import RewardModel

VELOCITY = {"observe_human_velocity": True}
ANY_ROBOT = VELOCITY | {"observe_nobody": True, "observe_robot": True}
KINDS = ({}, VELOCITY, {"observe_nobody": True}, ANY_ROBOT)
LAST = [0.2, 0.25, 2.0, 6.28, 4.0, 0.0]
"""A robot with a top speed of 0.25 m/s."""


def seen(observed: dict[str, bool], velocity: list[list[float]], nobody: list[float]):
    count = len(nobody)
    return observation(
        Sensing(**observed),
        lidar=torch.full((count, 30), 4.0),
        goal=torch.tensor([5.0, 0.0]).expand(count, 2),
        human=torch.tensor([2.0, 1.0]).expand(count, 2),
        human_velocity=torch.tensor(velocity),
        nobody=torch.tensor(nobody).unsqueeze(-1),
        robot=torch.tensor(LAST).expand(count, 6),
    )


@pytest.mark.parametrize("observed", KINDS)
def test_speed_of_the_human_is_in_metres_per_second_for_any_robot(observed):
    speed = human_speed(seen(observed, [[0.3, -0.4]], [0.0]), observation_parts(**observed))
    if "observe_human_velocity" in observed:
        torch.testing.assert_close(speed, torch.tensor([0.5]))
    else:
        assert speed is None


@pytest.mark.parametrize(
    ("observed", "stands"),
    list(zip(KINDS, (None, [True, False, True], [True, True, False], [True, False, False]))),
)
def test_who_stands(observed, stands):
    features = seen(observed, [[0.1, 0.2], [0.3, 0.1], [0.0, 0.0]], [0.0, 0.0, 1.0])
    found = somebody_stands(features, observation_parts(**observed))
    assert found is None if stands is None else found.tolist() == stands


def test_a_style_pays_only_where_somebody_stands():
    torch.manual_seed(0)
    features = seen(ANY_ROBOT, [[0.1, 0.2], [0.3, 0.1], [0.0, 0.0]], [0.0, 0.0, 1.0])
    model = RewardModel(in_features=features.shape[-1] + 2, num_cells=(8,))
    gated = WhereSomebodyStands(model, observation_parts(**ANY_ROBOT))
    data = TensorDict(observation=features, action=torch.zeros(3, 2), batch_size=[3])
    everywhere = model(data.clone())["demo_score"]
    for one in (gated, copy.deepcopy(gated), pickle.loads(pickle.dumps(gated))):
        score = one(data.clone())["demo_score"]
        torch.testing.assert_close(score[0], everywhere[0])
        assert score[0] > 0 and (score[1:] == 0).all()


def test_it_needs_to_be_told():
    model = RewardModel(in_features=36 + 2, num_cells=(8,))
    with pytest.raises(
        ValueError, match=r"demonstrations\.standing_only needs env\.observe_human_vel"
    ):
        WhereSomebodyStands(model, observation_parts())
