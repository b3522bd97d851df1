"""What a collision costs one objective more than the others."""

from __future__ import annotations

from tensordict import TensorDictBase
from torchrl.envs.transforms import Transform

from torchrl_morl.representation import describe

_FLAGS = ("collision_human", "collision_obstacle")


class CollisionReward(Transform):
    """Add to one entry of a vector reward where a step ends in a collision.

    The reward of navigation charges a collision once, whatever is preferred. A demonstrated path may lead
    through a box, so that each step around it costs style, and nothing else costs as much. What is added
    here counts as the objective's weight does.

    Args:
        reward: what is added, at most 0.
        entry: of the reward.

    Raises:
        ValueError: for a reward above 0.

    Example:
        >>> from envs import NavigationEnv
        >>> from torchrl.envs import TransformedEnv
        >>> env = TransformedEnv(
        ...     NavigationEnv(num_envs=2, seed=0), CollisionReward(-500.0, entry=1)
        ... )
        >>> env.rollout(3)["next", "reward"].shape
        torch.Size([2, 3, 3])
        >>> env.close()

    """

    def __init__(self, reward: float, *, entry: int) -> None:
        if reward > 0:
            raise ValueError(f"reward must be at most 0, got {reward}.")
        super().__init__(in_keys=["reward"], out_keys=["reward"])
        self.reward, self.entry = reward, entry

    def __repr__(self) -> str:
        return describe(self, reward=self.reward, entry=self.entry)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        human, box = (next_tensordict[flag] for flag in _FLAGS)
        reward = next_tensordict["reward"].clone()
        reward[..., self.entry] += self.reward * (human | box).squeeze(-1)
        return next_tensordict.set("reward", reward)
