"""Transitions of a lifecycle that cannot be made: refused, where rclpy would let the node die."""

from __future__ import annotations

from typing import Any

from lifecycle_msgs.msg import Transition
from rclpy.lifecycle import LifecycleNode

_NAMES = {
    Transition.TRANSITION_CONFIGURE: "configure",
    Transition.TRANSITION_CLEANUP: "cleanup",
    Transition.TRANSITION_ACTIVATE: "activate",
    Transition.TRANSITION_DEACTIVATE: "deactivate",
}


def refuse_impossible(node: LifecycleNode) -> None:
    """Answer ``success: false`` to a transition that the node's state does not have, and go on as before.

    rclpy 7 (Jazzy) raises there, out of the executor: https://github.com/ros2/rclpy/issues/1209. A lifecycle
    manager beside ``autostart`` asks for such a transition.

    Args:
        node: before it is spun.
    """
    service = node._service_change_state
    change_state = service.callback

    def answer(request: Any, response: Any) -> Any:
        _, state = node._state_machine.current_state
        possible = {key: name for key, name, *_ in node._state_machine.available_transitions}
        wanted = request.transition
        if wanted.id in possible or wanted.label in possible.values():
            return change_state(request, response)
        name = wanted.label or _NAMES.get(wanted.id, wanted.id)
        node.get_logger().warning(
            f"a transition is refused: {name} from state {state}; possible are "
            f"{', '.join(possible.values()) or 'none'}"
        )
        response.success = False
        return response

    service.callback = answer
