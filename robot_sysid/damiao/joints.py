"""Motor types, which motor drives which joint, whether ids can share a bus, and mountings.

A type's scaling limits PMAX, VMAX, TMAX only say how numbers are packed into frames; what a motor
can deliver is in its ratings. The limits are stored in each motor and can be changed there, so the
table of types serves the export and the comparison with the registers; on a bus the register values
are used.

A motor may turn the other way than its joint in the model, have its zero elsewhere, and deliver
another torque than it believes:

    motor position = direction * joint position + offset
    motor velocity = direction * joint velocity
    joint torque   = direction * torque ratio * motor torque

Stiffness and damping ask for motor torque, so they are divided by the ratio. Everything above the
frames is in joint space; only here and in the frames are motors' own numbers.

A joint map is a small table in a file; only ``joint``, ``can_id`` and ``direction`` have to be
there::

    joint,bus,can_id,master_id,direction,offset,torque_ratio,verified
    shoulder,can0,1,0x11,+1,0.0,1.0,hand
    elbow,can0,2,0x12,-1,0.785,1.0,

``verified`` is how somebody saw that this motor turns this joint this way, if anybody has.

LeRobot's files are joint maps too, a robot's configuration or a calibration::

    {"motor_config": {"joint_1": [1, 17, "dm8009"], ...}, "port": "can0", ...}      configuration
    {"joint_1": {"id": 1, "drive_mode": 0, "homing_offset": 0, ...}, ...}             calibration

A configuration may have one such part per arm, ``left_arm_config`` and ``right_arm_config``; the
names of its motors begin with left_ and right_ then, as in LeRobot's own recordings.

LeRobot uses what Damiao motors report as it is, in degrees: it writes a zero into the motor when it
calibrates, and applies neither drive_mode nor homing_offset. So a motor turns as its joint does.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import pi
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.damiao.protocol import Address, MitCommand
from robot_sysid.errors import InputError, error_text
from robot_sysid.json_files import read_json
from robot_sysid.records import Array
from robot_sysid.records.atomic_files import write_whole
from robot_sysid.special_files import refuse_special_file

RPM = 2.0 * pi / 60.0
"""One revolution per minute [rad/s]."""
# Relative; PMAX of two types is 12.5 and 12.566, five times as far apart.
_AGREEMENT = 1e-3


@dataclass(frozen=True)
class MotorSpec:
    """One motor type, from the maker's data sheets; all quantities are at the output shaft.

    Attributes:
        limits: PMAX [rad], VMAX [rad/s], TMAX [N m].
        rated_torque: torque the motor can hold for good [N m].
        peak_torque: torque it reaches for a short time [N m].
        gear_ratio: motor turns per output turn.
        supply: supply voltage the type is usually run at [V].
        no_load_rpm: its speed without load at that voltage [rev/min], None where unknown.
        rotor: inertia of its rotor times the gear ratio squared [kg m^2], 0 where unknown.
    """

    name: str
    limits: tuple[float, float, float]
    rated_torque: float
    peak_torque: float
    gear_ratio: float
    supply: float = 24.0
    no_load_rpm: float | None = None
    rotor: float = 0.0
    note: str = ""


_SPECS = (
    MotorSpec("DM4310", (12.5, 30.0, 10.0), 3.0, 7.0, 10.0, 24.0, 200.0, 0.0018),
    MotorSpec("DM4340", (12.5, 10.0, 28.0), 9.0, 27.0, 40.0, 24.0, 52.0, 0.032),
    MotorSpec("DM4340_48V", (12.5, 20.0, 28.0), 9.0, 27.0, 40.0, 48.0, 100.0, 0.032),
    MotorSpec("DM6006", (12.5, 45.0, 12.0), 4.0, 12.0, 6.0, 24.0, 240.0, 0.0021),
    MotorSpec("DM8006", (12.5, 45.0, 20.0), 8.0, 20.0, 6.0, 24.0, 200.0, 0.0041),
    MotorSpec("DM10010L", (12.5, 25.0, 200.0), 40.0, 120.0, 10.0, 24.0, 100.0, 0.056),
    MotorSpec("DM8009", (12.5, 45.0, 54.0), 20.0, 40.0, 9.0, 24.0, 160.0, 0.0158),
    MotorSpec("DM3507", (12.566, 50.0, 5.0), 0.8, 3.0, 7.0, 24.0, 460.0, 0.00043),
    MotorSpec(
        *("DM4310_48V", (12.5, 50.0, 10.0), 3.0, 7.0, 10.0, 48.0, 400.0, 0.0018),
        note="the maker's sources disagree about VMAX (30 or 50 rad/s)",
    ),
    MotorSpec("DM6248", (12.566, 20.0, 120.0), 30.0, 97.0, 48.0, 48.0, None, 0.124),
    MotorSpec("DM10010", (12.5, 20.0, 200.0), 40.0, 150.0, 10.0, 48.0, 150.0, 0.055),
    MotorSpec("DMH3510", (12.5, 280.0, 1.0), 0.18, 0.45, 1.0),
    MotorSpec("DMH6215", (12.5, 45.0, 10.0), 1.0, 2.0, 1.0),
    MotorSpec(
        *("DMS3519", (12.5, 2000.0, 2.0), 3.5, 7.8, 19.2),
        note="its TMAX is below the motor's rated torque and its VMAX leaves steps of 1 rad/s: "
        "compare with the registers before using torques or velocities",
    ),
    MotorSpec("DMG6220", (12.5, 45.0, 10.0), 1.3, 2.7, 1.0),
)
MOTORS = {spec.name: spec for spec in _SPECS}


def motor_spec(name: str) -> MotorSpec:
    """Return the type called ``name``, or raise InputError listing the valid ones."""
    try:
        return MOTORS[name]
    except KeyError:
        valid = ", ".join(MOTORS)
        raise InputError(
            f"unknown Damiao motor type {name!r}; valid types: {valid}"
        ) from None


def matching_types(limits: tuple[float, float, float]) -> tuple[str, ...]:
    """Return the names of the types whose (PMAX, VMAX, TMAX) [rad, rad/s, N m] agree."""
    return tuple(spec.name for spec in _SPECS if limits_agree(spec.limits, limits))


def limits_agree(
    expected: tuple[float, float, float], found: tuple[float, float, float]
) -> bool:
    """Tell whether two (PMAX, VMAX, TMAX) agree to a tenth of a percent."""
    return all(abs(a - b) <= _AGREEMENT * abs(a) for a, b in zip(expected, found))


MASTER_ID_OFFSET = 0x10
BY_HAND = "hand"
BY_MOTION = "motion"
VERIFIED = ("", BY_HAND, BY_MOTION)
"""How it was seen which joint a motor turns, and which way: not yet, by hand, by a small motion."""


@dataclass(frozen=True)
class DamiaoJoint:
    """Which motor drives a joint, and how it is mounted; see the module's text.

    It listens to ``can_id`` and answers on ``master_id``. ``name`` is the joint's in the model, or
    ""; buses are counted from 0, and ``channel`` names the bus where there are several. The offset
    [rad] is the motor's position where the joint is at zero. A line of a joint map tells no type.
    ``verified`` is one of ``VERIFIED``.
    """

    motor_type: str
    can_id: int
    master_id: int
    name: str = ""
    bus: int = 0
    channel: str = ""
    direction: int = 1
    offset: float = 0.0
    torque_ratio: float = 1.0
    verified: str = ""

    @property
    def address(self) -> Address:
        """Where its motor is."""
        return Address(self.bus, self.can_id)

    @property
    def label(self) -> str:
        """How messages call it."""
        place = f" on {self.channel}" if self.channel else ""
        return f"motor {self.can_id}{place}" + (
            f" (joint {self.name})" if self.name else ""
        )

    @property
    def spec(self) -> MotorSpec:
        """The type's data."""
        return motor_spec(self.motor_type)


