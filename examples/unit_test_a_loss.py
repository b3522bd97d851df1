"""Unit tests of a vector-reward loss, with ``torchrl_morl.testing``: closed forms first.

python -m pytest examples/unit_test_a_loss.py
"""

import copy

import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs import TransformedEnv

from torchrl_morl import PreferenceSpace
from torchrl_morl.modules import make_actor, make_vector_critic
from torchrl_morl.objectives import MOTD3Loss
from torchrl_morl.testing import VectorRewardMockEnv
from torchrl_morl.transforms import PreferenceSampler

SPACE = PreferenceSpace(("left", "right", "up"))
SPEC = Bounded(-1.0, 1.0, (2,))


def batch() -> TensorDict:
    """Transitions of a small environment, as a collector gives them."""
    env = TransformedEnv(VectorRewardMockEnv(3, batch_size=(4,)), PreferenceSampler(SPACE, seed=0))
    return env.rollout(8, break_when_any_done=False).reshape(-1)


def make_loss() -> MOTD3Loss:
    torch.manual_seed(0)
    actor = make_actor(SPEC, in_features=2 + 3, num_cells=(8,))
    critics = [make_vector_critic(3, in_features=2 + 3 + 2, num_cells=(8,)) for _ in range(2)]
    loss = MOTD3Loss(actor, critics, preference_space=SPACE, action_spec=SPEC)
    loss.make_value_estimator(gamma=0.9)
    return loss


def test_the_target_of_a_last_step_is_its_reward():
    data = batch()
    data["next", "terminated"].fill_(True)
    _, metadata = make_loss().value_loss(data)
    utility = (data["preference"] * data["next", "reward"]).sum(-1)
    torch.testing.assert_close(metadata["target_value"], utility)


def test_every_parameter_gets_a_gradient_from_its_own_loss():
    loss = make_loss()
    losses = loss(batch())
    (losses["loss_actor"] + losses["loss_qvalue"]).backward()
    for name, parameter in loss.named_parameters():
        if "target" not in name:
            assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


def test_a_copy_computes_the_same():
    loss, data = make_loss(), batch()
    torch.manual_seed(1)
    first = loss(data.clone())["loss_qvalue"]
    torch.manual_seed(1)
    torch.testing.assert_close(copy.deepcopy(loss)(data.clone())["loss_qvalue"], first)
