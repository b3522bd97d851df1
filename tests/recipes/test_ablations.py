"""Every ablation is an override of the recipes: what it changes, and that it trains."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from envs.demonstrations import CircleDemonstrator
from envs.policy_env import make_policy_env, observation_size
from envs.straight_drive import StraightDriveValue
from recipes.drex import drex, ranking, report
from recipes.drex.cloning import clone_behaviour, save_clone
from recipes.evaluation.setting import trained_in
from recipes.evaluation.sweep import sweep
from recipes.pd_morl import pd_morl
from recipes.training.agent import make_actor
from recipes.training.loss import make_loss
from recipes.training.replay import make_replay_buffer, prefill
from recipes.training.task import make_preference_space, make_train_env
from tests._drex import TINY, config
from tests._task import make_task
from torchrl_morl import PreferenceSegments
from torchrl_morl.data import load_demonstrations
from torchrl_morl.deploy import load_policy, load_reward_model
from torchrl_morl.deploy.features import OBSERVATION_SIZE
from torchrl_morl.modules import RewardModel
from torchrl_morl.objectives import MOTD3Loss

DREX = (*TINY, "style_negatives.rollouts=0", "diagnostics.rollouts=2", "cloning.updates=50")
TRAINING = (
    "collector.total_frames=384",
    "collector.init_random_frames=192",
    "collector.frames_per_batch=96",
    "evaluation.interval=384",
    "evaluation.episodes=2",
    "replay_buffer.batch_size=16",
    "replay_buffer.size=4000",
    "network.num_cells=[16,16]",
    "env.max_episode_steps=20",
    "optim.updates_per_batch=2",
    "logger.interval=96",
    "logger.backends=[csv]",
    "compute.compile=false",
)


def train(recipe, cfg: DictConfig, folder: Path) -> Path:
    """Run a recipe as its command does, in this process, which has paid for its imports."""
    folder.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        run = SimpleNamespace(runtime=SimpleNamespace(output_dir=str(folder)))
        patch.setattr(HydraConfig, "get", lambda: run)
        recipe.main.__wrapped__(cfg)
    return folder


def morl(folder: Path, *overrides: str) -> Path:
    return train(pd_morl, config("pd_morl", (*TRAINING, *overrides)), folder)


# --- without the human's position


def test_without_the_human_the_rest_of_the_observation_is_the_same():
    envs = [
        make_policy_env(num_envs=5, num_threads=1, seed=3, observe_human=observe)
        for observe in (True, False)
    ]
    for env in envs:
        check_env_specs(env)
        env.base_env.set_seed(3)
    torch.manual_seed(0)
    action = torch.rand(5, 4, 2) * 2 - 1
    with_human, without = (env.reset() for env in envs)
    for step in range(4):
        assert with_human["observation"].shape == (5, 36)
        assert without["observation"].shape == (5, 33)
        assert torch.equal(with_human["observation"][:, :33], without["observation"])
        with_human, without = (
            env.step(data.set("action", action[:, step]))["next"]
            for env, data in zip(envs, (with_human, without), strict=True)
        )
    assert observation_size({"observe_human": False, "scene": "static"}) == 33
    assert observation_size({}) == OBSERVATION_SIZE == 36


def test_what_is_observed_is_true_or_false():
    with pytest.raises(ValueError, match="observe_human must be true or false, got 'no'"):
        make_policy_env(observe_human="no")


WITHOUT_ACTION = "reward_model.inputs=[lidar,goal,human]"
WITHOUT_HUMAN = "env.observe_human=false"


@pytest.mark.parametrize(
    ("overrides", "keys", "size", "hidden"),
    [
        ((), ["observation", "action"], 38, []),
        ((WITHOUT_ACTION,), ["observation"], 36, []),
        ((WITHOUT_HUMAN,), ["observation", "action"], 35, []),
        ((WITHOUT_HUMAN, WITHOUT_ACTION), ["observation"], 33, []),
        (("reward_model.inputs=[lidar,goal]",), ["observation"], 36, [33, 34, 35]),
        ((WITHOUT_HUMAN, "reward_model.inputs=[lidar]"), ["observation"], 33, [30, 31, 32]),
    ],
)
def test_reward_model_knows_what_the_override_leaves_it(overrides, keys, size, hidden):
    cfg = config("drex", (*DREX, *overrides))
    model = ranking.make_reward_model(cfg)
    assert model.in_keys == keys
    assert model.module.members[0][0].in_features == size
    assert ranking.hidden_entries(cfg) == hidden


def test_reward_model_of_a_human_that_is_not_observed_is_refused():
    cfg = config("drex", (WITHOUT_HUMAN, "reward_model.inputs=[human]"))
    with pytest.raises(ValueError, match="inputs must be some of"):
        ranking.hidden_entries(cfg)


def test_both_ablations_from_demonstrations_to_an_evaluated_policy(tmp_path, monkeypatch):
    cfg = config("drex", (*DREX, WITHOUT_HUMAN, WITHOUT_ACTION))

    def short_report(folder, cfg, model, *_):
        report.heat_map(folder / "heat_map.png", cfg, model)  # the part that depends on them
        return {}

    monkeypatch.setattr(drex, "write_report", short_report)
    distilled = train(drex, cfg, tmp_path / "drex")
    dataset, reward_model = distilled / "demonstrations.safetensors", distilled / "reward_model"
    data, _ = load_demonstrations(dataset)
    assert data["observation"].shape[-1] == 33
    model, _ = load_reward_model(reward_model)
    assert model.in_keys == ["observation"]

    demonstrations = (
        f"demonstrations.reward_model={reward_model}",
        f"demonstrations.dataset={dataset}",
        "demonstrations.prefill=4",
    )
    folder = morl(tmp_path / "run", *demonstrations, WITHOUT_HUMAN)
    for policy in (folder / "policies" / "000000384", distilled / "behaviour_clone"):
        loaded = load_policy(policy)
        assert loaded.preference_space.tunable == ("demo", "distance", "efficiency")
        assert loaded.actor[0].module[0].in_features == 33 + 3
        assert trained_in(loaded.card).observed["observe_human"] is False
        assert loaded.card["demonstrator"]["radius"] == 1.0
        kwargs = {"episodes": 2, "seed": 0, "max_episode_steps": 5, "num_threads": 1}
        demonstrator = CircleDemonstrator(**loaded.card["demonstrator"])
        result = sweep(
            loaded.actor,
            loaded.preference_space,
            loaded.preference_space.corners(),
            demonstrator=demonstrator,
            **kwargs,
            **trained_in(loaded.card).observed,
        )
        assert result.metrics["frechet"].isfinite().all()

    # What was made with another observation is refused before anything is written.
    with pytest.raises(ValueError, match="about observations of 33 entries, here they have 36"):
        morl(tmp_path / "refused", *demonstrations)
    assert not list((tmp_path / "refused").iterdir())
    other = config("pd_morl", (f"demonstrations.dataset={dataset}",))
    with pytest.raises(ValueError, match=r"demonstrations\.safetensors is about observations"):
        prefill(other, make_task(loaded.preference_space, reward_model=model), None)


def test_the_saved_clone_does_what_the_clone_does_under_every_preference(tmp_path):
    cfg = config("drex", ("cloning.num_cells=[16,16]", "cloning.updates=20"))
    data = TensorDict(
        observation=torch.rand(4, 10, OBSERVATION_SIZE),
        action=torch.rand(4, 10, 2),
        mask=torch.ones(4, 10, dtype=torch.bool),
        batch_size=[4, 10],
    )
    clone, _ = clone_behaviour(cfg, data)
    save_clone(tmp_path, cfg, clone, {"note": 1})
    policy = load_policy(tmp_path)
    assert policy.card["note"] == 1
    expected = clone(data.select("observation"))["action"]
    for preference in policy.preference_space.corners():
        given = data.select("observation").set("preference", preference.expand(4, 10, 3))
        torch.testing.assert_close(policy.actor(given)["action"], expected)


def test_cards_that_do_not_tell_observe_the_human():
    assert (
        trained_in({}).observed
        == trained_in({"config": {"env": {"scene": "static"}}}).observed
        == {}
    )


def test_a_reward_model_of_the_state_alone_scores_any_action_alike():
    model = RewardModel(in_features=OBSERVATION_SIZE, in_keys=["observation"], num_cells=(8,))
    env = make_policy_env(num_envs=3, num_threads=1, seed=0, reward_model=model)
    check_env_specs(env)
    data = env.reset()
    expected = 10 * (model(data.select("observation"))["demo_score"] - 1)
    for value in (-0.9, 0.9):
        stepped = env.step(data.clone().set("action", torch.full((3, 2), value)))
        torch.testing.assert_close(stepped["next", "reward"][:, 1:2], expected)


# --- other robots, humans and faults

VARIANTS = {
    "moving humans": (
        "env.scene=mixed",
        "evaluation.scene=mixed",
        "env.observe_human_velocity=true",
    ),
    "random faults": (
        "env.faults.range_noise=[0,0.05]",
        "env.faults.dropout=[0,0.1]",
        "env.faults.velocity_noise=[0,0.05]",
        "env.faults.latency=[0,1]",
        "env.robot=hsr",
    ),
}


@pytest.mark.parametrize("name", VARIANTS)
def test_variant_trains_and_is_evaluated_elsewhere(name, tmp_path):
    folder = morl(tmp_path / "run", *VARIANTS[name])
    policy = load_policy(folder / "policies" / "000000384")
    kwargs = {"episodes": 2, "seed": 0, "max_episode_steps": 5, "num_threads": 1}
    result = sweep(
        policy.actor,
        policy.preference_space,
        policy.preference_space.corners(),
        scene="moving_human",
        **kwargs,
        **trained_in(policy.card).observed,
    )
    assert result.metrics.shape == (2, 2)


# --- ingredients of PD-MORL

INGREDIENTS = {
    "angle off": ("loss.angle=null", "loss.angle_coeff_actor=0"),
    "official angle": ("loss.angle=raw", "loss.angle_coeff_actor=1.75e-3"),
    "official angle, raw preference": (
        "loss.angle=raw",
        "loss.angle_coeff_actor=1.75e-3",
        "loss.interpolated=false",
    ),
    "raw preference": ("loss.interpolated=false",),
    "no relabelling": ("preference.relabel_ratio=0",),
    "no segments": ("preference.num_segments=1",),
    "elementwise minimum": ("loss.target_selection=elementwise",),
    "critics learn the whole value": ("network.straight_drive=false",),
    "starts of the evaluation": ("env.scene=static",),
}


@pytest.mark.parametrize("name", INGREDIENTS)
def test_ingredient_of_pd_morl_trains(name, tmp_path):
    folder = morl(tmp_path / "run", *INGREDIENTS[name])
    policy = load_policy(folder / "policies" / "000000384")
    for override in INGREDIENTS[name]:
        section, key = override.split("=")[0].split(".")
        asked = OmegaConf.from_dotlist([override])
        assert policy.card["config"][section][key] == asked[section][key]
    scalars = {path.stem for path in (folder / "log_csv" / "scalars" / "train").glob("*.csv")}
    assert {"loss_actor", "loss_qvalue"} <= scalars
    assert ("angle" in scalars) == (name != "angle off")


def loss_of(*overrides: str) -> MOTD3Loss:
    cfg = config("pd_morl", (*TRAINING, *overrides))
    task = make_task(make_preference_space(with_demonstrations=False))
    return make_loss(cfg, task, make_actor(cfg, task))


def test_critics_add_what_straight_driving_is_worth():
    losses = []
    for override in ("network.straight_drive=true", "network.straight_drive=false"):
        torch.manual_seed(0)
        losses.append(loss_of(override))
    data = TensorDict(
        observation=torch.rand(5, OBSERVATION_SIZE),
        preference=torch.full((5, 2), 0.5),
        action=2 * torch.rand(5, 2) - 1,
        batch_size=5,
    )
    values = [loss._all_qvalues(data, loss.qvalue_network_params) for loss in losses]
    value = StraightDriveValue(("core", "distance", "efficiency"), gamma=0.998, reward_scale=0.01)
    expected = value(data["observation"]).expand(2, 5, 3)
    torch.testing.assert_close(values[0] - values[1], expected, rtol=1e-4, atol=1e-5)
    trained = [dict(loss.qvalue_network_params.flatten_keys()) for loss in losses]
    assert len(trained[0]) == len(trained[1])


def test_the_direction_of_the_angle_is_what_the_override_says():
    # Returns of the policies of the corners, distance and efficiency: penalties.
    solutions = torch.tensor([[0.0, -4.0], [-3.0, -3.0]])
    preference = torch.tensor([1.0, 0.0])
    default, raw, official = (
        loss_of(*overrides).interpolator
        for overrides in ((), INGREDIENTS["raw preference"], INGREDIENTS["official angle"])
    )
    for interpolator in (default, raw, official):
        interpolator.refit(solutions)
    # Normalised, the first corner is the best in distance and the worst in efficiency.
    torch.testing.assert_close(default(preference), torch.tensor([1.0, 0.0]))
    torch.testing.assert_close(default(torch.tensor([0.5, 0.5])), torch.tensor([0.5, 0.5]).sqrt())
    # Straight along the preference, in the same normalised space.
    torch.testing.assert_close(raw(torch.tensor([0.6, 0.8])), torch.tensor([0.6, 0.8]))
    assert torch.equal(raw.normalize(solutions), default.normalize(solutions))
    # The official code takes returns as they are.
    torch.testing.assert_close(official(preference), torch.tensor([0.0, -1.0]))
    assert torch.equal(official.normalize(solutions), solutions)


def test_angle_off_needs_coefficients_of_zero(tmp_path):
    with pytest.raises(ValueError, match="an angle coefficient has no effect"):
        morl(tmp_path / "run", "loss.angle=null")
    assert not list((tmp_path / "run").iterdir())


def test_segments_and_relabelling_follow_their_overrides():
    preference_space = make_preference_space(with_demonstrations=True)
    thirds = torch.arange(30) % 3
    for count, kept in ((3, True), (1, False)):
        cfg = config("pd_morl", (f"preference.num_segments={count}", "env.num_envs=30"))
        drawn = make_train_env(cfg, preference_space, None).reset()["preference"]
        assert torch.equal(PreferenceSegments(preference_space, 3).index(drawn), thirds) == kept
    preference = preference_space.sample(4)
    given = {tuple(row) for row in preference.tolist()}
    for ratio in (0, 1):
        cfg = config("pd_morl", (f"preference.relabel_ratio={ratio}",))
        buffer = make_replay_buffer(cfg, make_task(preference_space))
        later = TensorDict(preference=preference, reward=torch.ones(4, 4), batch_size=4)
        buffer.extend(TensorDict(preference=preference, next=later, batch_size=4).clone())
        sampled = {tuple(row) for row in buffer.sample()["preference"].tolist()}
        assert sampled <= given if ratio == 0 else not sampled & given
