"""tf2, where it is installed."""

from __future__ import annotations

import importlib.util
from typing import Any

from .frames import Lookup


def has_tf2() -> bool:
    """Whether ``tf2_ros`` is installed."""
    return importlib.util.find_spec("tf2_ros") is not None


def listen(node: Any) -> tuple[Lookup, Any]:
    """Hear of transforms.

    Args:
        node: that subscribes to ``/tf`` and ``/tf_static``.

    Returns:
        The newest transform of a source frame (second) in a target frame (first), and what must be
        kept for as long as the node listens.
    """
    import tf2_ros
    from rclpy.time import Time

    buffer = tf2_ros.Buffer()
    listener = tf2_ros.TransformListener(buffer, node)

    def lookup(target: str, source: str) -> Any:
        try:
            return buffer.lookup_transform(target, source, Time()).transform
        except tf2_ros.TransformException as error:
            raise LookupError(f"no transform from {source!r} to {target!r}: {error}") from error

    return lookup, listener
