"""Finding out by hand which motor drives which joint, which way, and where its zero is.

The arm is limp. A person moves one joint after the other the way the model calls positive; the
motor that turned drives it. Then the arm is put into a pose that the model knows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from robot_sysid.damiao.bus.inspection import InspectedMotor
from robot_sysid.damiao.protocol.frames import Address
from robot_sysid.damiao.protocol.joint_map import MappedJoint
from robot_sysid.errors import HardwareAbort, InputError
from robot_sysid.records import Array, RobotModel
from robot_sysid.simulation.stepper import ArmStepper

Positions = Mapping[Address, float]
_MOVED, _CLEARLY = 0.15, 3.0
_TRIES = 3
_PROBE, _SEEN = 0.3, 0.02
_AXES = ("x", "y", "z")
_WAYS = {"+z": " (up)", "-z": " (down)"}


def positive_ways(robot: RobotModel) -> list[str]:
    """Return, per joint, what the model does when it moves the positive way, in words."""
    begin = ArmStepper(robot)
    words = []
    for j in range(robot.n_joints):
        q = robot.reference + _PROBE * (np.arange(robot.n_joints) == j)
        shift = ArmStepper(robot, q).tip() - begin.tip()
        if np.max(np.abs(shift)) > _SEEN:
            words.append(f"the end of the arm moves towards {_way(shift)}")
        else:
            words.append(f"it turns counter-clockwise seen from {_way(begin.axis(j))}")
    return words


def _way(vector: Array) -> str:
    k = int(np.argmax(np.abs(vector)))
    way = f"{'+' if vector[k] > 0.0 else '-'}{_AXES[k]}"
    return way + _WAYS.get(way, "")


def map_by_hand(
    robot: RobotModel,
    motors: Sequence[InspectedMotor],
    positions: Callable[[], Positions],
    ask: Callable[[str], None],
) -> list[MappedJoint]:
    """Return the joint map that a person shows.

    Args:
        robot: the arm.
        motors: those on the bus; all limp.
        positions: reads where each motor is [rad].
        ask: says what to do and returns when it is done.

    Raises:
        HardwareAbort: a movement could not be told from others three times.
    """
    by_address = {motor.address: motor for motor in motors}
    found: list[tuple[str, Address, int]] = []
    for name, way in zip(robot.joint_names, positive_ways(robot)):
        left = set(by_address) - {address for _, address, _ in found}
        found.append((name, *_moved_one(name, way, left, positions, ask)))
    listed = ", ".join(f"{n} {q:.3f}" for n, q in zip(robot.joint_names, robot.reference))
    ask(f"put the arm into the model's own pose ({listed} rad or m) and hold it there")
    here = positions()
    rows = []
    for (name, address, direction), q in zip(found, robot.reference):
        motor = by_address[address]
        offset = round(here[address] - direction * float(q), 4)
        rows.append(
            MappedJoint(name, motor.channel, address.can_id, motor.master_id, direction, offset)
        )
    return rows


def _moved_one(
    name: str,
    way: str,
    left: set[Address],
    positions: Callable[[], Positions],
    ask: Callable[[str], None],
) -> tuple[Address, int]:
    again = ""
    for _ in range(_TRIES):
        before = positions()
        ask(f"{again}move joint {name} alone, by 20 degrees or more, so that {way}")
        after = positions()
        turned = sorted(left, key=lambda each: -abs(after[each] - before[each]))
        way_back = [after[each] - before[each] for each in turned]
        if turned and abs(way_back[0]) > _MOVED:
            if len(turned) == 1 or abs(way_back[0]) > _CLEARLY * abs(way_back[1]):
                return turned[0], 1 if way_back[0] > 0.0 else -1
            again = "several motors turned; "
        else:
            again = "no motor turned far enough; "
    raise HardwareAbort(f"it cannot be told which motor drives {name}; nothing was written")


def require_limp(motors: Sequence[InspectedMotor], n: int) -> None:
    """Raise unless there are motors enough and all of them are off.

    Raises:
        InputError: fewer motors than joints.
        HardwareAbort: one is enabled or does not tell.
    """
    if len(motors) < n:
        raise InputError(f"{len(motors)} motors answer but the model's chain has {n} joints")
    for motor in motors:
        if motor.feedback is None or motor.feedback.status[0] == 1:
            raise HardwareAbort(f"{motor.name} is enabled or does not tell; the arm has to be limp")
