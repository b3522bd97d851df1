"""The rooms of the house: who may import whom, no circles, no drawers for odds and ends, no long files.

Imports are read from the source, also those inside functions.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("torchrl_morl", "envs", "recipes", "benchmarks")
RECIPES = {f"recipes.{name}" for name in ("pd_morl", "mo_ppo", "drex", "scalarized", "benchmark")}
SHARED = {
    f"recipes.{name}"
    for name in ("training", "evaluation", "objectives", "arguments", "outputs", "policy_folders")
}
MOST_LINES = 400
NAMED_TUPLE = {"_replace", "_asdict", "_make"}
"""Public, so that fields may have any name."""

# Private methods that may be called, and why.
PRIVATE: dict[tuple[str, str], str] = {
    ("benchmarks/environment_variants.py", "TensorDict._new_unsafe"): "as the environment",
    ("envs/scene_files.py", "other._key"): "another SceneSampler, in its own class",
    (
        "recipes/training/logs.py",
        "logger.experiment._get_file_writer",
    ): "SummaryWriter has no other",
    ("envs/batched_mujoco.py", "TensorDict._new_unsafe"): "no checks of what a step has just made",
    ("torchrl_morl/data/snippets.py", "part._index"): "another RankedSnippets, in its own class",
    ("torchrl_morl/data/snippets.py", "part._reseed"): "another RankedSnippets, in its own class",
}


def sources() -> list[Path]:
    return [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in sources()}


def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text(), filename=str(path))


def imported(name: str, path: Path, tree: ast.AST, modules: set[str]) -> Iterator[str]:
    """Modules that a module imports anywhere in it, by their full names.

    ``from package import name`` is an import of ``package.name`` if that is a module, else of what
    stands in ``package/__init__.py``. That a package's own file runs before its modules is no import.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = name.split(".")
                up = node.level - (path.name == "__init__.py")
                base = ".".join([*package[: len(package) - up], *filter(None, [node.module])])
            for alias in node.names:
                full = f"{base}.{alias.name}"
                yield full if full in modules else base


GRAPH = {
    name: sorted(set(imported(name, path, parse(path), set(MODULES))))
    for name, path in MODULES.items()
}


def inside(name: str, rooms: set[str]) -> bool:
    return any(name == room or name.startswith(f"{room}.") for room in rooms)


def imports_into(room: str, forbidden: set[str]) -> list[str]:
    """``importer -> imported`` from a room into those that it must not know."""
    return [
        f"{name} -> {other}"
        for name, others in GRAPH.items()
        if inside(name, {room})
        for other in others
        if inside(other, forbidden)
    ]


# --- the readers of this file


def test_imports_are_read_in_every_form():
    code = """
import a.b
from . import near
from .near import name
from .. import up
from ..up.far import name
from a import b, name

def lazy():
    import hidden
"""
    modules = {"a.b", "p.q.near", "p.up", "p.up.far"}
    found = set(imported("p.q.here", Path("here.py"), ast.parse(code), modules))
    assert found == {"a.b", "p.q.near", "p.up", "p.up.far", "a", "hidden"}
    package = set(imported("p.q", Path("__init__.py"), ast.parse("from .near import x"), modules))
    assert package == {"p.q.near"}


def circles(graph: dict[str, list[str]]) -> list[list[str]]:
    """Groups of modules that reach each other: strongly connected components, Tarjan (1972)."""
    order: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        order[node] = low[node] = len(order)
        stack.append(node)
        for other in graph[node]:
            if other not in graph:
                continue
            if other not in order:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], order[other])
        if low[node] == order[node]:
            start = stack.index(node)
            group = stack[start:]
            del stack[start:]
            if len(group) > 1 or node in graph[node]:
                found.append(sorted(group))

    for node in graph:
        if node not in order:
            visit(node)
    return found


def test_circles_are_found():
    assert circles({"a": ["b", "c"], "b": ["c", "elsewhere"], "c": []}) == []
    graph = {"a": ["b"], "b": ["c"], "c": ["b", "d"], "d": ["d"], "e": ["a"]}
    assert sorted(circles(graph)) == [["b", "c"], ["d"]]


