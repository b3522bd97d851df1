"""What ``repr`` says about a component: its settings, where those of PyTorch show its children."""

from __future__ import annotations

from textwrap import indent
from typing import Any

__all__ = ["describe"]

_WIDTH = 100


def describe(component: object, **settings: Any) -> str:
    """The name of the class and its settings, in one line if they fit.

    Args:
        component: what is described.
        **settings: shown in this order.

    Returns:
        ``Name(setting=value, ...)``.

    Example:
        >>> describe(object(), ratio=0.75, key="preference")
        "object(ratio=0.75, key='preference')"
    """
    name = type(component).__name__
    parts = [f"{key}={value!r}" for key, value in settings.items()]
    line = f"{name}({', '.join(parts)})"
    if len(line) <= _WIDTH and "\n" not in line:
        return line
    return f"{name}(\n" + indent(",\n".join(parts), "    ") + ")"
