"""Recorded trajectories become demonstrations: recovered exactly, or refused with the reason."""

from __future__ import annotations

import csv
import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase

from envs import HSR, HUMAN_RADIUS, TURTLEBOT2
from envs.demonstrations import CircleDemonstrator
from envs.demonstrations.feasibility import Tolerances, check, heading_from_motion, velocities
from envs.demonstrations.importer import import_demonstrations, replay
from envs.demonstrations.recordings import BOX_COLUMNS, COLUMNS, Recording
from envs.policy_env import make_policy_env
from recipes.drex.rollouts import rollouts
from torchrl_morl.data import load_demonstrations
from torchrl_morl.evaluation import episode_mask
from torchrl_morl.geometry import wrap_angle

ROOT = Path(__file__).resolve().parents[3]
HEADER = ("trajectory", "time", "x", "y", "heading", *COLUMNS[3:])


def write_csv(path: Path, header: tuple[str, ...], rows: list) -> Path:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])
    return path


def tracks(data: TensorDictBase) -> list[dict[str, np.ndarray]]:
    """What somebody would have recorded of the episodes ``[N, T]`` of a rollout."""
    out = []
    for row in data:
        steps = int(row["mask"].sum())
        pose = torch.cat((row["pose"][:1], row["next", "pose"][:steps])).numpy()
        human = torch.cat((row["human_pose"][:1], row["next", "human_pose"][:steps])).numpy()
        goal = row["scene", "goal"][0].expand(steps + 1, 2).numpy()
        out.append(
            {
                "time": 7.0 + 0.2 * np.arange(steps + 1),
                **dict(zip(("x", "y", "heading"), pose.T)),
                **dict(zip(("human_x", "human_y"), human.T[:2])),
                **dict(zip(("goal_x", "goal_y"), goal.T)),
                "boxes": row["scene", "boxes"][0].numpy(),
            }
        )
    return out


def save_csv(folder: Path, recorded: list[dict[str, np.ndarray]], columns=HEADER[1:]):
    rows, boxes = [], []
    for index, track in enumerate(recorded):
        name = f"drive {index}"
        rows += [[name, *point] for point in zip(*(track[column].tolist() for column in columns))]
        boxes += [[name, *box] for box in track["boxes"].tolist()]
    return (
        write_csv(folder / "drives.csv", ("trajectory", *columns), rows),
        write_csv(folder / "boxes.csv", ("trajectory", *BOX_COLUMNS), boxes),
    )


def save_npz(folder: Path, recorded: list[dict[str, np.ndarray]], **extra) -> Path:
    longest = max(len(track["time"]) for track in recorded)
    arrays = {
        column: np.stack(
            [
                np.pad(track[column], (0, longest - len(track["time"])), constant_values=np.nan)
                for track in recorded
            ]
        )
        for column in HEADER[1:]
    }
    boxes = np.stack([track["boxes"] for track in recorded])
    path = folder / "drives.npz"
    np.savez(path, **({**arrays, "boxes": boxes} | extra))
    return path


@pytest.fixture(scope="module")
def original() -> TensorDictBase:
    """Successful drives past the human on the right, among boxes, in rollouts of the policy's env."""
    env = make_policy_env(keep_simulation=True, num_envs=24, seed=5, num_threads=1)
    policy = CircleDemonstrator(side="right", scaled=True)
    data = env.rollout(300, policy, break_when_any_done=False, break_when_all_done=True)
    env.close()
    data.set("mask", episode_mask(data["next", "done"]))
    data = data[(data["next", "success"].squeeze(-1) & data["mask"]).any(-1)]
    assert len(data) >= 6
    return data[:6, : int(data["mask"][:6].sum(-1).max())]


@pytest.fixture(scope="module")
def recorded(original) -> list[dict[str, np.ndarray]]:
    return tracks(original)


