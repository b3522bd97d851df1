"""The simulated robot with faults, what it was told, and the node in a process of its own."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar, NamedTuple

import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from std_msgs.msg import Float64MultiArray
from torchrl_morl_ros.simulated_robot import SimulatedRobot

ROOT = Path(__file__).resolve().parents[3]
POLICY = ROOT / "recipes" / "policies" / "polished_seed0"
STARTS = 240.0
"""Seconds that a node may take to start on a busy machine: it imports PyTorch."""


class Moment(NamedTuple):
    """A step of the robot: when, how fast it moved, and what its sensors told after it."""

    time: float
    speed: float
    turn_rate: float
    scan: list[float]
    goal: tuple[float, float]
    human: tuple[float, float]

    @property
    def stands(self) -> bool:
        return abs(self.speed) < 0.01 and abs(self.turn_rate) < 0.05


class Robot(SimulatedRobot):
    """Remembers, and has faults: ``silent``, ``stale`` and ``nan`` scans, ``lost`` humans."""

    def __init__(self, factor: float = 1.0, **parameters) -> None:
        given = {"real_time_factor": factor, "next_scene": False, **parameters}
        overrides = [Parameter(name, value=value) for name, value in given.items()]
        self.fault, self.moments, self.commands, self.told = "", [], [], []
        self.began: float | None = None
        self._last_stamp = Time()
        super().__init__(parameter_overrides=overrides)
        self.factor = factor
        self.create_subscription(DiagnosticArray, "/diagnostics", self._hear, 10)
        self._weights = self.create_publisher(Float64MultiArray, "preference", 1)
        self._due = time.monotonic()

    # --- faults

    def scan(self):
        message = super().scan()
        if self.fault and self.began is None:
            self.began = self.now
        if self.fault == "silent":
            return None
        if self.fault == "stale":
            message.header.stamp = self._last_stamp
        elif self.fault == "nan":
            message.ranges = [math.nan] * len(message.ranges)
        return message

    def human(self):
        return None if self.fault == "lost" else super().human()

    # --- memory

    def advance(self) -> None:
        super().advance()
        state = self.state
        scan, goal, human = (state[key][0].tolist() for key in ("scan", "goal", "human"))
        self.moments.append(Moment(self.now, *self.velocity, scan, goal, human))
        if self.fault != "stale":
            self._last_stamp = Time(sec=int(self.now), nanosec=int(self.now % 1 * 1e9))

    def take_command(self, twist) -> None:
        super().take_command(twist)
        self.commands.append((self.now, twist.linear.x, twist.angular.z))

    def _hear(self, message) -> None:
        values = {entry.key: entry.value for entry in message.status[0].values}
        self.told.append((self.now, values))

    @property
    def reason(self) -> str:
        """The last one that the node told."""
        return self.told[-1][1]["reason"] if self.told else ""

    @property
    def stands(self) -> bool:
        return self.moments[-1].stands

    # --- time

    def run(self, until: Callable[[], bool], limit: float) -> bool:
        """Go on until something is so, or for this many seconds of the wall; whether it is."""
        end = time.monotonic() + limit
        while not until():
            if time.monotonic() > end:
                return False
            # A machine that was busy for long is not caught up with.
            self._due = max(self._due + self.period / self.factor, time.monotonic() - 0.05)
            while (left := self._due - time.monotonic()) > 0:
                rclpy.spin_once(self, timeout_sec=left)
            rclpy.spin_once(self, timeout_sec=0.0)
            self.advance()
        return True

    def rest(self, seconds: float) -> None:
        end = self.now + seconds
        self.run(lambda: self.now >= end, 10 + seconds / self.factor)

    def prefer(self, *weights: float) -> None:
        """Tell the node by its topic."""
        self._weights.publish(Float64MultiArray(data=weights))

    def set_parameter(self, name: str, value):
        """Ask the node by its service; what it answers."""
        parameter = Parameter(name, value=value).to_parameter_msg()
        request = SetParameters.Request(parameters=[parameter])
        return self.ask(SetParameters, "set_parameters", request).results[0]

    def ask(self, kind, name: str, request):
        """What a service of the node answers."""
        client = self.create_client(kind, f"/policy_node/{name}")
        assert self.run(client.service_is_ready, STARTS)
        future = client.call_async(request)
        assert self.run(future.done, 30)
        self.destroy_client(client)
        return future.result()


class NodeProcess:
    """``python -m torchrl_morl_ros``, which the robot meets on topics alone."""

    running: ClassVar[list[subprocess.Popen]] = []

    def __init__(self, log: Path, **parameters) -> None:
        given = {"policy": POLICY, "autostart": "true", **parameters}
        given = {name: value for name, value in given.items() if value is not None}
        words = [word for name, value in given.items() for word in ("-p", f"{name}:={value}")]
        self._arguments, self.log = ["--ros-args", *words], log
        self.start()

    def start(self) -> None:
        """Another process, with the same parameters, into the same log."""
        self._interrupted = False
        path = os.pathsep.join([str(ROOT), str(ROOT / "ros2" / "torchrl_morl_ros")])
        self._out = self.log.open("a")
        self.process = subprocess.Popen(
            [sys.executable, "-m", "torchrl_morl_ros", *self._arguments],
            env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
            stdin=subprocess.DEVNULL,
            stdout=self._out,
            stderr=subprocess.STDOUT,
        )
        self.running.append(self.process)

    def kill(self) -> None:
        """As a crash does; it may take a while until all its memory is given back."""
        self.process.kill()
        self._out.close()

    def interrupt(self) -> None:
        """As Ctrl-C does, once."""
        if not self._interrupted and self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        self._interrupted = True

    def end(self) -> int:
        """Interrupt it; its exit status."""
        self.interrupt()
        try:
            return self.process.wait(STARTS)  # it unloads PyTorch
        finally:
            self.process.kill()
            self._out.close()

    def said(self) -> str:
        return self.log.read_text()
