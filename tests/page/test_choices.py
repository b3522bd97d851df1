"""The page asks, infers and recommends as ``torchrl_morl.choices`` does, and drives what it asks about."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
import torch

from recipes.choices import outcomes, rollouts
from recipes.choices.outcomes import SHIPPED, first_moments, load, request_of
from recipes.choices.rollouts import NUM_SCENES
from recipes.evaluation.setting import demonstrator, trained_in
from recipes.evaluation.sweep import SHIPPED_POLICY, sweep
from recipes.page.choices import choices
from recipes.page.contents import contents
from tests import _any_robot as any_robot
from torchrl_morl.choices import (
    ChoiceModel,
    PreferencePosterior,
    best_preference,
    information,
    next_question,
    value_of_information,
)
from torchrl_morl.deploy import load_policy
from torchrl_morl.deploy.files import file_checksum

from ._node import needs_node, node

ANSWER = {"1": "first", "2": "second", "=": "tie", "n": "neither"}
LOGS = ("12=n1", "222222", "12u=", "1s2s=u1")


@functools.cache
def held() -> dict:
    """What the page holds of choices."""
    return choices(SHIPPED_POLICY)


def dialogue(log: str) -> tuple[list, PreferencePosterior, object]:
    """The same in Python: questions before each key and after the last, posterior, recommendation."""
    found = load(SHIPPED)
    posterior = PreferencePosterior(("demo", "distance", "efficiency"))
    valid, skipped, questions = found.arrived.clone(), 0, []

    def ask():
        number = (posterior.num_answers * 1000 + skipped) * 10
        questions.append(
            next_question(
                posterior,
                found.outcomes,
                valid=valid,
                generator=torch.Generator().manual_seed(number),
            )
        )
        return questions[-1]

    for key in log:
        question = ask()
        if key == "s":
            valid[question.scene, question.first] = False
            skipped += 1
            continue
        skipped = 0
        if key == "u":
            if posterior.num_answers:
                posterior.undo()
        else:
            rows = found.outcomes[question.scene]
            posterior.answer(rows[question.first], rows[question.second], ANSWER[key])
    ask()
    return questions, posterior, best_preference(posterior, found.outcomes, found.preferences)


@needs_node
def test_random_numbers_are_those_of_torch(tmp_path):
    asked = [(0, 60, 3000), (31, 66, 10), (10_020, 7, 700), (2**32 + 5, 1000, 5)]
    for (seed, high, count), got in zip(
        asked, node("choices.mjs", {"random": asked}, tmp_path)["random"], strict=True
    ):
        generator = torch.Generator().manual_seed(seed)
        assert got == torch.randint(high, (count,), generator=generator).tolist()


@needs_node
@pytest.mark.parametrize(
    ("size", "divisions", "model"),
    [
        (2, 50, ChoiceModel()),
        (3, 25, ChoiceModel()),
        (4, 6, ChoiceModel(rationalities=(0.5, 8.0), chance=0.0, half_life=None, slip=0.0)),
        (3, 10, ChoiceModel(tie=0.0, neither=0.3, half_life=2.0)),
    ],
)
def test_the_posterior_is_that_of_the_library(size, divisions, model, tmp_path):
    draw = torch.Generator().manual_seed(size)
    offered = model.offered
    pairs = torch.randn(40, 2, size, generator=draw)
    answers = [
        [first.tolist(), second.tolist(), offered[index % len(offered)]]
        for index, (first, second) in enumerate(3 * pairs[:9])
    ]
    answers[5:5] = [None, None]  # two are taken back
    table = torch.randn(6, 11, size, generator=draw)
    valid = torch.rand(6, 11, generator=draw) < 0.8
    job = {
        "size": size,
        "model": dataclasses.asdict(model),
        "divisions": divisions,
        "answers": answers,
        "pairs": pairs.tolist(),
        "outcomes": table.tolist(),
        "valid": valid.tolist(),
    }
    got = node("choices.mjs", {"posterior": job}, tmp_path)
    posterior = PreferencePosterior(tuple("abcd"[:size]), model=model, divisions=divisions)
    for answer, known in zip(answers, got["posterior"], strict=True):
        if answer is None:
            posterior.undo()
        else:
            posterior.answer(*answer)
        assert known["probability"] == pytest.approx(posterior.probability().tolist(), abs=1e-12)
        assert known["chance"] == pytest.approx(posterior.chance(), abs=1e-12)
        assert known["mean"] == pytest.approx(posterior.mean().tolist(), abs=1e-12)
        sides = pairs[:, 0], pairs[:, 1]
        bits = information(posterior, *sides)
        assert [one["information"] for one in known["worths"]] == pytest.approx(
            bits.tolist(), abs=1e-6
        )
        value = value_of_information(posterior, *sides, table)
        assert [one["value"] for one in known["worths"]] == pytest.approx(value.tolist(), abs=1e-6)
    question = next_question(
        posterior, table, valid=valid, candidates=50, generator=torch.Generator().manual_seed(5)
    )
    asked = got["question"]
    assert (asked["scene"], asked["first"], asked["second"]) == (
        question.scene,
        question.first,
        question.second,
    )
    best = best_preference(posterior, table, torch.eye(11))
    assert got["best"]["index"] == best.index
    assert got["best"]["satisfaction"] == pytest.approx(best.satisfaction.tolist(), abs=1e-9)
    assert got["best"]["regret"] == pytest.approx(best.regret, abs=1e-9)
    assert got["best"]["regretHigh"] == pytest.approx(best.regret_high, abs=1e-9)


@needs_node
def test_the_same_answers_lead_to_the_same_questions_and_preference(tmp_path):
    """All kinds of answers, some taken back, some questions skipped; a link brings them back."""
    got = node("choices.mjs", {"choices": held(), "logs": LOGS}, tmp_path)["dialogues"]
    for log, mine in zip(LOGS, got, strict=True):
        questions, posterior, best = dialogue(log)
        for one, other in zip(mine["questions"], questions, strict=True):
            assert one["information"] == pytest.approx(other.information, abs=1e-6), log
            assert one["value"] == pytest.approx(other.value, abs=1e-6), log
            assert (one["scene"], one["first"], one["second"]) == (
                other.scene,
                other.first,
                other.second,
            ), log
        assert mine["probability"] == pytest.approx(posterior.probability().tolist(), abs=1e-12)
        assert mine["again"] == pytest.approx(mine["probability"], abs=1e-12)
        assert mine["best"]["index"] == best.index
        assert mine["best"]["preference"] == pytest.approx(best.preference.tolist(), abs=1e-6)
        assert mine["best"]["regret"] == pytest.approx(best.regret, abs=1e-9)
        assert mine["best"]["regretHigh"] == pytest.approx(best.regret_high, abs=1e-9)
    assert [one["kept"] for one in got][2:] == ["1=", "1s2s=u1"]


@needs_node
def test_what_is_shown_is_what_was_driven(tmp_path):
    """The page drives the shipped policy itself: endings, times, distances and style of all scenes."""
    policy = load_policy(SHIPPED_POLICY)
    setting = trained_in(policy.card).with_one_robot.with_one_human
    rows = [0, 30, 65]
    result = sweep(
        policy.actor,
        policy.preference_space,
        load(SHIPPED).preferences[rows],
        episodes=NUM_SCENES,
        seed=31,
        demonstrator=demonstrator(policy.card, setting.robot),
        num_threads=1,
        **setting.arguments,
    )
    page = contents([SHIPPED_POLICY], ["showcase"], num_scenes=1)
    job = {
        "choices": held(),
        "robot": page["robot"],
        "entry": page["policies"]["navigation"],
        "drives": [(scene, row) for row in rows for scene in range(NUM_SCENES)],
    }
    got = node("choices.mjs", job, tmp_path)["drives"]
    metrics = result.metrics.flatten()
    arrived = torch.tensor([one["ending"] == "goal" for one in got])
    assert torch.equal(arrived, metrics["success"])
    for key, name in (
        ("seconds", "time"),
        ("nearest", "min_human_distance"),
        ("style", "frechet"),
    ):
        off = np.abs(np.array([one[key] for one in got]) - metrics[name].double().numpy())
        off = off[arrived.numpy()]
        print(f"{name}: median {np.median(off):.0e}, most {off.max():.0e}")
        assert np.quantile(off, 0.98) < 1e-3
    # And they are the drives that the outcomes are of.
    shipped = load(SHIPPED)
    assert torch.equal(shipped.arrived[:, rows], result.metrics["success"].T)


def test_the_shipped_outcomes_are_of_the_shipped_policy_and_its_scenes():
    """Where not: python -m recipes.choices.outcomes"""
    setting = trained_in(load_policy(SHIPPED_POLICY).card).with_one_robot.with_one_human
    request = request_of(SHIPPED)
    assert request["policy"] == file_checksum(SHIPPED_POLICY / "policy.safetensors")
    assert request["setting"] == str(setting)
    start = first_moments(SHIPPED_POLICY, setting)
    shipped = load(SHIPPED)
    torch.testing.assert_close(shipped.scenes["boxes"], start["scene", "boxes"])
    torch.testing.assert_close(shipped.scenes["start"], start["pose"])


def test_who_knows_any_robot_and_all_sorts_of_people_is_asked_about_in_scenes_of_the_page(
    tmp_path, monkeypatch
):
    """On a TurtleBot 2 and with one human who stands: what a page shows."""
    folder = any_robot.save(
        tmp_path / "any",
        scene="everyday",
        demonstrator={"radius": 1.0, "side": "left", "speed": 0.5},
    )
    policy = load_policy(folder)
    # Few drives and short ones: that of one preference stands for all.
    monkeypatch.setattr(outcomes, "NUM_SCENES", 2)
    monkeypatch.setattr(rollouts, "MAX_STEPS", 2)
    monkeypatch.setattr(
        type(policy.preference_space), "lattice", lambda self, _: self.corners()[:1]
    )
    held = choices(folder, drives=tmp_path)
    (file,) = tmp_path.glob("*.safetensors")
    assert file.name.split("_")[1] == "static"
    assert len(held["scenes"]) == 2
    assert {scene["human_speed"] for scene in held["scenes"]} == {0.0}


def test_a_policy_without_demonstrator_is_not_asked_about(monkeypatch):
    """How much like recorded demonstrations its drives are is not measured."""
    monkeypatch.setattr("recipes.page.choices.demonstrator", lambda *_: None)
    assert choices(SHIPPED_POLICY) is None
