"""Where the time of a training goes: the recipe of PD-MORL itself, under stopwatches.

Runs ``recipes.pd_morl`` for a while with watches around the functions that it calls, and prints
their shares. Further arguments are passed on to the recipe. By default the run takes as many steps as lie
between two evaluations, so that the one at its end counts as it does in a whole training.

Examples::

    python -m benchmarks.training_step
    python -m benchmarks.training_step --frames 9600 compute.compile=false
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest import mock

import torch
from torch.optim.swa_utils import AveragedModel
from torchrl.collectors import Collector
from torchrl.data import TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate

from envs import NavigationEnv
from recipes.pd_morl import evaluation, files, pd_morl, utils

from .learner import machine
from .learner_systems import config

# The first calls of compiled functions compile, forward and backward.
_COMPILING_CALLS = 2

OTHER = "everything else"
COMPILING = "torch.compile, once"


class Watch:
    """Seconds by name. What runs within something else counts for itself alone."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()
        self.calls: Counter[str] = Counter()
        self._running = [OTHER]
        self._since = time.perf_counter()

    @property
    def running(self) -> str:
        return self._running[-1]

    def stop(self) -> None:
        """Bring the seconds up to date."""
        now = time.perf_counter()
        self.seconds[self.running] += now - self._since
        self._since = now

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
            with self(COMPILING if compiling and calls <= _COMPILING_CALLS else label):
                return function(*args, **kwargs)

        return timed


def _inside(parent: str) -> str:
    """Simulation on behalf of the collector or of the evaluation."""
    return f"{parent}, simulation"


@contextlib.contextmanager
def watched(watch: Watch, *, compiled: bool) -> Iterator[None]:
    """Watches around what the recipe calls, for as long as the context lasts."""
    updating = ["critic"]

    def network(_: str) -> str:
        return updating[0]

    def losses(cfg, loss):
        def of(kind: str, function: Callable) -> Callable:
            timed = watch.around(function, f"{kind}: loss", compiling=compiled)

            def run(batch):
                updating[0] = kind
                return timed(batch)

            return run

        value_loss, actor_loss = compile_losses(cfg, loss)
        return of("critic", value_loss), of("actor", actor_loss)

    compile_losses = utils.compile_losses
    plain = (
        (Collector, "rollout", "collect"),
        (NavigationEnv, "_step", _inside),
        (NavigationEnv, "_reset", _inside),
        (TensorDictReplayBuffer, "extend", "replay: extend"),
        (TensorDictReplayBuffer, "sample", "replay: sample, relabel"),
        (torch.Tensor, "backward", lambda parent: f"{updating[0]}: backward"),
        (torch.nn.utils, "clip_grad_norm_", lambda parent: f"{updating[0]}: clip, Adam"),
        (torch.optim.Adam, "step", lambda parent: f"{updating[0]}: clip, Adam"),
        (SoftUpdate, "step", "soft update, average"),
        (AveragedModel, "update_parameters", "soft update, average"),
        (evaluation, "evaluate", "evaluate"),
        (utils, "log_training", "log, save"),
        (utils, "log_metrics", "log, save"),
        (files, "save_training_policy", "log, save"),
        (pd_morl.CheckpointRotation, "save", "log, save"),
    )
    with contextlib.ExitStack() as stack:
        for owner, attribute, name in plain:
            backward = owner is torch.Tensor
            timed = watch.around(getattr(owner, attribute), name, compiling=compiled and backward)
            stack.enter_context(mock.patch.object(owner, attribute, timed))
        stack.enter_context(mock.patch.object(utils, "compile_losses", losses))
        yield


def profile(overrides: list[str]) -> tuple[Watch, float]:
    """Train, and return the watch and the seconds that it ran."""
    cfg = config(*(field for field in overrides if not field.startswith("hydra")))
    with tempfile.TemporaryDirectory() as folder:
        arguments = ["pd_morl", *overrides, f"hydra.run.dir={folder}/run"]
        watch = Watch()
        patched = watched(watch, compiled=cfg.compute.compile)
        with mock.patch.object(sys, "argv", arguments), patched:
            pd_morl.main()
        watch.stop()
    return watch, sum(watch.seconds.values())


def table(watch: Watch) -> str:
    """Shares as Markdown, without what happens once."""
    seconds = {name: value for name, value in watch.seconds.items() if name != COMPILING}
    total = sum(seconds.values())
    rows = ["| part | seconds | calls | share |", "| --- | --- | --- | --- |"]
    for name, value in sorted(seconds.items(), key=lambda item: -item[1]):
        share = 100 * value / total
        rows.append(f"| {name} | {value:.2f} | {watch.calls[name]:,} | {share:.1f} % |")
    return "\n".join(rows)


def summary(watch: Watch, frames: int) -> str:
    """Rates, and the share of sampling that is asked for."""
    seconds = {name: value for name, value in watch.seconds.items() if name != COMPILING}
    updates = watch.calls["critic: loss"]
    learning = ("replay: sample", "critic", "actor", "soft update")
    update = sum(value for name, value in seconds.items() if name.startswith(learning))
    total = sum(seconds.values())
    share = 100 * seconds.get("replay: sample, relabel", 0) / update
    return (
        f"{frames:,} environment steps and {updates:,} updates in {total:.1f} s: "
        f"{frames / total:.0f} steps/s, {updates / total:.1f} updates/s; one update "
        f"{1000 * update / updates:.2f} ms, of which sampling and relabelling {share:.1f} %\n"
        f"{COMPILING}: {watch.seconds[COMPILING]:.1f} s (not in the table)"
    )


def main(arguments: list[str] | None = None) -> None:
    """Measure; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--frames", type=int, help="environment steps (default: evaluation.interval)"
    )
    parser.add_argument("--output", type=Path, default=Path("runs/benchmarks/training_step.md"))
    parser.add_argument("overrides", nargs="*", help="of recipes/pd_morl/config.yaml")
    args = parser.parse_args(arguments)
    shipped = config()
    frames = args.frames or shipped.evaluation.interval
    batch = shipped.collector.frames_per_batch
    overrides = [
        f"collector.total_frames={frames}",
        # From the first batches on: nearly all of a training is past them.
        f"collector.init_random_frames={batch}",
        *args.overrides,
    ]
    watch, _ = profile(overrides)
    text = "\n\n".join((table(watch), summary(watch, frames), machine()))
    print(text)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    args.output.write_text(text + "\n")


if __name__ == "__main__":
    main()
