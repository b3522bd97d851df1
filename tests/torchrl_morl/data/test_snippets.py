from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_morl.data import RankedSnippets


def group(level: int, num: int, steps: int, durations=None, **extra) -> TensorDict:
    """Observations that tell where they come from: (level, trajectory, step)."""
    trajectory, step = torch.meshgrid(torch.arange(num), torch.arange(steps), indexing="ij")
    observation = torch.stack([torch.full_like(step, level), trajectory, step], -1).float()
    data = TensorDict(
        observation=observation, action=-observation, unused=step, batch_size=[num, steps], **extra
    )
    if durations is not None:
        data["mask"] = step < torch.as_tensor(durations)[:, None]
    return data


def groups(num: int = 6, steps: int = 20, levels: int = 4) -> list:
    """Level ``k`` has quality ``-0.1 * k``."""
    return [(-0.1 * k, group(k, num, steps)) for k in range(levels)]


def origin(snippets: TensorDict) -> tuple[torch.Tensor, ...]:
    """Level, trajectory and start of each snippet ``[B, L]``, after a check that it is in one piece."""
    observation = snippets["observation"].long()
    length = observation.shape[1]
    assert (observation[..., :2] == observation[:, :1, :2]).all()
    assert (observation[..., 2] - observation[:, :1, 2] == torch.arange(length)).all()
    return observation[:, 0].unbind(-1)


def test_shapes_and_keys():
    pairs = RankedSnippets(groups(), length=5, seed=0).sample(32)
    assert pairs.batch_size == (32,)
    for side in ("preferred", "other"):
        assert pairs[side].batch_size == (32, 5)
        assert set(pairs[side].keys()) == {"observation", "action"}
        assert torch.equal(pairs[side, "action"], -pairs[side, "observation"])
    assert pairs["gap"].shape == (32,)


@pytest.mark.parametrize(("min_gap", "least"), [(0.0, 1), (0.1, 1), (0.2, 2), (0.3, 3)])
def test_ranks(min_gap, least):
    pairs = RankedSnippets(groups(), length=5, min_gap=min_gap, seed=0).sample(500)
    better, worse = origin(pairs["preferred"])[0], origin(pairs["other"])[0]
    gap = worse - better
    assert gap.min() == least
    assert gap.max() == 3
    assert torch.allclose(pairs["gap"], 0.1 * gap)
    # All combinations of groups are about equally likely.
    count = torch.bincount(4 * better + worse)
    count = count[count > 0].float()
    assert count.max() / count.min() < 2


def test_a_gap_is_not_missed_by_rounding():
    assert 0.3 - 0.1 < 0.2
    data = [(-0.1, group(0, 3, 9)), (-0.3, group(1, 3, 9))]
    assert len(RankedSnippets(data, length=5, min_gap=0.2, seed=0).sample(4)) == 4


@pytest.mark.gpu
def test_gpu():
    data = [(quality, trajectories.to("cuda")) for quality, trajectories in groups()]
    train, held_out = RankedSnippets(data, length=5, seed=0).split(0.3)
    for part in (train, held_out):
        pairs = part.sample(20)
        assert {value.device.type for value in pairs.values(True, True)} == {"cuda"}


def test_groups_of_the_same_quality_are_not_compared():
    same = [(1.0, group(0, 3, 9)), (1.0, group(1, 3, 9)), (0.0, group(2, 3, 9))]
    pairs = RankedSnippets(same, length=5, seed=0).sample(100)
    assert set(origin(pairs["preferred"])[0].tolist()) == {0, 1}
    assert set(origin(pairs["other"])[0].tolist()) == {2}


def test_everything_is_reached():
    data = [(1.0, group(0, 3, 8)), (0.0, group(1, 5, 11))]
    pairs = RankedSnippets(data, length=4, seed=0).sample(2000)
    for side, num, steps in (("preferred", 3, 8), ("other", 5, 11)):
        _, trajectory, start = origin(pairs[side])
        assert trajectory.unique().tolist() == list(range(num))
        assert start.unique().tolist() == list(range(steps - 4 + 1))


def test_short_trajectories_are_left_out():
    durations = [20, 4, 5, 0]
    data = [(1.0, group(0, 4, 20, durations)), (0.0, group(1, 2, 20))]
    snippets = RankedSnippets(data, length=5, seed=0)
    assert snippets.num_left_out == 2
    _, trajectory, start = origin(snippets.sample(500)["preferred"])
    assert trajectory.unique().tolist() == [0, 2]
    assert (start[trajectory == 2] == 0).all()
    assert start.max() == 15
    with pytest.raises(ValueError, match="2 of 6 trajectories are long enough"):
        RankedSnippets([(1.0, data[0][1]), (0.0, group(1, 2, 4))], length=5)