def damiao_joints(
    motor_types: Sequence[str],
    n_joints: int,
    can_ids: Sequence[int] | None = None,
    master_ids: Sequence[int] | None = None,
    names: Sequence[str] = (),
) -> tuple[DamiaoJoint, ...]:
    """Return one checked DamiaoJoint per joint, base to terminal.

    CAN ids, 1 to 15, count from 1 by default; master ids, of the replies, are 0x10 higher. Blanks
    in the model's ``names`` become underscores. InputError for a wrong number of types or ids, an
    unknown type, or ids that clash on one bus.
    """
    if not motor_types:
        raise InputError(
            "--export-damiao requires at least one --motor-type: give one per joint, base to "
            f"terminal, out of {', '.join(MOTORS)}"
        )
    types = [motor_spec(name).name for name in motor_types]
    ids = list(range(1, n_joints + 1)) if not can_ids else list(can_ids)
    replies = (
        [i + MASTER_ID_OFFSET for i in ids] if not master_ids else list(master_ids)
    )
    for option, values, how in (
        ("--motor-type", types, ", base to terminal"),
        ("--can-id", ids, " or not at all"),
        ("--master-id", replies, " or not at all"),
    ):
        if len(values) != n_joints:
            times = "once" if len(values) == 1 else f"{len(values)} times"
            raise InputError(
                f"{option} was given {times} but the chain has {n_joints} joints: give it once "
                f"per joint{how}"
            )
    for problem in id_problems([(0, *pair) for pair in zip(ids, replies)]):
        raise InputError(problem)
    called = ["_".join(name.split()) for name in names] or [""] * n_joints
    return tuple(map(DamiaoJoint, types, ids, replies, called))


