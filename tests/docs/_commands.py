"""The commands of the pages: which they are, and whether the program takes what they give it."""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.util
import io
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from unittest import mock

from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from recipes.training.overrides import prepared
from tests.docs._pages import ROOT
from tools.configuration_pages import RECIPES

STAGES = {"--drex": "drex", "--pd-morl": "pd_morl", "--mo-ppo": "mo_ppo"}
"""Options that pass fields on to a recipe."""

HYDRA = {"--help", "--multirun", "-m", "--debug", "--cfg"}
OURS = ("torchrl_morl", "recipes", "benchmarks", "examples", "envs", "tools")


class Command(NamedTuple):
    """``python -m MODULE ARGUMENTS``."""

    module: str
    arguments: list[str]


def commands(code: str) -> Iterator[Command]:
    """Programs that a shell block starts, with its variables filled in."""
    variables: dict[str, str] = {}
    for line in code.replace("\\\n", " ").splitlines():
        if loop := re.search(r"for (\w+) in (\S+)", line):
            variables[loop[1]] = loop[2].rstrip(";")
        try:
            words = shlex.split(line.strip(), comments=True)
        except ValueError as error:
            raise AssertionError(f"not a line of a shell, {error}: {line}") from error
        while words and re.match(r"\w+=", words[0]):
            key, _, value = words.pop(0).partition("=")
            variables[key] = filled(value, variables)
        words = [
            part
            for word in words
            for part in _expanded(word, variables, quoted=f'"{word}"' in line)
        ]
        for place in range(len(words) - 2):
            if re.search(r"(^|/)python3?$", words[place]) and words[place + 1] == "-m":
                ends = [
                    i for i in range(place, len(words)) if words[i] in {"|", "&&", ";", ">", "&"}
                ]
                yield Command(words[place + 2], words[place + 3 : (ends or [len(words)])[0]])


def make_targets(code: str) -> set[str]:
    """Targets that a shell block asks ``make`` for."""
    found = set()
    for line in code.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if "make" in words:
            rest = words[words.index("make") + 1 :]
            found |= {word for word in rest if re.fullmatch(r"[a-z][a-z-]*", word)}
    return found


def filled(text: str, variables: dict[str, str]) -> str:
    """A text with ``$NAME`` and ``${NAME}`` replaced, as far as they are known."""
    return re.sub(r"\$\{?(\w+)\}?", lambda match: variables.get(match[1], match[0]), text)


def _expanded(word: str, variables: dict[str, str], *, quoted: bool) -> list[str]:
    text = filled(word, variables)
    return [text] if text == word or quoted else text.split()


def problem(command: Command) -> str | None:
    """What a command gives that its program does not take; ``None`` where all is well."""
    module, arguments = command
    if module.split(".")[0] not in OURS:
        return None
    if importlib.util.find_spec(module) is None:
        return f"there is no module {module}"
    if module.split(".")[0] in ("examples", "tools"):
        return None
    if found := [one for one in RECIPES if one.module == module]:
        recipe = next((one for one in found if one.chosen in arguments), found[0])
        fields = [one for one in arguments if one not in HYDRA and one != "job"]
        return refused(recipe, fields)
    known = options(module)
    if arguments and arguments[0] in known:
        known |= options(module, arguments[0])
    stage: str | None = None
    fields: dict[str, list[str]] = {}
    for word in arguments:
        if re.match(r"--?[a-z]", word):
            option = word.split("=")[0]
            if option not in known:
                return f"{module} has no option {option}"
            stage = STAGES.get(option)
        elif stage is not None:
            fields.setdefault(stage, []).append(word)
    for page, given in fields.items():
        recipe = next(one for one in RECIPES if one.page == page)
        if found := refused(recipe, given):
            return found
    return None


@functools.cache
def options(module: str, *subcommand: str) -> set[str]:
    """Options and subcommands that the help of a program, or of a subcommand of it, names."""
    program = importlib.import_module(module)
    if not hasattr(program, "main"):
        program = importlib.import_module(f"{module}.__main__")
    printed = io.StringIO()
    with (
        mock.patch.object(sys, "argv", [module, *subcommand, "--help"]),
        contextlib.redirect_stdout(printed),
        contextlib.suppress(SystemExit),
    ):
        program.main()
    text = printed.getvalue()
    subcommands = re.search(r"(?:^|\s)\{([\w,-]+)\} \.\.\.", text)
    named = set(re.findall(r"(?<![\w-])--?[a-z][\w-]*", text))
    return named | set(subcommands[1].split(",") if subcommands else ())


def refused(recipe, fields: list[str]) -> str | None:
    """Why a recipe would not take these fields; whether files are there is not looked at."""
    folder = Path(importlib.import_module(recipe.module).__file__).parent
    fields = [one for one in fields if not one.startswith(("hydra.", "hydra/"))]
    # Where the reader is asked for a value of theirs.
    swept = [re.sub(r"=(\d+)(,\d+)+$", r"=\1", one) for one in fields]
    try:
        with initialize_config_dir(str(folder), version_base="1.3"):
            overrides = prepared(swept, recipe.schema, folder)
            config = OmegaConf.to_container(compose(recipe.config, overrides))
        given = {key: value for key, value in config.items() if value != "???"}
        recipe.schema.model_validate(
            {"policy": "FOLDER", **given} if recipe.page == "mo_ppo" else given
        )
    except Exception as error:
        return f"{recipe.module} {' '.join(fields)}: {error}"
    return None


def known_place(path: str) -> bool:
    """Whether a path of the checkout that a command names is there, or is what it builds."""
    return (ROOT / path).exists() or path.startswith("docs/_build")
