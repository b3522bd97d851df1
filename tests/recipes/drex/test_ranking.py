"""Pairs of snippets, and the reward models that learn from them: what each of them may know."""

from __future__ import annotations

import pytest
import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import check_env_specs

from envs.policy_env import make_policy_env
from recipes.drex import ranking, styles
from recipes.drex.cloning import clone_behaviour
from recipes.drex.demonstrations import collect_demonstrations
from recipes.drex.rollouts import noisy_rollouts
from recipes.training.replay import make_replay_buffer
from recipes.training.task import make_preference_space
from tests._drex import TINY, config
from tests._task import make_task
from torchrl_morl.data import RankedSnippets, save_demonstrations
from torchrl_morl.deploy import load_reward_model
from torchrl_morl.deploy.features import OBSERVATION_SIZE
from torchrl_morl.modules import RewardModel
from torchrl_morl.objectives import BradleyTerryLoss

# --- pairs


def group(number: int, count: int = 5, steps: int = 60) -> TensorDict:
    """Trajectories whose observation says who they are; they are near the human halfway."""
    step = torch.arange(steps, dtype=torch.float32).expand(count, steps)
    return TensorDict(
        {
            "observation": torch.stack((torch.full_like(step, number), step), dim=-1),
            "action": torch.zeros(count, steps, 2),
            "human": torch.stack(((step - 25).abs() / 5, torch.zeros_like(step)), dim=-1),
            "mask": torch.ones(count, steps, dtype=torch.bool),
        },
        batch_size=[count, steps],
    )


DEMONSTRATION, CLONE, NOISY, NOISIER, ORBIT, STRAIGHT = range(6)
NOISE = {DEMONSTRATION: 0.0, CLONE: -0.0, NOISY: -0.1, NOISIER: -0.2}


def test_styles_are_compared_with_undisturbed_driving_near_the_human():
    noisy = [(quality, group(number)) for number, quality in NOISE.items()]
    others = [group(ORBIT), group(STRAIGHT)]
    sources = ranking.ranked_snippets(config(reward_model__near_human=2.0), noisy, others)
    source = sources["style pairs"]
    pairs = source.sample(500)
    preferred, other = (pairs[key, "observation"][:, 0] for key in ("preferred", "other"))
    assert set(preferred[:, 0].tolist()) == {DEMONSTRATION, CLONE}
    assert set(other[:, 0].tolist()) == {ORBIT, STRAIGHT}
    for snippets in (preferred, other):
        assert set(snippets[:, 1].tolist()) == set(range(16, 35))  # within 2 m, see `group`


@pytest.mark.parametrize("others", [[], [group(ORBIT)]], ids=["plain", "extended"])
def test_noise_is_compared_with_less_noise_anywhere(others):
    noisy = [(quality, group(number)) for number, quality in NOISE.items()]
    cfg = config(reward_model__snippet_length=20, reward_model__min_gap=0.05)
    sources = ranking.ranked_snippets(cfg, noisy, others)
    assert len(sources) == 1 + bool(others)
    pairs = sources["noise pairs"].sample(500)
    preferred, other = (pairs[key, "observation"][:, 0] for key in ("preferred", "other"))
    combinations = {
        (int(better), int(worse))
        for better, worse in zip(preferred[:, 0], other[:, 0], strict=True)
    }
    expected = {(i, j) for i, a in NOISE.items() for j, b in NOISE.items() if a > b}
    assert combinations == expected
    assert set(preferred[:, 1].tolist()) == set(range(41))


def test_accuracy_on_held_out_pairs_for_every_gap():
    """R of five groups is known: which of their combinations it ranks right, and which not."""
    levels = (0.0, 0.2, 0.35, 0.5, 0.7)
    score = torch.tensor([0.9, 0.5, 0.7, 0.3, 0.4])  # wrong about 0.2 - 0.35 and 0.5 - 0.7
    network = TensorDictModule(
        lambda observation: score[observation[..., :1].long()],
        in_keys=["observation"],
        out_keys=["demo_score"],
    )
    noisy = [(-level, group(number)) for number, level in enumerate(levels)]
    source = RankedSnippets(noisy, length=20, min_gap=0.15, seed=0)
    style = RankedSnippets([(0.0, group(0)), (-1.0, group(1))], length=20, seed=0)
    scores = ranking.held_out_accuracy(
        BradleyTerryLoss(network), {"noise pairs": source, "style pairs": style}
    )
    assert scores["held_out_accuracy noise pairs"] == pytest.approx(0.8, abs=0.05)
    assert scores["held_out_accuracy style pairs"] == 1.0
    per_gap = scores["held_out_accuracy per noise gap"]
    expected = {"0.15": 1 / 2, "0.2": 1 / 2, "0.3": 1, "0.35": 1, "0.5": 1, "0.7": 1}
    assert list(per_gap) == list(expected)
    for gap, accuracy in expected.items():
        # About 1,600 pairs of these two gaps.
        assert per_gap[gap] == (1 if accuracy == 1 else pytest.approx(accuracy, abs=0.06))


# --- reward models

INPUTS = {
    "all": ["lidar", "goal", "human", "action"],
    "RM": ["lidar", "goal", "human"],
    "NH": ["lidar", "goal", "action"],
    "RM-NH": ["lidar", "goal"],
}
ENTRIES = {"lidar": slice(0, 30), "goal": slice(30, 33), "human": slice(33, 36)}


