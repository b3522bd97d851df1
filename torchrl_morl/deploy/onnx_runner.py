"""Drives a robot with an exported policy: NumPy and ONNX Runtime, nothing else.

This file stands alone. Copy it to the robot, beside the file that ``export_onnx`` wrote::

    from onnx_runner import OnnxRunner

An ONNX graph refuses nothing; this refuses what ``torchrl_morl.deploy.PolicyRunner`` refuses. When to stop
is written here for both: the library imports it from here, since this file may import nothing of the library.
"""

from __future__ import annotations

import abc
import collections
import dataclasses
import json
import math
import numbers
from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["Command", "OnnxRunner", "Runner"]

Reason = Literal["drive", "goal reached", "clock", "stale", "no scan", "no goal", "refused"]

FORMAT = 1
TOLERANCE = 1e-4  # how far the sum of a preference may be from one
FASTEST_HUMAN = 3.0  # m/s; two positions further apart are not those of one person
FORGET_HUMAN = 5  # periods after which a human who comes back is seen for the first time
JUMP = 0.1, 0.2  # m and rad, beyond twice the limits, from which on odometry has jumped
NUM_COMMANDS = 4  # last commands that a policy may read; after as many periods without any it stood


@dataclasses.dataclass(frozen=True)
class Command:
    """What the base is told.

    Args:
        speed: forward, m/s.
        turn_rate: counter-clockwise, rad/s.
        reason: ``"drive"``, or why the robot stops: see :class:`~torchrl_morl.deploy.PolicyRunner`.
        detail: the same for a person to read; empty while driving.
        valid_until: on the clock of ``time``, seconds. A base that has got no other command by then
            must stop on its own: nothing here runs if the process hangs.
    """

    speed: float
    turn_rate: float
    reason: Reason
    detail: str
    valid_until: float


