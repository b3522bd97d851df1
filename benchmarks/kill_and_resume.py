"""Trainings that are killed at random moments and gone on with, beside one that nobody disturbs.

Every one is the same small ``python -m recipes.train``. All its processes get SIGKILL at moments that are
uniform over the first third of the undisturbed one's wall time, counted from every start: then it goes on with
``--resume``, is killed again, and so on, until it is through.
What it leaves must be what the undisturbed one left: demonstrations, reward model, clone and every policy, each
tensor bit by bit, and what their evaluations found. The exit code is 1 where anything differs.

Examples::

    OMP_NUM_THREADS=1 python -m benchmarks.kill_and_resume --kills 50 --seed 0
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import itertools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import tqdm
from safetensors.torch import load_file

from recipes.arguments import Parser, positive_int
from recipes.arguments import seed as seed_type

ROOT = Path(__file__).resolve().parents[1]

# Seconds of work, several checkpoints in every stage that makes them.
OVERRIDES = {
    "--episodes": "1",
    "--with-pd-morl": "",
    "--drex": """torch_threads=1 env.num_threads=1 demonstrations.count=4 demonstrations.batch=8
        cloning.updates=60 cloning.batch_size=32 cloning.num_cells=[16] noise.levels=[0.0,0.3]
        noise.rollouts=2 style_negatives.rollouts=12 reward_model.updates=520 reward_model.num_cells=[16]
        reward_model.batch_size=4 diagnostics.rollouts=2""",
    "--pd-morl": """compute.torch_threads=1 compute.compile=false collector.total_frames=768
        collector.init_random_frames=192 evaluation.interval=192 evaluation.episodes=1
        replay_buffer.batch_size=16 replay_buffer.size=960 demonstrations.prefill=2
        network.num_cells=[16,16] env.max_episode_steps=10 optim.updates_per_batch=4
        logger.backends=[csv] logger.interval=96""",
    "--mo-ppo": """compute.torch_threads=1 env.num_threads=1 env.num_envs=8 collector.total_frames=512
        collector.frames_per_batch=64 network.num_cells=[16] optim.batch_size=32
        optim.penalty_batch_size=16 optim.critic_batches=1 optim.critic_epochs=1
        evaluation.interval=128 evaluation.episodes=1 logger.backends=[csv]""",
}
BEFORE = "before the record"


def begin(output: Path) -> list[str]:
    """The command that starts the training in a folder."""
    options = [word for name, text in OVERRIDES.items() for word in (name, *text.split())]
    return [sys.executable, "-m", "recipes.train", "--output", str(output), *options]


def go_on(output: Path) -> list[str]:
    """The command that goes on with it."""
    return [sys.executable, "-m", "recipes.train", "--resume", str(output)]


# --- what a training leaves ----------------------------------------------------------------------


def left(folder: Path) -> dict[str, Any]:
    """By name, what two trainings must agree in: tensors as type, shape and bytes, and evaluations."""
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        # Checkpoints are older by the way; what begins with a dot was never finished.
        if "checkpoints/" in name or "/." in name or not path.is_file():
            continue
        if path.suffix == ".safetensors":
            for key, value in load_file(path).items():
                content = value.contiguous().flatten().view(-1).numpy().tobytes()
                found[f"{name}: {key}"] = (str(value.dtype), tuple(value.shape), content)
        elif path.name == "policy.json":
            card = json.loads(path.read_text())["card"]
            found[f"{name}: evaluation"] = (card.get("score"), card.get("evaluation"))
    return found


def differences(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """Names of what only one has, or of what is not the same."""
    return sorted(name for name in one.keys() | other.keys() if one.get(name) != other.get(name))


# --- kills ---------------------------------------------------------------------------------------


def moments(seed: int, seconds: float) -> Iterator[float]:
    """Random seconds after a start, uniform over a wall time."""
    generator = random.Random(seed)
    while True:
        yield generator.uniform(0.0, seconds)


def descendants(pid: int) -> list[int]:
    """Its children, theirs, and so on: a stage has a session of its own."""
    parents: dict[int, list[int]] = {}
    for entry in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            # "pid (name) state parent ...", and a name may hold anything.
            parent = int(entry.read_text().rpartition(")")[2].split()[1])
            parents.setdefault(parent, []).append(int(entry.parent.name))
    found = list(parents.get(pid, ()))
    for child in found:
        found += parents.get(child, ())
    return found


def alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in "ZX"


def kill(process: subprocess.Popen) -> None:
    """SIGKILL to all processes of a training; nobody gets the time to react to the end of another."""
    process.send_signal(signal.SIGSTOP)
    killed = descendants(process.pid)
    for pid in killed:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    process.kill()
    process.wait()
    while any(map(alive, killed)):
        time.sleep(0.01)


def stage(output: Path) -> str:
    """The one that had begun last, as the training has recorded it."""
    try:
        record = json.loads((output / "stages.json").read_text())
    except FileNotFoundError:
        return BEFORE
    if not record["stages"]:
        return "before D-REX"
    name, entry = list(record["stages"].items())[-1]
    return f"after {name}" if "seconds" in entry else name


def finished(output: Path) -> bool:
    """Whether a training has recorded that it is."""
    record = output / "stages.json"
    return record.is_file() and json.loads(record.read_text())["finished"]


@dataclasses.dataclass
class Run:
    """What became of one training.

    Args:
        hits: stages in which it was killed.
        again: starts from nothing, because nothing was there to go on with.
        error: why it could not go on.
        differing: names of what is not as in the undisturbed one.
    """

    hits: list[str] = dataclasses.field(default_factory=list)
    again: int = 0
    error: str | None = None
    differing: list[str] = dataclasses.field(default_factory=list)

    @property
    def good(self) -> bool:
        return self.error is None and not self.differing

    def row(self, number: int) -> str:
        stages = ", ".join(
            f"{name} {count}x" if (count := self.hits.count(name)) > 1 else name
            for name in dict.fromkeys(self.hits)
        )
        equal = self.error or ("yes" if not self.differing else "no: " + "; ".join(self.differing))
        resumed = len(self.hits) - self.again
        return f"| {number} | {len(self.hits)} | {stages} | {resumed} | {self.again} | {equal} |"


HEADER = """| run | kills | killed in | resumed | started again | equal |
| --- | --- | --- | --- | --- | --- |"""


def summary(runs: list[Run], seconds: float) -> str:
    """One line."""
    kills = sum(len(run.hits) for run in runs)
    again = sum(run.again for run in runs)
    return (
        f"{kills} kills in {len(runs)} runs of {seconds:.0f} s: {kills - again} resumed, {again} started "
        f"again, {sum(run.good for run in runs)} of {len(runs)} runs equal to the undisturbed one"
    )


def attempt(command: list[str], log: Path, seconds: float | None, limit: float) -> str | None:
    """Run a command, killed after so many seconds.

    Returns:
        ``None`` if it has finished, "killed", or what went wrong.
    """
    with log.open("a") as file:
        process = subprocess.Popen(
            command,
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            code = process.wait(timeout=limit if seconds is None else seconds)
        except subprocess.TimeoutExpired:
            return "killed" if seconds is not None else f"not through after {limit:.0f} s"
        finally:
            if process.returncode is None:
                kill(process)
    if code:
        lines = log.read_text(errors="replace").replace("\r", "\n").splitlines()
        errors = [line for line in lines if "rror" in line] or lines
        return f"exit code {code}: {errors[-1] if errors else ''}"
    return None


def disturbed(
    folder: Path,
    when: Iterator[float],
    most: int,
    limit: float,
    killed: Callable[[], object] = lambda: None,
) -> Run:
    """One training, killed until it is through, or as often as it may be; ``killed`` counts."""
    run, output = Run(), folder / "run"
    command = begin(output)
    while run.error is None:
        seconds = next(when) if len(run.hits) < most else None
        ended = attempt(command, folder / "log", seconds, limit)
        if ended is None:
            break
        if ended != "killed":
            run.error = ended
            break
        run.hits.append(stage(output))
        killed()
        if finished(output):  # it was only ending: there is nothing to go on with
            break
        command = go_on(output)
        if run.hits[-1] == BEFORE:
            run.again += 1
            shutil.rmtree(output, ignore_errors=True)
            command = begin(output)
    return run


def main(arguments: list[str] | None = None) -> None:
    """Train, kill, go on, compare; ``--help`` lists the options."""
    parser = make_parser()
    args = parser.parse_args(arguments)
    base = Path(tempfile.mkdtemp(prefix="kill_and_resume_"))
    runs: list[Run] = []
    try:
        with tqdm.tqdm(total=args.kills, unit="kill", desc="undisturbed") as progress:
            started = time.perf_counter()
            wrong = attempt(begin(base / "undisturbed"), base / "log", None, limit=3600)
            seconds = time.perf_counter() - started
            if wrong:
                parser.exit(1, f"{parser.prog}: error: the undisturbed training: {wrong}\n")
            expected = left(base / "undisturbed")
            progress.write(HEADER, file=sys.stdout)
            # Over all of it, most moments would come after the end of what was left to do.
            when = moments(args.seed, seconds / 3)
            for number in itertools.count(1):
                progress.set_description(f"run {number}")
                folder = base / f"{number:03d}"
                folder.mkdir()
                most = min(args.per_run, args.kills - progress.n)
                run = disturbed(folder, when, most, 10 * seconds + 120, progress.update)
                if run.error is None:
                    run.differing = differences(expected, left(folder / "run"))
                runs.append(run)
                progress.write(run.row(number), file=sys.stdout)
                sys.stdout.flush()
                if run.good:
                    shutil.rmtree(folder)
                if progress.n >= args.kills:
                    break
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
    finally:
        good = all(run.good for run in runs)
        if good:
            shutil.rmtree(base)
    if runs:
        print(summary(runs, seconds))
    if not good:
        print(f"what was left is in {base}")
    sys.exit(0 if good and sum(len(run.hits) for run in runs) >= args.kills else 1)


def make_parser() -> argparse.ArgumentParser:
    parser = Parser(prog="kill_and_resume", description=__doc__)
    parser.add_argument("--kills", type=positive_int, default=50, help="of all runs (default: 50)")
    parser.add_argument("--seed", type=seed_type, default=0, help="of the moments (default: 0)")
    parser.add_argument(
        "--per-run", type=positive_int, default=6, help="kills of one run at most (default: 6)"
    )
    return parser


if __name__ == "__main__":
    main()
