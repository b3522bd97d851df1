"""TD3 with a vector of action values, conditioned on a preference."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives.utils import distance_loss

from torchrl_morl.modules import PreferenceInterpolator, ValueSpace, saturated_fraction
from torchrl_morl.objectives.angle import angle_between
from torchrl_morl.objectives.mo_td3_options import TargetSelection, check_amounts, check_options
from torchrl_morl.objectives.preference_td3 import PreferenceTD3Loss
from torchrl_morl.representation import describe

if TYPE_CHECKING:
    from torchrl_morl.preferences import PreferenceSpace

__all__ = ["MOTD3Loss"]


class MOTD3Loss(PreferenceTD3Loss):
    r"""Multi-objective TD3 loss, after PD-MORL.

    The critics :math:`Q_i(s, \lambda, a) \in \mathbb{R}^K` learn one value per objective, the actor
    :math:`\pi(s, \lambda)` maximises the utility :math:`w \cdot Q_1`, where the weights :math:`w` are
    the preference :math:`\lambda` with the static weights filled in:

    .. math::
        y &= r + \gamma (1 - \mathrm{terminated})\, Q'_j(s', \lambda, a'), \qquad
             j = \arg\min_i\, w \cdot Q'_i(s', \lambda, a') \\
        L_\mathrm{qvalue} &= \sum_i \mathrm{smooth\_l1}(Q_i, y) + c_\mathrm{critic}\, g(\lambda, Q_i) \\
        L_\mathrm{actor} &= -w \cdot Q_1 + c_\mathrm{actor}\, g(\lambda, Q_1)
                            + c_\mathrm{tanh}\, \overline{u^2}

    with :math:`a'` the smoothed target action of TD3 (https://arxiv.org/abs/1802.09477), smooth-l1
    averaged over objectives, :math:`u` the pre-tanh output of the actor, and :math:`g` the angle
    term of PD-MORL (https://arxiv.org/abs/2208.07914; used for navigation by de Heuvel et al.,
    https://arxiv.org/abs/2404.04857). The target takes the *whole* vector of one critic: an
    elementwise minimum would mix values that no single policy attains. With one objective, the angle
    off and no pre-tanh penalty, the losses are those of :class:`~torchrl.objectives.TD3Loss`.

    The angle :math:`g` is taken over the tunable objectives, between the direction
    :math:`I(\lambda)` given by ``interpolator`` and

    - ``angle="normalized"``: the values in the normalised space of the interpolator, in radians, alive
      over the whole :math:`(0, \pi)`;
    - ``angle="raw"``: the raw values, in degrees, as in the code of PD-MORL, where the
      interpolator has ``value_space="raw"`` too. No gradient at obtuse angles, hence none for penalties.

    Rewards of several steps, as :class:`~torchrl.envs.MultiStepTransform` sums them, are discounted
    by ``steps_to_next_obs``. Inputs that only one of the networks reads are supported. At the next state every input comes from
    ``"next"``; what is missing there, such as a preference that is stored once, carries over from the
    root.

    Args:
        actor_network (TensorDictModule): the actor ``(state, preference) -> action``.
        qvalue_network (TensorDictModule or list of TensorDictModule): the vector critic, or a list
            with one per ``num_qvalue_nets``. A single one is replicated and re-drawn uniformly within
            the range of each of its parameters; a list keeps its initialisation.

    Keyword Args:
        preference_space (PreferenceSpace, optional): tells which objectives the preference weighs.
            Defaults to ``None``: all of them, the weights are the preference.
        interpolator (PreferenceInterpolator, optional): the direction of a preference and the
            normalised space. Needed by both forms of the angle, with the ``value_space`` of that
            name; for the raw preference as direction give it ``identity=True``. It is part of the
            state dict, but never trained.
        angle (str, optional): ``"normalized"``, ``"raw"`` or ``None`` (default) for no angle.
        angle_coeff_actor (float): :math:`c_\mathrm{actor}`. Defaults to 0.0, which only measures
            the angle. PD-MORL uses 10 on returns of hundreds; its gradient is in inverse units of Q.
        angle_coeff_critic (float): :math:`c_\mathrm{critic}`. Defaults to 0.0, since the term moves
            the fixed point of the critic away from the Bellman equation. PD-MORL uses 1.
        pre_tanh_coeff (float): :math:`c_\mathrm{tanh}`. Defaults to 0.0. To raise it from zero later,
            the actor must write the ``pre_tanh`` key from the start.
        target_selection (str): ``"utility"`` (default) as above, or ``"elementwise"`` for the minimum
            of every objective on its own.
        **td3_kwargs: passed to :class:`~torchrl.objectives.TD3Loss`: ``action_spec`` or ``bounds``,
            ``num_qvalue_nets``, ``policy_noise`` and ``noise_clip`` (both in units of the action),
            ``loss_function``, ``delay_actor``, ``delay_qvalue``, ``separate_losses``, ``reduction``,
            ``deactivate_vmap``, ``use_prioritized_weights``.

    The three coefficients are buffers: ``loss.angle_coeff_actor = 0.5`` schedules them in place.

    Keys read, besides those of the networks: ``action``, ``preference`` ``[*B, T]``, ``("next",
    "reward")`` ``[*B, K]``, ``("next", "done")`` and ``("next", "terminated")`` ``[*B, 1]``, and, if
    they are there, ``priority_weight`` ``[*B]`` and ``steps_to_next_obs`` ``[*B]`` or ``[*B, 1]``. Keys
    written: the priority (``"td_error"``) ``[*B]``, into the input of ``forward``.

    Metadata, detached, under the names in ``out_keys`` (``N`` critics):

    - ``state_action_value_actor`` ``[*B]``: utility of the actor's action, from the first critic;
    - ``saturated_fraction`` ``[]``: see :func:`~torchrl_morl.modules.saturated_fraction`;
    - ``angle`` ``[*B]``, only if the angle is on: of the first critic, radians or degrees as above;
    - ``pred_value`` ``[N, *B]``, ``target_value`` ``[*B]``, ``next_state_value`` ``[*B]``: utilities;
    - ``q_scale`` ``[K]``: mean absolute value of every objective, which shows the one that dominates;
    - ``td_error`` ``[N, *B]``, returned by ``value_loss`` only: squared error, mean over objectives.

    Raises:
        ValueError: for an unknown or inconsistent option, or environments whose bounds differ, at construction; for rewards, preferences or
            values whose numbers of objectives disagree, at the first call.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_morl.modules import PreferenceInterpolator, make_actor, make_vector_critic
        >>> from torchrl_morl.preferences import PreferenceSpace
        >>> space = PreferenceSpace(("core", "distance", "efficiency"), static={"core": 1.0})
        >>> spec = Bounded(-1.0, 1.0, (2,))
        >>> loss = MOTD3Loss(
        ...     make_actor(spec, in_features=4 + 2, num_cells=(16,)),
        ...     make_vector_critic(3, in_features=4 + 2 + 2, num_cells=(16,)),
        ...     preference_space=space,
        ...     interpolator=PreferenceInterpolator(torch.eye(2)),
        ...     angle="normalized",
        ...     angle_coeff_actor=0.1,
        ...     pre_tanh_coeff=0.01,
        ...     action_spec=spec,
        ... )
        >>> _ = loss.make_value_estimator(gamma=0.99)
        >>> end = torch.zeros(8, 1, dtype=torch.bool)
        >>> later = TensorDict(
        ...     observation=torch.randn(8, 4), reward=torch.randn(8, 3), done=end, terminated=end
        ... )
        >>> batch = TensorDict(
        ...     observation=torch.randn(8, 4),
        ...     preference=space.sample(8),
        ...     action=spec.rand((8,)),
        ...     next=later,
        ...     batch_size=8,
        ... )
        >>> losses = loss(batch)
        >>> (losses["loss_actor"] + losses["loss_qvalue"]).backward()
        >>> losses["q_scale"].shape, batch["td_error"].shape
        (torch.Size([3]), torch.Size([8]))

    """

    tensor_keys: PreferenceTD3Loss._AcceptedKeys
    _schedulable_buffers = frozenset({"angle_coeff_actor", "angle_coeff_critic", "pre_tanh_coeff"})
    interpolator: PreferenceInterpolator | None

    def __init__(
        self,
        actor_network: TensorDictModule,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        *,
        preference_space: PreferenceSpace | None = None,
        interpolator: PreferenceInterpolator | None = None,
        angle: ValueSpace | None = None,
        angle_coeff_actor: float = 0.0,
        angle_coeff_critic: float = 0.0,
        pre_tanh_coeff: float = 0.0,
        target_selection: TargetSelection = "utility",
        **td3_kwargs: Any,
    ) -> None:
        check_options(angle, target_selection, preference_space, interpolator)
        # Floats: an integer buffer would round every value that is scheduled later.
        coefficients = {
            "angle_coeff_actor": float(angle_coeff_actor),
            "angle_coeff_critic": float(angle_coeff_critic),
            "pre_tanh_coeff": float(pre_tanh_coeff),
        }
        check_amounts(coefficients | td3_kwargs)
        if angle is None and (angle_coeff_actor or angle_coeff_critic):
            raise ValueError("an angle coefficient has no effect without angle=...")
        super().__init__(actor_network, qvalue_network, **td3_kwargs)
        # A spec of several environments repeats their bounds, and data come in any shape.
        for name in ("min_action", "max_action"):
            bound = getattr(self, name)
            if bound.ndim > 1:
                rows = bound.flatten(0, -2)
                if (rows != rows[0]).any():
                    raise ValueError(
                        f"action_spec has different bounds within its batch dimensions "
                        f"{tuple(bound.shape[:-1])}: give actions as shares of them."
                    )
                setattr(self, name, rows[0].clone())
        device = self._default_device
        self.preference_space = preference_space
        self.interpolator = None if interpolator is None else interpolator.to(device)
        self.angle = angle
        self.target_selection = target_selection
        self._needs_pre_tanh = coefficients["pre_tanh_coeff"] > 0
        for name, value in coefficients.items():
            self.register_coeff_buffer(name, value, device=device)
        tunable = () if preference_space is None else preference_space.tunable_indices
        tunable = torch.tensor(tunable, dtype=torch.long, device=device)
        self.register_buffer("_tunable", tunable, persistent=False)
        self.out_keys = [
            "loss_actor",
            "loss_qvalue",
            "state_action_value_actor",
            "saturated_fraction",
            *(["angle"] if angle is not None else []),
            "next_state_value",
            "pred_value",
            "target_value",
            "q_scale",
        ]
        self._set_in_keys()
        # TorchRL makes it at the first call, so that a loss that has been called has a state dict that
        # a new one refuses (as in https://github.com/pytorch/rl/issues/1594).
        self.make_value_estimator()

    def __repr__(self) -> str:
        coefficients = {
            name: float(getattr(self, name)) for name in sorted(self._schedulable_buffers)
        }
        return describe(
            self,
            preference_space=self.preference_space,
            angle=self.angle,
            **coefficients,
            target_selection=self.target_selection,
            interpolator=self.interpolator,
            loss_function=self.loss_function,
            policy_noise=float(self.policy_noise),
            noise_clip=float(self.noise_clip),
            delay_actor=self.delay_actor,
            delay_qvalue=self.delay_qvalue,
            reduction=self.reduction,
            num_qvalue_nets=self.num_qvalue_nets,
            qvalue_network=self.qvalue_network,
            actor_network=self.actor_network,
        )

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the actor and its metadata; evaluates the first critic only, without training it.

        Args:
            tensordict (TensorDictBase): a batch with the inputs of both networks.

        Returns:
            The reduced loss, and the metadata described in the class.

        Raises:
            KeyError: if ``pre_tanh_coeff`` is set and the actor does not write the pre-tanh output.

        """
        priority_weights = self._maybe_get_priority_weight(tensordict)
        preference = tensordict.get(self.tensor_keys.preference)
        td = tensordict.select(*self._state_keys, strict=False)
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            td = self.actor_network(td)
        pre_tanh = td.get(self.tensor_keys.pre_tanh, None)
        action = self._action_of(td)
        with self._first_critic().to_module(self.qvalue_network, preserve_module_state=False):
            critic_td = self.qvalue_network(td.select(*self.qvalue_network.in_keys, strict=False))
        qvalue = self._value_of(critic_td)
        utility = self._utility(self._weights(preference), qvalue)
        loss_actor = -utility
        metadata = {
            "state_action_value_actor": utility.detach(),
            "saturated_fraction": saturated_fraction(action, self.min_action, self.max_action),
        }
        if self.angle is not None:
            angle = self._angle_term(preference, qvalue)
            loss_actor = loss_actor + self.angle_coeff_actor * angle
            metadata["angle"] = angle.detach()
        if pre_tanh is not None:
            loss_actor = loss_actor + self.pre_tanh_coeff * pre_tanh.pow(2).mean(-1)
        elif self._needs_pre_tanh:
            raise KeyError(
                f"pre_tanh_coeff needs the actor to write {self.tensor_keys.pre_tanh!r}, but its "
                f"out_keys are {self.actor_network.out_keys}."
            )
        loss_actor = self._reduce_loss(loss_actor, tensordict=tensordict, weights=priority_weights)
        self._forget_refs(tensordict)
        return loss_actor, metadata

    def value_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the critics, summed over them, and its metadata.

        Args:
            tensordict (TensorDictBase): a batch of transitions.

        Returns:
            The reduced loss, and the metadata described in the class.

        Raises:
            ValueError: if the reward does not have one entry per value of the critic.

        """
        priority_weights = self._maybe_get_priority_weight(tensordict)
        tensordict = tensordict.clone(False)
        preference = tensordict.get(self.tensor_keys.preference)
        next_qvalue, next_utility = self._next_qvalue(tensordict)
        target = self._target_qvalue(tensordict, next_qvalue)
        td = tensordict.select(*self.qvalue_network.in_keys, strict=False)
        qvalue = self._all_qvalues(td, self.qvalue_network_params)
        td_error = (qvalue - target).pow(2).mean(-1).detach()
        loss_qvalue = distance_loss(
            qvalue, target.expand_as(qvalue), loss_function=self.loss_function
        ).mean(-1)
        if self.angle is not None:
            loss_qvalue = loss_qvalue + self.angle_coeff_critic * self._angle_term(
                preference, qvalue
            )
        weights = self._weights(preference)
        detached = qvalue.detach()
        metadata = {
            "td_error": td_error,
            "next_state_value": next_utility,
            "pred_value": self._utility(weights, detached),
            "target_value": self._utility(weights, target),
            "q_scale": detached.abs().flatten(0, -2).mean(0),
        }
        loss_qvalue = self._reduce_loss(
            loss_qvalue.sum(0), tensordict=tensordict, weights=priority_weights
        )
        self._forget_refs(tensordict)
        return loss_qvalue, metadata

    @torch.no_grad()
    def _next_qvalue(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Bootstrap values ``[*B, K]`` of the target networks, and their utility ``[*B]``."""
        action = tensordict.get(self.tensor_keys.action)
        noise = (torch.randn_like(action) * self.policy_noise).clamp(
            -self.noise_clip, self.noise_clip
        )
        next_td = tensordict.empty()
        for key in self._state_keys:
            value = tensordict.get(("next", key), None)
            # As step_mdp does: what "next" lacks has not changed.
            next_td.set(key, tensordict.get(key) if value is None else value)
        weights = self._weights(next_td.get(self.tensor_keys.preference))
        with self.target_actor_network_params.to_module(
            self.actor_network, preserve_module_state=False
        ):
            next_td = self.actor_network(next_td)
        next_action = self._action_of(next_td) + noise
        next_td.set(self.tensor_keys.action, next_action.clamp(self.min_action, self.max_action))
        next_td = next_td.select(*self.qvalue_network.in_keys, strict=False)
        qvalues = self._all_qvalues(next_td, self.target_qvalue_network_params)
        if self.target_selection == "elementwise":
            qvalue = qvalues.amin(0)
        else:
            lowest = self._utility(weights, qvalues).argmin(0)[None, ..., None]
            qvalue = qvalues.gather(0, lowest.expand(1, *qvalues.shape[1:])).squeeze(0)
        return qvalue, self._utility(weights, qvalue)

    def _target_qvalue(self, tensordict: TensorDictBase, next_qvalue: Tensor) -> Tensor:
        """Target ``[*B, K]`` from the value estimator; edits the tensordict."""
        keys = self.tensor_keys
        reward = tensordict.get(("next", keys.reward))
        if reward is None:
            raise KeyError(
                f"the batch has no {('next', keys.reward)}: give transitions, as of "
                "env.rollout or a collector."
            )
        if reward.shape != next_qvalue.shape:
            raise ValueError(
                f"the reward has shape {tuple(reward.shape)}, the critic gives "
                f"{tuple(next_qvalue.shape)}: both need one entry per objective."
            )
        # The estimators want one shape for all: an objective is to them a feature dimension.
        steps_key = self.value_estimator.tensor_keys.steps_to_next_obs
        for key in (("next", keys.done), ("next", keys.terminated), steps_key):
            value = tensordict.get(key, None)
            if value is not None:
                if value.ndim < reward.ndim:
                    # MultiStepTransform writes its steps as [*B], flags are [*B, 1].
                    value = value.unsqueeze(-1)
                tensordict.set(key, value.expand_as(reward))
        tensordict.set(("next", keys.state_action_value), next_qvalue)
        return self.value_estimator.value_estimate(tensordict).detach()

    def _weights(self, preference: Tensor) -> Tensor:
        """Weights ``[*B, K]`` of all objectives."""
        return (
            preference
            if self.preference_space is None
            else self.preference_space.weights(preference)
        )

    def _utility(self, weights: Tensor, values: Tensor) -> Tensor:
        """Scalarised values: ``[*B]`` or ``[N, *B]``."""
        if weights.shape[-1] != values.shape[-1]:
            raise ValueError(
                f"the preference gives {weights.shape[-1]} weights, the critic "
                f"{values.shape[-1]} values: pass the preference_space of this reward."
            )
        return (weights * values).sum(-1)

    def _angle_term(self, preference: Tensor, values: Tensor) -> Tensor:
        """Angle between the direction of the preference and the tunable values, ``[N, *B]``."""
        direction = self.interpolator(preference).detach()
        if self.preference_space is not None:
            values = values.index_select(-1, self._tunable)
        if self.angle == "raw":
            return angle_between(direction, values, form="official")
        return angle_between(direction, self.interpolator.normalize(values))
