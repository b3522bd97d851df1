"""Mirror images of observations and actions, beside the features of a mirrored world."""

from __future__ import annotations

import pytest
import torch

from torchrl_morl.deploy import Sensing
from torchrl_morl.deploy.features import observation, observation_parts
from torchrl_morl.deploy.mirror import mirror_action, mirror_observation

KINDS = (
    {"observe_human": False},
    {},
    {"observe_human_velocity": True},
    {"observe_nobody": True},
    {"observe_human": False, "observe_robot": True},
    {"observe_motion": True},
    {
        "observe_human_velocity": True,
        "observe_nobody": True,
        "observe_robot": True,
        "observe_motion": True,
    },
)
SIDE = torch.tensor([1.0, -1.0])


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_the_features_of_a_mirrored_world_are_the_mirrored_features(kind):
    """Sectors the other way around; bearings and the velocity to the left with the other sign."""
    lidar = 0.2 + 3.8 * torch.rand(7, 30)
    goal, human = torch.rand(2, 7, 2) * torch.tensor([4.0, 6.0]) - torch.tensor([0.0, 3.0])
    velocity, nobody = torch.randn(7, 2), torch.randint(2, (7, 1)).float()
    # The lidar of some is behind the rotation centre.
    robot = torch.rand(7, 6) + torch.tensor([0.1, 0.1, 0.1, 3.0, 3.0, -0.5])
    motion = torch.randn(7, 10)
    sensing, same = Sensing(**kind), {"nobody": nobody, "robot": robot}
    seen = observation(
        sensing, lidar=lidar, goal=goal, human=human, human_velocity=velocity, motion=motion, **same
    )
    image = observation(
        sensing,
        lidar=lidar.flip(-1),
        goal=goal * SIDE,
        human=human * SIDE,
        human_velocity=velocity * SIDE,
        motion=motion * SIDE.repeat(5),
        **same,
    )
    parts = observation_parts(**kind)
    torch.testing.assert_close(mirror_observation(seen, parts), image)
    torch.testing.assert_close(mirror_observation(image, parts), seen)


def test_an_action_keeps_its_speed():
    action = torch.randn(3, 4, 2)
    torch.testing.assert_close(mirror_action(action), action * SIDE)


def test_what_has_no_image_is_refused():
    with pytest.raises(ValueError, match="no mirror image of colour: parts are lidar, goal"):
        mirror_observation(torch.zeros(3), {"colour": range(3)})
    with pytest.raises(ValueError, match="must have 36 entries"):
        mirror_observation(torch.zeros(5, 38), observation_parts())