def assert_same(data: TensorDictBase, original: TensorDictBase) -> None:
    """Observations are exact up to rounding, also of a file's decimals.

    The recovered action is the mean velocity of a step, which is less than a command that changed
    by what the servos need to follow it.
    """
    mask = original["mask"]
    assert torch.equal(data["mask"], mask)
    for key in ("observation", "goal", "human", "pose", ("next", "observation"), ("next", "pose")):
        torch.testing.assert_close(data[key][mask], original[key][mask], rtol=0, atol=1e-5)
    for key in ("reward", "done", "terminated", "truncated", "success"):
        torch.testing.assert_close(
            data["next", key][mask], original["next", key][mask], rtol=0, atol=1e-3
        )
    error = (data["action"] - original["action"])[mask].abs()
    # Of the full scale: 0.25 m/s and pi rad/s. Steady driving is recovered exactly.
    assert (error.amax(0) < torch.tensor([0.25, 0.12])).all()
    assert (error.mean(0) < torch.tensor([0.02, 0.01])).all()
    assert (error.median(0).values < 2e-3).all()


# --- what comes out ----------------------------------------------------------------------------


def test_a_csv_file_gives_the_drives_back(tmp_path, original, recorded):
    data, report = import_demonstrations(*save_csv(tmp_path, recorded), num_threads=1)
    assert report.accepted == [f"drive {index}" for index in range(len(original))]
    assert not report.rejected
    assert str(report) == "6 of 6 trajectories accepted"
    assert_same(data, original)


def test_an_npz_file_gives_the_same_drives(tmp_path, original, recorded):
    data, report = import_demonstrations(save_npz(tmp_path, recorded), num_threads=1)
    assert report.accepted == [str(index) for index in range(len(original))]
    assert_same(data, original)


def test_the_dataset_is_that_of_the_recipe(tmp_path, recorded):
    data, _ = import_demonstrations(*save_csv(tmp_path, recorded[:1]), num_threads=1)
    policy = CircleDemonstrator(scaled=True)
    ours = rollouts(policy, 2, 0, max_steps=3, scene="empty", num_threads=1)
    keys = set(ours.keys(include_nested=True, leaves_only=True))
    assert set(data.keys(include_nested=True, leaves_only=True)) == keys
    for key in keys:
        assert data[key].dtype == ours[key].dtype, key
        assert data[key].shape[2:] == ours[key].shape[2:], key
    torch.cat((data[:, :3], ours))


def test_boxes_are_seen(tmp_path, original, recorded):
    with_boxes, _ = import_demonstrations(*save_csv(tmp_path, recorded), num_threads=1)
    without, _ = import_demonstrations(tmp_path / "drives.csv", num_threads=1)
    lidar = slice(0, 30)
    nearer = without["observation"][..., lidar] - with_boxes["observation"][..., lidar]
    assert nearer.min() >= -1e-6
    assert (nearer[original["mask"]].amax(-1) > 0.05).any()
    assert torch.equal(without["observation"][..., 30:], with_boxes["observation"][..., 30:])


def test_trajectories_may_have_different_numbers_of_boxes(tmp_path, original, recorded):
    # The third box of the first drive and all boxes of the second are left out.
    boxes = np.stack([track["boxes"] for track in recorded])
    boxes[0, 2] = boxes[1] = np.nan
    data, _ = import_demonstrations(save_npz(tmp_path, recorded, boxes=boxes), num_threads=1)
    rest, mask = data[2:], original["mask"][2:]
    torch.testing.assert_close(
        rest["observation"][mask], original["observation"][2:][mask], rtol=0, atol=1e-5
    )
    plain, _ = import_demonstrations(save_csv(tmp_path, recorded)[0], num_threads=1)
    assert torch.equal(data["observation"][1], plain["observation"][1])


def test_padding_is_zero(tmp_path, recorded):
    data, _ = import_demonstrations(*save_csv(tmp_path, recorded), num_threads=1)
    assert not data["mask"].all()
    padding = data[~data["mask"]]
    assert all((leaf == 0).all() for leaf in padding.values(True, True))


# --- time ----------------------------------------------------------------------------------------


def upsample(track: dict[str, np.ndarray], time: np.ndarray) -> dict[str, np.ndarray]:
    smooth = {key: np.unwrap(track[key]) if key == "heading" else track[key] for key in HEADER[1:]}
    out = {key: np.interp(time, track["time"], values) for key, values in smooth.items()}
    out["heading"] = np.angle(np.exp(1j * out["heading"]))
    return {**out, "time": time, "boxes": track["boxes"]}


def test_ten_hertz_is_resampled(tmp_path, original, recorded):
    faster = [
        upsample(
            track, np.linspace(track["time"][0], track["time"][-1], 2 * len(track["time"]) - 1)
        )
        for track in recorded
    ]
    data, _ = import_demonstrations(*save_csv(tmp_path, faster), num_threads=1)
    assert_same(data, original)


