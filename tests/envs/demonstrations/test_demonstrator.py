"""The scripted drivers: their geometry in 200 random scenes, mirror images and options."""

from __future__ import annotations

import functools
import math

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import ActionScaling, TransformedEnv

from envs import HSR, TURTLEBOT2, NavigationEnv
from envs.demonstrations import (
    CircleDemonstrator,
    DetourDriver,
    StraightDriver,
    demonstrated_paths,
)
from torchrl_morl.evaluation import episode_mask
from torchrl_morl.geometry import rotate, wrap_angle

make_env = functools.partial(
    NavigationEnv, scene="empty", num_threads=1, seed=0, dtype=torch.float64
)


def roll_out(env, policy, start: TensorDict | None = None) -> TensorDictBase:
    """First episodes ``[N, T]`` with ``mask``, without the scans."""
    data = env.rollout(
        300,
        policy,
        auto_reset=start is None,
        tensordict=start,
        break_when_any_done=False,
        break_when_all_done=True,
    )
    return data.set("mask", episode_mask(data["next", "done"]))


def succeeded(data: TensorDictBase) -> torch.Tensor:
    return (data["next", "success"].squeeze(-1) & data["mask"]).any(-1)


def at(values: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
    """Each row's value at its own step, the last one at most."""
    return values.gather(1, step.clamp(max=values.shape[1] - 1)[:, None]).squeeze(1)


class Pattern:
    """What a rollout ``[N, T]`` passing on the left looks like from above, in the scene's frame.

    The corner starts 0.1 m outside of the radius; ``settled`` steps later the orbit has begun.
    """

    def __init__(
        self, data: TensorDictBase, radius: torch.Tensor | float, settled: int = 3
    ) -> None:
        radius = torch.as_tensor(radius, dtype=torch.float64).reshape(-1, 1)
        self.mask, self.steps = data["mask"], torch.arange(data.shape[1])
        pose, human = data["pose"], data["human_pose"][..., :2]
        self.position, self.heading = pose[..., :2], pose[..., 2]
        offset = self.position - human
        self.distance, self.radius = offset.norm(dim=-1), radius
        way = self.goal(data) - human
        around = torch.atan2(offset[..., 1], offset[..., 0])
        # Angle at the human from the goal to the robot, counter-clockwise.
        self.phase = wrap_angle(around - torch.atan2(way[..., 1], way[..., 0]))
        self.turned = wrap_angle(around.diff(dim=-1))  # per step, around the human
        self.corner = (self.distance <= radius + 0.1).int().argmax(1)
        self.entry = self.corner + settled
        orbiting = self.steps >= self.entry[:, None]
        self.leaving = (orbiting & (self.phase.abs() <= 0.1)).int().argmax(1)

    @staticmethod
    def goal(data: TensorDictBase) -> torch.Tensor:
        distance, bearing = data["goal"].unbind(-1)
        local = torch.stack((distance, torch.zeros_like(distance)), dim=-1)
        return data["pose"][..., :2] + rotate(local, data["pose"][..., 2] + bearing)

    def between(self, first: torch.Tensor | int, last: torch.Tensor) -> torch.Tensor:
        """Steps ``[N, T]`` from ``first`` up to, not including, ``last``."""
        first = torch.as_tensor(first).reshape(-1, 1)
        return self.mask & (self.steps >= first) & (self.steps < last[:, None])


@pytest.fixture(scope="module")
def data() -> TensorDictBase:
    return roll_out(make_env(num_envs=200, snapshots=False), CircleDemonstrator())


@pytest.fixture(scope="module")
def pattern(data) -> Pattern:
    return Pattern(data, 1.0)


def test_it_always_reaches_the_goal(data):
    assert succeeded(data).all()


def test_it_approaches_the_human_in_a_straight_line(data, pattern):
    # The first second goes into turning: the robot starts up to 30 degrees off.
    approach = pattern.between(5, pattern.corner)
    assert (approach.sum(1) >= 2).all()
    assert data["human"][..., 1][approach].abs().max() < 0.02
    bend = wrap_angle(pattern.heading - at(pattern.heading, pattern.corner)[:, None])
    assert bend[approach].abs().max() < 0.02


def test_it_turns_left_by_a_right_angle_at_one_metre(data, pattern):
    assert ((at(pattern.distance, pattern.corner) - 1.0).abs() < 0.11).all()
    # Seen from the robot, the human moves from straight ahead to its right in 0.8 s.
    assert (at(data["human"][..., 1], pattern.corner).abs() < 0.02).all()
    bearing = at(data["human"][..., 1], pattern.corner + 4)
    assert ((bearing + math.pi / 2).abs() < 0.1).all()
    # The orbit bends the other way from its first step on, which takes some of the right angle.
    corner = torch.stack([at(pattern.heading, pattern.corner + step) for step in range(6)])
    left = wrap_angle(corner - corner[0]).amax(0)
    assert left.min() > math.radians(75)
    assert left.max() < math.radians(95)


def test_it_orbits_clockwise_on_the_circle(pattern):
    orbit = pattern.between(pattern.entry, pattern.leaving)
    assert ((pattern.distance - pattern.radius).abs()[orbit] < 0.05).all()
    assert (pattern.turned[orbit[:, :-1]] < 0).all()
    swept = torch.where(orbit[:, :-1], pattern.turned, 0.0).sum(1)
    assert (swept < -math.radians(130)).all()
    assert (swept > -math.radians(200)).all()


def test_it_leaves_between_the_human_and_the_goal(data, pattern):
    assert (pattern.leaving > pattern.corner + 10).all()
    assert (at(pattern.phase, pattern.leaving).abs() <= 0.1).all()
    # Left again, then straight on: the goal stays ahead and the human behind.
    after = torch.stack([at(pattern.heading, pattern.leaving + step) for step in range(6)])
    assert (wrap_angle(after - after[0]).amax(0) > math.radians(70)).all()
    straight = pattern.mask & (pattern.steps > pattern.leaving[:, None] + 6)
    assert data["goal"][..., 1][straight].abs().max() < 0.02
    assert (data["human"][..., 1][straight].abs() > math.radians(150)).all()


def test_it_is_slow_in_corners_and_fast_elsewhere(data, pattern):
    speed = data["action"][..., 0]
    straight = pattern.between(5, pattern.corner)
    assert (speed[straight] > 0.499).all()
    assert (at(speed, pattern.corner) < 0.05).all()
    assert (at(speed, pattern.leaving) < 0.05).all()


def test_actions_respect_the_robot(data):
    speed, turn = data["action"].unbind(-1)
    assert speed.min() >= 0
    assert speed.max() <= TURTLEBOT2.max_speed
    assert turn.abs().max() <= TURTLEBOT2.max_turn_rate


def test_a_radius_for_each_robot():
    radius = torch.tensor([0.7, 1.0, 1.5], dtype=torch.float64).repeat_interleave(20)
    data = roll_out(make_env(num_envs=60, snapshots=False), CircleDemonstrator(radius))
    assert succeeded(data).all()
    pattern = Pattern(data, radius)
    orbit = pattern.between(pattern.entry, pattern.leaving)
    assert ((pattern.distance - pattern.radius).abs()[orbit] < 0.05).all()
    for value in (0.7, 1.5):
        rows = radius == value
        alone = CircleDemonstrator(value)(data[rows].select("goal", "human"))
        assert torch.equal(alone["action"], data["action"][rows])


def flip(start: TensorDictBase) -> TensorDictBase:
    """The same scenes mirrored at the x axis."""
    start = start.clone()
    start["qpos"][:, 1:] *= -1
    start["human_pose"][:, 1:] *= -1
    start["scene", "goal"][:, 1] *= -1
    start["scene", "human_goal"][:, 1] *= -1
    return start


@pytest.mark.parametrize("make", [CircleDemonstrator, DetourDriver])
def test_the_right_side_is_the_mirror_image(make):
    env = make_env(num_envs=40)
    start = env.reset()
    left = roll_out(env, make(), start.clone())
    mirrored = env.reset(flip(start), set_state=True)
    right = roll_out(env, make(side="right"), mirrored)
    assert torch.equal(left["mask"], right["mask"])
    image = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    # Exact but for the rounding of the simulation, over a hundred steps.
    rows = left["mask"]
    torch.testing.assert_close(right["pose"][rows], left["pose"][rows] * image, rtol=0, atol=1e-8)
    torch.testing.assert_close(
        right["action"][rows], left["action"][rows] * image[:2], rtol=0, atol=1e-6
    )
    # On the same observation, mirrored, there is no difference at all.
    seen = left.select("goal", "human")
    seen = seen.apply(lambda polar: polar * image[:2])
    action = make(side="right")(seen)["action"]
    assert torch.equal(action, left["action"] * image[:2])


@pytest.mark.parametrize("make", [CircleDemonstrator, DetourDriver, StraightDriver])
def test_scaled_actions_give_the_same_motion(make):
    env = make_env(num_envs=20)
    start = env.reset()
    raw = roll_out(env, make(), start.clone())
    env = TransformedEnv(make_env(num_envs=20), ActionScaling())
    scaled = roll_out(env, make(scaled=True), env.reset(start.clone(), set_state=True))
    assert torch.equal(raw["mask"], scaled["mask"])
    assert scaled["action"].abs().max() <= 1
    rows = raw["mask"]
    torch.testing.assert_close(scaled["pose"][rows], raw["pose"][rows], rtol=0, atol=1e-5)


def test_scaled_actions_for_another_robot_use_its_limits():
    seen = TensorDict(goal=torch.tensor([[3.0, 0.0]]), batch_size=[1])
    for speed in (0.5, 0.25):
        action = StraightDriver(speed, HSR, scaled=True)(seen)["action"]
        assert action.tolist() == [[2 * speed / HSR.max_speed - 1, 0.0]]


@pytest.mark.parametrize("speed", [0.2, 0.35])
def test_speed(speed):
    env = make_env(num_envs=20, snapshots=False, max_episode_steps=500)
    data = env.rollout(
        500,
        CircleDemonstrator(speed=speed),
        break_when_any_done=False,
        break_when_all_done=True,
    )
    data.set("mask", episode_mask(data["next", "done"]))
    assert succeeded(data).all()
    assert data["action"][..., 0].max() == pytest.approx(speed)
    moved = (data["next", "pose"] - data["pose"])[..., :2].norm(dim=-1)[data["mask"]]
    assert moved.max().item() == pytest.approx(0.2 * speed, rel=1e-3)
    # The slower, the more steps from 0.1 m outside onto the circle.
    pattern = Pattern(data, 1.0, settled=10)
    orbit = pattern.between(pattern.entry, pattern.leaving)
    assert ((pattern.distance - 1.0).abs()[orbit] < 0.05).all()


@pytest.mark.parametrize("make", [CircleDemonstrator, DetourDriver, StraightDriver])
def test_nested_keys_and_any_batch_shape(make):
    seen = TensorDict(goal=torch.rand(3, 4, 2) + 2, human=torch.rand(3, 4, 2) + 0.5)
    seen.batch_size = [3, 4]
    expected = make()(seen.clone())["action"]
    keys = {"goal_key": ("sensors", "goal"), "action_key": ("agent", "act")}
    if make is not StraightDriver:
        keys["human_key"] = ("sensors", "person")
    policy = make(**keys)
    nested = TensorDict(
        {"sensors": {"goal": seen["goal"], "person": seen["human"]}}, batch_size=[3, 4]
    )
    assert set(policy.in_keys) == {key for name, key in keys.items() if name != "action_key"}
    assert policy.out_keys == [("agent", "act")]
    assert torch.equal(policy(nested)["agent", "act"], expected)
    assert expected.shape == (3, 4, 2)


@pytest.mark.parametrize("make", [CircleDemonstrator, DetourDriver])
@pytest.mark.parametrize("radius", [0.0, -1.0, math.nan, torch.tensor([1.0, 0.0])])
def test_radius_must_be_positive(make, radius):
    with pytest.raises(ValueError, match="radius must be positive"):
        make(radius)


@pytest.mark.parametrize("make", [CircleDemonstrator, DetourDriver])
def test_side_must_be_known(make):
    with pytest.raises(ValueError, match="'left' or 'right', got 'up'"):
        make(side="up")


@pytest.mark.parametrize("make", [CircleDemonstrator, DetourDriver, StraightDriver])
@pytest.mark.parametrize("speed", [0.0, -0.1, 0.6, math.nan])
def test_speed_must_be_within_the_robots(make, speed):
    with pytest.raises(ValueError, match=r"speed must be in \(0, 0\.5\] m/s"):
        make(speed=speed)


# --- detour ------------------------------------------------------------------------------------


def shortest_way(start: TensorDictBase, radius: torch.Tensor) -> torch.Tensor:
    """Length from start to goal, on the left of the circle: tangent, arc and tangent."""
    human, goal = start["human_pose"][:, :2], start["scene", "goal"]
    before, behind = start["qpos"][:, :2] - human, goal - human
    angles = (torch.atan2(way[:, 1], way[:, 0]) for way in (before, behind))
    clockwise = torch.sub(*angles) % (2 * math.pi)
    length = torch.zeros_like(radius)
    for distance in (before.norm(dim=-1), behind.norm(dim=-1)):
        length += (distance**2 - radius**2).sqrt()
        clockwise -= torch.acos(radius / distance)
    return length + radius * clockwise


@pytest.fixture(scope="module")
def detour() -> tuple[TensorDictBase, TensorDictBase, torch.Tensor]:
    """Start, rollout and radius of 160 detours: with each radius in 40 scenes."""
    radius = torch.tensor([0.5, 0.8, 1.0, 1.4], dtype=torch.float64).repeat(40)
    env = make_env(num_envs=160)
    start = env.reset()
    return start, roll_out(env, DetourDriver(radius), start.clone()), radius


def test_a_detour_is_the_shortest_way_around_the_circle(detour):
    start, data, radius = detour
    assert succeeded(data).all()
    moved = (data["next", "pose"] - data["pose"])[..., :2].norm(dim=-1)
    length = torch.where(data["mask"], moved, 0.0).sum(1)
    # Longer by the turn at the start, up to 30 degrees and more; it ends up to a step inside the goal.
    more = length - (shortest_way(start, radius) - 0.3)
    assert more.min() > 0
    assert more.max() < 0.13


def test_a_detour_touches_its_circle_on_its_side(detour):
    _, data, radius = detour
    distance, bearing = data["human"].unbind(-1)
    distance = torch.where(data["mask"], distance, torch.inf)
    nearest, step = distance.min(1)
    # Outside of it, by a centimetre: the arc of the smallest radius takes one step only.
    assert (nearest > radius - 1e-3).all()
    assert (nearest < radius + 0.015).all()
    # The human is on its right all along.
    passed = at(bearing, step)
    assert ((passed + math.pi / 2).abs() < 0.15).all()


def test_a_radius_for_each_detour(detour):
    _, data, radius = detour
    for value in (0.5, 1.4):
        rows = radius == value
        alone = DetourDriver(value)(data[rows].select("goal", "human"))
        torch.testing.assert_close(alone["action"], data["action"][rows], rtol=0, atol=1e-9)


@pytest.mark.parametrize(("side", "sign"), [("left", -1.0), ("right", 1.0)])
def test_a_detour_is_straight_where_the_way_is_clear(side, sign):
    env = make_env(num_envs=20)
    start = env.reset()
    for beside, straight in ((1.05, True), (0.95, False)):
        start["human_pose"][:, 1] = sign * beside  # the goal lies on the x axis
        data = roll_out(env, DetourDriver(side=side), env.reset(start.clone(), set_state=True))
        expected = StraightDriver()(data.select("goal"))["action"]
        assert torch.equal(data["action"][:, 0], expected[:, 0]) == straight
        # On the wrong side of it there is no straight way, however far the human.
        start["human_pose"][:, 1] = -sign * beside
        data = roll_out(env, DetourDriver(side=side), env.reset(start.clone(), set_state=True))
        nearest = torch.where(data["mask"], data["human"][..., 0], torch.inf).amin(1)
        assert nearest.sub(1.0).abs().max() < 0.01
        assert succeeded(data).all()


def test_a_detour_leads_away_from_inside_the_circle():
    seen = TensorDict(
        goal=torch.tensor([[4.0, 0.0], [4.0, -0.5]]),
        human=torch.tensor([[0.8, 0.0], [0.8, -math.pi / 2]]),
        batch_size=[2],
    )
    _, turn = DetourDriver()(seen)["action"].unbind(-1)
    # At a right angle to the human and 2 rad per metre more, times four fifths of 5 Hz.
    assert turn.tolist() == pytest.approx([math.pi, 4 * 0.4])
    _, turn = DetourDriver(side="right")(seen)["action"].unbind(-1)
    assert turn[0].item() == pytest.approx(-math.pi)


# --- straight driver ---------------------------------------------------------------------------


def test_the_straight_driver_takes_the_shortest_way():
    env = make_env(num_envs=20)
    start = env.reset()
    start["human_pose"][:, 1] = 9.0  # out of its way
    data = roll_out(env, StraightDriver(), env.reset(start, set_state=True))
    assert succeeded(data).all()
    moved = (data["next", "pose"] - data["pose"])[..., :2].norm(dim=-1)
    length = torch.where(data["mask"], moved, 0.0).sum(1)
    direct = data["goal"][:, 0, 0] - env.goal_radius
    # A step may end up to 0.1 m inside the goal; the start may face 30 degrees off.
    assert (length - direct > -1e-3).all()
    assert (length - direct < 0.12).all()
    settled = data["mask"].clone()
    settled[:, :5] = False
    assert data["goal"][..., 1][settled].abs().max() < 0.01
    assert (data["action"][..., 0][settled] > 0.499).all()


def test_the_straight_driver_runs_over_whoever_stands_there():
    env = make_env(num_envs=20)
    start = env.reset()
    start["human_pose"][:, 1] = 0.0  # on the line to the goal
    data = roll_out(env, StraightDriver(), env.reset(start, set_state=True))
    hit = (data["next", "collision_human"].squeeze(-1) & data["mask"]).any(-1)
    assert hit.all()


def test_the_straight_driver_turns_before_it_drives():
    seen = TensorDict(goal=torch.tensor([[4.0, math.pi], [4.0, -2.0], [4.0, 0.1]]), batch_size=[3])
    speed, turn = StraightDriver()(seen)["action"].unbind(-1)
    assert speed.tolist() == pytest.approx([0.0, 0.0, 0.5 * math.cos(0.1) ** 2])
    assert turn.tolist() == pytest.approx([math.pi, -math.pi, 0.4])


# --- what it drives in given scenes ------------------------------------------------------------


@pytest.fixture(scope="module")
def static() -> tuple[TensorDictBase, TensorDict]:
    """The demonstrator in 100 scenes with boxes, and its paths as if there were none."""
    env = make_env(scene="static", num_envs=100, seed=4)
    start = env.reset()
    paths = demonstrated_paths(CircleDemonstrator(), start, scene="static", dtype=torch.float64)
    return roll_out(env, CircleDemonstrator(), start.clone()), paths


def test_free_paths_are_those_that_the_demonstrator_drives(static):
    real, paths = static
    hit = (real["next", "collision_obstacle"].squeeze(-1) & real["mask"]).any(-1)
    assert 10 < hit.sum() < 90
    assert torch.equal(paths["free"], ~hit)
    assert succeeded(real)[paths["free"]].all()
    for row in range(100):
        steps = int(real["mask"][row].sum())
        driven = torch.cat((real["pose"][row, :1], real["next", "pose"][row, :steps]))[:, :2]
        path = paths["position"][row][paths["mask"][row]]
        # Up to the box that stops it, if there is one in the way.
        same = steps + int(paths["free"][row])
        assert torch.equal(path[:same], driven[:same])
        assert (len(path) == steps + 1) == bool(paths["free"][row])


def test_boxes_do_not_influence_the_path(static):
    real, paths = static
    start = real[:, 0].clone()
    middle = paths["position"][torch.arange(100), paths["mask"].sum(-1) // 2]
    start["scene", "boxes"][:, 0, :2] = middle
    before = start.clone()
    blocked = demonstrated_paths(CircleDemonstrator(), start, scene="static", dtype=torch.float64)
    assert torch.equal(blocked["position"], paths["position"])
    assert torch.equal(blocked["mask"], paths["mask"])
    assert not blocked["free"].any()
    assert (start == before).all()
    start["scene", "boxes"][..., 1] += 50.0
    cleared = demonstrated_paths(CircleDemonstrator(), start, scene="static", dtype=torch.float64)
    assert cleared["free"].all()
