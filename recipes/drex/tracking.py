"""Drives along the demonstrated paths under the noise of a learner, and along paths beside them.

A reward model that has seen the demonstrations alone takes the noise of whoever learns from it for
another style: what it pays then depends on the noise and hardly on the path. So it is shown what is
demonstrated under such noise, too, by a driver that comes back to the path, and, ranked below, paths
with a bulge under the same noise.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torch.nn import functional as F

from envs import NavigationEnv
from envs.demonstrations import CircleDemonstrator, PathDriver, demonstrated_paths
from envs.policy_env import simulated
from envs.splits import training_seed

from .demonstrations import demonstrator_arguments
from .recorded import started
from .rollouts import INTENDED, rollouts, succeeded

FILE = "tracked.safetensors"
"""What a run calls the drives along demonstrated paths, from which a policy can be cloned."""

_SEED = 60_000
"""Beside the seeds of demonstrations, rollouts and diagnostics."""

_DEVIATION = 0.12
"""Metres from the path, at which a snippet of a bulge is one of another path: twice what the driver
leaves the path by."""


@dataclasses.dataclass(frozen=True)
class Paths:
    """What is demonstrated."""

    start: TensorDictBase
    """Snapshots ``[N]`` of a :class:`~envs.NavigationEnv`."""
    position: Tensor
    """Metres, ``[N, L, 2]``."""
    mask: Tensor
    """Valid points, ``[N, L]``."""
    arguments: dict[str, Any]
    """Of the environment."""


def disturbed(driver: TensorDictModuleBase, sigma: Tensor, seed: int) -> TensorDictSequential:
    """A driver whose actions in [-1, 1] carry normal noise and stay within those limits.

    What it would have done without noise stands beside, as ``intended_action``.

    Args:
        driver: writes ``action`` ``[N, A]``.
        sigma: standard deviations, ``[A]`` or ``[N, A]``.
        seed: of the noise.
    """
    generator = torch.Generator().manual_seed(seed)

    def disturb(action: Tensor) -> tuple[Tensor, Tensor]:
        noise = torch.randn(action.shape, generator=generator)
        return (action + sigma * noise).clamp(-1.0, 1.0), action

    noisy = TensorDictModule(disturb, in_keys=["action"], out_keys=["action", INTENDED])
    return TensorDictSequential(driver, noisy)


def drawn_sigma(cfg: DictConfig, count: int, generator: torch.Generator) -> Tensor:
    """A share of ``tracking.noise`` for each of so many drives, ``[N, A]``."""
    most = torch.tensor(list(cfg.tracking.noise))
    return most * torch.rand(count, 1, generator=generator)


@torch.no_grad()
def tracked(cfg: DictConfig, paths: Paths) -> TensorDictBase:
    """The demonstrated paths under noise, trajectories ``[N, T]`` that reach the goal."""
    generator = torch.Generator().manual_seed(cfg.seed + _SEED)
    sigma = drawn_sigma(cfg, len(paths.position), generator)
    data = _drive(cfg, paths, paths.position, sigma, cfg.seed + _SEED)
    return data[succeeded(data)]


def shown(tracked: TensorDictBase) -> TensorDictBase:
    """Drives under noise as demonstrations: states off the path, and the actions that lead back to it.

    After DART (Laskey et al., https://arxiv.org/abs/1703.09327): who clones these stays on the path,
    where a clone of undisturbed drives never saw what is beside it.

    Args:
        tracked: of :func:`tracked`.
    """
    return tracked.select("observation", "goal", "human", "pose", "human_pose", "mask").set(
        "action", tracked[INTENDED]
    )


@torch.no_grad()
def bulging(cfg: DictConfig, paths: Paths) -> TensorDictBase:
    """Paths with a bulge under noise, trajectories ``[N, T]``.

    ``near`` marks the steps at which snippets of the bulge start.
    """
    section, count = cfg.tracking, len(paths.position)
    generator = torch.Generator().manual_seed(cfg.seed + _SEED + 1)

    def drawn(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, generator=generator)

    side = 2.0 * torch.randint(2, (count,), generator=generator) - 1.0
    other = bulge(
        paths.position,
        paths.mask,
        height=side * drawn(*section.heights),
        width=drawn(*section.widths),
        place=drawn(0.1, 0.95),
    )
    sigma = drawn_sigma(cfg, count, generator)
    data = _drive(cfg, paths, other, sigma, cfg.seed + _SEED + 1)
    away = deviation(data["pose"][..., :2], paths.position, paths.mask)
    # Where the middle of a snippet lies on the bulge.
    half = cfg.reward_model.snippet_length // 2
    middle = F.pad(away, (0, half))[:, half:]
    return data.set("near", middle > _DEVIATION)


def deviation(position: Tensor, path: Tensor, mask: Tensor) -> Tensor:
    """Distance from where robots are to the nearest point of their path.

    Args:
        position: metres, ``[N, T, 2]``.
        path: metres, ``[N, L, 2]``.
        mask: valid points, ``[N, L]``.

    Returns:
        Metres, ``[N, T]``.

    Examples:
        >>> path, mask = (
        ...     torch.tensor([[[0.0, 0.0], [1.0, 0.0], [9.0, 9.0]]]),
        ...     torch.tensor([[1, 1, 0]]),
        ... )
        >>> deviation(torch.tensor([[[1.0, 0.5], [9.0, 9.0]]]), path, mask.bool())
        tensor([[ 0.5000, 12.0416]])
    """
    # The matrix product of the other modes costs half the digits.
    exact = "donot_use_mm_for_euclid_dist"
    apart = torch.cdist(position, path.to(position), compute_mode=exact)
    return apart.masked_fill(~mask.unsqueeze(-2), torch.inf).amin(-1)


def bulge(path: Tensor, mask: Tensor, *, height: Tensor, width: Tensor, place: Tensor) -> Tensor:
    """Push paths to the side, as a normal curve over their length; their ends stay.

    Args:
        path: metres, ``[N, L, 2]``.
        mask: valid points, ``[N, L]``.

    Keyword Args:
        height: by how much, to the left, metres, ``[N]``.
        width: standard deviation along the path, metres, ``[N]``.
        place: of the middle, as a share of the length, ``[N]``.

    Returns:
        ``[N, L, 2]``.

    Examples:
        >>> path = torch.stack((torch.linspace(0, 4, 41), torch.zeros(41)), -1)[None]
        >>> numbers = {"height": 0.5, "width": 0.4, "place": 0.5}
        >>> numbers = {name: torch.tensor([value]) for name, value in numbers.items()}
        >>> other = bulge(path, torch.ones(1, 41, dtype=torch.bool), **numbers)
        >>> other[0, [0, 20, 40], 1]
        tensor([0.0000, 0.5000, 0.0000])
    """
    rows, steps = torch.arange(len(path)).unsqueeze(-1), torch.arange(path.shape[1])
    last = mask.sum(-1, keepdim=True) - 1
    path = path[rows, steps.minimum(last)]
    arc = F.pad((path[:, 1:] - path[:, :-1]).norm(dim=-1).cumsum(-1), (1, 0))
    length = arc[:, -1:]
    # The direction over a metre or so: corners are sharp.
    ahead, behind = (
        path[rows, (steps + 5).minimum(last)],
        path[rows, (steps - 5).clamp_min(0)[None]],
    )
    along = F.normalize(ahead - behind, dim=-1)
    left = torch.stack((-along[..., 1], along[..., 0]), dim=-1)
    curve = torch.exp(-0.5 * ((arc - place.unsqueeze(-1) * length) / width.unsqueeze(-1)) ** 2)
    ends = (arc / 0.5).clamp_max(1.0) * ((length - arc) / 0.5).clamp(0.0, 1.0)
    return path + (height.unsqueeze(-1) * curve * ends).unsqueeze(-1) * left


def demonstrated(cfg: DictConfig, recorded: TensorDictBase | None = None) -> Paths:
    """What is demonstrated, and from where.

    Recorded drives take turns, without boxes. The scripted pattern is driven in scenes of its own, those
    in which no box blocks it.
    """
    count = cfg.tracking.rollouts
    if recorded is not None:
        drives = recorded[torch.arange(count) % len(recorded)]
        start, arguments = started(cfg, drives)
        return Paths(start, drives["pose"][..., :2], drives["mask"], arguments)
    arguments = simulated(cfg.env)
    starts, paths, found, seed = [], [], 0, cfg.seed + _SEED
    while found < count:
        env = NavigationEnv(num_envs=count, seed=training_seed(seed), **arguments)
        start = env.reset()
        env.close()
        reference = demonstrated_paths(
            CircleDemonstrator(**demonstrator_arguments(cfg)), start, **arguments
        )
        free = reference["free"]
        starts.append(start[free])
        paths.append(reference[free])
        found, seed = found + int(free.sum()), seed + 1
    longest = max(path["position"].shape[1] for path in paths)
    position, mask = (
        torch.cat([_longer(path[key], longest) for path in paths])[:count]
        for key in ("position", "mask")
    )
    return Paths(torch.cat(starts)[:count], position, mask, arguments)


def _longer(values: Tensor, steps: int) -> Tensor:
    """``[N, T, ...]`` with zeros behind, up to so many steps."""
    return F.pad(values, (*(0, 0) * (values.ndim - 2), 0, steps - values.shape[1]))


def _drive(cfg: DictConfig, paths: Paths, path: Tensor, sigma: Tensor, seed: int) -> TensorDictBase:
    driver = PathDriver(path, paths.mask, cfg.env.robot, scaled=True)
    arguments = {**cfg.env, **paths.arguments}
    return rollouts(
        disturbed(driver, sigma, seed), len(path), cfg.seed, start=paths.start, **arguments
    )