def id_problems(motors: Sequence[tuple[Any, int, int]]) -> Iterator[str]:
    """Yield a sentence for each way in which motors (bus, CAN id, master id) clash on their buses.

    A motor compares the low eight bits of every frame's id, replies of other motors included, and
    a reply carries only the low four bits of the sender's id.
    """
    for column, name in ((1, "CAN"), (2, "master")):
        used = [(each[0], each[column]) for each in motors]
        for _, i in sorted({place for place in used if used.count(place) > 1}):
            yield f"{name} id {i:#04x} is used by more than one motor; each needs its own"
    for bus, i, master in motors:
        if not 1 <= i <= 15:
            yield f"CAN id {i} is outside 1 to 15, where replies can be told apart"
        if not 0 <= master <= 0x7FE:
            yield f"master id {master:#x} of the motor with CAN id {i} is outside 0 to 0x7fe"
        for place, other, _ in motors:
            if place == bus and other != i and master & 0xFF == other:
                yield (
                    f"replies of the motor with CAN id {i} (master id {master:#x}) would be taken "
                    f"as commands by the motor with CAN id {other}; use {i + MASTER_ID_OFFSET:#x}"
                )


@dataclass(frozen=True)
class JointSpace:
    """How n motors are mounted: (n,) each, the offset in [rad]; see the module's text."""

    direction: Array
    offset: Array
    ratio: Array

    @classmethod
    def of(cls, joints: Sequence[DamiaoJoint]) -> JointSpace:
        """Return how the motors of joints are mounted."""
        rows = [(joint.direction, joint.offset, joint.torque_ratio) for joint in joints]
        return cls(*np.array(rows, dtype=float).reshape(-1, 3).T)

    def to_motors(
        self, position: Array, velocity: Array, torque: Array
    ) -> tuple[Array, ...]:
        """Return what motors are told, or tell, of their joints' (n,) [rad, rad/s, N m]."""
        sign = self.direction
        return (
            sign * position + self.offset,
            sign * velocity,
            sign * torque / self.ratio,
        )

    def to_joints(
        self, position: Array, velocity: Array, torque: Array
    ) -> tuple[Array, ...]:
        """Return what joints do of what their motors are told, or tell (n,) [rad, rad/s, N m]."""
        sign = self.direction
        return (
            sign * (position - self.offset),
            sign * velocity,
            sign * self.ratio * torque,
        )

    def command_to_motors(self, told: MitCommand) -> MitCommand:
        """Return a command for joints as one for motors."""
        p, v, t = self.to_motors(told.position, told.velocity, told.torque)
        return MitCommand(p, v, told.kp / self.ratio, told.kd / self.ratio, t)

    def command_to_joints(self, told: MitCommand) -> MitCommand:
        """Return a command for motors as one for joints."""
        p, v, t = self.to_joints(told.position, told.velocity, told.torque)
        return MitCommand(p, v, told.kp * self.ratio, told.kd * self.ratio, t)

    def joint_position(self, position: Array) -> Array:
        """Return the joint positions (n,) at motor positions (n,) [rad]."""
        return self.to_joints(position, position, position)[0]


