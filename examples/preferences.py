"""Preferences in an environment that knows nothing of them: MO-Gymnasium's dam, flooding against need.

An environment of MO-Gymnasium's is a TorchRL environment through ``MOGymEnv``. A transform adds the
preference that a policy reads, another what it says about the vector reward.
"""

import argparse

import torch
from torchrl.envs import Compose, MOGymEnv, TransformedEnv

from torchrl_morl import PreferenceSpace
from torchrl_morl.transforms import PreferenceSampler, ScalarizeReward

SPACE = PreferenceSpace(("flooding", "deficit"))


def main() -> None:
    base = MOGymEnv("water-reservoir-v0", normalized_action=True)
    env = TransformedEnv(base, Compose(PreferenceSampler(SPACE, seed=0), ScalarizeReward(SPACE)))
    for episode in range(3):
        data = env.rollout(20)
        flooding, deficit = data["preference"][0].tolist()
        print(
            f"episode {episode}: preference ({flooding:.2f}, {deficit:.2f}), "
            f"return {[round(value) for value in data['next', 'reward'].sum(0).tolist()]}, "
            f"as it is weighed {data['next', 'scalar_reward'].sum():.0f}"
        )

    # Or one that the user has chosen; it may change before any step.
    start = env.reset()
    start["preference"] = SPACE.validate([0.2, 0.8])
    after = env.step(start.set("action", torch.zeros(1)))["next"]
    print("kept through the episode:", [round(value, 1) for value in after["preference"].tolist()])


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()  # --help; it takes nothing else
    main()
