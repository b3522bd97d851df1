"""Policy files: what is saved comes back, and whatever is wrong with a file is said."""

from __future__ import annotations

import hashlib
import json
import pickle
import re
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict
from torchrl.data import Bounded

from torchrl_morl import PreferenceSpace
from torchrl_morl.deploy import load_policy, save_policy
from torchrl_morl.modules import make_actor

SPACE = PreferenceSpace(("core", "distance", "efficiency"), static={"core": 1.0})
OBSERVATION, ACTION, CELLS = 5, 2, (16, 8)
CARD = {"scene": "static", "success": [97.5, 100.0]}


@pytest.fixture
def actor():
    return make_actor(
        Bounded(-1.0, 1.0, (ACTION,)),
        in_features=OBSERVATION + SPACE.num_tunable,
        num_cells=CELLS,
        last_layer_gain=1.0,
    )


def save(folder: Path, actor, **kwargs) -> Path:
    return save_policy(folder, actor, **({"preference_space": SPACE, "card": CARD} | kwargs))


@pytest.fixture
def folder(tmp_path, actor) -> Path:
    return save(tmp_path / "runs" / "policy", actor)


def inputs(*batch: int) -> TensorDict:
    return TensorDict(
        observation=torch.randn(*batch, OBSERVATION),
        preference=SPACE.sample(batch),
        batch_size=batch,
    )


def edit(folder: Path, **changes) -> None:
    path = folder / "policy.json"
    config = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({k: v for k, v in config.items() if v is not None}))


def edit_network(folder: Path, **changes) -> None:
    network = json.loads((folder / "policy.json").read_text())["network"]
    edit(folder, network=network | changes)


def test_round_trip_is_bit_equal(folder, actor):
    policy = load_policy(folder)
    loaded = policy.actor
    data = inputs(64)
    expected, action = actor(data.clone()), loaded(data.clone())
    assert torch.equal(action["action"], expected["action"])
    assert torch.equal(action["pre_tanh"], expected["pre_tanh"])
    assert (policy.preference_space, policy.card) == (SPACE, CARD)
    assert not loaded.training
    assert not any(parameter.requires_grad for parameter in loaded.parameters())


def test_folder_holds_two_files_that_anyone_can_read(folder, actor):
    assert sorted(path.name for path in folder.iterdir()) == ["policy.json", "policy.safetensors"]
    weights = load_file(folder / "policy.safetensors")
    assert set(weights) == set(actor.state_dict())
    config = json.loads((folder / "policy.json").read_text())
    assert config["objectives"] == ["core", "distance", "efficiency"]
    assert config["static"] == {"core": 1.0}


def test_loaded_policy_can_be_saved_again(folder, tmp_path):
    copy = save(tmp_path / "copy", load_policy(folder).actor)
    for name in ("policy.json", "policy.safetensors"):
        assert (copy / name).read_bytes() == (folder / name).read_bytes()


@pytest.mark.parametrize("name", ["policy.json", "policy.safetensors"])
def test_nothing_is_overwritten(folder, actor, name):
    other = "policy.json" if name == "policy.safetensors" else "policy.safetensors"
    (folder / other).unlink()  # one file is enough to refuse
    before = (folder / name).read_bytes()
    with pytest.raises(FileExistsError, match="policy exists and is not overwritten"):
        save(folder, actor, card={})
    assert (folder / name).read_bytes() == before
    assert not (folder / other).exists()


def test_file_is_json_for_every_reader(tmp_path, actor):
    card = {"time": [1.5, float("nan")], "nested": {"score": (float("inf"), 2)}}
    folder = save(tmp_path / "policy", actor, card=card)
    text = (folder / "policy.json").read_text()
    assert "NaN" not in text and "Infinity" not in text
    assert load_policy(folder).card == {"time": [1.5, None], "nested": {"score": [None, 2]}}


