"""Files that somebody else wrote: each loads or is refused in one line, and none takes more than its size."""

from __future__ import annotations

import hashlib
import json
import math
import os
import pickle
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torchrl.data import Bounded

from torchrl_morl import PreferenceSpace
from torchrl_morl.deploy import (
    Sensing,
    load_policy,
    load_reward_model,
    save_policy,
    save_reward_model,
)
from torchrl_morl.modules import RewardModel, make_actor

SPACE = PreferenceSpace(("core", "distance", "efficiency"), static={"core": 1.0})
LOADERS = {"policy": load_policy, "reward_model": load_reward_model}


@pytest.fixture(scope="module")
def originals(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("originals")
    torch.manual_seed(0)
    sensing = Sensing()
    size = sensing.observation_size + SPACE.num_tunable
    actor = make_actor(Bounded(-1.0, 1.0, (2,)), in_features=size, num_cells=(16, 8))
    save_policy(
        folder / "policy", actor, preference_space=SPACE, sensing=sensing, card={"note": "mine"}
    )
    model = RewardModel(in_features=38, num_cells=(16, 8), num_members=2)
    save_reward_model(folder / "reward_model", model, card={"note": "mine"})
    return folder


@pytest.fixture(params=["policy", "reward_model"])
def folder(request, originals, tmp_path) -> Path:
    """A copy, to be spoiled."""
    copy = tmp_path / request.param
    copy.mkdir()
    for path in (originals / request.param).iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    return copy


def weights(folder: Path) -> Path:
    return folder / f"{folder.name}.safetensors"


def config(folder: Path) -> Path:
    return folder / f"{folder.name}.json"


def edit(folder: Path, change: Callable[[dict], None]) -> None:
    values = json.loads(config(folder).read_text())
    change(values)
    config(folder).write_text(json.dumps(values))


def put(section: str | None, **entries) -> Callable[[Path], None]:
    def change(values: dict) -> None:
        (values if section is None else values[section]).update(entries)

    return lambda folder: edit(folder, change)


def drop(section: str | None, name: str) -> Callable[[Path], None]:
    return lambda folder: edit(
        folder, lambda values: (values if section is None else values[section]).pop(name)
    )


def rewrite(change: Callable[[dict], dict]) -> Callable[[Path], None]:
    """Other weights, with a checksum that fits them."""

    def spoil(folder: Path) -> None:
        save_file(change(load_file(weights(folder))), weights(folder))
        digest = hashlib.sha256(weights(folder).read_bytes()).hexdigest()
        put(None, checksum=digest)(folder)

    return spoil


def each(change: Callable[[torch.Tensor], torch.Tensor]) -> Callable[[Path], None]:
    return rewrite(lambda tensors: {name: change(value) for name, value in tensors.items()})


def flip_bit(folder: Path) -> None:
    data = bytearray(weights(folder).read_bytes())
    data[-3] ^= 1
    weights(folder).write_bytes(data)


def header(size: int, text: bytes) -> Callable[[Path], None]:
    return lambda folder: weights(folder).write_bytes(struct.pack("<Q", size) + text)


def replaced_by_folder(which: Callable[[Path], Path]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        which(folder).unlink()
        which(folder).mkdir()

    return spoil


def link_loop(which: Callable[[Path], Path]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        which(folder).unlink()
        which(folder).symlink_to(which(folder).name)

    return spoil


def fifo(folder: Path) -> None:
    config(folder).unlink()
    os.mkfifo(config(folder))


def pipe(which: Callable[[Path], Path]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        which(folder).unlink()
        os.mkfifo(which(folder))

    return spoil


def link_to_zero(which: Callable[[Path], Path]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        which(folder).unlink()
        which(folder).symlink_to("/dev/zero")

    return spoil


def again(entry: str) -> Callable[[Path], None]:
    """An entry once more in front of the one that is there: one reader takes the first, another the last."""
    name = entry.partition(":")[0] + ":"

    def spoil(folder: Path) -> None:
        content = config(folder).read_text()
        assert name in content
        config(folder).write_text(content.replace(name, f"{entry}, {name}", 1))

    return spoil


def text(data: bytes) -> Callable[[Path], None]:
    return lambda folder: config(folder).write_bytes(data)


HUGE_TENSOR = json.dumps(
    {"x": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}}
).encode()

NEGATIVE_TENSOR = b'{"x": {"dtype": "F32", "shape": [-1], "data_offsets": [0, 4]}}'
OVERFLOWING_TENSOR = json.dumps(
    {"x": {"dtype": "F32", "shape": [2**63, 2**63], "data_offsets": [0, 0]}}
).encode()

REFUSED = {
    "flipped bit": (flip_bit, "SHA-256 differs"),
    "checksum of another type": (put(None, checksum=7), "checksum must be"),
    "checksum missing": (drop(None, "checksum"), "lacks 'checksum'"),
    "int32": (each(lambda w: w.to(torch.int32)), "should be float32 .* and is I32"),
    "float16": (each(torch.Tensor.half), "should be float32 .* and is F16"),
    "bfloat16": (each(torch.Tensor.bfloat16), "and is BF16"),
    "float64 that says float32": (each(torch.Tensor.double), "and is float64"),
    "complex": (each(lambda w: w.to(torch.complex64)), "and is C64"),
    "dtype of another kind": (
        put(None, dtype="complex64"),
        "dtype must be one of float32, float64",
    ),
    "not a number": (each(lambda w: w * torch.nan), "must be finite"),
    "infinite": (each(lambda w: torch.full_like(w, torch.inf)), "must be finite"),
    "transposed": (each(lambda w: w.mT.contiguous() if w.ndim == 2 else w), "of shape"),
    "empty tensors": (each(lambda w: w[:0]), "of shape"),
    "a tensor more": (rewrite(lambda t: t | {"more": torch.ones(1)}), "another number"),
    "a tensor less": (rewrite(lambda t: dict(list(t.items())[1:])), "another number"),
    "a tensor renamed": (
        rewrite(lambda t: {("x\n" + n if i == 0 else n): v for i, (n, v) in enumerate(t.items())}),
        "does not fit",
    ),
    "layers of 30000": (put("network", num_cells=[30000, 30000]), "of shape"),
    "layers of 10**30": (put("network", num_cells=[10**30, 8]), "num_cells must be a list of int"),
    "a million layers": (put("network", num_cells=[1] * 1_000_000), "another number"),
    "layers as text": (put("network", num_cells="16"), "num_cells must be a list of integers"),
    "layers of floats": (put("network", num_cells=[16.0, 8.0]), "num_cells must be a list"),
    "layers of truth": (put("network", num_cells=[True, 8]), "num_cells must be a list"),
    "a layer of 2**48 weights": (put("network", num_cells=[2**24, 2**24]), "json: .*num_cells"),
    "inputs of 10**9": (put("network", in_features=10**9), "in_features must be|reads"),
    "keys that are no list": (put("network", in_keys=7), "in_keys must be a list of keys"),
    "keys of numbers": (put("network", in_keys=[1, 2]), "in_keys must be"),
    "no keys": (put("network", in_keys=[]), "in_keys must be"),
    "activation of another module": (
        put("network", activation="torch.nn.Sequential"),
        "activation must be one of",
    ),
    "activation as list": (put("network", activation=["ReLU"]), "activation must be one of"),
    "network is null": (put(None, network=None), "network must be an object"),
    "network missing": (drop(None, "network"), "lacks 'network'"),
    "card is null": (put(None, card=None), "card must be an object"),
    "card is a list": (put(None, card=["x"]), "card must be an object"),
    "card as deep as memory": (
        text(b'{"format": 2, "card": ' + b"[" * 200_000 + b"]" * 200_000 + b"}"),
        "not valid JSON",
    ),
    "card of 100 levels": (put(None, card=json.loads('{"a":' * 100 + "1" + "}" * 100)), "deeply"),
    "a brace 200,000 times": (text(b'{"a":' * 200_000), "not valid JSON"),
    "not UTF-8": (text(b'{"format": 2, "card": {"a": "\xff\xfe"}}'), "not valid JSON"),
    "NaN in JSON": (put(None, period=float("nan"), card={"x": float("nan")}), "NaN is no JSON"),
    "an integer of 5000 digits": (text(b'{"format": ' + b"9" * 5000 + b"}"), "not valid JSON"),
    "format of the future": (put(None, format=3), "has format 3, this version reads 1 to 2"),
    "format is true": (put(None, format=True), "has format True"),
    "format is text": (put(None, format="2"), "has format '2'"),
    "JSON is a list": (text(b"[]"), "no JSON object"),
    "JSON is empty": (text(b""), "not valid JSON"),
    "weights truncated": (
        lambda folder: weights(folder).write_bytes(weights(folder).read_bytes()[:-10]),
        "not a safetensors file",
    ),
    "weights empty": (lambda folder: weights(folder).write_bytes(b""), "not a safetensors file"),
    "weights with a tail": (
        lambda folder: weights(folder).write_bytes(weights(folder).read_bytes() + b"x" * 8),
        "not a safetensors file",
    ),
    "header of 2**62 bytes": (header(2**62, b"{}"), "not a safetensors file"),
    "header that is no JSON": (header(4, b"\xff\xff\xff\xff"), "not a safetensors file"),
    "header nested deeply": (header(100_000, b"[" * 100_000), "not a safetensors file"),
    "tensor of four terabytes": (header(len(HUGE_TENSOR), HUGE_TENSOR), "not a safetensors file"),
    "weights are a pickle": (
        lambda folder: weights(folder).write_bytes(pickle.dumps({"a": torch.ones(1)})),
        "not a safetensors file",
    ),
    "weights missing": (lambda folder: weights(folder).unlink(), "safetensors not found"),
    "JSON missing": (lambda folder: config(folder).unlink(), "json not found"),
    "weights are a folder": (replaced_by_folder(weights), "safetensors not found"),
    "JSON is a folder": (replaced_by_folder(config), "json not found"),
    "weights are a loop of links": (link_loop(weights), "safetensors not found"),
    "JSON is a loop of links": (link_loop(config), "json not found"),
    "JSON is a pipe": (fifo, "json not found"),
    "weights are a pipe": (pipe(weights), "safetensors not found"),
    "weights without an end": (link_to_zero(weights), "safetensors not found"),
    "JSON without an end": (link_to_zero(config), "json not found"),
    "an entry twice": (again('"format": 2'), "'format' stands there twice"),
    "an entry of the network twice": (again('"num_cells": [8]'), "'num_cells' stands there twice"),
    "minus infinity": (put(None, dtype=-math.inf), "-Infinity is no JSON"),
    "a tensor of a negative size": (
        header(len(NEGATIVE_TENSOR), NEGATIVE_TENSOR),
        "not a safetensors file",
    ),
    "a tensor of more entries than there are numbers": (
        header(len(OVERFLOWING_TENSOR), OVERFLOWING_TENSOR),
        "not a safetensors file",
    ),
    "JSON of 17 MiB": (text(b" " * (17 << 20)), "larger than 16 MiB"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_is_refused_in_one_line(folder, name):
    spoil, message = REFUSED[name]
    spoil(folder)
    with pytest.raises((ValueError, FileNotFoundError), match=message) as error:
        LOADERS[folder.name](folder)
    shown = str(error.value)
    assert len(shown.splitlines()) == 1 and len(shown) < 600, shown


POLICY = {
    "action_size is text": (put("network", action_size="2"), "action_size must be an integer"),
    "action_size is 10**6": (put("network", action_size=10**6), "action_size must be an integer"),
    "three actions": (put("network", action_size=3), "3 actions"),
    "objectives are text": (put(None, objectives="core"), "objectives must be a list"),
    "an objective twice": (put(None, objectives=["a", "a"], static={}), "repeats 'a'"),
    "an objective of two lines": (put(None, objectives=["a\nb"], static={}), "objectives must be"),
    "half a surrogate": (put(None, objectives=["\ud800"], static={}), "objectives must be"),
    "a weight of text": (put(None, static={"core": "1"}), "core must be a finite number"),
    "a weight of 10**400": (put(None, static={"core": 10**400}), "core must be a finite number"),
    "static is a list": (put(None, static=[1.0]), "static must be an object"),
    "another sensor": (put("sensing", num_sectors=60), "the actor reads 38 entries"),
    "no sectors": (put("sensing", num_sectors=0), "num_sectors must be"),
    "sectors of truth": (put("sensing", num_sectors=True), "num_sectors must be an integer"),
    "range as text": (put("sensing", max_range="4"), "max_range must be a finite number"),
    "negative range": (put("sensing", max_range=-4.0), "max_range must be finite and positive"),
    "range of 10**400": (put("sensing", max_range=10**400), "max_range must be a finite number"),
    "observe_human is 1": (put("sensing", observe_human=1), "observe_human must be true or false"),
    "goal_range upside down": (put("sensing", goal_range=[12, 0]), "goal_range must be two"),
    "nobody is null": (put("sensing", nobody=None), "nobody must be 2 finite numbers"),
    "memory": (put("sensing", history=4), "history must be 1"),
    "an entry more": (put("sensing", colour="red"), "unknown entry 'colour'"),
    "an entry less": (drop("sensing", "max_range"), "lacks 'max_range'"),
    "sensing is a list": (put(None, sensing=[]), "sensing must be an object"),
    "limits upside down": (put("limits", speed=[0.5, 0.0]), "speed must be two finite numbers"),
    "limits missing": (drop(None, "limits"), "lacks 'limits'"),
    "period is zero": (put(None, period=0), "period must be positive"),
    "robot with colours": (put(None, robot="\x1b[31mred"), "robot must be a printable"),
    "bounds of 5": (
        rewrite(lambda t: t | {"module.1.action_high": torch.full((2,), 5.0)}),
        r"actions are not in \[-1, 1\]",
    ),
}


@pytest.mark.parametrize("name", POLICY)
def test_a_policy_is_refused_in_one_line(originals, tmp_path, name):
    copy = tmp_path / "policy"
    copy.mkdir()
    for path in (originals / "policy").iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    spoil, message = POLICY[name]
    spoil(copy)
    with pytest.raises(ValueError, match=message) as error:
        load_policy(copy)
    assert len(str(error.value).splitlines()) == 1
    assert str(copy) in str(error.value)


def test_strings_of_a_card_stay_strings(folder, monkeypatch):
    monkeypatch.setenv("SECRET", "leaked")
    put(None, card={"config": {"env": {"scene": "${oc.env:SECRET}"}}})(folder)
    loaded = LOADERS[folder.name](folder)
    card = loaded.card if folder.name == "policy" else loaded[1]
    assert card["config"]["env"]["scene"] == "${oc.env:SECRET}"


def test_what_is_large_only_in_words_takes_no_memory(folder):
    """In a process of its own, whose address space ends a little above what it has."""
    put("network", num_cells=[30000, 30000])(folder)
    code = f"""
import resource
from torchrl_morl.deploy import load_policy, load_reward_model
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + (256 << 20),) * 2)
try:
    load_{folder.name}({str(folder)!r})
except ValueError as error:
    print("refused:", error)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert "refused:" in run.stdout and "does not fit" in run.stdout, run.stderr


def test_the_originals_load(originals):
    assert load_policy(originals / "policy").card == {"note": "mine"}
    assert load_reward_model(originals / "reward_model")[1] == {"note": "mine"}


@pytest.mark.parametrize("device", ["cuda:7", "tpu", "meta", 3.5])
def test_a_device_that_is_not_there_is_said_before_anything_is_read(device, tmp_path):
    for load in LOADERS.values():
        with pytest.raises(ValueError, match="device must be one that"):
            load(tmp_path / "nowhere", device=device)
