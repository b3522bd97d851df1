"""Demonstrations: scripted drivers, recordings, whether a robot can drive them, and their import."""

from .drivers import (
    CircleDemonstrator,
    DetourDriver,
    Driver,
    StraightDriver,
    demonstrated_paths,
)
from .feasibility import Tolerances, check
from .importer import ImportReport, import_demonstrations, replay
from .recordings import Recording, read_recordings

__all__ = [
    "CircleDemonstrator",
    "DetourDriver",
    "Driver",
    "ImportReport",
    "Recording",
    "StraightDriver",
    "Tolerances",
    "check",
    "demonstrated_paths",
    "import_demonstrations",
    "read_recordings",
    "replay",
]
