"""What of a training in stages is finished: a record in its folder, and a lock for who works there."""

from __future__ import annotations

import dataclasses
import fcntl
import json
import os
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from recipes.outputs import check_writable
from recipes.training.foreign import refuse_foreign
from recipes.training.quoting import is_harmless
from recipes.training.run_folder import claim, write_atomically


@dataclasses.dataclass
class Record:
    """Which stages of a training are finished: ``stages.json`` in its folder.

    Args:
        folder: of the training.
        options: of its command.
        stages: by name, in order: ``folder`` beside this file, ``command``, and ``seconds`` once the
            stage is finished.

    Examples:
        >>> import tempfile
        >>> record = Record(Path(tempfile.mkdtemp()), {"episodes": 100})
        >>> record.begin("D-REX", ["recipes.drex.drex"], "drex")
        >>> record.is_finished("D-REX")
        False
        >>> record.finish("D-REX", 60.0)
        >>> Record.load(record.folder).is_finished("D-REX")
        True
    """

    folder: Path
    options: dict[str, Any]
    stages: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)
    finished: bool = False

    FILE = "stages.json"

    @classmethod
    def load(cls, folder: Path) -> Record:
        """Read the record of a training.

        Raises:
            ValueError: if there is none, or if it cannot be read.
        """
        path = folder / cls.FILE
        if not path.is_file():
            raise ValueError(f"{path} not found: {folder} is no training in stages.")
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            record = cls(folder, content["options"], content["stages"], content["finished"])
            record.check()
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise ValueError(f"{path} cannot be read: {error}.") from error
        return record

    def check(self) -> None:
        """Whether the folder, which somebody else may have made, says nothing but what it may.

        Raises:
            TypeError: if not.
        """
        if not (isinstance(self.options, dict) and isinstance(self.stages, dict)):
            raise TypeError("its entries are no mappings")
        if not isinstance(self.finished, bool):
            raise TypeError(f"it is finished or not, it says {self.finished!r}")
        for name, option in self.options.items():
            for one in option if isinstance(option, list) else ():
                if not (isinstance(one, str) and is_harmless(one)):
                    raise TypeError(f"its option {name!r} holds {one!r}, which no folder may say")
        for name, stage in self.stages.items():
            folder = stage.get("folder", "") if isinstance(stage, Mapping) else ""
            if folder is not None and not _is_a_name(folder):
                raise TypeError(f"its stage {name!r} is not in a folder of its own")
            if not isinstance(stage, Mapping) or folder == "":
                raise TypeError(f"its stage {name!r} names no folder")

    def check_options(self, **types: type | tuple[type, ...]) -> None:
        """Whether the options are those of a command, by name and type.

        Raises:
            ValueError: if not.
        """
        for name in types.keys() | self.options.keys():
            value = self.options.get(name)
            wanted = types.get(name, ())
            if not isinstance(value, wanted) or (isinstance(value, bool) and wanted is int):
                raise ValueError(
                    f"{self.folder / self.FILE}: there is no option {name} = {value!r}; the folder was "
                    "made by another command or version."
                )

    def save(self) -> None:
        content = {"options": self.options, "stages": self.stages, "finished": self.finished}
        write_atomically(self.folder / self.FILE, json.dumps(content, indent=2) + "\n")

    def begin(self, name: str, command: Sequence[str], folder: str | None) -> None:
        self.stages[name] = {"folder": folder, "command": list(command)}
        self.save()

    def finish(self, name: str, seconds: float) -> None:
        self.stages[name]["seconds"] = seconds
        self.save()

    def is_finished(self, name: str) -> bool:
        return "seconds" in self.stages.get(name, {})

    def folder_of(self, name: str) -> Path | None:
        """Where a stage that has begun writes to."""
        folder = self.stages.get(name, {}).get("folder")
        return self.folder / folder if folder is not None else None


