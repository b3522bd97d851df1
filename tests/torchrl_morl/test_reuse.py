"""The library on somebody else's environment: a dam of MO-Gymnasium, which knows nothing of robots.

Water kept behind the dam floods the shore, water let go is missing when it is needed: one policy
learns the whole trade-off in half a minute. The file reads as an example too.
"""

from __future__ import annotations

from functools import partial

import moocore
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import (
    Compose,
    EnvBase,
    MOGymEnv,
    ObservationNorm,
    RewardScaling,
    SerialEnv,
    TransformedEnv,
)
from torchrl.modules import AdditiveGaussianModule
from torchrl.objectives import SoftUpdate

from torchrl_morl import PreferenceSpace
from torchrl_morl.evaluation import rollout_preferences, steerability
from torchrl_morl.modules import PreferenceInterpolator, make_actor, make_vector_critic
from torchrl_morl.objectives import MOTD3Loss
from torchrl_morl.transforms import PreferenceRelabel, PreferenceSampler

SPACE = PreferenceSpace(("flooding", "deficit"))
EPISODE = 100  # steps, fixed by the environment
REFERENCE = torch.tensor([-3500.0, -1200.0])  # returns worse than those of any policy here
FRAMES, NUM_ENVS, GAMMA, REWARD_SCALE, NOISE = 4_800, 8, 0.9, 0.1, 0.1


def make_env(num_envs: int | None = None, *, seed: int = 0) -> EnvBase:
    make = partial(MOGymEnv, "water-reservoir-v0", normalized_action=True)
    base = make() if num_envs is None else SerialEnv(num_envs, make)
    scaled = ObservationNorm(loc=-1.0, scale=0.02, in_keys=["observation"])  # levels up to 160
    env = TransformedEnv(base, Compose(scaled, PreferenceSampler(SPACE, seed=seed)))
    env.set_seed(seed)
    return env


def mean_returns(env: EnvBase, actor: TensorDictModule, preferences: Tensor) -> Tensor:
    """Undiscounted returns ``[P, 2]`` over the same three episodes for every preference."""
    returns = [
        (data["next", "reward"] * data["mask"].unsqueeze(-1)).sum(-2)
        for seed in range(3)
        for data in [rollout_preferences(env, actor, preferences, max_steps=EPISODE, seed=seed)]
    ]
    return torch.stack(returns).mean(0)


def hypervolume(returns: Tensor) -> float:
    """What the returns dominate, down to the reference; moocore minimises, hence the signs."""
    return moocore.hypervolume(-returns.double().numpy(), ref=-REFERENCE.double().numpy())


def train(actor: TensorDictModule, env: EnvBase, evaluation_env: EnvBase) -> None:
    spec = env.action_spec_unbatched
    critics = [make_vector_critic(2, in_features=1 + 2 + 1, num_cells=(64, 64)) for _ in range(2)]
    interpolator = PreferenceInterpolator(SPACE.corners())
    loss = MOTD3Loss(
        actor,
        critics,
        preference_space=SPACE,
        interpolator=interpolator,
        angle="normalized",
        angle_coeff_actor=0.1,
        pre_tanh_coeff=0.01,
        action_spec=spec,
        policy_noise=NOISE,
        noise_clip=2 * NOISE,
    )
    loss.make_value_estimator(gamma=GAMMA)
    target_updater = SoftUpdate(loss, tau=0.01)
    actor_params = loss.actor_network_params.flatten_keys().values()
    critic_params = loss.qvalue_network_params.flatten_keys().values()
    actor_optimizer = torch.optim.Adam(actor_params, lr=1e-3, fused=True)
    critic_optimizer = torch.optim.Adam(critic_params, lr=1e-3, fused=True)
    replay_buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(FRAMES),
        batch_size=64,
        transform=Compose(
            RewardScaling(0.0, REWARD_SCALE, in_keys=[("next", "reward")]),
            PreferenceRelabel(SPACE, seed=0),
        ),
    )
    noise = AdditiveGaussianModule(spec=spec, sigma_init=NOISE, sigma_end=NOISE)
    collector = Collector(
        env,
        TensorDictSequential(actor, noise),
        frames_per_batch=32,
        total_frames=FRAMES,
        init_random_frames=960,
        auto_register_policy_transforms=False,
    )
    for iteration, data in enumerate(collector):
        replay_buffer.extend(data.reshape(-1))
        if iteration < 30:  # the random frames
            continue
        for update in range(10):
            batch = replay_buffer.sample()
            value_loss, _ = loss.value_loss(batch)
            critic_optimizer.zero_grad()
            value_loss.backward()
            critic_optimizer.step()
            if update % 2:
                actor_loss, _ = loss.actor_loss(batch)
                actor_optimizer.zero_grad()
                actor_loss.backward()
                actor_optimizer.step()
                target_updater.step()
        if iteration % 40 == 0:
            # Returns of the corners in the units of Q: scaled and discounted.
            corners = mean_returns(evaluation_env, actor, SPACE.corners())
            interpolator.refit(REWARD_SCALE * corners / EPISODE / (1 - GAMMA), momentum=0.5)
    collector.shutdown()


def test_one_policy_learns_the_trade_off_of_a_dam(seed: int = 0):
    torch.manual_seed(seed)
    env, evaluation_env = make_env(NUM_ENVS, seed=seed), make_env()
    actor = make_actor(env.action_spec_unbatched, in_features=1 + 2, num_cells=(64, 64))
    preferences = SPACE.lattice(4)

    untrained = mean_returns(evaluation_env, actor, preferences)
    train(actor, env, evaluation_env)
    trained = mean_returns(evaluation_env, actor, preferences)

    assert (untrained > REFERENCE).all()  # so that both hypervolumes are positive
    assert hypervolume(trained) > 3 * hypervolume(untrained)
    # Better everywhere is not enough: each objective follows its weight.
    for column in range(2):
        assert steerability(preferences[:, column], trained[:, column]) >= 0.9
