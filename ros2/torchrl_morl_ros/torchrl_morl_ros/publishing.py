"""Messages that the node sends."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Twist, TwistStamped

from .driver import Decision

WELL = ("drive", "goal reached", "no goal", "inactive")
"""Reasons that need nobody's attention."""


def velocity(decision: Decision, stamp: Any, frame: str, *, stamped: bool) -> Twist | TwistStamped:
    """The command for the base.

    Args:
        decision: what to tell it.
        stamp: ``builtin_interfaces/Time``, now.
        frame: of the robot.

    Keyword Args:
        stamped: whether the base takes ``TwistStamped``.
    """
    twist = Twist()
    twist.linear.x, twist.angular.z = float(decision.speed), float(decision.turn_rate)
    if not stamped:
        return twist
    message = TwistStamped(twist=twist)
    message.header.stamp, message.header.frame_id = stamp, frame
    return message


def diagnostics(
    name: str, hardware: str, decision: Decision, stamp: Any, values: Mapping[str, str]
) -> DiagnosticArray:
    """What the node does and why, for ``/diagnostics``."""
    level = DiagnosticStatus.OK if decision.reason in WELL else DiagnosticStatus.ERROR
    text = decision.reason + (f": {decision.detail}" if decision.detail else "")
    told = {
        "reason": decision.reason,
        "detail": decision.detail,
        "speed (m/s)": f"{decision.speed:.3f}",
        "turn rate (rad/s)": f"{decision.turn_rate:.3f}",
        **values,
    }
    status = DiagnosticStatus(level=level, name=name, hardware_id=hardware, message=text)
    status.values = [KeyValue(key=key, value=value) for key, value in told.items()]
    message = DiagnosticArray(status=[status])
    message.header.stamp = stamp
    return message
