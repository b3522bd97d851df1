"""What the browser is sent, by a server that nobody looks at, and what its controls do."""

from __future__ import annotations

import socket
from types import SimpleNamespace

import numpy as np
import pytest

import recipes.live.__main__ as live
from envs import get_scene
from recipes.evaluation.setting import Setting, trained_in
from recipes.evaluation.sweep import SHIPPED_POLICY
from recipes.live.simulation import LiveSimulation
from tests._command import run_here
from torchrl_morl.deploy import load_policy

viser = pytest.importorskip("viser", reason="viser is not installed: group live")

from recipes.live.view import LiveView, on_floor  # noqa: E402


@pytest.fixture(scope="module")
def view():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    policy = load_policy(SHIPPED_POLICY)
    setting = Setting(get_scene("showcase"), trained_in(policy.card).robot)
    simulation = LiveSimulation(policy, setting, seed=7)
    server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
    yield LiveView(server, simulation)
    server.stop()
    simulation.close()


def test_the_robot_is_shown_where_it_is(view):
    live.serve(view, view.simulation, seconds=1.5)
    assert view.simulation.seconds > 0.5
    robot = next(iter(view.things("robot")))
    x, y, _ = robot.position
    # Between the last two control steps.
    assert 0 <= view.simulation.pose[0] - x < 0.11
    assert abs(view.simulation.pose[1] - y) < 0.05
    assert len(view.things("way")) == 3
    assert "to the person" in view.numbers


def test_another_seed_shows_another_scene_and_no_old_ways(view):
    live.serve(view, view.simulation, seconds=0.5)
    assert view.things("path")
    view.again(9)
    assert (view.simulation.seed, view.simulation.seconds) == (9, 0.0)
    assert not view.things("path") and not view.things("way")
    assert len(view.things("box")) == len(view.simulation.boxes)


def test_a_weight_changes_the_others(view):
    view.weigh(1, 1.0)
    view.handle()
    assert view.simulation.preference.tolist() == [0.0, 1.0, 0.0]
    assert view.weights == [0, 100, 0]
    view.weigh(1, 0.5)
    view.handle()
    assert view.simulation.preference.tolist() == [0.25, 0.5, 0.25]


def test_a_drag_ends_on_the_floor_and_not_where_the_camera_looks():
    camera = np.array([0.0, -6.0, 6.0])
    assert on_floor(camera, np.array([0.0, -3.0, 3.0]), 0.0) == pytest.approx((0.0, 0.0))
    assert on_floor(camera, np.array([0.0, -3.0, 3.0]), 1.0) == pytest.approx((0.0, -1.0))
    with pytest.raises(ValueError, match="does not come down"):
        on_floor(camera, np.array([0.0, 0.0, 7.0]), 0.0)


def test_a_thing_is_dragged(view):
    event = SimpleNamespace(
        client=SimpleNamespace(camera=SimpleNamespace(position=(4.0, -6.0, 6.0))),
        end_position=(4.0, -4.0, 4.0),
        start_position=(9.0, 0.0, 0.0),
    )
    view.drag("goal", event)
    view.handle()
    assert view.simulation.goal == pytest.approx([4.0, 0.0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--policy", "nowhere"], "nowhere"),
        (["--port", "0"], "must be a whole number from 1 to 65535, got '0'"),
        (["--scene", "moon"], "moon"),
    ],
)
def test_mistakes_are_one_line(arguments, message, capsys):
    with pytest.raises(SystemExit) as stopped:
        run_here(live.main, *arguments)
    assert stopped.value.code == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
