"""What the actor of MO-PPO pays for beside its returns: leaving a style, jerks, standing still, a side."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn

from envs import HUMAN_RADIUS
from envs.policy_env import observed
from recipes.training.people import somebody_stands
from torchrl_morl.deploy import Sensing
from torchrl_morl.deploy.features import NUM_SECTORS, observation_parts
from torchrl_morl.deploy.mirror import mirror_action, mirror_observation
from torchrl_morl.geometry import wrap_angle
from torchrl_morl.transforms import LogRange

_MARGIN = 0.1
"""Radians."""


def compute(
    cfg: DictConfig,
    batch: TensorDictBase,
    actor: TensorDictSequential,
    *,
    sigma: Tensor,
    demo: int | None,
    anchored: bool,
    efficiency: int | None = None,
) -> dict[str, Tensor]:
    """What an actor pays for beside its returns: smoothness, standing still, a side, a style, and the anchor.

    Args:
        cfg: the configuration.
        batch: of transitions.
        actor: the mean of the policy.

    Keyword Args:
        sigma: standard deviations of the policy.
        demo: the place of the demonstrated style in the preference; ``None`` without demonstrations.
        anchored: whether the batch says what the policy did at the start.
        efficiency: the place of hurry in the preference, for the cost ``elsewhere``.

    Returns:
        Of those that are asked for, before their coefficients.
    """
    action = actor(batch.select(*actor.in_keys))["action"]
    parts = observation_parts(**observed(cfg.env))
    found = {}
    if cfg.loss.smoothness_coeff:
        found["smoothness"] = smoothness(batch, action, actor)
    if cfg.loss.standing_coeff:
        found["standing"] = standing(action)
    if cfg.loss.mirror_coeff:
        found["mirror"] = mirror(batch, action, actor, parts=parts, demo=demo)
    stands = somebody_stands(batch["observation"], parts)
    if asks_elsewhere(cfg):
        assert stands is not None and demo is not None and efficiency is not None
        found["elsewhere"] = elsewhere(
            batch, action, actor, stands=stands, demo=demo, efficiency=efficiency
        )
    if anchored:
        # The demonstrated style is a learned reward: see config.yaml.
        found["anchor"] = anchor(
            batch,
            action,
            sigma=sigma,
            objective=demo,
            radius=cfg.loss.anchor_radius,
            clearance=cfg.loss.anchor_clearance,
            stands=stands,
        )
    return found


def asks_elsewhere(cfg: DictConfig) -> bool:
    """Whether a configuration has the cost ``elsewhere``, from the start or in the end."""
    return bool(cfg.loss.elsewhere_coeff or cfg.loss.final_elsewhere_coeff)


@torch.no_grad()
def start_action(
    cfg: DictConfig,
    start: TensorDictSequential,
    data: TensorDictBase,
    *,
    envs_at_once: int,
    preference: Tensor | None = None,
) -> Tensor:
    """What the policy at the start does in ``data`` ``[E, T]``, averaged over time, ``[E, T, A]``.

    With ``preference`` ``[P]`` what it does at that one, and not at those of the data.
    """
    inputs = data.select(*start.in_keys)
    if preference is not None:
        inputs["preference"] = preference.expand_as(inputs["preference"])
    parts = inputs.split(envs_at_once)
    return average_over_time(
        torch.cat([start(part)["action"] for part in parts]),
        data["collector", "traj_ids"],
        window=cfg.loss.anchor_window,
    )


def average_over_time(action: Tensor, episode: Tensor, *, window: int) -> Tensor:
    """The mean of the actions around each step, of the same episode.

    Args:
        action: of steps in a row, ``[E, T, A]``.
        episode: which one a step belongs to, integers from 0, ``[E, T]``.

    Keyword Args:
        window: steps of a mean, odd; fewer at the ends of episodes and of the row.
    """
    side = window // 2
    nearby = nn.functional.pad(action, (0, 0, side, side)).unfold(-2, window, 1)
    episodes = nn.functional.pad(episode, (side, side), value=-1).unfold(-1, window, 1)
    same = (episodes == episode.unsqueeze(-1)).unsqueeze(-2)
    return (nearby * same).sum(-1) / same.sum(-1)


def anchor(
    batch: TensorDictBase,
    action: Tensor,
    *,
    sigma: Tensor,
    objective: int,
    radius: float,
    clearance: float = 0.0,
    stands: Tensor | None = None,
) -> Tensor:
    """How far a policy has gone from the one it started as, where an objective matters.

    The logarithm of one plus the divergence in nats, which is the Cauchy loss of Barron
    (https://arxiv.org/abs/1701.03077) of the change in standard deviations: small changes everywhere,
    of which a style is made, cost what they diverge; a decision that was wrong, as to stand still or
    on which side to pass, may change, which would cost hundreds of nats.

    A mean over the transitions, weighed by the cube of the weight of the objective: it holds a corner
    of the preferences and leaves the middle free. Far from the human it holds nothing: styles differ
    in how a person is passed, and the rest of the way only has to be driven well. Nor does it hold
    what ends in a failure: the policy at the start may have led there. Nor where a box is near, nobody
    is there, or the human walks: what was demonstrated may lead into them.

    Args:
        batch: of transitions, with the ``start_action`` of the policy at the start, averaged over time or
            not, ``human``, and which steps lead to a failure, ``fails``.
        action: the mean of the policy there, ``[*B, A]``.

    Keyword Args:
        sigma: standard deviations of both, see :func:`~recipes.training.ppo.make_policy`.
        objective: the place of the weight in the preference.
        radius: around the human, metres.
        clearance: from the nearest box, metres; 0 holds beside boxes, too.
        stands: where somebody stands, ``[*B]``; ``None`` holds whatever people do.
    """
    divergence = ((action - batch["start_action"]) / sigma).square().sum(-1) / 2
    held = (batch["human"][..., 0] < radius) & ~batch["fails"]
    if clearance:
        held = held & (nearest_box(batch["observation"], batch["human"]) >= clearance)
    if stands is not None:
        held = held & stands
    weight = batch["preference"][..., objective] ** 3 * held
    return (weight * divergence.log1p()).mean()


def nearest_box(observation: Tensor, human: Tensor) -> Tensor:
    """The shortest range of the lidar that is not the human's, metres.

    Args:
        observation: begins with the sectors of the lidar, ``[*B, D]``, see
            :func:`~torchrl_morl.deploy.features.policy_transforms`.
        human: distance (m) and bearing (rad), ``[*B, 2]``.

    Returns:
        ``[*B]``.
    """
    ranges = LogRange(Sensing.max_range).inverse(observation[..., :NUM_SECTORS])
    width = 2 * math.pi / NUM_SECTORS
    middle = width * (torch.arange(NUM_SECTORS, device=observation.device) + 0.5)
    distance, bearing = human.unsqueeze(-2).unbind(-1)
    # Sectors that the human reaches into. A lidar ahead of the robot's centre sees them elsewhere.
    seen = (HUMAN_RADIUS / distance).clamp_max(1.0).asin() + width / 2 + _MARGIN
    is_human = wrap_angle(middle - bearing).abs() < seen
    return ranges.masked_fill(is_human, torch.inf).amin(-1)


def smoothness(batch: TensorDictBase, action: Tensor, actor: TensorDictSequential) -> Tensor:
    """By how much the turn rate changes from a step to the next, mean square.

    After the temporal term of CAPS (Mysore et al., https://arxiv.org/abs/2012.06644), squared, and of
    the turn rate alone: the speed is at its limit nearly always.

    Args:
        batch: of transitions.
        action: of the actor there, in [-1, 1], speed and turn rate, ``[*B, 2]``.
        actor: writes the action of the step after.

    Returns:
        A number, in units of half the range of the turn rate, squared. The last step of an episode
        counts as no change.
    """
    later = batch.select(*actor.in_keys).update(batch["next"].select("observation"))
    change = actor(later)["action"] - action
    continues = ~batch["next", "done"].squeeze(-1)
    return (change[..., 1].square() * continues).mean()


def mirror(
    batch: TensorDictBase,
    action: Tensor,
    actor: TensorDictSequential,
    *,
    parts: Mapping[str, Sequence[int]],
    demo: int | None,
) -> Tensor:
    """How much a policy does otherwise in the mirror image of what it sees, mean square.

    The loss of Yu et al. (https://arxiv.org/abs/1801.08093), where nobody prefers a side: distances
    and times are the same in the mirror image, and so is what is best. Demonstrations are not; the
    weight of the loss is the cube of what the preference leaves to the other objectives. Without it
    all preferences pass people on the demonstrated side, which is as often the longer one.

    Args:
        batch: of transitions.
        action: of the actor there, in [-1, 1], speed and turn rate, ``[*B, 2]``.
        actor: writes the action in the mirror image.

    Keyword Args:
        parts: of the observation.
        demo: the place of the demonstrated style in the preference; ``None`` without demonstrations.
    """
    image = batch.select(*actor.in_keys)
    image["observation"] = mirror_observation(image["observation"], parts)
    difference = (mirror_action(actor(image)["action"]) - action).square().sum(-1)
    if demo is not None:
        difference = (1 - batch["preference"][..., demo]) ** 3 * difference
    return difference.mean()


def elsewhere(
    batch: TensorDictBase,
    action: Tensor,
    actor: TensorDictSequential,
    *,
    stands: Tensor,
    demo: int,
    efficiency: int,
) -> Tensor:
    """How much a policy does otherwise for a style where there is none to follow, mean square.

    Where nobody stands each step costs as much in the style as in efficiency, so that a weight on the
    one asks for what a weight on the other does. The policy learns there what it does with all of that
    weight on efficiency, which itself does not move.

    Args:
        batch: of transitions.
        action: of the actor there, in [-1, 1], ``[*B, A]``.
        actor: writes the action at the other preference.

    Keyword Args:
        stands: where somebody stands, ``[*B]``.
        demo: the place of the demonstrated style in the preference.
        efficiency: the place of hurry.
    """
    same = batch.select(*actor.in_keys)
    preference = same["preference"].clone()
    preference[..., efficiency] += preference[..., demo]
    preference[..., demo] = 0
    with torch.no_grad():
        wanted = actor(same.set("preference", preference))["action"]
    return ((action - wanted).square().sum(-1) * ~stands).mean()


def standing(action: Tensor) -> Tensor:
    """How nearly a policy stands still, mean square.

    Where a policy without noise neither drives nor turns it observes the same again and stays for
    ever, which noise hides from the training.

    Args:
        action: in [-1, 1], speed and turn rate, ``[*B, 2]``.

    Returns:
        A number: 1 where all stand, 0 where all drive at a tenth of their speed or turn at a
        twentieth of their rate at least.
    """
    speed, turn = (action[..., 0] + 1) / 2, action[..., 1].abs()
    return (1 - speed / 0.1 - turn / 0.05).clamp(min=0.0).square().mean()
