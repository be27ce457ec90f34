"""The settings file of an arm's driver, with identified numbers in place of its own.

Drivers keep one number per joint, from the base on, as a list of YAML on one line; the gripper's
may follow: ``coulomb_friction: [0.3, 0.3, 0.06]``. Only the numbers of identified joints change.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from robot_sysid.errors import InputError
from robot_sysid.records.messages import count_text

if TYPE_CHECKING:
    from robot_sysid.records import Array
    from robot_sysid.results.record import Result

FIELDS: Mapping[str, str] = {
    "gravity_comp_factor": "scale",
    "coulomb_friction": "coulomb",
    "breakaway": "coulomb",
    "Fc": "coulomb",
    "Fv": "viscous",
}
"""Field of a settings file to what it holds: the torque scale of each joint, which multiplies the
model's gravity torque, or the dry [N m] or viscous [N m s/rad] friction. The first three fields are
those of i2rt's ``robots/config/yam.yml``, the others those of openarm_teleop's
``config/follower.yaml``."""
_FIELD = re.compile(rf"^([ \t]*({'|'.join(FIELDS)})[ \t]*:[ \t]*\[)([^\]\n]*)", re.M)
"""A field with its list up to the closing bracket: what precedes the numbers, name, numbers."""


def require_driver_settings(path: Path, n_joints: int) -> None:
    """Raise InputError unless a file is the settings of an arm with so many joints.

    It has at least one field of ``FIELDS``, each with a number per joint or more.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise InputError(
            f"--driver-settings {path} cannot be read; give the settings file of a driver"
        ) from None
    matches = list(_FIELD.finditer(text))
    if not matches:
        raise InputError(
            f"{path} has none of the fields {', '.join(FIELDS)}, each with a list in brackets "
            "behind it; give the settings file of i2rt or openarm_teleop"
        )
    for _, field, numbers in (match.groups() for match in matches):
        count = len(numbers.split(","))
        if count < n_joints:
            raise InputError(
                f"{path}: {field} has {count_text(count, 'number')}, the arm has "
                f"{n_joints} joints; give the settings of this arm"
            )


def updated_settings(text: str, result: Result, scales: Array) -> str:
    """Return the text of a settings file with the identified numbers.

    A driver commands what the log's torque column reads: friction is multiplied by the torque
    scale.

    Args:
        text: of a file that ``require_driver_settings`` takes.
        result: an identification from measured torques.
        scales: (n,) torque that the column of each joint reads over the torque that is there.
    """

    def replace_numbers(match: re.Match[str]) -> str:
        """Return a field with the numbers of the identified joints replaced."""
        start, field, numbers = match.groups()
        entries = [entry.strip() for entry in numbers.split(",")]
        values = _joint_values(result, FIELDS[field], scales)
        entries[: len(scales)] = [f"{value:.4g}" for value in values]
        return start + ", ".join(entries)

    return _FIELD.sub(replace_numbers, text)


def _joint_values(result: Result, quantity: str, scales: Array) -> Iterator[float]:
    """Yield a value per joint: its torque scale, or a friction term of the written model."""
    robot = result.robot
    written = result.file.joints if result.file is not None else {}
    for index, joint in enumerate(robot.joint_names):
        scale = float(scales[index])
        if quantity == "scale":
            yield scale
        elif quantity in written.get(joint, {}):
            yield scale * written[joint][quantity].value
        else:
            yield scale * float(getattr(robot.friction, quantity)[index])
