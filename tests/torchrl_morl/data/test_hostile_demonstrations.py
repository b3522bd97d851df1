"""Demonstrations that somebody else wrote: each loads or is refused in one line."""

from __future__ import annotations

import json
import struct

import pytest
import torch
from safetensors.torch import save_file
from tensordict import TensorDict

from torchrl_morl.data import load_demonstrations, save_demonstrations

METADATA = {"format": "torchrl_morl.demonstrations/1", "metadata": "{}"}
MASK = torch.ones(2, 5, dtype=torch.bool)
DEMONSTRATIONS = {
    "another batch": ({"mask": MASK, "x": torch.ones(3, 5)}, METADATA, "does not begin with"),
    "fewer dimensions": ({"mask": MASK, "x": torch.ones(2)}, METADATA, "does not begin with"),
    "nothing": ({"mask": MASK[:0], "x": torch.ones(0, 5)}, METADATA, "holds nothing"),
    "mask of numbers": ({"mask": MASK.float()}, METADATA, "no boolean 'mask'"),
    "mask of no dimension": ({"mask": torch.tensor(True)}, METADATA, "no boolean 'mask'"),
    "complex": ({"mask": MASK, "x": torch.ones(2, 5, dtype=torch.complex64)}, METADATA, "is C64"),
    "float16": ({"mask": MASK, "x": torch.ones(2, 5).half()}, METADATA, "is F16"),
    "an empty key": ({"mask": MASK, "a//b": torch.ones(2, 5)}, METADATA, "no key of a tensordict"),
    "a key below a leaf": (
        {"mask": MASK, "a": torch.ones(2, 5), "a/b": torch.ones(2, 5)},
        METADATA,
        "no key of a tensordict",
    ),
    "keys as deep as memory": (
        {"mask": MASK, "a/" * 50_000 + "b": torch.ones(2, 5)},
        METADATA,
        "no key of a tensordict",
    ),
    "a key of two lines": ({"mask": MASK, "a\nb": torch.ones(2, 5)}, METADATA, "no key of a"),
    "metadata missing": ({"mask": MASK}, {"format": METADATA["format"]}, "not valid JSON"),
    "metadata broken": ({"mask": MASK}, METADATA | {"metadata": "{"}, "not valid JSON"),
    "metadata as list": ({"mask": MASK}, METADATA | {"metadata": "[]"}, "are no JSON object"),
    "metadata nested": ({"mask": MASK}, METADATA | {"metadata": "[" * 200_000}, "not valid JSON"),
    "another format": ({"mask": MASK}, METADATA | {"format": "x" * 10_000}, "has format"),
    "no metadata at all": ({"mask": MASK}, None, "has format None"),
}


@pytest.mark.parametrize("name", DEMONSTRATIONS)
def test_demonstrations_are_refused_in_one_line(tmp_path, name):
    tensors, metadata, message = DEMONSTRATIONS[name]
    path = tmp_path / "demos.safetensors"
    save_file(tensors, path, metadata)
    with pytest.raises(ValueError, match=message) as error:
        load_demonstrations(path)
    assert len(str(error.value).splitlines()) == 1 and len(str(error.value)) < 600


def test_a_truth_that_is_neither_true_nor_false(tmp_path):
    steps = TensorDict(x=torch.rand(2, 5), mask=MASK, batch_size=[2, 5])
    path = save_demonstrations(tmp_path / "right.safetensors", steps, {"seed": 0})
    assert load_demonstrations(path)[1] == {"seed": 0}
    data = bytearray(path.read_bytes())
    (length,) = struct.unpack("<Q", data[:8])
    start, _ = json.loads(data[8 : 8 + length])["mask"]["data_offsets"]
    data[8 + length + start] = 2
    path = tmp_path / "demos.safetensors"
    path.write_bytes(data)
    with pytest.raises(ValueError, match="'mask' holds values that are neither true nor false"):
        load_demonstrations(path)
