"""The schemas of the recipes: each field of each YAML, and what they refuse."""

from __future__ import annotations

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

from ._bad_values import BAD

ROOT = Path(recipes.__file__).parent
RECIPES = {
    "pd_morl": (PD_MORL, "config", "pd_morl"),
    "mo_ppo": (MO_PPO, "config", "mo_ppo"),
    "drex": (DREX, "config", "drex"),
    "td3": (TD3Config, "td3", "scalarized"),
    "sac": (SACConfig, "sac", "scalarized"),
}
POLISHED = str(ROOT / "policies" / "polished_seed0")


def configuration(recipe: str, *overrides: str) -> dict:
    _, name, folder = RECIPES[recipe]
    given = [f"policy={POLISHED}"] if recipe == "mo_ppo" else []
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


PRESETS = [
    (recipe, file.stem)
    for recipe, (_, _, folder) in RECIPES.items()
    for file in sorted((ROOT / folder / "preset").glob("*.yaml"))
]


@pytest.mark.parametrize(("recipe", "preset"), PRESETS)
def test_the_defaults_and_presets_are_allowed(recipe, preset):
    validate(RECIPES[recipe][0], configuration(recipe, f"preset={preset}"))


def parts(value: object) -> list[object]:
    """A value and what it consists of: the line names the part that is wrong."""
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return [value, *(part for one in inner for part in parts(one))]


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
    assert (
        str(refused.value)
        == "policy must be given: Folder of the policy to start from; null starts from nothing."
    )


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
