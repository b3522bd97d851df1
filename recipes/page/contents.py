"""What a page holds beside its program: policies, scenes, the robot and the colours of the objectives."""

from __future__ import annotations

import base64
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from envs import NavigationEnv, Robot, Scene, get_scene
from envs.policy_env import contract
from envs.splits import TEST_SEEDS
from recipes.evaluation.setting import demonstrator, trained_in
from recipes.objectives import known
from torchrl_morl.deploy import load_policy
from torchrl_morl.deploy.networks import describe_mlp

_POLICIES = Path(__file__).resolve().parents[1] / "policies"
SHIPPED = (_POLICIES / "navigation", _POLICIES / "polished_seed0")
"""One that knows whatever people do, and one that knows people who stand, past whom it hurries more."""

RECORDING = "empty"
"""The scene in which visitors record drives, which may become a training."""

SCENES = ("showcase", "static", "moving_human", "corridor", RECORDING)

NUM_SCENES = 50
"""Seeds of each scene."""

_FIRST_TRAINING_SEED = TEST_SEEDS[-1] + 1


def contents(
    folders: Sequence[Path], scenes: Sequence[str | Path], *, num_scenes: int = NUM_SCENES
) -> dict[str, Any]:
    """What the page is told, as JSON values.

    Args:
        folders: of the policies; the first is shown first. They were trained for one robot, or for any,
            which is then a TurtleBot 2.
        scenes: names or YAML files; the first is shown first.
        num_scenes: of each of them.

    Raises:
        FileNotFoundError: for a policy or a scene that is not there.
        ValueError: for a policy that the page cannot run, policies of two robots, or a scene that is refused.
    """
    policies, robot = {}, None
    for folder in folders:
        entry, its = _policy(folder)
        if robot is not None and its != robot:
            raise ValueError(
                f"{folder}: its robot is {its.name}, that of {folders[0]} is {robot.name}: a page has "
                "one robot, build two."
            )
        if folder.name in policies:
            raise ValueError(
                f"{folder}: another policy is called {folder.name}: rename the folder."
            )
        policies[folder.name], robot = entry, its
    assert robot is not None
    names = {name for entry in policies.values() for name in entry["objectives"]}
    names -= {name for entry in policies.values() for name in entry["static"]}
    radius = policies[folders[0].name]["goal_radius"]
    return {
        "policies": policies,
        "robot": dataclasses.asdict(robot),
        "objectives": {
            row.name: {"label": row.label, "color": row.color} for row in known(sorted(names))
        },
        "scenes": dict(_scenes(get_scene(scene), robot, radius, num_scenes) for scene in scenes),
    }


def _policy(folder: Path) -> tuple[dict[str, Any], Robot]:
    policy = load_policy(folder)  # which looks at the files
    trained = trained_in(policy.card)
    setting = trained.with_one_robot
    if policy.sensing is None:
        raise ValueError(f"{folder}: its file does not tell what it senses: save it again.")
    activation = describe_mlp(policy.actor[0].module)["activation"]
    dtype = str(next(policy.actor.parameters()).dtype).removeprefix("torch.")
    for name, got, runs in (
        ("activation", activation, "ReLU"),
        ("dtype", dtype, "float32"),
        ("drive", setting.drive, "planar"),
    ):
        if got != runs:
            raise ValueError(f"{folder}: its {name} is {got}, a page runs {runs} alone.")
    space = policy.preference_space
    weights = (folder / "policy.safetensors").read_bytes()
    drives = demonstrator(policy.card, setting.robot)
    # Of robots that differ, actions are shares of the limits of each.
    one = isinstance(trained.robot, Robot)
    limits = policy.limits if one else contract(setting.arguments)["limits"]
    entry: dict[str, Any] = {
        "objectives": list(space.objectives),
        "static": dict(space.static),
        "limits": limits.to_json(),
        "sensing": policy.sensing.to_json(),
        "goal_radius": setting.goal_radius,
        # Among people with ways of their own it has met both, some who walk and some who stand.
        "walking": None if setting.scene.num_people is not None else setting.scene.human_speed > 0,
        "demonstrator": drives
        and {"radius": drives.radius, "side": drives.side, "speed": drives.speed},
        "weights": base64.b64encode(weights).decode(),
    }
    return entry, setting.robot


def _scenes(
    scene: Scene, robot: Robot, goal_radius: float, num_scenes: int
) -> tuple[str, dict[str, Any]]:
    """What the first episode of ``NavigationEnv(scene=scene, seed=seed)`` is, for the first seeds.

    No policy has trained in what the page shows, those of tests; what is recorded must not be of tests.
    """
    if scene.num_people is not None:
        raise ValueError(
            f"scene {scene.name!r} has people with ways of their own: a page shows one human, choose a "
            "scene with one, such as static or moving_human."
        )
    first = _FIRST_TRAINING_SEED if scene.name == RECORDING else TEST_SEEDS[0]
    env = NavigationEnv(
        scene=scene,
        robot=robot,
        goal_radius=goal_radius,
        num_rays=1,
        num_threads=1,
        dtype=torch.float64,
    )
    found = []
    for seed in range(first, first + num_scenes):
        env.set_seed(seed)
        start = env.reset()[0]
        found.append(
            {
                "start": start["pose"].tolist(),
                "goal": start["scene", "goal"].tolist(),
                "human": start["human_pose"].tolist(),
                "human_goal": start["scene", "human_goal"].tolist(),
                "boxes": start["scene", "boxes"].tolist(),
            }
        )
        if found[:1] == found[1:]:  # the same for every seed
            found.pop()
            break
    env.close()
    return scene.name, {
        "human_speed": scene.human_speed,
        "first_seed": first,
        "scenes": found,
    }
