"""Specs of what the navigation environment shows."""

from __future__ import annotations

import math

import torch
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded

from .faults import NUM_AMOUNTS, Faults
from .people import PERSON
from .robot_ranges import DRIVEN
from .scenes import Scene


def observation_spec(
    n: int, num_rays: int, max_range: float, dtype: torch.dtype, *, invalid_rays: bool = False
) -> Composite:
    """Of what the robot senses, how an episode ended, and the true poses, for ``n`` environments."""
    low = torch.tensor([0.0, -math.pi], dtype=dtype).expand(n, 2).clone()
    high = torch.tensor([math.inf, math.pi + 1e-6], dtype=dtype).expand(n, 2).clone()
    return Composite(
        # What is invalid may be coded as infinity or NaN.
        scan=Unbounded(shape=(n, num_rays), dtype=dtype)
        if invalid_rays
        else Bounded(0.0, max_range, shape=(n, num_rays), dtype=dtype),
        goal=Bounded(low=low, high=high, dtype=dtype),
        human=Bounded(low=low.clone(), high=high.clone(), dtype=dtype),
        success=Binary(n=1, shape=(n, 1), dtype=torch.bool),
        collision_human=Binary(n=1, shape=(n, 1), dtype=torch.bool),
        collision_obstacle=Binary(n=1, shape=(n, 1), dtype=torch.bool),
        pose=Unbounded(shape=(n, 3), dtype=torch.float64),
        human_pose=Unbounded(shape=(n, 3), dtype=torch.float64),
        shape=(n,),
    )


def snapshot_specs(
    n: int, scene: Scene, faults: Faults, *, robots_differ: bool = False
) -> dict[str, TensorSpec]:
    """Of what an episode of ``n`` environments needs, besides its poses, to go on from there."""
    fields = {
        "goal": Unbounded(shape=(n, 2), dtype=torch.float64),
        "boxes": Unbounded(shape=(n, scene.num_boxes, 5), dtype=torch.float64),
    }
    if scene.num_people is None:
        fields["human_goal"] = Unbounded(shape=(n, 2), dtype=torch.float64)
    else:
        shape = (n, scene.num_people, len(PERSON))
        fields["people"] = Unbounded(shape=shape, dtype=torch.float64)
    if robots_differ:
        fields["robot"] = Unbounded(shape=(n, len(DRIVEN)), dtype=torch.float64)
    specs = {"scene": Composite(fields, shape=(n,))}
    if faults.memory:
        specs["pending_action"] = Unbounded(shape=(n, 2 * faults.memory), dtype=torch.float64)
    if faults.is_random:
        specs["faults"] = Unbounded(shape=(n, NUM_AMOUNTS), dtype=torch.float64)
    return specs
