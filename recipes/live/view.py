"""What a browser shows of a :class:`~recipes.live.simulation.LiveSimulation`, and what it lets one do."""

from __future__ import annotations

import queue
from collections.abc import Callable
from typing import Any, get_args

import numpy as np
import viser

from envs import HUMAN_RADIUS, SCENES
from envs.drive import yaw_quaternion
from envs.mjcf import BOX_HEIGHT, HUMAN_HEIGHT, LIDAR_HEIGHT
from recipes.objectives import known, preference_colors

from .simulation import LiveSimulation, Motion, one_human

_GREY = (150, 150, 152)
_DARK = (40, 42, 46)

_EVERY = 5
"""Control steps between two looks ahead, which cost as much as sixty of them."""


def on_floor(camera: np.ndarray, point: np.ndarray, height: float) -> tuple[float, float]:
    """Where the ray from a camera through a point meets a plane above the floor.

    A drag ends on a plane that faces the camera, not on the one on which things stand.

    Args:
        camera: where it is, x, y, z.
        point: another one of the ray.
        height: of the plane, metres.

    Raises:
        ValueError: for a ray that does not come down to it.

    Examples:
        >>> on_floor(np.array([0.0, 0.0, 4.0]), np.array([1.0, 0.0, 3.0]), 0.0)
        (4.0, 0.0)
    """
    way = point - camera
    share = (height - camera[2]) / way[2] if way[2] else -1.0
    if not share > 0:
        raise ValueError("the ray does not come down to the floor.")
    x, y, _ = camera + share * way
    return float(x), float(y)


def with_weight(preference: np.ndarray, entry: int, value: float) -> np.ndarray:
    """A preference with one weight set; the others keep their shares of the rest.

    Examples:
        >>> with_weight(np.array([0.5, 0.25, 0.25]), 0, 0.0)
        array([0. , 0.5, 0.5])
    """
    rest = 1 - preference[entry]
    others = (
        preference / rest if rest > 1e-9 else np.full_like(preference, 1 / (len(preference) - 1))
    )
    changed = others * (1 - value)
    changed[entry] = value
    return changed


