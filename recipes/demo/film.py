"""Film one policy in one scene, preference after preference."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import EnvBase, step_mdp

from envs import Scene
from envs.demonstrations import CircleDemonstrator, demonstrated_paths
from envs.people import FAR, PERSON
from envs.policy_env import make_policy_env, simulated
from envs.views import scene_view
from recipes.evaluation.setting import GOAL_RADIUS
from recipes.objectives import known, preference_colors
from torchrl_morl.evaluation import preference_strip
from torchrl_morl.evaluation.video import write_video
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.transforms import PreferenceSampler

from .legend import legend_strip, star

FPS = 12
_LIGHT = 1.1  # how much brighter than its colour a trail is in the light of the scene
_BLACK = (0.1, 0.1, 0.1)
_DASH, _GAP = 0.22, 0.16  # of the demonstrated path, metres

Trail = tuple[Tensor, tuple[float, ...]]


@torch.no_grad()
def film(
    path: Path,
    actor: TensorDictModule,
    preference_space: PreferenceSpace,
    preferences: Tensor,
    *,
    scene: str | Scene = "showcase",
    goal_radius: float = GOAL_RADIUS,
    seed: int = 0,
    max_episode_steps: int = 300,
    demonstrator: CircleDemonstrator | None = None,
    every: int = 3,
    hold: float = 1.0,
    size: tuple[int, int] = (800, 450),
    **env_kwargs: Any,
) -> Path:
    """Drive through one scene under each preference ``[P, T]`` and film it with MuJoCo.

    The camera stays: it sees all paths, start, goal, human and boxes (walls may be cut). A path has
    the colour of its preference, the mixture of those of :data:`recipes.objectives.OBJECTIVES`, and
    stays on the floor under the preferences that follow. Bars above the picture say which preference
    drives, a line below it what is what.

    Args:
        path: file to write, ``.gif`` or ``.mp4``.
        actor: the policy.
        preference_space: of its preferences.
        preferences: ``[P, T]``.

    Keyword Args:
        scene: see :class:`envs.NavigationEnv`.
        goal_radius: metres.
        seed: of the scene.
        max_episode_steps: steps before a drive is cut off.
        demonstrator: its path is drawn, black and dashed, unless the human walks or people have ways of
            their own: then it turns around a human who is elsewhere by the time of the next preference.
        every: every so many steps are a frame; so is the last one.
        hold: for how long the last frame of each preference stays, seconds.
        size: width and height of the picture, pixels; the bars and the line come on top of it.
        **env_kwargs: see :func:`envs.policy_env.make_policy_env`.

    Raises:
        ValueError: for an objective without a row in :data:`recipes.objectives.OBJECTIVES`, and
            whatever the environment refuses.
    """
    names = preference_space.tunable
    labels = [objective.label for objective in known(names)]
    bars = preference_colors(torch.eye(len(names)), names)
    simulation = {
        "scene": scene,
        "goal_radius": goal_radius,
        "max_episode_steps": max_episode_steps,
    }
    env = make_policy_env(
        PreferenceSampler(preference_space),
        keep_simulation=True,
        num_envs=1,
        seed=seed,
        **simulation,
        **env_kwargs,
    )
    # Once to learn where the camera has to look, and once for it.
    drives = [
        torch.stack([torch.stack((state["pose"][0], state["human_pose"][0])) for state in states])[
            ..., :2
        ]
        for states in (_drive(env, actor, preference, seed) for preference in preferences)
    ]
    env.set_seed(seed)
    start = env.reset(TensorDict({"preference": preferences[:1]}, [1]), set_state=False)
    goal, boxes = start["scene", "goal"], start["scene", "boxes"][0]
    ends, stands = _of_people(start)
    points = [drive.flatten(0, 1) for drive in drives] + [goal, ends]
    marks: list[Trail] = [(star(*goal[0].tolist(), 0.9 * goal_radius), _BLACK)]
    if demonstrated := demonstrator is not None and stands:
        shown = demonstrated_paths(demonstrator, start, **simulation, **simulated(env_kwargs))
        demonstration = shown["position"][0, shown["mask"][0]]
        points.append(demonstration)
        marks += [(dash, _BLACK) for dash in _dashes(demonstration)]
    width, height = size
    # Who and what is not there stands beyond everything.
    places, boxes = (one[one[:, 0].abs() < FAR / 2] for one in (torch.cat(points), boxes))
    camera = scene_view(places, boxes, width / height)
    legend = legend_strip(width, demonstration=demonstrated)

    frames, trails = [], []
    colors = [tuple(rgb) for rgb in (preference_colors(preferences, names) / _LIGHT).tolist()]
    for preference, color, drive in zip(preferences, colors, drives, strict=True):
        strip = preference_strip(preference, labels, width=width, colors=bars)
        last = len(drive) - 1
        for step, _ in enumerate(_drive(env, actor, preference, seed)):
            if step % every and step != last:
                continue
            # The newest path first: where two run together it is the one to see.
            trail = (drive[: step + 1, 0], color)
            picture = env.base_env.render(
                camera=camera, width=width, height=height, trails=[trail, *trails, *marks]
            )[0]
            frames.append(torch.cat((strip, picture.cpu(), legend)))
        frames += [frames[-1]] * round(hold * FPS)
        trails.insert(0, (drive[:, 0], color))
    env.close()
    return write_video(path, torch.stack(frames), fps=FPS)


def _of_people(start: TensorDictBase) -> tuple[Tensor, bool]:
    """Where people begin and end, ``[P, 2]``, and whether there is one human alone, who stands."""
    scene = start["scene"]
    if "people" in scene.keys():
        people = scene["people"][0]
        columns = [
            [PERSON.index(name) for name in pair] for pair in (("x", "y"), ("goal_x", "goal_y"))
        ]
        return torch.cat([people[:, pair] for pair in columns]), False
    ends = scene["human_goal"]
    return ends, bool((start["human_pose"][..., :2] == ends).all())


def _drive(
    env: EnvBase, actor: TensorDictModule, preference: Tensor, seed: int
) -> Iterator[TensorDictBase]:
    """States of one drive, from its start to its end; the same ones for every call."""
    env.set_seed(seed)
    state = env.reset(TensorDict({"preference": preference[None]}, [1]), set_state=False)
    yield state
    while not state["done"].item():
        state = step_mdp(env.step(actor(state)))
        yield state


def _dashes(path: Tensor) -> list[Tensor]:
    """Pieces of a path ``[T, 2]`` that are drawn, each ``[_, 2]``."""
    steps = (path[1:] - path[:-1]).norm(dim=-1)
    length = torch.cat((steps.new_zeros(1), steps.cumsum(0)))
    pieces = []
    for begin in torch.arange(0.0, float(length[-1]), _DASH + _GAP).tolist():
        where = torch.linspace(begin, min(begin + _DASH, float(length[-1])), 4).to(length)
        after = torch.searchsorted(length, where).clamp(1, len(path) - 1)
        share = (where - length[after - 1]) / steps[after - 1].clamp(min=1e-9)
        pieces.append(torch.lerp(path[after - 1], path[after], share.clamp(0, 1)[:, None]))
    return pieces
