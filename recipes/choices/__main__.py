"""Find the preference of a person: two drives side by side, "which do you like better?", a few times.

The first call drives the policy under 66 preferences, once, for a minute or two. Then each question is a
picture; answer it and press Enter::

    1  the left one      =  they are the same     u  take the last answer back     s  ask something else
    2  the right one     n  I like neither        q  stop; --resume goes on

Examples::

    python -m recipes.choices                                # ten questions, in runs/choices
    python -m recipes.choices --resume runs/choices/person   # goes on where you stopped
    python -m recipes.choices --scene static corridor        # a preference for each of two scenes
    python -m recipes.choices --answers 1,2,=,1,n            # answers given beforehand
"""

from __future__ import annotations

import json
import shlex
import webbrowser
from argparse import Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch

from envs import SCENES, get_scene
from torchrl_morl.choices import PreferencePosterior
from torchrl_morl.deploy import load_policy

from ..arguments import Parser, count, existing_folder, seed
from ..evaluation.setting import reads_preference, scene_seed
from ..evaluation.sweep import SHIPPED_POLICY, Sweep
from ..outputs import claim_folder
from ..policy_folders import no_policy, policy_folder
from .dialogue import KEYS, POSTERIOR, Dialogue
from .rollouts import DRIVES, NUM_SCENES, SEED, obtain, usual_scene

SETTING = "setting.json"
COMMANDS = "1 left, 2 right, = same, n neither, u undo, s skip, q stop"


def parse_answers(text: str) -> list[str]:
    """Answers given beforehand.

    Raises:
        ValueError: for anything else.

    Examples:
        >>> parse_answers("1,2,=")
        ['1', '2', '=']
    """
    words = [word.strip() for word in text.split(",")]
    for word in words:
        if word not in (*KEYS, "u", "s"):
            raise ValueError(f"--answers {text}: {word!r} must be one of {', '.join(KEYS)}, u, s.")
    return words


def typed() -> Iterator[str]:
    """What a person types, up to the end of the input."""
    while True:
        try:
            yield input("  which do you like better? ").strip().lower()
        except EOFError:
            return


def main() -> None:
    """Ask; ``--help`` lists the options."""
    parser = Parser(description=__doc__)
    parser.add_argument(
        "--policy", type=policy_folder, default=SHIPPED_POLICY, help="folder of the policy"
    )
    parser.add_argument(
        "--scene",
        nargs="+",
        help=f"{', '.join(SCENES)}, or .yaml files; each has a preference of its own (default: that of "
        "the training, or static where people there have ways of their own)",
    )
    parser.add_argument(
        "--scenes", type=count(2, 1000), default=NUM_SCENES, help="scenes of each kind"
    )
    parser.add_argument("--seed", type=scene_seed, default=SEED, help="of the scenes")
    parser.add_argument("--question-seed", type=seed, default=0, help="of the questions")
    parser.add_argument("--questions", type=count(0, 1000), default=10, help="how many are asked")
    parser.add_argument("--answers", help="comma-separated, instead of typing")
    parser.add_argument("--open", action="store_true", help="show each picture in the browser")
    parser.add_argument("--drives", type=Path, default=DRIVES, help="folder of the drives")
    place = parser.add_mutually_exclusive_group()
    place.add_argument("--output", type=Path, help="new folder (default: runs/choices/person)")
    place.add_argument("--resume", type=existing_folder, help="folder of an earlier call")
    args = parser.parse_args()
    check_resumed(parser, args)
    torch.set_num_threads(1)
    try:
        answers = iter(parse_answers(args.answers)) if args.answers is not None else typed()
        dialogue = resumed(args.resume, args.drives) if args.resume else started(args)
    except (OSError, ValueError) as error:
        parser.error(str(error))
    try:
        converse(dialogue, answers, questions=args.questions, show=args.open)
    except ValueError as error:  # of drives that never arrive there are no two to choose from
        parser.error(f"the drives of this policy cannot be compared: {error}")
    written = dialogue.finish()
    print("\n".join(dialogue.lines()))
    print("\n".join(f"written: {path}" for path in written))
    print(f"go on: python -m recipes.choices --resume {dialogue.folder}")
    setting = json.loads((dialogue.folder / SETTING).read_text())
    for scene, best in zip(setting["scene"], dialogue.best().values(), strict=True):
        print(f"drive so: {drive_command(setting['policy'], scene, best.preference.tolist())}")


def drive_command(policy: str, scene: str | None, preference: Sequence[float]) -> str:
    """What drives a policy in a scene, ``None`` for that of its training, as one would type it.

    Examples:
        >>> drive_command("my policy", "room.yaml", [0.2, 0.8])
        "python -m recipes.evaluate --policy 'my policy' --scene room.yaml --preferences 0.2,0.8"
    """
    words = ["python", "-m", "recipes.evaluate"]
    if policy != str(SHIPPED_POLICY):
        words += ["--policy", policy]
    if scene is not None:
        words += ["--scene", scene]
    return shlex.join([*words, "--preferences", ",".join(f"{value:.1f}" for value in preference)])


