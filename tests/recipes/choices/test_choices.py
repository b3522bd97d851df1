"""The command as a person uses it, on drives of a policy that is quick to simulate."""

from __future__ import annotations

import dataclasses
import json

import pytest
import torch

from recipes.choices import __main__ as command
from recipes.choices.dialogue import Dialogue
from recipes.choices.people import KINDS, Drives, Person, in_units, people, units_of
from recipes.choices.rollouts import Request, described, joint_outcomes, load, raw_outcomes, save
from recipes.choices.trials import AFTER, Mind, Place, asked, compared, stated
from recipes.evaluation.setting import choose
from recipes.evaluation.sweep import sweep
from tests._sweeps import BEND, SPACE, is_png
from torchrl_morl.choices import PreferencePosterior, standardize

REQUEST = Request(policy="0" * 64, setting="scene static", scenes=6, seed=31, divisions=4)


@pytest.fixture(scope="module")
def drives():
    result = sweep(
        BEND, SPACE, SPACE.lattice(4), episodes=6, seed=31, max_episode_steps=120, num_threads=1
    )
    # It drives through anything; what a dialogue needs are drives that arrived.
    metrics = result.metrics.clone()
    metrics["success"] = torch.ones_like(metrics["success"])
    metrics["time"] = metrics["path_length"] / 0.5
    return dataclasses.replace(result, metrics=metrics)


@pytest.fixture
def quick(drives, monkeypatch):
    """The command with those drives instead of the shipped policy's."""
    setting = command.obtain.__globals__["choose"]({})

    def obtain(policy, scene, **_):
        return drives, setting

    monkeypatch.setattr(command, "obtain", obtain)


def run(monkeypatch, *arguments):
    monkeypatch.setattr("sys.argv", ["choices", *map(str, arguments)])
    command.main()


def test_drives_are_what_was_saved(tmp_path, drives):
    path = REQUEST.file(tmp_path)
    save(path, drives, REQUEST)
    loaded = load(path, REQUEST)
    assert loaded.preference_space == SPACE and torch.equal(loaded.preferences, drives.preferences)
    for part in ("metrics", "paths", "scenes"):
        one, other = getattr(loaded, part), getattr(drives, part)
        assert one.batch_size == other.batch_size
        for key in other.keys():
            torch.testing.assert_close(one[key], other[key], equal_nan=True)
    with pytest.raises(FileExistsError):
        save(path, drives, REQUEST)
    other = Request(policy="1" * 64, setting="scene static", scenes=6, seed=31, divisions=4)
    with pytest.raises(ValueError, match="holds other drives: its policy"):
        load(path, other)
    path.write_bytes(b"nothing")
    with pytest.raises(ValueError, match="holds no rollouts"):
        load(path, REQUEST)


def test_outcomes_are_better_where_the_metric_is(drives):
    raw = raw_outcomes(drives)
    assert raw.shape == (6, 5, 2)
    distance = drives.metrics["min_human_distance"].T
    torch.testing.assert_close(raw[..., 0], distance.clamp(max=2.0).float())
    assert (raw[..., 1] < 0).all()
    # Two places have one unit: what is twice as far apart in one of them counts twice.
    twice = drives.metrics.clone()
    twice["time"] = 2 * twice["time"]
    far = dataclasses.replace(drives, metrics=twice)
    near, far = (joint_outcomes({"near": drives, "far": far})[x] for x in ("near", "far"))
    torch.testing.assert_close(far[..., 1], 2 * near[..., 1])
    torch.testing.assert_close(far[..., 0], near[..., 0])


def test_where_nobody_is_a_drive_keeps_its_distance(drives):
    metrics = drives.metrics.clone()
    metrics["min_human_distance"][:, 2] = torch.nan
    raw = raw_outcomes(dataclasses.replace(drives, metrics=metrics))
    assert (raw[2, :, 0] == 2.0).all()
    assert raw.isfinite().all()


