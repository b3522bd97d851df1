"""Drives in ROS bags: unsynchronised topics, gaps, several drives, chosen topics, refusals."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from envs.demonstrations import BagTopics, import_demonstrations, read_recordings
from envs.demonstrations.reading import open_recordings
from tests._bags import ODOMETRY, POSE, drive, write_bag

pytest.importorskip(
    "rosbags", reason="rosbags is not installed: pip install -c constraints.txt rosbags"
)


def read(path: Path, **options):
    file = open_recordings(path, topics=BagTopics(**options))
    return list(file), file.notes


@pytest.mark.parametrize("mcap", [True, False])
def test_a_drive_comes_out_as_it_went_in(tmp_path, mcap):
    (recording,) = read_recordings(write_bag(tmp_path / "morning", drive(), mcap=mcap))
    assert (recording.name, recording.faults) == ("morning", ())
    # It ends at its goal, with the first point within 0.3 m.
    assert 3.7 - 1e-9 <= recording.position[-1, 0] < 3.7 + 0.4 / 30
    np.testing.assert_allclose(np.diff(recording.time), 1 / 30, atol=1e-6)
    np.testing.assert_allclose(recording.human, [[2.0, 1.5]] * len(recording.time))
    np.testing.assert_allclose(recording.goal, [[4.0, 0.0]] * len(recording.time))
    # It waited for a second, and was told of its goal after 0.2 s.
    moved = recording.position[:, 0] > 1e-9
    assert recording.time[0] == pytest.approx(101.0, abs=0.1)
    np.testing.assert_allclose(
        recording.position[moved, 0], 0.4 * (recording.time[moved] - 101.0), atol=1e-6
    )
    np.testing.assert_allclose(recording.heading, 0.0, atol=1e-12)


def test_the_demonstrations_are_those_of_the_same_drive_as_csv(tmp_path):
    bag = write_bag(tmp_path / "bag", drive())
    data, report = import_demonstrations(bag)
    assert report.accepted == ["bag"]
    (recording,) = read_recordings(bag)
    columns = recording.columns()
    rows = [",".join(["trajectory", *columns])]
    rows += [",".join(["d", *map(repr, map(float, one))]) for one in zip(*columns.values())]
    (tmp_path / "drive.csv").write_text("\n".join(rows))
    same, _ = import_demonstrations(tmp_path / "drive.csv")
    assert data.shape == same.shape
    for key in ("pose", "observation", "action", "goal", "human"):
        np.testing.assert_array_equal(data[key].numpy(), same[key].numpy())
    speed = 0.5 * (data["action"][0, 2:-1, 0] + 1) * 0.5
    np.testing.assert_allclose(speed.numpy(), 0.4, atol=1e-3)


def test_a_human_who_walks_is_interpolated(tmp_path):
    messages = [one for one in drive(human=None)]
    for k in range(90):  # a message every 0.13 s, at 0.5 m/s
        stamp = 100.0 + 0.13 * k
        messages.append(("/human", POSE, stamp, stamp + 0.2, ("odom", 8.0 - 0.5 * 0.13 * k, 1.5)))
    (recording,) = read_recordings(write_bag(tmp_path / "bag", messages))
    np.testing.assert_allclose(
        recording.human[:, 0], 8.0 - 0.5 * (recording.time - 100.0), atol=1e-6
    )


def test_the_nearest_of_many_counts_and_nobody_is_between_two(tmp_path):
    messages = [one for one in drive(human=None)]
    for k in range(110):
        stamp = 100.0 + 0.11 * k
        people = ("odom", (6.0, 3.0), (0.0, -1.0))
        messages.append(("/people", "geometry_msgs/msg/PoseArray", stamp, stamp, people))
    (recording,) = read(write_bag(tmp_path / "bag", messages), human="/people")[0]
    found = {tuple(place) for place in recording.human.tolist()}
    assert found == {(0.0, -1.0), (6.0, 3.0)}
    near = recording.position[:, 0] < 2.0
    assert (recording.human[near] == (0.0, -1.0)).all()


def test_a_human_before_the_robot_is_turned_into_its_frame(tmp_path):
    messages = drive(human=None)
    for k in range(90):
        stamp = 100.0 + 0.13 * k
        ahead = 2.0 - 0.4 * max(0.0, 0.13 * k - 1.0)
        messages.append(("/human", POSE, stamp, stamp, ("base_link", ahead, 1.5)))
    (recording,) = read_recordings(write_bag(tmp_path / "bag", messages))
    np.testing.assert_allclose(recording.human, [[2.0, 1.5]] * len(recording.time), atol=0.02)


def test_every_other_goal_begins_a_drive(tmp_path):
    first = drive(goal=(4.0, 0.0))
    # The same goal again is none, and what is driven before the first one belongs to nothing.
    again = [("/goal_pose", POSE, 105.0, 105.013, ("odom", 4.0, 0.01))]
    second = drive(130.0, goal=(8.0, 0.0), offset=4.2)
    bag = write_bag(tmp_path / "day", [*first, *again, *second])
    recordings, notes = read(bag)
    assert [one.name for one in recordings] == ["day 1", "day 2"]
    assert [tuple(one.goal[0]) for one in recordings] == [(4.0, 0.0), (8.0, 0.0)]
    assert notes == ["left out 6 point(s) of day before its first goal"]
    _, report = import_demonstrations(bag)
    # From the arrival to the next goal the robot's topic is silent for 18 s: that is no gap.
    assert report.accepted == ["day 1", "day 2"]


def test_a_human_who_leaves_after_the_arrival_is_not_missed(tmp_path):
    messages = drive(seconds=20.0)
    until = lambda end: [one for one in messages if one[0] != "/human" or one[2] < end]  # noqa: E731
    # It is 0.3 m from its goal after 9.25 s of driving, at 110.25 s.
    (recording,) = read_recordings(write_bag(tmp_path / "after", until(110.5)))
    assert recording.faults == ()
    (recording,) = read_recordings(write_bag(tmp_path / "before", until(109.0)))
    assert recording.faults[0].startswith("no word of the human for")


def test_without_goals_stands_separate_drives(tmp_path):
    first = drive(goal=None)
    pause = [
        ("/odom", ODOMETRY, t, t + 0.01, ("odom", 4.2, 0.0, 0.0))
        for t in np.arange(111.52, 116, 0.1)
    ]
    second = drive(116.0, goal=None, offset=4.2)
    bag = write_bag(tmp_path / "teleop", [*first, *pause, *second])
    recordings, _ = read(bag, goal=None)
    assert [one.name for one in recordings] == ["teleop 1", "teleop 2"]
    assert recordings[0].goal[0] == pytest.approx((4.2, 0.0), abs=0.03)
    assert recordings[1].goal[0] == pytest.approx((8.4, 0.0), abs=0.03)
    data, report = import_demonstrations(bag, topics=BagTopics(goal=None))
    assert (len(data), report.rejected) == (2, {})


def test_a_folder_of_bags(tmp_path):
    write_bag(tmp_path / "b", drive())
    write_bag(tmp_path / "a", drive(500.0))
    (tmp_path / "notes.txt").write_text("of the day")
    assert [one.name for one in read_recordings(tmp_path)] == ["a", "b"]


def test_an_mcap_alone(tmp_path):
    bag = write_bag(tmp_path / "bag", drive())
    (file,) = bag.glob("*.mcap")
    (alone,) = read_recordings(file.rename(tmp_path / "alone.mcap"))
    assert alone.name == "alone"


def test_boxes_around_the_drives_of_a_bag(tmp_path):
    bag = write_bag(tmp_path / "bag", drive())
    boxes = tmp_path / "boxes.csv"
    boxes.write_text("trajectory,x,y,yaw,half_length,half_width\nbag,2,-1,0.3,0.2,0.2\n")
    data, report = import_demonstrations(bag, boxes)
    assert report.accepted == ["bag"]
    bare, _ = import_demonstrations(bag)
    assert not np.allclose(data["observation"].numpy(), bare["observation"].numpy())
    boxes.write_text("trajectory,x,y,yaw,half_length,half_width\nbog,2,-1,0.3,0.2,0.2\n")
    with pytest.raises(ValueError, match=r"has no trajectory 'bog'. Is 'bag' meant\?"):
        import_demonstrations(bag, boxes)


# --- what is not known


def test_a_human_who_is_lost_costs_the_drive_and_says_for_how_long(tmp_path):
    messages = [one for one in drive() if not (one[0] == "/human" and 104.0 < one[2] < 105.5)]
    bag = write_bag(tmp_path / "bag", messages)
    (recording,) = read_recordings(bag)
    (fault,) = recording.faults
    assert fault.startswith("no word of the human for 1.57 s around 104.")
    # What it names is enough.
    assert fault.endswith("at most 0.5 s are bridged: --gap-tolerance 1.58")
    assert [one.faults for one in open_recordings(bag, gap=1.58)] == [()]


def test_a_human_who_comes_too_late(tmp_path):
    messages = [one for one in drive() if not (one[0] == "/human" and one[2] < 105.0)]
    (recording,) = read_recordings(write_bag(tmp_path / "bag", messages))
    assert recording.faults[0].startswith("no word of the human for 4.0")


def test_a_gap_in_the_odometry_is_named_as_in_other_files(tmp_path):
    messages = [one for one in drive() if not (one[0] == "/odom" and 104.0 < one[2] < 105.0)]
    both = [*messages, *drive(200.0, goal=(4.01, 0.2))]
    _, report = import_demonstrations(write_bag(tmp_path / "bag", both))
    assert report.accepted == ["bag 2"]
    (reason,) = report.rejected["bag 1"]
    assert str(reason).startswith("time jumps by 1.0")


def test_messages_that_are_sent_twice_are_left_out(tmp_path):
    messages = drive()
    twice = [*messages, *(one for one in messages if one[0] == "/odom")]
    recordings, notes = read(write_bag(tmp_path / "bag", twice))
    assert notes[0] == "left out 346 point(s) of bag of equal time"
    assert len(recordings) == 1


# --- named refusals

STRANGE = {
    "no human": (drive(human=None), {}, r"topic /human for the human is not in .*bag: of a type that"),
    "another name": (drive(), {"robot": "/pose"}, r"topic /pose for the robot is not in .* /odom.*--robot-topic"),
    "another type": (drive(), {"human": "/odom", "robot": "/human"}, r"topic /odom: for the human messages must"),
    "two frames": (drive(human_frame="map"), {}, r"the human is told in frame 'map', the robot in 'odom'"),
    "frames mixed": (
        [*drive(), ("/human", POSE, 101.0, 101.0, ("map", 1.0, 1.0))],
        {},
        "topic /human: messages in several frames, map, odom",
    ),
    "no stamps": (
        [(t, k, 0.0 if t == "/human" else s, r, c) for t, k, s, r, c in drive()],
        {},
        r"topic /human: \d+ message\(s\) without a stamp in their header: --stamps received",
    ),
    "two clocks": (
        [(t, k, s - 90.0 if t == "/human" else s, r, c) for t, k, s, r, c in drive()],
        {},
        r"the stamps of /human and /odom are of two clocks, 90 s apart: --stamps received",
    ),
    "a goal too late": (
        [(t, k, s + 60 * (t == "/goal_pose"), r + 60 * (t == "/goal_pose"), c) for t, k, s, r, c in drive()],
        {},
        "holds no drive: no pose of the robot comes after a goal",
    ),
}  # fmt: skip


@pytest.mark.parametrize("strange", STRANGE)
def test_what_concerns_the_whole_bag_is_one_line(tmp_path, strange):
    messages, options, line = STRANGE[strange]
    with pytest.raises(ValueError, match=line) as error:
        read(write_bag(tmp_path / "bag", messages), **options)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("strange", ["no stamps", "two clocks"])
def test_the_time_of_reception_serves_where_stamps_do_not(tmp_path, strange):
    messages, _, _ = STRANGE[strange]
    (recording,) = read(write_bag(tmp_path / "bag", messages), stamps="received")[0]
    assert recording.faults == ()
    assert recording.time[0] == pytest.approx(101.013, abs=0.1)


def test_a_goal_from_a_desk_with_another_clock_begins_a_drive_when_it_came(tmp_path):
    messages = [(t, k, s + 1e6 * (t == "/goal_pose"), r, c) for t, k, s, r, c in drive()]
    (recording,) = read_recordings(write_bag(tmp_path / "bag", messages))
    assert recording.time[0] == pytest.approx(101.0, abs=0.1)


def test_the_same_topic_twice():
    with pytest.raises(ValueError, match="robot, human and goal must be different topics"):
        BagTopics(robot="/odom", human="/odom")
    with pytest.raises(ValueError, match="stamps must be 'header' or 'received', got 'now'"):
        BagTopics(stamps="now")


@pytest.mark.parametrize("share", [0.0, 0.4, 0.9])
def test_a_bag_that_is_cut_off(tmp_path, share):
    bag = write_bag(tmp_path / "bag", drive())
    (file,) = bag.glob("*.mcap")
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    with pytest.raises(ValueError, match="is no bag that can be read") as error:
        read(bag)
    assert "\n" not in str(error.value)


def test_what_is_no_bag(tmp_path):
    (tmp_path / "bag.mcap").write_text("trajectory,time")
    with pytest.raises(ValueError, match=r"bag\.mcap is no bag that can be read"):
        read(tmp_path / "bag.mcap")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match="empty is a folder, not a file"):
        read_recordings(tmp_path / "empty")


def test_headings_are_those_of_the_poses(tmp_path):
    messages = []
    for k in range(300):  # a circle of 2 m at 0.4 m/s
        t, angle = 100.0 + k / 20, 0.2 * k / 20
        pose = ("odom", 2 * math.sin(angle), 2 - 2 * math.cos(angle), angle)
        messages.append(("/odom", ODOMETRY, t, t, pose))
        messages.append(("/human", POSE, t, t, ("odom", -3.0, -3.0)))
    messages.append(("/goal_pose", POSE, 99.0, 99.0, ("odom", *messages[-2][4][1:3])))
    (recording,) = read_recordings(write_bag(tmp_path / "bag", messages))
    turned = np.unwrap(recording.heading)
    np.testing.assert_allclose(turned, 0.2 * (recording.time - 100.0), atol=1e-6)
