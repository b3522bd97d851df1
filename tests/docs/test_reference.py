"""What pages say of configurations, keys and code is what these are."""

from __future__ import annotations

import inspect
import re

import pytest

import envs.objectives
from envs.policy_env import make_policy_env
from tools import configuration_pages
from torchrl_morl import PreferenceSpace
from torchrl_morl.modules import RewardModel
from torchrl_morl.transforms import PreferenceSampler, ScalarizeReward

from ._pages import ROOT, blocks

FOLDER = ROOT / "docs" / "configuration"


@pytest.mark.parametrize(
    ("file", "text"), list(configuration_pages.pages()), ids=lambda one: one[:12]
)
def test_every_field_is_documented_as_its_schema_says(file, text):
    """To repair it: python -m tools.configuration_pages."""
    assert (FOLDER / file).read_text() == text


@pytest.mark.parametrize("recipe", configuration_pages.RECIPES, ids=lambda one: one.page)
def test_every_preset_is_on_the_page_of_its_recipe(recipe):
    folder = ROOT.joinpath(*recipe.module.split(".")[:-1]) / "preset"
    text = (FOLDER / f"{recipe.page}.md").read_text()
    named = re.findall(r"^\| \[`(\w+)`\]\(\S+\) \| \S+ .+ \|$", text, re.MULTILINE)
    assert set(named) | {"none"} == {file.stem for file in folder.glob("*.yaml")}


def test_no_other_page_of_fields_is_there():
    assert {path.name for path in FOLDER.iterdir()} == dict(configuration_pages.pages()).keys()


def test_the_keys_of_a_transition_are_those_of_the_table():
    page = (ROOT / "docs" / "architecture.md").read_text()
    section = page.split("## Keys of the tensordict")[1]
    state = set(re.findall(r"`(\w+)`", section.split("simulator's state:")[1].split("\n")[0]))
    rows = re.findall(r"^\| (`[\w`, ]+) \| `\[N, (\w+)\]` \|", section, re.MULTILINE)
    told = {key: size for keys, size in rows for key in re.findall(r"\w+", keys)}

    space = PreferenceSpace(("core", "demo", "distance", "efficiency"), static={"core": 1.0})
    env = make_policy_env(
        PreferenceSampler(space, seed=0),
        reward_model=RewardModel(in_features=36 + 2, num_cells=(8,)),
        keep_simulation=True,
        num_envs=2,
        num_threads=1,
        seed=0,
    )
    env.append_transform(ScalarizeReward(space))
    data = env.rollout(2)
    found = {
        key: data.get(key, data["next"].get(key)) for key in {*data.keys(), *data["next"].keys()}
    }
    assert found.keys() - {"next"} == told.keys() | state
    sizes = {"T": space.num_tunable, "K": space.num_objectives}
    for key, size in told.items():
        assert found[key].shape[-1] == int(sizes.get(size, size)), key


def test_the_shown_objective_is_the_one_that_ships():
    first, *_ = blocks((ROOT / "docs" / "how_to" / "objective.md").read_text(), "python")
    assert inspect.getsource(envs.objectives.clearance) in first.code


def test_the_reference_has_a_page_for_every_package():
    listed = (ROOT / "docs" / "api" / "index.md").read_text()
    for folder in ("torchrl_morl", "envs"):
        for package in sorted((ROOT / folder).rglob("__init__.py")):
            module = ".".join(package.parent.relative_to(ROOT).parts)
            if "import" not in package.read_text():
                continue
            page = (ROOT / "docs" / "api" / f"{module}.md").read_text()
            assert f"automodule:: {module}\n" in page
            assert f"({module}.md)" in listed
