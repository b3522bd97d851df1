"""Recorded trajectories become demonstrations: recovered exactly, or refused with the reason."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase

from envs import HSR, TURTLEBOT2
from envs.demonstrations import CircleDemonstrator
from envs.demonstrations.feasibility import check
from envs.demonstrations.importer import import_demonstrations, replay
from envs.policy_env import make_policy_env
from recipes.drex.rollouts import rollouts
from tests._recordings import HEADER, line, save_csv, save_npz, tracks
from torchrl_morl.evaluation import episode_mask
from torchrl_morl.geometry import wrap_angle


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
    assert str(report) == "6 of 6 drives accepted"
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


# --- files without headings, drives that are rejected ---------------------------------------------


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


def test_an_empty_heading_column_is_no_heading(tmp_path, recorded):
    recorded = [{**track, "heading": np.full_like(track["time"], np.nan)} for track in recorded]
    recorded[0]["heading"] = np.zeros_like(recorded[0]["time"])
    path = save_npz(tmp_path, recorded)
    data, report = import_demonstrations(path, num_threads=1)
    # The first drive claims to head along x all the way, which its motion contradicts.
    assert list(report.rejected) == ["0"]
    assert len(data) == len(recorded) - 1


def test_rejected_drives_are_left_out_and_listed(tmp_path, original, recorded):
    worse = [dict(track) for track in recorded]
    worse[1]["x"] = worse[1]["x"] * 2
    worse[4]["goal_x"] = worse[4]["goal_x"] + 3
    data, report = import_demonstrations(*save_csv(tmp_path, worse), num_threads=1)
    assert report.accepted == ["drive 0", "drive 2", "drive 3", "drive 5"]
    assert list(report.rejected) == ["drive 1", "drive 4"]
    lines = str(report).splitlines()
    assert lines[0] == "4 of 6 drives accepted"
    assert any(re.match("  1 of 6 drives faster than", line) for line in lines)
    first, second = report.details()
    assert re.match("drive 1: .*drives at", first)
    assert re.match("drive 4: never comes within", second)
    kept = original[[0, 2, 3, 5]]
    assert_same(data, kept[:, : data.shape[1]])


def test_nothing_accepted_is_an_error_that_says_why(tmp_path, recorded):
    recorded = [{**track, "goal_x": track["goal_x"] + 9} for track in recorded[:2]]
    files = save_csv(tmp_path, recorded)
    with pytest.raises(ValueError, match=r"drives\.csv: .*: 2 of 2 drives that never come"):
        import_demonstrations(*files, num_threads=1)
