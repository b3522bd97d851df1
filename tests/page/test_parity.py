"""The page drives as ``NavigationEnv`` does, and commands what ``policy.act`` does."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import numpy as np
import pytest
import torch

from envs import Robot, get_robot
from envs.demonstrations.drivers import demonstrated_paths
from envs.policy_env import make_policy_env, simulated
from recipes.evaluation.setting import demonstrator, trained_in
from recipes.page.contents import contents
from torchrl_morl.deploy import load_policy
from torchrl_morl.evaluation import discrete_frechet
from torchrl_morl.transforms import PreferenceSampler

from ._node import needs_node, node

POLICIES = Path(__file__).resolve().parents[2] / "recipes" / "policies"
ENDINGS = {"success": "goal", "collision_human": "human", "collision_obstacle": "box"}

pytestmark = needs_node


@functools.cache
def job(name: str) -> dict:
    """What the page holds of a policy, a shipped one or a folder, and where its weights lie."""
    page = contents([POLICIES / name], ["showcase"], num_scenes=1)
    (entry,) = page["policies"].values()
    weights = str(POLICIES / name / "policy.safetensors")
    limits = {
        "goalRadius": entry["goal_radius"],
        "maxRange": entry["sensing"]["max_range"],
        "maxSteps": 300,
    }
    return {
        "policy": entry,
        "robot": page["robot"],
        "weights": weights,
        "limits": limits,
        "demonstrator": entry["demonstrator"],
    }


def driven(name: str, scene: str, episodes: int, seed: int, robot: str | Robot = "turtlebot2"):
    """Episodes of a policy under drawn preferences, and the arguments of their environment."""
    policy = load_policy(POLICIES / name)
    arguments = {**trained_in(policy.card).arguments, "scene": scene, "robot": robot}
    env = make_policy_env(
        PreferenceSampler(policy.preference_space, seed=seed),
        keep_simulation=True,
        num_envs=episodes,
        num_threads=1,
        seed=seed,
        **arguments,
    )
    with torch.no_grad():
        rollout = env.rollout(
            300, policy.actor, break_when_any_done=False, break_when_all_done=True
        )
    speed = env.base_env.scene.human_speed
    env.close()
    return rollout, speed, arguments


def scene_of(start, speed: float) -> dict:
    """The first moment of an episode, as the page takes it."""
    return {
        "start": start["pose"].tolist(),
        "goal": start["scene", "goal"].tolist(),
        "human": start["human_pose"].tolist(),
        "human_goal": start["scene", "human_goal"].tolist(),
        "boxes": start["scene", "boxes"].tolist(),
        "human_speed": speed,
    }


def on_the_page(rollout, speed: float, told: dict, folder: Path) -> list[dict]:
    """The same episodes there, from the same starts."""
    asked = [
        {"scene": scene_of(one[0], speed), "preference": one[0]["preference"].tolist()}
        for one in rollout
    ]
    return node("replay.mjs", {**told, "episodes": asked}, folder)["episodes"]


@pytest.mark.parametrize(
    ("name", "scene", "robot", "episodes"),
    [
        ("polished_seed0", "static", "turtlebot2", 12),
        ("polished_seed0", "corridor", "turtlebot2", 6),
        ("walking", "moving_human", "turtlebot2", 8),
        ("navigation", "moving_human", "turtlebot2", 8),
        # Its lidar sits ahead of the centre and sees 270 degrees.
        ("polished_seed0", "static", "hsr", 4),
    ],
)
def test_the_same_episodes(policy_folders, name, scene, robot, episodes, tmp_path):
    """Both are closed loops from the same start: nothing is corrected on the way.

    Where a drive hangs on a decision, rounding grows, by a factor of ten thousand in one of a former
    policy: the bounds are of medians, and wide for the worst.
    """
    check_the_same_episodes(str(policy_folders[name]), scene, robot, episodes, tmp_path)


def check_the_same_episodes(
    name: str, scene: str, robot: str | Robot, episodes: int, folder: Path
) -> None:
    rollout, speed, _ = driven(name, scene, episodes, seed=7, robot=robot)
    told = {**job(name), "robot": dataclasses.asdict(get_robot(robot))}
    ours = on_the_page(rollout, speed, told, folder)
    largest = {key: [] for key in ("scan", "observation", "action", "pose", "human")}
    for theirs, mine in zip(rollout, ours, strict=True):
        length = int(theirs["next", "done"].int().argmax()) + 1
        assert len(mine["steps"]) == length
        last = theirs["next"][length - 1]
        (ending,) = [told for key, told in ENDINGS.items() if last[key]] or ["time"]
        assert mine["ending"] == ending
        for key, values in (
            ("scan", theirs["scan"]),
            ("observation", theirs["observation"]),
            ("action", theirs["action"]),
            ("pose", theirs["next", "pose"]),
            ("human", theirs["next", "human_pose"]),
        ):
            got = np.array([step[key] for step in mine["steps"]])
            off = np.abs(got - values[:length].double().numpy())
            if key == "pose":
                off[:, 2] = np.minimum(off[:, 2], 2 * np.pi - off[:, 2])
                if mine["ending"] in ("human", "box"):  # the next test
                    off = off[:-1]
            # A ray that grazes an edge meets it or not: all but one in ten thousand are compared.
            largest[key].append(np.quantile(off, 0.9999) if key == "scan" else off.max())
    middle = {key: np.median(values) for key, values in largest.items()}
    most = {key: max(values) for key, values in largest.items()}
    print(
        Path(name).name,
        scene,
        get_robot(robot).name,
        *(f"{key} {middle[key]:.0e} {most[key]:.0e}" for key in most),
    )
    assert middle["scan"] < 1e-4  # metres
    assert middle["observation"] < 1e-5
    assert middle["action"] < 1e-5
    assert middle["pose"] < 2e-6  # metres, radians
    assert most["pose"] < 5e-3
    assert most["human"] < 1e-9


def test_the_same_contacts_but_for_the_last_pose(tmp_path):
    """MuJoCo's contact holds the robot back in the step that ends in one."""
    name = "behaviour_clone"  # which runs into boxes
    rollout, speed, _ = driven(name, "static", 32, seed=7)
    before, last = [], []
    for theirs, mine in zip(rollout, on_the_page(rollout, speed, job(name), tmp_path), strict=True):
        length = int(theirs["next", "done"].int().argmax()) + 1
        touched = bool(theirs["next", "collision_obstacle"][length - 1])
        assert (mine["ending"] == "box") == touched
        if touched:
            got = np.array([step["pose"][:2] for step in mine["steps"]])
            off = np.hypot(*(got - theirs["next", "pose"][:length, :2].numpy()).T)
            before.append(off[:-1].max())
            last.append(off[-1])
    print(f"{len(last)} contacts, last pose {max(last):.3f} m, before {np.median(before):.0e} m")
    assert len(last) > 10
    assert np.median(before) < 2e-6
    assert max(last) < 0.055


