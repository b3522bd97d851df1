"""Recipes: each a readable script that composes the library and the simulation."""

import sys
from types import TracebackType


def _ends_quietly(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    """Ctrl-C is no error: a line, as also while a command still imports PyTorch."""
    if issubclass(kind, KeyboardInterrupt) and "--debug" not in sys.argv:
        print("\ninterrupted", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


# So while `python -m recipes.something` looks for something; whoever imports us has a hook of their own.
if sys.argv[:1] == ["-m"]:
    sys.excepthook = _ends_quietly
