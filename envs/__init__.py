"""Simulation: batched MuJoCo environments, the navigation task, its scenes and robots."""

from .batched_mujoco import BatchedMujocoEnv, PhysicsState
from .catalogue import EVERYDAY, SCENES
from .faults import Faults
from .navigation import NavigationEnv
from .objectives import OBJECTIVES, RewardConstants
from .rendering import Camera
from .robot_ranges import ANY_ROBOT, RobotRanges, get_robots
from .robots import HSR, ROBOTS, TURTLEBOT2, Robot, get_robot
from .scene_files import get_scene
from .scenes import (
    CORRIDOR,
    EMPTY,
    EXPLORING,
    HUMAN_RADIUS,
    MIXED,
    MOVING_HUMAN,
    SHOWCASE,
    STATIC,
    Scene,
)

__all__ = [
    "ANY_ROBOT",
    "CORRIDOR",
    "EMPTY",
    "EVERYDAY",
    "EXPLORING",
    "HSR",
    "HUMAN_RADIUS",
    "MIXED",
    "MOVING_HUMAN",
    "OBJECTIVES",
    "ROBOTS",
    "SCENES",
    "SHOWCASE",
    "STATIC",
    "TURTLEBOT2",
    "BatchedMujocoEnv",
    "Camera",
    "Faults",
    "NavigationEnv",
    "PhysicsState",
    "RewardConstants",
    "Robot",
    "RobotRanges",
    "Scene",
    "get_robot",
    "get_robots",
    "get_scene",
]