@pytest.mark.parametrize("name", ["polished_seed0", "walking"])
def test_the_same_commands_as_policy_act_also_beyond_the_training(policy_folders, name, tmp_path):
    folder = str(policy_folders[name])
    policy, random = load_policy(folder), np.random.default_rng(0)
    n = 1_000
    scan = random.uniform(0.05, 4.5, (n, 720))
    goal = np.stack((random.uniform(0, 30, n), random.uniform(-np.pi, np.pi, n)), -1)
    human = np.stack((random.uniform(0.2, 20, n), random.uniform(-np.pi, np.pi, n)), -1)
    velocity = random.uniform(-1, 1, (n, 2))
    preference = random.dirichlet(np.ones(3), n)
    given = {"human_velocity": velocity} if policy.sensing.observe_human_velocity else {}
    expected = policy.act(
        preference=preference,
        lidar=scan.reshape(n, 30, 24).min(-1).clip(None, 4.0),
        goal=goal,
        human=human,
        **given,
    )
    inputs = [
        {"scan": s, "goal": g, "human": h, "humanVelocity": v, "preference": p}
        for s, g, h, v, p in zip(
            *(one.tolist() for one in (scan.clip(None, 4.0), goal, human, velocity, preference))
        )
    ]
    got = np.array(node("replay.mjs", {**job(folder), "inputs": inputs}, tmp_path)["commands"])
    off = np.abs(got - expected).max(0)
    print(name, f"{off[0]:.1e} m/s, {off[1]:.1e} rad/s")
    assert off[0] < 1e-5
    assert off[1] < 1e-4


def test_the_same_demonstrated_path_and_distance_to_it(tmp_path):
    rollout, speed, arguments = driven("polished_seed0", "static", 8, seed=7)
    start = rollout[:, 0]
    policy = load_policy(POLICIES / "polished_seed0")
    shown = demonstrated_paths(
        demonstrator(policy.card, trained_in(policy.card).robot), start, **simulated(arguments)
    )
    asked, expected = [], []
    for episode, way, mask in zip(rollout, shown["position"], shown["mask"]):
        length = int(episode["next", "done"].int().argmax()) + 1
        path = torch.cat((episode["pose"][:1, :2], episode["next", "pose"][:length, :2]))
        asked.append({"scene": scene_of(episode[0], speed), "path": path.tolist()})
        whole = torch.ones(len(path), dtype=torch.bool)
        expected.append((way[mask], discrete_frechet(path, whole, way, mask).item()))
    answers = node("replay.mjs", {**job("polished_seed0"), "shown": asked}, tmp_path)["shown"]
    for (way, distance), answer in zip(expected, answers, strict=True):
        assert np.abs(np.array(answer["points"]) - way.numpy()).max() < 1e-4
        assert answer["distance"] == pytest.approx(distance, abs=1e-4)
        so_far = answer["soFar"]
        assert so_far == sorted(so_far)  # it never comes nearer again
        assert so_far[0] == 0.0
        assert so_far[-1] <= answer["distance"]
