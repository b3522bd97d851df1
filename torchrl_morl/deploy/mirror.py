"""The mirror image of what a navigation policy observes and does: left becomes right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from .sensing import NUM_MOTION

__all__ = ["mirror_action", "mirror_observation"]

_LATERAL = {
    "goal": (1,),
    "human": (1,),
    "human_velocity": (1,),
    "nobody": (),
    "robot": (),
    "motion": tuple(range(1, NUM_MOTION, 2)),
}
"""The entries of each part that change their sign: sines of bearings, velocities to the left, turn rates."""


def mirror_observation(observation: Tensor, parts: Mapping[str, Sequence[int]]) -> Tensor:
    """What the robot would observe in the mirror image of its surroundings.

    The sectors of the lidar come in the other order, bearings, lateral velocities and turn
    rates change their sign. The lidar is one mounted on the axis of the robot.

    Args:
        observation: of :func:`~torchrl_morl.deploy.features.policy_transforms`, ``[*B, D]``.
        parts: where its parts lie, see :func:`~torchrl_morl.deploy.features.observation_parts`.

    Returns:
        ``[*B, D]``; the image of an image is the observation itself.

    Raises:
        ValueError: for a part that is not known, or an observation of another size.

    Example:
        Two sectors, to the left and to the right; a goal to the left.

        >>> import torch
        >>> seen = torch.tensor([-0.5, 0.0, 1.0, 0.6, 0.8])
        >>> mirror_observation(seen, {"lidar": range(2), "goal": range(2, 5)})
        tensor([ 0.0000, -0.5000,  1.0000, -0.6000,  0.8000])
    """
    unknown = sorted(set(parts) - {"lidar", *_LATERAL})
    if unknown:
        known = ", ".join(["lidar", *_LATERAL])
        raise ValueError(f"no mirror image of {', '.join(unknown)}: parts are {known}.")
    size = sum(map(len, parts.values()))
    if observation.shape[-1:] != (size,):
        raise ValueError(
            f"observation must have {size} entries, as its parts have, got a shape of "
            f"{tuple(observation.shape)}."
        )
    images = []
    for name, places in parts.items():
        part = observation[..., places[0] : places[-1] + 1]
        if name == "lidar":
            images.append(part.flip(-1))
        else:
            sign = [-1.0 if entry in _LATERAL[name] else 1.0 for entry in range(len(places))]
            images.append(part * part.new_tensor(sign) if _LATERAL[name] else part)
    return torch.cat(images, dim=-1)


def mirror_action(action: Tensor) -> Tensor:
    """The action there: the same speed, the turn to the other side.

    Args:
        action: speed and turn rate, ``[*B, 2]``.

    Example:
        >>> import torch
        >>> mirror_action(torch.tensor([0.5, 0.2]))
        tensor([ 0.5000, -0.2000])
    """
    return action * action.new_tensor((1.0, -1.0))
