"""Policies on the Hub: up and down again over loopback, from the cache without a network, and what is refused."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import pytest

from tests import _any_robot as any_robot
from torchrl_morl.deploy import Sensing, from_hub, load_policy, push_to_hub
from torchrl_morl.deploy.hub_card import model_card
from torchrl_morl.testing import untrained_policy

from ._hub_server import FakeHub

ROOT = Path(__file__).parents[3]
POLISHED = ROOT / "recipes" / "policies" / "polished_seed0"
FILM = ROOT / "docs" / "images" / "sweep.gif"
NAMES = ("policy.json", "policy.safetensors")

pytest.importorskip("huggingface_hub")


@pytest.fixture
def hub(tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_DISABLE_TELEMETRY", "1")
    server = FakeHub()
    yield server
    server.shutdown()
    server.server_close()


@pytest.fixture
def there(hub) -> FakeHub:
    """A hub that has the shipped policy, and beside it what nobody should open."""
    hub.repos["me/navigation"] = {name: (POLISHED / name).read_bytes() for name in NAMES}
    hub.repos["me/navigation"]["pytorch_model.bin"] = b"a pickle"
    hub.repos["me/navigation"]["nested/policy.json"] = b"another"
    return hub


def test_up_and_down_again(hub, tmp_path):
    given = {"endpoint": hub.endpoint, "token": "hf_nothing"}
    url = push_to_hub(POLISHED, "me/navigation", film=FILM, license="mit", **given)
    assert url == f"{hub.endpoint}/me/navigation"
    files = hub.repos["me/navigation"]
    assert files.keys() == {*NAMES, "README.md", "film.gif"}
    assert files["film.gif"] == FILM.read_bytes()
    card = files["README.md"].decode()
    assert card.startswith("---\nlibrary_name: torchrl-morl\n") and "\nlicense: mit\n" in card
    assert "![The policy drives](film.gif)" in card
    assert "| efficiency | 100 | 0 | 0 | 18.03 |" in card

    folder = from_hub("me/navigation", cache_dir=tmp_path, endpoint=hub.endpoint)
    assert sorted(path.name for path in folder.iterdir()) == sorted(NAMES)
    for name in NAMES:
        assert (folder / name).read_bytes() == (POLISHED / name).read_bytes()
    assert load_policy(folder).robot == "turtlebot2"


def test_a_card_that_is_there_stays(there):
    there.repos["me/navigation"]["README.md"] = b"mine"
    push_to_hub(POLISHED, "me/navigation", endpoint=there.endpoint, token="hf_nothing")
    assert there.repos["me/navigation"]["README.md"] == b"mine"


def test_nothing_but_the_files_of_a_policy_is_downloaded(there, tmp_path):
    from_hub("me/navigation", cache_dir=tmp_path, endpoint=there.endpoint)
    asked = [line for line in there.asked if "/resolve/" in line]
    assert {line.rpartition("/")[2] for line in asked} == set(NAMES)
    assert not [line for line in asked if "nested" in line]
    assert not [path for path in tmp_path.rglob("*") if path.suffix in (".bin", ".pkl", ".pt")]


def test_offline_it_comes_from_the_cache_and_nobody_is_asked(there, tmp_path, monkeypatch):
    given = {"cache_dir": tmp_path, "endpoint": there.endpoint}
    folder = from_hub("me/navigation", **given)
    there.asked.clear()
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)  # the variable sets it
    assert from_hub("me/navigation", **given) == folder
    with pytest.raises(OSError, match="me/another is not in the cache"):
        from_hub("me/another", **given)
    assert there.asked == []


def test_without_a_network_it_comes_from_the_cache(there, tmp_path):
    given = {"cache_dir": tmp_path, "endpoint": there.endpoint}
    folder = from_hub("me/navigation", **given)
    there.shutdown()
    there.server_close()
    assert from_hub("me/navigation", **given) == folder


def test_a_folder_is_a_policy_as_well():
    assert from_hub(str(POLISHED)) == POLISHED


def test_what_was_changed_on_the_way_is_refused(there, tmp_path):
    weights = bytearray(there.repos["me/navigation"]["policy.safetensors"])
    weights[-1] ^= 1
    there.repos["me/navigation"]["policy.safetensors"] = bytes(weights)
    with pytest.raises(ValueError, match="its SHA-256 differs from the checksum"):
        from_hub("me/navigation", cache_dir=tmp_path, endpoint=there.endpoint)


@pytest.mark.parametrize(
    ("name", "given", "error", "message"),
    [
        ("me/another", {}, FileNotFoundError, "me/another is not on http"),
        ("me/empty", {}, FileNotFoundError, "a policy is a folder with"),
        ("me/navigation", {"revision": "v9"}, FileNotFoundError, "has no such revision"),
        (
            "a/b/c",
            {},
            ValueError,
            "repo_id must be NAME/POLICY, or a folder that is there, got 'a/b",
        ),
        ("not a name", {}, ValueError, "repo_id must be NAME/POLICY"),
    ],
)
def test_downloads_that_are_refused(there, tmp_path, name, given, error, message):
    there.repos["me/empty"] = {"README.md": b"nothing"}
    with pytest.raises(error, match=message) as found:
        from_hub(name, cache_dir=tmp_path, endpoint=there.endpoint, **given)
    assert len(str(found.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("folder", "given", "error", "message"),
    [
        (ROOT / "recipes", {}, FileNotFoundError, "a policy is a folder with"),
        (POLISHED, {"film": "film.exe"}, ValueError, "film must be one of .gif, .mp4, .webm"),
        (POLISHED, {"film": "no.gif"}, FileNotFoundError, "film no.gif not found"),
        (POLISHED, {"license": "MIT, mine"}, ValueError, "license must be a name such as"),
        (POLISHED, {"repo_id": "a b"}, ValueError, "repo_id must be NAME/POLICY"),
    ],
)
def test_uploads_that_are_refused_reach_no_server(hub, folder, given, error, message):
    given = {"repo_id": "me/mine", "endpoint": hub.endpoint, "token": "hf_nothing"} | given
    with pytest.raises(error, match=message) as found:
        push_to_hub(folder, **given)
    assert len(str(found.value).splitlines()) == 1
    assert hub.repos == {}


def test_a_server_that_is_not_there_is_one_line():
    with pytest.raises(OSError, match=r"me/mine on http://127\.0\.0\.1:9: ") as found:
        push_to_hub(POLISHED, "me/mine", endpoint="http://127.0.0.1:9", token="hf_nothing")
    assert len(str(found.value).splitlines()) == 1


def test_a_missing_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    for call in (lambda: from_hub("me/mine"), lambda: push_to_hub(POLISHED, "me/mine")):
        with pytest.raises(
            ImportError, match=r"huggingface_hub: pip install 'torchrl-morl\[hub\]'"
        ):
            call()


def test_a_card_without_an_evaluation_has_no_table_of_it():
    policy = load_policy(POLISHED)
    for evaluation in (None, 3, {"preferences": ["a"], "success": ["b"]}, {"preferences": 1}):
        policy.card["evaluation"] = evaluation
        assert "## Evaluation" not in model_card(policy, "me/mine")
    policy.card["evaluation"] = {"preferences": ["a | b"], "success": [99.25], "odd": [1, 2]}
    assert "| preference | success, % |\n| --- | --- |\n| a \\| b | 99.25 |" in model_card(
        policy, "x"
    )


def test_a_card_names_all_that_the_policy_reads():
    reads = dataclasses.replace(any_robot.SENSING, observe_motion=True)
    card, usual = (model_card(untrained_policy(sensing=s), "me/mine") for s in (reads, Sensing()))
    for row in (
        "| human | distance (m), bearing (rad), velocity (m/s), or nobody |",
        "| which robot it drives | radius (m), top speed (m/s),",
        "| how the robot moves | odometry;",
    ):
        assert row in card and row not in usual
    assert "| human | distance (m), bearing (rad) |" in usual
