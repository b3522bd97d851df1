"""What the learner benchmark measures: this project's update, and what it is compared with.

All of them learn from the same transitions, held in their own kind of replay buffer; sampling is
part of an update. ``SYSTEMS`` names them.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict, TensorDictBase
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torchrl.objectives import SoftUpdate

import recipes.pd_morl
from recipes.pd_morl import learning, utils
from torchrl_morl.deploy.features import OBSERVATION_SIZE

ACTION_SIZE = 2
CONFIG = Path(recipes.pd_morl.__file__).parent / "config.yaml"

# Neither what the peers lack nor what they do otherwise.
EQUAL_WORK = (
    "network.critic_layer_norm=false",
    "network.straight_drive=false",
    "loss.angle=null",
    "loss.angle_coeff_actor=0",
    "loss.angle_coeff_critic=0",
    "loss.pre_tanh_coeff=0",
    "optim.actor_average=null",
)

UPDATES = 10
"""Of a turn: a multiple of every policy delay, so that each turn is the same work."""

Stage = tuple[str, Callable[[], None]]


class Learner(abc.ABC):
    """Updates in named stages, so that a profile can tell them apart."""

    policy_delay = 1

    def __init__(self) -> None:
        self.updates = 0

    @abc.abstractmethod
    def critic_stages(self) -> list[Stage]:
        """Of every update."""

    def actor_stages(self) -> list[Stage]:
        """Of every ``policy_delay``-th update; none if the critics' stages see to it."""
        return []

    def stages(self) -> Iterator[Stage]:
        """Those of the next update."""
        self.updates += 1
        yield from self.critic_stages()
        if self.updates % self.policy_delay == 0:
            yield from self.actor_stages()

    def update(self) -> None:
        for _, run in self.stages():
            run()


class TD3Learner(Learner):
    """The stages of TD3: critics at every update, actor and targets at some.

    Gradients are the loss, its backward pass and clipping.
    """

    def critic_stages(self) -> list[Stage]:
        return [
            ("sample, relabel", self._sample),
            ("critic: gradients", self._critic_gradients),
            ("critic: Adam", self._critic_step),
        ]

    def actor_stages(self) -> list[Stage]:
        return [
            ("actor: gradients", self._actor_gradients),
            ("actor: Adam", self._actor_step),
            ("soft update, average", self._follow),
        ]

    @abc.abstractmethod
    def _sample(self) -> None: ...

    @abc.abstractmethod
    def _critic_gradients(self) -> None: ...

    @abc.abstractmethod
    def _critic_step(self) -> None: ...

    @abc.abstractmethod
    def _actor_gradients(self) -> None: ...

    @abc.abstractmethod
    def _actor_step(self) -> None: ...

    @abc.abstractmethod
    def _follow(self) -> None: ...


def config(*overrides: str) -> DictConfig:
    """The recipe's configuration with a few fields changed, as on its command line.

    Batches are drawn for 10 updates at a time instead of the recipe's number, which makes turns equal.
    """
    # Hydra's own section holds a date that only Hydra can fill in.
    cfg = OmegaConf.load(CONFIG)
    del cfg["hydra"]
    fields = [f"optim.updates_per_batch={UPDATES}", *overrides]
    return OmegaConf.merge(cfg, OmegaConf.from_dotlist(fields))


def transitions(number: int, seed: int = 0) -> TensorDict:
    """Random transitions of the sizes of the navigation task."""
    preference_space = utils.make_preference_space(with_demonstrations=True)
    generator = torch.Generator().manual_seed(seed)

    def normal(size: int) -> torch.Tensor:
        return torch.randn(number, size, generator=generator)

    preference = preference_space.sample(number, generator=generator)
    ends = torch.rand(number, 1, generator=generator) < 0.01
    data = TensorDict(
        observation=normal(OBSERVATION_SIZE),
        preference=preference,
        action=normal(ACTION_SIZE).tanh(),
        next=TensorDict(
            observation=normal(OBSERVATION_SIZE),
            preference=preference.clone(),
            reward=10 * normal(preference_space.num_objectives),
            done=ends,
            terminated=ends.clone(),
            truncated=torch.zeros_like(ends),
            batch_size=number,
        ),
        batch_size=number,
    )
    return data.select(*utils.TRANSITION)


