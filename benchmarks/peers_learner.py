"""Updates by others, written for the comparison: PD-MORL's own code, and TorchRL's TD3 recipe."""

from __future__ import annotations

import itertools
import random

import numpy as np
import torch
from scipy.interpolate import RBFInterpolator
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.data import Bounded, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import MLP, TanhModule
from torchrl.objectives import SoftUpdate, TD3Loss

from .learner_base import ACTION_SIZE, TD3Learner

CELLS = (256, 256, 256, 256)
BATCH_SIZE = 256


def _mlp(sizes: list[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise(sizes):
        layers += [nn.Linear(fan_in, fan_out), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


class OfficialUpdate(TD3Learner):
    """An update as the published code of PD-MORL does it (https://arxiv.org/abs/2208.07914).

    Written after its description: a list of transitions, SciPy's interpolator at every update,
    critics trained on smooth-L1 and angle, an actor on utility and angle, and targets that follow
    at every ``policy_delay``-th update. Here all four objectives are weighed, with 4 x 256 networks.
    """

    def __init__(self, data: TensorDict, policy_delay: int) -> None:
        super().__init__()
        self.policy_delay = policy_delay
        reward = data["next", "reward"]
        objectives = reward.shape[-1]
        state = data["observation"].shape[-1] + objectives
        self.actor = _mlp([state, *CELLS, ACTION_SIZE])
        self.critics = nn.ModuleList(
            _mlp([state + ACTION_SIZE, *CELLS, objectives]) for _ in range(2)
        )
        self.target_actor = _mlp([state, *CELLS, ACTION_SIZE])
        self.target_critics = nn.ModuleList(
            _mlp([state + ACTION_SIZE, *CELLS, objectives]) for _ in range(2)
        )
        self.target_actor.load_state_dict(self.actor.state_dict())
        self.target_critics.load_state_dict(self.critics.state_dict())
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), lr=3e-4)
        self.critic_optimizer = torch.optim.Adam(self.critics.parameters(), lr=3e-4)
        keys = np.eye(objectives)
        self.interpolator = RBFInterpolator(keys, 0.75 * keys + 0.1, kernel="linear")
        # Hindsight preferences are drawn when a transition is stored.
        preference = torch.randn(len(data), objectives).abs()
        preference = preference / preference.sum(-1, keepdim=True)
        columns = (
            data["observation"],
            preference,
            data["action"],
            data["next", "observation"],
            reward / 100,
            data["next", "done"].float(),
        )
        self.buffer = list(zip(*(column.numpy() for column in columns), strict=True))

    def _sample(self) -> None:
        chosen = random.sample(self.buffer, BATCH_SIZE)
        columns = (np.stack(column) for column in zip(*chosen, strict=True))
        self.batch = [torch.from_numpy(column) for column in columns]
        projected = self.interpolator(self.batch[1].numpy())
        self.projected = torch.tensor(projected, dtype=torch.float32)

    def _angle(self, values: Tensor) -> Tensor:
        cosine = F.cosine_similarity(self.projected, values, dim=-1)
        return torch.rad2deg(torch.acos(cosine.clamp(0, 0.9999)))

    def _critic_gradients(self) -> None:
        state, preference, action, next_state, reward, done = self.batch
        with torch.no_grad():
            noise = (torch.randn_like(action) * 0.2).clamp(-0.5, 0.5)
            following = torch.cat((next_state, preference), dim=-1)
            next_action = (self.target_actor(following).tanh() + noise).clamp(-1, 1)
            inputs = torch.cat((following, next_action), dim=-1)
            values = torch.stack([critic(inputs) for critic in self.target_critics])
            # Without the look at every sample from Python that the published code has.
            lowest = (preference * values).sum(-1).argmin(0)
            target = values[lowest, torch.arange(len(lowest))]
            target = reward + 0.995 * (1 - done) * target
        inputs = torch.cat((state, preference, action), dim=-1)
        self.loss_value = sum(
            self._angle(value).mean() + F.smooth_l1_loss(value, target)
            for value in (critic(inputs) for critic in self.critics)
        )
        self.critic_optimizer.zero_grad()
        self.loss_value.backward()
        nn.utils.clip_grad_norm_(self.critics.parameters(), 100.0)

    def _critic_step(self) -> None:
        self.critic_optimizer.step()

    def _actor_gradients(self) -> None:
        state, preference, *_ = self.batch
        inputs = torch.cat((state, preference), dim=-1)
        value = self.critics[0](torch.cat((inputs, self.actor(inputs).tanh()), dim=-1))
        utility = (preference * value).sum(-1)
        self.loss_value = -utility.mean() + 10 * self._angle(value).mean()
        self.actor_optimizer.zero_grad()
        self.loss_value.backward()
        nn.utils.clip_grad_norm_(self.actor.parameters(), 100.0)

    def _actor_step(self) -> None:
        self.actor_optimizer.step()

    @torch.no_grad()
    def _follow(self) -> None:
        pairs = ((self.actor, self.target_actor), (self.critics, self.target_critics))
        for trained, target in pairs:
            for parameter, follower in zip(trained.parameters(), target.parameters(), strict=True):
                follower.copy_(0.995 * follower + 0.005 * parameter)


class StockTD3(TD3Learner):
    """The loop of TorchRL's TD3 example with ``TD3Loss``: one objective, no preference to relabel."""

    policy_delay = 2

    def __init__(self, data: TensorDict) -> None:
        super().__init__()
        state = data["observation"].shape[-1] + data["preference"].shape[-1]
        spec = Bounded(-1.0, 1.0, (ACTION_SIZE,))
        kwargs = {"num_cells": list(CELLS), "activation_class": nn.ReLU}
        actor = TensorDictSequential(
            TensorDictModule(
                MLP(in_features=state, out_features=ACTION_SIZE, **kwargs),
                in_keys=["observation", "preference"],
                out_keys=["param"],
            ),
            TanhModule(in_keys=["param"], out_keys=["action"], spec=spec),
        )
        critic = TensorDictModule(
            MLP(in_features=state + ACTION_SIZE, out_features=1, **kwargs),
            in_keys=["observation", "preference", "action"],
            out_keys=["state_action_value"],
        )
        self.loss = TD3Loss(actor, critic, num_qvalue_nets=2, action_spec=spec, loss_function="l2")
        self.loss.make_value_estimator(gamma=0.99)
        self.target_updater = SoftUpdate(self.loss, eps=0.995)
        self.actor_optimizer, self.critic_optimizer = (
            torch.optim.Adam(params.flatten_keys().values(), lr=3e-4)
            for params in (self.loss.actor_network_params, self.loss.qvalue_network_params)
        )
        data = data.clone()
        data["next", "reward"] = data["next", "reward"].sum(-1, keepdim=True) / 100
        storage = LazyTensorStorage(len(data))
        self.replay_buffer = TensorDictReplayBuffer(storage=storage, batch_size=BATCH_SIZE)
        self.replay_buffer.extend(data)

    def _sample(self) -> None:
        self.batch = self.replay_buffer.sample()

    def _critic_gradients(self) -> None:
        self.critic_optimizer.zero_grad()
        self.loss_value, _ = self.loss.value_loss(self.batch)
        self.loss_value.backward()

    def _critic_step(self) -> None:
        self.critic_optimizer.step()

    def _actor_gradients(self) -> None:
        self.actor_optimizer.zero_grad()
        self.loss_value, _ = self.loss.actor_loss(self.batch)
        self.loss_value.backward()

    def _actor_step(self) -> None:
        self.actor_optimizer.step()

    def _follow(self) -> None:
        self.target_updater.step()
