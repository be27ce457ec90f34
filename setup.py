"""Packages and files of the wheel; all else is in pyproject.toml.

The examples lie beside the package, where a reader looks for them, and travel inside it. An
editable install finds them where they are, and is a plain path, which type checkers follow.
"""

import sys

from setuptools import find_packages, setup

EXAMPLE = "robot_sysid.examples.kinova"
IS_EDITABLE = "editable_wheel" in sys.argv

setup(
    packages=[
        *find_packages(include=["robot_sysid*"]),
        *([] if IS_EDITABLE else [EXAMPLE]),
    ],
    package_dir={"": "."} if IS_EDITABLE else {EXAMPLE: "examples/kinova"},
    include_package_data=False,
    package_data={
        "robot_sysid.api": ["*.pyi"],
        "robot_sysid.damiao": ["motors.csv"],
        "robot_sysid": ["py.typed", "*.pyi", "schemas/*.json"],
        "robot_sysid.report": ["*.html"],
        "robot_sysid.results": ["card_templates/*.txt"],
        EXAMPLE: ["README.md", "*.ipynb", "model/*.xml", "model/meshes/*.stl"],
    },
)
