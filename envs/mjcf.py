"""The MuJoCo model: a robot, a human, a goal marker and boxes, all of primitive geoms.

Collision geoms are in group 0, which is also what MuJoCo's rays see in tests and benchmarks (the
lidar of the environment computes its ranges from the scene); group 1 is decoration. Human, goal
and boxes are mocap bodies, placed at reset; box sizes are set for each environment.
"""

from __future__ import annotations

from typing import Literal

from .robots import Robot
from .scenes import HUMAN_RADIUS

HUMAN_HEIGHT = 1.7
BOX_HEIGHT = 0.6
LIDAR_HEIGHT = 0.25

# What the wheels' motors can do, m/s^2: a third of the weight rests on the driven wheels, which spin
# when asked for more.
_WHEEL_ACCELERATION = 3.0

Drive = Literal["planar", "wheels"]

_PLANAR = """
    <body name="robot" pos="0 0 {half_height}">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="y" type="slide" axis="0 1 0"/>
      <joint name="yaw" type="hinge" axis="0 0 1"/>
      <site name="base"/>
      <geom name="robot" class="robot" type="cylinder" size="{radius} {half_height}" mass="{mass}"/>
      {decoration}
    </body>"""

_PLANAR_ACTUATORS = """
    <velocity name="forward" site="base" gear="1 0 0 0 0 0" kv="{kv_forward}"/>
    <velocity name="turn" joint="yaw" kv="{kv_turn}"/>
    <velocity name="no_slip" site="base" gear="0 1 0 0 0 0" kv="{kv_lateral}"/>"""

# Sphere wheels touch the floor in a point; the contact of a cylinder wanders along its edge and
# makes the base turn several percent too slowly. The casters slide: a contact takes the larger
# condim of its two geoms, so the floor leaves the choice to them with condim 1.
_WHEELS = """
    <body name="robot" pos="0 0 0">
      <freejoint name="base"/>
      <geom name="robot" class="robot" type="cylinder" pos="0 0 {body_centre}"
            size="{radius} {body_half_height}" mass="{mass}"/>
      <geom name="caster_front" class="caster" pos="{caster} 0 {caster_radius}"
            size="{caster_radius}"/>
      <geom name="caster_back" class="caster" pos="-{caster} 0 {caster_radius}"
            size="{caster_radius}"/>
      <body name="left_wheel" pos="0 {half_track} {wheel_radius}">
        <joint name="left_wheel" type="hinge" axis="0 1 0" armature="{armature}"
               actuatorfrcrange="-{torque} {torque}"/>
        <geom class="wheel" size="{wheel_radius}"/>
      </body>
      <body name="right_wheel" pos="0 -{half_track} {wheel_radius}">
        <joint name="right_wheel" type="hinge" axis="0 1 0" armature="{armature}"
               actuatorfrcrange="-{torque} {torque}"/>
        <geom class="wheel" size="{wheel_radius}"/>
      </body>
      {decoration}
    </body>"""

# The base's velocities as its wheels measure them, each under a servo of its own, as on robots: with
# a servo for each wheel one time constant would have to do for both.
_WHEELS_TENDONS = """
  <tendon>
    <fixed name="forward">
      <joint joint="left_wheel" coef="{half_radius}"/>
      <joint joint="right_wheel" coef="{half_radius}"/>
    </fixed>
    <fixed name="turn">
      <joint joint="left_wheel" coef="-{radius_per_track}"/>
      <joint joint="right_wheel" coef="{radius_per_track}"/>
    </fixed>
  </tendon>"""

_WHEELS_ACTUATORS = """
    <velocity name="forward" tendon="forward" kv="{kv_rolling}"/>
    <velocity name="turn" tendon="turn" kv="{kv_rolling_turn}"/>"""

_WORLD = """
<mujoco model="navigation">
  <compiler angle="radian"/>
  <option timestep="{timestep}" integrator="{integrator}" gravity="0 0 {gravity}"/>
  <visual>
    <quality shadowsize="0"/>
    <headlight ambient="0.5 0.5 0.5" diffuse="0.2 0.2 0.2" specular="0 0 0"/>
    <map znear="0.01" zfar="60"/>
  </visual>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1="0.80 0.88 0.95" rgb2="0.97 0.97 0.96"
             width="256" height="256"/>
    <texture name="floor" type="2d" builtin="checker" rgb1="0.93 0.93 0.91" rgb2="0.88 0.88 0.86"
             width="256" height="256"/>
    <material name="floor" texture="floor" texrepeat="1 1" texuniform="true"/>
  </asset>
  <default>
    <geom contype="0" conaffinity="0"/>
    <default class="decoration"><geom group="1" mass="0"/></default>
    <default class="robot"><geom contype="1" conaffinity="2" rgba="0.20 0.22 0.26 1"/></default>
    <default class="obstacle"><geom contype="2" conaffinity="1"/></default>
    <default class="wheel">
      <geom type="sphere" contype="1" conaffinity="4" friction="1 0.005 0.0001" mass="0.1"
            group="1"/>
    </default>
    <default class="caster">
      <geom type="sphere" contype="1" conaffinity="4" condim="1" mass="0.05" group="1"/>
    </default>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="40 40 0.1" material="floor" group="2" {floor_contact}/>
    <light directional="true" pos="0 0 10" dir="0.3 0.2 -0.9" ambient="0 0 0"
           diffuse="0.35 0.35 0.35" specular="0 0 0" castshadow="false"/>{robot}{people}
    <body name="goal" mocap="true">
      <geom class="decoration" type="cylinder" pos="0 0 0.005" size="{goal_radius} 0.005"
            rgba="0.30 0.30 0.30 0.35"/>
      <geom class="decoration" type="cylinder" pos="0 0 0.3" size="0.03 0.3"
            rgba="0.10 0.10 0.10 1"/>
    </body>{boxes}
  </worldbody>{tendons}
  <actuator>{actuators}
  </actuator>
</mujoco>
"""

