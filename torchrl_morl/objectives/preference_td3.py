"""What TD3 needs where its networks read a preference: keys, copies, and critics evaluated together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives import TD3Loss

from torchrl_morl.objectives.network_output import read_output


class PreferenceTD3Loss(TD3Loss):
    """:class:`~torchrl.objectives.TD3Loss` whose networks read a preference, without losses of its own.

    It tells the inputs of a state apart from those of the critic alone, pickles and deep-copies, and
    runs its critics under torch.compile.
    """

    @dataclass
    class _AcceptedKeys(TD3Loss._AcceptedKeys):
        """The keys of :class:`~torchrl.objectives.TD3Loss` and two more.

        Attributes:
            preference (NestedKey): where the preference is read. Defaults to ``"preference"``.
            pre_tanh (NestedKey): where the actor writes its pre-tanh output. Defaults to
                ``"pre_tanh"``.

        """

        preference: NestedKey = "preference"
        pre_tanh: NestedKey = "pre_tanh"

    default_keys = _AcceptedKeys
    # TD3Loss keeps a list here, which its first instance turns into this property: before, neither
    # subclasses nor select_out_keys could set it.
    out_keys = TensorDictModuleBase.out_keys

    def _set_in_keys(self) -> None:
        keys = self.tensor_keys
        written = {keys.action, *self.actor_network.out_keys}
        critic_keys = [key for key in self.qvalue_network.in_keys if key not in written]
        state_keys = [*self.actor_network.in_keys, *critic_keys, keys.preference]
        # What describes a state: TD3Loss knows the inputs of the actor only.
        self._state_keys = tuple(dict.fromkeys(unravel_key(key) for key in state_keys))
        next_keys = [keys.reward, keys.done, keys.terminated, *self._state_keys]
        in_keys = [keys.action, *self._state_keys, *(("next", key) for key in next_keys)]
        self._in_keys = list(dict.fromkeys(unravel_key(key) for key in in_keys))

    def _first_critic(self) -> TensorDictBase:
        # TD3Loss keeps its detached critics in a cache from the first call on (since TorchRL's
        # https://github.com/pytorch/rl/pull/1272). A deep copy copies them as tensors of their own, and
        # then trains its actor against a critic that never changes. Not kept here, where it would save
        # a fortieth of the actor's loss; compiled, TorchRL does without, too.
        return self.qvalue_network_params.detach()[0]

    def __getstate__(self) -> dict[str, Any]:
        # What vmap made of the networks knows those of this very loss, and cannot be pickled.
        return {
            name: value
            for name, value in self.__dict__.items()
            if name not in ("_vmap_qvalue_network00", "_vmap_actor_network00")
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._make_vmap()

    def _all_qvalues(self, td: TensorDictBase, params: TensorDictBase) -> Tensor:
        """Values ``[N, *B, K]`` of all critics."""
        if not self.deactivate_vmap:
            td = td.expand(self.num_qvalue_nets, *td.batch_size)
            return self._value_of(self._vmap_qvalue_network00(td, params))
        # TorchRL's pseudo-vmap, its own way without vmap, breaks the graph of torch.compile.
        values = []
        for critic in params.unbind(0):
            with critic.to_module(self.qvalue_network, preserve_module_state=False):
                values.append(self._value_of(self.qvalue_network(td.copy())))
        return torch.stack(values)

    def _value_of(self, td: TensorDictBase) -> Tensor:
        key = self.tensor_keys.state_action_value
        return read_output(td, key, "state_action_value", "critic", self.qvalue_network)

    def _action_of(self, td: TensorDictBase) -> Tensor:
        return read_output(td, self.tensor_keys.action, "action", "actor", self.actor_network)

    def _forget_refs(self, tensordict: TensorDictBase) -> None:
        self._clear_weakrefs(
            tensordict,
            "actor_network_params",
            "qvalue_network_params",
            "target_actor_network_params",
            "target_qvalue_network_params",
        )
