"""Demonstrations: scripted drivers, recordings, whether a robot can drive them, and their import."""

from .bag_topics import BagTopics
from .drivers import (
    CircleDemonstrator,
    DetourDriver,
    Driver,
    StraightDriver,
    demonstrated_paths,
    robot_radius,
)
from .feasibility import Tolerances, check
from .importer import import_demonstrations, replay
from .path_driver import PathDriver
from .reading import read_recordings
from .recordings import Recording
from .report import ImportReport, NoDriveAcceptedError, Reason

__all__ = [
    "BagTopics",
    "CircleDemonstrator",
    "DetourDriver",
    "Driver",
    "ImportReport",
    "NoDriveAcceptedError",
    "PathDriver",
    "Reason",
    "Recording",
    "StraightDriver",
    "Tolerances",
    "check",
    "demonstrated_paths",
    "import_demonstrations",
    "read_recordings",
    "replay",
    "robot_radius",
]