class LiveView:
    """Nodes and controls of a server. Callbacks run in other threads: they leave what is to be done in a queue.

    Args:
        server: that shows it.
        simulation: that is shown.
    """

    def __init__(self, server: viser.ViserServer, simulation: LiveSimulation) -> None:
        self.server, self.simulation = server, simulation
        self.playing, self.pace, self._steps = True, 1.0, -1
        self._asked: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        names = simulation.policy.preference_space.tunable
        self._rows = known(names)
        self._colors = preference_colors(np.eye(len(names)), names)
        self._things: dict[str, Any] = {}
        self._ways: np.ndarray | None = None
        server.scene.set_up_direction("+z")
        server.scene.add_grid("/floor", width=40, height=40, cell_size=1.0, plane="xy")
        self._controls()
        self.build()

    def build(self) -> None:
        """The things of the scene, anew, and nothing of what was there."""
        for thing in self._things.values():
            thing.remove()
        scene, simulation = self.server.scene, self.simulation
        robot, things = simulation.env.robot, self._things
        things.clear()
        things["robot"] = scene.add_cylinder(
            "/robot", radius=robot.radius, height=robot.height, color=_DARK
        )
        scene.add_box(
            "/robot/nose",  # goes with it
            color=(255, 255, 255),
            dimensions=(0.7 * robot.radius, 0.06, 0.03),
            position=(0.55 * robot.radius, 0.0, robot.height / 2 + 0.02),
        )
        things["human"] = scene.add_cylinder(
            "/human", radius=HUMAN_RADIUS, height=HUMAN_HEIGHT, color=(90, 95, 105)
        )
        things["goal"] = scene.add_cylinder(
            "/goal", radius=simulation.env.goal_radius, height=0.04, color=(60, 150, 90)
        )
        for index, box in enumerate(simulation.boxes):
            things[f"box{index}"] = scene.add_box(
                f"/box{index}", color=_GREY, dimensions=(2 * box[3], 2 * box[4], BOX_HEIGHT)
            )
        for name in ("human", "goal", *(f"box{i}" for i in range(len(simulation.boxes)))):
            self._make_draggable(name)
        start, goal = simulation.pose[:2], simulation.goal
        middle = (start + goal) / 2
        self.server.initial_camera.position = (middle[0], middle[1] - 7.0, 7.5)
        self.server.initial_camera.look_at = (middle[0], middle[1], 0.0)
        self.show(simulation.pose)

    def handle(self) -> None:
        """Do what has been asked for since the last call."""
        while not self._asked.empty():
            self._asked.get()()

    def show(self, pose: np.ndarray) -> None:
        """Put everything where it is, with the robot at ``pose``."""
        simulation, things = self.simulation, self._things
        robot = simulation.env.robot
        things["robot"].position = (pose[0], pose[1], robot.height / 2)
        things["robot"].wxyz = _turned(pose[2])
        color = preference_colors(simulation.preference, [row.name for row in self._rows])
        things["robot"].color = tuple(round(255 * value) for value in color)
        things["human"].position = (*simulation.human, HUMAN_HEIGHT / 2)
        things["goal"].position = (*simulation.goal, 0.02)
        for index, (x, y, yaw, *_) in enumerate(simulation.boxes):
            things[f"box{index}"].position = (x, y, BOX_HEIGHT / 2)
            things[f"box{index}"].wxyz = _turned(yaw)

    def show_step(self) -> None:
        """What changes with a control step: numbers, the path, and what is shown on wish."""
        simulation = self.simulation
        ending = {
            None: "on its way",
            "success": "at the goal",
            "collision_human": "touched the person",
            "collision_obstacle": "touched a box",
            "truncated": "not there after a minute",
        }[simulation.ending]
        self._numbers.content = (
            f"**{ending}**, {simulation.seconds:.1f} s\n\nto the person {simulation.human_distance:.2f} m, "
            f"nearest {simulation.nearest:.2f} m"
        )
        if len(simulation.path) > 1:
            self._line("path", np.array(simulation.path), (200, 200, 205), 0.05)
        self._steps += 1
        if self._show_ways.value and simulation.ending is None and self._steps % _EVERY == 0:
            for entry, way in enumerate(simulation.ways_ahead()):
                color = tuple(round(255 * value) for value in self._colors[entry])
                self._line(f"way{entry}", way, color, 0.04)
        if self._show_lidar.value:
            self._lidar()

    def _line(self, name: str, points: np.ndarray, color: tuple[int, ...], width: float) -> None:
        raised = np.column_stack((points, np.full(len(points), 0.03)))
        self._things[name] = self.server.scene.add_line_segments(
            f"/{name}",
            points=np.stack((raised[:-1], raised[1:]), 1).astype(np.float32),
            colors=color,
            thickness=width,
        )

    def _lidar(self) -> None:
        simulation = self.simulation
        x, y, heading = simulation.pose
        offset = simulation.env.robot.lidar_offset
        ranges = simulation.scan
        angles = heading + 2 * np.pi * np.arange(len(ranges)) / len(ranges)
        met = ranges < simulation.env.max_range - 1e-6
        ends = np.column_stack(
            (
                x + offset * np.cos(heading) + ranges * np.cos(angles),
                y + offset * np.sin(heading) + ranges * np.sin(angles),
                np.full(len(ranges), LIDAR_HEIGHT),
            )
        )[met]
        self._things["lidar"] = self.server.scene.add_point_cloud(
            "/lidar", points=ends.astype(np.float32), colors=(10, 102, 216), point_size=0.03
        )

    def _make_draggable(self, name: str) -> None:
        thing = self._things[name]

        @thing.on_drag
        async def _(event: Any) -> None:
            # Async: the phases of a drag come in their order.
            self.drag(name, event)

    def drag(self, name: str, event: Any) -> None:
        """Somebody drags a thing: a :class:`viser.SceneNodeDragEvent`."""
        camera = np.asarray(event.client.camera.position)
        try:
            x, y = on_floor(camera, np.asarray(event.end_position), event.start_position[2])
        except ValueError:  # towards the sky
            return
        self._asked.put(lambda: self.simulation.move(name, x, y))

    def _forget(self, *names: str) -> None:
        for name in [one for one in self._things if one.startswith(names)]:
            self._things.pop(name).remove()

    def again(self, seed: int | None = None) -> None:
        """The episode from its start, or that of another seed."""
        self.simulation.restart(seed)
        self.build()

    def _controls(self) -> None:
        gui, simulation = self.server.gui, self.simulation
        self._numbers = gui.add_markdown("")
        with gui.add_folder("What matters"):
            self._weights = [
                gui.add_slider(
                    row.label, min=0, max=100, step=1, initial_value=round(100 * float(weight))
                )
                for row, weight in zip(self._rows, simulation.preference)
            ]
            for entry, slider in enumerate(self._weights):

                @slider.on_update
                def _(event: Any, entry: int = entry) -> None:
                    if event.client is not None:  # somebody did it, and not `weigh`
                        self.weigh(entry, event.target.value / 100)

        with gui.add_folder("Where"):
            held = [name for name, scene in SCENES.items() if one_human(scene)]
            names = tuple(dict.fromkeys((simulation.scene.name, *held)))
            self._scene = gui.add_dropdown("scene", names, initial_value=simulation.scene.name)
            self._seed = gui.add_number("seed", simulation.seed, min=0, max=2**31 - 1, step=1)
            self._motion = gui.add_dropdown(
                "the person", get_args(Motion), initial_value=simulation.motion
            )
        self._show_ways = gui.add_checkbox("ways ahead", True)
        self._show_lidar = gui.add_checkbox("lidar", False)
        pace = gui.add_dropdown("speed", ("0.5", "1", "2", "4"), initial_value="1")
        play, again = gui.add_button("Pause"), gui.add_button("Again")

        def ask(action: Callable[[], None]) -> Callable[[Any], None]:
            return lambda _: self._asked.put(action)

        def toggle() -> None:
            self.playing = not self.playing
            play.label = "Pause" if self.playing else "Go on"

        def set_pace() -> None:
            self.pace = float(pace.value)

        self._seed.on_update(ask(lambda: self.again(int(self._seed.value))))
        given = simulation.scene

        def enter() -> None:
            name = self._scene.value
            simulation.enter(given if name == given.name else SCENES[name])
            self._motion.value = simulation.motion
            self.build()

        self._scene.on_update(ask(enter))
        self._motion.on_update(ask(lambda: simulation.set_motion(self._motion.value)))
        self._show_ways.on_update(ask(lambda: self._forget("way")))
        self._show_lidar.on_update(ask(lambda: self._forget("lidar")))
        pace.on_update(ask(set_pace))
        play.on_click(ask(toggle))
        again.on_click(ask(self.again))

    def weigh(self, entry: int, value: float) -> None:
        """Somebody gives an objective a weight, from 0 to 1."""

        def change() -> None:
            self.simulation.preference = with_weight(self.simulation.preference, entry, value)
            for slider, weight in zip(self._weights, self.simulation.preference):
                slider.value = round(100 * float(weight))

        self._asked.put(change)

    @property
    def weights(self) -> list[int]:
        """What the sliders say, per cent."""
        return [slider.value for slider in self._weights]

    @property
    def numbers(self) -> str:
        """What is written above them."""
        return self._numbers.content

    def things(self, name: str) -> list[Any]:
        """Nodes whose names begin so."""
        return [thing for key, thing in self._things.items() if key.startswith(name)]


def _turned(yaw: float) -> tuple[float, ...]:
    return tuple(yaw_quaternion(np.array([yaw]))[0])
