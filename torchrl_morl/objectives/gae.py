"""Generalized advantage estimation with one value per objective."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives.value import GAE

from torchrl_morl.representation import describe

if TYPE_CHECKING:
    from torchrl_morl.preferences import PreferenceSpace

__all__ = ["MultiObjectiveGAE"]


class MultiObjectiveGAE(GAE):
    r"""Advantages of every objective, weighed by the preference of each transition.

    Generalized advantage estimation (https://arxiv.org/abs/1506.02438) of each of the ``K``
    objectives by itself, with the weights :math:`w` of the preference:

    .. math::
        A^k_t = \sum_{l \ge 0} (\gamma \lambda)^l \delta^k_{t+l}, \qquad
        \delta^k_t = r^k_t + \gamma (1 - \mathrm{terminated}_t) V^k_{t+1} - V^k_t, \qquad
        A_t = w \cdot A_t

    It writes what TorchRL's policy-gradient losses expect, so that
    :class:`~torchrl.objectives.ClipPPOLoss` and its siblings train one actor for all preferences and
    a critic with a value per objective, as they are: the advantage is a scalar, the target of the
    critic a vector. Since all of it is linear, :math:`A_t` equals the advantage of the scalarized
    reward under the value :math:`w \cdot V`; what vectors add is a critic that learns every objective
    from all preferences alike.

    The preference must not change within an episode, as the values of an episode are those of one
    preference; where it does, mark the change as the end of a trajectory.

    Keyword Args:
        gamma (float): discount.
        lmbda (float): :math:`\lambda`, the discount of later errors of the value; 0 trusts the
            critic, 1 only the rewards.
        value_network (TensorDictModule, optional): writes values ``[*B, T, K]``; without one they are
            read.
        preference_space (PreferenceSpace, optional): tells which objectives the preference weighs.
            Defaults to ``None``: all of them, the weights are the preference.
        level_preferences (bool): divide each advantage by how large advantages are on average at
            its preference. An objective whose returns are hard to predict makes large advantages
            wherever it is preferred, and one update for all preferences then serves these. What is
            best at a preference stays the same, as in PopArt (https://arxiv.org/abs/1809.04474),
            which levels tasks by the scale of their returns. Here the scale is a quadratic form of
            the preference, fitted to the absolute advantages of the call by least squares.
            Defaults to ``False``.
        average_gae (bool): standardise the scalar advantages. Defaults to ``False``.
        **kwargs: passed to :class:`~torchrl.objectives.value.GAE`.

    Keys read, each renamed by :meth:`set_keys`: ``preference`` ``[*B, T, P]``, ``("next", "reward")``
    ``[*B, T, K]``, ``("next", "done")`` and ``("next", "terminated")`` ``[*B, T, 1]``, and the inputs
    of the network here and at ``"next"``. Keys written: ``advantage`` ``[*B, T, 1]`` and
    ``value_target`` ``[*B, T, K]``.

    Raises:
        ValueError: if values and rewards have different numbers of objectives, or there is no weight
            for each of them.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_morl.preferences import PreferenceSpace
        >>> space = PreferenceSpace(("core", "distance", "efficiency"), static={"core": 1.0})
        >>> gae = MultiObjectiveGAE(
        ...     gamma=0.5, lmbda=1.0, value_network=None, preference_space=space
        ... )
        >>> end = torch.tensor([[[False], [True]]])
        >>> data = TensorDict(
        ...     preference=torch.tensor([[[0.25, 0.75], [0.25, 0.75]]]),
        ...     state_value=torch.zeros(1, 2, 3),
        ...     next=TensorDict(
        ...         reward=torch.tensor([[[0.0, -4.0, 0.0], [1.0, 0.0, -4.0]]]),
        ...         state_value=torch.zeros(1, 2, 3),
        ...         done=end,
        ...         terminated=end,
        ...     ),
        ...     batch_size=(1, 2),
        ... )
        >>> data = gae(data)
        >>> data["advantage"].squeeze(), data["value_target"][0, 0]
        (tensor([-2., -2.]), tensor([ 0.5000, -4.0000, -2.0000]))

    """

    @dataclass
    class _AcceptedKeys(GAE._AcceptedKeys):
        """The keys of :class:`~torchrl.objectives.value.GAE` and one more.

        Attributes:
            preference (NestedKey): where the preference is read. Defaults to ``"preference"``.

        """

        preference: NestedKey = "preference"
        # Of TorchRL's keys `set_keys` accepts only those that this class defines itself.
        advantage: NestedKey = "advantage"
        value_target: NestedKey = "value_target"
        value: NestedKey = "state_value"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        steps_to_next_obs: NestedKey = "steps_to_next_obs"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(
        self,
        *,
        preference_space: PreferenceSpace | None = None,
        level_preferences: bool = False,
        **kwargs: Any,
    ) -> None:
        # Of scalar advantages: objectives that are standardised one by one have lost their weights.
        self.average = kwargs.pop("average_gae", False)
        super().__init__(**kwargs)
        self.preference_space = preference_space
        self.level_preferences = level_preferences

    @property
    def in_keys(self) -> list[NestedKey]:
        keys, network = self.tensor_keys, self.value_network
        inputs = [] if network is None else list(network.in_keys)
        signals = (keys.reward, keys.done, keys.terminated, *inputs)
        in_keys = [*inputs, *(("next", key) for key in signals)]
        return in_keys if keys.preference in in_keys else [*in_keys, keys.preference]

    @dispatch
    def forward(self, tensordict: TensorDictBase, **kwargs: Any) -> TensorDictBase:
        """Write advantages and targets.

        Args:
            tensordict (TensorDictBase): trajectories ``[*B, T]``, see above.
            **kwargs: see :class:`~torchrl.objectives.value.GAE`.

        Returns:
            The same tensordict.

        """
        tensordict = super().forward(tensordict, **kwargs)
        keys = self.tensor_keys
        advantage = tensordict.get(keys.advantage)
        preference = tensordict.get(keys.preference)
        weights = self._weights(preference, advantage.shape[-1])
        advantage = (weights * advantage).sum(-1, keepdim=True)
        if self.level_preferences:
            advantage = advantage / _size(advantage, preference)
        if self.average:
            valid = tensordict.get("shifted_valid", default=None)
            groups = self._group_ids(tensordict)
            advantage = self._normalize_advantage(advantage, valid, groups=groups)
        return tensordict.set(keys.advantage, advantage)

    def _weights(self, preference: Tensor, num_objectives: int) -> Tensor:
        weights = preference
        if self.preference_space is not None:
            weights = self.preference_space.weights(preference)
        if weights.shape[-1] != num_objectives:
            raise ValueError(
                f"{num_objectives} values need as many weights, got {weights.shape[-1]} from "
                f"preferences with {preference.shape[-1]} entries: give the preference_space that "
                "fits the critic."
            )
        return weights

    def _prepare_signals(
        self, reward: Tensor, done: Tensor, terminated: Tensor, value: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        if reward.shape != value.shape:
            raise ValueError(
                f"rewards {tuple(reward.shape)} and values {tuple(value.shape)} must have the same "
                "shape, with one entry per objective at the end."
            )
        return reward, done.expand_as(value), terminated.expand_as(value)

    def _broadcast_optional(self, tensor: Tensor, value: Tensor) -> Tensor:
        if tensor.ndim < value.ndim:
            tensor = tensor.unsqueeze(-1)
        return tensor.expand_as(value)

    def __repr__(self) -> str:
        return describe(
            self,
            gamma=float(self.gamma),
            lmbda=float(self.lmbda),
            preference_space=self.preference_space,
            level_preferences=self.level_preferences,
            average_gae=self.average,
            value_network=self.value_network,
        )


def _size(advantage: Tensor, preference: Tensor) -> Tensor:
    """Mean absolute advantage at each preference ``[*B, P]``, as its quadratic form, ``[*B, 1]``."""
    entries = preference.shape[-1]
    first, second = torch.triu_indices(entries, entries, device=preference.device)
    features = preference[..., first] * preference[..., second]
    size = advantage.abs()
    flat, target = features.flatten(0, -2), size.flatten(0, -2)
    gram = flat.mT @ flat
    # Few different preferences do not determine the form: of all that fit, take a small one.
    tiny = torch.finfo(size.dtype).tiny
    ridge = gram.diagonal().mean().mul(1e-6).clamp_min(tiny)
    form = torch.linalg.solve(
        gram + ridge * torch.eye(entries * (entries + 1) // 2).to(gram), flat.mT @ target
    )
    # Fitted, not measured: nothing grows beyond all bounds where the form is nearly zero.
    return (features @ form).clamp_min(size.mean().mul(0.1).clamp_min(tiny))
