"""Exploration noise that lasts."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs.utils import ExplorationType, exploration_type

from torchrl_morl.arguments import check_seed
from torchrl_morl.generators import generator_from, generator_state, rand
from torchrl_morl.representation import describe

__all__ = ["HeldEGreedyModule"]


class HeldEGreedyModule(TensorDictModuleBase):
    """Epsilon-greedy noise whose random actions are held for several steps.

    White epsilon-greedy noise (:class:`torchrl.modules.EGreedyModule`) averages out on a
    velocity-controlled base: single random commands hardly move the path, and a reward model that
    ranks such rollouts learns to spot random actions. Here a random action, once drawn, replaces
    the policy's for ``hold`` steps. Draws start with the probability that makes ``eps`` the share
    of noisy steps in the long run, so levels mean the same as for white noise; ``hold=1`` is white
    noise.

    What is left of a hold travels in the tensordict, from step to step, as ``held_action`` and
    ``held_steps`` beside the action.

    Args:
        spec: of one action ``[A]``, or of several environments ``[*B, A]`` that all have its bounds;
            random actions are ``spec.rand()``.
        eps: share of noisy steps, in [0, 1].
        hold: length of a noisy stretch, steps.

    Keyword Args:
        action_key: the action ``[*B, A]`` that is replaced.
        seed: of the module's own generator, whose state is in the state dict; the global one of torch
            if ``None``.

    Raises:
        ValueError: for ``eps`` outside of [0, 1], ``hold`` below 1, or environments whose bounds differ.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl.envs.utils import ExplorationType, set_exploration_type
        >>> noise = HeldEGreedyModule(Bounded(-1.0, 1.0, (2,)), eps=1.0, hold=5, seed=0)
        >>> with set_exploration_type(ExplorationType.RANDOM):
        ...     first = noise(TensorDict(action=torch.zeros(3, 2), batch_size=[3]))
        ...     second = noise(first.clone().set("action", torch.zeros(3, 2)))
        >>> bool((first["action"] == second["action"]).all())
        True
    """

    def __init__(
        self,
        spec: TensorSpec,
        eps: float,
        hold: int = 5,
        *,
        action_key: NestedKey = "action",
        seed: int | None = None,
    ) -> None:
        super().__init__()
        if not 0 <= eps <= 1:
            raise ValueError(f"eps is a share in [0, 1], got {eps}.")
        if hold < 1:
            raise ValueError(f"hold must be at least 1 step, got {hold}.")
        self.spec = _of_one(spec)
        self.eps, self.hold = eps, hold
        self.action_key = unravel_key(action_key)
        # Beside the action, so that several agents each hold their own.
        group = self.action_key[:-1] if isinstance(self.action_key, tuple) else ()
        self._held_action = unravel_key((*group, "held_action"))
        self._held_steps = unravel_key((*group, "held_steps"))
        self.in_keys = [self.action_key]
        self.out_keys = [self.action_key, self._held_action, self._held_steps]
        check_seed(seed)
        self.generator = None if seed is None else torch.Generator().manual_seed(seed)

    def __repr__(self) -> str:
        return describe(
            self,
            eps=self.eps,
            hold=self.hold,
            action_key=self.action_key,
            seed=None if self.generator is None else self.generator.initial_seed(),
        )

    def get_extra_state(self) -> Tensor:
        """The state of the generator; empty if the global one is used."""
        return generator_state(self.generator)

    def set_extra_state(self, state: Tensor) -> None:
        """Restore the state of the generator."""
        self.generator = generator_from(state, self.generator)

    def _rand(self, shape: torch.Size) -> Tensor:
        low, high = self.spec.space.low, self.spec.space.high
        unit = rand((*shape, *low.shape), self.generator).to(low.device)
        return low + (high - low) * unit

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replace the actions of the environments that are in a noisy stretch."""
        # Like TorchRL's own exploration modules: random unless something else is asked for.
        if exploration_type() not in (ExplorationType.RANDOM, None):
            return tensordict
        action = tensordict.get(self.action_key)
        shape = action.shape[: action.ndim - self.spec.ndim]
        left = tensordict.get(self._held_steps, None)
        held = tensordict.get(self._held_action, None)
        if left is None:
            left = torch.zeros(*shape, 1, dtype=torch.int64, device=action.device)
            held = torch.zeros_like(action)
        # Noisy stretches of `hold` steps alternate with pauses of mean length 1 / start - 1.
        start = self.eps / (self.hold * (1 - self.eps) + self.eps)
        draw = rand((*shape, 1), self.generator).to(action.device)
        begins = (left == 0) & (draw < start)
        held = torch.where(begins, self._rand(shape).to(action), held)
        left = torch.where(begins, self.hold, left)
        noisy = left > 0
        tensordict.set(self.action_key, torch.where(noisy, held, action))
        tensordict.set(self._held_action, held)
        tensordict.set(self._held_steps, (left - 1).clamp_min(0))
        return tensordict


def _of_one(spec: TensorSpec) -> TensorSpec:
    """The spec of one action in that of several environments."""
    if spec.ndim <= 1:
        return spec
    one = spec[(0,) * (spec.ndim - 1)]
    for end in ("low", "high"):
        if (getattr(spec.space, end) != getattr(one.space, end)).any():
            raise ValueError(
                f"spec has different bounds within its batch dimensions {tuple(spec.shape[:-1])}: "
                "give each environment a module of its own."
            )
    return one
