"""LeRobot's files as a joint map: what a robot's configuration calls its motors, or a calibration.

::

    {"motor_config": {"joint_1": [1, 17, "dm8009"], ...}, "port": "can0", ...}      configuration
    {"joint_1": {"id": 1, "drive_mode": 0, "homing_offset": 0, ...}, ...}             calibration

A configuration may have one such part per arm, ``left_arm_config`` and ``right_arm_config``; the
names of its motors begin with left_ and right_ then, as in LeRobot's own recordings.

LeRobot uses what Damiao motors report as it is, in degrees: it writes a zero into the motor when it
calibrates, and applies neither drive_mode nor homing_offset. So a motor turns as its joint does.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from robot_sysid.damiao.protocol.joints import MASTER_ID_OFFSET, DamiaoJoint, checked_map
from robot_sysid.errors import InputError
from robot_sysid.json_files import read_json

_SIDES = {f"{side}_arm_config": f"{side}_" for side in ("left", "right")}


def read_lerobot_map(path: Path, names: Sequence[str] = ()) -> tuple[DamiaoJoint, ...]:
    """Read a joint map out of one of LeRobot's files, or raise InputError.

    A motor takes the name of the one joint out of a model's ``names`` that ends with its own, its
    signs left out: joint_1 becomes openarm_left_joint1.
    """
    content = read_json(path, "give LeRobot's calibration, or a configuration with motor_config")
    try:
        rows = tuple(_rows(content))
    except (TypeError, ValueError, KeyError, AttributeError, IndexError) as error:
        said = f"{type(error).__name__}: {error}"
        raise InputError(f"{path} is no calibration or configuration of LeRobot ({said})") from None
    return checked_map(path, tuple(replace(row, name=_known(row.name, names)) for row in rows))


def _rows(content: Mapping[str, Any], prefix: str = "", channel: str = "") -> Iterator[DamiaoJoint]:
    parts = {key: part for key, part in content.items() if key in (*_SIDES, "robot")}
    for key, part in parts.items():
        yield from _rows(part, _SIDES.get(key, ""))
    if parts:
        return
    if "motor_config" in content:
        for name, (can_id, master_id, *_) in content["motor_config"].items():
            where = "", int(can_id), int(master_id), prefix + name, 0, str(content.get("port", ""))
            yield DamiaoJoint(*where)
        return
    for name, entry in content.items():
        for key in ("drive_mode", "homing_offset"):
            if entry[key] != 0:
                raise ValueError(f"{key} of {name} is {entry[key]}, 0 for Damiao motors")
        yield DamiaoJoint("", int(entry["id"]), int(entry["id"]) + MASTER_ID_OFFSET, name)


def _known(name: str, names: Sequence[str]) -> str:
    bare = {each: re.sub(r"[^a-z0-9]", "", each.lower()) for each in (name, *names)}
    found = [each for each in names if bare[each].endswith(bare[name])]
    return found[0] if len(found) == 1 else name