def begin(
    base: Path, output: Path | None, options: dict[str, Any], module: str
) -> tuple[Record, IO[str]]:
    """A folder of its own, with its record and its lock; says if one is left that is unfinished.

    Args:
        base: of folders without a name.
        output: where the user wants it, seen by :func:`refuse_used`.
        options: of the command.
        module: of the command.

    Raises:
        OSError: if it cannot be made.
        ValueError: if another process has it.
    """
    if output is not None:
        output.mkdir(parents=True, exist_ok=True)
    else:
        if (left := unfinished(base)) is not None:
            where = shlex.quote(str(left))
            print(f"{left} is unfinished; to go on with it: python -m {module} --resume {where}")
        output = claim(base)
    record = Record(output.resolve(), options)
    held = locked(record)
    if not is_unused(output):
        raise FileExistsError(
            f"{output} has been taken by another training: choose another folder."
        )
    record.save()
    return record, held


def refuse_used(output: Path) -> None:
    """Refuse a folder that holds something, and say how to go on with what is unfinished.

    Raises:
        ValueError: if it does, or cannot be written.
    """
    if output.exists() and not is_unused(output):
        if (output / Record.FILE).is_file() and not Record.load(output).finished:
            raise ValueError(
                f"{output} holds an unfinished training: go on with --resume {shlex.quote(str(output))}."
            )
        raise ValueError(f"{output} exists and is not overwritten: choose another folder.")
    check_writable(output, output)


def to_resume(folder: Path, **types: type | tuple[type, ...]) -> Record:
    """The record of what has begun in a folder.

    Args:
        folder: that the user names.
        types: of its options.

    Raises:
        ValueError: if it is over, or none.
    """
    if is_unused(folder):
        raise ValueError(
            f"{folder} is no training yet, {Record.FILE} not found: begin one in it with --output "
            f"{shlex.quote(str(folder))}."
        )
    refuse_foreign(folder)
    record = Record.load(folder.resolve())
    record.check_options(**types)
    if record.finished:
        raise ValueError(f"{folder} is finished: there is nothing to go on with.")
    return record


def lock(folder: Path) -> IO[str] | None:
    """Keep others from a training as long as the file is open; ``None`` if another process has it.

    Stages that :func:`recipes.stages.run` begins have it open as well: one that outlives this process, to save what it
    has, keeps others away until it has ended.

    Raises:
        OSError: if the folder cannot be written.
        ValueError: if the lock is a link.
    """
    path = folder / ".lock"
    # The folder may be somebody else's: not through a link, and nothing is emptied.
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        file = os.fdopen(os.open(path, flags, 0o666), "w")
    except OSError as error:
        if not path.is_symlink():
            raise
        raise ValueError(f"{path} is a link, where a training has a file: remove it.") from error
    os.set_inheritable(file.fileno(), True)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        return None
    return file


def locked(record: Record) -> IO[str]:
    """The lock of a training, which nobody else has.

    Raises:
        ValueError: if another process has it.
    """
    held = lock(record.folder)
    if held is None:
        raise ValueError(f"{record.folder} is being trained by another process.")
    return held


def _is_a_name(value: object) -> bool:
    """Whether it is text that names something beside the record, and nothing elsewhere."""
    return (
        isinstance(value, str)
        and value.isprintable()
        and value != ".."
        and Path(value).name == value
    )


def is_unused(folder: Path) -> bool:
    """Whether a folder holds nothing, or only what a training leaves that was killed before its record was."""
    leftovers = (".lock", f".{Record.FILE}.")
    return folder.is_dir() and all(path.name.startswith(leftovers) for path in folder.iterdir())


def unfinished(base: Path) -> Path | None:
    """The latest training in a folder that is neither finished nor under way."""
    for path in sorted(base.glob(f"*/{Record.FILE}"), reverse=True):
        try:
            record = Record.load(path.parent)
            held = None if record.finished else lock(path.parent)
        except (ValueError, OSError):
            continue
        if held is not None:
            held.close()
            return path.parent
    return None
