"""What a page holds to ask which of two drives somebody likes better."""

from __future__ import annotations

import base64
import dataclasses
from pathlib import Path
from typing import Any

from recipes.choices.outcomes import outcomes_of
from recipes.choices.rollouts import DRIVES
from recipes.evaluation.setting import demonstrator, trained_in
from recipes.objectives import DEMO
from torchrl_morl.choices import PreferencePosterior
from torchrl_morl.deploy import load_policy


def choices(folder: Path, *, drives: Path = DRIVES) -> dict[str, Any] | None:
    """What the page's questions are made of, as JSON values.

    The page drives the two drives of a question itself; what all drives have reached, and how a person
    is taken to answer, come from here. ``python -m recipes.choices`` asks the same questions.

    Args:
        folder: of the policy.

    Keyword Args:
        drives: folder where drives of policies other than the shipped one are kept.

    Returns:
        ``None`` for a policy that cannot be asked about: with one objective, with more than a grid
        holds, or with a demonstration to be like and no demonstrator.
    """
    policy = load_policy(folder)
    tunable = policy.preference_space.tunable
    setting = trained_in(policy.card).with_one_robot.with_one_human
    shown = demonstrator(policy.card, setting.robot)
    if len(tunable) < 2 or (DEMO in tunable and shown is None):
        return None
    posterior = PreferencePosterior(tunable)
    if not posterior.exact:
        return None
    found = outcomes_of(folder, drives=drives)
    state = posterior.state_dict()
    starts = {name: value.tolist() for name, value in found.scenes.items()}
    return {
        "policy": folder.name,
        "preferences": [[round(w, 6) for w in row] for row in found.preferences.tolist()],
        "outcomes": _base64(found.outcomes.numpy().astype("<f4").tobytes()),
        "arrived": _base64(found.arrived.numpy().astype("u1").tobytes()),
        "scenes": [
            {
                **{name: values[scene] for name, values in starts.items()},
                "human_speed": setting.scene.human_speed,
            }
            for scene in range(len(found.outcomes))
        ],
        "model": dataclasses.asdict(posterior.model),
        "divisions": state["divisions"],
        "seed": 0,
    }


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()
