"""Vector-valued TD3 on a task of MO-Gymnasium with the parts alone, and its front: ``python -m examples.vector_td3``.

One policy for all preferences between fast and sparing of a cheetah. Raise ``steps`` to 200,000 for one that runs.
"""

import torch
from tensordict.nn import TensorDictSequential
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, DoubleToFloat, MOGymEnv, TransformedEnv
from torchrl.modules import AdditiveGaussianModule
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from torchrl_morl import PreferenceSpace
from torchrl_morl.evaluation import expected_utility, hypervolume, rollout_preferences
from torchrl_morl.modules import make_actor, make_vector_critic
from torchrl_morl.objectives import MOTD3Loss
from torchrl_morl.transforms import PreferenceRelabel, PreferenceSampler

BATCH = 50


def main(name: str = "mo-halfcheetah-v5", steps: int = 1000, episode: int = 200) -> torch.Tensor:
    """Train, and return what each preference of a lattice gives, ``[P, K]``."""
    torch.manual_seed(0)
    space = PreferenceSpace(("velocity", "energy"))  # the order of the reward
    sampler = PreferenceSampler(space, seed=0)
    env = TransformedEnv(MOGymEnv(name), Compose(DoubleToFloat(), sampler))

    actor = make_actor(env.action_spec, env.observation_spec, num_cells=(64, 64))
    noise = AdditiveGaussianModule(spec=env.action_spec, sigma_init=0.2, sigma_end=0.2)
    policy = TensorDictSequential(actor, noise)
    loss = MOTD3Loss(
        actor,
        make_vector_critic(2, env.observation_spec, env.action_spec, num_cells=(64, 64)),
        preference_space=space,
        action_spec=env.action_spec,
    )
    loss.make_value_estimator(gamma=0.99)
    target = SoftUpdate(loss, tau=0.005)
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-4)
    # Three quarters of a batch get another preference: a vector reward is valid for all of them.
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(steps), batch_size=128, transform=PreferenceRelabel(space, seed=0)
    )

    data = env.reset()
    for _ in tqdm(range(0, steps, BATCH), unit=f"{BATCH} steps"):
        with torch.no_grad():
            batch = env.rollout(
                BATCH, policy, auto_reset=False, tensordict=data, break_when_any_done=False
            )
        buffer.extend(batch)
        data = env.step_mdp(batch[-1]) if not batch[-1]["next", "done"] else env.reset()
        for _ in range(BATCH):
            losses = loss(buffer.sample())
            optimizer.zero_grad()
            (losses["loss_actor"] + losses["loss_qvalue"]).backward()
            optimizer.step()
            target.step()

    preferences = space.lattice(4)
    data = rollout_preferences(env, actor, preferences, max_steps=episode, seed=1)
    returns = (data["next", "reward"] * data["mask"].unsqueeze(-1)).sum(-2)  # [P, K]
    for preference, found in zip(preferences.tolist(), returns.tolist()):
        print(f"velocity {preference[0]:.2f}: velocity {found[0]:8.1f}, energy {found[1]:8.1f}")
    print(f"hypervolume above (-1000, -1000): {hypervolume(returns, torch.full((2,), -1e3)):.4g}")
    print(f"expected utility: {expected_utility(preferences, returns):.1f}")
    return returns


if __name__ == "__main__":
    main()
