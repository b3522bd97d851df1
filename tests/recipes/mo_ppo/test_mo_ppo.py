"""MO-PPO from a policy: a short run, its likelihoods and its anchor by hand, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from recipes.mo_ppo import mo_ppo
from recipes.training import on_policy
from recipes.training.ppo_optimizers import make_schedule
from tests._mo_ppo import CONFIG, SHIPPED, SPACE, run, small_policy
from torchrl_morl import PreferenceSpace
from torchrl_morl.deploy import load_policy, save_policy, save_reward_model
from torchrl_morl.deploy.features import OBSERVATION_SIZE
from torchrl_morl.modules import RewardModel


@pytest.fixture(scope="module")
def polished(tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("mo_ppo")
    start = small_policy(folder / "start")
    return start, run(folder / "run", start)


def test_writes_policies_that_load(polished):
    start, folder = polished
    saved = sorted((folder / "policies").glob("*"))
    assert [path.name for path in saved] == ["000000064", "000000128"]
    policy = load_policy(saved[-1])
    actor, preference_space, card = policy.actor, policy.preference_space, policy.card
    assert preference_space == SPACE
    assert card["start"]["config"] == CONFIG
    assert card["config"]["loss"]["lmbda"] == 0.8
    # What was null is what the policy was trained in, but for the scene: that of its evaluations.
    own = {"scene": "static", "num_envs": 4, "num_threads": 1, "repeat_failed": 0.25}
    assert card["config"]["env"] == CONFIG["env"] | own
    assert card["config"]["evaluation"]["scene"] == "static"
    before = load_policy(start).actor
    assert actor.state_dict().keys() == before.state_dict().keys()
    assert any(
        not torch.equal(value, before.state_dict()[name])
        for name, value in actor.state_dict().items()
    )
    assert (folder / "run.json").is_file()


def test_same_seed_same_policy(polished, tmp_path):
    start, folder = polished
    again = run(tmp_path / "run", start)
    name = "policies/000000128/policy.safetensors"
    assert (again / name).read_bytes() == (folder / name).read_bytes()


def test_critic_learns_first(polished, tmp_path):
    start, _ = polished
    folder = run(tmp_path / "run", start, "optim.critic_batches=4")
    actor = load_policy(folder / "policies" / "000000128").actor
    before = load_policy(start).actor
    for name, value in actor.state_dict().items():
        assert torch.equal(value, before.state_dict()[name]), name


def test_critic_alone_learns_whole_returns_in_more_passes(polished, tmp_path, monkeypatch):
    start, _ = polished
    seen, plain_advantage, plain_step = [], mo_ppo.make_advantage, on_policy.step

    def make_advantage(*args):
        advantage = plain_advantage(*args)

        def recorded(module, _):
            seen.append(round(module.lmbda.item(), 6))

        advantage.register_forward_pre_hook(recorded)
        return advantage

    def step(optimizer, loss, *args):
        seen.append("step")
        return plain_step(optimizer, loss, *args)

    monkeypatch.setattr(mo_ppo, "make_advantage", make_advantage)
    monkeypatch.setattr(on_policy, "step", step)
    run(tmp_path / "run", start, "optim.critic_batches=2", "optim.critic_epochs=3")
    # Four batches of two small ones: of the critic, and then of the critic and of the actor.
    alone, both = [1.0, *["step"] * 2 * 3], [0.8, *["step"] * 2 * 2]
    assert seen == [*alone, *alone, *both, *both]


def test_anchor_holds_a_policy_with_demonstrations(tmp_path):
    objectives = ("core", "demo", *SPACE.tunable)
    start = small_policy(tmp_path / "start", PreferenceSpace(objectives, static={"core": 1.0}))
    torch.manual_seed(0)
    model = RewardModel(in_features=OBSERVATION_SIZE + 2, num_cells=(8,), num_members=1)
    save_reward_model(tmp_path / "model", model, card={})
    moved = []
    for coefficient in (1e-9, 1e6):
        folder = run(
            tmp_path / str(coefficient),
            start,
            f"demonstrations.reward_model={tmp_path / 'model'}",
            f"loss.anchor_coeff={coefficient}",
            "loss.anchor_radius=100",  # everywhere: few of these short episodes meet the human
            "env.max_episode_steps=300",  # what ends too late is not held
            *("optim.lr=1e-2", "optim.epochs=3"),
            *("collector.total_frames=320", "evaluation.interval=320"),
        )
        rows = (folder / "log_csv/scalars/train/anchor.csv").read_text().split()
        moved.append(float(rows[-1].split(",")[-1]))
    assert 0 < moved[1] < moved[0] / 2, moved


def test_smoothness_steadies_a_policy(polished, tmp_path):
    start, _ = polished
    changes = []
    for coefficient in (1e-9, 1e6):
        folder = run(
            tmp_path / str(coefficient),
            start,
            f"loss.smoothness_coeff={coefficient}",
            *("optim.lr=1e-2", "optim.epochs=3"),
            *("collector.total_frames=320", "evaluation.interval=320"),
        )
        rows = (folder / "log_csv/scalars/train/smoothness.csv").read_text().split()
        changes.append(float(rows[-1].split(",")[-1]))
        assert (folder / "log_csv/scalars/train/failed.csv").exists()
    assert 0 < changes[1] < changes[0] / 2, changes


def test_trains_in_bfloat16(polished, tmp_path, monkeypatch):
    start, folder = polished
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True})
    rounded = run(tmp_path / "run", start, "compute.bfloat16=null")
    name = "policies/000000128"
    cards = [load_policy(path / name).card for path in (folder, rounded)]
    assert [card["bfloat16"] for card in cards] == [False, True]
    weights = [load_policy(path / name).actor.state_dict() for path in (folder, rounded)]
    assert all(value.dtype == torch.float32 for value in weights[1].values())
    moved = [torch.equal(weights[0][key], weights[1][key]) for key in weights[0]]
    assert not all(moved)


def test_the_rate_falls_over_all_frames_of_a_training():
    def rates(frames, total, steps, *, begin=0, loaded=None):
        """Of the actor, at the first batch and after every further one."""
        optimizer = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))], lr=0.2)
        if loaded is not None:
            optimizer.load_state_dict(loaded)
        cfg = OmegaConf.create(
            {
                "collector": {"total_frames": total, "frames_per_batch": 10},
                "optim": {"lr": 0.2, "critic_batches": 2},
            }
        )
        schedule = make_schedule(cfg, optimizer, frames, begin)
        found = [optimizer.param_groups[0]["lr"]]
        for _ in range(steps):
            optimizer.step()
            schedule.step()
            found.append(optimizer.param_groups[0]["lr"])
        return found, optimizer.state_dict()

    # Twelve batches, two of which are for the critic alone: ten steps down to a twentieth.
    whole, over = rates(0, 120, 10)
    assert whole == pytest.approx([0.2 - 0.019 * step for step in range(11)])
    # Cut after six batches, four of which had an update.
    cut = rates(0, 120, 4)[1]
    assert rates(60, 120, 6, loaded=cut)[0] == pytest.approx(whole[4:])
    # Cut while the critic was alone.
    assert rates(10, 120, 0, loaded=cut)[0] == pytest.approx([0.2])
    # It was over, and goes on for ten batches; that was cut after four.
    assert rates(120, 220, 10, begin=120, loaded=over)[0] == pytest.approx(whole)
    assert rates(160, 220, 6, begin=120, loaded=cut)[0] == pytest.approx(whole[4:])


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("optim.batch_size=64", "optim.batch_size must lie between"),
        ("collector.exploration_sigma=[0.05,0]", "exploration_sigma must be positive"),
        ("loss.anchor_coeff=-1", "anchor_coeff must not be negative"),
        ("loss.anchor_radius=-1", "anchor_radius must not be negative"),
        ("loss.anchor_clearance=-1", "anchor_clearance must not be negative"),
        ("loss.final_lmbda=1.1", "final_lmbda must be in"),
        ("loss.anchor_window=4", "anchor_window must be an odd number of steps, .* got 4"),
        ("loss.anchor_window=-1", "anchor_window must be an odd number of steps, .* got -1"),
        ("loss.smoothness_coeff=-1", "smoothness_coeff must not be negative"),
        ("loss.standing_coeff=-1", "standing_coeff must not be negative"),
        ("loss.gamma=1.5", "loss.gamma must be in"),
        ("collector.frames_per_batch=30", "must be a multiple of env.num_envs, 4, got 30"),
        ("optim.batch_size=0", "optim.batch_size must lie between"),
        ("optim.penalty_batch_size=0", "penalty_batch_size must be at least 1, got 0"),
        ("optim.critic_epochs=0", "critic_epochs must be at least 1, got 0"),
        ("optim.epochs=0", "optim.epochs must be at least 1, got 0"),
        ("optim.critic_batches=-1", "critic_batches must be at least 0, got -1"),
        ("env.observe_human=false", "observations of 36 entries, here they have 33"),
        ("policy=nowhere", "nowhere"),
        (
            "resume=nowhere",
            "resume=nowhere is no run: it must be the folder of one that has begun.",
        ),
    ],
)
def test_refuses_bad_configurations(polished, tmp_path, override, message):
    start, _ = polished
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        run(tmp_path / "run", start, override)
    assert not (tmp_path / "run" / "policies").exists()


def test_refuses_a_policy_of_other_objectives(tmp_path):
    with pytest.raises(ValueError, match=r"demonstrations\.reward_model must name"):
        run(tmp_path / "run", SHIPPED)


def test_asks_for_what_the_card_does_not_tell(polished, tmp_path):
    start, _ = polished
    loaded = load_policy(start)
    actor, preference_space, card = loaded.actor, loaded.preference_space, loaded.card
    del card["config"]["env"]["scene"], card["config"]["evaluation"]
    policy = save_policy(
        tmp_path / "policy",
        actor,
        preference_space=preference_space,
        card=card,
    )
    with pytest.raises(ValueError, match=r"does not say what it was trained in: give env\.scene\."):
        run(tmp_path / "run", policy)
    folder = run(tmp_path / "again", policy, "env.scene=corridor")
    card = load_policy(folder / "policies" / "000000128").card
    assert card["config"]["evaluation"]["scene"] == "corridor"