_COLUMNS = (
    "joint",
    "bus",
    "can_id",
    "master_id",
    "direction",
    "offset",
    "torque_ratio",
    "verified",
)
_NEEDED = ("joint", "can_id", "direction")


def read_joint_map(path: Path, names: Sequence[str] = ()) -> tuple[DamiaoJoint, ...]:
    """Read a joint map, or raise InputError; one that is about a line names it.

    A motor in one of LeRobot's files, .json, takes the name of the one joint out of a model's
    ``names`` that ends with its own, its signs left out: joint_1 becomes openarm_left_joint1.
    """
    if path.suffix == ".json":
        return _read_lerobot_map(path, names)
    refuse_special_file(path, "give a joint map")
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            lines = [line for line in file if line.strip() and not line.startswith("#")]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path}: {error_text(error)}") from None
    if any("\0" in line for line in lines):
        raise InputError(f"{path} is not text: it has zero bytes")
    table = csv.DictReader(lines, skipinitialspace=True)
    titles = [title.strip() for title in table.fieldnames or ()]
    if not set(_NEEDED) <= set(titles) <= set(_COLUMNS):
        raise InputError(
            f"{path}: expected the columns {', '.join(_COLUMNS)} (at least {', '.join(_NEEDED)})"
        )
    rows = (_row(line, f"{path}, row {k}") for k, line in enumerate(table, start=1))
    return _checked_map(path, tuple(rows))


def _checked_map(path: Path, rows: tuple[DamiaoJoint, ...]) -> tuple[DamiaoJoint, ...]:
    """Return the rows of a joint map, or raise InputError where they cannot share their buses."""
    if not rows:
        raise InputError(f"{path} has no lines")
    names = [row.name for row in rows]
    for name in (name for name in names if names.count(name) > 1):
        raise InputError(f"{path} names {name} twice")
    for problem in id_problems(
        [(row.channel, row.can_id, row.master_id) for row in rows]
    ):
        raise InputError(f"{path}: {problem}")
    return rows


def write_joint_map(path: Path, rows: Iterable[DamiaoJoint]) -> None:
    """Write a joint map."""
    lines = [",".join(_COLUMNS)]
    for row in rows:
        numbers = (
            f"{row.direction:+d},{row.offset:.4f},{row.torque_ratio:g},{row.verified}"
        )
        lines.append(
            f"{row.name},{row.channel},{row.can_id},{row.master_id:#x},{numbers}"
        )
    write_whole(path, "\n".join(lines) + "\n")


def map_joints(
    joints: Sequence[DamiaoJoint],
    rows: Sequence[DamiaoJoint],
    channels: Sequence[str],
    names: Sequence[str] = (),
) -> tuple[DamiaoJoint, ...]:
    """Return the joints of a trajectory, base to terminal, as a map says that they are mounted.

    The map may have more rows only where the model's ``names`` are known. InputError where it does
    not cover the joints, or names a bus that is not among the open ``channels``.
    """
    by_name = {row.name: row for row in rows}
    for name in (name for name in names if name not in by_name):
        raise InputError(
            f"the joint map has no line for {name}; it has {', '.join(by_name)}"
        )
    chosen = [by_name[name] for name in names] if names else rows
    if len(chosen) != len(joints):
        raise InputError(
            f"the joint map has {len(chosen)} joints but the trajectory {len(joints)}: give one "
            "line per joint, base to terminal, or --model to choose them by name"
        )
    # An adapter may have got another name; but never play one arm's motion on the other arm.
    several = len(channels) > 1 or len({row.channel for row in rows}) > 1
    mounted = []
    for joint, row in zip(joints, chosen):
        where = row.channel
        if several and where and where not in channels:
            raise InputError(
                f"the joint map puts {row.name} on {where}; open it with --channel {where}"
            )
        bus = channels.index(where) if where in channels else 0
        channel = channels[bus] if len(channels) > 1 else ""
        mounted.append(
            replace(row, motor_type=joint.motor_type, bus=bus, channel=channel)
        )
    return tuple(mounted)


