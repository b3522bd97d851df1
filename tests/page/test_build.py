"""The command that builds the page, and how modules become one script."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

import pytest

from recipes.page.__main__ import main
from recipes.page.contents import contents
from recipes.page.modules import script
from tests._command import ROOT, run_here

from ._node import needs_node

SHIPPED = ROOT / "recipes" / "policies"


def modules(folder: Path, **sources: str) -> Path:
    for name, source in sources.items():
        (folder / f"{name}.js").write_text(source)
    return folder / "main.js"


def test_a_module_runs_after_those_that_it_imports_and_once(tmp_path):
    entry = modules(
        tmp_path,
        main='import { a } from "./a.js";\nimport { b } from "./b.js";\nconsole.log(a, b);\n',
        a='import { b } from "./b.js";\nconst own = 1;\nexport const a = b + own;\n',
        b="const own = 2;\nexport const b = own;\nexport function unused() {}\n",
    )
    text = script(entry)
    assert [text.count(f"// {name}.js") for name in "ab"] == [1, 1]
    assert text.index("// b.js") < text.index("// a.js") < text.index("// main.js")
    assert not re.search(r"^(import|export)\b", text, re.MULTILINE)


@needs_node
def test_the_script_does_what_the_modules_do(tmp_path):
    entry = modules(
        tmp_path,
        main='import { Twice, most } from "./a.js";\nconsole.log(new Twice(3).value, most);\n',
        a="export const most = 7;\nexport class Twice {\n  constructor(n) {\n    this.value = 2 * n;\n  }\n}\n",
    )
    bundle = tmp_path / "bundle.cjs"
    bundle.write_text(script(entry))
    said = subprocess.run(["node", bundle], capture_output=True, text=True, check=True).stdout
    assert said == "6 7\n"


@pytest.mark.parametrize(
    ("sources", "message"),
    [
        ({"main": 'import { a } from "./a.js";\n'}, "a.js, which main.js imports, is not there"),
        (
            {"main": 'import { c } from "./a.js";\n', "a": "export const a = 1;\n"},
            "main.js imports c, which ./a.js does not export",
        ),
        (
            {"main": 'import { a } from "./a.js";\n', "a": 'import { x } from "./main.js";\n'},
            "main.js imports itself, by way of a.js",
        ),
        ({"main": 'import a from "./a.js";\n', "a": ""}, "of a form that the page cannot hold"),
        ({"main": "export default 3;\n"}, "of a form that the page cannot hold"),
    ],
)
def test_what_the_page_cannot_hold_is_refused(sources, message, tmp_path):
    with pytest.raises(ValueError, match=re.escape(message)):
        script(modules(tmp_path, **sources))


def test_the_page_is_one_small_file_of_data_and_program(tmp_path, capsys):
    output = tmp_path / "new" / "page.html"
    run_here(main, "--output", str(output))
    assert f"page: {output} (2.6 MB)" in capsys.readouterr().out  # docs/how_to/page.md says so
    text = output.read_text()
    assert not re.search(r"(src|href)=\"(?!data:)", text)  # nothing from elsewhere
    assert not re.search(r"/\*[A-Z]+\*/", text)
    held = json.loads(re.search(r'id="contents">(.*?)</script>', text, re.DOTALL)[1])
    assert list(held["policies"]) == ["navigation", "polished_seed0"]
    assert held["objectives"]["demo"]["color"] == "#d6336c"
    assert held["scenes"]["static"]["first_seed"] == 7
    assert held["scenes"]["empty"]["first_seed"] == 10_000  # recorded there: no seed of tests
    assert held["choices"]["policy"] == "navigation"
    assert len(text.encode()) < 3e6
    with pytest.raises(SystemExit):
        run_here(main, "--output", str(output))
    assert "exists and is not overwritten" in capsys.readouterr().err
    assert output.read_text() == text


def test_a_scene_and_a_policy_of_ones_own():
    page = contents([SHIPPED / "core"], [ROOT / "examples" / "doorway.yaml"], num_scenes=3)
    assert list(page["scenes"]) == ["doorway"]
    assert len(page["scenes"]["doorway"]["scenes"]) == 3
    assert page["policies"]["core"]["objectives"][0] == "core"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--policy", "nowhere"], "nowhere/policy.safetensors not found: a policy is a folder"),
        (["--scene", "moon"], "moon"),
        (["--seeds", "0"], "must be a whole number from 1 to 1000, got '0'"),
        (["--output", "page.txt"], "--output must end in .html, got 'page.txt'"),
    ],
)
def test_mistakes_are_one_line_and_nothing_is_written(
    arguments, message, tmp_path, monkeypatch, capsys
):
    check_mistake(arguments, message, tmp_path, monkeypatch, capsys)


def test_a_policy_on_wheels_is_one(policy_folders, tmp_path, monkeypatch, capsys):
    arguments = ["--policy", str(policy_folders["hsr"])]
    message = "its drive is wheels, a page runs planar alone"
    check_mistake(arguments, message, tmp_path, monkeypatch, capsys)


def check_mistake(arguments: list[str], message: str, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        run_here(main, *arguments)
    assert stopped.value.code == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