def private_calls(tree: ast.Module) -> list[str]:
    """``object._method()`` on anything but oneself and modules that are imported from elsewhere."""
    theirs = {
        (alias.asname or alias.name).split(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, ast.Import)
        for alias in node.names
        if alias.name.split(".")[0] not in PACKAGES
    }
    own = {"self", "cls"}
    found = []
    for node in ast.walk(tree):
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
            continue
        name, owner = node.func.attr, node.func.value
        if not name.startswith("_") or name.endswith("__") or name in NAMED_TUPLE:
            continue
        if isinstance(owner, ast.Call) and ast.unparse(owner.func) in ("super", "type"):
            continue
        root = owner
        while isinstance(root, ast.Attribute):
            root = root.value
        direct = isinstance(owner, ast.Name) and owner.id in own
        module = isinstance(root, ast.Name) and root.id in theirs
        if not direct and not module:
            found.append(f"{ast.unparse(owner)}.{name}")
    return found


def test_private_calls_are_found():
    code = """
import torch
import envs

class A(B):
    def run(self, other):
        super()._step(); self._step(); type(self)._step(); cls._new(); row._replace(); other.__len__()
        torch._foreach_add_(x, y); torch._dynamo.config._load(); other.public()
        other._step(); self.env._reset(); make()._go(); envs._hidden()
"""
    assert private_calls(ast.parse(code)) == [
        "other._step",
        "self.env._reset",
        "make()._go",
        "envs._hidden",
    ]


# --- who may import whom


@pytest.mark.parametrize(
    ("room", "forbidden"),
    [
        ("torchrl_morl", {"envs", "recipes", "benchmarks", "tests", "mujoco"}),
        ("envs", {"recipes", "benchmarks", "tests"}),
        ("recipes", {"benchmarks", "tests"}),
        ("benchmarks", {"tests"}),
    ],
)
def test_imports_point_one_way(room, forbidden):
    assert imports_into(room, forbidden) == []


@pytest.mark.parametrize("recipe", sorted(RECIPES))
def test_a_recipe_knows_no_other_and_nothing_made_of_them(recipe):
    others = {f"recipes.{path.stem}" for path in (ROOT / "recipes").iterdir()}
    assert imports_into(recipe, others - SHARED - {recipe}) == []


@pytest.mark.parametrize("room", sorted(SHARED))
def test_what_is_shared_knows_no_recipe_and_nothing_made_of_them(room):
    others = {f"recipes.{path.stem}" for path in (ROOT / "recipes").iterdir()}
    assert imports_into(room, others - SHARED) == []


@pytest.mark.parametrize("room", ["recipes.results", "recipes.demo"])
def test_results_and_demo_are_made_of_what_is_shared(room):
    others = {f"recipes.{path.stem}" for path in (ROOT / "recipes").iterdir()}
    assert imports_into(room, others - SHARED - {room}) == []


def test_benchmarks_import_what_is_shared_and_no_recipe():
    others = {f"recipes.{path.stem}" for path in (ROOT / "recipes").iterdir()}
    # That one compares peers with recipes.benchmark, by its evaluation and its front.
    own = [
        f"benchmarks.mo_gymnasium_{name} -> recipes.benchmark.{part}"
        for name, part in (
            ("runs", "fronts"),
            ("runs", "lattice"),
            ("runs", "problem"),
            ("table", "fronts"),
        )
    ]
    assert sorted(imports_into("benchmarks", others - SHARED)) == own


def test_every_room_that_is_named_here_is_there():
    rooms = {*RECIPES, "recipes.training", "recipes.evaluation", "recipes.results", "recipes.demo"}
    assert rooms <= MODULES.keys()


def test_no_circle_of_imports():
    assert circles(GRAPH) == []


# --- files


def test_no_drawer_for_odds_and_ends():
    names = {"utils", "util", "helpers", "helper", "misc", "common"}
    assert [str(p.relative_to(ROOT)) for p in sources() if p.stem in names] == []


def test_a_file_can_be_read_in_one_sitting():
    lines = {str(p.relative_to(ROOT)): len(p.read_text().splitlines()) for p in sources()}
    # One file that is copied to a robot, and may import nothing of the library.
    most = {"torchrl_morl/deploy/onnx_runner.py": MOST_LINES + 50}
    assert {name: n for name, n in lines.items() if n > most.get(name, MOST_LINES)} == {}


def test_nobody_calls_the_private_methods_of_others():
    found = {
        (str(path.relative_to(ROOT)), call)
        for path in sources()
        for call in private_calls(parse(path))
    }
    assert found == PRIVATE.keys()
