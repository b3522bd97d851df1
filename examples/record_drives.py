"""Record drives in a file that ``recipes.teach`` takes: here of a scripted driver, on the right at 1.5 m.

On a robot, write the same columns from its odometry and from what sees the human.
"""

import csv

from envs import NavigationEnv
from envs.demonstrations import CircleDemonstrator
from recipes.arguments import Parser, new_file

COLUMNS = ("trajectory", "time", "x", "y", "heading", "human_x", "human_y", "goal_x", "goal_y")


def main(path: str = "drives.csv", drives: int = 20) -> None:
    env = NavigationEnv(scene="empty", num_envs=drives, seed=10_000)
    driver = CircleDemonstrator(radius=1.5, side="right")
    data = env.rollout(300, driver, break_when_any_done=False, break_when_all_done=True)
    with open(path, "x", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for name, drive in enumerate(data):
            last = int(drive["next", "done"].int().argmax())
            for step, row in enumerate(drive[: last + 1]["next"]):
                numbers = [*row["pose"], *row["human_pose"][:2], *row["scene", "goal"]]
                time = env.CONTROL_PERIOD * step
                writer.writerow([name, f"{time:.1f}", *(f"{float(x):.3f}" for x in numbers)])
    print(f"{drives} drives: {path}")


if __name__ == "__main__":
    parser = Parser(description=__doc__)
    parser.add_argument("file", nargs="?", type=new_file, default="drives.csv", help="to write")
    file = parser.parse_args().file
    try:
        main(str(file))
    except OSError as error:
        parser.error(f"{file}: {error.strerror}: choose another file")
