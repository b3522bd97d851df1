"""The update of ``recipes.pd_morl`` by hand: the ceiling that a library can be held against.

The same maths to rounding (``tests/benchmarks/test_learner.py``), and nothing else: no TorchRL, no
TensorDict, no metadata for a log. Transitions lie in one matrix, so that a batch is one look-up.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.nn import functional as F

from recipes.training.agent import make_straight_drive_value
from recipes.training.gradients import tracing_backward
from torchrl_morl.objectives import angle_between

from .learner_base import TD3Learner
from .ours import Ours

Layer = list[Tensor]
"""Weight and bias, and, in front of the activation, those of the LayerNorm."""


def _layers(params: TensorDict) -> list[Layer]:
    """Parameters of an MLP in the order of its modules, copied."""
    names = sorted(params.keys(), key=int)
    modules = [
        [params[name, part].detach().clone() for part in ("weight", "bias")] for name in names
    ]
    layers: list[Layer] = []
    for weight, bias in modules:
        if weight.ndim == 1:
            layers[-1] += [weight, bias]
        else:
            layers.append([weight, bias])
    return layers


def mlp(x: Tensor, layers: list[Layer]) -> Tensor:
    for weight, bias, *norm in layers[:-1]:
        x = F.linear(x, weight, bias)
        if norm:
            x = F.layer_norm(x, norm[0].shape, *norm)
        x = F.relu(x)
    return F.linear(x, *layers[-1])


def _flat(layers: list[Layer]) -> list[Tensor]:
    return [parameter for layer in layers for parameter in layer]


def _compiled(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """With the backward pass in the graph, as the recipe."""
    compiled = torch.compile(function, fullgraph=True)

    @functools.wraps(function)
    def run(*batch: Tensor) -> Tensor:
        with tracing_backward():
            return compiled(*batch)

    return run


class BareLoop(TD3Learner):
    """The same networks, losses and optimizers as an :class:`~benchmarks.ours.Ours`."""

    def __init__(self, ours: Ours, data: TensorDict, *, compiled: bool = False) -> None:
        super().__init__()
        cfg, loss, preference_space = ours.cfg, ours.loss, ours.preference_space
        if cfg.preference.relabel_distribution != "jeffreys":
            raise ValueError(
                "The bare loop draws preferences from jeffreys only, "
                f"got preference.relabel_distribution={cfg.preference.relabel_distribution!r}."
            )
        self.cfg, self.policy_delay, self.preference_space = (
            cfg,
            ours.policy_delay,
            preference_space,
        )
        self.batch_size = cfg.replay_buffer.batch_size
        self.interpolator, self.angle = loss.interpolator, loss.angle
        self.tunable = torch.tensor(preference_space.tunable_indices)
        self.actor = _layers(loss.actor_network_params["module", "0", "module"])
        self.straight_drive = None
        # Where the critic is one of several modules, it is the first.
        critic = ("module",)
        if cfg.network.straight_drive:
            self.straight_drive = make_straight_drive_value(cfg, ours.task)
            critic = ("module", "0", "module")
        self.critics = [_layers(params[critic]) for params in loss.qvalue_network_params]
        self.actor_parameters = _flat(self.actor)
        self.critic_parameters = [p for critic in self.critics for p in _flat(critic)]
        # Targets and average follow; only these two are trained.
        self.target_actor = [[p.clone() for p in layer] for layer in self.actor]
        self.target_critics = [
            [[p.clone() for p in layer] for layer in critic] for critic in self.critics
        ]
        self.targets = _flat(self.target_actor)
        self.targets += [p for critic in self.target_critics for p in _flat(critic)]
        self.average: list[Tensor] = []
        for parameter in self.actor_parameters + self.critic_parameters:
            parameter.requires_grad_()
        # Views of the same memory that lead no gradient to the first critic.
        self.frozen_critic = [[p.detach() for p in layer] for layer in self.critics[0]]
        self.optimizers = [
            torch.optim.Adam(parameters, lr=cfg.optim.lr, fused=True)
            for parameters in (self.actor_parameters, self.critic_parameters)
        ]
        parts = (
            data["observation"],
            data["preference"],
            data["action"],
            data["next", "observation"],
            cfg.replay_buffer.reward_scale * data["next", "reward"],
            data["next", "done" if cfg.loss.truncation_is_terminal else "terminated"].float(),
        )
        self.sizes = [part.shape[-1] for part in parts]
        self.storage = torch.cat(parts, dim=-1)
        self.batches: list[tuple[Tensor, ...]] = []
        self.critic_gradients, self.actor_gradients = (
            self._gradients(self._critic_loss, self.critic_parameters),
            self._gradients(self._actor_loss, self.actor_parameters),
        )
        if compiled:
            self.critic_gradients = _compiled(self.critic_gradients)
            self.actor_gradients = _compiled(self.actor_gradients)

    # --- stages ---

    def _sample(self) -> None:
        if not self.batches:
            self.batches = list(zip(*(p.split(self.batch_size) for p in self._rows()), strict=True))
        self.batch = self.batches.pop()

    def _rows(self) -> list[Tensor]:
        """For the next updates at once, as the recipe."""
        number = self.batch_size * self.cfg.optim.updates_per_batch
        rows = self.storage.index_select(0, torch.randint(len(self.storage), (number,)))
        state, preference, *others = rows.split(self.sizes, dim=-1)
        drawn = torch.randn_like(preference).square()
        drawn = drawn / drawn.sum(-1, keepdim=True)
        relabelled = torch.rand(number, 1) < self.cfg.preference.relabel_ratio
        return [state, torch.where(relabelled, drawn, preference), *others]

    def _gradients(
        self, function: Callable[..., Tensor], parameters: list[Tensor]
    ) -> Callable[..., Tensor]:
        def run(*batch: Tensor) -> Tensor:
            for parameter in parameters:
                parameter.grad = None
            loss = function(*batch)
            loss.backward(inputs=parameters)
            torch.nn.utils.clip_grad_norm_(parameters, self.cfg.optim.max_grad_norm, foreach=True)
            return loss.detach()

        return run

    def _critic_gradients(self) -> None:
        self.loss_value = self.critic_gradients(*self.batch)

    def _critic_step(self) -> None:
        self.optimizers[1].step()

    def _actor_gradients(self) -> None:
        self.loss_value = self.actor_gradients(*self.batch)

    def _actor_step(self) -> None:
        self.optimizers[0].step()

    @torch.no_grad()
    def _follow(self) -> None:
        trained = self.actor_parameters + self.critic_parameters
        torch._foreach_lerp_(self.targets, trained, 1 - self.cfg.optim.polyak)
        kept = self.cfg.optim.actor_average
        if self.average:
            torch._foreach_lerp_(self.average, self.actor_parameters, 1 - kept)
        elif kept is not None:
            # As AveragedModel: the average starts from the first update.
            self.average = [p.clone() for p in self.actor_parameters]

    # --- losses ---

    def _value(self, state: Tensor, preference: Tensor, action: Tensor, critic: list[Layer]):
        value = mlp(torch.cat((state, preference, action), dim=-1), critic)
        return value if self.straight_drive is None else value + self.straight_drive(state)

    def _weights(self, preference: Tensor) -> Tensor:
        (_, core), *more = self.preference_space.static
        assert not more and self.preference_space.objectives[0] == "core"
        return F.pad(preference, (1, 0), value=core)

    def _direction_angle(self, preference: Tensor, values: Tensor) -> Tensor:
        values = self.interpolator.normalize(values[..., self.tunable])
        return angle_between(self.interpolator(preference), values)

    def _critic_loss(
        self,
        state: Tensor,
        preference: Tensor,
        action: Tensor,
        next_state: Tensor,
        reward: Tensor,
        done: Tensor,
    ) -> Tensor:
        cfg = self.cfg.loss
        weights = self._weights(preference)
        with torch.no_grad():
            noise = (torch.randn_like(action) * cfg.policy_noise).clamp(
                -cfg.noise_clip, cfg.noise_clip
            )
            following = torch.cat((next_state, preference), dim=-1)
            next_action = (mlp(following, self.target_actor).tanh() + noise).clamp(-1, 1)
            first, second = (
                self._value(next_state, preference, next_action, critic)
                for critic in self.target_critics
            )
            gap = (weights * (second - first)).sum(-1, keepdim=True)
            target = reward + cfg.gamma * (1 - done) * torch.where(gap < 0, second, first)
        values = [self._value(state, preference, action, critic) for critic in self.critics]
        error = F.smooth_l1_loss if cfg.loss_function == "smooth_l1" else F.mse_loss
        loss = sum(error(value, target) for value in values)
        if self.angle is not None and cfg.angle_coeff_critic:
            for value in values:
                angle = self._direction_angle(preference, value)
                loss = loss + cfg.angle_coeff_critic * angle.mean()
        return loss

    def _actor_loss(
        self,
        state: Tensor,
        preference: Tensor,
        action: Tensor,
        next_state: Tensor,
        reward: Tensor,
        done: Tensor,
    ) -> Tensor:
        cfg = self.cfg.loss
        pre_tanh = mlp(torch.cat((state, preference), dim=-1), self.actor)
        value = self._value(state, preference, pre_tanh.tanh(), self.frozen_critic)
        loss = -(self._weights(preference) * value).sum(-1).mean()
        if cfg.pre_tanh_coeff:
            loss = loss + cfg.pre_tanh_coeff * pre_tanh.square().mean()
        if self.angle is not None and cfg.angle_coeff_actor:
            angle = self._direction_angle(preference, value)
            loss = loss + cfg.angle_coeff_actor * angle.mean()
        return loss