def test_focus():
    data = groups()
    for _, trajectories in data:
        step = torch.arange(20).expand(6, 20)
        # Trajectory 0 has no such steps.
        trajectories["near"] = (step >= 8) & (step < 11) & (step.new_tensor(range(6))[:, None] > 0)
    pairs = RankedSnippets(data, length=5, focus_key="near", seed=0).sample(2000)
    for side in ("preferred", "other"):
        _, trajectory, start = origin(pairs[side])
        assert start[trajectory > 0].unique().tolist() == [8, 9, 10]
        assert start[trajectory == 0].unique().numel() > 10


def test_seed():
    first, second, third = (RankedSnippets(groups(), length=5, seed=seed) for seed in (3, 3, 4))
    expected = first.sample(50)
    # The global generator has no part in it.
    torch.manual_seed(100)
    assert (second.sample(50) == expected).all()
    assert not (third.sample(50) == expected).all()
    assert not (first.sample(50) == expected).all()
    assert RankedSnippets(groups(), length=5).generator.initial_seed() != torch.initial_seed()


class TestSplit:
    def test_parts_share_no_trajectory(self):
        parts = RankedSnippets(groups(num=10), length=5, seed=0).split(0.3)
        seen = []
        for part in parts:
            pairs = part.sample(2000)
            seen.append(set())
            for side in ("preferred", "other"):
                level, trajectory, _ = origin(pairs[side])
                seen[-1] |= set((100 * level + trajectory).tolist())
        assert not seen[0] & seen[1]
        assert [len(part) for part in seen] == [7 * 4, 3 * 4]

    def test_the_seed_decides_what_is_held_out(self):
        held_out = [
            RankedSnippets(groups(), length=5, seed=seed).split(0.3)[1].sample(20)
            for seed in (1, 1, 2)
        ]
        assert (held_out[0] == held_out[1]).all()
        assert not (held_out[0] == held_out[2]).all()

    def test_parts_do_not_disturb_each_other(self):
        first, second = (RankedSnippets(groups(), length=5, seed=0).split(0.3) for _ in range(2))
        first[1].sample(100)
        assert (first[0].sample(20) == second[0].sample(20)).all()

    def test_invalid(self):
        snippets = RankedSnippets(groups(num=1), length=5, seed=0)
        with pytest.raises(ValueError, match="no two groups"):
            snippets.split(0.5)
        for fraction in (0.0, 1.0):
            with pytest.raises(ValueError, match="fraction must be between 0 and 1"):
                snippets.split(fraction)


def test_nested_keys_and_mask_of_one_entry():
    data = []
    for quality in (0.0, 1.0):
        flat = group(int(quality), 3, 9, [9, 9, 2])
        nested = TensorDict(agent=flat.select("observation"), batch_size=[3, 9])
        nested["collector", "mask"] = flat["mask"].unsqueeze(-1)
        data.append((quality, nested))
    snippets = RankedSnippets(
        data, length=5, in_keys=[("agent", "observation")], mask_key=("collector", "mask"), seed=0
    )
    assert snippets.num_left_out == 2
    assert snippets.sample(4)["preferred", "agent", "observation"].shape == (4, 5, 3)


def test_invalid():
    with pytest.raises(ValueError, match="length must be at least 1"):
        RankedSnippets(groups(), length=0)
    for min_gap in (-0.1, float("nan")):
        with pytest.raises(ValueError, match=f"min_gap must be finite and >= 0, got {min_gap}"):
            RankedSnippets(groups(), length=5, min_gap=min_gap)
    with pytest.raises(ValueError, match="at least two groups, got 1"):
        RankedSnippets(groups(levels=1), length=5)
    with pytest.raises(ValueError, match=r"no two groups at least 0\.5 apart"):
        RankedSnippets(groups(), length=5, min_gap=0.5)
    holes = groups()
    holes[0][1]["mask"] = torch.arange(20).expand(6, 20) % 2 == 0
    with pytest.raises(ValueError, match="'mask' must be true up to the end"):
        RankedSnippets(holes, length=5)
    with pytest.raises(KeyError, match="near"):
        RankedSnippets(groups(), length=5, focus_key="near")
