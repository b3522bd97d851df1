"""Somebody says which of two drives they like better, and drives so: in a real browser, without a window."""

from __future__ import annotations

import pytest
import torch

from recipes.choices.outcomes import SHIPPED, load
from torchrl_morl.choices import PreferencePosterior, best_preference, next_question

from ._browser import SHOWCASE, drive

ANSWER = {"1": "first", "2": "second", "=": "tie", "n": "neither"}


def found(answers: str) -> list[float]:
    """The preference that ``torchrl_morl.choices`` finds from these answers to its questions."""
    shipped = load(SHIPPED)
    posterior = PreferencePosterior(("demo", "distance", "efficiency"))
    for number, key in enumerate(answers):
        generator = torch.Generator().manual_seed(10_000 * number)
        question = next_question(
            posterior, shipped.outcomes, valid=shipped.arrived, generator=generator
        )
        rows = shipped.outcomes[question.scene]
        posterior.answer(rows[question.first], rows[question.second], ANSWER[key])
    return best_preference(posterior, shipped.outcomes, shipped.preferences).preference.tolist()


def choosing(page) -> str:
    """What was typed so far."""
    return page.evaluate("page.chooser.log")


def test_five_answers_by_key_and_by_click_and_it_drives_so(opened):
    page = opened()
    page.get_by_role("button", name="You choose").click()
    assert page.locator("#question").inner_text() == "Question 1: which do you like better?"
    assert page.locator("#drive-so").is_disabled()
    page.keyboard.press("2")
    page.locator("#first").click()
    page.get_by_role("button", name="The same").click()
    page.keyboard.press("ArrowRight")
    page.get_by_role("button", name="Neither", exact=True).click()
    page.keyboard.press("u")
    page.keyboard.press("1")
    assert choosing(page) == "21=21"
    assert page.locator("#found").inner_text() == "After 5 answers"
    preference = found("21=21")
    told = [
        text.replace("\xa0", " ") for text in page.locator("#found-weights b").all_inner_texts()
    ]
    assert told == [f"{round(100 * weight)} %" for weight in preference]
    page.get_by_role("button", name="Drive so").click()
    assert page.evaluate("page.session.preference") == pytest.approx(preference, abs=1e-6)
    # The triangle and its sliders show it.
    texts = page.locator("#weights output").all_inner_texts()
    assert texts == told
    dot = page.locator("#triangle [role=slider]")
    assert dot.get_attribute("aria-valuetext").endswith(f"fast {told[2]}")
    assert "as you chose" in page.locator("#lead").inner_text()
    page.wait_for_function("page.session.seconds > 0.5")  # it is on its way
    page.wait_for_function("page.previews.ways.length === 3")
    page.evaluate("page.session.playing = false")
    drive(page)
    assert page.evaluate("page.session.episode.ending") == "goal"


def test_a_link_brings_the_answers_back(opened):
    page = opened(SHOWCASE + "&answers=1s2u=&view=choices")
    assert page.locator("#found").inner_text() == "After 2 answers"
    question = page.evaluate("page.chooser.dialogue.question")
    page.keyboard.press("n")
    page.wait_for_function("location.hash.endsWith('answers=1s2u=n&view=choices')")
    page.keyboard.press("u")
    assert page.evaluate("page.chooser.dialogue.question") == question
    page.get_by_role("button", name="It drives").click()
    page.wait_for_function("location.hash.endsWith('answers=1s2u=nu')")
    page.get_by_role("button", name="You choose").click()
    page.get_by_role("button", name="Start over").click()
    assert choosing(page) == ""
    assert page.locator("#undo").is_disabled()


def test_what_is_seen_is_said(opened):
    """A screen reader hears what the two drives did, and after an answer what was found."""
    page = opened(SHOWCASE + "&view=choices")
    name = page.locator("#first").get_attribute("aria-label")
    assert name.startswith("Drive 1 is better: ")
    assert all(part in name for part in (" s, ", "m from the person", "m off the demonstration"))
    page.keyboard.press("1")
    said = page.locator("#status").inner_text()
    assert said.startswith("You said: the first one. This should reach ")
    assert said.endswith("Question 2: which do you like better?")


def test_keys_that_answer_do_nothing_else_meanwhile(opened):
    """N is the next scene and 1 a corner of the triangle where the robot drives, and answers here."""
    page = opened(SHOWCASE + "&view=choices")
    before = page.evaluate("[page.session.sceneName, page.session.preference]")
    for key in ("n", "1", "r", "l", "0"):
        page.keyboard.press(key)
    assert choosing(page) == "n1"
    assert page.evaluate("[page.session.sceneName, page.session.preference]") == before
    assert page.evaluate("page.chooser.playing")
    page.locator("#question").click()
    page.keyboard.press("Space")
    assert not page.evaluate("page.chooser.playing")
    assert choosing(page) == "n1"


def test_someone_who_always_takes_the_left_one_is_told(opened):
    page = opened(SHOWCASE + "&answers=111&view=choices")
    assert page.locator("#random").is_hidden()
    for _ in range(9):
        page.keyboard.press("1")
    assert (
        "these answers follow nothing that the robot knows" in page.locator("#random").inner_text()
    )


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_two_drives_and_their_answers_fit_the_window(opened, width, scheme):
    height = 844 if width < 400 else 800
    page = opened(
        SHOWCASE + "&answers=12&view=choices", width=width, height=height, color_scheme=scheme
    )
    assert page.evaluate("document.documentElement.scrollWidth") == width
    frames = [page.locator(f"#{name}").bounding_box() for name in ("first", "second", "undo")]
    assert all(one["y"] + one["height"] < height for one in frames)
    assert all(one["x"] >= 0 and one["x"] + one["width"] <= width for one in frames)
    # Side by side, or one above the other on a phone.
    assert (frames[0]["y"] == frames[1]["y"]) == (width > 400)
    assert page.locator("#drive-so").is_enabled()
    assert page.locator("#floor").is_hidden()


def test_fingers_answer(opened):
    page = opened(SHOWCASE + "&view=choices", width=390, height=844, has_touch=True)
    page.locator("#second canvas").tap()
    page.locator("#undo").tap()
    page.locator("#first canvas").tap()
    assert choosing(page) == "1"


def test_recording_and_choosing_give_way_to_each_other(opened):
    page = opened()
    page.get_by_role("button", name="You drive").click()
    page.get_by_role("button", name="You choose").click()
    assert page.locator("#choices").is_visible()
    assert page.locator("#record-card").is_hidden()
    page.keyboard.press("ArrowLeft")  # an answer, no turn
    assert choosing(page) == "1"
    page.get_by_role("button", name="You drive").click()
    assert page.locator("#record-card").is_visible()
    assert page.locator("#choices").is_hidden()
    page.get_by_role("button", name="It drives").click()
    assert page.locator("#preference-card").is_visible()
    assert page.locator("#where-card").is_visible()