@pytest.fixture(scope="module")
def driven() -> tuple[TensorDictBase, dict[str, RankedSnippets]]:
    """A few demonstrations and the pairs that follow from them."""
    cfg = config(overrides=TINY)
    demonstrations = collect_demonstrations(cfg)
    policy, _ = clone_behaviour(cfg, demonstrations)
    noisy = [(0.0, demonstrations), *noisy_rollouts(cfg, policy)]
    return demonstrations, ranking.ranked_snippets(cfg, noisy, styles.other_styles(cfg))


def distill(cfg: DictConfig, driven: tuple[TensorDictBase, dict[str, RankedSnippets]], folder):
    """Train, save and load."""
    torch.manual_seed(cfg.seed)
    model, scores = ranking.train_reward_model(cfg, driven[1])
    ranking.save_model(folder, cfg, model, scores)
    return load_reward_model(folder)


@pytest.fixture(scope="module", params=[*INPUTS, "ensemble"])
def variant(request, driven, tmp_path_factory) -> tuple[list[str], RewardModel, dict]:
    """What it may know, the reward model and its card."""
    inputs = INPUTS.get(request.param, INPUTS["all"])
    cfg = config(overrides=TINY, reward_model__inputs=inputs, reward_model__lr=1e-2)
    cfg.reward_model.num_members = 3 if request.param == "ensemble" else 1
    folder = tmp_path_factory.mktemp("variant") / "reward_model"
    return inputs, *distill(cfg, driven, folder)


def test_a_reward_model_depends_on_its_inputs_alone(variant, driven):
    inputs, model, card = variant
    assert card["config"]["reward_model"]["inputs"] == inputs
    data = driven[0].select("observation", "action")[driven[0]["mask"]]
    score = model(data.clone())["demo_score"]
    assert 0 < score.min() < score.max() < 1
    for part, entries in ENTRIES.items():
        other = data.clone()
        other["observation"][:, entries] += 0.1
        assert torch.equal(model(other)["demo_score"], score) == (part not in inputs), part
    other = data.clone()
    other["action"] *= -1
    assert torch.equal(model(other)["demo_score"], score) == ("action" not in inputs)
    assert model.in_keys == ["observation", *(["action"] if "action" in inputs else [])]


def test_an_ensemble_has_as_many_members_as_asked_for(variant):
    _, model, card = variant
    assert len(model.module.members) == card["config"]["reward_model"]["num_members"]


def test_environment_and_replay_buffer_pay_the_same(variant, driven, tmp_path):
    _, model, _ = variant
    preference_space = make_preference_space(with_demonstrations=True)
    env = make_policy_env(reward_model=model, scene="empty", num_envs=2, num_threads=1, seed=0)
    check_env_specs(env)
    data = env.rollout(5)
    score = model(data.select("observation", "action"))["demo_score"]
    torch.testing.assert_close(data["next", "reward"][..., 1:2], 10 * (score - 1))
    env.close()

    file = save_demonstrations(tmp_path / "demonstrations.safetensors", driven[0], {})
    cfg = config("pd_morl", demonstrations__dataset=str(file), demonstrations__prefill=2)
    cfg.replay_buffer.size = 1000
    buffer = make_replay_buffer(cfg, make_task(preference_space, reward_model=model))
    score = model(driven[0][:2].select("observation", "action"))["demo_score"]
    expected = 10 * (score[driven[0][:2]["mask"]] - 1)
    torch.testing.assert_close(buffer.storage[:]["next", "reward"][:, 1:2], expected)


def test_the_full_reward_model_is_the_librarys():
    """With the same weights from the same seed."""
    cfg = config()
    torch.manual_seed(3)
    model = ranking.make_reward_model(cfg)
    torch.manual_seed(3)
    expected = RewardModel(in_features=OBSERVATION_SIZE + 2)
    assert model.in_keys == expected.in_keys
    for value, other in zip(
        model.state_dict().values(), expected.state_dict().values(), strict=True
    ):
        assert torch.equal(value, other)


def test_training_is_that_of_a_network_without_the_hidden_entries(driven):
    """What R must not know, it cannot learn from either: other values of it change nothing."""
    cfg = config(overrides=TINY, reward_model__inputs=INPUTS["NH"])
    groups = [(quality, group(number)) for number, quality in NOISE.items()]
    models = []
    for shift in (0.0, 1.0):
        torch.manual_seed(0)
        for number, (_, data) in enumerate(groups):
            generator = torch.Generator().manual_seed(number)
            seen = torch.randn(5, 60, OBSERVATION_SIZE, generator=generator)
            seen[..., ENTRIES["human"]] += shift * number
            data["observation"] = seen
        model, _ = ranking.train_reward_model(cfg, ranking.ranked_snippets(cfg, groups, []))
        models.append(model.state_dict())
    for name, value in models[0].items():
        assert torch.equal(value, models[1][name]), name


@pytest.mark.parametrize("inputs", [[], ["position"], ["lidar", "actions"]])
def test_inputs_must_exist(inputs):
    with pytest.raises(
        ValueError,
        match=r"must be some of .*'lidar', 'goal', 'human', 'human_velocity', 'nobody', 'robot', 'action'",
    ):
        ranking.make_reward_model(config(reward_model__inputs=inputs))