def test_a_scene_that_is_edited_is_driven_anew(tmp_path):
    fields = "start: [0, 0, 0]\ngoal: [{goal}, 0]\nhuman: [3, 1]\n"
    path, words = tmp_path / "room.yaml", []
    for goal in (6, 7):
        path.write_text(fields.format(goal=goal))
        words.append(described(choose({}, scene=str(path)), str(path)))
    assert words[0] != words[1] and all(one.startswith("scene room-") for one in words)
    files = {dataclasses.replace(REQUEST, setting=one).file(tmp_path) for one in words}
    assert len(files) == 2
    assert described(choose({}, scene="corridor"), "corridor").startswith("scene corridor,")


def test_three_answers_then_resumed(tmp_path, monkeypatch, capsys, quick):
    folder = tmp_path / "ann"
    run(monkeypatch, "--answers", "1,2,=", "--output", folder)
    printed = capsys.readouterr().out
    assert printed.count("question ") == 4 and "drive so: python -m recipes.evaluate" in printed
    assert "look at each picture" in printed and "1 left, 2 right" in printed
    said = [line for line in printed.splitlines() if line.startswith("  ")]
    assert said[0].strip() == command.COMMANDS and max(map(len, said)) <= 80
    assert is_png(folder / "question_01.png") and is_png(folder / "chosen.png")
    chosen = json.loads((folder / "preference.json").read_text())
    (entry,) = chosen["contexts"].values()
    assert chosen["answers"] == 3 and sum(entry["preference"].values()) == pytest.approx(1)
    assert 0 <= entry["expected_regret"] <= entry["regret_90_percent"] <= 1

    run(monkeypatch, "--answers", "u,n,1", "--resume", folder)
    answers = PreferencePosterior.load(folder / "answers.json").choices
    assert [choice.answer for choice in answers] == ["first", "second", "neither", "first"]


def test_resumed_asks_what_would_have_been_asked(tmp_path, drives):
    def dialogue(posterior):
        return Dialogue(tmp_path, {"static": drives}, {"static": 0.3}, posterior)

    one = dialogue(PreferencePosterior(SPACE.tunable, contexts=("static",)))
    context, question = one.ask()
    one.take(context, question, "first")
    again = dialogue(PreferencePosterior.load(tmp_path / "answers.json"))
    assert again.ask() == one.ask()
    success = drives.metrics["success"].clone()
    one.skip(*one.ask())
    assert again.ask() != one.ask()
    assert torch.equal(drives.metrics["success"], success)


def test_typed_answers_end_with_the_input(tmp_path, monkeypatch, capsys, quick):
    lines = iter(["what", "1", "q"])
    monkeypatch.setattr("builtins.input", lambda _: next(lines))
    run(monkeypatch, "--output", tmp_path / "one")
    assert "'what' is no answer" in capsys.readouterr().out
    assert PreferencePosterior.load(tmp_path / "one" / "answers.json").num_answers == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--answers", "1,left"], "'left' must be one of 1, 2, =, n, u, s"),
        (["--scene", "static", "static"], "names a scene twice"),
        (["--scene", "static", "../static.yaml"], "names a scene twice: static, static"),
        (["--resume", "."], "holds no choices of this command"),
        (
            ["--resume", ".", "--seed", "40"],
            "--seed is of a new dialogue, --resume . keeps its own",
        ),
        (["--seed", "0"], "Seed 0 draws scenes for training"),
        (["--resume", "nowhere"], "must be a folder, 'nowhere' does not exist"),
    ],
)
def test_mistakes_are_one_line(arguments, message, monkeypatch, capsys, quick, tmp_path):
    (tmp_path / "static.yaml").write_text("start: [0, 0, 0]\ngoal: [6, 0]\nhuman: [3, 1]\n")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    with pytest.raises(SystemExit):
        run(monkeypatch, *arguments)
    printed = capsys.readouterr()
    assert message in printed.err and printed.err.count("\n") == 1
    assert list((tmp_path / "here").iterdir()) == []


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("answers.json", {"objectives": ["a", "b"]}, "answers.json is of ('a', 'b')"),
        ("answers.json", {"choices": None}, "no state of a PreferencePosterior"),
        ("setting.json", {"scene": "static"}, "scene must be a list, got 'static'"),
    ],
)
def test_a_folder_that_was_edited_is_refused(
    file, change, message, tmp_path, monkeypatch, capsys, quick
):
    folder = tmp_path / "one"
    run(monkeypatch, "--answers", "1", "--questions", "1", "--output", folder)
    path = folder / file
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    before = {one.name: one.read_bytes() for one in folder.iterdir()}
    capsys.readouterr()
    with pytest.raises(SystemExit):
        run(monkeypatch, "--answers", "1", "--questions", "1", "--resume", folder)
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1
    assert {one.name: one.read_bytes() for one in folder.iterdir()} == before


