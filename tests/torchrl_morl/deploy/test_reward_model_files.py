"""Reward model files: what is saved comes back frozen, and whatever is wrong with a file is said.

What both kinds of files share is tested in more depth in ``test_policy_files.py``.
"""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict

from torchrl_morl.deploy import load_policy, load_reward_model, save_reward_model
from torchrl_morl.modules import RewardModel

OBSERVATION, ACTION, CELLS, MEMBERS = 5, 2, (16, 8), 2
CARD = {"demonstrator": {"radius": 1.0, "side": "left"}, "style_lead": 0.4}
FILES = ["reward_model.json", "reward_model.safetensors"]


def make(in_keys=("observation", "action"), in_features=OBSERVATION + ACTION) -> RewardModel:
    return RewardModel(
        in_features=in_features,
        in_keys=in_keys,
        num_cells=CELLS,
        num_members=MEMBERS,
        last_layer_gain=1.0,
    )


def save(folder: Path, model: RewardModel, **kwargs) -> Path:
    return save_reward_model(folder, model, **({"card": CARD} | kwargs))


@pytest.fixture
def model() -> RewardModel:
    return make()


@pytest.fixture
def folder(tmp_path, model) -> Path:
    return save(tmp_path / "runs" / "reward_model", model)


def edit(folder: Path, **changes) -> None:
    path = folder / "reward_model.json"
    config = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({k: v for k, v in config.items() if v is not None}))


def edit_network(folder: Path, **changes) -> None:
    network = json.loads((folder / "reward_model.json").read_text())["network"]
    edit(folder, network=network | changes)


def inputs(*batch: int) -> TensorDict:
    return TensorDict(
        observation=torch.randn(*batch, OBSERVATION),
        action=torch.rand(*batch, ACTION),
        batch_size=batch,
    )


def test_round_trip_is_bit_equal_and_frozen(folder, model):
    loaded, card = load_reward_model(folder)
    data = inputs(64)
    score = loaded(data.clone())["demo_score"]
    assert torch.equal(score, model(data)["demo_score"])
    assert score.std() > 1e-3  # not a constant
    assert card == CARD
    assert not loaded.training
    assert not any(parameter.requires_grad for parameter in loaded.parameters())


def test_what_it_may_know_comes_back(tmp_path):
    """A reward of the state alone stays one."""
    model = make(in_keys=("observation",), in_features=OBSERVATION)
    folder = save(tmp_path / "state_only", model)
    loaded, _ = load_reward_model(folder)
    assert list(loaded.in_keys) == ["observation"]
    data = inputs(8)
    expected = model(data.clone())["demo_score"]
    assert torch.equal(loaded(data.exclude("action"))["demo_score"], expected)


def test_folder_holds_two_files_that_anyone_can_read(folder, model):
    assert sorted(path.name for path in folder.iterdir()) == FILES
    assert set(load_file(folder / "reward_model.safetensors")) == set(model.state_dict())
    config = json.loads((folder / "reward_model.json").read_text())
    assert config["network"]["in_keys"] == ["observation", "action"]
    assert config["network"]["num_members"] == MEMBERS


def test_loaded_model_can_be_saved_again(folder, tmp_path):
    copy = save(tmp_path / "copy", load_reward_model(folder)[0])
    for name in FILES:
        assert (copy / name).read_bytes() == (folder / name).read_bytes()


@pytest.mark.parametrize("name", FILES)
def test_nothing_is_overwritten(folder, model, name):
    other = next(file for file in FILES if file != name)
    (folder / other).unlink()  # one file is enough to refuse
    before = (folder / name).read_bytes()
    with pytest.raises(FileExistsError, match="reward_model exists and is not overwritten"):
        save(folder, model, card={})
    assert (folder / name).read_bytes() == before
    assert not (folder / other).exists()


@pytest.mark.parametrize("name", FILES)
def test_missing_file(folder, name):
    (folder / name).unlink()
    message = f"{re.escape(name)} not found: a reward model is a folder"
    with pytest.raises(FileNotFoundError, match=message):
        load_reward_model(folder)


def test_a_policy_is_no_reward_model_and_the_other_way_round(folder):
    with pytest.raises(FileNotFoundError, match=r"policy\.safetensors not found"):
        load_policy(folder)
    for path in list(folder.iterdir()):
        path.rename(folder / path.name.replace("reward_model", "policy"))
    with pytest.raises(FileNotFoundError, match=r"reward_model\.safetensors not found"):
        load_reward_model(folder)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "is not valid JSON"),
        (b'{"format": 1,', "is not valid JSON"),
        (b"\xff\xfe\x80", "is not valid JSON"),
        (b"[]", "is not a reward_model: no JSON object"),
        (b"{}", "has format None"),
    ],
)
def test_broken_json(folder, text, message):
    (folder / "reward_model.json").write_bytes(text)
    with pytest.raises(ValueError, match=rf"reward_model\.json {message}"):
        load_reward_model(folder)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_members": 0}, "num_members must be an integer between 1 and .*, got 0"),
        ({"num_members": "2"}, "num_members must be an integer .*, got '2'"),
        ({"num_members": 10**9}, "num_members must be an integer"),
        ({"in_features": -1}, "in_features must be an integer"),
        ({"num_cells": ["16", "8"]}, "num_cells must be a list of integers"),
        ({"in_keys": "observation"}, "in_keys must be a list of keys"),
        ({"activation": "Linear"}, "activation must be one of ELU, .*, got 'Linear'"),
    ],
)
def test_entry_that_makes_no_sense(folder, changes, message):
    edit_network(folder, **changes)
    with pytest.raises(ValueError, match=rf"reward_model\.json.* {message}"):
        load_reward_model(folder)


@pytest.mark.parametrize(
    "changes",
    [{"in_features": OBSERVATION}, {"num_cells": [16, 9]}, {"num_cells": [16]}, {"num_members": 3}],
)
def test_weights_that_do_not_fit(folder, changes):
    edit_network(folder, **changes)
    message = r"reward_model\.safetensors does not fit reward_model\.json: .* (entries|number)"
    with pytest.raises(ValueError, match=message):
        load_reward_model(folder)


def test_truncated_weights(folder):
    path = folder / "reward_model.safetensors"
    path.write_bytes(path.read_bytes()[:-10])
    message = r"reward_model\.safetensors is not a safetensors file"
    with pytest.raises(ValueError, match=message):
        load_reward_model(folder)


def test_weights_that_are_not_finite(folder):
    path = folder / "reward_model.safetensors"
    weights = load_file(path)
    name = next(iter(weights))
    weights[name].view(-1)[1] = torch.nan
    save_file(weights, path)
    edit(folder, checksum=hashlib.sha256(path.read_bytes()).hexdigest())
    with pytest.raises(ValueError, match=rf"reward_model\.safetensors .*{re.escape(name)}"):
        load_reward_model(folder)


def test_missing_card_is_empty(folder):
    edit(folder, card=None)
    assert load_reward_model(folder)[1] == {}
