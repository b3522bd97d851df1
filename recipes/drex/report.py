"""Diagnostics of a reward model that decide before any RL."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import ActionScaling, Compose

from envs import HUMAN_RADIUS, TURTLEBOT2, Robot, get_robots
from envs.policy_env import observed
from envs.robot_ranges import DRIVEN
from torchrl_morl.deploy.features import policy_transforms
from torchrl_morl.deploy.sensing import NUM_ROBOT
from torchrl_morl.evaluation import steerability
from torchrl_morl.geometry import rotate, wrap_angle
from torchrl_morl.modules import RewardModel
from torchrl_morl.transforms import VelocityInFrame

from . import ranking, styles
from .demonstrations import demonstrated
from .rollouts import core_return, frechet, mean_and_error, succeeded

# Of the environment's lidar.
_NUM_RAYS, _MAX_RANGE = 720, 4.0


@torch.no_grad()
def write_report(
    run_dir: Path,
    cfg: DictConfig,
    model: RewardModel,
    groups: list[tuple[float, TensorDictBase]],
    held_out: dict[str, Any],
) -> dict[str, Any]:
    """Numbers and pictures of a reward model.

    What is shown of the demonstrated circle is missing where the recipe was given recorded ones.

    Args:
        run_dir: where the pictures go.
        cfg: of the recipe.
        model: the reward model.
        groups: demonstrations, then the noisy rollouts with their quality (minus the noise level).
        held_out: of :func:`ranking.held_out_accuracy`.

    Returns:
        Diagnostics, as JSON values.
    """
    noisy = groups[1:]
    recorded = None if cfg.demonstrations.dataset is None else groups[0][1]
    scores = ranking.mean_scores(model, noisy)
    levels = [-quality for quality, _ in noisy]
    every = torch.cat([ranking.step_scores(model, data)[data["mask"]] for _, data in groups])
    contrast = styles.style_contrast(cfg, model, recorded)
    rivals = [value for name, value in contrast.items() if name != "demonstration"]
    lead = contrast["demonstration"] - max(rivals, default=float("nan"))
    degradation_figure(run_dir / "degradation.png", cfg, noisy)
    if recorded is None:
        heat_map(run_dir / "heat_map.png", cfg, model)
    else:
        drives = {"recorded": recorded, f"clone, {levels[-1]:.0%} noise": noisy[-1][1]}
        drives_figure(run_dir / "drives.png", model, drives)
    contrast_figure(run_dir / "style_contrast.png", contrast)
    rho = steerability(torch.tensor(levels), torch.tensor(scores))
    share_saturated = ((every < 0.02) | (every > 0.98)).float().mean().item()
    print(f"Spearman rho(noise level, mean R) = {rho:.2f} (gate: <= -0.9)")
    print(accuracy_table(held_out["held_out_accuracy per noise gap"]))
    print(f"share of R outside [0.02, 0.98]: {100 * share_saturated:.1f} %")
    print("mean R within 2 m of the human:")
    for name, value in contrast.items():
        print(f"  {name:>18}: {value:.3f}")
    print(f"lead of the demonstration over the next style: {lead:.3f} (gate: >= 0.2)")
    for warning in warnings_of(noisy, rho, lead):
        print(f"warning: {warning}")
    return {
        "noise_levels": levels,
        "mean_score_per_level": scores,
        "spearman_noise_score": rho,
        "share_saturated": share_saturated,
        "style_contrast": contrast,
        "style_lead": lead,
    }


def warnings_of(noisy: list[tuple[float, TensorDictBase]], rho: float, lead: float) -> list[str]:
    """Where a stage has failed at its purpose.

    Args:
        noisy: rollouts of the clone with their quality, the least noisy first.
        rho: rank correlation of the noise level with the mean R.
        lead: of the mean R of the demonstration over that of the next style.
    """
    found = []
    (_, least), *_, (_, most) = noisy
    arrived = 100 * succeeded(least).float().mean().item()
    if arrived < 50:
        found.append(
            f"the cloned policy arrives in {arrived:.0f} % of the scenes: noise makes it no worse, so "
            "that D-REX has little to rank. Demonstrate more, also in scenes with boxes, or rely on "
            "style_negatives."
        )
    if core_return(most).mean() >= core_return(least).mean():
        found.append(
            "the degradation is inverted: the clone earns no less under the most noise than under the "
            "least, see degradation.png."
        )
    if rho > -0.9:
        found.append(
            f"R does not fall with the noise (rho {rho:.2f}): raise noise.rollouts or "
            "reward_model.updates."
        )
    if lead < 0.2:
        found.append(
            f"R hardly tells the demonstration from the next style (lead {lead:.2f}): a policy will "
            "not learn it. Demonstrate what differs, or raise style_negatives.rollouts."
        )
    return found


def accuracy_table(per_gap: dict[str, float]) -> str:
    """Held-out pairs that R ranks right, by how far their noise levels are apart."""
    lines = ["held-out pairs ranked right, by the gap between their noise levels:"]
    lines += [f"  {gap:>18}: {100 * accuracy:.1f} %" for gap, accuracy in per_gap.items()]
    return "\n".join(lines)


def degradation_figure(
    path: Path, cfg: DictConfig, noisy: list[tuple[float, TensorDictBase]]
) -> None:
    """Core return and Frechet distance to the demonstration against noise (Fig. 2a).

    The distance to the scripted circle alone: nobody knows what a person would have done elsewhere.
    """
    count = min(cfg.diagnostics.rollouts, cfg.noise.rollouts)
    core = torch.stack([core_return(data[:count]) for _, data in noisy])
    panels = [(core, "core return, as a share of what the way to the goal pays")]
    title = "cloned policy under held noise, means and standard errors"
    if cfg.demonstrations.dataset is None:
        # In the scenes of the noisy rollouts; nobody can follow a path that leads through a box.
        reference = demonstrated(cfg, cfg.noise.rollouts, cfg.seed + 10_000)[:count]
        free = reference["free"]
        distance = torch.stack([frechet(data[:count], reference)[free] for _, data in noisy])
        panels.append((distance, "Frechet distance to the demonstration / m"))
        title += "; the distance where no box stands on the demonstrated path"
    levels = [-quality for quality, _ in noisy]
    fig, axes = plt.subplots(
        1, len(panels), figsize=(4.5 * len(panels), 3.6), layout="constrained", squeeze=False
    )
    for ax, (values, label) in zip(axes[0], panels, strict=True):
        mean, error = mean_and_error(values)
        ax.errorbar(levels, mean, error, marker="o", capsize=3, color="#0072b2")
        ax.set_xlabel("share of noisy steps")
        ax.set_ylabel(label)
        ax.set_title(f"n = {values.shape[1]}", fontsize=9)
        ax.grid(alpha=0.3)
    fig.suptitle(title, fontsize=10, wrap=True)
    fig.savefig(path, dpi=120)
    plt.close(fig)


def heat_map(
    path: Path, cfg: DictConfig, model: RewardModel, goal: float = 4.0, extent: float = 2.5
) -> None:
    """R over the plane around a human, for a robot that heads as demonstrated, and opposite."""
    robots = get_robots(cfg.env.robot)
    radius, robot = cfg.demonstrations.radius, robots if isinstance(robots, Robot) else TURTLEBOT2
    mirror = 1.0 if cfg.demonstrations.side == "left" else -1.0
    axis = torch.linspace(-extent, extent, 101)
    x, y = torch.meshgrid(axis, axis, indexing="xy")
    position = torch.stack((x, y), dim=-1)  # the human is the origin, the goal lies to the right
    distance = position.norm(dim=-1)
    towards_human = torch.atan2(-y, -x)
    towards_goal = torch.atan2(-y, goal - x)
    angle = torch.atan2(mirror * y, x)  # pi before the human, 0 behind it
    phase = torch.where(angle < -torch.pi / 2, angle + 2 * torch.pi, angle)
    tangent = towards_human + mirror * torch.pi / 2
    leaving, orbiting = phase <= 0.1, distance <= radius + 0.2
    heading = torch.where(leaving, towards_goal, torch.where(orbiting, tangent, towards_human))
    fig, axes = plt.subplots(1, 2, figsize=(10.5, 4.6), layout="constrained")
    for ax, turned, title in (
        (axes[0], 0.0, "heading as demonstrated"),
        (axes[1], torch.pi, "heading the opposite way"),
    ):
        curve = -mirror * cfg.demonstrations.speed / radius / robot.max_turn_rate
        turn_rate = torch.where(leaving | ~orbiting, 0.0, curve)
        speed = torch.full_like(turn_rate, 2 * cfg.demonstrations.speed / robot.max_speed - 1)
        features = observation(position, heading + turned, goal, robot=robot, **observed(cfg.env))
        action = torch.stack((speed, turn_rate), dim=-1)
        data = TensorDict({"observation": features, "action": action}, batch_size=x.shape)
        score = model(data)["demo_score"].squeeze(-1)
        image = ax.pcolormesh(
            *(values.numpy() for values in (x, y, score)),
            vmin=0,
            vmax=1,
            cmap="viridis",
            shading="auto",
        )
        circle = torch.linspace(0, torch.pi, 100)
        line = {"color": "white", "linestyle": "--", "linewidth": 1.5}
        ax.plot(radius * circle.cos(), mirror * radius * circle.sin(), **line)
        ax.plot([-extent, -radius], [0, 0], **line)
        ax.plot([radius, extent], [0, 0], **line)
        ax.add_patch(plt.Circle((0, 0), HUMAN_RADIUS, color="#d55e00"))
        ax.set_aspect("equal")
        ax.set_title(title)
        ax.set_xlabel("x / m (goal to the right)")
    axes[0].set_ylabel("y / m")
    fig.colorbar(image, ax=axes, label="R")
    fig.savefig(path, dpi=120)
    plt.close(fig)


@torch.no_grad()
def drives_figure(path: Path, model: RewardModel, drives: dict[str, TensorDictBase]) -> None:
    """R along trajectories ``[N, T]``, turned so that all start on the left and have the human ahead."""
    fig, axes = plt.subplots(
        1, len(drives), figsize=(10.5, 4.6), sharex=True, sharey=True, layout="constrained"
    )
    for ax, (title, data) in zip(axes, drives.items(), strict=True):
        score = ranking.step_scores(model, data)
        position = data["pose"][..., :2] - data["human_pose"][..., :2]
        first = position[:, :1]
        turn = torch.pi - torch.atan2(first[..., 1], first[..., 0])
        x, y = rotate(position, turn.expand(data.shape))[data["mask"]].unbind(-1)
        image = ax.scatter(x, y, c=score[data["mask"]], s=3, vmin=0, vmax=1, cmap="viridis")
        ax.add_patch(plt.Circle((0, 0), HUMAN_RADIUS, color="#d55e00"))
        ax.set_aspect("equal")
        ax.set_title(f"{title} (n = {len(data)})")
        ax.set_xlabel("x / m (from the start to the human)")
    axes[0].set_ylabel("y / m (the human is at 0, 0)")
    fig.colorbar(image, ax=axes, label="R")
    fig.savefig(path, dpi=120)
    plt.close(fig)


def observation(
    position: Tensor,
    heading: Tensor,
    goal: float,
    *,
    robot: Robot = TURTLEBOT2,
    **reads: bool,
) -> Tensor:
    """The policy's observation ``[*B, D]`` at positions around a human, nothing else in sight.

    Args:
        position: of the robot, ``[*B, 2]``; the human is the origin.
        heading: ``[*B]``.
        goal: its x.
        robot: that is there.
        **reads: see :func:`~torchrl_morl.deploy.features.policy_transforms`.
    """
    x, y = position.unbind(-1)

    def polar(dx: Tensor, dy: Tensor) -> Tensor:
        bearing = wrap_angle(torch.atan2(dy, dx) - heading)
        return torch.stack((torch.hypot(dx, dy), bearing), dim=-1)

    # Where each ray meets the cylinder that stands for the human.
    distance = torch.hypot(x, y)[..., None]
    ray = torch.arange(_NUM_RAYS).to(x) * (2 * torch.pi / _NUM_RAYS)
    off = ray - (torch.atan2(-y, -x) - heading)[..., None]
    aside = distance * off.sin()
    along = distance * off.cos() - (HUMAN_RADIUS**2 - aside**2).clamp_min(0.0).sqrt()
    hit = (aside.abs() <= HUMAN_RADIUS) & (off.cos() > 0) | (distance <= HUMAN_RADIUS)
    scan = along.clamp(0.0, _MAX_RANGE).masked_fill(~hit, _MAX_RANGE)
    numbers = torch.tensor([getattr(robot, name) for name in DRIVEN[:NUM_ROBOT]]).to(x)
    sensed = TensorDict(
        {
            "scan": scan,
            "goal": polar(goal - x, -y),
            "human": polar(-x, -y),
            "human_velocity": torch.zeros(*x.shape, 2).to(x),  # they stand
            "robot": numbers.expand(*x.shape, -1),
        },
        batch_size=x.shape,
    )
    transforms = policy_transforms(_MAX_RANGE, **reads)
    # It is the features that are wanted; there is no action to scale, and no step before.
    others = ActionScaling, VelocityInFrame
    features = Compose(*(one.clone() for one in transforms if not isinstance(one, others)))
    return features(sensed)["observation"]


def contrast_figure(path: Path, contrast: dict[str, float]) -> None:
    """Mean R of each style."""
    fig, ax = plt.subplots(figsize=(7, 3.4), layout="constrained")
    colors = ["#0072b2" if name == "demonstration" else "0.6" for name in contrast]
    ax.barh(list(contrast), list(contrast.values()), color=colors)
    ax.invert_yaxis()
    ax.set_xlim(0, 1)
    ax.set_xlabel("mean R within 2 m of the human")
    fig.savefig(path, dpi=120)
    plt.close(fig)