def test_drives_that_never_arrive_are_one_line(tmp_path, monkeypatch, capsys, quick, drives):
    metrics = drives.metrics.clone()
    metrics["success"] = torch.zeros_like(metrics["success"])
    failed = dataclasses.replace(drives, metrics=metrics)
    setting = choose({})
    monkeypatch.setattr(command, "obtain", lambda *_, **__: (failed, setting))
    capsys.readouterr()
    with pytest.raises(SystemExit):
        run(monkeypatch, "--answers", "1", "--output", tmp_path / "one")
    said = capsys.readouterr().err
    assert "the drives of this policy cannot be compared: outcomes" in said
    assert said.count("\n") == 1


def test_an_old_folder_is_kept(tmp_path, monkeypatch, capsys, quick):
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(SystemExit):
        run(monkeypatch, "--answers", "1", "--output", tmp_path)
    assert "is not empty" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["note.txt"]


# --- simulated people


@pytest.fixture(scope="module")
def place():
    """Made-up drives: a demonstration, a distance and a time that a preference trades off."""
    random = torch.Generator().manual_seed(0)
    corners = torch.eye(3)
    middle = torch.tensor([[0.4, 0.3, 0.3], [0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5]])
    preferences = torch.cat((corners, middle))

    def drives(count):
        noise = 0.1 * torch.randn(count, len(preferences), 3, generator=random).double()
        demo, far, fast = (preferences.double() + noise).unbind(-1)
        time = 20 - 4 * fast
        return Drives(
            frechet=(1.2 - demo).clamp(min=0),
            distance=0.6 + far,
            near=3 - 2 * far,
            time=time,
            straight_time=torch.full_like(time, 15.0),
            irregularity=0.2 + 0.1 * far,
            arrived=torch.ones_like(time, dtype=torch.bool),
        )

    known, unseen = drives(10), drives(20)
    values = torch.stack((-known.frechet, known.distance, -known.time), -1).float()
    return Place(standardize(values), known.arrived, preferences, known, unseen)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_person_answers_and_is_seeded(kind, place):
    draw = [people(kind, 3, torch.Generator().manual_seed(1)) for _ in range(2)]
    for one, other in zip(*draw, strict=True):
        assert torch.equal(one.weights, other.weights) and one.threshold == other.threshold
        utility = in_units(one.utility(place.known, units_of(kind, place.known)))
        assert utility.std(1).square().mean().sqrt() == pytest.approx(1)
        best, worst = int(utility[0].argmax()), int(utility[0].argmin())
        sure = torch.Generator().manual_seed(0)
        said = [one.answer(utility[0], best, worst, sure) for _ in range(40)]
        assert said.count("first") > 20


def test_regret_falls_with_answers(place):
    weights = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64)
    person = Person("near", weights, weights, rationality=6.0, slip=0.0)
    mind = Mind(person, place)
    trial = asked(person, mind, place, 0, informative=True)
    assert len(trial.regret["best"]) == len(trial.claimed) == len(AFTER)
    assert trial.regret["best"][-1] < 0.05 < trial.claimed[0]
    assert compared(person, mind, place, 0, scenes=5)[-1] < 0.3
    assert stated(person, mind, 0, error=0.0) == 0.0
    # Far is best for them in all scenes alike, and near is worst: their utility misses nothing.
    assert mind.floor(0) == 0.0 and mind.regret(torch.tensor([1.0, 0.0, 0.0]), 0) > 0.9
