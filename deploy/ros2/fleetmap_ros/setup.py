"""ROS 2 package of ament_python: a program that starts the daemon, launch files, parameters, and a layout of RViz."""

from pathlib import Path

from setuptools import setup

NAME = "fleetmap_ros"
FOLDERS = ("launch", "config", "rviz")

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml", "README.md"]),
        *((f"share/{NAME}/{folder}", [str(path) for path in sorted(Path(folder).iterdir())]) for folder in FOLDERS),
    ],
    entry_points={"console_scripts": [f"localizer = {NAME}:main"]},
)
