"""Drive a policy in the real MuJoCo environment, under your hands, in a browser.

Change what matters to it as it drives, drag the person, the goal and the boxes::

    python -m recipes.live
    python -m recipes.live --scene moving_human

Then open the address that it prints. ``make page`` builds a page that needs none of this; here any policy, scene,
robot and drive runs that ``recipes.evaluate`` takes. Needs viser: ``pip install -c constraints.txt -e . --group live``.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
import torch

from envs import ROBOTS, SCENES
from envs.policy_env import check_policy
from recipes.arguments import Parser, count, seed
from recipes.evaluation.setting import choose
from recipes.evaluation.sweep import SHIPPED_POLICY
from recipes.policy_folders import policy_folder
from torchrl_morl.deploy import load_policy
from torchrl_morl.geometry import wrap_angle

from .simulation import LiveSimulation

if TYPE_CHECKING:
    from .view import LiveView

FRAME = 1 / 30
PAUSE_AT_THE_END = 2.0


def main() -> None:
    """Serve it until Ctrl-C; ``--help`` lists the options."""
    parser = Parser(prog="python -m recipes.live", description=__doc__)
    parser.add_argument(
        "--policy", type=policy_folder, default=SHIPPED_POLICY, help="folder of the policy"
    )
    parser.add_argument("--scene", default="showcase", help=f"{', '.join(SCENES)}, or a .yaml file")
    parser.add_argument(
        "--robot", help=f"{', '.join(ROBOTS)}, or a .yaml file (default: that of the training)"
    )
    parser.add_argument(
        "--drive", choices=("planar", "wheels"), help="default: that of the training"
    )
    parser.add_argument("--seed", type=seed, default=7, metavar="N", help="of the scene")
    parser.add_argument(
        "--host", default="127.0.0.1", help="where it listens (0.0.0.0: in the whole network)"
    )
    parser.add_argument(
        "--port", type=count(1, 65_535), default=8080, metavar="N", help="(%(default)s)"
    )
    args = parser.parse_args()
    torch.set_num_threads(1)
    try:
        import viser
    except ModuleNotFoundError as error:
        parser.error(f"{error.name} is missing: pip install -c constraints.txt -e . --group live")
    try:
        policy = load_policy(args.policy)
        if policy.sensing is None:
            raise ValueError(
                f"{args.policy}: its file does not tell what it senses: save it again."
            )
        setting = choose(
            policy.card, scene=args.scene, robot=args.robot, drive=args.drive, one_robot=True
        )
        check_policy(policy, setting.arguments)
        simulation = LiveSimulation(policy, setting, seed=args.seed)
        server = viser.ViserServer(
            host=args.host, port=args.port, label="torchrl-morl", verbose=False
        )
    except (OSError, ValueError, RuntimeError) as error:
        parser.error(str(error))
    from .view import LiveView

    view = LiveView(server, simulation)
    # viser takes the next port where one is in use.
    print(f"open http://{args.host}:{server.get_port()} (Ctrl-C ends it)")
    try:
        serve(view, simulation)
    except KeyboardInterrupt:
        print()
    finally:
        server.stop()
        simulation.close()


def serve(view: LiveView, simulation: LiveSimulation, *, seconds: float = np.inf) -> None:
    """Step and show, a control period of the simulation in one of the clock times the pace.

    Args:
        view: of the simulation.
        simulation: that runs.

    Keyword Args:
        seconds: after which it returns.
    """
    began = before = time.perf_counter()
    fraction, last, ended = 1.0, simulation.pose, None
    while (now := time.perf_counter()) - began < seconds:
        view.handle()
        if simulation.ending is None:
            ended = None
        if view.playing:
            fraction += (now - before) * view.pace / simulation.env.CONTROL_PERIOD
        if fraction >= 1 and view.playing:
            last = simulation.pose
            if simulation.ending is None:
                simulation.step()
                view.show_step()
                fraction = min(fraction - 1, 1.0)
            else:
                fraction = 1.0
                ended = ended or now
                if now - ended > PAUSE_AT_THE_END:
                    view.again()
                    last = simulation.pose
        before = now
        view.show(between(last, simulation.pose, fraction))
        time.sleep(max(FRAME - (time.perf_counter() - now), 0.0))


def between(first: np.ndarray, second: np.ndarray, share: float) -> np.ndarray:
    """A pose between two, headings the shortest way.

    Examples:
        >>> between(np.array([0.0, 0.0, 3.0]), np.array([1.0, 0.0, -3.0]), 0.5).round(3)
        array([0.5  , 0.   , 3.142])
    """
    way = second - first
    way[2] = wrap_angle(torch.as_tensor(way[2]))
    return first + share * way


if __name__ == "__main__":
    main()
