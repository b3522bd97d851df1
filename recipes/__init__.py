"""Recipes: each a readable script that composes the library and the simulation."""

import os
import sys
import traceback
from types import TracebackType


def _ends_quietly(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    """Ctrl-C is no error: a line, as also while a command still imports PyTorch, and MuJoCo."""
    asked = os.environ.get("MUJOCO_GL")
    if "--debug" in sys.argv:
        sys.__excepthook__(kind, error, trace)
    elif issubclass(kind, KeyboardInterrupt):
        print("\ninterrupted", file=sys.stderr)
    elif asked is not None and _in_graphics(trace):
        print(
            f"error: MUJOCO_GL={asked!r}: MuJoCo cannot be imported with it ({kind.__name__}: {error}): "
            "unset it, or name a backend that is installed: egl, osmesa or glfw; off for none.",
            file=sys.stderr,
        )
    else:
        sys.__excepthook__(kind, error, trace)


def _in_graphics(trace: TracebackType | None) -> bool:
    """Whether MuJoCo's choice of a graphics library has failed, which it makes when it is imported."""
    names = [frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_tb(trace)]
    return "mujoco.rendering.classic.gl_context" in names


# So while `python -m recipes.something` looks for something; whoever imports us has a hook of their own.
if sys.argv[:1] == ["-m"]:
    sys.excepthook = _ends_quietly
