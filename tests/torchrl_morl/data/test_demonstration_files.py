"""Demonstration files: what is saved comes back, and whatever is wrong with a file is said."""

from __future__ import annotations

import pickle

import pytest
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict

from torchrl_morl.data import load_demonstrations, save_demonstrations

METADATA = {"robot": "turtlebot2", "seed": 3, "versions": {"mujoco": "4.0"}, "levels": [0.0, 0.5]}
FORMAT = "torchrl_morl.demonstrations/1"


@pytest.fixture
def data() -> TensorDict:
    """Three trajectories of up to six steps, with several types of numbers."""
    mask = torch.arange(6) < torch.tensor([6, 2, 4])[:, None]
    return TensorDict(
        {
            "observation": torch.randn(3, 6, 5),
            "pose": torch.randn(3, 6, 3, dtype=torch.float64),
            "elapsed": torch.arange(18).reshape(3, 6, 1),
            "mask": mask,
            "next": {"observation": torch.randn(3, 6, 5), "done": ~mask.unsqueeze(-1)},
        },
        batch_size=[3, 6],
    )


@pytest.fixture
def path(tmp_path, data):
    return save_demonstrations(tmp_path / "runs" / "demos.safetensors", data, METADATA)


def test_round_trip(path, data):
    loaded, metadata = load_demonstrations(path)
    assert metadata == METADATA
    assert loaded.batch_size == data.batch_size
    keys = set(data.keys(include_nested=True, leaves_only=True))
    assert set(loaded.keys(include_nested=True, leaves_only=True)) == keys
    for key in keys:
        assert loaded[key].dtype == data[key].dtype
        assert torch.equal(loaded[key], data[key])


def test_path_may_be_a_string(tmp_path, data):
    save_demonstrations(str(tmp_path / "demos.safetensors"), data, {})
    assert load_demonstrations(str(tmp_path / "demos.safetensors"))[1] == {}


def test_views_and_tensors_that_share_memory(tmp_path, data):
    # Rollouts often hold one flag under two names, and parts of larger tensors.
    data["next", "terminated"] = data["next", "done"]
    for index, part in enumerate((data, data[:, 1:4])):
        file = save_demonstrations(tmp_path / f"{index}.safetensors", part, {})
        loaded, _ = load_demonstrations(file)
        assert (loaded == part).all()
        assert torch.equal(loaded["next", "terminated"], part["next", "done"])


def test_an_existing_file_is_not_overwritten(path, data):
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match=r"demos\.safetensors exists and is not overwritten"):
        save_demonstrations(path, data + 1, {})
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    "mask",
    [None, torch.ones(3, 6), torch.ones(3, 6, 1, dtype=torch.bool)],
    ids=["missing", "float", "shape"],
)
def test_a_boolean_mask_is_required(tmp_path, data, mask):
    del data["mask"]
    if mask is not None:
        data["mask"] = mask
    file = tmp_path / "runs" / "demos.safetensors"
    with pytest.raises(ValueError, match=r"boolean 'mask' of shape \[3, 6\]"):
        save_demonstrations(file, data, {})
    assert not file.parent.exists()


def test_missing_file_and_folder(tmp_path):
    for path in (tmp_path / "none.safetensors", tmp_path):
        with pytest.raises(FileNotFoundError, match=r"not found: demonstrations are a"):
            load_demonstrations(path)


@pytest.mark.parametrize("header", [None, {"format": "torchrl_morl.demonstrations/9"}])
def test_another_format_is_named(tmp_path, header):
    path = tmp_path / "other.safetensors"
    save_file({"mask": torch.ones(2, 3, dtype=torch.bool)}, path, header)
    with pytest.raises(ValueError, match=rf"has format .*, expected '{FORMAT}'"):
        load_demonstrations(path)


def test_the_right_format_without_a_mask(tmp_path):
    path = tmp_path / "maskless.safetensors"
    save_file({"action": torch.ones(2, 3)}, path, {"format": FORMAT, "metadata": "{}"})
    with pytest.raises(ValueError, match=r"maskless\.safetensors has no boolean 'mask'"):
        load_demonstrations(path)


@pytest.mark.parametrize("keep", [0, 4, 200, -1])
def test_a_broken_file(path, keep):
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ValueError, match=r"demos\.safetensors is not a safetensors file"):
        load_demonstrations(path)


class Trap:
    """Unpickling it would leave a mark."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return open, (str(self.mark), "w")


@pytest.mark.parametrize("write", [lambda x, f: pickle.dump(x, f), torch.save], ids=["plain", "pt"])
def test_a_pickle_is_refused_unopened(tmp_path, write):
    path, mark = tmp_path / "demos.safetensors", tmp_path / "mark"
    with path.open("wb") as file:
        write({"mask": Trap(mark)}, file)
    with pytest.raises(ValueError, match="is not a safetensors file"):
        load_demonstrations(path)
    assert not mark.exists()


def test_the_file_can_be_read_without_this_library(path, data):
    tensors = load_file(path)
    assert set(tensors) == {"observation", "pose", "elapsed", "mask"} | {
        "next/observation",
        "next/done",
    }
    assert torch.equal(tensors["next/observation"], data["next", "observation"])
