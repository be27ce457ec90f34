"""Packages and files of the wheel; all else is in pyproject.toml.

The examples lie beside the package, where a reader looks for them, and travel inside it.
"""

from setuptools import find_packages, setup

EXAMPLE = "robot_sysid.examples.kinova"

setup(
    packages=[*find_packages(include=["robot_sysid*"]), EXAMPLE],
    package_dir={EXAMPLE: "examples/kinova"},
    package_data={
        "robot_sysid": ["py.typed", "*.pyi", "schemas/*.json"],
        "robot_sysid.report": ["*.html"],
        EXAMPLE: ["README.md", "*.ipynb", "model/*.xml", "model/meshes/*.stl"],
    },
)