def test_card_that_is_not_json_leaves_nothing_behind(tmp_path, actor):
    with pytest.raises(TypeError, match="not JSON serializable"):
        save(tmp_path / "policy", actor, card={"actor": actor})
    assert not (tmp_path / "policy").exists()


@pytest.mark.parametrize("name", ["policy.json", "policy.safetensors"])
def test_missing_file(folder, name):
    (folder / name).unlink()
    with pytest.raises(FileNotFoundError, match=f"{re.escape(name)} not found: a policy is a fold"):
        load_policy(folder)


def test_missing_folder(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere.*not found"):
        load_policy(tmp_path / "nowhere")


@pytest.mark.parametrize("text", ["", '{"format": 1,', "[1, 2", "\x00"])
def test_broken_json(folder, text):
    (folder / "policy.json").write_text(text)
    with pytest.raises(ValueError, match=r"policy\.json is not valid JSON"):
        load_policy(folder)


def test_json_that_is_not_text(folder):
    (folder / "policy.json").write_bytes(b"\xff\xfe\x80")
    with pytest.raises(ValueError, match=r"policy\.json is not valid JSON"):
        load_policy(folder)


@pytest.mark.parametrize("text", ["[]", "3", "null", '"format"'])
def test_json_that_is_no_object(folder, text):
    (folder / "policy.json").write_text(text)
    with pytest.raises(ValueError, match=r"policy\.json is not a policy"):
        load_policy(folder)


@pytest.mark.parametrize("key", ["format", "objectives", "static", "network", "checksum", "period"])
def test_missing_entry(folder, key):
    edit(folder, **{key: None})
    with pytest.raises(ValueError, match=rf"policy\.json.* '?{key}"):
        load_policy(folder)


@pytest.mark.parametrize("version", [0, 3, "1", True, 1.0])
def test_other_format(folder, version):
    edit(folder, format=version)
    with pytest.raises(ValueError, match=f"has format {version!r}, this version reads 1 to 2"):
        load_policy(folder)


def test_missing_card_is_empty(folder):
    edit(folder, card=None)
    assert load_policy(folder).card == {}


class Bomb:
    """Leaves a file behind when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@pytest.mark.parametrize("dump", [pickle.dump, torch.save], ids=["pickle", "torch.save"])
def test_pickle_is_refused_and_never_opened(folder, tmp_path, dump):
    trace = tmp_path / "unpickled"
    with (folder / "policy.safetensors").open("wb") as file:
        dump(Bomb(trace), file)
    with pytest.raises(ValueError, match=r"policy\.safetensors is not a safetensors file"):
        load_policy(folder)
    assert not trace.exists()


def test_truncated_weights(folder):
    path = folder / "policy.safetensors"
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(ValueError, match=r"policy\.safetensors is not a safetensors file"):
        load_policy(folder)


def test_empty_weights(folder):
    (folder / "policy.safetensors").write_bytes(b"")
    with pytest.raises(ValueError, match=r"policy\.safetensors is not a safetensors file"):
        load_policy(folder)


def test_weights_of_another_size(folder):
    edit_network(folder, num_cells=[16, 9])
    message = r"policy\.safetensors does not fit policy\.json: .*should be float32 of shape \(9,\) "
    with pytest.raises(ValueError, match=message + r"and is float32 of shape \(8,\)"):
        load_policy(folder)


def test_weights_of_another_depth(folder):
    edit_network(folder, num_cells=[16])
    with pytest.raises(ValueError, match=r"does not fit .* 6 entries, for 1 hidden layers"):
        load_policy(folder)


def test_weights_that_are_not_finite(folder):
    path = folder / "policy.safetensors"
    weights = load_file(path)
    name = "module.0.module.0.weight"
    weights[name][3, 2] = torch.nan
    save_file(weights, path)
    edit(folder, checksum=hashlib.sha256(path.read_bytes()).hexdigest())
    with pytest.raises(
        ValueError, match=rf"policy\.safetensors .*{re.escape(name)}'\[3, 2\] = nan"
    ):
        load_policy(folder)
