"""The shipped policy as a controller in numpy, without simulator: a scan in, speed and turn rate out.

The world here is twelve lines: a unicycle, a person who is a circle, a lidar of 360 beams.
"""

import argparse
from pathlib import Path

import numpy as np

from torchrl_morl.deploy import LidarGeometry, PolicyRunner, load_policy

POLICY = Path(__file__).parents[1] / "recipes" / "policies" / "navigation"
ROBOT = (0.177, 0.5, np.pi)  # radius, top speed, top turn rate
GOAL, PERSON, RADIUS = np.array([9.0, 0.0]), np.array([4.5, 0.0]), 0.25
BEAMS = np.linspace(-np.pi, np.pi, 360, endpoint=False)


def polar(pose: np.ndarray, point: np.ndarray) -> tuple[float, float]:
    dx, dy = point - pose[:2]
    bearing = np.arctan2(dy, dx) - pose[2]
    return np.hypot(dx, dy), (bearing + np.pi) % (2 * np.pi) - np.pi


def scan(pose: np.ndarray) -> np.ndarray:
    distance, bearing = polar(pose, PERSON)
    along, aside = distance * np.cos(BEAMS - bearing), distance * np.sin(BEAMS - bearing)
    hit = (np.abs(aside) <= RADIUS) & (along > 0)
    return np.where(hit, along - np.sqrt(np.maximum(RADIUS**2 - aside**2, 0.0)), np.inf)


def drive(preference: tuple[float, ...]) -> tuple[float, float]:
    lidar = LidarGeometry(-np.pi, 2 * np.pi / 360, 360, range_min=0.1, range_max=4.0)
    policy = load_policy(POLICY)
    runner = PolicyRunner(policy, lidar=lidar, robot=ROBOT)
    pose, nearest = np.zeros(3), np.inf
    for step in range(300):
        time = policy.period * step
        goal, person = polar(pose, GOAL), polar(pose, PERSON)
        command = runner.step(
            scan(pose),
            goal=goal,
            human=person,
            preference=preference,
            odometry=pose,
            stamp=time,
            time=time,
        )
        if command.reason != "drive":
            break
        nearest = min(nearest, person[0])
        ahead = np.array([np.cos(pose[2]), np.sin(pose[2])])
        pose += policy.period * np.array([*(command.speed * ahead), command.turn_rate])
    print(f"{preference}: {command.reason} after {time:.1f} s, {nearest:.2f} m from the person")
    return time, nearest


def main() -> None:
    for preference in ((1, 0, 0), (0, 1, 0), (0, 0, 1)):  # demonstration, distance, efficiency
        drive(preference)


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()  # --help; it takes nothing else
    main()