def _row(line: Mapping[str, str | None], where: str) -> DamiaoJoint:
    cells = {key.strip(): (value or "").strip() for key, value in line.items() if key}
    try:
        can_id = int(cells["can_id"], 0)
        row = DamiaoJoint(
            motor_type="",
            can_id=can_id,
            master_id=int(cells.get("master_id") or str(can_id + MASTER_ID_OFFSET), 0),
            name=cells["joint"],
            channel=cells.get("bus", ""),
            direction=int(cells["direction"]),
            offset=float(cells.get("offset") or 0.0),
            torque_ratio=float(cells.get("torque_ratio") or 1.0),
            verified=cells.get("verified", ""),
        )
    except ValueError:
        raise InputError(
            f"{where}: expected a name and numbers, as in elbow,can0,2,0x12,-1,0,1"
        ) from None
    if row.verified not in VERIFIED:
        raise InputError(
            f"{where}: verified must be {BY_HAND}, {BY_MOTION} or nothing, got {row.verified}"
        )
    if row.direction not in (1, -1):
        raise InputError(f"{where}: direction must be +1 or -1, got {row.direction}")
    if not math.isfinite(row.offset) or not 0.0 < row.torque_ratio < math.inf:
        raise InputError(f"{where}: offset must be a number and torque_ratio positive")
    return row


_SIDES = {f"{side}_arm_config": f"{side}_" for side in ("left", "right")}


def _read_lerobot_map(path: Path, names: Sequence[str]) -> tuple[DamiaoJoint, ...]:
    content = read_json(
        path, "give LeRobot's calibration, or a configuration with motor_config"
    )
    try:
        rows = tuple(_motors_in(content))
    except (TypeError, ValueError, KeyError, AttributeError, IndexError) as error:
        said = f"{type(error).__name__}: {error}"
        raise InputError(
            f"{path} is no calibration or configuration of LeRobot ({said})"
        ) from None
    return _checked_map(
        path, tuple(replace(row, name=_known(row.name, names)) for row in rows)
    )


def _motors_in(content: Mapping[str, Any], prefix: str = "") -> Iterator[DamiaoJoint]:
    parts = {key: part for key, part in content.items() if key in (*_SIDES, "robot")}
    for key, part in parts.items():
        yield from _motors_in(part, _SIDES.get(key, ""))
    if parts:
        return
    if "motor_config" in content:
        for name, (can_id, master_id, *_) in content["motor_config"].items():
            where = (
                "",
                int(can_id),
                int(master_id),
                prefix + name,
                0,
                str(content.get("port", "")),
            )
            yield DamiaoJoint(*where)
        return
    for name, entry in content.items():
        for key in ("drive_mode", "homing_offset"):
            if entry[key] != 0:
                raise ValueError(
                    f"{key} of {name} is {entry[key]}, 0 for Damiao motors"
                )
        yield DamiaoJoint(
            "", int(entry["id"]), int(entry["id"]) + MASTER_ID_OFFSET, name
        )


def _known(name: str, names: Sequence[str]) -> str:
    bare = {each: re.sub(r"[^a-z0-9]", "", each.lower()) for each in (name, *names)}
    found = [each for each in names if bare[each].endswith(bare[name])]
    return found[0] if len(found) == 1 else name
