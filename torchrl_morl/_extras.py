"""Packages that only some functions need, and what to install where one is missing."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

__all__ = ["from_extra"]


@contextlib.contextmanager
def from_extra(extra: str, function: str) -> Iterator[None]:
    """Import packages of an extra; a missing one is named together with the extra.

    Args:
        extra: of pyproject.toml that lists the packages.
        function: that needs them, for the message.

    Raises:
        ImportError: where one is not installed.

    Examples:
        >>> with from_extra("viz", "my_function"):
        ...     import a_package_that_nobody_has
        Traceback (most recent call last):
        ImportError: my_function needs a_package_that_nobody_has: pip install 'torchrl-morl[viz]'.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        name = (error.name or "a package").split(".")[0]
        raise ImportError(
            f"{function} needs {name}: pip install 'torchrl-morl[{extra}]'.", name=error.name
        ) from error