_PERSON = """
    <body name="{name}" mocap="true">
      <geom name="{name}" class="obstacle" type="cylinder" pos="0 0 {human_half}"
            size="{human_radius} {human_half}" rgba="0.10 0.10 0.10 1"/>
      <geom class="decoration" type="sphere" pos="0 0 {human_height}" size="0.18"
            rgba="1 1 1 1"/>
      <geom class="decoration" type="capsule" fromto="0.05 0 {human_height} 0.38 0 {human_height}"
            size="0.04" rgba="0.10 0.10 0.10 1"/>
    </body>"""

_BOX = """
    <body name="box{index}" mocap="true">
      <geom name="box{index}" class="obstacle" type="box" pos="0 0 {half}" size="0.3 0.3 {half}"
            rgba="0.60 0.60 0.62 1"/>
    </body>"""

# A white bar on top of the robot points where it is heading. Colours are left to preferences.
_DECORATION = """<geom class="decoration" type="capsule" size="{bar}"
            fromto="{tail} 0 {top} {nose} 0 {top}" rgba="1 1 1 1"/>"""


def time_step(drive: Drive) -> float:
    """Physics time step of a drive, seconds: rolling contact needs a finer one.

    Raises:
        ValueError: for an unknown drive.
    """
    if drive not in ("planar", "wheels"):
        raise ValueError(f"Unknown drive {drive!r}: choose 'planar' or 'wheels'.")
    return 0.05 if drive == "planar" else 0.01


def navigation_mjcf(
    robot: Robot, *, drive: Drive, num_boxes: int, num_people: int = 1, goal_radius: float
) -> str:
    """MJCF of a scene for one robot.

    Args:
        robot: dimensions and actuation.
        drive: ``"planar"`` slides the base on two joints and a hinge under velocity servos, with
            a stiff lateral servo for the wheels' no-slip; ``"wheels"`` rolls it on the floor.
        num_boxes: boxes in the scene.
        num_people: people in the scene: "human", and "person1" and so on.
        goal_radius: of the goal marker, metres.

    Raises:
        ValueError: for an unknown drive.
    """
    names = ["human", *(f"person{index}" for index in range(1, num_people))]
    half_height = robot.height / 2
    inertia = 0.5 * robot.mass * robot.radius**2
    half_track = robot.wheel_separation / 2
    # A wheel carries half the mass at its rim. Its motor's rotor, behind its gears, is as much again:
    # a wheel without it is so light that it turns before the base moves. So the servos move twice the
    # mass, and what the rotors add to a turn sits at the wheels.
    rotor = 0.5 * robot.mass * robot.wheel_radius**2
    caster_radius = 0.6 * robot.wheel_radius
    ground_clearance = 0.5 * robot.wheel_radius
    values = {
        "radius": robot.radius,
        "mass": robot.mass,
        "half_height": half_height,
        "body_centre": half_height + ground_clearance,
        "body_half_height": half_height,
        "caster": 0.7 * robot.radius,
        "caster_radius": caster_radius,
        "half_track": half_track,
        "wheel_radius": robot.wheel_radius,
        "kv_forward": robot.mass / robot.linear_response,
        "kv_turn": inertia / robot.angular_response,
        # No slip: the velocity follows the heading, one time step late in a turn.
        "kv_lateral": 800.0 * robot.mass,
        "armature": rotor,
        "half_radius": robot.wheel_radius / 2,
        "radius_per_track": robot.wheel_radius / robot.wheel_separation,
        "kv_rolling": 2 * robot.mass / robot.linear_response,
        "kv_rolling_turn": (inertia + robot.mass * half_track**2) / robot.angular_response,
        "torque": 2 * rotor * _WHEEL_ACCELERATION / robot.wheel_radius,
    }
    base_height = half_height if drive == "planar" else 0.0
    top = robot.height - base_height + (0.0 if drive == "planar" else ground_clearance)
    bar = 0.22 * robot.radius
    decoration = _DECORATION.format(
        bar=bar, tail=-0.1 * robot.radius, nose=robot.radius - bar, top=top
    )
    if drive == "planar":
        body, tendons, actuators = _PLANAR, "", _PLANAR_ACTUATORS
    else:
        body, tendons, actuators = _WHEELS, _WHEELS_TENDONS, _WHEELS_ACTUATORS
    return _WORLD.format(
        timestep=time_step(drive),
        # implicitfast leaves out the servos' coupling of the two slides, which the mass matrix lacks:
        # the base would accelerate up to ten times more slowly when not heading along an axis. So do
        # both for the two wheels, whose fine time step needs neither.
        integrator="implicit" if drive == "planar" else "Euler",
        gravity=0 if drive == "planar" else -9.81,
        floor_contact="" if drive == "planar" else 'contype="4" conaffinity="1" condim="1"',
        robot=body.format(decoration=decoration, **values),
        tendons=tendons.format(**values),
        actuators=actuators.format(**values),
        people="".join(map(_person, names)),
        goal_radius=goal_radius,
        boxes="".join(_BOX.format(index=i, half=BOX_HEIGHT / 2) for i in range(num_boxes)),
    )


def _person(name: str) -> str:
    return _PERSON.format(
        name=name,
        human_half=HUMAN_HEIGHT / 2 - 0.06,
        human_height=HUMAN_HEIGHT - 0.1,
        human_radius=HUMAN_RADIUS,
    )
