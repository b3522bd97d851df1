"""Drives a robot with an exported policy: NumPy and ONNX Runtime, nothing else.

This file stands alone. Copy it to the robot, beside the file that ``export_onnx`` wrote::

    from onnx_runner import OnnxRunner

An ONNX graph refuses nothing; this refuses what ``torchrl_morl.deploy.PolicyRunner`` refuses, for the
same reasons, and gives the same commands.
"""

from __future__ import annotations

import dataclasses
import json
import math
import numbers
from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["Command", "OnnxRunner"]

FORMAT = 1
TOLERANCE = 1e-4  # how far the sum of a preference may be from one
FASTEST_HUMAN = 3.0  # m/s; two positions further apart are not those of one person
FORGET_HUMAN = 5  # periods after which a human who comes back is seen for the first time


@dataclasses.dataclass(frozen=True)
class Command:
    """What the base is told.

    Args:
        speed: forward, m/s.
        turn_rate: counter-clockwise, rad/s.
        reason: ``"drive"``, or why the robot stops.
        detail: the same for a person to read; empty while driving.
        valid_until: on the clock of ``time``, seconds. A base that has got no other command by then
            must stop on its own: nothing here runs if the process hangs.
    """

    speed: float
    turn_rate: float
    reason: str
    detail: str
    valid_until: float


