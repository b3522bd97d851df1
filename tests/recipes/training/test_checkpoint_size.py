"""Checkpoints take no more room in a long training than in one that has filled its replay buffer."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose

from recipes.training.checkpoint import BufferState, Checkpoints, Counters

ROOM = 64


def contents(folder: Path) -> tuple[int, int]:
    """Files, and bytes of all of them."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return len(files), sum(path.stat().st_size for path in files)


def training(folder: Path) -> tuple[Checkpoints, TensorDictReplayBuffer, Counters]:
    network = torch.nn.Linear(5, 3)
    optimizer = torch.optim.Adam(network.parameters())
    network(torch.ones(5)).sum().backward()
    optimizer.step()
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(ROOM), batch_size=4, transform=Compose()
    )
    count = Counters(frames=100)
    return (
        Checkpoints(
            folder,
            network=network,
            optimizer=optimizer,
            replay_buffer=BufferState(buffer),
            count=count,
        ),
        buffer,
        count,
    )


def test_many_checkpoints_take_the_room_of_one(tmp_path):
    checkpoints, buffer, count = training(tmp_path)
    sizes = []
    for _ in range(12):  # the buffer is full after four
        buffer.extend(TensorDict({"x": torch.randn(16, 7)}, batch_size=[16]))
        count.frames += 16
        checkpoints.save(count.frames)
        assert len(list(tmp_path.iterdir())) == 1
        sizes.append(contents(tmp_path))
    assert sizes[0][1] < sizes[1][1] < sizes[3][1]  # what there is to be saved
    assert len({files for files, _ in sizes}) == 1
    spread = max(size for _, size in sizes[3:]) - min(size for _, size in sizes[3:])
    assert spread < 100  # the digits of counters


@pytest.mark.parametrize("step", [116, 10**9])
def test_what_a_killed_process_was_writing_is_removed_by_the_next_one(step, tmp_path):
    checkpoints, buffer, count = training(tmp_path)
    buffer.extend(TensorDict({"x": torch.randn(16, 7)}, batch_size=[16]))
    checkpoints.save(count.frames)
    before = contents(tmp_path)
    for name in (f".checkpoint-{step:012d}.tmp", ".checkpoint-1.partial-abc"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "half").write_bytes(bytes(1000))
    again, *_ = training(tmp_path)
    assert again.load()
    assert contents(tmp_path) == before
