"""What a reward model pays: by hand, and from the command line."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded

from recipes.drex import landscape
from recipes.drex.cards import metadata
from recipes.drex.ranking import make_reward_model, save_model
from tests._command import run
from tests._drex import TINY, config
from torchrl_morl import PreferenceSpace
from torchrl_morl.deploy import save_policy
from torchrl_morl.modules import make_actor

SHIPPED = Path(landscape.__file__).parents[1] / "policies"


def by_distance(near: float, far: float) -> TensorDictModule:
    """R that reads the first entry of the observation: 1 near the human, 0 away from them."""
    return TensorDictModule(
        lambda observation, action: torch.where(observation[..., :1] > 0.5, near, far),
        in_keys=["observation", "action"],
        out_keys=["demo_score"],
    )


def test_what_is_paid_by_hand():
    """Two scenes of three steps, of which the second is not free; the last step is behind the end."""
    human = torch.tensor([[1.0, 1.5, 3.0], [1.0, 1.0, 1.0]])
    data = TensorDict(
        observation=(human < 2.0).float().unsqueeze(-1),
        action=torch.zeros(2, 3, 2),
        human=torch.stack((human, torch.zeros(2, 3)), -1),
        pose=torch.zeros(2, 3, 3),
        human_pose=torch.zeros(2, 3, 3),
        mask=torch.tensor([[True, True, True], [True, True, False]]),
        next=TensorDict(
            success=torch.tensor([[[False], [False], [True]], [[False], [False], [False]]]),
            done=torch.tensor([[[False], [False], [True]], [[False], [True], [False]]]),
            pose=torch.zeros(2, 3, 3),
            human_pose=torch.zeros(2, 3, 3),
            batch_size=[2, 3],
        ),
        batch_size=[2, 3],
    )
    reference = TensorDict(
        position=torch.zeros(2, 4, 2).index_fill(1, torch.tensor([3]), 0.5),
        mask=torch.ones(2, 4, dtype=torch.bool),
        batch_size=[2],
    )
    row = landscape.paid(
        by_distance(near=0.8, far=0.3),
        data,
        reference,
        torch.tensor([True, False]),
        driver="anyone",
        noise=(0.0, 0.0),
        scale=10.0,
    )
    assert row.episode == pytest.approx(10 * (2 * -0.2 - 0.7))
    assert (row.near, row.far) == (pytest.approx(0.8), pytest.approx(0.3))
    assert row.success == 1.0
    assert row.frechet == pytest.approx(0.5 * 2**0.5, abs=1e-5)


def paid(driver: str, episode: float, noise=(0.0, 0.0), success=1.0) -> landscape.Paid:
    return landscape.Paid(driver, noise, episode, 0.96, 0.94, 0.1, success)


def test_the_verdict_names_who_is_paid_most():
    rows = [
        paid("demonstrator", -20.0),
        paid("orbit 0.90 m", -25.0),
        paid("straight", -1.0, success=0.1),
    ]
    text = landscape.verdict(rows)
    assert "near the human: 0.960" in text
    assert "away from them: 0.940" in text
    # Who hardly arrives has short episodes, not a better style.
    assert "the demonstrator gets -20, the next, orbit 0.90 m, -25" in text


@pytest.fixture
def model(tmp_path) -> Path:
    cfg = config(overrides=(*TINY, "env.scene=empty"))
    save_model(tmp_path / "model", cfg, make_reward_model(cfg), metadata(cfg))
    return tmp_path / "model"


@pytest.mark.slow
def test_from_the_command_line(model, tmp_path):
    output = tmp_path / "out"
    arguments = (
        "--policies",
        SHIPPED / "polished_seed0",
        "--noise",
        "0.1",
        "0.2",
        "--episodes",
        "3",
    )
    result = run("recipes.drex.landscape", model, *arguments, "--output", output)
    assert result.returncode == 0, result.stderr
    with (output / "landscape.csv").open() as file:
        rows = list(csv.DictReader(file))
    drivers = [row["driver"] for row in rows]
    assert drivers[0] == "demonstrator"
    assert drivers[-1] == "polished_seed0"
    assert len(rows) == len(landscape.RADII) + 6
    assert {row["noise_turn"] for row in rows} == {"0.2"}
    # R starts at a half everywhere.
    assert float(rows[0]["near"]) == pytest.approx(0.5, abs=0.02)
    assert (output / "landscape.png").read_bytes().startswith(b"\x89PNG")
    assert "R of the demonstrator near the human" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "must be a folder, 'nowhere' does not exist"),
        (["MODEL", "--seed", "3"], "Seed 3 draws scenes for training"),
        (["MODEL", "--noise", "-1", "0"], "must be a number from 0, got '-1'"),
    ],
)
def test_what_is_refused(model, tmp_path, arguments, message):
    given = [str(model) if one == "MODEL" else one for one in arguments]
    result = run("recipes.drex.landscape", *given, "--output", tmp_path / "out")
    assert result.returncode == 2
    assert message in result.stderr.splitlines()[-1]
    assert not (tmp_path / "out").exists()


def test_refuses_a_policy_without_the_objective(tmp_path):
    space = PreferenceSpace(("core", "distance", "efficiency"), static={"core": 1.0})
    actor = make_actor(Bounded(-1.0, 1.0, (2,)), in_features=36 + 2, num_cells=(8,))
    folder = save_policy(tmp_path / "policy", actor, preference_space=space, card={})
    with pytest.raises(ValueError, match="none of them 'demo'"):
        landscape.given(config(), [folder])


def test_refuses_a_model_of_recorded_drives(model):
    path = model / "reward_model.json"
    content = json.loads(path.read_text())
    del content["card"]["demonstrator"]
    with pytest.raises(ValueError, match="recorded demonstrations"):
        landscape.configuration(content["card"], model)
