"""The C++ runner as Python calls it: cpp/c_interface.cpp compiled, behind ctypes."""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from torchrl_morl.deploy import Command, LidarGeometry

SOURCES = Path(__file__).resolve().parent.parent / "cpp"
_DOUBLES = ctypes.POINTER(ctypes.c_double)
_OPTIONS = ("goal_radius", "timeout", "max_speed", "max_turn_rate")
_BUFFER = (ctypes.c_char_p, ctypes.c_size_t)
_ARRAY = (_DOUBLES, ctypes.c_size_t)
_FUNCTIONS = {
    "torchrl_morl_open": (
        ctypes.c_void_p,
        (ctypes.c_char_p, *_ARRAY, _DOUBLES, _DOUBLES, *_BUFFER),
    ),
    "torchrl_morl_step": (
        None,
        (
            *(ctypes.c_void_p, *_ARRAY, *(_DOUBLES,) * 4, *_ARRAY),
            *(ctypes.c_double, ctypes.c_double, _DOUBLES, *_BUFFER, *_BUFFER),
        ),
    ),
    "torchrl_morl_close": (None, (ctypes.c_void_p,)),
}
"""What ``c_interface.cpp`` declares: the result and the arguments of each."""


def compiler() -> str | None:
    """The C++ compiler of this machine."""
    return shutil.which("g++") or shutil.which("clang++")


def build(source: str, output: Path, *flags: str) -> Path:
    """Compile a source of ``cpp/``; a warning is an error.

    Raises:
        RuntimeError: if there is no compiler, or if it does not compile.
    """
    program = compiler()
    if program is None:
        raise RuntimeError("there is no C++ compiler: install g++ or clang++.")
    strict = ("-std=c++17", "-O3", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
    command = [program, *strict, *flags, "-o", str(output), str(SOURCES / source)]
    run = subprocess.run(command, capture_output=True, text=True, timeout=300)
    if run.returncode:
        raise RuntimeError(f"{' '.join(command)}:\n{run.stderr}")
    return output


def build_library(folder: Path) -> Path:
    """The shared library, ``folder/libtorchrl_morl.so``."""
    return build("c_interface.cpp", folder / "libtorchrl_morl.so", "-shared", "-fPIC")


class CppRunner:
    """``torchrl_morl::Runner`` with the interface of :class:`torchrl_morl.deploy.PolicyRunner`.

    Raises:
        ValueError: for what the runner refuses.
    """

    def __init__(
        self,
        library: Path,
        policy: Path,
        *,
        lidar: LidarGeometry,
        robot: Sequence[float] | None = None,
        **options: float,
    ) -> None:
        self._library = ctypes.CDLL(str(library))
        for name, (result, arguments) in _FUNCTIONS.items():
            function = getattr(self._library, name)
            function.restype, function.argtypes = result, arguments
        fields = (lidar.first_angle, lidar.increment, lidar.range_min, lidar.range_max)
        options = [options.get(name, math.nan) for name in _OPTIONS]
        error = ctypes.create_string_buffer(400)
        self._runner = self._library.torchrl_morl_open(
            str(policy).encode(),
            _doubles((*fields, *lidar.mount))[0],
            lidar.num_beams,
            _doubles(options)[0],
            # Three NaN: those of the lidar.
            _doubles(None if robot is None else (*robot, *[math.nan] * (6 - len(robot))))[0],
            error,
            len(error),
        )
        if not self._runner:
            raise ValueError(error.value.decode())

    def step(
        self,
        ranges: np.ndarray | None,
        *,
        goal: Sequence[float] | None,
        preference: Sequence[float],
        stamp: float,
        time: float,
        human: Sequence[float] | None = None,
        human_velocity: Sequence[float] | None = None,
        odometry: Sequence[float] | None = None,
    ) -> Command:
        command, reason = (ctypes.c_double * 3)(), ctypes.create_string_buffer(20)
        detail = ctypes.create_string_buffer(400)
        self._library.torchrl_morl_step(
            self._runner,
            *_doubles(ranges),
            *(_doubles(value)[0] for value in (goal, human, human_velocity, odometry)),
            *_doubles(preference),
            stamp,
            time,
            command,
            *(reason, len(reason)),
            *(detail, len(detail)),
        )
        speed, turn_rate, valid_until = command
        return Command(speed, turn_rate, reason.value.decode(), detail.value.decode(), valid_until)

    def close(self) -> None:
        self._library.torchrl_morl_close(self._runner)


def _doubles(values: Sequence[float] | np.ndarray | None) -> tuple[object, int]:
    """A pointer to numbers, which keeps them, and how many there are."""
    if values is None:
        return None, 0
    array = np.ascontiguousarray(values, dtype=np.float64)
    return array.ctypes.data_as(_DOUBLES), array.size
