"""What visitors do that nobody planned: broken links, narrow windows, a pause too early, things dragged anywhere."""

from __future__ import annotations

import pytest

from ._browser import corners, drag, drive, on_floor


@pytest.mark.parametrize("view", ["", "&view=choices"])
def test_a_broken_link_says_so_where_it_is_seen(opened, view):
    page = opened("#seed=abc&" + 3000 * "a" + "=<script>" + view)
    lead = page.locator("#lead")
    assert lead.is_visible()
    assert "seed=abc" in lead.inner_text()
    assert len(lead.inner_text()) < 200
    assert page.evaluate("document.documentElement.scrollWidth") == 1280
    page.evaluate("location.hash = '#seed=7'")
    page.wait_for_function("!document.querySelector('#lead').textContent.includes('abc')")


def test_a_link_of_many_broken_entries_names_the_first_of_them(opened):
    page = opened("#" + "&".join(f"entry{number}=x" for number in range(500)))
    said = page.locator("#lead").inner_text()
    assert "entry0=x" in said
    assert said.endswith("and 496 more")


def test_a_link_by_hand_is_read_in_the_scene_that_is_open(opened):
    page = opened("#scene=static")
    page.evaluate("location.hash = '#seed=9&box0=1,2.5'")
    page.wait_for_function("page.session.seed === 9")
    assert page.evaluate("page.session.episode.boxes[0].slice(0, 2)") == [1, 2.5]
    assert "not here" not in page.locator("#lead").inner_text()


def test_help_fits_a_phone_and_begins_at_its_beginning(opened):
    page = opened(width=390, height=844, has_touch=True)
    page.locator("#help").click()
    dialog = page.locator("#help-dialog")
    wide, seen, scrolled = dialog.evaluate("d => [d.scrollWidth, d.clientWidth, d.scrollTop]")
    assert wide <= seen
    assert scrolled == 0
    page.keyboard.press("Escape")
    assert dialog.is_hidden()


def overlap(one: dict, other: dict) -> bool:
    return all(
        one[at] < other[at] + other[size] and other[at] < one[at] + one[size]
        for at, size in (("x", "width"), ("y", "height"))
    )


@pytest.mark.parametrize("width", [390, 1280])
def test_the_dot_lies_on_no_name_of_a_corner(opened, width):
    page = opened(width=width)
    for key in "123":
        page.keyboard.press(key)
        dot = page.locator("#triangle [role=slider]").bounding_box()
        for corner in page.locator("#triangle .corner").all():
            assert not overlap(dot, corner.bounding_box()), (key, corner.inner_text())


def test_a_frame_around_the_floor_is_for_keys(opened):
    page = opened()
    framed = "document.querySelector('#floor').matches(':focus-visible')"
    drag(page, on_floor(page, 4.5, 0), on_floor(page, 4.5, 0.8))
    assert not page.evaluate(framed)
    drag(page, corners(page)[0], corners(page)[1])
    drag(page, on_floor(page, 9, 0), on_floor(page, 8, 1))
    assert not page.evaluate(framed)
    page.keyboard.press("Tab")
    page.keyboard.press("Shift+Tab")
    assert page.evaluate(framed)


@pytest.mark.parametrize("width", [390, 1280])
def test_the_flag_stays_below_the_numbers(opened, width):
    page = opened(width=width)
    frame = page.locator("#floor").bounding_box()
    drag(page, on_floor(page, 9, 0), (frame["x"] + 60, frame["y"] + 3))
    numbers = page.locator("#numbers").bounding_box()
    pole = max(0.62 * page.evaluate("page.floor.scale"), 30)  # pixels
    goal = page.evaluate("page.session.episode.goal")
    assert on_floor(page, *goal)[1] - pole >= numbers["y"] + numbers["height"]
    # With keys, too.
    page.locator("#floor").focus()
    page.keyboard.press("Enter")
    page.keyboard.press("Enter")
    for _ in range(20):
        page.keyboard.press("Shift+ArrowUp")
    assert page.evaluate("page.session.episode.goal") == pytest.approx(goal, abs=1e-6)


def test_ways_ahead_begin_at_the_robot_also_where_they_are_late(opened):
    """On a slow machine the robot has gone on before the answer comes."""
    page = opened()
    page.wait_for_function("page.previews.ways.length === 3")
    page.evaluate("page.previews.ask = () => {}")
    drive(page, 25)
    x = page.evaluate("page.session.episode.body.x")
    ahead = page.evaluate("page.previews.ahead(page.session.episode.elapsed)")
    assert all(way[0][0] > x - 0.6 for way in ahead["ways"])
    assert ahead["own"][0][0] == pytest.approx(x, abs=0.2)
    shown = [place for place in ahead["names"] if place]
    assert all(place[0] > x - 0.6 for place in shown)


def test_nobody_can_pause_while_time_waits_anyway(opened):
    """Paused, the robot would not move where somebody presses, and nothing would say why."""
    page = opened()
    page.locator("#play").click()
    page.get_by_role("button", name="You drive").click()
    assert page.locator("#play").is_hidden()
    assert page.locator("#show-previews").is_hidden()
    page.locator("#floor").focus()
    page.keyboard.press("Space")
    page.mouse.move(*on_floor(page, 3, 1))
    page.mouse.down()
    page.wait_for_function("page.session.seconds > 0.3")
    page.mouse.up()
    page.get_by_role("button", name="It drives").click()
    assert page.locator("#play").is_visible()
    assert page.locator("#show-previews").is_visible()


def test_who_comes_back_to_drive_goes_on_where_they_were(opened):
    """From the first scene again, drives would be recorded of the same scenes twice."""
    page = opened()
    page.get_by_role("button", name="You drive").click()
    page.locator("#next").click()
    page.locator("#next").click()
    seed = page.evaluate("page.session.seed")
    page.get_by_role("button", name="It drives").click()
    page.select_option("#scene", "static")
    page.get_by_role("button", name="You drive").click()
    assert page.evaluate("[page.session.sceneName, page.session.seed]") == ["empty", seed]


@pytest.mark.parametrize("width", [320, 390])
@pytest.mark.parametrize("mode", ["It drives", "You drive", "You choose"])
def test_a_small_phone_shows_everything(opened, width, mode):
    page = opened(width=width, height=700, has_touch=True)
    button = page.get_by_role("button", name=mode)
    if button.get_attribute("aria-pressed") == "false":
        button.click()
    assert page.evaluate("document.documentElement.scrollWidth") == width
    for button in page.locator("header button").all():
        assert button.evaluate("b => b.scrollWidth <= b.clientWidth + 1"), button.inner_text()


def test_what_to_do_is_told_beside_the_person_on_a_phone(opened):
    page = opened(width=390, height=844, has_touch=True)
    page.get_by_role("button", name="You drive").click()
    told = page.locator("#verdict").bounding_box()
    human = page.evaluate("page.session.episode.human")
    _, y = on_floor(page, *human[:2])
    assert told["y"] > y + 0.25 * page.evaluate("page.floor.scale") + 16  # below the word "person"
