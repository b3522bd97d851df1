"""What a policy does under many preferences in some scenes: driven once, then kept in a file."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
import tqdm
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from tensordict import TensorDict
from torch import Tensor

from envs import SCENES, NavigationEnv
from torchrl_morl.choices import standardize
from torchrl_morl.deploy import load_policy
from torchrl_morl.deploy.files import file_checksum
from torchrl_morl.preferences import PreferenceSpace

from ..evaluation.setting import Setting, choose, demonstrator, trained_in
from ..evaluation.sweep import Sweep, sweep
from ..objectives import DEMO, PERSONAL_SPACE, known

DRIVES = Path("runs/choices/drives")
"""Where drives are kept."""

NUM_SCENES, SEED = 60, 31
"""Scenes that are asked about where nothing else is said, and their seed."""

FORMAT = "1"
MAX_STEPS = 300
UNLIKE = 1.5
"""Frechet distance from which on a drive is unlike the demonstration, by however much, metres."""
_PARTS = ("metrics", "paths", "scenes", "demonstration")


@dataclasses.dataclass(frozen=True)
class Request:
    """Which drives: what a file must agree with to be used again.

    Args:
        policy: SHA-256 of its weights.
        setting: scene, robot, drive and goal radius in words.
        scenes: how many.
        seed: of the scenes.
        divisions: of the lattice of preferences.
    """

    policy: str
    setting: str
    scenes: int
    seed: int
    divisions: int = 10

    def file(self, folder: Path) -> Path:
        """Where these drives are kept."""
        kind = self.setting.split(",")[0].removeprefix("scene ").replace("/", "_")
        name = f"{self.policy[:8]}_{kind}_{self.scenes}_seed{self.seed}_{self.divisions}"
        return folder / f"{name}.safetensors"


def usual_scene(card: Mapping[str, Any]) -> str | None:
    """Where one is asked when nothing else is said: ``None``, the scene of the training, if it has one human.

    Else ``static``: paths do not show who walked where, and where nobody stands nothing was demonstrated.

    Args:
        card: of the policy.

    Example:
        >>> usual_scene({"config": {"evaluation": {"scene": "everyday"}}})
        'static'
    """
    trained = trained_in(card)
    scene = trained.with_one_human.scene
    return None if scene == trained.scene else scene.name


def obtain(
    policy_folder: Path,
    scene: str | None,
    *,
    scenes: int,
    seed: int,
    folder: Path,
) -> tuple[Sweep, Setting]:
    """The drives of a policy from their file, or from driving them now, with a progress bar.

    Args:
        policy_folder: of the policy.
        scene: a name or a file; ``None`` for that of the training.

    Keyword Args:
        scenes: how many.
        seed: of the scenes.
        folder: where drives are kept.

    Raises:
        ValueError: for a policy, a scene or a file that is refused.
    """
    policy = load_policy(policy_folder)
    setting = choose(policy.card, scene=scene, one_robot=True)
    request = Request(
        policy=file_checksum(policy_folder / "policy.safetensors"),
        setting=described(setting, scene),
        scenes=scenes,
        seed=seed,
    )
    path = request.file(folder)
    if path.exists():
        return load(path, request), setting
    preferences = policy.preference_space.lattice(request.divisions)
    with tqdm.tqdm(total=len(preferences), desc=f"drives, once ({path.name})") as progress:
        result = sweep(
            policy.actor,
            policy.preference_space,
            preferences,
            episodes=scenes,
            seed=seed,
            max_episode_steps=MAX_STEPS,
            demonstrator=demonstrator(policy.card, setting.robot),
            on_preference=lambda _: progress.update(),
            **setting.arguments,
        )
    save(path, result, request)
    return result, setting


def described(setting: Setting, scene: str | None) -> str:
    """A setting in words; a scene from a file with its checksum, since the file may be edited."""
    if scene is None or scene in SCENES:
        return str(setting)
    name = f"{setting.scene.name}-{file_checksum(Path(scene))[:8]}"
    named = dataclasses.replace(setting.scene, name=name)
    return str(dataclasses.replace(setting, scene=named))


def save(path: Path, result: Sweep, request: Request) -> None:
    """Write drives to a new file; an interruption leaves none.

    Raises:
        FileExistsError: if there is one.
    """
    if path.exists():
        raise FileExistsError(f"{path} exists and is not overwritten.")
    space = result.preference_space
    parts = {p: getattr(result, p) for p in _PARTS if getattr(result, p) is not None}
    data = TensorDict({"preferences": result.preferences, **parts}).flatten_keys("/")
    # Copies: the file format refuses tensors that share memory.
    tensors = {name: value.contiguous().clone() for name, value in data.items()}
    about = {
        "objectives": space.objectives,
        "static": dict(space.static),
        "shapes": {name: part.shape for name, part in parts.items()},
        "request": dataclasses.asdict(request),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.partial")
    save_file(tensors, partial, {"format": FORMAT, "rollouts": json.dumps(about)})
    partial.rename(path)


def load(path: Path, request: Request) -> Sweep:
    """Read drives.

    Args:
        path: the file.
        request: what they must be.

    Raises:
        ValueError: for a file of another kind, or of other drives; the message says which.
    """
    try:
        with safe_open(path, "pt") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}
        about = json.loads(header["rollouts"])
        if header.get("format") != FORMAT:
            raise KeyError("format")
        data = TensorDict(tensors).unflatten_keys("/")
        for part, shape in about["shapes"].items():
            data[part].batch_size = shape
        space = PreferenceSpace(tuple(about["objectives"]), static=about["static"])
        result = Sweep(preference_space=space, **data)
        made = about["request"]
    except (OSError, SafetensorError, LookupError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path} holds no rollouts of recipes.choices: {error!r}.") from error
    asked = dataclasses.asdict(request)
    if made != asked:
        wrong = next(name for name in asked if made.get(name) != asked[name])
        raise ValueError(
            f"{path} holds other drives: its {wrong} is {made.get(wrong)!r}, not {asked[wrong]!r}. "
            "Move it away."
        )
    return result


def arrived(result: Sweep) -> Tensor:
    """Which drives reached their goal, ``[S, P]``."""
    return result.metrics["success"].T


def raw_outcomes(result: Sweep) -> Tensor:
    """How well each drive serves each tunable objective, in the unit of its metric, ``[S, P, T]``.

    Higher is better. Distances to the human beyond :data:`~recipes.objectives.PERSONAL_SPACE` count
    as that distance, also where nobody is; those to the demonstration beyond :data:`UNLIKE` as that one; a drive that does
    not arrive takes as long as it may.
    """
    columns: list[Tensor] = []
    for objective in known(result.preference_space.tunable):
        if objective.metric not in result.metrics.keys():
            raise ValueError(
                f"objective {objective.name!r} needs the metric {objective.metric!r}, which these "
                "drives do not have: the policy's card names no demonstrator."
            )
        values = result.metrics[objective.metric].float()
        if objective.metric == "time":
            values = values.nan_to_num(nan=MAX_STEPS * NavigationEnv.CONTROL_PERIOD)
        if objective.name == "distance":
            values = values.nan_to_num(nan=PERSONAL_SPACE).clamp(max=PERSONAL_SPACE)
        if objective.name == DEMO:
            values = values.clamp(max=UNLIKE)
        columns.append(objective.sign * values.T)
    return torch.stack(columns, -1)


def joint_outcomes(drives: dict[str, Sweep]) -> dict[str, Tensor]:
    """Outcomes by context, see :func:`torchrl_morl.choices.standardize`.

    All are in the same units: a second counts as much in a corridor as elsewhere.
    """
    values = standardize(
        torch.cat([raw_outcomes(one) for one in drives.values()]),
        torch.cat([arrived(one) for one in drives.values()]),
    )
    sizes = [len(one.scenes) for one in drives.values()]
    return dict(zip(drives, values.split(sizes), strict=True))