def test_the_end_is_kept_and_a_rest_dropped_at_the_start(tmp_path, original, recorded):
    # Half a period before the first point: the grid still ends where the recording does.
    cut = [upsample(track, track["time"][0] + np.arange(0.1, 60, 0.1)) for track in recorded]
    for late, track in zip(cut, recorded):
        keep = late["time"] <= track["time"][-1] + 1e-9
        late.update({key: late[key][keep] for key in HEADER[1:]})
    data, report = import_demonstrations(*save_csv(tmp_path, cut), num_threads=1)
    assert not report.rejected
    assert data["mask"].sum() == original["mask"].sum() - len(original)
    for row, before in zip(data, original):
        steps = int(row["mask"].sum())
        expected = before["pose"][1 : steps + 1]
        torch.testing.assert_close(row["pose"][:steps], expected, rtol=0, atol=1e-5)


def line(speed: float = 0.4, time: np.ndarray | None = None, **changes) -> Recording:
    """A drive along x to a goal at (4, 0) past a human at (2, 1.5)."""
    time = np.arange(0.0, 12.0, 0.2) if time is None else time
    ones = np.ones_like(time)
    values = {
        "name": "line",
        "time": time,
        "position": np.stack((speed * time, 0 * time), axis=-1),
        "heading": 0 * time,
        "human": np.stack((2 * ones, 1.5 * ones), axis=-1),
        "goal": np.stack((4 * ones, 0 * ones), axis=-1),
        "boxes": np.zeros((0, 5)),
        "places": tuple(f"point {index}" for index in range(len(time))),
    }
    return Recording(**(values | changes))


def test_irregular_times_keep_the_velocity():
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.01, 0.3, 100))
    path, reasons = check(line(0.4, time))
    assert reasons == []
    speed, turn, slip = velocities(path.pose[:-1], path.pose[1:])
    assert torch.allclose(speed, torch.full_like(speed, 0.4))
    assert torch.allclose(turn, torch.zeros_like(turn))
    assert torch.allclose(slip, torch.zeros_like(slip), atol=1e-12)
    assert torch.allclose(path.time.diff(), torch.full_like(speed, 0.2))


def test_headings_take_the_shortest_way():
    # Turning in place through pi, a tenth of a radian at 3.3 Hz, written within (-pi, pi].
    time = np.arange(0.0, 10.0, 0.3)
    turning = math.pi - 0.5 + np.minimum(0.3 * time, 1.0)
    wrapped = np.angle(np.exp(1j * turning))
    assert wrapped.min() < -2 < 2 < wrapped.max()
    recording = line(0.0, time, heading=wrapped)
    recording.position[:, 0] = np.linspace(0, -4, len(time))
    recording.goal[:, 0] = -4
    path, _ = check(recording, tolerances=Tolerances(slip=1.0))
    expected = np.interp(path.time.numpy(), time, turning)
    error = wrap_angle(path.pose[:, 2] - torch.from_numpy(expected))
    assert error.abs().max() < 1e-9


def test_an_episode_ends_at_the_goal():
    time = np.arange(0.0, 30.0, 0.2)
    path, _ = check(line(0.4, time), goal_radius=0.3)
    distance = (path.pose[:, :2] - path.goal).norm(dim=-1)
    assert distance[-1] <= 0.3 < distance[-2]


# --- replay --------------------------------------------------------------------------------------


def test_a_walking_human_is_seen_where_it_is():
    time = np.arange(0.0, 12.0, 0.2)
    human = np.stack((6 - 0.5 * time, 1.5 + 0 * time), axis=-1)
    path, _ = check(line(0.4, time, human=human))
    data = replay([path], num_threads=1)[0]
    way = torch.from_numpy(human - np.stack((0.4 * time, 0 * time), axis=-1))[: len(data)]
    torch.testing.assert_close(data["human"][:, 0], way.norm(dim=-1).float())
    torch.testing.assert_close(data["human"][:, 1], torch.atan2(way[:, 1], way[:, 0]).float())
    after = torch.cat((way[1:], way[-1:])).norm(dim=-1)[:-1]
    penalty = -10 * ((2 - after).clamp_min(0) / 1.7) ** 2
    assert penalty.min() < -0.5
    torch.testing.assert_close(data["next", "reward"][:-1, 1], penalty.float())
    torch.testing.assert_close(data["next", "reward"][:, 0], torch.full((len(data),), 10.0))
    torch.testing.assert_close(
        data["action"], torch.tensor([0.6, 0.0]).expand(len(data), 2), rtol=0, atol=1e-5
    )


