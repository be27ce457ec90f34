"""Motor types, which motor drives which joint, whether ids can share a bus, and mountings.

A motor type's scaling limits PMAX [rad], VMAX [rad/s] and TMAX [N m] only define how quantities are
packed into CAN frames; the torque that a motor can deliver is in its ratings. Each motor stores its
limits in registers, where they can be changed. So ``motors.csv`` serves the export and the
comparison with the registers; on a bus the register values are used.

A motor may turn opposite to its joint in the model, and have another zero position than the joint:

    motor position = direction * joint position + offset
    motor velocity = direction * joint velocity
    joint torque   = direction * motor torque

Quantities of motors appear only in this module and in frames; all other code is in joint space.

A joint map is a small CSV file::

    joint,can_id,master_id,direction,offset,verified
    shoulder,1,0x11,+1,0.0,hand
    elbow,2,0x12,-1,0.785,

``verified`` is ``hand`` where somebody turned the joint by hand and saw that this motor turned with
it in this direction, else empty.
"""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from robot_sysid.damiao.protocol import MitCommand
from robot_sysid.errors import InputError
from robot_sysid.records import Array, Limits
from robot_sysid.records.file_access import read_text, write_atomically
from robot_sysid.records.usual_errors import LARGEST_FRICTION, LARGEST_FRICTION_SHARES
from robot_sysid.wording import option_name

RPM = math.tau / 60.0
"""One revolution per minute [rad/s]."""


@dataclass(frozen=True)
class MotorSpec:
    """One motor type, from the maker's data sheets; all quantities are at the output shaft.

    Attributes:
        name: name of the type in trajectory files and options, such as "DM4310".
        limits: scaling limits PMAX [rad], VMAX [rad/s], TMAX [N m] of the factory setting.
        rated_torque: torque that the motor can hold continuously [N m].
        peak_torque: torque that the motor can deliver for a short time [N m].
        no_load_rpm: output speed without load [rev/min]; None where unknown.
    """

    name: str
    limits: tuple[float, float, float]
    rated_torque: float
    peak_torque: float
    no_load_rpm: float | None = None


def _motor_specs() -> Iterator[MotorSpec]:
    """Yield the motor types in the table ``motors.csv``, in its order."""
    path = Path(__file__).with_name("motors.csv")
    with path.open(encoding="utf-8") as file:
        for name, *cells in csv.reader(line for line in file if line[0] != "#"):
            pmax, vmax, tmax, rated, peak, *no_load = map(float, filter(None, cells))
            yield MotorSpec(name, (pmax, vmax, tmax), rated, peak, *no_load)


MOTORS = {spec.name: spec for spec in _motor_specs()}
"""Data of every supported motor type, by its name."""


def motor_spec(name: str) -> MotorSpec:
    """Return the data of the motor type called ``name``; InputError lists the valid names."""
    if name not in MOTORS:
        raise InputError(
            f"unknown Damiao motor type {name!r}; valid types: {', '.join(MOTORS)}"
        )
    return MOTORS[name]


def largest_friction(joints: Sequence[DamiaoJoint]) -> Array:
    """Return the largest friction (n,) that nobody knows of joints with motors of a type [N m]."""
    least, most = np.outer(LARGEST_FRICTION_SHARES, peak_torques(joints))
    return np.clip(LARGEST_FRICTION, least, most)


def peak_torques(joints: Sequence[DamiaoJoint]) -> Array:
    """Return the peak torque (n,) that each joint's motor makes at its joint [N m]."""
    return np.array([joint.spec.peak_torque for joint in joints])


def no_load_speeds(joints: Sequence[DamiaoJoint]) -> Array:
    """Return how fast joints (n,) turn without load [rad/s]; infinite where unknown."""
    return RPM * np.array([joint.spec.no_load_rpm or np.inf for joint in joints])


def matching_types(limits: Sequence[float]) -> tuple[str, ...]:
    """Return the names of all motor types whose factory limits agree with given limits.

    Args:
        limits: PMAX [rad], VMAX [rad/s] and TMAX [N m], as read from a motor's registers.
    """
    return tuple(
        spec.name for spec in MOTORS.values() if limits_agree(spec.limits, limits)
    )


def limits_agree(expected: Sequence[float], actual: Sequence[float]) -> bool:
    """Tell whether scaling limits (PMAX, VMAX, TMAX) agree within 0.1 % of the expected ones."""
    # The closest limits of two types, PMAX of 12.5 and 12.566 rad, differ by five times as much.
    return np.allclose(actual, expected, rtol=1e-3, atol=0.0)


