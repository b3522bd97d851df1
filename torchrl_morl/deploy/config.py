"""Configurations that come from files."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Mapping
from typing import Any

__all__ = ["literal_config", "training_config"]

_INTERPOLATION = re.compile(r"(\\*)\$\{")


def literal_config(value: Any) -> Any:
    r"""A configuration from a file, for OmegaConf, with every string meaning itself.

    OmegaConf evaluates ``${...}`` in strings when they are read, environment variables of the user
    included. A file that somebody else wrote must not be able to ask for that.

    Args:
        value: of a card, any JSON value.

    Returns:
        A copy in which ``${`` is escaped: read through OmegaConf, every string is as it was.

    Example:
        >>> card = {"scene": "static", "run": "${oc.env:HOME}"}
        >>> print(literal_config(card)["run"])
        \${oc.env:HOME}
    """
    if isinstance(value, dict):
        return {name: literal_config(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [literal_config(entry) for entry in value]
    if isinstance(value, str):
        # Backslashes before it would escape the escape.
        return _INTERPOLATION.sub(lambda match: match[1] * 2 + "\\${", value)
    return value


def training_config(card: Mapping[str, Any], section: str) -> dict[str, Any]:
    """A section of the configuration that stands in a card, for OmegaConf.

    Args:
        card: of a policy.
        section: ``"env"``, ``"evaluation"``, ...

    Returns:
        The section, see :func:`literal_config`; empty if the card has none.

    Raises:
        ValueError: if it is no object.

    Example:
        >>> training_config({"config": {"env": {"scene": "static"}}}, "env")
        {'scene': 'static'}
        >>> training_config({"config": {"env": "static"}}, "env")
        Traceback (most recent call last):
        ...
        ValueError: card: config.env must be an object, got 'static'.
    """
    value = card
    for key, name in (("config", "config"), (section, f"config.{section}")):
        value = value.get(key, {})
        if not isinstance(value, Mapping):
            raise ValueError(f"card: {name} must be an object, got {reprlib.repr(value)}.")
    return literal_config(dict(value))
