"""Configurations that come from files."""

from __future__ import annotations

import re
from typing import Any

__all__ = ["literal_config"]

_INTERPOLATION = re.compile(r"(\\*)\$\{")


def literal_config(value: Any) -> Any:
    """A configuration from a file, for OmegaConf, with every string meaning itself.

    OmegaConf evaluates ``${...}`` in strings when they are read, environment variables of the user
    included. A file that somebody else wrote must not be able to ask for that.

    Args:
        value: of a card, any JSON value.

    Returns:
        A copy in which ``${`` is escaped: read through OmegaConf, every string is as it was.

    Example:
        >>> from omegaconf import OmegaConf
        >>> card = {"scene": "static", "run": "${oc.env:HOME}"}
        >>> OmegaConf.create(literal_config(card)).run
        '${oc.env:HOME}'
    """
    if isinstance(value, dict):
        return {name: literal_config(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [literal_config(entry) for entry in value]
    if isinstance(value, str):
        # Backslashes before it would escape the escape.
        return _INTERPOLATION.sub(lambda match: match[1] * 2 + "\\${", value)
    return value
