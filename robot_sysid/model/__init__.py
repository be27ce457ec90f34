"""Models as MuJoCo compiles them, and the arm in them; here the options that choose both.

The options stand apart from the other modules, which import MuJoCo.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Optional

from robot_sysid.records.option_fields import (
    Factor,
    OptionRecord,
    PathUse,
    check_finite,
    check_scale,
    option,
)


@dataclass(frozen=True)
class ModelOptions(OptionRecord):
    """Options that choose a model file (``path``, MJCF or URDF), the arm in it and its rest."""

    path: Path = Path()
    mesh_dir: Optional[Path] = option(
        None,
        "folder of the mesh files",
        default_text="what the model says",
        path_use=PathUse.FOLDER,
    )
    joint: Optional[str] = option(
        None, "terminal joint", "NAME", default_text="found automatically"
    )
    first_joint: Optional[str] = option(
        None,
        "first joint of the arm, where those before it, as of a torso, stand still",
        "NAME",
        default_text="the one nearest to the base",
    )
    fix_base: bool = option(
        False, "the base that a free joint carries stands still where the model has it"
    )
    mass_scale: Optional[Factor] = option(
        None,
        "multiply all masses and moments of inertia of the model by this; 1.7+-16% may be so far "
        "off",
        "FACTOR",
        check=check_scale,
    )
    total_mass: Optional[float] = option(
        None,
        "mass of the arm with its base, from its data sheet, where the model states no masses: "
        "it is spread over the links by volume",
        "KG [kg] > 0",
        default_text="what the model says",
    )
    gravity: Optional[tuple[float, ...]] = option(
        None,
        "direction in which gravity acts, in the model's axes: of an arm that hangs, or is mounted "
        "on a wall",
        metavar=("X", "Y", "Z"),
        check=check_finite,
        default_text="what the model says",
    )
    keyframe: Optional[str] = option(
        None,
        "keyframe in which the arm is at rest, where motions start",
        "NAME",
        default_text="home, or the only one",
    )


OF_LOG = (
    "mesh_dir",
    "joint",
    "first_joint",
    "fix_base",
    "mass_scale",
    "total_mass",
    "gravity",
)
"""Keys of the options of a model that is compared with a log, and is not moved."""
