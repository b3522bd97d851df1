"""What is asked of the library in a process that sees a wheel, what it requires, and nothing else.

Run as ``python -P _installed.py QUESTION SITE HIDDEN...``: SITE is the folder of the unpacked wheel, HIDDEN
are names of packages that the environment of the tests has and a clean one does not.
"""

from __future__ import annotations

import doctest
import importlib
import importlib.metadata
import importlib.util
import pkgutil
import sys
from importlib.machinery import BuiltinImporter, FrozenImporter, PathFinder
from pathlib import Path
from types import ModuleType


class _Visible:
    """The finder of files, which does not find what is hidden."""

    hidden: frozenset[str] = frozenset()
    find_distributions = PathFinder.find_distributions

    @classmethod
    def find_spec(cls, name, path=None, target=None):
        if name.partition(".")[0] in cls.hidden:
            return None
        return PathFinder.find_spec(name, path, target)


def see_only(site: Path, hidden: frozenset[str]) -> None:
    """Let imports find the wheel in ``site``, no checkout, and none of the ``hidden`` packages."""
    _Visible.hidden = hidden
    sys.meta_path[:] = [BuiltinImporter, FrozenImporter, _Visible]
    others = [entry for entry in sys.path if not (Path(entry) / "torchrl_morl").exists()]
    sys.path[:] = [str(site), *others]


def modules(site: Path) -> list[ModuleType]:
    """All modules of the installed library."""
    package = importlib.import_module("torchrl_morl")
    walked = pkgutil.walk_packages(package.__path__, "torchrl_morl.")
    found = [package, *(importlib.import_module(module.name) for module in walked)]
    outside = [module.__file__ for module in found if site not in Path(module.__file__).parents]
    assert not outside, outside
    return found


def imports(site: Path) -> None:
    """Every module imports, has every name that it promises, and the version is that of the wheel."""
    for module in modules(site):
        missing = [name for name in getattr(module, "__all__", ()) if not hasattr(module, name)]
        assert not missing, (module.__name__, missing)
    package = importlib.import_module("torchrl_morl")
    assert package.__version__ == importlib.metadata.version("torchrl-morl")
    for name in ("envs", "recipes", "mujoco", "hydra", "matplotlib", "moocore", "pytest"):
        assert importlib.util.find_spec(name) is None, name


def extras(site: Path) -> None:
    """What needs a package of an extra says which one to install."""
    import torch

    evaluation = importlib.import_module("torchrl_morl.evaluation")
    deploy = importlib.import_module("torchrl_morl.deploy")
    policy = importlib.import_module("torchrl_morl.testing").untrained_policy()
    lidar = deploy.training_lidar(policy)
    frames = torch.zeros(2, 240, 320, 3, dtype=torch.uint8)
    video = site / "nowhere" / "video"
    scene = {"start": [0, 0], "goal": [1, 0], "human": [0, 1, 0], "boxes": torch.zeros(1, 5)}
    radii = {"human_radius": 0.3, "goal_radius": 0.3}
    path = torch.zeros(1, 3, 2), torch.ones(1, 3, dtype=torch.bool), torch.zeros(1)
    for function, extra, package, arguments, keywords in (
        ("hypervolume", "indicators", "moocore", (torch.ones(2, 2), torch.zeros(2)), {}),
        ("write_video", "viz", "imageio", (video.with_suffix(".mp4"), frames), {}),
        ("write_video", "viz", "PIL", (video.with_suffix(".gif"), frames), {}),
        ("draw_preference", "viz", "PIL", (frames, torch.ones(2, 1), ["a"]), {}),
        ("draw_scene", "viz", "matplotlib", (None,), {**scene, **radii}),
        ("draw_paths", "viz", "matplotlib", (None, *path), {}),
        ("export_onnx", "export", "onnx", (policy, site / "policy.onnx"), {"lidar": lidar}),
        ("from_hub", "hub", "huggingface_hub", ("name/policy",), {}),
    ):
        expected = f"{function} needs {package}: pip install 'torchrl-morl[{extra}]'."
        try:
            room = evaluation if hasattr(evaluation, function) else deploy
            getattr(room, function)(*arguments, **keywords)
        except ImportError as error:
            assert str(error) == expected, str(error)
        else:
            raise AssertionError(f"{function} works without {package}")
    assert not video.parent.exists()


def examples(site: Path) -> None:
    """Every example of a docstring gives what it says."""
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    results = [doctest.testmod(module, optionflags=flags) for module in modules(site)]
    assert not sum(result.failed for result in results)
    assert sum(result.attempted for result in results) > 100


if __name__ == "__main__":
    question, folder, *names = sys.argv[1:]
    see_only(Path(folder), frozenset(names))
    for answer in {"alone": (imports, extras), "with extras": (examples,)}[question]:
        answer(Path(folder))
