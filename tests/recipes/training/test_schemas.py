"""The schemas of the recipes: each field of each YAML, and what they refuse."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

import recipes
from recipes.drex.schema import Config as DREX
from recipes.mo_ppo.schema import Config as MO_PPO
from recipes.pd_morl.schema import Config as PD_MORL
from recipes.scalarized.schema import SACConfig, TD3Config
from recipes.training.allowed import leaves
from recipes.training.validation import ConfigurationError, validate

ROOT = Path(recipes.__file__).parent
RECIPES = {
    "pd_morl": (PD_MORL, "config", "pd_morl"),
    "mo_ppo": (MO_PPO, "config", "mo_ppo"),
    "drex": (DREX, "config", "drex"),
    "td3": (TD3Config, "td3", "scalarized"),
    "sac": (SACConfig, "sac", "scalarized"),
}
NAVIGATION = str(ROOT / "policies" / "navigation")


def configuration(recipe: str, *overrides: str) -> dict:
    _, name, folder = RECIPES[recipe]
    given = [f"policy={NAVIGATION}"] if recipe == "mo_ppo" else []
    with initialize_config_dir(str(ROOT / folder), version_base="1.3"):
        cfg = compose(name, overrides=[*given, *overrides])
    return OmegaConf.to_container(cfg, resolve=True)


def change(config: dict, changes: dict[str, object]) -> dict:
    for name, value in changes.items():
        *sections, last = name.split(".")
        part = config
        for section in sections:
            part = part[section]
        part[last] = value
    return config


def flat(config: dict, prefix: str = "") -> set[str]:
    names = set()
    for name, value in config.items():
        if isinstance(value, dict) and value:
            names |= flat(value, f"{prefix}{name}.")
        else:
            names.add(prefix + name)
    return names


@pytest.mark.parametrize("recipe", RECIPES)
def test_yaml_and_schema_have_the_same_fields(recipe):
    schema = RECIPES[recipe][0]
    required = {leaf.name for leaf in leaves(schema) if not leaf.optional}
    optional = {leaf.name for leaf in leaves(schema) if leaf.optional}
    # Null for a whole section: MO-PPO's faults.
    given = flat(configuration(recipe)) - {"env.faults"}
    assert required <= given <= required | optional


@pytest.mark.parametrize("recipe", RECIPES)
def test_every_field_says_what_it_is_and_what_it_allows(recipe):
    for leaf in leaves(RECIPES[recipe][0]):
        assert leaf.description.endswith("."), leaf.name
        assert len(leaf.description.split()) > 1, leaf.name
        assert leaf.allowed, leaf.name


@pytest.mark.parametrize("preset", ["none", "quick"])
@pytest.mark.parametrize("recipe", RECIPES)
def test_the_defaults_and_presets_are_allowed(recipe, preset):
    validate(RECIPES[recipe][0], configuration(recipe, f"preset={preset}"))


def parts(value: object) -> list[object]:
    """A value and what it consists of: the line names the part that is wrong."""
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return [value, *(part for one in inner for part in parts(one))]


# What is set, what the line must hold beside field and value. By recipe.
OFF_POLICY = [
    ("seed", -1, "at least 0"),
    ("seed", 2**31, "at most "),
    ("seed", 1.5, "whole number"),
    ("seed", "abc", "whole number"),
    ("seed", True, "whole number"),
    ("seed", None, "whole number"),
    ("device", "tpu", "cpu or cuda"),
    ("device", "cuda:x", "cpu or cuda"),
    ("compute.torch_threads", 0, "at least 1"),
    ("env.scene", "nowhere", "choose one of"),
    ("env.scene", 3, "a name, a .yaml file or a mapping"),
    ("env.robot", "broom", "choose one of"),
    ("env.robot", None, "a name, a .yaml file or a mapping"),
    ("env.drive", "legs", "'planar' or 'wheels'"),
    ("env.observe_human", "no", "true or false"),
    ("env.observe_human_velocity", 1, "true or false"),
    ("env.goal_radius", 0, "positive"),
    ("env.goal_radius", math.nan, "positive"),
    ("env.max_episode_steps", 0, "at least 1"),
    ("env.num_envs", 0, "at least 1"),
    ("env.num_envs", 10**9, "at most "),
    ("env.num_threads", -1, "at least 0"),
    ("env.faults.dropout", 2, "probability in [0, 1]"),
    ("env.faults.dropout", "much", "pair in ascending order"),
    ("env.faults.range_noise", -0.1, "not be negative"),
    ("env.faults.range_noise", [0.2, 0.1], "pair in ascending order"),
    ("env.faults.velocity_noise", [0.1], "pair in ascending order"),
    ("env.faults.latency", -1, ""),
    ("env.faults", 3, "mapping"),
    ("env.objectives", [], "list of names"),
    ("env.objectives", ["core", "core"], ""),
    ("demonstrations.reward_model", "nowhere", "is a folder with"),
    ("demonstrations.dataset", "nowhere", "needs demonstrations.reward_model"),
    ("demonstrations.prefill", 0, "at least 1"),
    ("preference.num_segments", 0, "at least 1"),
    ("preference.num_segments", 25, "at most env.num_envs"),
    ("preference.distribution", "uniform", "'jeffreys', 'dirichlet', 'abs_normal'"),
    ("preference.relabel_distribution", None, "'jeffreys', 'dirichlet', 'abs_normal'"),
    ("preference.relabel_ratio", 2, "in [0, 1]"),
    ("preference.relabel_ratio", -0.1, "in [0, 1]"),
    ("collector.total_frames", 0, "at least 1"),
    ("collector.total_frames", 9600, "greater than collector.init_random_frames"),
    ("collector.total_frames", 1e5, "whole number"),
    ("collector.frames_per_batch", 0, "at least 1"),
    ("collector.frames_per_batch", 100, "multiple of env.num_envs"),
    ("collector.init_random_frames", -1, "at least 0"),
    ("replay_buffer.size", 0, "at least 1"),
    ("replay_buffer.size", 95, "at least collector.frames_per_batch"),
    ("replay_buffer.batch_size", 0, "at least 1"),
    ("replay_buffer.reward_scale", 0, "positive"),
    ("replay_buffer.reward_scale", math.inf, "positive"),
    ("network.num_cells", [], "list of at least 1"),
    ("network.num_cells", [256, 0], "at least 1"),
    ("network.num_cells", [30_000, 30_000], "at most "),
    ("network.num_cells", 256, "list"),
    ("network.critic_layer_norm", "yes", "true or false"),
    ("loss.gamma", 0, "in (0, 1]"),
    ("loss.gamma", 1.5, "in (0, 1]"),
    ("loss.gamma", math.nan, "in (0, 1]"),
    ("loss.truncation_is_terminal", "maybe", "true or false"),
    ("loss.loss_function", "huberx", "'smooth_l1', 'l2', 'l1'"),
    ("optim.updates_per_batch", 0, "at least 1"),
    ("optim.lr", 0, "positive"),
    ("optim.lr", -1e-3, "positive"),
    ("optim.lr", "fast", "positive number"),
    ("optim.final_lr_ratio", -3, "in [0, 1]"),
    ("optim.final_lr_ratio", 2, "in [0, 1]"),
    ("optim.polyak", 1, "in [0, 1)"),
    ("optim.max_grad_norm", 0, "positive"),
    ("optim.actor_average", 1, "in [0, 1)"),
    ("optim.actor_average", None, "in [0, 1)"),
    ("evaluation.interval", 0, "at least 1"),
    ("evaluation.scene", "nowhere", "choose one of"),
    ("evaluation.episodes", 0, "at least 1"),
    ("evaluation.episodes", 999_999_999, "at most "),
    ("evaluation.seed", 7, "at least 1000000"),
    ("logger.interval", 0, "at least 1"),
    ("logger.backends", ["paper"], "'csv', 'tensorboard'"),
    ("logger.backends", "csv", "list"),
]
TD3 = [
    ("collector.exploration_sigma", -1, "not be negative"),
    ("collector.exploration_sigma", 0.01, "at most collector.exploration_sigma"),
    ("collector.final_exploration_sigma", math.inf, "not negative"),
    ("loss.policy_noise", -1, "not be negative"),
    ("loss.noise_clip", -1, "not be negative"),
    ("optim.policy_delay", 0, "at least 1"),
]
BAD = {
    "pd_morl": [
        *OFF_POLICY,
        *TD3,
        ("compute.compile", "yes", "true or false"),
        ("compute.compile_mode", "fast", "'default', "),
        ("compute.bfloat16", 16, "true or false, or null"),
        ("network.straight_drive", None, "true or false"),
        ("loss.target_selection", "smaller", "'utility' or 'elementwise'"),
        ("loss.angle", "official", "'normalized' or 'raw', or null"),
        ("loss.interpolated", 0, "true or false"),
        ("loss.angle_coeff_actor", -1, "not be negative"),
        ("loss.angle_coeff_critic", math.nan, "not negative"),
        ("loss.pre_tanh_coeff", -1, "not be negative"),
        ("loss.final_pre_tanh_coeff", -1, "not be negative"),
        ("evaluation.refit_momentum", 5, "in [0, 1)"),
        ("evaluation.refit_momentum", 1, "in [0, 1)"),
    ],
    "td3": [*OFF_POLICY, *TD3, ("objective", "speed", "'preference' or 'core'")],
    "sac": [
        *OFF_POLICY,
        ("loss.alpha_init", 0, "positive"),
        ("network.initial_scale", 0, "positive"),
        ("network.min_scale", 0, "in (0, network.initial_scale)"),
        ("network.min_scale", 2.0, "in (0, network.initial_scale)"),
    ],
    "mo_ppo": [
        ("policy", "nowhere", "is a folder with policy.safetensors and policy.json"),
        ("policy", 3, "a folder"),
        ("resume", "nowhere", "it must be the folder of"),
        ("seed", -1, "at least 0"),
        ("device", "tpu", "cpu or cuda"),
        ("compute.torch_threads", 0, "at least 1"),
        ("compute.bfloat16", "no", "true or false, or null"),
        ("env.scene", "nowhere", "choose one of"),
        ("env.robot", "broom", "choose one of"),
        ("env.goal_radius", -0.3, "positive"),
        ("env.max_episode_steps", 0, "at least 1"),
        ("env.num_envs", 0, "at least 1"),
        ("env.num_threads", -1, "at least 0"),
        ("env.repeat_failed", 2, "in [0, 1]"),
        ("env.faults", {"dropout": 2}, "probability in [0, 1]"),
        ("env.faults", {"fog": 1}, "no field env.faults.fog"),
        ("demonstrations.reward_model", "nowhere", "is a folder with"),
        ("preference.num_segments", 513, "at most env.num_envs"),
        ("preference.distribution", "uniform", "'jeffreys'"),
        ("collector.total_frames", 0, "at least 1"),
        ("collector.frames_per_batch", 100, "multiple of env.num_envs"),
        ("collector.exploration_sigma", [0.05, 0], "positive"),
        ("collector.exploration_sigma", [0.05], "for speed and turn rate"),
        ("collector.exploration_sigma", 0.05, "two positive numbers"),
        ("replay_buffer.reward_scale", -1, "positive"),
        ("network.num_cells", [0], "at least 1"),
        ("loss.gamma", 1.5, "in (0, 1]"),
        ("loss.lmbda", 2, "in [0, 1]"),
        ("loss.level_preferences", "yes", "true or false"),
        ("loss.clip_epsilon", -1, "in (0, 1)"),
        ("loss.clip_epsilon", 0, "in (0, 1)"),
        ("loss.anchor_coeff", math.nan, "not negative"),
        ("loss.anchor_coeff", -1, "not be negative"),
        ("loss.anchor_radius", -1, "not be negative"),
        ("loss.anchor_window", 4, "odd number of steps"),
        ("loss.anchor_window", 0, "odd number of steps"),
        ("loss.smoothness_coeff", -1, "not be negative"),
        ("loss.standing_coeff", -1, "not be negative"),
        ("optim.critic_batches", -1, "at least 0"),
        ("optim.critic_epochs", 0, "at least 1"),
        ("optim.epochs", 0, "at least 1"),
        ("optim.batch_size", 0, "between 1 and collector.frames_per_batch"),
        ("optim.batch_size", 32_769, "between 1 and collector.frames_per_batch"),
        ("optim.penalty_batch_size", 0, "at least 1"),
        ("optim.lr", 0, "positive"),
        ("optim.critic_lr", math.inf, "positive"),
        ("optim.max_grad_norm", 0, "positive"),
        ("optim.actor_average", 1, "in [0, 1)"),
        ("evaluation.interval", 0, "at least 1"),
        ("evaluation.episodes", 0, "at least 1"),
        ("logger.backends", None, "list"),
    ],
    "drex": [
        ("seed", -1, "at least 0"),
        ("torch_threads", 0, "at least 1"),
        ("bfloat16", 1, "true or false, or null"),
        ("env.scene", "nowhere", "choose one of"),
        ("env.robot", "broom", "choose one of"),
        ("env.num_threads", -1, "at least 0"),
        ("demonstrations.dataset", "nowhere", "no such file"),
        ("demonstrations.count", 0, "at least 1"),
        ("demonstrations.batch", 0, "at least 1"),
        ("demonstrations.radius", 0, "positive"),
        ("demonstrations.side", "above", "'left' or 'right'"),
        ("demonstrations.speed", 0.6, "in (0, 0.5] m/s"),
        ("demonstrations.speed", 0, "positive"),
        ("cloning.num_cells", [], "list of at least 1"),
        ("cloning.lr", 0, "positive"),
        ("cloning.batch_size", 0, "at least 1"),
        ("cloning.updates", 0, "at least 1"),
        ("cloning.held_out", 0, "in (0, 1)"),
        ("cloning.held_out", 1, "in (0, 1)"),
        ("cloning.patience", 0, "at least 1"),
        ("noise.levels", [], "list of shares"),
        ("noise.levels", [0.0, 2.0], "in [0, 1]"),
        ("noise.levels", [0.0, 0.0], "repeat"),
        ("noise.levels", [0.0, 0.05], "at least reward_model.min_gap"),
        ("noise.rollouts", 1, "at least 2"),
        ("noise.hold", 0, "at least 1"),
        ("style_negatives.rollouts", 5, "0 or at least 12"),
        ("style_negatives.rollouts", -12, "at least 0"),
        ("style_negatives.radii", [], "list of pairs"),
        ("style_negatives.radii", [[0.85, 0.6]], "ascending"),
        ("style_negatives.radii", [[0.0, 0.6]], "positive"),
        ("style_negatives.detours", [0.5], "two positive numbers"),
        ("style_negatives.min_frechet", -1, "not be negative"),
        ("reward_model.inputs", [], "list"),
        (
            "reward_model.inputs",
            ["position"],
            "'lidar', 'goal', 'human', 'human_velocity', 'action'",
        ),
        ("reward_model.inputs", ["human_velocity"], "some of"),
        ("reward_model.inputs", ["goal", "goal"], "repeat"),
        ("reward_model.num_cells", [0], "at least 1"),
        ("reward_model.num_members", 0, "at least 1"),
        ("reward_model.snippet_length", 0, "at least 1"),
        ("reward_model.min_gap", 0, "in (0, 1]"),
        ("reward_model.near_human", 0, "positive"),
        ("reward_model.batch_size", 1, "at least 2"),
        ("reward_model.updates", 0, "at least 1"),
        ("reward_model.lr", 0, "positive"),
        ("reward_model.weight_decay", -1, "not be negative"),
        ("reward_model.label_smoothing", 1, "in [0, 1)"),
        ("reward_model.held_out", 0, "in (0, 1)"),
        ("diagnostics.rollouts", 1, "at least 2"),
    ],
}
CASES = [(recipe, *case) for recipe, cases in BAD.items() for case in cases]
assert len(CASES) >= 120


@pytest.fixture(scope="module")
def defaults() -> dict[str, dict]:
    return {recipe: configuration(recipe) for recipe in RECIPES}


@pytest.mark.parametrize(("recipe", "field", "value", "allowed"), CASES)
def test_a_bad_value_is_one_line_with_field_value_and_what_is_allowed(
    recipe, field, value, allowed, defaults, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    config = OmegaConf.to_container(OmegaConf.create(defaults[recipe]))
    with pytest.raises(ConfigurationError) as refused:
        validate(RECIPES[recipe][0], change(config, {field: value}))
    line = str(refused.value)
    assert "\n" not in line
    assert field.rsplit(".", 1)[0] in line and field.rsplit(".", 1)[-1] in line
    assert allowed in line
    assert any(str(one) in line for one in parts(value)) or "no field" in line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"loss.angle": None},
            "an angle coefficient has no effect without loss.angle: loss.angle_coeff_actor and "
            "loss.angle_coeff_critic must be 0 with loss.angle=null, got (0.1, 0.0).",
        ),
        (
            {"optim.final_lr_ratio": -3, "optim.policy_delay": 0, "network.num_cells": [0, -1]},
            "network.num_cells[0] must be at least 1, got 0. (Also refused: "
            "network.num_cells[1], optim.final_lr_ratio, optim.policy_delay.)",
        ),
        ({"optim.lrate": 1e-3}, "there is no field optim.lrate: did you mean optim.lr?"),
        ({"polyak": 0.9}, "there is no field polyak: did you mean optim.polyak?"),
        ({"optim.zzz": 1}, "there is no field optim.zzz: --help lists the fields."),
    ],
)
def test_lines_word_by_word(changes, message, defaults):
    config = OmegaConf.to_container(OmegaConf.create(defaults["pd_morl"]))
    with pytest.raises(ConfigurationError) as refused:
        validate(PD_MORL, change(config, changes))
    assert str(refused.value) == message


def test_what_must_be_given_is_named(defaults):
    config = OmegaConf.to_container(OmegaConf.create(defaults["mo_ppo"]))
    with pytest.raises(ConfigurationError) as refused:
        validate(MO_PPO, change(config, {"policy": "???"}))
    meaning = "Folder of the policy to start from; null starts from nothing."
    assert str(refused.value) == f"policy must be given: {meaning}"


def test_a_logger_that_is_not_installed_says_what_to_install(defaults, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    config = OmegaConf.to_container(OmegaConf.create(defaults["pd_morl"]))
    with pytest.raises(ConfigurationError, match="wandb is not installed: pip install wandb"):
        validate(PD_MORL, change(config, {"logger.backends": ["csv", "wandb"]}))


def test_a_gpu_that_is_not_there_says_what_to_do(defaults, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    config = OmegaConf.to_container(OmegaConf.create(defaults["pd_morl"]))
    with pytest.raises(ConfigurationError, match=r"device=cuda: PyTorch .* use device=cpu"):
        validate(PD_MORL, change(config, {"device": "cuda"}))


def test_what_is_planned_need_not_be_there_yet(defaults, tmp_path):
    config = change(
        OmegaConf.to_container(OmegaConf.create(defaults["pd_morl"])),
        {"demonstrations.reward_model": str(tmp_path / "run" / "drex" / "reward_model")},
    )
    validate(PD_MORL, config, planned=tmp_path / "run")
    with pytest.raises(ConfigurationError):
        validate(PD_MORL, config)


@pytest.mark.parametrize(
    "changes",
    [
        {"env.faults.latency": [0, 1], "env.faults.range_noise": [0, 0.05]},
        {"optim.lr": 1, "loss.gamma": 1},  # whole numbers are numbers
        {"collector.exploration_sigma": 0, "collector.final_exploration_sigma": 0},
        {"loss.angle": None, "loss.angle_coeff_actor": 0},
        {"loss.pre_tanh_coeff": 0},
        {"env.objectives": ["core", "distance"]},
        {"logger.backends": []},
    ],
)
def test_what_is_unusual_is_allowed(changes, defaults):
    validate(
        PD_MORL, change(OmegaConf.to_container(OmegaConf.create(defaults["pd_morl"])), changes)
    )
