"""Values that Hydra's grammar reads as what they are, and overrides that a folder may say."""

from __future__ import annotations

from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException


def quoted(path: str | Path) -> str:
    """A path as the value of an override: in quotes, if Hydra would read it as something else.

    Examples:
        >>> quoted("runs/drex"), quoted("runs/a=b"), quoted("runs/Käfer (1), neu")
        ('runs/drex', "'runs/a=b'", "'runs/Käfer (1), neu'")
    """
    text = str(path)
    return text if reads_as(text) == text else in_quotes(text)


def in_quotes(text: str) -> str:
    """The text and nothing but the text.

    Examples:
        >>> in_quotes("it's")
        "'it\\\\'s'"
    """
    return QuotedString(text, Quote.single).with_quotes()


def reads_as(value: str) -> object:
    """What Hydra makes of a value; ``None`` if it cannot read it as a single one."""
    try:
        override = OverridesParser.create().parse_override(f"key={value}")
    except HydraException:
        return None
    if override.is_sweep_override():
        return None
    read = override.value()
    return read.text if isinstance(read, QuotedString) else read


def is_sweep(value: str) -> bool:
    """Whether Hydra reads several values."""
    try:
        return OverridesParser.create().parse_override(f"key={value}").is_sweep_override()
    except HydraException:
        return False


def is_of_hydra(override: str) -> bool:
    """Whether it is about Hydra itself, which makes objects of whatever class it is told.

    Examples:
        >>> [is_of_hydra(one) for one in ("+hydra.callbacks.x=1", "hydra/launcher=a", "seed=1")]
        [True, True, False]
    """
    return override.lstrip("+~ \t").startswith("hydra")


def is_harmless(override: str) -> bool:
    """Whether an override may come from a folder, which somebody else may have made.

    It must not read the user's environment, and not tell Hydra what to run.
    """
    return "${" not in override and not is_of_hydra(override)
