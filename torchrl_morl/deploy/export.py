"""Write a policy as one ONNX file: raw ranges, goal, human and preference in, m/s and rad/s out.

    python -m torchrl_morl.deploy.export recipes/policies/navigation --onnx navigation.onnx --robot 0.177 0.5 3.14
    python -m torchrl_morl.deploy.export POLICY --onnx FILE --lidar -3.1416 0.017453 360 0.12 3.5
    python -m torchrl_morl.deploy.export POLICY --onnx FILE --runner onnx_runner.py

The lidar is that of the robot, which becomes part of the file: angle of the first beam (rad), angle from
beam to beam (rad; negative: clockwise), number of beams, nearest and furthest range (m), as in ROS's
LaserScan. Without --lidar it is that of the training: 720 beams, counter-clockwise from straight ahead.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from . import onnx_runner
from .files import check_new, write_new
from .lidar import LidarGeometry
from .onnx_export import export_onnx, training_lidar
from .policy_files import load_policy

__all__ = ["main"]


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message}\n")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command.

    Args:
        arguments: those of the command line if ``None``.
    """
    parser = _Parser(
        prog="export",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("policy", type=Path, help="folder of the policy")
    parser.add_argument("--onnx", type=Path, required=True, help="file to write")
    parser.add_argument(
        "--lidar",
        nargs=5,
        metavar=("FIRST_ANGLE", "INCREMENT", "NUM_BEAMS", "RANGE_MIN", "RANGE_MAX"),
        help="of the robot",
    )
    parser.add_argument(
        "--mount",
        nargs=3,
        type=float,
        metavar=("X", "Y", "YAW"),
        help="of the lidar: ahead and to the left of the rotation centre (m), yaw (rad)",
    )
    parser.add_argument(
        "--robot",
        nargs="+",
        type=float,
        metavar="NUMBER",
        help="for policies that read which robot they drive: radius (m), top speed (m/s), top turn rate (rad/s); "
        "after them may stand the lidar's view (rad), range (m) and place ahead (m), where they are not --lidar's",
    )
    parser.add_argument(
        "--runner",
        type=Path,
        help="write the checks beside it: a file that needs numpy and onnxruntime alone",
    )
    given = parser.parse_args(arguments)
    try:
        if given.runner is not None:
            check_new(given.runner)
            if given.runner.resolve() == given.onnx.resolve():
                raise ValueError(f"--runner {given.runner} is the file of --onnx: choose another.")
        policy = load_policy(given.policy)
        if given.lidar is None:
            if given.mount is not None:
                raise ValueError("--mount is of a lidar: give --lidar as well.")
            lidar = training_lidar(policy, robot=given.robot)
        else:
            lidar = _lidar(given.lidar, given.mount or (0.0, 0.0, 0.0))
        export_onnx(policy, given.onnx, lidar=lidar, robot=given.robot)
        if given.runner is not None:
            write_new(given.runner, Path(onnx_runner.__file__).read_bytes())
    except (OSError, ValueError, ImportError) as error:
        parser.error(str(error))
    first, last = lidar.first_angle, lidar.first_angle + lidar.increment * (lidar.num_beams - 1)
    print(
        f"{given.onnx}: {lidar.num_beams} beams from {first:.4f} to {last:.4f} rad, "
        f"{lidar.range_min:g} to {lidar.range_max:g} m; "
        f"preference: {', '.join(policy.preference_space.tunable)}; a step every {policy.period:g} s"
    )


def _lidar(numbers: Sequence[str], mount: Sequence[float]) -> LidarGeometry:
    given = f"--lidar {' '.join(numbers)}"
    try:
        first, increment, _, nearest, furthest = map(float, numbers)
        num_beams = int(numbers[2])
    except ValueError:
        raise ValueError(f"{given}: must be numbers, and NUM_BEAMS a whole one.") from None
    try:
        return LidarGeometry(first, increment, num_beams, nearest, furthest, tuple(mount))
    except ValueError as error:
        raise ValueError(f"{given}: {str(error).removeprefix('lidar: ')}") from error


if __name__ == "__main__":
    main()
