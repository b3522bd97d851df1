"""The package as colcon and pip see it: files, versions, parameters, who imports whom."""

from __future__ import annotations

import ast
import doctest
import importlib
import pkgutil
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import torchrl_morl_ros
import yaml
from torchrl_morl_ros.settings import descriptions

import torchrl_morl

FOLDER = Path(__file__).resolve().parents[2] / "ros2" / "torchrl_morl_ros"
SOURCES = sorted(FOLDER.rglob("*.py"))
WITH_ROS = {"node", "publishing", "transforms", "transitions", "simulated_robot", "__main__"}
MODULES = {module.name for module in pkgutil.iter_modules(torchrl_morl_ros.__path__)}


@pytest.mark.parametrize("name", sorted(MODULES - WITH_ROS))
def test_it_imports_without_ros_and_its_examples_run(name):
    module = importlib.import_module(f"torchrl_morl_ros.{name}")
    assert doctest.testmod(module).failed == 0


def imports(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.split(".")[0])
    return found


def test_only_the_simulated_robot_knows_the_simulation():
    knows = {p.stem for p in SOURCES if imports(p) & {"envs", "recipes", "benchmarks", "mujoco"}}
    assert knows == {"simulated_robot"}


def test_what_it_imports_is_declared():
    package = ElementTree.parse(FOLDER / "package.xml").getroot()
    declared = {node.text.removeprefix("python3-") for node in package.iter("exec_depend")}
    other = {"torchrl_morl", "torchrl_morl_ros", "torchrl", "envs", "setuptools"}
    standard = {"__future__", *__import__("sys").stdlib_module_names}
    used = set().union(*map(imports, SOURCES)) - standard - other
    assert used - declared == set()


def test_the_versions_are_those_of_the_library():
    package = ElementTree.parse(FOLDER / "package.xml").getroot()
    assert package.findtext("version") == torchrl_morl.__version__
    (version,) = re.findall(r'version="([\d.]+)"', (FOLDER / "setup.py").read_text())
    assert version == torchrl_morl.__version__
    assert package.findtext("name") == "torchrl_morl_ros"
    assert (FOLDER / "resource" / "torchrl_morl_ros").exists()


def test_the_programs_are_there():
    points = re.findall(r'f"(\w+) = \{NAME\}\.(\w+):main"', (FOLDER / "setup.py").read_text())
    assert points == [("policy_node", "node"), ("simulated_robot", "simulated_robot")]
    for _, module in points:
        assert "\ndef main(" in (FOLDER / "torchrl_morl_ros" / f"{module}.py").read_text()


def test_the_configuration_holds_every_parameter_with_its_default():
    (given,) = yaml.safe_load((FOLDER / "config" / "policy.yaml").read_text()).values()
    given = given["ros__parameters"]
    expected = {
        name: list(default) if isinstance(default, tuple) else default
        for name, (default, _) in descriptions().items()
    }
    assert given == expected
    # YAML's 1 is an integer to ROS, which refuses it for a double.
    assert {name: type(value) for name, value in given.items()} == {
        name: type(value) for name, value in expected.items()
    }


@pytest.mark.parametrize("page", ["README.md", "../../docs/how_to/ros.md"])
def test_a_page_names_parameters_that_are_there(page):
    named = set(re.findall(r"-p (\w+):=", (FOLDER / page).read_text()))
    known = {*descriptions(), "preference", "use_sim_time", "real_time_factor", "seed", "scene"}
    assert named <= known


def test_files_can_be_read_in_one_sitting():
    assert {p.name: n for p in SOURCES if (n := len(p.read_text().splitlines())) > 400} == {}