class OnnxRunner:
    """Drives a robot with an exported policy: one :meth:`step` a control period.

    The reasons to stop are those of :class:`torchrl_morl.deploy.PolicyRunner`: ``goal reached``,
    ``clock``, ``stale``, ``no scan``, ``no goal`` and ``refused``.

    Args:
        file: that ``export_onnx`` wrote.

    Keyword Args:
        goal_radius: distance at which the goal is reached, metres; that of the training if ``None``.
        timeout: age at which an input is too old, seconds; one period if ``None``.
        max_speed: of the robot, m/s, if lower than the policy's.
        max_turn_rate: likewise, rad/s. Both are lowered together: the robot follows the same arc.

    Raises:
        ImportError: where ONNX Runtime is not installed.
        FileNotFoundError: if there is no such file.
        ValueError: for a file of another origin or format, or limits that are not positive.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_morl.deploy import LidarGeometry, export_onnx
        >>> from torchrl_morl.testing import untrained_policy
        >>> lidar = LidarGeometry(-np.pi, np.pi / 180, 360, range_min=0.12, range_max=3.5)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = export_onnx(untrained_policy(), f"{folder}/policy.onnx", lidar=lidar)
        ...     runner = OnnxRunner(file)
        >>> scan, preference = np.full(360, np.inf), (0.0, 0.5, 0.5)
        >>> command = runner.step(
        ...     scan, goal=(3.0, 0.1), preference=preference, stamp=0.0, time=0.05
        ... )
        >>> command.reason, command.speed > 0.1
        ('drive', True)
        >>> runner.step(
        ...     scan, goal=(3.0, 0.1), preference=(1, 1, 0), stamp=0.2, time=0.25
        ... ).detail
        "preference = [1.0, 1.0, 0.0] over ('demo', 'distance', 'efficiency') sums to 2; it must sum \
to 1 within 0.0001"
    """

    def __init__(
        self,
        file: str | Path,
        *,
        goal_radius: float | None = None,
        timeout: float | None = None,
        max_speed: float | None = None,
        max_turn_rate: float | None = None,
    ) -> None:
        try:
            import onnxruntime
        except ModuleNotFoundError as error:
            raise ImportError(
                "OnnxRunner needs onnxruntime: pip install onnxruntime.", name=error.name
            ) from error
        if not Path(file).is_file():
            raise FileNotFoundError(f"{file} not found: export_onnx writes such a file.")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # the network is small
        providers = ["CPUExecutionProvider"]
        try:
            self._session = onnxruntime.InferenceSession(str(file), options, providers=providers)
        except Exception as error:
            raise ValueError(f"{file} is no ONNX file: {_one_line(error)}.") from error
        self.metadata = _metadata(self._session, file)
        self.preference_names = tuple(self.metadata["preference"])
        self.period: float = self.metadata["period"]
        self._reads = [value.name for value in self._session.get_inputs()]
        self._lidar, self._sensing = self.metadata["lidar"], self.metadata["sensing"]
        limits = self.metadata["limits"]
        self.goal_radius = self._sensing["goal_range"][0] if goal_radius is None else goal_radius
        self.timeout = self.period if timeout is None else timeout
        fastest = {name: max(map(abs, limits[name])) for name in ("speed", "turn_rate")}
        self.max_speed = fastest["speed"] if max_speed is None else max_speed
        self.max_turn_rate = fastest["turn_rate"] if max_turn_rate is None else max_turn_rate
        for name in ("goal_radius", "timeout", "max_speed", "max_turn_rate"):
            value = getattr(self, name)
            if not (_is_number(value) and value > 0):
                raise ValueError(f"{name} must be finite and positive, got {value!r}.")
        self._time: float | None = None
        self._human: tuple[float, float, float] | None = None
        self._velocity = (0.0, 0.0)

    def step(
        self,
        ranges: Any,
        *,
        goal: Sequence[float] | None,
        preference: Sequence[float],
        stamp: float,
        time: float,
        human: Sequence[float] | None = None,
        human_velocity: Sequence[float] | None = None,
        odometry: Sequence[float] | None = None,
    ) -> Command:
        """Command for the next control period. It raises for nothing that it is given: it stops.

        Args:
            ranges: the scan ``[num_beams]``, metres.

        Keyword Args:
            goal: distance (m) and bearing (rad) from the robot.
            preference: weights of the tunable objectives, on the simplex.
            stamp: when the oldest input was measured, seconds.
            time: now, on the same clock.
            human: distance (m) and bearing (rad) of the nearest person; ``None``: nobody.
            human_velocity: of that person over the ground, ahead and to the left of the robot, m/s.
                Only for policies that read it.
            odometry: instead of ``human_velocity``: x and y (m) and heading (rad) of the robot in any
                fixed frame.
        """
        last, self._time = self._time, time if _is_number(time) else self._time
        if not _is_number(time) or not _is_number(stamp):
            given = f"{_shown(time)} and {_shown(stamp)}"
            return self._stop("clock", f"time and stamp must be finite numbers, got {given}")
        if last is not None and time <= last:
            return self._stop("clock", f"time is {time} s, at the last step it was {last} s")
        age = time - stamp
        if age < -self.timeout:
            return self._stop("clock", f"stamp is {-age:.2f} s later than time: two clocks")
        if age > self.timeout + 1e-9:
            allowed = f"at most {self.timeout:g} s are allowed"
            return self._stop("stale", f"the inputs are {age:.2f} s old, {allowed}")
        if ranges is None:
            return self._stop("no scan", "the scan is None")
        if goal is None:
            return self._stop("no goal", "the goal is None")
        try:
            ranges, goal = self._scan(ranges), _polar("goal", goal)
            human = None if human is None else _polar("human", human)
            if human is not None and human[0] == 0:
                raise ValueError("the human is at 0 m: for nobody pass human=None")
            if human is not None and human_velocity is None and odometry is not None:
                human_velocity = self._velocity_of(human, odometry, stamp)
            inputs = {"ranges": ranges, "goal": goal} | self._person(human, human_velocity)
            inputs["preference"] = self._preference(preference)
            row = {name: _row(name, inputs[name]) for name in self._reads}
            speed, turn_rate = map(float, self._session.run(["command"], row)[0][0])
            if not math.isfinite(speed + turn_rate):
                raise ValueError(f"the policy's command is not finite, {[speed, turn_rate]}")
        except Exception as error:
            # Whatever objects are given may raise whatever they like: the robot stops.
            kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
            return self._stop("refused", kind + _one_line(error).rstrip("."))
        near = _rounded(self._lidar["range_min"])
        if not (((ranges >= near) & (ranges > 0)) | (ranges == -math.inf)).any():
            return self._stop("no scan", "the scan has no valid beam")
        if goal[0] <= self.goal_radius:
            return self._stop("goal reached", f"the goal is {goal[0]:.2f} m away")
        share = min(
            1.0,
            self.max_speed / max(abs(speed), 1e-9),
            self.max_turn_rate / max(abs(turn_rate), 1e-9),
        )
        return Command(speed * share, turn_rate * share, "drive", "", time + self.timeout)

    def _scan(self, ranges: Any) -> np.ndarray:
        if isinstance(ranges, np.ma.MaskedArray):
            ranges = np.ma.filled(ranges.astype(np.float64), np.nan)
        try:
            ranges = np.asarray(ranges)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"ranges must be numbers, one a beam: {_one_line(error)}") from error
        if ranges.dtype.kind not in "fiu":
            raise ValueError(f"ranges must be numbers, one a beam: they are {ranges.dtype}")
        if ranges.shape != (self._lidar["num_beams"],):
            raise ValueError(
                f"ranges must have shape [{self._lidar['num_beams']}], one a beam, "
                f"got {list(ranges.shape)}"
            )
        return ranges

    def _person(
        self, human: tuple[float, float] | None, velocity: Sequence[float] | None
    ) -> dict[str, Sequence[float]]:
        if "human_velocity" not in self._reads:
            velocity = (0.0, 0.0)
        elif human is not None and velocity is None:
            raise ValueError(
                "this policy reads the human's velocity: give human_velocity=, ahead and to the "
                "left in m/s, or odometry="
            )
        still = human is None or velocity is None
        velocity = (0.0, 0.0) if still else _numbers("human_velocity", velocity, "two speeds", 2)
        return {
            "human": self._sensing["nobody"] if human is None else human,
            "human_velocity": velocity,
        }

    def _preference(self, preference: Sequence[float]) -> np.ndarray:
        if isinstance(preference, np.ma.MaskedArray):
            preference = np.ma.filled(preference.astype(np.float64), np.nan)
        names = self.preference_names
        try:
            weights = np.asarray(preference)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"preference is no array of numbers: {_one_line(error)}") from error
        if weights.dtype.kind not in "fiub":
            raise ValueError(f"preference is no array of numbers: it is {weights.dtype}")
        if weights.shape != (len(names),):
            raise ValueError(
                f"preference must have shape [{len(names)}] for {names}, got {list(weights.shape)}"
            )
        with np.errstate(over="ignore"):
            weights = weights.astype(np.float32)
        for name, weight in zip(names, weights.tolist()):
            if not 0 <= weight < math.inf:
                raise ValueError(f"preference of {name!r} must be finite and >= 0, got {weight:g}")
        total = float(weights.sum())
        if not abs(total - 1) <= TOLERANCE:
            raise ValueError(
                f"preference = {weights.tolist()} over {names} sums to {total:g}; it must sum to 1 "
                f"within {TOLERANCE:g}"
            )
        return weights

    def _velocity_of(
        self, human: tuple[float, float], odometry: Sequence[float], stamp: float
    ) -> tuple[float, float]:
        """Of the human since the last step, along the axes of the robot."""
        x, y, heading = _numbers("odometry", odometry, "x, y and heading", 3)
        distance, bearing = human
        x += distance * math.cos(heading + bearing)
        y += distance * math.sin(heading + bearing)
        last, self._human = self._human, (stamp, x, y)
        since = stamp - last[0] if last else math.inf
        if since <= 0:  # the same inputs again
            self._human = last
        elif since > FORGET_HUMAN * self.period:
            self._velocity = (0.0, 0.0)
        else:
            velocity = (x - last[1]) / since, (y - last[2]) / since
            self._velocity = velocity if math.hypot(*velocity) <= FASTEST_HUMAN else (0.0, 0.0)
        east, north = self._velocity
        cos, sin = math.cos(heading), math.sin(heading)
        return cos * east + sin * north, cos * north - sin * east

    def _stop(self, reason: str, detail: str) -> Command:
        until = math.inf if self._time is None else self._time + self.timeout
        return Command(0.0, 0.0, reason, detail, until)


