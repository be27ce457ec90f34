"""What a program may give as a model, and the arm in it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Union

from robot_sysid.errors import InputError
from robot_sysid.model.in_memory import InMemory, compiled_in_memory, file_of, is_in_memory
from robot_sysid.model.options import ModelOptions
from robot_sysid.parser import load_robot_model, robot_from_compiled
from robot_sysid.records import RobotModel
from robot_sysid.records.options import record_from

Model = Union[str, "os.PathLike[str]", InMemory]
"""Path of an MJCF or URDF file, or a model of MuJoCo's."""


def path_of(model: Model) -> Path:
    """Return the file of a model; of one in memory a copy that MuJoCo writes.

    Raises:
        InputError: it is no model, or cannot be written.
    """
    if is_in_memory(model):
        return file_of(model)
    if not isinstance(model, (str, os.PathLike)):
        known = "the path of an MJCF or URDF file, a mujoco.MjSpec or a mujoco.MjModel"
        raise InputError(f"a model is {known}, not {type(model).__name__}")
    return Path(model)


def arm_of(model: Model, values: Mapping[str, Any]) -> RobotModel:
    """Return the arm in a model, with the options of ``ModelOptions``; see ``path_of``."""
    chosen = record_from(ModelOptions, values)
    if is_in_memory(model):
        compiled = compiled_in_memory(model)
        return robot_from_compiled(compiled, Path("model"), chosen.joint, keyframe=chosen.keyframe)
    return load_robot_model(path_of(model), chosen.mesh_dir, chosen.joint, keyframe=chosen.keyframe)