MASTER_ID_OFFSET = 0x10
"""Default difference between a motor's master id (of its replies) and its CAN id."""
MAP_PATH = Path("joint_map.csv")
"""Where a joint map is written unless another file is named."""
BY_HAND = "hand"
"""``DamiaoJoint.verified`` of a joint that somebody turned by hand while its motor was read."""


@dataclass(frozen=True)
class DamiaoJoint:
    """One joint of an arm: the motor that drives it, and how this motor is mounted.

    Attributes:
        motor_type: a name of ``MOTORS``; "" in a row of a joint map, which states no type.
        can_id: CAN id of frames to the motor, 1 to 15.
        master_id: CAN id of frames from the motor.
        name: name of the joint in the model, or "".
        direction: 1, or -1 where the motor turns opposite to the joint.
        offset: position of the motor where the joint is at zero [rad].
        verified: how the mounting was verified: ``BY_HAND``, or "" where it was not.
    """

    motor_type: str
    can_id: int
    master_id: int
    name: str = ""
    direction: int = 1
    offset: float = 0.0
    verified: str = ""

    @property
    def label(self) -> str:
        """Text for messages: "motor", its CAN id, and the name of the joint if not empty."""
        return f"motor {self.can_id}" + (f" (joint {self.name})" if self.name else "")

    @property
    def spec(self) -> MotorSpec:
        """Data of the motor's type; InputError where the type is unknown."""
        return motor_spec(self.motor_type)


def damiao_joints(
    motor_types: Sequence[str], n_joints: int, names: Sequence[str] = ()
) -> tuple[DamiaoJoint, ...]:
    """Return one checked DamiaoJoint per joint, base to terminal, with CAN ids 1, 2, 3, ...

    A joint map states other ids.

    Args:
        motor_types: a name of ``MOTORS`` per joint.
        n_joints: number of joints of the chain.
        names: name of each joint in the model, or nothing.

    Raises:
        InputError: wrong number of types, unknown type, or more motors than a bus has ids for.
    """
    if len(motor_types) != n_joints:
        raise InputError(
            f"{option_name('motor_type')} needs one value per joint of the chain, base to "
            f"terminal: {n_joints}, got {len(motor_types)}"
        )
    names = names or [""] * n_joints
    joints = []
    for i, (motor_type, name) in enumerate(zip(motor_types, names), start=1):
        spec = motor_spec(motor_type)
        joints.append(DamiaoJoint(spec.name, i, i + MASTER_ID_OFFSET, name))
    for problem in id_problems([(joint.can_id, joint.master_id) for joint in joints]):
        raise InputError(problem)
    return tuple(joints)


def id_problems(motors: Sequence[tuple[int, int]]) -> Iterator[str]:
    """Yield a sentence for each CAN or master id that is invalid or clashes with another motor's.

    A motor takes every frame whose low eight id bits are its CAN id, replies of other motors
    included, and a reply carries only the low four bits of the sender's CAN id. ``motors`` are
    the CAN id and the master id of each motor on one bus.
    """
    for ids, name in zip(zip(*motors), ("CAN", "master")):
        for i, n_users in sorted(Counter(ids).items()):
            if n_users > 1:
                yield f"{name} id {i:#04x} is used by more than one motor; each needs its own"
    for i, master in motors:
        if not 1 <= i <= 15:
            yield f"CAN id {i} is outside 1 to 15, where replies can be told apart"
        # 0x7FF is the id of register requests.
        if not 0 <= master <= 0x7FE:
            yield f"master id {master:#x} of the motor with CAN id {i} is outside 0 to 0x7fe"
        for other, _ in motors:
            if other != i and master & 0xFF == other:
                yield (
                    f"replies of the motor with CAN id {i} (master id {master:#x}) would be taken "
                    f"as commands by the motor with CAN id {other}; use {i + MASTER_ID_OFFSET:#x}"
                )