class Ours(TD3Learner):
    """The update of ``recipes.pd_morl``, out of the recipe's own factories."""

    def __init__(self, cfg: DictConfig, data: TensorDict) -> None:
        super().__init__()
        self.cfg, device = cfg, torch.device(cfg.device)
        self.preference_space = utils.make_preference_space(with_demonstrations=True)
        self.policy_delay = cfg.optim.policy_delay
        env = utils.make_train_env(cfg, utils.make_preference_space(False), None)
        self.actor, _ = utils.make_policy(cfg, env, self.preference_space, device)
        self.loss = utils.make_loss(cfg, env, self.preference_space, self.actor, device)
        env.close()
        self.critic_gradients, self.actor_gradients = learning.make_gradients(cfg, self.loss)
        self.target_updater = SoftUpdate(self.loss, eps=cfg.optim.polyak)
        self.averaged = None
        if cfg.optim.actor_average is not None:
            average = get_ema_multi_avg_fn(cfg.optim.actor_average)
            self.averaged = AveragedModel(self.actor, multi_avg_fn=average, use_buffers=False)
        self.optimizers, _ = learning.make_optimizers(cfg, self.loss)
        self.replay_buffer = utils.make_replay_buffer(cfg, self.preference_space, device)
        self.replay_buffer.extend(data)
        self.batches: list[TensorDictBase] = []

    def _sample(self) -> None:
        if not self.batches:
            # As the recipe: those of the next updates at once.
            size = self.cfg.replay_buffer.batch_size
            batches = self.replay_buffer.sample(self.cfg.optim.updates_per_batch * size)
            self.batches = list(batches.split(size))
        self.batch = self.batches.pop()

    def _critic_gradients(self) -> None:
        self.info = self.critic_gradients(self.batch)
        self.loss_value = self.info["loss_qvalue"]

    def _critic_step(self) -> None:
        self.optimizers["critic"].step()

    def _actor_gradients(self) -> None:
        self.info = self.actor_gradients(self.batch)
        self.loss_value = self.info["loss_actor"]

    def _actor_step(self) -> None:
        self.optimizers["actor"].step()

    def _follow(self) -> None:
        self.target_updater.step()
        if self.averaged is not None:
            self.averaged.update_parameters(self.actor)


@dataclasses.dataclass(frozen=True)
class System:
    """One row of the table."""

    make: Callable[[TensorDict, bool], Learner]
    """From the transitions, and whether to compile what can be."""
    compiled: bool = False
    precision: str = "float32"
    """Of the matrix products."""
    requires: tuple[str, ...] = ()
    """Optional modules."""


def _ours(data: TensorDict, compiled: bool, *overrides: str) -> Learner:
    return Ours(config(f"compute.compile={compiled}".lower(), *overrides), data)


def _bare(data: TensorDict, compiled: bool, *overrides: str) -> Learner:
    from .bare_loop import BareLoop

    cfg = config("compute.compile=false", *overrides)
    return BareLoop(Ours(cfg, data[:1]), data, compiled=compiled)


def _official(data: TensorDict, compiled: bool, delay: int) -> Learner:
    from .peers_learner import OfficialUpdate

    return OfficialUpdate(data, policy_delay=delay)


def _stock(data: TensorDict, compiled: bool) -> Learner:
    from .peers_learner import StockTD3

    return StockTD3(data)


def _capql(data: TensorDict, compiled: bool) -> Learner:
    from .peers_morl_baselines import capql

    return capql(data)


def _gpi_ls(data: TensorDict, compiled: bool, batch_size: int) -> Learner:
    from .peers_morl_baselines import gpi_ls

    return gpi_ls(data, batch_size)


def _with(make: Callable[..., Learner], *arguments) -> Callable[[TensorDict, bool], Learner]:
    return lambda data, compiled: make(data, compiled, *arguments)


OURS = "ours"
OURS_EQUAL = "ours, equal work"

_SHIPPED = config()
_BFLOAT16 = "compute.bfloat16=true"
_DELAY_10 = (*EQUAL_WORK, "optim.policy_delay=10")
_PEERS = ("morl_baselines",)

SYSTEMS: dict[str, System] = {
    OURS: System(_ours, _SHIPPED.compute.compile),
    "ours, bfloat16": System(_with(_ours, _BFLOAT16), _SHIPPED.compute.compile, "bfloat16"),
    "ours, eager": System(_ours),
    OURS_EQUAL: System(_with(_ours, *EQUAL_WORK), _SHIPPED.compute.compile),
    "ours, equal work, eager": System(_with(_ours, *EQUAL_WORK)),
    "ours, equal work, delay 10": System(_with(_ours, *_DELAY_10), _SHIPPED.compute.compile),
    "bare loop": System(_bare, True),
    "bare loop, eager": System(_bare),
    "bare loop, equal work": System(_with(_bare, *EQUAL_WORK), True),
    "bare loop, equal work, eager": System(_with(_bare, *EQUAL_WORK)),
    "bare loop, equal work, delay 10": System(_with(_bare, *_DELAY_10), True),
    "TorchRL TD3Loss": System(_stock),
    "PD-MORL, delay 10": System(_with(_official, 10)),
    "PD-MORL, delay 2": System(_with(_official, 2)),
    "CAPQL": System(_capql, requires=_PEERS),
    "GPI-LS": System(_with(_gpi_ls, 256), requires=_PEERS),
    "GPI-LS, half the batch": System(_with(_gpi_ls, 128), requires=_PEERS),
}
"""What is measured. "Equal work" is without LayerNorm, angle, penalties and average."""
