"""What the scalarised baselines are made of, beside what they share with PD-MORL."""

from __future__ import annotations

import dataclasses

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModule, TensorDictSequential, biased_softplus
from torch import Tensor, nn
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import UnaryTransform
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import LossModule, SACLoss, TD3Loss

import torchrl_morl.modules
from envs.policy_env import observation_size
from recipes.pd_morl import utils as pd_morl
from recipes.task import Task
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.transforms import ScalarizeReward


class CoreSpace(PreferenceSpace):
    """Preferences that weigh nothing: only objectives with a static weight count."""

    def weights(self, preference: Tensor) -> Tensor:
        return super().weights(torch.zeros_like(preference))


def core_only(task: Task) -> Task:
    """The same task with rewards, and scores of the evaluation, that no preference changes."""
    preference_space = CoreSpace(task.preference_space.objectives, task.preference_space.static)
    return dataclasses.replace(
        task, preference_space=preference_space, facts={"preference": "ignored"}
    )


def make_replay_buffer(cfg: DictConfig, task: Task) -> TensorDictReplayBuffer:
    """PD-MORL's buffer of vector rewards, which adds ``scalar_reward`` to what is sampled.

    In a :class:`CoreSpace` sampled preferences are zero, for :func:`cut_off_preference`.
    """
    replay_buffer = pd_morl.make_replay_buffer(
        cfg, task.preference_space, task.device, batches=cfg.optim.updates_per_batch
    )
    if isinstance(task.preference_space, CoreSpace):
        keys = ["preference", ("next", "preference")]
        zero = UnaryTransform(in_keys=keys, out_keys=keys, fn=torch.zeros_like)
        replay_buffer.append_transform(zero)
    replay_buffer.append_transform(ScalarizeReward(task.preference_space))
    if cfg.demonstrations.dataset:
        pd_morl.prefill(cfg, replay_buffer, task.preference_space, task.reward_model)
    return replay_buffer


def make_actor(cfg: DictConfig, task: Task) -> TensorDictSequential:
    return torchrl_morl.modules.make_actor(
        task.env.action_spec_unbatched,
        in_features=observation_size(cfg.env) + task.preference_space.num_tunable,
        num_cells=cfg.network.num_cells,
        device=task.device,
    )


def make_stochastic_policy(
    cfg: DictConfig, task: Task, actor: TensorDictSequential
) -> ProbabilisticActor:
    """A squashed Gaussian around the actor's pre-tanh output.

    It shares all layers with ``actor`` and adds one for the standard deviation, so that training it
    trains the actor, whose action is the tanh of the mean.

    Raises:
        ValueError: unless ``network.min_scale`` lies between zero and ``network.initial_scale``.
    """
    initial, least = cfg.network.initial_scale, cfg.network.min_scale
    if not 0 < least < initial:
        raise ValueError(
            f"network.min_scale must be in (0, network.initial_scale), got {least} and {initial}."
        )
    *hidden, mean = actor[0].module
    scale = nn.Sequential(
        nn.Linear(mean.in_features, mean.out_features, device=task.device),
        biased_softplus(initial, least),
    )
    return ProbabilisticActor(
        TensorDictSequential(
            TensorDictModule(
                _Hidden(*hidden), in_keys=["observation", "preference"], out_keys=["hidden"]
            ),
            TensorDictModule(mean, in_keys=["hidden"], out_keys=["loc"]),
            TensorDictModule(scale, in_keys=["hidden"], out_keys=["scale"]),
        ),
        in_keys=["loc", "scale"],
        spec=task.env.action_spec_unbatched,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -1.0, "high": 1.0},
        return_log_prob=True,
    )


class _Hidden(nn.Sequential):
    """The hidden layers of a :class:`torchrl.modules.MLP`, which concatenates its inputs."""

    def forward(self, *inputs: Tensor) -> Tensor:
        return super().forward(torch.cat(inputs, dim=-1))


def cut_off_preference(actor: TensorDictSequential, preference_space: PreferenceSpace) -> None:
    """Zero what the actor's first layer makes of the preference.

    Trained with zero preferences these weights get no gradient and stay zero: the policy keeps the
    inputs that all policies have, and ignores the last of them.
    """
    first = actor[0].module[0]
    with torch.no_grad():
        first.weight[:, -preference_space.num_tunable :] = 0.0


def make_td3_loss(cfg: DictConfig, task: Task, actor: TensorDictSequential) -> TD3Loss:
    loss = TD3Loss(
        actor,
        _make_critics(cfg, task),
        action_spec=task.env.action_spec_unbatched,
        policy_noise=cfg.loss.policy_noise,
        noise_clip=cfg.loss.noise_clip,
        loss_function=cfg.loss.loss_function,
        deactivate_vmap=True,  # a loop over two critics is faster on a CPU
    )
    return _configure(cfg, task, loss)


def make_sac_loss(cfg: DictConfig, task: Task, policy: ProbabilisticActor) -> SACLoss:
    if not cfg.loss.alpha_init > 0:
        raise ValueError(f"loss.alpha_init must be positive, got {cfg.loss.alpha_init}.")
    loss = SACLoss(
        policy,
        _make_critics(cfg, task),
        action_spec=task.env.action_spec_unbatched,
        alpha_init=cfg.loss.alpha_init,
        loss_function=cfg.loss.loss_function,
        deactivate_vmap=True,  # a loop over two critics is faster on a CPU
    )
    return _configure(cfg, task, loss)


def _make_critics(cfg: DictConfig, task: Task) -> list[TensorDictModule]:
    """Two scalar critics: the vector critic of PD-MORL with a single value."""
    return [
        pd_morl.make_critic(cfg, task.env, task.preference_space, 1, task.device) for _ in range(2)
    ]


def _configure(cfg: DictConfig, task: Task, loss: LossModule) -> LossModule:
    loss.set_keys(reward="scalar_reward")
    if cfg.loss.truncation_is_terminal:
        loss.set_keys(terminated="done")
    loss.make_value_estimator(gamma=cfg.loss.gamma)
    return loss.to(task.device)
