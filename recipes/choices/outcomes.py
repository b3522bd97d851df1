"""What questions are made of: scenes, and the outcomes of many preferences in them.

For the shipped policy they lie beside this file, which a page is made with at once. When that policy
or the scenes have changed, make the file anew, in some minutes::

    python -m recipes.choices.outcomes
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from tensordict import TensorDictBase
from torch import Tensor

from envs.policy_env import make_policy_env
from torchrl_morl.deploy import load_policy
from torchrl_morl.deploy.files import file_checksum
from torchrl_morl.transforms import PreferenceSampler

from ..arguments import Parser
from ..evaluation.setting import Setting, trained_in
from ..evaluation.sweep import SHIPPED_POLICY
from .rollouts import (
    DRIVES,
    NUM_SCENES,
    SEED,
    Request,
    arrived,
    described,
    joint_outcomes,
    obtain,
    usual_scene,
)

SHIPPED = Path(__file__).with_name("navigation_outcomes.safetensors")
_SCENES = ("start", "goal", "human", "human_goal", "boxes")


@dataclasses.dataclass(frozen=True)
class Outcomes:
    """What ``P`` preferences did in ``S`` scenes, as far as questions need it."""

    preferences: Tensor
    """``[P, T]``"""
    outcomes: Tensor
    """``[S, P, T]``, of :func:`recipes.choices.rollouts.joint_outcomes`."""
    arrived: Tensor
    """``[S, P]``, bool."""
    scenes: dict[str, Tensor]
    """How each scene starts: ``start`` and ``human`` [S, 3], ``goal`` and ``human_goal`` [S, 2],
    ``boxes`` [S, M, 5]."""


def outcomes_of(policy_folder: Path, *, drives: Path = DRIVES) -> Outcomes:
    """Outcomes of a policy in the scenes that ``python -m recipes.choices`` asks about by default.

    With one robot and one human, as a page has: where every episode draws a robot it is a TurtleBot 2,
    where people have ways of their own it is ``static``.

    From the file that is shipped, if it is of this policy; otherwise from its drives, which are made
    once, with a progress bar.

    Args:
        policy_folder: of the policy.

    Keyword Args:
        drives: folder where drives are kept.

    Raises:
        ValueError: for a policy whose drives cannot be compared, or a file that is refused.
    """
    setting = trained_in(load_policy(policy_folder).card).with_one_robot.with_one_human
    if SHIPPED.exists() and request_of(SHIPPED) == dataclasses.asdict(
        _request(policy_folder, setting)
    ):
        return load(SHIPPED)
    return _driven(policy_folder, drives)


def _driven(policy_folder: Path, drives: Path) -> Outcomes:
    scene = usual_scene(load_policy(policy_folder).card)
    result, setting = obtain(policy_folder, scene, scenes=NUM_SCENES, seed=SEED, folder=drives)
    start = first_moments(policy_folder, setting)
    scenes = {
        "start": start["pose"],
        "goal": start["scene", "goal"],
        "human": start["human_pose"],
        "human_goal": start["scene", "human_goal"],
        "boxes": start["scene", "boxes"],
    }
    for name in ("start", "goal", "human", "boxes"):
        torch.testing.assert_close(scenes[name], result.scenes[name], rtol=0, atol=0)
    (values,) = joint_outcomes({"": result}).values()
    return Outcomes(result.preferences, values, arrived(result), scenes)


def first_moments(policy_folder: Path, setting: Setting) -> TensorDictBase:
    """How the scenes start, ``[S]``, without driving in them."""
    space = load_policy(policy_folder).preference_space
    env = make_policy_env(
        PreferenceSampler(space),
        keep_simulation=True,
        num_envs=NUM_SCENES,
        seed=SEED,
        **setting.arguments,
    )
    env.set_seed(SEED)
    start = env.reset()
    env.close()
    return start


def save(path: Path, found: Outcomes, request: Request) -> None:
    """Write outcomes; a file of that name is replaced."""
    tensors = {name: getattr(found, name) for name in ("preferences", "outcomes", "arrived")}
    tensors |= {f"scenes/{name}": found.scenes[name] for name in _SCENES}
    about = json.dumps(dataclasses.asdict(request))
    save_file({n: t.contiguous().clone() for n, t in tensors.items()}, path, {"request": about})


def load(path: Path) -> Outcomes:
    """Read what :func:`save` has written."""
    with safe_open(path, "pt") as file:
        read = {name: file.get_tensor(name) for name in file.keys()}
    scenes = {name: read.pop(f"scenes/{name}") for name in _SCENES}
    return Outcomes(**read, scenes=scenes)


def _request(policy_folder: Path, setting: Setting) -> Request:
    checksum = file_checksum(policy_folder / "policy.safetensors")
    return Request(checksum, described(setting, None), NUM_SCENES, SEED)


def request_of(path: Path) -> dict:
    """Which drives a file of outcomes is of, the fields of a :class:`Request`."""
    with safe_open(path, "pt") as file:
        return json.loads(file.metadata()["request"])


def main() -> None:
    """Make the shipped file anew."""
    Parser(prog="python -m recipes.choices.outcomes", description=__doc__).parse_args()
    torch.set_num_threads(1)
    # The old file stays until there is another.
    found = _driven(SHIPPED_POLICY, DRIVES)
    setting = trained_in(load_policy(SHIPPED_POLICY).card).with_one_robot.with_one_human
    save(SHIPPED, found, _request(SHIPPED_POLICY, setting))
    print(f"written: {SHIPPED}")


if __name__ == "__main__":
    main()
