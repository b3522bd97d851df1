"""A learned reward as one more objective."""

from __future__ import annotations

from copy import deepcopy
from typing import Self

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from torchrl_morl.arguments import check_count, check_positive
from torchrl_morl.representation import describe
from torchrl_morl.transforms.holder import is_in_environment
from torchrl_morl.transforms.stored import apart_from_storage

__all__ = ["RewardModelReward"]


class RewardModelReward(Transform):
    r"""Insert the penalty :math:`c\,(R(s_t, a_t) - 1) \in [-c, 0]` into a vector reward.

    R is a trained :class:`~torchrl_morl.modules.RewardModel`, of which the transform keeps a frozen
    copy: in evaluation mode, without gradients, its values part of the state dict. A penalty, since a
    reward that is never negative would pay for staying alive.

    R is evaluated at the state and the action of the step. In an environment it reads them when the
    step enters the chain, which is what the transforms *before* it expose: place it **behind**
    :class:`~torchrl.envs.ActionScaling` (or any other transform of the action), and it sees the
    policy's action in [-1, 1], the same that a replay buffer stores; in front of it, it would see
    the action of the simulator, in m/s and rad/s. Place it behind the transforms that write its
    inputs, too: they become part of the state spec, so that batched environments hand them on to
    their workers, and a step needs them.

    As a module or in a replay buffer it extends ``("next", reward)``; a tensordict without that
    entry is treated as a flat one, with the reward at the root. What is stored stays as it is. Use
    it in one of the two places, as each adds an entry.

    Args:
        reward_model (TensorDictModuleBase): writes R in [0, 1], of shape ``[*B, 1]``.

    Keyword Args:
        reward_key (NestedKey): the vector reward of shape ``[*B, K]``, which becomes ``[*B, K + 1]``.
            A bounded spec stays bounded, with [-scale, 0] for the new entry; any other one becomes
            unbounded, as one spec cannot be both.
        position (int): the index of the new entry, from 0 to K. The default, 1, turns (core,
            distance, efficiency) into (core, demo, distance, efficiency).
        scale (float): :math:`c`, in units of reward.
        score_key (NestedKey): where the model writes R. R itself is not kept. Several of these
            transforms in one chain need different keys.

    Raises:
        ValueError: if the scale is not positive, the model does not write the ``score_key``, or the
            reward has less than ``position`` entries.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_morl.modules import RewardModel
        >>> from torchrl_morl.testing import VectorRewardMockEnv
        >>> transform = RewardModelReward(RewardModel(in_features=2 + 2, num_cells=(16,)))
        >>> env = TransformedEnv(VectorRewardMockEnv(3, batch_size=(4,)), transform)
        >>> reward = env.rollout(5)["next", "reward"]
        >>> reward.shape, bool(((reward[..., 1] + 5).abs() < 0.2).all())
        (torch.Size([4, 5, 4]), True)

    """

    def __init__(
        self,
        reward_model: TensorDictModuleBase,
        *,
        reward_key: NestedKey = "reward",
        position: int = 1,
        scale: float = 10.0,
        score_key: NestedKey = "demo_score",
    ) -> None:
        if not isinstance(reward_model, TensorDictModuleBase):
            raise ValueError(f"reward_model must be a TensorDictModule, got {reward_model!r}.")
        super().__init__(in_keys=[reward_key], out_keys=[reward_key])
        self.score_key = unravel_key(score_key)
        written = [unravel_key(key) for key in reward_model.out_keys]
        if self.score_key not in written:
            raise ValueError(f"the reward model writes {written}, not {score_key!r}.")
        check_positive("scale", scale)
        check_count("position", position, least=0)
        self.position = position
        self.scale = scale
        # A copy: freezing the caller's model would end its training.
        self.reward_model = deepcopy(reward_model).eval().requires_grad_(False)

    def __repr__(self) -> str:
        return describe(
            self,
            reward_key=self.in_keys[0],
            position=self.position,
            scale=self.scale,
            score_key=self.score_key,
            reward_model=self.reward_model,
        )

    def train(self, mode: bool = True) -> Self:
        super().train(mode)
        self.reward_model.eval()
        return self

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Extend the rewards of recorded transitions.

        Args:
            tensordict (TensorDictBase): holds the inputs of the model at the root and, in ``"next"``
                or at the root, the rewards.

        Returns:
            The same tensordict with the longer rewards; for a lazy stack, a shallow copy of it.

        """
        tensordict = apart_from_storage(tensordict)
        key = unravel_key(("next", self.in_keys[0]))
        if tensordict.get(key, None) is None:
            key = self.in_keys[0]
        score = self._score(tensordict)
        tensordict.set(key, self._insert(tensordict.get(key), self.scale * (score - 1)))
        return tensordict

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        # `_step` gets what the base environment got, an action that the whole chain has converted;
        # here it is still the one that this place in the chain exposes. A replay buffer calls this
        # too, on what it is about to store.
        if is_in_environment(self):
            tensordict.set(self._carried_key, self._score(tensordict))
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        score = tensordict.pop(self._carried_key)
        reward = next_tensordict.get(self.in_keys[0])
        next_tensordict.set(self.in_keys[0], self._insert(reward, self.scale * (score - 1)))
        return next_tensordict

    @property
    def _carried_key(self) -> NestedKey:
        return unravel_key(("_reward_model", self.score_key))

    @torch.no_grad()
    def _score(self, tensordict: TensorDictBase) -> Tensor:
        inputs = tensordict.select(*self.reward_model.in_keys)
        score = self.reward_model(inputs).get(self.score_key)
        if score.shape[-1] != 1:
            raise ValueError(
                f"the reward model writes {self.score_key!r} of shape {list(score.shape)}: it must "
                "end in 1, the one entry that is inserted."
            )
        return score

    def _insert(self, reward: Tensor, entry: Tensor) -> Tensor:
        self._check_size(reward.shape[-1])
        before, after = reward[..., : self.position], reward[..., self.position :]
        return torch.cat([before, entry.to(reward.dtype), after], -1)

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        reward_spec = reward_spec.clone()
        reward_spec[self.out_keys[0]] = self._longer_spec(reward_spec[self.in_keys[0]])
        return reward_spec

    def _longer_spec(self, spec: TensorSpec) -> TensorSpec:
        self._check_size(spec.shape[-1])
        if not isinstance(spec, Bounded):
            shape = (*spec.shape[:-1], spec.shape[-1] + 1)
            return Unbounded(shape, device=spec.device, dtype=spec.dtype)
        space = spec.space
        entry = torch.zeros_like(space.low[..., :1])
        low = self._insert(space.low, entry - self.scale)
        return Bounded(low, self._insert(space.high, entry), device=spec.device, dtype=spec.dtype)

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        # Of what a step is given, batched environments pass on only actions and states.
        state_spec = state_spec.clone()
        observation_spec = self.parent.full_observation_spec
        available = set(observation_spec.keys(True, True))
        for key in map(unravel_key, self.reward_model.in_keys):
            if key in available and key not in state_spec.keys(True, True):
                state_spec[key] = observation_spec[key].clone()
        return state_spec

    def _check_size(self, size: int) -> None:
        if size < self.position:
            raise ValueError(
                f"position {self.position} is beyond the end of {self.in_keys[0]!r}, which has "
                f"{size} entries."
            )
