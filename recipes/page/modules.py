"""JavaScript modules as one script, which a page can hold and a worker can run."""

from __future__ import annotations

import re
from pathlib import Path

_IMPORT = re.compile(r'^import \{([^}]*)\} from "(\.{1,2}/[\w./-]+\.js)";$', re.MULTILINE)
_EXPORT = re.compile(r"^export (?:async )?(?:function\*?|class|const) (\w+)", re.MULTILINE)


def script(entry: Path) -> str:
    """The module ``entry`` and all that it imports, each in a scope of its own, in the order in which they run.

    The modules keep to two forms, ``import { a, b } from "./file.js";`` and ``export`` before a function,
    a class or a ``const``. A circle of imports is refused.

    Raises:
        ValueError: for another form, a file that is not there, a name that is not exported, or a circle.
    """
    done: dict[Path, tuple[str, list[str]]] = {}
    parts: list[str] = []
    _add(entry.resolve(), entry.resolve().parent, done, parts, ())
    return '"use strict";\n' + "\n".join(parts)


def _add(
    path: Path,
    root: Path,
    done: dict[Path, tuple[str, list[str]]],
    parts: list[str],
    importers: tuple[Path, ...],
) -> None:
    if path in importers:
        raise ValueError(f"{path.name} imports itself, by way of {importers[-1].name}.")
    if path in done:
        return
    if not path.is_file():
        by = f", which {importers[-1].name} imports" if importers else ""
        raise ValueError(f"{path}{by}, is not there.")
    code = path.read_text()
    for _, target in _IMPORT.findall(code):
        _add((path.parent / target).resolve(), root, done, parts, (*importers, path))

    def bound(match: re.Match[str]) -> str:
        scope, exported = done[(path.parent / match[2]).resolve()]
        names = [name.strip() for name in match[1].split(",") if name.strip()]
        for name in names:
            if name not in exported:
                raise ValueError(f"{path.name} imports {name}, which {match[2]} does not export.")
        return f"const {{ {', '.join(names)} }} = {scope};"

    exported = _EXPORT.findall(code)
    body = re.sub(
        r"^export (?=async |function|class|const)", "", _IMPORT.sub(bound, code), flags=re.M
    )
    for line in body.splitlines():
        if re.match(r"(import|export)\b", line):
            raise ValueError(f"{path.name}: {line!r} is of a form that the page cannot hold.")
    scope = f"module{len(done)}"
    done[path] = (scope, exported)
    label = path.name if path.parent == root else f"{path.parent.name}/{path.name}"
    parts.append(
        f"// {label}\nconst {scope} = (() => {{\n{body}\nreturn {{ {', '.join(exported)} }};\n}})();\n"
    )
