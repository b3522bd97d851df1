"""One policy under many preferences: rollouts over the same scenes, a table, and its numbers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from envs.demonstrations import CircleDemonstrator, demonstrated_paths, robot_radius
from envs.metrics import episode_metrics, trajectories
from envs.policy_env import make_policy_env, simulated
from torchrl_morl.evaluation import discrete_frechet, min_clearance, rollout_preferences
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.transforms import PreferenceSampler

SHIPPED_POLICY = Path(__file__).parents[1] / "policies" / "navigation"


@dataclasses.dataclass(frozen=True)
class Sweep:
    """What a policy did under ``P`` preferences in the same ``N`` scenes."""

    preference_space: PreferenceSpace
    preferences: Tensor
    """``[P, T]``"""
    metrics: TensorDict
    """``[P, N]``, see :func:`envs.metrics.episode_metrics`, and ``min_clearance`` to boxes, metres."""
    paths: TensorDict
    """``[P, N]``, see :func:`envs.metrics.trajectories`."""
    scenes: TensorDictBase
    """``[N]``, ``start`` [N, 3], ``goal``, ``human`` [N, 3] and ``boxes``; ``robot`` [N, 8] where they differ."""
    demonstration: TensorDictBase | None = None
    """``[N]``, see :func:`envs.demonstrations.demonstrated_paths`; ``None`` without a demonstrator.
    Then ``metrics`` has ``frechet``, the distance to it in metres."""

    def mean(self, name: str) -> Tensor:
        """Mean over the episodes where the metric is defined, ``[P]``."""
        return self.metrics[name].float().nanmean(-1)

    def table(self) -> str:
        """One line per preference; means of quantities that need success come with their n."""
        names = "  ".join(f"{name[:10]:>10}" for name in self.preference_space.tunable)
        lines = [
            f"{names}  {'success':>8}  {'hit human':>9}  {'hit box':>8}  {'timeout':>8}"
            f"  {'time (n)':>14}  {'min. distance to human (n)':>26}"
        ]
        if self.demonstration is not None:
            lines[0] += f"  {'Frechet, free (n)':>17}  {'all (n)':>12}"
        count = self.metrics.shape[1]
        for row, preference in enumerate(self.preferences.tolist()):
            metrics = self.metrics[row]

            def percent(name: str, metrics: TensorDictBase = metrics) -> str:
                return f"{100 * metrics[name].float().mean():.1f} %"

            weights = "  ".join(f"{value:10.2f}" for value in preference)
            solved = int(metrics["success"].sum())
            # Nobody arrived, or nobody was there: no mean, said so instead of nan.
            time = f"{metrics['time'].nanmean():.2f} s ({solved})" if solved else "- (0)"
            near = metrics["min_human_distance"]
            seen = int((~near.isnan()).sum())
            near = f"{near.nanmean():.2f} m ({seen})" if seen else "- (0)"
            lines.append(
                f"{weights}  {percent('success'):>8}  {percent('collision_human'):>9}"
                f"  {percent('collision_obstacle'):>8}  {percent('timeout'):>8}"
                f"  {time:>14}  {near:>26}"
            )
            if self.demonstration is not None:
                free = self.demonstration["free"]
                shown = f"{metrics['frechet'][free].mean():6.2f} m" if free.any() else "-"
                lines[-1] += f"  {shown} ({int(free.sum())})".rjust(19)
                lines[-1] += f"  {metrics['frechet'].mean():5.2f} m ({count})".rjust(14)
        return "\n".join(lines)


def sweep(
    actor: TensorDictModule,
    preference_space: PreferenceSpace,
    preferences: Tensor,
    *,
    episodes: int,
    seed: int,
    max_episode_steps: int = 300,
    demonstrator: CircleDemonstrator | None = None,
    on_preference: Callable[[int], None] | None = None,
    **env_kwargs: Any,
) -> Sweep:
    """Roll a policy out in ``episodes`` scenes under each preference.

    Args:
        actor: the policy.
        preference_space: of its preferences.
        preferences: ``[P, T]``.

    Keyword Args:
        episodes: scenes, the same for every preference.
        seed: of the scenes.
        max_episode_steps: steps before an episode is truncated.
        demonstrator: what the policy was shown, for the distance to it.
        on_preference: called after each preference, for a progress bar.
        **env_kwargs: see :func:`envs.policy_env.make_policy_env`; those of a policy's training are
            in :func:`recipes.evaluation.setting.trained_in`.

    Raises:
        ValueError: for preferences off the simplex, and whatever the environment refuses.
    """
    preferences = preference_space.validate(preferences)
    env = make_policy_env(
        PreferenceSampler(preference_space),
        keep_simulation=True,
        num_envs=episodes,
        seed=seed,
        max_episode_steps=max_episode_steps,
        **env_kwargs,
    )
    first: list[TensorDictBase] = []

    def keep(rollout: TensorDictBase) -> TensorDictBase:
        if not first:
            first.append(rollout[..., 0].clone())
        names = ("pose", "human_pose", "goal", "action")
        ends = ("success", "collision_human", "collision_obstacle", "truncated")
        return rollout.select(*names, *(("next", name) for name in ("pose", "human_pose", *ends)))

    rollout = rollout_preferences(
        env,
        actor,
        preferences,
        max_steps=max_episode_steps,
        seed=seed,
        keep=keep,
        on_preference=on_preference,
    )
    env.close()
    start = first[0]
    metrics, paths, demonstration = episode_metrics(rollout), trajectories(rollout), None
    metrics["min_clearance"] = min_clearance(
        paths["position"],
        start["scene", "boxes"],
        paths["mask"],
        robot_radius(start, env.base_env.robot),
    )
    if demonstrator is not None:
        demonstration = demonstrated_paths(
            demonstrator, start, max_episode_steps=max_episode_steps, **simulated(env_kwargs)
        )
        metrics["frechet"] = discrete_frechet(
            paths["position"], paths["mask"], demonstration["position"], demonstration["mask"]
        )
    return Sweep(
        preference_space=preference_space,
        preferences=preferences,
        metrics=metrics,
        paths=paths,
        demonstration=demonstration,
        scenes=scene_layout(start),
    )


def scene_layout(start: TensorDictBase) -> TensorDict:
    """What is where in scenes ``[N]``, from snapshots of a :class:`envs.NavigationEnv`.

    Returns:
        ``start`` and ``human`` [N, 3], ``goal`` [N, 2], ``boxes`` [N, M, 5]; where robots differ ``robot``
        [N, 8], in the order of :data:`envs.robot_ranges.DRIVEN`.
    """
    scene = start["scene"]
    fields = {
        "start": start["pose"],
        "human": start["human_pose"],
        "goal": scene["goal"],
        "boxes": scene["boxes"],
    }
    if "robot" in scene.keys():
        fields["robot"] = scene["robot"]
    return TensorDict(fields, batch_size=start.batch_size)


def edge(preference_space: PreferenceSpace, first: str, second: str, steps: int = 11) -> Tensor:
    """Preferences from ``first`` alone to ``second`` alone, ``[steps, T]``.

    Raises:
        ValueError: if a name is not a tunable objective.
    """
    for name in (first, second):
        if name not in preference_space.tunable:
            raise ValueError(f"{name!r} is not tunable: choose among {preference_space.tunable}.")
    preferences = torch.zeros(steps, preference_space.num_tunable)
    share = torch.linspace(0, 1, steps)
    preferences[:, preference_space.tunable.index(first)] = 1 - share
    preferences[:, preference_space.tunable.index(second)] = share
    return preferences
