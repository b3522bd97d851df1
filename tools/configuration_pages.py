"""Write ``docs/configuration``, every field of every recipe, from the schemas: ``python -m tools.configuration_pages``.

A test fails where the pages are not what this writes.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from pydantic import BaseModel

from recipes.benchmark.schema import MOPPOConfig, PDMORLConfig
from recipes.drex.schema import Config as DREX
from recipes.mo_ppo.schema import Config as MOPPO
from recipes.pd_morl.schema import Config as PDMORL
from recipes.scalarized.schema import SACConfig, TD3Config
from recipes.training.allowed import leaves
from recipes.training.command_help import as_given
from recipes.training.validation import select

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "configuration"


class Recipe(NamedTuple):
    """A recipe with a configuration: its page, its module, its schema and its YAML.

    ``chosen`` is what the command must be given for it, where one module has several.
    """

    page: str
    title: str
    module: str
    schema: type[BaseModel]
    config: str
    chosen: str = ""


RECIPES = (
    Recipe("drex", "D-REX", "recipes.drex.drex", DREX, "config"),
    Recipe("pd_morl", "PD-MORL", "recipes.pd_morl.pd_morl", PDMORL, "config"),
    Recipe("mo_ppo", "MO-PPO", "recipes.mo_ppo.mo_ppo", MOPPO, "config"),
    Recipe("td3", "TD3-PR and CORE", "recipes.scalarized.td3", TD3Config, "td3"),
    Recipe("sac", "SAC-PR", "recipes.scalarized.sac", SACConfig, "sac"),
    Recipe(
        "benchmark_pd_morl",
        "PD-MORL on other environments",
        "recipes.benchmark.train",
        PDMORLConfig,
        "pd_morl",
        "algorithm=pd_morl",
    ),
    Recipe(
        "benchmark_mo_ppo",
        "MO-PPO on other environments",
        "recipes.benchmark.train",
        MOPPOConfig,
        "mo_ppo",
        "algorithm=mo_ppo",
    ),
)

INDEX = """# Where are the fields of a recipe?

Each recipe has a page with all of its fields: default, what is allowed, what it means. `--help` of the recipe prints the same.

{table}

```bash
python -m recipes.pd_morl.pd_morl --help
python -m recipes.pd_morl.pd_morl seed=1 optim.lr=1e-4 env.robot=examples/my_robot.yaml
python -m recipes.pd_morl.pd_morl --multirun seed=0,1,2
```

A field that is not there, or a value that is not allowed, is refused in one line before anything is written. `python -m recipes.train` passes fields on to its stages by `--drex`, `--pd-morl` and `--mo-ppo`.

The constants of the rewards, which `env.rewards` changes, are those of `envs.RewardConstants` in [envs/objectives.py](../../envs/objectives.py).

```{{toctree}}
:hidden:

{names}
```
"""


def main() -> None:
    """Write the pages."""
    FOLDER.mkdir(exist_ok=True)
    for name, text in pages():
        (FOLDER / name).write_text(text)


def pages() -> Iterator[tuple[str, str]]:
    """Names of the files, and what stands in them."""
    rows = [f"| [{recipe.title}]({recipe.page}.md) | `{_command(recipe)}` |" for recipe in RECIPES]
    yield (
        "index.md",
        INDEX.format(
            table="\n".join(["| recipe | module |", "|---|---|", *rows]),
            names="\n".join(recipe.page for recipe in RECIPES),
        ),
    )
    for recipe in RECIPES:
        yield f"{recipe.page}.md", page(recipe)


def page(recipe: Recipe) -> str:
    """One table for each section of a recipe's configuration."""
    folder = Path(importlib.import_module(recipe.module).__file__).parent
    with initialize_config_dir(str(folder), version_base="1.3"):
        defaults = OmegaConf.to_container(compose(recipe.config))
    sections: dict[str, list[str]] = {}
    for leaf in leaves(recipe.schema):
        section, _, _ = leaf.name.rpartition(".")
        default = as_given(select(defaults, leaf.name))
        default = "must be given" if default == "???" else f"`{default}`"
        allowed = leaf.allowed.replace("|", "\\|")
        sections.setdefault(section, []).append(
            f"| `{leaf.name}` | {default} | {leaf.description} *Allowed: {allowed}.* |"
        )
    files = [f"{recipe.config}.yaml", "common.yaml"]
    links = [
        f"[{file}](../../{(folder / file).relative_to(ROOT)})"
        for file in files
        if (folder / file).exists()
    ]
    lines = [
        f"# Which fields configure {recipe.title}?",
        "",
        f"These. Give them as `FIELD=VALUE` behind `python -m {_command(recipe)}`. Their defaults stand in "
        f"{' and '.join(links)}, with the reasons.",
    ]
    if found := presets(folder / "preset"):
        lines += ["", "`preset=NAME` sets several of them at once:", ""]
        lines += ["| preset | is |", "|---|---|", *found]
    for section, rows in sections.items():
        lines += ["", f"## {f'`{section}`' if section else 'The run'}", ""]
        lines += ["| field | default | is |", "|---|---|---|", *rows]
    return "\n".join(lines) + "\n"


def presets(folder: Path) -> list[str]:
    """A row for each preset of a recipe, with the first sentence of its file."""
    rows = []
    for file in sorted(folder.glob("*.yaml")):
        said = takewhile(lambda line: line.startswith("#"), file.read_text().splitlines())
        text = " ".join(line[1:].strip() for line in said if not line.startswith("# @"))
        sentence = re.split(r"(?<=\.) ", text)[0]
        sentence = re.sub(r"\bdocs/(\w+\.md)", r"[\1](../\1)", sentence)
        if file.stem != "none":
            rows.append(f"| [`{file.stem}`](../../{file.relative_to(ROOT)}) | {sentence} |")
    return rows


def _command(recipe: Recipe) -> str:
    return f"{recipe.module} {recipe.chosen}".rstrip()


if __name__ == "__main__":
    main()
