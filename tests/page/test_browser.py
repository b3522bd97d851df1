"""Somebody opens the page, drags, types and records: in a real browser, without a window.

The page's clock depends on the machine. The tests hold it and make control steps themselves.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from envs.demonstrations import import_demonstrations

from ._browser import SHOWCASE, corners, drag, drive, on_floor


def copied(page) -> str:
    """The state, in the part of the link behind ``#``."""
    page.locator("#link").click()
    return page.evaluate("location.hash")


def test_the_robot_answers_to_the_triangle(opened):
    """Dragged on the way from fast to far, it keeps away from there on, in the same scene."""
    page = opened(SHOWCASE + "&weights=0,0,1")
    assert page.evaluate("page.session.preference") == [0, 0, 1]
    drive(page, 15)
    fast = page.evaluate("structuredClone(page.session.episode.moment())")
    drag(page, corners(page)[2], corners(page)[1])
    assert page.evaluate("page.session.preference") == [0, 1, 0]
    assert page.locator("#weights output").all_inner_texts() == ["0 %", "100 %", "0 %"]
    path = drive(page)
    assert page.evaluate("page.session.episode.ending") == "goal"
    far = page.evaluate("page.session.nearest")  # metres
    page.evaluate("page.session.restart(); page.session.preference = [0, 0, 1]")
    other = drive(page)
    assert np.allclose(path[:16], other[:16])  # until the dot was dragged
    assert page.evaluate("page.session.nearest") < far - 0.3
    assert fast["elapsed"] == 15


def test_the_robot_answers_to_the_person(opened):
    page = opened(SHOWCASE + "&weights=0,0,1")
    before = drive(page)
    page.evaluate("page.session.restart()")
    drive(page, 10)
    drag(page, on_floor(page, 4.5, 0), on_floor(page, 4.5, -1.6))
    human = page.evaluate("page.session.episode.human")
    assert np.allclose(human[:2], [4.5, -1.6], atol=0.03)
    after = drive(page)
    assert page.evaluate("page.session.episode.ending") == "goal"
    # It was to pass on the right of the person; now there is more room on the left.
    assert beside(before) < -0.4
    assert beside(after) > -0.2
    assert "human=4.5" in copied(page)


def beside(path: np.ndarray) -> float:
    """How far to the left of the straight way it passes x = 4.5 m."""
    return float(np.interp(4.5, path[:, 0], path[:, 1]))


def test_the_goal_and_the_boxes_can_be_dragged(opened):
    page = opened()
    drag(page, on_floor(page, 9, 0), on_floor(page, 8, 2))
    drag(page, on_floor(page, 1.9, 1.9), on_floor(page, 2.4, -1.5))
    assert np.allclose(page.evaluate("page.session.episode.goal"), [8, 2], atol=0.03)
    assert np.allclose(page.evaluate("page.session.episode.boxes[0]")[:2], [2.4, -1.5], atol=0.03)
    path = drive(page)
    assert page.evaluate("page.session.episode.ending") == "goal"
    assert np.hypot(*(path[-1] - [8, 2])) < 0.31


def test_previews_show_where_each_corner_would_go(opened):
    page = opened()
    drive(page, 10)
    page.wait_for_function("page.previews.ways.length === 3")
    ways = page.evaluate("page.previews.ways")
    assert [way["ending"] for way in ways] == ["goal"] * 3
    nearest = [min(math.hypot(x - 4.5, y) for x, y in way["points"]) for way in ways]
    assert nearest[1] > nearest[0] + 0.3  # far from the person
    assert nearest[1] > nearest[2] + 0.3
    assert page.evaluate("page.previews.names[1]") in ways[1]["points"]
    # The broad line is where it goes, and follows the dot also while all stands still.
    page.evaluate("page.session.playing = false")
    drag(page, corners(page)[2], corners(page)[1])
    page.wait_for_function(
        "JSON.stringify(page.previews.own) === JSON.stringify(page.previews.ways[1])"
    )
    assert len(ways[2]["points"]) <= min(len(ways[0]["points"]), len(ways[1]["points"]))  # fast


def test_keys_do_what_pointers_do(opened):
    page = opened()
    page.keyboard.press("2")
    assert page.evaluate("page.session.preference") == [0, 1, 0]
    dot = page.get_by_role("slider", name="What matters")
    dot.focus()
    page.keyboard.press("ArrowUp")
    weights = page.evaluate("page.session.preference")
    assert weights[0] > 0.04
    assert sum(weights) == pytest.approx(1)
    assert dot.get_attribute("aria-valuetext").startswith("like the demonstration")
    page.locator("#floor").focus()
    page.keyboard.press("Enter")
    page.keyboard.press("ArrowDown")
    assert page.evaluate("page.session.episode.human")[1] == pytest.approx(-0.1, abs=1e-6)
    assert "the person" in page.locator("#status").inner_text()
    page.keyboard.press("Escape")
    page.keyboard.press("Space")
    assert page.evaluate("page.session.playing")


def test_a_link_carries_the_state(opened):
    page = opened()
    page.select_option("#scene", "static")
    page.fill("#seed", "9")
    page.locator("#seed").press("Enter")
    page.keyboard.press("Tab")
    page.select_option("#motion", "crosses")
    page.keyboard.press("Escape")
    page.select_option("#policy", "polished_seed0")
    page.keyboard.press("Escape")
    page.evaluate("page.session.move('goal', 7, 1)")
    page.locator("#weights input").nth(1).fill("60")
    link = copied(page)
    assert "policy=polished_seed0" in link
    code = "[page.session.scene, page.session.policyName, page.session.preference.map((w) => Math.round(1000 * w))]"
    assert opened(link).evaluate(code) == page.evaluate(code)