def test_the_size_of_a_chunk_does_not_matter():
    paths = [check(line(speed))[0] for speed in (0.4, 0.5)]
    whole = replay(paths, num_threads=1)
    for chunk in (1, 7):
        assert (replay(paths, chunk=chunk, num_threads=1) == whole).all()


def test_another_robot_sees_with_its_own_lidar():
    boxes = np.array([[-1.0, 0.0, 0.0, 0.2, 0.6]])  # behind the start
    path, _ = check(line(boxes=boxes), HSR)
    behind = slice(14, 16)  # the two sectors about 180 degrees
    seen, missed = (replay([path], robot, num_threads=1)[0, 0] for robot in (TURTLEBOT2, HSR))
    assert (seen["observation"][behind] < -0.5).all()
    assert (missed["observation"][behind] == 0).all()


# --- velocities ----------------------------------------------------------------------------------


@pytest.mark.parametrize("turn", [-3.0, -0.5, 0.0, 1e-9, 0.7, math.pi])
def test_arcs_are_inverted_exactly(turn):
    start = torch.tensor([[1.0, -2.0, 3.0], [0.0, 0.0, -0.4]], dtype=torch.float64)
    speed, angle = 0.45, 0.2 * turn
    # Closed form of constant speeds: forward and left in the frame of the start.
    forward = speed * 0.2 if abs(turn) < 1e-6 else speed / turn * math.sin(angle)
    left = 0.0 if abs(turn) < 1e-6 else speed / turn * (1 - math.cos(angle))
    cos, sin = start[:, 2].cos(), start[:, 2].sin()
    end = torch.stack(
        (
            start[:, 0] + forward * cos - left * sin,
            start[:, 1] + forward * sin + left * cos,
            wrap_angle(start[:, 2] + angle),
        ),
        dim=-1,
    )
    for value, expected in zip(velocities(start, end), (speed, turn, 0.0)):
        torch.testing.assert_close(value, torch.full_like(value, expected), rtol=0, atol=1e-8)


def test_slip_is_signed_and_apart_from_the_speed():
    sideways = torch.tensor([0.0, 0.02, 0.0], dtype=torch.float64)
    speed, turn, slip = velocities(torch.zeros(3, dtype=torch.float64), sideways)
    assert (speed.item(), turn.item(), slip.item()) == pytest.approx((0.0, 0.0, 0.1))


# --- headings from motion ------------------------------------------------------------------------


def test_headings_of_a_file_without_them(tmp_path, original, recorded):
    columns = [column for column in HEADER[1:] if column != "heading"]
    files = save_csv(tmp_path, recorded, columns)
    data, report = import_demonstrations(*files, num_threads=1)
    assert not report.rejected
    # Right on lines and arcs; the demonstrator turns almost in place in its three corners, where
    # positions say little.
    error = wrap_angle(data["pose"] - original["pose"])[..., 2][original["mask"]].abs()
    assert error.median() < 0.01
    assert error.quantile(0.85) < 0.06
    mask = original["mask"]
    position = data["pose"][mask][:, :2]
    torch.testing.assert_close(position, original["pose"][mask][:, :2], rtol=0, atol=1e-9)


def test_derived_headings_on_an_arc_are_exact_also_across_pi():
    angle = torch.linspace(-0.3, 4.0, 60, dtype=torch.float64)
    circle = torch.stack((angle.sin(), -angle.cos()), dim=-1)
    error = wrap_angle(heading_from_motion(circle) - angle)
    assert error.abs().max() < 1e-9


def test_a_robot_that_stands_keeps_its_derived_heading():
    x = torch.tensor([0.0, 0.0, 0.1, 0.2, 0.2, 0.2, 0.3])
    position = torch.stack((x, -x), dim=-1)
    assert torch.allclose(heading_from_motion(position), torch.full((7,), -math.pi / 4))
    assert heading_from_motion(torch.zeros(5, 2)) is None