class Runner(abc.ABC):
    """When a robot stops, whatever computes its commands: one :meth:`step` a control period."""

    def __init__(
        self,
        period: float,
        nearest_goal: float,
        limits: Mapping[str, Sequence[float]],
        given: tuple[float | None, float | None, float | None, float | None],
        *,
        reads_motion: bool = False,
    ) -> None:
        goal_radius, timeout, max_speed, max_turn_rate = given
        fastest = {name: max(map(abs, limits[name])) for name in ("speed", "turn_rate")}
        self.period = period
        self.goal_radius = _positive("goal_radius", goal_radius, nearest_goal)
        self.timeout = _positive("timeout", timeout, period)
        self.max_speed = _positive("max_speed", max_speed, fastest["speed"])
        self.max_turn_rate = _positive("max_turn_rate", max_turn_rate, fastest["turn_rate"])
        self._fastest = fastest["speed"], fastest["turn_rate"]  # max_speed is of commands alone
        self._time: float | None = None
        self._human: tuple[float, float, float] | None = None
        self._velocity = (0.0, 0.0)
        self.reads_motion = reads_motion
        self._pose: tuple[float, float, float, float] | None = None
        self._measured = (0.0, 0.0)
        self._commands = collections.deque([(0.0, 0.0)] * NUM_COMMANDS, maxlen=NUM_COMMANDS)

    def step(
        self,
        ranges: ArrayLike | None,
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
            human: distance (m) of the nearest person's centre, and bearing (rad); ``None``: nobody.
            human_velocity: of that person over the ground, ahead and to the left of the robot, m/s.
                Only for policies that read it.
            odometry: instead of ``human_velocity``: where the robot is in any fixed frame, x and y
                (m) and heading (rad). The velocity is then that between two positions of the human;
                at first sight it is 0. Needed by policies that read how the robot moves: that is what
                changed since the last step, and what was commanded then. The frame must not jump.
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
            scan, has_valid_beam = self._scan(ranges)
            inputs = {"goal": _polar("goal", goal), "human": None, "human_velocity": None}
            tracked = odometry is not None and human is not None and human_velocity is None
            if self.reads_motion or tracked:
                self._moved(odometry, stamp)
            if human is not None:
                inputs["human"] = human = _polar("human", human)
                if human[0] == 0:
                    raise ValueError("the human is at 0 m: for nobody pass human=None")
                if tracked:
                    human_velocity = self._velocity_of(human, odometry, stamp)
                inputs["human_velocity"] = human_velocity
            if self.reads_motion:
                inputs["motion"] = (*self._measured, *(v for told in self._commands for v in told))
            inputs["preference"] = preference
            speed, turn_rate = self._command(scan, inputs)
        except Exception as error:
            # Whatever objects are given may raise whatever they like: the robot stops.
            kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
            return self._stop("refused", kind + _one_line(error).rstrip("."))
        if not has_valid_beam:
            return self._stop("no scan", "the scan has no valid beam")
        if (distance := inputs["goal"][0]) <= self.goal_radius:
            return self._stop("goal reached", f"the goal is {distance:.2f} m away")
        # Both by the same, so that it follows the same arc.
        slower = max(1.0, abs(speed) / self.max_speed, abs(turn_rate) / self.max_turn_rate)
        speed, turn_rate = speed / slower, turn_rate / slower
        return self._told(Command(speed, turn_rate, "drive", "", time + self.timeout))

    @abc.abstractmethod
    def _scan(self, ranges: ArrayLike) -> tuple[np.ndarray, bool]:
        """What the policy reads of a scan, and whether any of its beams is valid."""

    @abc.abstractmethod
    def _command(self, scan: np.ndarray, inputs: dict[str, Any]) -> tuple[float, float]:
        """Speed (m/s) and turn rate (rad/s); inputs are goal, human, its velocity and the preference, and
        the robot's own motion for policies that read it.
        """

    def _moved(self, odometry: Sequence[float] | None, stamp: float) -> None:
        """Measure speed and turn rate since the last step."""
        if odometry is None:
            raise ValueError("this policy reads how the robot moves: give odometry=")
        x, y, heading = numbers_of("odometry", odometry, "x, y and heading", 3)
        last = self._pose
        since = stamp - last[0] if last else math.inf
        if since > 0:
            self._pose = (stamp, x, y, heading)
        if since > NUM_COMMANDS * self.period:  # nobody has told it anything for so long
            self._measured = (0.0, 0.0)
            self._commands.extend([(0.0, 0.0)] * NUM_COMMANDS)
        elif since > 0:
            east, north = x - last[1], y - last[2]
            turned = math.remainder(heading - last[3], math.tau)
            ahead = math.cos(heading) * east + math.sin(heading) * north
            self._measured = ahead / since, turned / since
            furthest, most = (2 * one * since + more for one, more in zip(self._fastest, JUMP))
            if math.hypot(east, north) > furthest or abs(turned) > most:
                self._measured, self._human = (0.0, 0.0), None

    def _velocity_of(
        self, human: tuple[float, float], odometry: Sequence[float], stamp: float
    ) -> tuple[float, float]:
        """Of the human since the last step, along the axes of the robot."""
        x, y, heading = numbers_of("odometry", odometry, "x, y and heading", 3)
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

    def _stop(self, reason: Reason, detail: str) -> Command:
        until = math.inf if self._time is None else self._time + self.timeout
        return self._told(Command(0.0, 0.0, reason, detail, until))

    def _told(self, command: Command) -> Command:
        self._commands.appendleft((command.speed, command.turn_rate))
        return command


class OnnxRunner(Runner):
    """Drives a robot with an exported policy: one :meth:`~Runner.step` a control period.

    The reasons to stop are those of :class:`torchrl_morl.deploy.PolicyRunner`.

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
        >>> runner.step(scan, goal=(3.0, 0.1), preference=(1, 1, 0), stamp=0.2, time=0.25).reason
        'refused'
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
        try:
            self._session = onnxruntime.InferenceSession(
                str(file), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:
            raise ValueError(f"{file} is no ONNX file: {_one_line(error)}.") from error
        self.metadata = told = _metadata(self._session, file)
        self.preference_names = tuple(told["preference"])
        self._reads = [value.name for value in self._session.get_inputs()]
        self._lidar, self._sensing = told["lidar"], told["sensing"]
        given = goal_radius, timeout, max_speed, max_turn_rate
        super().__init__(
            told["period"],
            told["sensing"]["goal_range"][0],
            told["limits"],
            given,
            reads_motion="motion" in self._reads,
        )

    def _scan(self, ranges: ArrayLike) -> tuple[np.ndarray, bool]:
        ranges = numeric_ranges(ranges, self._lidar["num_beams"])
        if ranges.ndim != 1:
            raise ValueError(f"one scan at a time, got {len(ranges)}")
        near = as_reported(self._lidar["range_min"])
        valid = ((ranges >= near) & (ranges > 0)) | (ranges == -math.inf)
        return ranges, bool(valid.any())

    def _command(self, scan: np.ndarray, inputs: dict[str, Any]) -> tuple[float, float]:
        inputs |= {"ranges": scan, "preference": self._preference(inputs["preference"])}
        if inputs["human"] is None:
            inputs |= {"human": self._sensing["nobody"], "human_velocity": (0.0, 0.0)}
        rows = {}
        for name in self._reads:
            value = inputs[name]
            if name == "human_velocity":
                if value is None:
                    give = "give human_velocity= (ahead, left; m/s) or odometry="
                    raise ValueError(f"this policy reads the human's velocity: {give}")
                value = numbers_of(name, value, "two speeds", 2)
            with np.errstate(over="ignore"):
                rows[name] = np.asarray(value, dtype=np.float32)[None]
            if name != "ranges" and not np.isfinite(rows[name]).all():
                raise ValueError(f"{name} must be finite, got {list(value)}")
        speed, turn_rate = map(float, self._session.run(["command"], rows)[0][0])
        if not math.isfinite(speed + turn_rate):
            raise ValueError(f"the policy's command is not finite, {[speed, turn_rate]}")
        return speed, turn_rate

    def _preference(self, preference: Sequence[float]) -> np.ndarray:
        names = self.preference_names
        wrong = "preference is no array of numbers"
        weights = _array(preference, "fiub", wrong, f"{wrong}: it is")
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


def _metadata(session: Any, file: str | Path) -> dict[str, Any]:
    """What the file tells of itself; ``ValueError`` where it is not one of ``export_onnx`` and this format."""
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
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file}: its metadata is not valid JSON: {_one_line(error)}.") from error
    for name in ("preference", "lidar", "sensing", "limits", "period"):
        if name not in values:
            raise ValueError(f"{file} lacks {name!r} in its metadata.")
    return values


def as_reported(length: float) -> float:
    """A limit as a driver reports it, in float32, where that is less: their 0.12 is less than 0.12."""
    return min(length, float(np.float32(length)))


def numeric_ranges(ranges: ArrayLike, num_beams: int) -> np.ndarray:
    """Ranges ``[*B, num_beams]`` as float64, NaN where they are masked; ``ValueError`` for what is none."""
    wrong = "ranges must be numbers, one a beam"
    ranges = _array(ranges, "fiu", wrong, f"{wrong}: they are").astype(np.float64, copy=False)
    if ranges.ndim == 0 or ranges.shape[-1] != num_beams:
        raise ValueError(
            f"ranges must have shape [..., {num_beams}], one a beam, got {list(ranges.shape)}."
        )
    return ranges


def _array(value: ArrayLike, kinds: str, wrong: str, wrong_dtype: str) -> np.ndarray:
    if isinstance(value, np.ma.MaskedArray):
        # What is masked is invalid, whatever stands behind the mask.
        value = np.ma.filled(value.astype(np.float64), np.nan)
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{wrong}: {_one_line(error)}.") from error
    if array.dtype.kind not in kinds:
        raise ValueError(f"{wrong_dtype} {array.dtype}.")
    return array


def numbers_of(name: str, value: Any, what: str, count: int) -> tuple[float, ...]:
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
    distance, bearing = numbers_of(name, value, "a distance and a bearing", 2)
    if distance < 0:
        raise ValueError(
            f"{name} must be finite, with a distance of at least 0, got {(distance, bearing)}"
        )
    return distance, bearing


def _positive(name: str, value: float | None, default: float) -> float:
    value = default if value is None else value
    if not (_is_number(value) and value > 0):
        raise ValueError(f"{name} must be finite and positive, got {value!r}.")
    return value


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
    """A message in one short line, without the dot at its end."""
    text = " ".join(str(error).split())
    return (text if len(text) <= 200 else f"{text[:200]}...").removesuffix(".")
