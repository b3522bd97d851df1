"""Where the time of a training goes: the recipe of PD-MORL itself, under stopwatches.

Runs ``recipes.pd_morl`` for a while, as its command does, with watches around what it calls, and prints
their shares. Further arguments are passed on to the recipe. By default the run takes as many steps as lie
between two evaluations, so that the one at its end counts as it does in a whole training.

Examples::

    python -m benchmarks.training_step
    python -m benchmarks.training_step --frames 9600 compute.compile=false
"""

from __future__ import annotations

import contextlib
import functools
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from unittest import mock

import torch
from torch.optim.swa_utils import AveragedModel
from torchrl.collectors import Collector
from torchrl.data import TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate

from envs import NavigationEnv
from recipes.arguments import Parser, positive_int
from recipes.training import corner_evaluation, logs, vector_td3
from recipes.training.checkpoint import Checkpoints

from .learner import CLOCKS, machine
from .output import parse_with_output
from .workload import PD_MORL, config, run_recipe

OTHER = "everything else"
SET_UP = "set-up, once"
COMPILING = "torch.compile, once"
ONCE = (SET_UP, COMPILING)


class Watch:
    """Seconds by name. What runs within something else counts for itself alone."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.seconds: Counter[str] = Counter()
        self.calls: Counter[str] = Counter()
        self.clock = clock
        self._running = [SET_UP]
        self._since = clock()

    @property
    def running(self) -> str:
        return self._running[-1]

    def stop(self) -> None:
        """Bring the seconds up to date."""
        now = self.clock()
        self.seconds[self.running] += now - self._since
        self._since = now

    def set_up(self) -> None:
        """What runs outside of everything else no longer counts as the set-up."""
        self.stop()
        self._running[0] = OTHER

    @contextlib.contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        self.stop()
        self._running.append(name)
        self.calls[name] += 1
        try:
            yield
        finally:
            self.stop()
            self._running.pop()

    def around(
        self, function: Callable, name: str | Callable[[str], str], *, compiling: bool = False
    ) -> Callable:
        """The function under this watch; the name may depend on what it is called from."""
        calls = 0

        @functools.wraps(function)
        def timed(*args, **kwargs):
            nonlocal calls
            calls += 1
            label = name(self.running) if callable(name) else name
            # The first call of a compiled function compiles it.
            with self(COMPILING if compiling and calls == 1 else label):
                return function(*args, **kwargs)

        return timed


def _inside(parent: str) -> str:
    """Simulation on behalf of the collector or of the evaluation."""
    return f"{parent}, simulation"


@contextlib.contextmanager
def watched(watch: Watch, *, compiled: bool) -> Iterator[None]:
    """Watches around what the recipe calls, for as long as the context lasts."""
    adam = {}

    def watched_gradients(cfg, loss):
        functions = zip(("critic", "actor"), make_gradients(cfg, loss), strict=True)
        return tuple(
            watch.around(function, f"{kind}: gradients", compiling=compiled)
            for kind, function in functions
        )

    def watched_optimizers(cfg, loss):
        made = make_optimizers(cfg, loss)
        adam.update((id(optimizer), f"{kind}: Adam") for kind, optimizer in made[0].items())
        return made

    def step(optimizer, *arguments):
        with watch(adam[id(optimizer)]):
            return plain_step(optimizer, *arguments)

    def rollout(collector: Collector):
        watch.set_up()
        with watch("collect"):
            return plain_rollout(collector)

    make_gradients, make_optimizers = vector_td3.make_gradients, vector_td3.make_optimizers
    plain_rollout, plain_step = Collector.rollout, torch.optim.Adam.step
    plain = (
        (NavigationEnv, "_step", _inside),
        (NavigationEnv, "_reset", _inside),
        (TensorDictReplayBuffer, "extend", "replay: extend"),
        (TensorDictReplayBuffer, "sample", "replay: sample, relabel"),
        (SoftUpdate, "step", "soft update, average"),
        (AveragedModel, "update_parameters", "soft update, average"),
        (corner_evaluation, "evaluate_corners", "evaluate"),
        (logs, "log_training", "log, save"),
        (logs, "log_metrics", "log, save"),
        (corner_evaluation, "save_training_policy", "log, save"),
        (corner_evaluation, "trajectories_picture", "log, save"),
        (Checkpoints, "save", "log, save"),
    )
    with contextlib.ExitStack() as stack:
        for owner, attribute, name in plain:
            timed = watch.around(getattr(owner, attribute), name)
            stack.enter_context(mock.patch.object(owner, attribute, timed))
        stack.enter_context(mock.patch.object(vector_td3, "make_gradients", watched_gradients))
        stack.enter_context(mock.patch.object(vector_td3, "make_optimizers", watched_optimizers))
        stack.enter_context(mock.patch.object(torch.optim.Adam, "step", step))
        stack.enter_context(mock.patch.object(Collector, "rollout", rollout))
        yield


def profile(overrides: list[str], clock: str = "wall") -> Watch:
    """Train under a watch."""
    cfg = config(*(field for field in overrides if not field.startswith("hydra")))
    with tempfile.TemporaryDirectory() as folder:
        watch = Watch(CLOCKS[clock])
        with watched(watch, compiled=cfg.compute.compile):
            run_recipe(PD_MORL, *overrides, f"hydra.run.dir={folder}/run")
        watch.stop()
    return watch


def table(watch: Watch) -> str:
    """Shares as Markdown, without what happens once."""
    seconds = {name: value for name, value in watch.seconds.items() if name not in ONCE}
    total = sum(seconds.values())
    rows = ["| part | seconds | calls | share |", "| --- | --- | --- | --- |"]
    for name, value in sorted(seconds.items(), key=lambda item: -item[1]):
        share = 100 * value / total
        rows.append(f"| {name} | {value:.2f} | {watch.calls[name]:,} | {share:.1f} % |")
    return "\n".join(rows)


def summary(watch: Watch, frames: int) -> str:
    """Rates, and the share of sampling that is asked for."""
    seconds = {name: value for name, value in watch.seconds.items() if name not in ONCE}
    updates = watch.calls["critic: gradients"]
    parts = ("replay: sample", "critic", "actor", "soft update")
    update = sum(value for name, value in seconds.items() if name.startswith(parts))
    total = sum(seconds.values())
    share = 100 * seconds.get("replay: sample, relabel", 0) / update
    return (
        f"{frames:,} environment steps and {updates:,} updates in {total:.1f} s: "
        f"{frames / total:.0f} steps/s, {updates / total:.1f} updates/s; one update "
        f"{1000 * update / updates:.2f} ms, of which sampling and relabelling {share:.1f} %\n"
        + ", ".join(f"{name}: {watch.seconds[name]:.1f} s" for name in ONCE)
        + " (not in the table)"
    )


def main(arguments: list[str] | None = None) -> None:
    """Measure; ``--help`` lists the options."""
    parser = Parser(prog="training_step", description=__doc__)
    parser.add_argument(
        "--frames", type=positive_int, help="environment steps (default: evaluation.interval)"
    )
    parser.add_argument(
        "--clock",
        choices=CLOCKS,
        default="wall",
        help="cpu: seconds of this process, for a machine that does other work too",
    )
    parser.add_argument("overrides", nargs="*", help="of recipes/pd_morl/config.yaml")
    args = parse_with_output(parser, arguments, "training_step.md")
    shipped = config()
    frames = args.frames or shipped.evaluation.interval
    batch = shipped.collector.frames_per_batch
    overrides = [
        f"collector.total_frames={frames}",
        # From the first batches on: nearly all of a training is past them.
        f"collector.init_random_frames={batch}",
        *args.overrides,
    ]
    watch = profile(overrides, args.clock)
    text = "\n\n".join((table(watch), summary(watch, frames), machine(), f"clock: {args.clock}"))
    print(text)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    args.output.write_text(text + "\n")


if __name__ == "__main__":
    main()
