"""What is saved comes back as the same function, or is refused when it is saved; folders appear whole."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from safetensors.torch import save_file
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded

from torchrl_morl import PreferenceSpace
from torchrl_morl.deploy import (
    Limits,
    Sensing,
    literal_config,
    load_policy,
    load_reward_model,
    save_policy,
    save_reward_model,
)
from torchrl_morl.deploy import files as files_module
from torchrl_morl.deploy.files import whole_folder
from torchrl_morl.deploy.networks import ACTIVATIONS
from torchrl_morl.modules import RewardModel, make_actor

SPACE = PreferenceSpace(("core", "distance", "efficiency"), static={"core": 1.0})


def make(**changes):
    arguments = {"in_features": 5 + 2, "num_cells": (16, 8), "last_layer_gain": 1.0} | changes
    return make_actor(Bounded(-1.0, 1.0, (2,)), **arguments)


def save(folder: Path, actor, **changes) -> Path:
    return save_policy(folder, actor, **({"preference_space": SPACE, "card": {}} | changes))


@pytest.mark.parametrize("name", sorted(ACTIVATIONS))
def test_activation_comes_back(tmp_path, name):
    actor = make(activation_class=ACTIVATIONS[name])
    loaded = load_policy(save(tmp_path / "policy", actor)).actor
    inputs = torch.randn(64, 5), SPACE.sample(64)
    for one, other in zip(actor(*inputs), loaded(*inputs)):
        assert torch.equal(one, other)
    model = RewardModel(in_features=4, num_cells=(8,), activation_class=ACTIVATIONS[name])
    save_reward_model(tmp_path / "model", model, card={})
    again, _ = load_reward_model(tmp_path / "model")
    inputs = torch.randn(64, 2), torch.randn(64, 2)
    assert torch.equal(model(*inputs), again(*inputs))


@pytest.mark.parametrize("num_cells", [(), (1,), (7, 3, 5)])
def test_sizes_are_those_of_the_weights(tmp_path, num_cells):
    actor = make(num_cells=num_cells)
    loaded = load_policy(save(tmp_path / "policy", actor)).actor
    inputs = torch.randn(3, 5), SPACE.sample(3)
    assert torch.equal(actor(*inputs)[1], loaded(*inputs)[1])


def test_keys_come_back(tmp_path):
    keys = {
        "in_keys": [("agent", "observation"), "preference"],
        "out_key": ("agent", "action"),
        "pre_tanh_key": "raw",
    }
    actor = make(**keys)
    loaded = load_policy(save(tmp_path / "policy", actor)).actor
    assert loaded.in_keys == actor.in_keys and loaded.out_keys == actor.out_keys
    data = TensorDict(
        agent=TensorDict(observation=torch.randn(3, 5), batch_size=3),
        preference=SPACE.sample(3),
        batch_size=3,
    )
    assert torch.equal(
        loaded(data.clone())["agent", "action"], actor(data.clone())["agent", "action"]
    )
    model = RewardModel(in_features=3, in_keys=[("next", "observation")], out_key=("r", "demo"))
    save_reward_model(tmp_path / "model", model, card={})
    again, _ = load_reward_model(tmp_path / "model")
    assert again.in_keys == model.in_keys and again.out_keys == model.out_keys


def test_double_precision_comes_back(tmp_path):
    loaded = load_policy(save(tmp_path / "policy", make().double())).actor
    assert {value.dtype for value in loaded.state_dict().values()} == {torch.float64}


def test_the_contract_comes_back(tmp_path):
    contract = {
        "sensing": Sensing(
            max_range=8.0,
            lidar_origin=(0.15, -0.1),
            goal_range=(0.2, 20.0),
            nobody=(7.0, 3.0),
            unknown_range=2.0,
            observe_human_velocity=True,
        ),
        "limits": Limits((0.0, 0.8), (-1.5, 1.5)),
        "period": 0.1,
        "robot": "mine",
    }
    actor = make(in_features=38 + 2)
    policy = load_policy(save(tmp_path / "policy", actor, **contract))
    assert {name: getattr(policy, name) for name in contract} == contract


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda: make().half(), "all float32 or all float64, got float16"),
        (lambda: make().bfloat16(), "got bfloat16"),
        (lambda: mixed_dtypes(make()), "got float32, float64"),
        (lambda: exchanged(make(), 1, nn.Tanh()), "has ReLU, Tanh between its linear layers"),
        (lambda: exchanged(make(num_cells=(8,)), 1, nn.LeakyReLU(0.5)), "negative_slope=0.5"),
        (lambda: exchanged(make(num_cells=(8,)), 1, nn.Softsign()), "has Softsign between"),
        (lambda: exchanged(make(), 2, nn.Linear(16, 8, bias=False)), "would be restored as"),
        (lambda: hooked(make()), "has a forward hook"),
        (lambda: not_finite(make()), "must be finite"),
        (lambda: make_actor(Bounded(0.0, 0.5, (2,)), in_features=7), r"are in \[-1, 1\], got"),
        (lambda: nn.Linear(7, 2), "not one of make_actor"),
    ],
)
def test_what_would_not_come_back_is_refused(tmp_path, spoil, message):
    with pytest.raises(ValueError, match=message) as error:
        save(tmp_path / "policy", spoil())
    assert len(str(error.value).splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def exchanged(actor, index: int, layer: nn.Module):
    actor[0].module[index] = layer
    return actor


def mixed_dtypes(actor):
    actor[0].module[0].double()
    return actor


def hooked(actor):
    actor[0].module.register_forward_hook(lambda *_: None)
    return actor


def not_finite(actor):
    actor[0].module[0].weight.data[0, 0] = torch.nan
    return actor


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sensing": Sensing()}, r"reads 7 entries, sensing and preference_space have 36 \+ 2"),
        ({"preference_space": PreferenceSpace(("a", "b", "c"))}, None),  # without sensing: any
    ],
)
def test_an_actor_that_does_not_fit_its_contract(tmp_path, changes, message):
    if message is None:
        save(tmp_path / "policy", make(), **changes)
        return
    with pytest.raises(ValueError, match=message):
        save(tmp_path / "policy", make(), **changes)


def test_members_that_differ_are_refused(tmp_path):
    model = RewardModel(in_features=4, num_cells=(8,), num_members=2)
    model.module.members[1][1] = nn.Tanh()
    with pytest.raises(ValueError, match="members of the reward model differ"):
        save_reward_model(tmp_path / "model", model, card={})


def test_a_loaded_actor_can_be_exported(tmp_path):
    loaded = load_policy(save(tmp_path / "policy", make())).actor
    inputs = torch.randn(3, 5), SPACE.sample(3)
    graph = torch.export.export(loaded, inputs, strict=False).module()
    assert torch.equal(graph(*inputs)[1], loaded(*inputs)[1])


# --- folders -----------------------------------------------------------------------------------


def test_a_failure_leaves_nothing_behind(tmp_path, monkeypatch):
    write, written = files_module.write_new, []

    def full_disk(path, data):
        if written:
            raise OSError(28, "No space left on device")
        written.append(path)
        write(path, data)

    monkeypatch.setattr(files_module, "write_new", full_disk)
    with pytest.raises(OSError, match="No space left"):
        save(tmp_path / "policies" / "000000960", make())
    assert written and not written[0].exists()
    assert list((tmp_path / "policies").iterdir()) == []


def test_until_it_is_whole_it_has_another_name(tmp_path):
    with whole_folder(tmp_path / "policy") as partial:
        assert partial.parent == tmp_path and partial.name.startswith(".policy.")
        assert not (tmp_path / "policy").exists()
        (partial / "a").touch()
    assert [path.name for path in tmp_path.rglob("*")] == ["policy", "a"]


def test_two_at_once_and_one_wins(tmp_path):
    errors, barrier = [], threading.Barrier(2)

    def write():
        try:
            with whole_folder(tmp_path / "policy") as partial:
                (partial / "a").touch()
                barrier.wait()
        except FileExistsError as error:
            errors.append(error)

    threads = [threading.Thread(target=write) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(errors) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["policy"]


def test_an_empty_folder_is_taken_and_a_full_one_is_not(tmp_path):
    save(tmp_path / "policy", make())
    (tmp_path / "empty").mkdir()
    save(tmp_path / "empty", make())
    assert load_policy(tmp_path / "empty").card == {}
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="full exists and is not overwritten"):
        save(tmp_path / "full", make())
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["notes.txt"]


# --- format 1 ----------------------------------------------------------------------------------


@pytest.fixture
def format1(tmp_path) -> Path:
    """As earlier versions wrote it, with the names of their time."""
    folder = tmp_path / "old"
    folder.mkdir()
    actor = make(in_features=38 + 2)
    save_file(actor.state_dict(), folder / "policy.safetensors")
    env = {
        "scene": "mixed",
        "robot": "hsr",
        "observe_human_velocity": True,
        "perturbation": {"latency": 1},
    }
    preference = {"law": "jeffreys", "relabel_law": "dirichlet"}
    start = {"config": {"preference": {"law": "abs_normal"}}}
    config = {
        "format": 1,
        "objectives": list(SPACE.objectives),
        "static": dict(SPACE.static),
        "observation_size": 38,
        "action_size": 2,
        "num_cells": [16, 8],
        "card": {"config": {"env": env, "preference": preference}, "start": start},
    }
    (folder / "policy.json").write_text(json.dumps(config))
    return folder


def test_format_1_loads_with_the_names_of_today(format1):
    policy = load_policy(format1)
    assert policy.robot == "hsr" and policy.period == 0.2
    assert policy.sensing == Sensing(
        lidar_origin=(0.15, 0.0), observe_human_velocity=True, human_range=(0.4, 12.0)
    )
    config = policy.card["config"]
    assert config["env"]["faults"] == {"latency": 1} and "perturbation" not in config["env"]
    assert config["preference"] == {
        "distribution": "jeffreys",
        "relabel_distribution": "dirichlet",
    }
    assert policy.card["start"]["config"]["preference"] == {"distribution": "abs_normal"}


def test_format_1_without_a_configuration_has_an_actor_only(format1):
    path = format1 / "policy.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"card": {}}))
    policy = load_policy(format1)
    assert policy.sensing is None
    assert policy.actor(torch.zeros(38), torch.tensor([0.5, 0.5]))[1].isfinite().all()
    with pytest.raises(ValueError, match="does not tell what it senses"):
        policy.act(preference=[0.5, 0.5], lidar=[4.0] * 30, goal=[1, 0], human=[1, 0])


@pytest.mark.parametrize("env", [3, {"robot": ["hsr"]}, {"robot": "tank"}, {"observe_human": "no"}])
def test_format_1_with_a_card_of_another_type(format1, env):
    path = format1 / "policy.json"
    config = json.loads(path.read_text())
    config["card"]["config"]["env"] = env
    path.write_text(json.dumps(config))
    with pytest.raises(ValueError, match=r"policy\.json.*(robot|env|observe_human) must be"):
        load_policy(format1)


# --- configurations and checkpoints ------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "${oc.env:SECRET}",
        "\\${oc.env:SECRET}",
        "\\\\${oc.env:SECRET}",
        "a${oc.env:SECRET}${b}",
        "$${oc.env:SECRET}",
        "${",
        "C:\\runs",
    ],
)
def test_no_string_is_interpolated(monkeypatch, text):
    monkeypatch.setenv("SECRET", "leaked")
    card = {"env": {"scene": text, "list": [text]}}
    cfg = OmegaConf.create(literal_config(card))
    assert cfg.env.scene == text and cfg.env.list[0] == text
    assert OmegaConf.to_container(cfg, resolve=True) == card
    # Nor after it has been merged with something else.
    merged = OmegaConf.merge({"env": {"other": 1}}, cfg)
    assert merged.env.scene == text
