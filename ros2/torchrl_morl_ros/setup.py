"""Installed by colcon; ``pip install`` of this folder does as well."""

from pathlib import Path

from setuptools import setup

NAME = "torchrl_morl_ros"
HERE = Path(__file__).parent

setup(
    name=NAME,
    version="0.2.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", [str(p.relative_to(HERE)) for p in HERE.glob("config/*.yaml")]),
        (f"share/{NAME}/launch", [str(p.relative_to(HERE)) for p in HERE.glob("launch/*.py")]),
    ],
    install_requires=["setuptools", "numpy", "torchrl-morl>=0.2"],
    zip_safe=True,
    maintainer="The torchrl-morl contributors",
    description="Drives a robot with a preference-conditioned navigation policy of torchrl-morl.",
    license="MIT",
    entry_points={
        "console_scripts": [
            f"policy_node = {NAME}.node:main",
            f"simulated_robot = {NAME}.simulated_robot:main",
        ]
    },
)