def _metadata(session: Any, file: str | Path) -> dict[str, Any]:
    """What the file tells of itself.

    Raises:
        ValueError: if it is not one of ``export_onnx``, or of a later format.
    """
    found = session.get_modelmeta().custom_metadata_map
    if "torchrl_morl_format" not in found:
        raise ValueError(f"{file} is not a file of export_onnx: it lacks torchrl_morl_format.")
    if found["torchrl_morl_format"] != str(FORMAT):
        raise ValueError(
            f"{file} has format {found['torchrl_morl_format']}, this version reads {FORMAT}: use the "
            "onnx_runner.py of the version that wrote it."
        )
    try:
        values = {name: json.loads(text) for name, text in found.items()}
    except ValueError as error:
        raise ValueError(f"{file}: its metadata is not valid JSON: {_one_line(error)}.") from error
    for name in ("preference", "lidar", "sensing", "limits", "period"):
        if name not in values:
            raise ValueError(f"{file} lacks {name!r} in its metadata.")
    return values


def _row(name: str, value: Any) -> np.ndarray:
    """A batch of one; ranges may be infinite, or no number, and nothing else may."""
    with np.errstate(over="ignore"):
        row = np.asarray(value, dtype=np.float32)[None]
    if name != "ranges" and not np.isfinite(row).all():
        raise ValueError(f"{name} must be finite, got {list(value)}")
    return row


def _rounded(length: float) -> float:
    """A limit as a driver reports it, in float32, where that is less."""
    return min(length, float(np.float32(length)))


def _numbers(name: str, value: Any, what: str, count: int) -> tuple[float, ...]:
    # A set or a mapping has no order that anybody meant.
    unordered = isinstance(value, (Set, Mapping))
    try:
        found = () if unordered else tuple(float(entry) for entry in value)
    except (TypeError, ValueError, OverflowError):
        found = ()
    if len(found) != count:
        raise ValueError(f"{name} must be {what}, got {_shown(value)}")
    if not all(map(math.isfinite, found)):
        raise ValueError(f"{name} must be finite, got {found}")
    return found


def _polar(name: str, value: Any) -> tuple[float, float]:
    distance, bearing = _numbers(name, value, "a distance and a bearing", 2)
    if distance < 0:
        raise ValueError(
            f"{name} must be finite, with a distance of at least 0, got {(distance, bearing)}"
        )
    return distance, bearing


def _is_number(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond all floats
        return False


def _shown(value: object) -> str:
    try:
        return _one_line(repr(value))
    except Exception:  # whatever an object does instead of telling what it is
        return f"a {type(value).__name__}"


def _one_line(error: object) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= 200 else f"{text[:200]}..."
