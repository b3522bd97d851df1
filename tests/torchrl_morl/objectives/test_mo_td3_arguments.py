"""Multi-objective TD3: what is refused, and how."""

from __future__ import annotations

import pytest
import torch

from tests._mo_td3 import (
    SPACE,
    SPEC,
    make_batch,
    make_loss,
    make_networks,
)
from torchrl_morl.modules import PreferenceInterpolator
from torchrl_morl.objectives import MOTD3Loss


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"angle": "degrees"}, "angle must be None or one of"),
        ({"angle": None}, "no effect without angle"),
        ({"interpolator": None}, "needs an interpolator"),
        ({"interpolator": PreferenceInterpolator(torch.eye(3))}, "3 tunable objectives"),
        ({"angle_coeff_actor": -1.0}, "angle_coeff_actor must not be negative"),
        ({"pre_tanh_coeff": -1.0}, "pre_tanh_coeff must not be negative"),
        ({"pre_tanh_coeff": float("nan")}, "pre_tanh_coeff .* must be finite, got nan"),
        ({"angle_coeff_critic": float("inf")}, "angle_coeff_critic .* must be finite, got inf"),
        ({"policy_noise": -0.1}, "policy_noise must not be negative"),
        ({"noise_clip": float("nan")}, "noise_clip .* must be finite, got nan"),
        (
            {"angle": "raw", "interpolator": PreferenceInterpolator(torch.eye(2))},
            "^angle='raw' compares raw values with directions in the normalized space of the "
            "interpolator: give it value_space='raw'.$",
        ),
        (
            {"interpolator": PreferenceInterpolator(torch.eye(2), value_space="raw")},
            "^angle='normalized' compares .* in the raw space .*: give it value_space='normalized'.$",
        ),
        ({"target_selection": "median"}, "target_selection must be one of"),
        ({"action_spec": None}, "bounds"),
    ],
)
def test_bad_constructor_arguments(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_loss(**kwargs)


def test_unknown_key():
    with pytest.raises(ValueError, match="not an accepted tensordict key"):
        make_loss().set_keys(weight="w")


@pytest.mark.parametrize("method", ["actor_loss", "value_loss"])
def test_preference_without_its_space(method):
    loss = MOTD3Loss(*make_networks(), action_spec=SPEC)
    with pytest.raises(ValueError, match="gives 2 weights, the critic 3 values"):
        getattr(loss, method)(make_batch(4))


def test_one_weight_does_not_broadcast_over_the_objectives():
    loss = MOTD3Loss(*make_networks(num_objectives=3, num_tunable=1), action_spec=SPEC)
    with pytest.raises(ValueError, match="gives 1 weights, the critic 3 values"):
        loss(make_batch(4, num_tunable=1))


@pytest.mark.parametrize("num_rewards", [1, 4])
def test_reward_of_the_wrong_length(num_rewards):
    with pytest.raises(ValueError, match="one entry per objective"):
        make_loss()(make_batch(4, num_objectives=num_rewards))


def test_pre_tanh_penalty_without_a_pre_tanh_output():
    loss = make_loss()
    loss.set_keys(pre_tanh="logit")
    with pytest.raises(KeyError, match="pre_tanh_coeff needs the actor to write 'logit'"):
        loss(make_batch(4))


def test_missing_preference():
    batch = make_batch(4).exclude("preference", ("next", "preference"))
    with pytest.raises(KeyError, match="preference"):
        make_loss()(batch)


def test_networks_that_write_other_keys():
    actor, critic = make_networks()
    critic.out_keys = ["q"]
    with pytest.raises(
        KeyError, match=r"the critic writes \['q'\].*set_keys\(state_action_value='q'\)"
    ):
        MOTD3Loss(actor, critic, preference_space=SPACE, action_spec=SPEC).actor_loss(make_batch(4))
    loss = make_loss()
    loss.set_keys(action="command")
    batch = make_batch(4)
    batch["command"] = batch["action"]
    with pytest.raises(KeyError, match=r"the actor writes .*set_keys\(action='action'\)"):
        loss.actor_loss(batch)
