"""A stochastic policy that shares its layers with the actor that is saved."""

from __future__ import annotations

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModule, TensorDictSequential, biased_softplus
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor, TanhNormal

from recipes.training.task import Task


def make_stochastic_policy(
    cfg: DictConfig, task: Task, actor: TensorDictSequential
) -> ProbabilisticActor:
    """A squashed Gaussian around the actor's pre-tanh output.

    It shares all layers with ``actor`` and adds one for the standard deviation, so that training it
    trains the actor, whose action is the tanh of the mean.

    Raises:
        ValueError: unless ``network.min_scale`` lies between zero and ``network.initial_scale``.
    """
    initial, least = cfg.network.initial_scale, cfg.network.min_scale
    if not 0 < least < initial:
        raise ValueError(
            f"network.min_scale must be in (0, network.initial_scale), got {least} and {initial}."
        )
    *hidden, mean = actor[0].module
    scale = nn.Sequential(
        nn.Linear(mean.in_features, mean.out_features, device=task.device),
        biased_softplus(initial, least),
    )
    return ProbabilisticActor(
        TensorDictSequential(
            TensorDictModule(
                _Hidden(*hidden), in_keys=["observation", "preference"], out_keys=["hidden"]
            ),
            TensorDictModule(mean, in_keys=["hidden"], out_keys=["loc"]),
            TensorDictModule(scale, in_keys=["hidden"], out_keys=["scale"]),
        ),
        in_keys=["loc", "scale"],
        spec=task.env.action_spec_unbatched,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -1.0, "high": 1.0},
        return_log_prob=True,
    )


class _Hidden(nn.Sequential):
    """The hidden layers of a :class:`torchrl.modules.MLP`, which concatenates its inputs."""

    def forward(self, *inputs: Tensor) -> Tensor:
        return super().forward(torch.cat(inputs, dim=-1))
