"""What holds a transform: an environment, or something else."""

from __future__ import annotations

from torchrl.envs.transforms import Transform

__all__ = ["is_in_environment"]


def is_in_environment(transform: Transform) -> bool:
    """Not so in a replay buffer, whose writes pass through ``_inv_call`` as steps do."""
    try:
        return transform.container is not None
    except ValueError:
        # TorchRL's answer where a replay buffer holds the chain.
        return False