@dataclass(frozen=True)
class Mounting:
    """Mounting of n motors, which converts quantities of their joints to those of the motors.

    Attributes:
        direction: 1, or -1 where the motor turns opposite to its joint (n,).
        offset: position of the motor where its joint is at zero (n,) [rad].
    """

    direction: Array
    offset: Array

    @classmethod
    def of(cls, joints: Sequence[DamiaoJoint]) -> Mounting:
        """Return the mounting of the motors of n joints, in the order of ``joints``."""
        direction = np.array([joint.direction for joint in joints], float)
        return cls(direction, np.array([joint.offset for joint in joints]))

    @cached_property
    def inverse(self) -> Mounting:
        """The conversion from motors to joints, which has the same form."""
        return Mounting(self.direction, -self.direction * self.offset)

    def signals(
        self, position: Array, velocity: Array, torque: Array
    ) -> tuple[Array, ...]:
        """Return motor position, velocity and torque of joint position, velocity and torque.

        All arguments and results are (..., n) [rad, rad/s, N m].
        """
        sign = self.direction
        return sign * position + self.offset, sign * velocity, sign * torque

    def command(self, command: MitCommand) -> MitCommand:
        """Return the command to send to the motors for a command of their joints, fields (n,)."""
        p, v, t = self.signals(command.position, command.velocity, command.torque)
        return command._replace(position=p, velocity=v, torque=t)

    def frame_limits(self, frames: Array) -> Limits:
        """Return what frames with PMAX, VMAX and TMAX (n, 3) [rad, rad/s, N m] can carry."""
        pmax, vmax, tmax = frames.T
        middle = self.inverse.offset
        return Limits(middle - pmax, middle + pmax, vmax, torque=tmax)


# The columns of a joint map file, in their order.
_COLUMNS = ["joint", "can_id", "master_id", "direction", "offset", "verified"]


def read_joint_map(path: Path) -> tuple[DamiaoJoint, ...]:
    """Return the joints in a joint map file, in the order of its rows.

    They have no motor type. InputError where the file is unreadable or incomplete, a row is wrong,
    or names or ids clash.
    """
    table = []
    for line in read_text(path, "give a joint map").splitlines():
        if line.strip() and not line.startswith("#"):
            table.append([cell.strip() for cell in line.split(",")])
    if table[:1] != [_COLUMNS] or len(table) == 1:
        raise InputError(
            f"{path}: expected the columns {', '.join(_COLUMNS)} and a row per joint"
        )
    joints = tuple(
        _parse_row(cells, f"{path}, row {number}")
        for number, cells in enumerate(table[1:], start=1)
    )
    for name, count in Counter(joint.name for joint in joints).items():
        if count > 1:
            raise InputError(f"{path} names {name} twice")
    for problem in id_problems([(joint.can_id, joint.master_id) for joint in joints]):
        raise InputError(f"{path}: {problem}")
    return joints


def write_joint_map(path: Path, rows: Iterable[DamiaoJoint]) -> None:
    """Write joints to a joint map file in the CSV format of this module, one row per joint."""
    lines = [",".join(_COLUMNS)]
    for row in rows:
        lines.append(
            f"{row.name},{row.can_id},{row.master_id:#x},{row.direction:+d},{row.offset:.4f},"
            f"{row.verified}"
        )
    write_atomically(path, "\n".join(lines) + "\n")


def map_joints(
    joints: Sequence[DamiaoJoint], rows: Sequence[DamiaoJoint], names: Sequence[str]
) -> tuple[DamiaoJoint, ...]:
    """Return the joints of a trajectory, base to terminal, with ids and mounting of a joint map.

    Args:
        joints: joints of the trajectory, base to terminal; only their motor types are used.
        rows: joints of the map; without ``names`` one per joint, in the order of ``joints``.
        names: joint names of the model, base to terminal, which select rows of the map by name; or
            nothing.

    Raises:
        InputError: the map does not cover the joints.
    """
    row_by_name = {row.name: row for row in rows}
    for name in names:
        if name not in row_by_name:
            raise InputError(
                f"the joint map has no line for {name}; it has {', '.join(row_by_name)}"
            )
    selected = [row_by_name[name] for name in names] if names else rows
    if len(selected) != len(joints):
        raise InputError(
            f"joints of the joint map: {len(selected)}, of the trajectory: {len(joints)}; give one "
            f"line per joint, base to terminal, or {option_name('model')} to choose them by name"
        )
    return tuple(
        replace(row, motor_type=joint.motor_type)
        for joint, row in zip(joints, selected)
    )


def _parse_row(cells: Sequence[str], where: str) -> DamiaoJoint:
    """Return the joint in one row of a joint map file, checked.

    Args:
        cells: texts of the row's cells.
        where: file and row number, with which the message of an InputError begins.
    """
    try:
        name, can_id, master_id, direction, offset, verified = cells
        # Base 0 reads decimal numbers and such as 0x12.
        ids = int(can_id, base=0), int(master_id, base=0)
        joint = DamiaoJoint("", *ids, name, int(direction), float(offset), verified)
        is_known = joint.verified in ("", BY_HAND) and joint.direction in (1, -1)
        if is_known and math.isfinite(joint.offset):
            return joint
    except ValueError:
        pass
    raise InputError(
        f"{where}: expected a row as elbow,2,0x12,-1,0,{BY_HAND}: name, ids, "
        f"direction +1 or -1, offset, verified {BY_HAND} or nothing"
    )