def test_an_empty_heading_column_is_no_heading(tmp_path, recorded):
    recorded = [{**track, "heading": np.full_like(track["time"], np.nan)} for track in recorded]
    recorded[0]["heading"] = np.zeros_like(recorded[0]["time"])
    path = save_npz(tmp_path, recorded)
    data, report = import_demonstrations(path, num_threads=1)
    # The first drive claims to head along x all the way, which its motion contradicts.
    assert list(report.rejected) == ["0"]
    assert len(data) == len(recorded) - 1


# --- rejections ----------------------------------------------------------------------------------


def bump(recording: Recording, field: str, index: int, value: float, column=()) -> Recording:
    getattr(recording, field)[(index, *column)] = value
    return recording


def corner() -> Recording:
    """A drive without slip that turns by 1.2 rad in one step."""
    heading = np.where(np.arange(60) < 30, 0.0, 1.2)
    middle = (heading[1:] + heading[:-1]) / 2
    way = 0.08 * np.stack((np.cos(middle), np.sin(middle)), axis=-1).cumsum(0)
    position = np.concatenate((np.zeros((1, 2)), way))
    return line(position=position, heading=heading, goal=np.tile(position[-1], (60, 1)))


REASONS = {
    "too fast": (line(0.6), "drives at 0.60 m/s at .* s, over 0.50 + 0.05 m/s in .* step"),
    "backwards": (
        line(heading=np.full(60, math.pi)),
        "drives backwards at 0.40 m/s at .* s, over 0.00 + 0.05 m/s in .* step",
    ),
    "turns too fast": (
        corner(),
        "turns at 6.00 rad/s at 5.80 s, over 3.14 + 0.20 rad/s in 1 step",
    ),
    "slips": (
        line(heading=np.full(60, 0.6)),
        "slips sideways at 0.23 m/s at .* s, over 0.00 + 0.1",
    ),
    "gap": (
        line(time=np.delete(np.arange(0, 12, 0.2), [20, 21, 22])),
        "time jumps by 0.80 s at point 20, over 0.5 s",
    ),
    "time goes back": (
        bump(line(), "time", 7, 1.15),
        "time does not increase at point 7",
    ),
    "time stands": (bump(line(), "time", 7, 1.2), "time does not increase at point 7"),
    "not finite": (
        bump(line(), "position", 3, math.inf, (1,)),
        "column y is not finite at point 3",
    ),
    "no heading at one point": (
        bump(line(), "heading", 9, math.nan),
        "column heading is not finite at point 9",
    ),
    "one point": (line(time=np.zeros(1)), "has 1 point(s), fewer than 2"),
    "no point": (line(time=np.zeros(0)), "has 0 point(s), fewer than 2"),
    "too short": (line(time=np.array([0.0, 0.1])), "is shorter than a control step of 0.2 s"),
    "never there": (
        line(time=np.arange(0, 8, 0.2)),
        "never comes within 0.3 m of the goal, 0.88 m at best",
    ),
    "there already": (
        line(goal=np.tile([0.1, 0.0], (60, 1))),
        "starts within 0.3 m of the goal",
    ),
    "wandering goal": (
        bump(line(), "goal", 5, 0.5, (1,)),
        "the goal moves by 0.50 m: a trajectory has one goal",
    ),
    "human": (line(human=np.tile([2.0, 0.42], (60, 1))), "touches the human at 5.00 s"),
    "box": (line(boxes=np.array([[2.0, 0.5, 0.0, 0.3, 0.33]])), "touches a box at 4.20 s"),
    "too long": (
        line(0.05, np.arange(0, 80, 0.2)),
        "takes 370 control steps, an episode has 300",
    ),
    "stands without heading": (
        line(0.0, heading=None),
        "has no heading and never moves, so that none can be derived",
    ),
}


@pytest.mark.parametrize("name", REASONS)
def test_a_rejection_says_why(name):
    recording, expected = REASONS[name]
    path, reasons = check(recording)
    assert path is None
    pattern = re.escape(expected).replace(r"\.\*", ".*")
    assert len(reasons) == 1
    assert re.match(pattern, reasons[0]), reasons


def test_the_drive_that_all_of_them_spoil_is_accepted():
    path, reasons = check(line())
    assert reasons == []
    assert path.pose.shape == (48, 3)