def test_a_link_that_is_none_opens_the_page_and_says_so(opened):
    page = opened("#scene=moon&seed=x&weights=1,nan,0&goal=1e9,0&human=2,1")
    assert page.evaluate("page.session.sceneName") == "showcase"
    assert page.evaluate("page.session.episode.human.slice(0, 2)") == [2, 1]
    said = page.locator("#status").inner_text()
    assert all(part in said for part in ("scene=moon", "seed=x", "weights=1,nan,0", "goal=1e9,0"))


def test_who_walks_is_met_by_a_policy_that_knows_it(opened):
    page = opened("#scene=showcase&policy=polished_seed0")
    assert page.evaluate("page.session.policyName") == "polished_seed0"
    page.keyboard.press("Tab")
    page.select_option("#motion", "crosses")
    assert page.evaluate("page.session.policyName") == "navigation"


def test_a_person_walks_and_crosses(opened):
    page = opened("#scene=moving_human&seed=8")
    before = page.evaluate("page.session.episode.human")
    drive(page, 10)
    after = page.evaluate("page.session.episode.human")
    assert before[0] - after[0] == pytest.approx(1.0, abs=1e-6)  # 10 steps of 0.2 s at 0.5 m/s
    page.select_option("#motion", "crosses")
    ys = []
    for _ in range(6):
        page.evaluate("for (let i = 0; i < 10; i++) page.session.episode.step([0, 0])")
        ys.append(page.evaluate("page.session.episode.human")[1])
    assert max(ys) - min(ys) > 3
    assert min(np.diff(ys)) < 0 < max(np.diff(ys))  # there and back


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_the_window_and_follows_the_scheme(opened, width, scheme):
    page = opened(width=width, color_scheme=scheme, has_touch=width < 400)
    assert page.evaluate("document.documentElement.scrollWidth") == width
    assert page.evaluate("document.documentElement.dataset.theme") == scheme
    # The scene lies below the numbers on it.
    numbers = page.locator("#numbers").bounding_box()
    for name in ("[s.body.x, s.body.y]", "s.goal", "s.human"):
        x, y = page.evaluate(f"(() => {{ const s = page.session.episode; return {name}; }})()")[:2]
        assert on_floor(page, x, y)[1] > numbers["y"] + numbers["height"]
    # The floor and the whole triangle are seen at once on a phone of 844 points.
    frame = page.locator("#triangle").bounding_box()
    assert frame["y"] + frame["height"] < 844
    page.locator("#theme").click()
    assert page.evaluate("document.documentElement.dataset.theme") != scheme


def test_fingers_drag_the_dot(opened):
    page = opened(width=390, height=844, has_touch=True)
    page.touchscreen.tap(*corners(page)[1])
    assert page.evaluate("page.session.preference") == [0, 1, 0]


def test_what_is_recorded_is_imported(opened, tmp_path):
    """Two drives, one with the pointer and one with keys, and one that fails; the file goes to the importer."""
    page = opened()
    page.get_by_role("button", name="You drive").click()
    page.evaluate("page.session.playing = false")
    assert page.evaluate("page.session.sceneName") == "empty"
    for _ in range(2):
        goal, human = page.evaluate("[page.session.episode.goal, page.session.episode.human]")
        page.mouse.move(*on_floor(page, 0.8, 0.0))
        page.mouse.down()
        for spot in ((human[0], human[1] - 1.5), (goal[0], goal[1])):
            page.mouse.move(*on_floor(page, *spot))
            code = """([x, y]) => {
                const { session } = page;
                const near = () => Math.hypot(session.episode.body.x - x, session.episode.body.y - y) < 0.4;
                while (!session.episode.ending && !near()) session.step();
                if (near()) for (let i = 0; i < 40 && !session.episode.ending && x > 5.9; i++) session.step();
            }"""
            page.evaluate(code, list(spot))
        page.mouse.up()
        assert page.evaluate("page.session.episode.ending") == "goal"
        page.evaluate("page.session.next()")
    page.keyboard.down("ArrowUp")  # straight on: into the person, or past them
    drive(page)
    page.keyboard.up("ArrowUp")
    kept = page.evaluate("page.recorder.drives.kept.length")
    assert kept in (2, 3)
    with page.expect_download() as download:
        page.get_by_role("button", name=f"Download {kept} drives").click()
    file = tmp_path / "drives.csv"
    download.value.save_as(file)
    drives, report = import_demonstrations(file)
    assert len(drives) == kept, str(report)
    rows = page.locator("#drives li")
    assert "on the right" in rows.last.inner_text()
    assert rows.first.inner_text().startswith(f"drive {kept}:")  # the latest is seen first


def test_time_waits_for_the_driver(opened):
    page = opened()
    page.get_by_role("button", name="You drive").click()
    page.wait_for_timeout(600)
    assert page.evaluate("page.session.seconds") == 0
    page.keyboard.down("w")
    page.wait_for_function("page.session.seconds > 0.3")
    page.keyboard.up("w")
    waited = page.evaluate("page.session.seconds")
    page.wait_for_timeout(600)
    assert page.evaluate("page.session.seconds") <= waited + 0.21
