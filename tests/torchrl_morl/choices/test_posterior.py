"""The posterior against closed forms, and what it survives."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math

import pytest
import torch

from torchrl_morl.choices import (
    ANSWERS,
    ChoiceModel,
    PreferencePosterior,
    best_preference,
    information,
    next_question,
    standardize,
    value_of_information,
)
from torchrl_morl.choices.grid import context_log_posterior, resemblance
from torchrl_morl.preferences import PreferenceSpace

PLAIN = ChoiceModel(rationalities=(2.0,), chance=0.0, slip=0.0, tie=0.0, neither=0.0)
TWO = ("distance", "efficiency")


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


class TestModel:
    def test_two_answers_are_bradley_terry(self):
        chances = PLAIN.probabilities(
            torch.tensor(0.7), torch.tensor(-0.2), torch.tensor(2.0)
        ).tolist()
        assert chances[0] == pytest.approx(1 / (1 + math.exp(-1.8)))
        assert chances[2:] == [0.0, 0.0] and sum(chances) == pytest.approx(1)

    def test_ties_and_neither_by_hand(self):
        model = ChoiceModel(slip=0.1, tie=0.5, neither=0.25)
        u, v, b = 1.0, 0.0, 2.0
        odds = [math.exp(b * u), 1.0, 0.5 * math.exp(b * (u + v) / 2), 0.25]
        expected = [0.9 * one / sum(odds) + 0.025 for one in odds]
        found = model.probabilities(torch.tensor(u), torch.tensor(v), torch.tensor(b))
        torch.testing.assert_close(found, torch.tensor(expected))

    def test_two_bad_alternatives_are_refused(self):
        bad, good = torch.tensor(-2.0), torch.tensor(2.0)
        share = [
            float(ChoiceModel().probabilities(x, x, torch.tensor(2.0))[3]) for x in (bad, good)
        ]
        assert share[0] > 0.5 > 0.05 > share[1]

    def test_large_utilities_overflow_nothing(self):
        found = ChoiceModel().probabilities(
            torch.tensor(1e4), torch.tensor(-1e4), torch.tensor(4.0)
        )
        assert found.isfinite().all() and found[0] > 0.9

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"slip": 1.0}, "slip must be at least 0 and below 1, got 1.0"),
            ({"chance": -0.1}, "chance must be at least 0"),
            ({"half_life": 0}, "half_life must be finite and above 0, or None, got 0"),
            ({"tie": -1.0}, "tie must be finite"),
            ({"rationalities": ()}, "at least one number"),
            ({"rationalities": (1.0, 0.0)}, r"rationalities\[1\] must be finite and above 0"),
        ],
    )
    def test_invalid(self, change, message):
        with pytest.raises(ValueError, match=message):
            ChoiceModel(**change)


class TestExact:
    def test_one_answer_by_hand(self):
        posterior = PreferencePosterior(TWO, model=PLAIN, divisions=2)
        posterior.answer([1.0, 0.0], [0.0, 1.0], "first")
        # Weights (0, 1), (1/2, 1/2), (1, 0) with differences -1, 0, 1 of the utilities.
        likelihood = [1 / (1 + math.exp(2)), 0.5, 1 / (1 + math.exp(-2))]
        expected = torch.tensor(likelihood, dtype=torch.float64) / sum(likelihood)
        torch.testing.assert_close(posterior.probability(), expected)
        assert float(posterior.mean()[0]) == pytest.approx(
            float(expected @ posterior.weights[:, 0])
        )

    def test_order_does_not_matter_and_undo_is_exact(self):
        questions = [
            ([1, 0], [0, 1], "first"),
            ([2, 0], [0, 1], "tie"),
            ([0, 1], [0, 0], "neither"),
        ]
        forever = ChoiceModel(half_life=None)
        one, other = (PreferencePosterior(TWO, model=forever) for _ in range(2))
        for question in questions:
            one.answer(*question)
        for question in reversed(questions):
            other.answer(*question)
        torch.testing.assert_close(one.probability(), other.probability())
        before = PreferencePosterior(TWO, model=forever)
        before.answer(*questions[0])
        one.undo(), one.undo()
        assert torch.equal(one.probability(), before.probability())
        one.undo()
        with pytest.raises(ValueError, match="no answer to undo"):
            one.undo()

    def test_contradictions_leave_the_middle_and_doubt(self):
        forever = ChoiceModel(half_life=None)
        clear, torn = (PreferencePosterior(TWO, model=forever) for _ in range(2))
        for turn in range(10):
            clear.answer([1, -1], [-1, 1], "first")
            torn.answer([1, -1], [-1, 1], "first" if turn % 2 else "second")
        assert torn.mean().tolist() == pytest.approx([0.5, 0.5], abs=1e-6)
        assert clear.mean()[0] > 0.8 and clear.chance() < 0.01 < torn.chance()

    def test_older_answers_count_less(self):
        model = ChoiceModel(rationalities=(2.0,), chance=0.0, slip=0.0, tie=0.0, neither=0.0)
        model = dataclasses.replace(model, half_life=1.0)
        posterior = PreferencePosterior(TWO, model=model, divisions=1)
        posterior.answer([1.0, 0.0], [0.0, 1.0], "first")
        posterior.answer([1.0, 0.0], [0.0, 1.0], "second")
        # Log odds of weights (1, 0) against (0, 1): 2 for each answer, halved for the older one.
        odds = math.log(float(posterior.probability()[1] / posterior.probability()[0]))
        assert odds == pytest.approx(0.5 * 2 - 2)

    def test_a_change_of_mind_is_followed(self):
        posterior = PreferencePosterior(TWO)
        for answer in ["first"] * 8 + ["second"] * 10:
            posterior.answer([1, -1], [-1, 1], answer)
        assert posterior.mean()[0] < 0.5

    def test_always_the_first_is_found_to_be_chance(self):
        # Asked what tells most, not what matters to the choice: that says less about chance.
        outcomes = torch.randn(20, 30, 3, generator=generator())
        posterior = PreferencePosterior(("a", "b", "c"))
        for number in range(20):
            draw = generator(number)
            scene = torch.randint(20, (100,), generator=draw)
            sides = [outcomes[scene, torch.randint(30, (100,), generator=draw)] for _ in range(2)]
            most = int(information(posterior, *sides).argmax())
            posterior.answer(sides[0][most], sides[1][most], "first")
        assert posterior.chance() > 0.5
        best = best_preference(posterior, outcomes, torch.eye(30))
        assert best.regret > 0.1

    def test_a_new_posterior_is_uniform(self):
        posterior = PreferencePosterior(("a", "b", "c"))
        torch.testing.assert_close(posterior.mean(), torch.full((3,), 1 / 3, dtype=torch.float64))
        assert posterior.chance() == pytest.approx(0.1)


class TestContexts:
    def test_kernels_have_uniform_margins(self):
        lattice = PreferenceSpace(("a", "b", "c")).lattice(8).double()
        kernel = resemblance(lattice, 0.2)
        torch.testing.assert_close(kernel.sum(0), torch.ones(len(lattice), dtype=torch.float64))
        torch.testing.assert_close(kernel, kernel.T)

    def test_an_answer_tells_less_about_the_other_context(self):
        posterior = PreferencePosterior(TWO, contexts=("open", "corridor", "empty"))
        for _ in range(4):
            posterior.answer([1, -1], [-1, 1], "first", "open")
        here, there, elsewhere = (float(posterior.mean(x)[0]) for x in posterior.contexts)
        assert here > there > 0.55 and there == pytest.approx(elsewhere)

    def test_contexts_that_differ_are_told_apart(self):
        posterior = PreferencePosterior(TWO, contexts=("open", "corridor"))
        for _ in range(6):
            posterior.answer([1, -1], [-1, 1], "first", "open")
            posterior.answer([1, -1], [-1, 1], "second", "corridor")
        assert posterior.mean("open")[0] > 0.7 > 0.3 > posterior.mean("corridor")[0]

    def test_exact_sums_agree_with_brute_force(self):
        weights, rationalities, spreads = 4, 2, (0.0, 0.3)
        lattice = PreferenceSpace(TWO).lattice(weights - 1).double()
        kernels = torch.stack([resemblance(lattice, spread) for spread in spreads])
        like = torch.rand(3, weights, rationalities, generator=generator()).double()
        prior = torch.tensor([0.3, 0.7], dtype=torch.float64)
        total = torch.zeros(3, weights, rationalities, dtype=torch.float64)
        for kernel, general, *places, r in itertools.product(
            kernels, range(weights), *3 * [range(weights)], range(rationalities)
        ):
            joint = prior[r]
            for context, place in enumerate(places):
                joint = joint * kernel[general, place] * like[context, place, r]
            for context, place in enumerate(places):
                total[context, place, r] += joint
        found = context_log_posterior(like.log(), prior.log(), kernels).exp()
        torch.testing.assert_close(found, total / total[0].sum())


class TestSampled:
    def test_samples_agree_with_the_grid(self, monkeypatch):
        names = ("a", "b", "c")
        exact = PreferencePosterior(names)
        monkeypatch.setattr("torchrl_morl.choices.posterior.LARGEST_GRID", 2)
        sampled = PreferencePosterior(names, seed=1)
        assert exact.exact and not sampled.exact
        random = torch.randn(12, 2, 3, generator=generator(2))
        for first, second in random:
            answer = "first" if first[0] > second[0] else "second"
            for posterior in (exact, sampled):
                posterior.answer(first, second, answer)
        torch.testing.assert_close(sampled.mean(), exact.mean(), atol=0.03, rtol=0)
        torch.testing.assert_close(sampled.deviation(), exact.deviation(), atol=0.03, rtol=0)
        assert sampled.chance() == pytest.approx(exact.chance(), abs=0.02)

    def test_six_objectives_are_found(self):
        posterior = PreferencePosterior(tuple("abcdef"))
        for one in torch.randn(25, 2, 6, generator=generator()):
            posterior.answer(*one, "first" if one[0, 4] > one[1, 4] else "second")
        assert int(posterior.mean().argmax()) == 4 and posterior.mean()[4] > 0.4

    def test_the_same_answers_give_the_same_samples(self):
        one = PreferencePosterior(tuple("abcde"), seed=3)
        for _ in range(6):
            one.answer([1, 0, 0, 0, 0], [0, 1, 0, 0, 0], "first")
        state = json.loads(json.dumps(one.state_dict()))
        other = PreferencePosterior.from_state_dict(state)
        assert torch.equal(one.weights, other.weights)
        assert torch.equal(one.probability(), other.probability())


class TestFiles:
    def test_saved_and_loaded(self, tmp_path):
        posterior = PreferencePosterior(TWO, contexts=("open", "corridor"))
        posterior.answer([1, 0], [0, 1], "second", "corridor")
        loaded = PreferencePosterior.load(posterior.save(tmp_path / "answers.json"))
        assert loaded.choices == posterior.choices
        assert torch.equal(loaded.probability("open"), posterior.probability("open"))
        assert [path.name for path in tmp_path.iterdir()] == ["answers.json"]

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"format": 9}, "its format is 9, not 1"),
            ({"objectives": None}, "NoneType"),
            ({"choices": [{"first": [1, 2]}]}, "no state of a PreferencePosterior"),
            ({"model": {"slip": 0.1}}, "'rationalities' is missing"),
        ],
    )
    def test_other_files_are_refused(self, tmp_path, change, message):
        state = PreferencePosterior(TWO).state_dict() | change
        path = tmp_path / "answers.json"
        path.write_text(json.dumps(state))
        with pytest.raises(ValueError, match=message):
            PreferencePosterior.load(path)
        path.write_text("{")
        with pytest.raises(ValueError, match=r"answers\.json"):
            PreferencePosterior.load(path)


class TestRefused:
    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (([1, 0], [0, 1], "left"), "answer must be one of .*got 'left'"),
            (([1, 0, 0], [0, 1], "first"), r"first must hold one outcome .*got shape \[3\]"),
            (([1, 0], [0, math.nan], "first"), "second must be finite"),
            (([1, 0], [0, 1], "first", "attic"), "context must be one of .*got 'attic'"),
        ],
    )
    def test_an_answer_that_does_not_fit_changes_nothing(self, arguments, message):
        posterior = PreferencePosterior(TWO)
        with pytest.raises(ValueError, match=message):
            posterior.answer(*arguments)
        assert posterior.num_answers == 0

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"objectives": "ab"}, "sequence of names"),
            ({"objectives": ("a", "a")}, "repeats 'a'"),
            ({"objectives": tuple("abcde"), "contexts": ("x", "y")}, "at most 4 objectives"),
            ({"objectives": TWO, "divisions": 0}, "divisions must be at least 1"),
        ],
    )
    def test_settings(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            PreferencePosterior(**arguments)


class TestQuestions:
    def test_information_by_hand(self):
        posterior = PreferencePosterior(TWO, model=PLAIN, divisions=1)
        # Two hypotheses, equally likely, that answer oppositely with sigmoid(2).
        p = 1 / (1 + math.exp(-2))
        expected = 1 + p * math.log2(p) + (1 - p) * math.log2(1 - p)
        assert float(information(posterior, [[1.0, 0.0]], [[0.0, 1.0]])) == pytest.approx(
            expected, abs=1e-5
        )

    def test_seeded_and_only_what_may_be_shown(self):
        outcomes = torch.randn(3, 6, 2, generator=generator())
        valid = torch.zeros(3, 6, dtype=torch.bool)
        valid[1, [2, 4]] = True
        posterior = PreferencePosterior(TWO)
        asked = [
            next_question(posterior, outcomes, valid=valid, generator=generator(1))
            for _ in range(2)
        ]
        assert asked[0] == asked[1] and asked[0].scene == 1
        assert {asked[0].first, asked[0].second} == {2, 4}
        with pytest.raises(ValueError, match="no two alternatives"):
            next_question(posterior, outcomes, valid=torch.zeros_like(valid))

    def test_what_is_known_is_not_asked_again(self):
        posterior = PreferencePosterior(TWO)
        before = information(posterior, [[1.0, -1.0]], [[-1.0, 1.0]])
        for _ in range(6):
            posterior.answer([1.0, -1.0], [-1.0, 1.0], "first")
        assert information(posterior, [[1.0, -1.0]], [[-1.0, 1.0]]) < before / 2


class TestValue:
    def test_by_hand(self):
        # Two people, equally likely, of whom each likes one preference alone: a blind choice satisfies
        # half of them, and an answer is right with sigmoid(2).
        posterior = PreferencePosterior(TWO, model=PLAIN, divisions=1)
        value = value_of_information(posterior, [[1.0, 0.0]], [[0.0, 1.0]], torch.eye(2))
        assert float(value) == pytest.approx(1 / (1 + math.exp(-2)) - 0.5)

    def test_a_question_that_cannot_change_the_choice_has_none(self):
        # The third preference is the best for everybody, whatever is answered.
        posterior = PreferencePosterior(TWO)
        outcomes = torch.tensor([[1.0, 0.0], [0.0, 1.0], [2.0, 2.0]])
        first, second = [[1.0, 0.0]], [[0.0, 1.0]]
        assert float(information(posterior, first, second)) > 0.1
        assert float(value_of_information(posterior, first, second, outcomes)) < 1e-12

    @pytest.mark.parametrize("size", [1, 2, 3, 4, 6])
    def test_is_the_rise_of_the_recommended_satisfaction(self, size):
        """Each answer is taken in, and the preference chosen anew: in a context of several, too."""
        model = ChoiceModel(half_life=None)
        contexts = ("open", "corridor") if size < 5 else ("open",)
        posterior = PreferencePosterior(
            tuple("abcdef"[:size]),
            contexts=contexts,
            model=model,
            divisions={3: 10, 4: 5}.get(size),
            particles=500,
        )
        draw = generator(size)
        outcomes = torch.randn(5, 8, size, generator=draw)
        pairs = torch.randn(4, 2, size, generator=draw)
        posterior.answer(*pairs[0], "first", contexts[0])
        value = value_of_information(
            posterior, pairs[:, 0], pairs[:, 1], outcomes, context=contexts[0]
        )
        utility = posterior.weights @ outcomes.double().mean(0).T
        utility = utility - utility.amin(1, keepdim=True)
        satisfied = utility / utility.amax(1, keepdim=True)
        prior = posterior.probability(contexts[0])
        for (first, second), found in zip(pairs.double(), value.tolist(), strict=True):
            chances = model.probabilities(
                posterior.weights @ first, posterior.weights @ second, posterior.rationality
            )
            joint = prior[:, None] * chances
            after = sum(float((joint[:, one] @ satisfied).max()) for one in range(4))
            assert found == pytest.approx(after - float((prior @ satisfied).max()), abs=1e-5)

    def test_where_no_answer_changes_the_choice_the_one_that_tells_most_is_asked(self):
        posterior = PreferencePosterior(TWO)
        outcomes = torch.tensor([[[1.0, 0.0], [0.9, 0.0], [0.0, 1.0], [2.0, 2.0]]])
        valid = torch.tensor([[True, True, True, False]])
        question = next_question(posterior, outcomes, valid=valid, generator=generator())
        assert question.value < 1e-12 and {question.first, question.second} == {0, 2}
        assert question.worth == pytest.approx(question.information / 100)

    def test_the_best_for_everybody_is_known_to_be_so(self):
        """Of a choice between two preferences, the answer about these two is worth most."""
        posterior = PreferencePosterior(("a", "b", "c"))
        outcomes = torch.tensor([[[1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [-2.0, -2.0, 0.0]]])
        question = next_question(posterior, outcomes, generator=generator())
        assert {question.first, question.second} == {0, 1}

    def test_a_question_is_typical_of_the_average(self):
        # In the last scene the two preferences have changed sides, further apart: an answer there
        # tells most, and about the other scenes the wrong way round.
        outcomes = torch.tensor([[[1.0, -1.0], [-1.0, 1.0]]] * 3 + [[[-2.0, 2.0], [2.0, -2.0]]])
        posterior = PreferencePosterior(TWO)
        scenes = {
            next_question(posterior, outcomes, typical=typical, generator=generator()).scene
            for typical in (0.3, 0.7)
        }
        assert scenes <= {0, 1, 2}
        assert next_question(posterior, outcomes, typical=1.0, generator=generator()).scene == 3

    @pytest.mark.parametrize("typical", [0.0, 1.5, math.nan, "all"])
    def test_share_of_typical_questions(self, typical):
        with pytest.raises(ValueError, match="typical must be above 0 and at most 1, got"):
            next_question(PreferencePosterior(TWO), torch.eye(2)[None], typical=typical)

    def test_shapes(self):
        with pytest.raises(ValueError, match="2 objectives in their last dimension"):
            value_of_information(PreferencePosterior(TWO), [[1, 0]], [[0, 1]], torch.zeros(3, 3))


class TestRecommendation:
    def test_rollouts_decide_and_not_the_weights(self):
        # A policy that exaggerates: at equal weights it already drives as if distance were all.
        outcomes = torch.tensor([[[1.0, -2.0], [0.9, -1.9], [0.2, 0.6], [-1.0, 1.0]]])
        preferences = torch.tensor([[1.0, 0.0], [0.5, 0.5], [0.1, 0.9], [0.0, 1.0]])
        posterior = PreferencePosterior(TWO)
        posterior.answer([1.0, -1.0], [-1.0, 1.0], "tie")
        best = best_preference(posterior, outcomes, preferences)
        assert best.index == 2 and posterior.mean().tolist() == pytest.approx([0.5, 0.5])
        assert 0 <= best.regret <= best.regret_high <= 1
        assert "90 %" in str(best)

    def test_a_known_person_gets_the_best(self):
        outcomes = torch.randn(50, 10, 3, generator=generator(4))
        model = ChoiceModel(rationalities=(8.0,), chance=0.0, slip=0.0)
        posterior = PreferencePosterior(("a", "b", "c"), model=model)
        weights = torch.tensor([0.6, 0.4, 0.0])
        for number in range(30):
            q = next_question(posterior, outcomes, candidates=100, generator=generator(number))
            pair = outcomes[q.scene, [q.first, q.second]]
            posterior.answer(*pair, "first" if (pair @ weights).argmax() == 0 else "second")
        best = best_preference(posterior, outcomes, torch.eye(10))
        utility = outcomes.mean(0) @ weights
        missed = (utility.max() - utility[best.index]) / (utility.max() - utility.min())
        assert missed < 0.05 and best.regret < 0.1

    def test_alike_preferences_miss_nothing(self):
        best = best_preference(PreferencePosterior(TWO), torch.zeros(2, 3, 2), torch.eye(3))
        assert best.regret == pytest.approx(0)

    def test_shapes(self):
        with pytest.raises(ValueError, match="2 objectives in their last dimension"):
            best_preference(PreferencePosterior(TWO), torch.zeros(2, 3, 3), torch.eye(3))
        with pytest.raises(ValueError, match=r"preferences must have shape \[3, T\]"):
            best_preference(PreferencePosterior(TWO), torch.zeros(2, 3, 2), torch.eye(4))


class TestStandardize:
    def test_unit_is_shared_by_scenes(self):
        found = standardize([[[0.0], [2.0]], [[10.0], [10.2]]])
        unit = math.sqrt((1 + 1 + 0.01 + 0.01) / 4)
        torch.testing.assert_close(
            found.flatten(), torch.tensor([-1, 1, -0.1, 0.1]) / unit, atol=1e-4, rtol=1e-4
        )

    def test_failures_are_as_bad_as_the_worst(self):
        values = torch.tensor([[[1.0], [3.0], [math.nan]]])
        found = standardize(values, [[True, True, False]])
        assert found.flatten().tolist() == [-1.0, 1.0, -1.0]
        with pytest.raises(ValueError, match="finite where they are valid"):
            standardize(values)
        with pytest.raises(ValueError, match="valid must be bool"):
            standardize(values, [[1, 1, 0]])

    def test_answers_have_the_order_of_probabilities(self):
        assert ANSWERS == ("first", "second", "tie", "neither")