def test_all_reasons_are_given():
    human = np.tile([2.0, 0.0], (60, 1))
    _, reasons = check(line(0.7, human=human, goal=np.tile([4.0, 3.0], (60, 1))))
    assert [reason.split()[0] for reason in reasons] == ["never", "drives", "touches"]


def test_contact_is_that_of_the_environment():
    touching = TURTLEBOT2.radius + HUMAN_RADIUS
    for gap, accepted in ((-1e-6, False), (1e-6, True)):
        human = np.tile([2.0, touching + gap], (60, 1))
        assert (check(line(human=human))[0] is not None) is accepted


def test_what_comes_after_the_goal_does_not_count():
    recording = line()
    recording.position[55:, 1] = 3.0  # a jump after the goal was reached at step 47
    assert check(recording)[1] == []


@pytest.mark.parametrize(
    ("name", "tolerances"),
    [
        ("too fast", {"speed": 0.11}),
        ("backwards", {"backwards": 0.41}),
        ("turns too fast", {"turn_rate": 2.9}),
        ("slips", {"slip": 0.24}),
        ("gap", {"gap": 0.81}),
    ],
)
def test_each_tolerance_counts(name, tolerances):
    recording, _ = REASONS[name]
    assert check(recording)[0] is None
    assert check(recording, tolerances=Tolerances(**tolerances))[1] == []


def test_tolerances_are_checked():
    for wrong in ({"slip": -0.1}, {"gap": 0.0}, {"speed": math.nan}):
        with pytest.raises(ValueError, match="Tolerances must not be negative"):
            Tolerances(**wrong)


def test_rejected_drives_are_left_out_and_listed(tmp_path, original, recorded):
    worse = [dict(track) for track in recorded]
    worse[1]["x"] = worse[1]["x"] * 2
    worse[4]["goal_x"] = worse[4]["goal_x"] + 3
    data, report = import_demonstrations(*save_csv(tmp_path, worse), num_threads=1)
    assert report.accepted == ["drive 0", "drive 2", "drive 3", "drive 5"]
    assert list(report.rejected) == ["drive 1", "drive 4"]
    lines = str(report).splitlines()
    assert lines[0] == "4 of 6 trajectories accepted"
    assert re.match(r"  drive 1: .*drives at", lines[1])
    assert re.match(r"  drive 4: never comes within", lines[2])
    kept = original[[0, 2, 3, 5]]
    assert_same(data, kept[:, : data.shape[1]])


def test_nothing_accepted_is_an_error_that_lists_the_reasons(tmp_path, recorded):
    recorded = [{**track, "goal_x": track["goal_x"] + 9} for track in recorded[:2]]
    files = save_csv(tmp_path, recorded)
    with pytest.raises(
        ValueError, match=r"(?s)drives\.csv: 0 of 2 .*drive 0: never.*drive 1: never"
    ):
        import_demonstrations(*files, num_threads=1)


# --- command line --------------------------------------------------------------------------------


def run(*args: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "recipes.import_demonstrations", *map(str, args)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


def test_from_the_command_line(tmp_path, original, recorded):
    recorded = [*recorded[:2], {**recorded[2], "x": 3 * recorded[2]["x"]}]
    drives, boxes = save_csv(tmp_path, recorded)
    output = tmp_path / "out" / "demos.safetensors"
    done = run(drives, "--boxes", boxes, "--output", output, "--speed-tolerance", 0.06)
    assert done.returncode == 0, done.stderr
    assert "2 of 3 trajectories accepted\n  drive 2: " in done.stdout
    data, metadata = load_demonstrations(output)
    assert_same(data, original[:2, : data.shape[1]])
    assert metadata["accepted"] == ["drive 0", "drive 1"]
    assert list(metadata["rejected"]) == ["drive 2"]
    assert metadata["source"] == "drives.csv"
    assert metadata["tolerances"]["speed"] == 0.06
    written = output.read_bytes()
    again = run(drives, "--output", output)
    assert again.returncode == 2
    assert "demos.safetensors exists and is not overwritten" in again.stderr
    assert output.read_bytes() == written


def test_command_line_errors_are_one_message(tmp_path):
    done = run(tmp_path / "none.csv", "--output", tmp_path / "demos.safetensors")
    assert done.returncode == 2
    assert "none.csv not found" in done.stderr
    assert "Traceback" not in done.stderr
