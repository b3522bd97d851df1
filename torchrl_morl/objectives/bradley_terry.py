"""Learning a reward from pairs of ranked snippets."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torch.nn import functional as F
from torchrl.objectives import LossModule

from torchrl_morl.objectives.network_output import read_output
from torchrl_morl.representation import describe

__all__ = ["BradleyTerryLoss"]

_Reduction = Literal["mean", "sum", "none"]


class BradleyTerryLoss(LossModule):
    r"""Ranking loss for a reward model, after Bradley and Terry (1952).

    The model of the preference between two snippets of :math:`L` steps is

    .. math::
        P(i \succ j) = \mathrm{sigmoid}\Big(\beta \big(\sum_{t=1}^{L} R(s^i_t, a^i_t)
                       - \sum_{t=1}^{L} R(s^j_t, a^j_t)\big)\Big)

    and the loss is its cross-entropy, as in T-REX (https://arxiv.org/abs/1904.06387) and D-REX
    (https://arxiv.org/abs/1907.03976), where the order comes from the noise that was injected.

    The sum is over steps, so :math:`\beta` decides how far apart a bounded reward is pulled. With
    :math:`\beta = 1` and 30 steps a gap of 0.1 per step already gives P = 0.95 and R stays flat; with
    :math:`\beta = 1/L`, a mean, P cannot exceed 0.73. The default, :math:`5/L`, keeps pulling: the
    full range of R gives P = 0.993.

    Args:
        reward_network (TensorDictModule): writes the reward of a step, of shape ``[..., 1]``, such as
            a :class:`~torchrl_morl.modules.RewardModel`. Its inputs have exactly one dimension
            behind the steps.

    Keyword Args:
        beta (float, optional): the scale :math:`\beta` of the logits. Defaults to ``None``:
            :math:`5/L`, with L from the shape of the data.
        label_smoothing (float): in [0, 1). The target is ``1 - label_smoothing / 2``, as for two
            classes in :func:`~torch.nn.functional.cross_entropy`: the share of labels that a coin
            would have decided.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"``, over pairs.

    Keys read: the ``in_keys`` of the network, of shape ``[*B, L, F_i]``, in each of the
    sub-tensordicts ``preferred`` and ``other``, e.g. from
    :class:`~torchrl_morl.data.RankedSnippets`.

    Keys written:

    - ``loss_bradley_terry`` ``[]``, or ``[*B]`` without a reduction;
    - ``accuracy`` ``[]``: share of the pairs that the model ranks as given, ties count half. Detached;
    - ``margin`` ``[]``: mean over pairs of the difference in R per step. Detached.

    Raises:
        ValueError: at construction for a ``beta`` that is not positive and finite, a
            ``label_smoothing`` outside of [0, 1) or an unknown ``reduction``; at the call if the network
            writes more than one reward per step, or if snippets differ in length. A sum over unequal
            lengths would learn that long is good, or bad.
        KeyError: at the call if the network writes another key than ``score``; see :meth:`set_keys`.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_morl.modules import RewardModel
        >>> loss = BradleyTerryLoss(RewardModel(in_features=4 + 2, num_cells=(16,)))
        >>> def snippets():
        ...     data = {"observation": torch.randn(8, 30, 4), "action": torch.randn(8, 30, 2)}
        ...     return TensorDict(data, batch_size=[8, 30])
        >>> pairs = TensorDict(preferred=snippets(), other=snippets(), batch_size=[8])
        >>> losses = loss(pairs)
        >>> losses["loss_bradley_terry"].backward()
        >>> sorted(losses.keys())
        ['accuracy', 'loss_bradley_terry', 'margin']

    """

    @dataclass
    class _AcceptedKeys:
        """Where the snippets and their rewards are.

        Attributes:
            preferred (NestedKey): the better snippets. Defaults to ``"preferred"``.
            other (NestedKey): the worse snippets. Defaults to ``"other"``.
            score (NestedKey): where the network writes the reward. Defaults to ``"demo_score"``.

        """

        preferred: NestedKey = "preferred"
        other: NestedKey = "other"
        score: NestedKey = "demo_score"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_bradley_terry", "accuracy", "margin"]

    reward_network: TensorDictModule
    reward_network_params: TensorDictParams
    target_reward_network_params: TensorDictParams

    def __init__(
        self,
        reward_network: TensorDictModule,
        *,
        beta: float | None = None,
        label_smoothing: float = 0.0,
        reduction: _Reduction = "mean",
    ) -> None:
        if beta is not None and not 0 < beta < math.inf:
            raise ValueError(f"beta must be positive and finite, got {beta}.")
        if not 0 <= label_smoothing < 1:
            raise ValueError(f"label_smoothing must be in [0, 1), got {label_smoothing}.")
        if reduction not in get_args(_Reduction):
            raise ValueError(f"reduction must be one of {get_args(_Reduction)}, got {reduction!r}.")
        super().__init__()
        self.convert_to_functional(reward_network, "reward_network", create_target_params=False)
        self.beta = beta
        self.label_smoothing = label_smoothing
        self.reduction = reduction

    @property
    def in_keys(self) -> list[NestedKey]:
        """The inputs of the network, in both snippets of a pair."""
        sides = (self.tensor_keys.preferred, self.tensor_keys.other)
        return [unravel_key((side, key)) for side in sides for key in self.reward_network.in_keys]

    @in_keys.setter
    def in_keys(self, keys: list[NestedKey]) -> None:
        raise RuntimeError("in_keys follow from the network; use set_keys for preferred and other.")

    def __repr__(self) -> str:
        return describe(
            self,
            beta="5 / L" if self.beta is None else self.beta,
            label_smoothing=self.label_smoothing,
            reduction=self.reduction,
            reward_network=self.reward_network,
        )

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        # There is no value estimator whose keys would have to follow.
        pass

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Rank pairs of snippets.

        Args:
            tensordict (TensorDictBase): pairs of shape ``[*B]``.

        Returns:
            The loss and its metadata, see the class.

        Raises:
            ValueError: if snippets differ in length.

        """
        preferred = self._inputs(tensordict, self.tensor_keys.preferred)
        other = self._inputs(tensordict, self.tensor_keys.other)
        if preferred.batch_size != other.batch_size:
            raise ValueError(
                "the snippets of a pair must be equally long, got shapes [*B, L] of "
                f"{list(preferred.batch_size)} (preferred) and {list(other.batch_size)} (other)."
            )
        if not preferred.batch_size:
            raise ValueError("the inputs must have the shape [*B, L, F], got no steps L.")
        length = preferred.batch_size[-1]
        # One pass of the network over both.
        both = torch.stack([preferred, other])
        with self.reward_network_params.to_module(self.reward_network, preserve_module_state=False):
            scored = self.reward_network(both)
        key = self.tensor_keys.score
        score = read_output(scored, key, "score", "reward network", self.reward_network)
        if score.shape != (*both.shape, 1):
            raise ValueError(
                f"the reward network writes {key!r} of shape {list(score.shape[1:])} for snippets of "
                f"shape {list(preferred.shape)}: one reward per step is {[*preferred.shape, 1]}."
            )
        total = score.squeeze(-1).sum(-1)
        difference = total[0] - total[1]
        beta = 5 / length if self.beta is None else self.beta
        logits = beta * difference
        target = torch.full_like(logits, 1 - self.label_smoothing / 2)
        loss = F.binary_cross_entropy_with_logits(logits, target, reduction="none")
        difference = difference.detach()
        out = TensorDict(
            {
                "loss_bradley_terry": self._reduce_loss(loss, tensordict=tensordict),
                "accuracy": (1 + difference.sign()).mean() / 2,
                "margin": difference.mean() / length,
            }
        )
        self._clear_weakrefs(tensordict, out, "reward_network_params")
        return out

    def _inputs(self, tensordict: TensorDictBase, side: NestedKey) -> TensorDict:
        """Inputs of the network, with a batch size of ``[*B, L]``."""
        # By the shape of the tensors: what dispatch builds has no other batch size.
        inputs: dict[NestedKey, Tensor] = {
            key: tensordict.get(unravel_key((side, key))) for key in self.reward_network.in_keys
        }
        batch_size = next(iter(inputs.values())).shape[:-1]
        return TensorDict(inputs, batch_size=batch_size)
