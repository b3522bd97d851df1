"""The command line of a recipe: Hydra's, with a whole check before anything is written and one line for a mistake.

::

    @recipe("config", Config)
    def main(cfg: DictConfig) -> None: ...

A training polls :func:`stop_requested` behind every step, or takes its batches from :func:`until_stopped`,
and raises :class:`Stopped` when it has saved.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn
from unittest import mock

import hydra
import tqdm
from hydra import compose, initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from pydantic import BaseModel

from . import quiet, run_folder, stopping
from .command_help import help_text
from .descriptions import copy_descriptions
from .foreign import refuse_foreign
from .overrides import importing, jobs, prepared, resumed
from .stopping import Stopped, stop_requested, undisturbed, until_stopped
from .user_errors import error_line
from .validation import ConfigurationError, validate

__all__ = ["Stopped", "recipe", "stop_requested", "undisturbed", "until_stopped"]

Main = Callable[[DictConfig], None]

_QUIET = ("hydra/job_logging=none", "hydra/hydra_logging=none")

_new_runs: dict[str, Path] = {}
"""What ``${new_run:...}`` is in this command."""


def recipe(config_name: str, schema: type[BaseModel]) -> Callable[[Main], Callable[..., None]]:
    """Makes the main function of a recipe its command.

    Args:
        config_name: of the YAML beside the recipe.
        schema: what it allows.
    """

    def decorate(main: Main) -> Callable[..., None]:
        @functools.wraps(main)
        def command(cfg: DictConfig | None = None) -> None:
            if cfg is not None:
                return main(cfg)
            return _Command(main, config_name, schema).run(sys.argv[1:])

        return command

    return decorate


def check(
    config_name: str,
    schema: type[BaseModel],
    folder: Path,
    overrides: Sequence[str],
    *,
    planned: Path | None = None,
) -> dict[str, Any]:
    """Check the configuration that overrides make, as the command does before it begins.

    Args:
        config_name: of the YAML.
        schema: of the recipe.
        folder: of the YAML.
        overrides: as given by the user.

    Keyword Args:
        planned: a folder; what lies in it need not be there yet.

    Returns:
        The configuration.

    Raises:
        ConfigurationError: if the recipe refuses it.
        HydraException: if Hydra does.
    """
    with _composing(folder):
        cfg = compose(config_name, overrides=prepared(overrides, schema, folder))
    config = OmegaConf.to_container(cfg, resolve=True)
    validate(schema, config, planned=planned)
    return config


def check_stage(
    option: str, schema: ModuleType, overrides: Sequence[str], planned: Path
) -> dict[str, Any]:
    """The same for a recipe that is a stage of another command, before the first stage begins.

    Args:
        option: of that command, whose value the overrides are.
        schema: module of the recipe's ``Config``, beside its YAML.
        overrides: of the stage; those of Hydra itself are left out.
        planned: see :func:`check`.

    Raises:
        ValueError: in one line, if the recipe or Hydra refuses it.
    """
    chosen = [one for one in overrides if not one.startswith("hydra.")]
    folder = Path(str(schema.__file__)).parent
    try:
        return check("config", schema.Config, folder, chosen, planned=planned)
    except (HydraException, ValueError) as error:
        line, _ = error_line(error, None)
        raise ValueError(f"{option}: {line}") from error


class _InJob(BaseException):
    """Carries what a recipe raises past Hydra, which would print a line of its own."""

    def __init__(self, error: BaseException) -> None:
        super().__init__()
        self.error = error


class _Command:
    def __init__(self, main: Main, config_name: str, schema: type[BaseModel]) -> None:
        self.main, self.config_name, self.schema = main, config_name, schema
        module = sys.modules[main.__module__]
        spec = getattr(module, "__spec__", None)
        self.module = spec.name if spec is not None else Path(str(module.__file__)).stem
        self.folder = Path(str(module.__file__)).resolve().parent
        self.about = (module.__doc__ or "").split("\n\n")[0]
        self.run_dir: Path | None = None
        self.was_there = False
        """The run folder, before this command."""
        self.was_empty = True
        self.made: list[Path] = []
        """Folders above it that were not there."""
        self.overrides: list[str] = []
        self.debug = False

    def run(self, arguments: Sequence[str]) -> None:
        self.debug = "--debug" in arguments or os.environ.get("HYDRA_FULL_ERROR") == "1"
        arguments = [one for one in arguments if one != "--debug"]
        _new_runs.clear()
        with stopping.handled(), contextlib.ExitStack() as self.held:
            try:
                self._run(arguments)
                return
            except (SystemExit, GeneratorExit):
                raise
            except BaseException as error:
                failure = error.error if isinstance(error, _InJob) else error
            self._fail(failure)

    def _fail(self, failure: BaseException) -> NoReturn:
        line, code = error_line(failure, self.run_dir, go_on=self._go_on())
        if self.run_dir is not None and self.was_empty:
            run_folder.remove_if_refused(self.run_dir, keep=self.was_there)
            run_folder.remove_empty(self.made)
        is_stop = isinstance(failure, Stopped | KeyboardInterrupt)
        if line is None or (self.debug and not is_stop):
            raise failure
        for bar in list(getattr(tqdm.tqdm, "_instances", ())):
            bar.close()
        print(line if is_stop else f"error: {line}", file=sys.stderr)
        if isinstance(failure, BrokenPipeError):
            # Python writes what is left in its buffer when it ends.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(code) from None

    def _go_on(self) -> str | None:
        """The command that goes on where this one was; ``None`` where nothing is saved for it.

        A stage is silent: its part alone would go on, and the command that ran it says how to.
        """
        if stopping.IS_STAGE in os.environ:
            return None
        if self.run_dir is None or "resume" not in self.schema.model_fields:
            return None
        if not (self.run_dir / ".hydra").is_dir():
            return None
        # The folder knows its configuration, but for what it must not say.
        imports = importing(self.overrides, self.schema)
        resume = f"resume={_shown(self.run_dir)}"
        return shlex.join(["python", "-m", self.module, resume, *dict.fromkeys(imports)])

    def _run(self, arguments: Sequence[str]) -> None:
        if {"-h", "--help"} & set(arguments):
            print(self._help())
            return
        parser = get_args_parser()
        parser.error = _refuse_arguments
        args = parser.parse_args(arguments)
        if args.experimental_rerun is not None:
            raise ConfigurationError("--experimental-rerun would run a pickle: give the fields.")
        if args.config_dir is not None or args.config_path is not None:
            raise ConfigurationError("--config-dir and --config-path: give the fields instead.")
        if args.config_name not in (None, self.config_name):
            raise ConfigurationError(
                f"--config-name must be {self.config_name}, got {args.config_name!r}."
            )
        # What only shows the configuration makes no folder.
        shows = bool(args.cfg or args.info or args.hydra_help or args.shell_completion)
        _register_new_run(run_folder.free_name if shows else self._claim)
        multirun = args.multirun or "hydra.mode=MULTIRUN" in args.overrides
        overrides = prepared(args.overrides, self.schema, self.folder, multirun=multirun)
        if multirun and (asked := [one for one in overrides if one.startswith("resume=")]):
            raise ConfigurationError(
                f"{asked[-1]} goes on with one run, where it is: leave out --multirun."
            )
        self.overrides = resumed(overrides, self.schema, self.folder)
        if not shows:
            self._check(multirun=multirun)
            if not self.was_empty:
                # Before Hydra writes the configuration of what goes on.
                try:
                    self.held.enter_context(run_folder.held(self.run_dir))
                except ValueError as error:
                    raise ConfigurationError(str(error)) from error
        options = _options(args)
        argv = [sys.argv[0], *options, *_QUIET, *self.overrides]
        task = hydra.main(
            config_path=str(self.folder), config_name=self.config_name, version_base="1.3"
        )(self._job())
        with (
            mock.patch.object(sys, "argv", argv),
            mock.patch.dict(os.environ, {"HYDRA_FULL_ERROR": "1"}),
            mock.patch.object(hydra.core.utils, "_save_config", _save_config),
        ):
            task()

    def _claim(self, base: Path) -> Path:
        self.made = run_folder.missing(base)
        return run_folder.claim(base)

    def _check(self, *, multirun: bool) -> None:
        """Check everything that will run, then claim or check its folder."""
        with _composing(self.folder):
            runs = list(jobs(self.overrides)) if multirun else [self.overrides]
            if not runs:
                raise ConfigurationError(
                    f"--multirun {' '.join(self.overrides)}: that is no run at all."
                )
            for overrides in runs:
                cfg = compose(self.config_name, [*_QUIET, *overrides], return_hydra_config=True)
                config = OmegaConf.masked_copy(cfg, [name for name in cfg if name != "hydra"])
                validate(self.schema, OmegaConf.to_container(config, resolve=True))
        resumed = config.get("resume")
        if resumed is not None and Path(cfg.hydra.run.dir).resolve() != Path(resumed).resolve():
            raise ConfigurationError(
                f"resume={resumed} goes on in its own folder: leave out hydra.run.dir."
            )
        if resumed is not None:
            try:
                refuse_foreign(Path(resumed))
            except ValueError as error:
                raise ConfigurationError(f"resume={resumed}: {error}") from error
        folder = Path(cfg.hydra.sweep.dir if multirun else cfg.hydra.run.dir)
        if folder not in _new_runs.values():
            self.was_there = folder.exists()
            self.made = run_folder.missing(folder.parent)
            self.was_empty = resumed is None
            if self.was_empty:
                run_folder.check_new(folder)
        self.run_dir = folder

    def _job(self) -> Main:
        @functools.wraps(self.main)
        def job(cfg: DictConfig) -> None:
            now = HydraConfig.get()
            if "MULTIRUN" in str(now.mode):
                self.run_dir = Path(now.runtime.output_dir)
                print(f"--- job {now.job.num}: {' '.join(now.overrides.task)} -> {self.run_dir}")
            folder = Path(now.runtime.output_dir)
            try:
                with contextlib.ExitStack() as held:
                    if self.was_empty:
                        held.enter_context(run_folder.held(folder))
                    held.enter_context(quiet.torchrl())
                    held.enter_context(quiet.plain_warnings(keep=self.debug))
                    config = OmegaConf.to_container(cfg, resolve=True)
                    copy_descriptions(folder, config, now.overrides.task)
                    self.main(cfg)
            except Exception as error:
                raise _InJob(error) from None

        return job

    def _help(self) -> str:
        with _composing(self.folder):
            cfg = compose(self.config_name)
        defaults = OmegaConf.to_container(cfg)
        return help_text(self.module, self.about, self.schema, defaults, self.folder)


@contextlib.contextmanager
def _composing(folder: Path) -> Iterator[None]:
    with initialize_config_dir(str(folder), version_base="1.3"):
        yield


def _save_config(cfg: DictConfig, filename: str, output_dir: Path) -> None:
    """Hydra's, but whole or not at all: a training that goes on writes over what it goes on with."""
    output_dir.mkdir(parents=True, exist_ok=True)
    run_folder.write_atomically(output_dir / filename, OmegaConf.to_yaml(cfg))


def _register_new_run(make: Callable[[Path], Path]) -> None:
    """The resolver ``new_run``: a folder of its own for every run, made when it is first asked for."""

    def new_run(base: str) -> str:
        if base not in _new_runs:
            _new_runs[base] = make(Path(base))
        return str(_new_runs[base])

    OmegaConf.register_new_resolver("new_run", new_run, replace=True)


def _refuse_arguments(message: str) -> NoReturn:
    raise ConfigurationError(f"{message}; fields are given as seed=1, --help lists them.")


def _options(args: argparse.Namespace) -> list[str]:
    """The flags of Hydra that were given, without the overrides."""
    given: list[str] = []
    for name in ("hydra_help", "multirun", "run", "resolve", "shell_completion"):
        if getattr(args, name):
            given.append(f"--{name.replace('_', '-')}")
    for name in ("cfg", "package", "info"):
        value: Any = getattr(args, name)
        if value is not None:
            given += [f"--{name}", value]
    return given


def _shown(path: Path) -> str:
    """Relative to where the user is, if it lies below."""
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except ValueError:
        return str(path)