def check_resumed(parser: Parser, args: Namespace) -> None:
    """Refuse options that a dialogue keeps from its first call."""
    for name in ("policy", "scene", "scenes", "seed", "question_seed"):
        if args.resume and getattr(args, name) != parser.get_default(name):
            parser.error(
                f"--{name.replace('_', '-')} is of a new dialogue, --resume {args.resume} keeps its "
                "own: leave it out."
            )


def started(args: Namespace) -> Dialogue:
    """A new dialogue, in a new folder.

    Raises:
        ValueError: for whatever is refused; nothing is written then but drives.
    """
    names = [get_scene(scene).name for scene in args.scene or ()]
    if len(set(names)) < len(names):
        raise ValueError(f"--scene {' '.join(args.scene)} names a scene twice: {', '.join(names)}.")
    card = load_policy(args.policy).card
    if not reads_preference(card):
        raise ValueError(
            f"--policy {args.policy} does not read the preference: all its drives are the same, there "
            "is nothing to choose."
        )
    setting = {
        "policy": str(args.policy),
        "scene": args.scene or [usual_scene(card)],
        "scenes": args.scenes,
        "seed": args.seed,
        "question_seed": args.question_seed,
    }
    drives, radii = all_drives(setting, args.drives)
    tunable = next(iter(drives.values())).preference_space.tunable
    posterior = PreferencePosterior(tunable, contexts=tuple(drives))
    folder = claim_folder(args.output, Path("runs/choices/person"))
    (folder / SETTING).write_text(json.dumps(setting, indent=1) + "\n")
    posterior.save(folder / POSTERIOR)
    return Dialogue(folder, drives, radii, posterior, args.question_seed)


def resumed(folder: Path, drives_folder: Path) -> Dialogue:
    """The dialogue of an earlier call.

    Raises:
        ValueError: if the folder holds none.
    """
    try:
        setting = json.loads((folder / SETTING).read_text())
        if not isinstance(setting["scene"], list):
            raise TypeError(f"{SETTING}: scene must be a list, got {setting['scene']!r}")
        posterior = PreferencePosterior.load(folder / POSTERIOR)
        drives, radii = all_drives(setting, drives_folder)
        question_seed = int(setting["question_seed"])
    except (
        OSError,
        LookupError,
        TypeError,
        AttributeError,
        RecursionError,
        UnicodeDecodeError,
        json.JSONDecodeError,
    ) as error:
        raise ValueError(f"--resume {folder} holds no choices of this command: {error}") from error
    if posterior.contexts != tuple(drives):
        raise ValueError(
            f"--resume {folder}: {POSTERIOR} is of {posterior.contexts}, {SETTING} of {tuple(drives)}."
        )
    tunable = next(iter(drives.values())).preference_space.tunable
    if posterior.objectives != tunable:
        raise ValueError(
            f"--resume {folder}: {POSTERIOR} is of {posterior.objectives}, the policy of {tunable}."
        )
    return Dialogue(folder, drives, radii, posterior, question_seed)


def all_drives(setting: dict, folder: Path) -> tuple[dict[str, Sweep], dict[str, float]]:
    """Drives and goal radius of every scene, by the name of the scene.

    Raises:
        ValueError: for a policy or a scene that is refused.
    """
    drives, radii = {}, {}
    if why := no_policy(Path(setting["policy"])):  # of an earlier call, which may be gone since
        raise ValueError(f"the policy of this dialogue is gone: {why}.")
    for scene in setting["scene"]:
        result, found = obtain(
            Path(setting["policy"]),
            scene,
            scenes=setting["scenes"],
            seed=setting["seed"],
            folder=folder,
        )
        drives[found.scene.name], radii[found.scene.name] = result, found.goal_radius
    return drives, radii


def converse(dialogue: Dialogue, answers: Iterator[str], *, questions: int, show: bool) -> None:
    """Ask and take answers until there are enough questions or no more answers.

    Keyword Args:
        questions: how many answers are taken.
        show: open the pictures.
    """
    given = 0
    if questions:
        print(f"look at each picture of two drives, then type which you like better:\n  {COMMANDS}")
    while given < questions:
        context, question = dialogue.ask()
        picture = dialogue.draw(context, question)
        print(f"question {dialogue.posterior.num_answers + 1}: {picture}", flush=True)
        if show:
            webbrowser.open(picture.resolve().as_uri())
        for key in answers:
            if key in KEYS:
                dialogue.take(context, question, KEYS[key])
                given += 1
            elif key == "u":
                given -= dialogue.undo()
            elif key == "s":
                dialogue.skip(context, question)
                print("  skipped, another one in its place")
            elif key == "q":
                return
            else:
                print(f"  {key!r} is no answer: {COMMANDS}")
                continue
            break
        else:
            return
        print("\n".join(dialogue.lines()), flush=True)


if __name__ == "__main__":
    main()
