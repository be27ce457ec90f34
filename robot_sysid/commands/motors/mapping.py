"""``robot-sysid motors map``: each joint's motor, direction and zero.

The arm is limp. A person moves one joint after the other in the model's positive direction, or says
that it moved the opposite way; the motor that turned drives it. Then the arm is put into a pose
that the model has, or each joint is pushed to its end stops.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Optional

import numpy as np

from robot_sysid.commands.motors.end_stops import zeros_at_stops
from robot_sysid.commands.motors.following import step_with_motors
from robot_sysid.commands.motors.limp import LimpArm, Positions
from robot_sysid.commands.motors.session import Session, ask
from robot_sysid.damiao import protocol
from robot_sysid.damiao.joints import (
    BY_HAND,
    MAP_PATH,
    DamiaoJoint,
    read_joint_map,
    write_joint_map,
)
from robot_sysid.damiao.joints import map_joints as select_rows
from robot_sysid.errors import HardwareAbort, InputError
from robot_sysid.records import RobotModel
from robot_sysid.records.file_access import claim
from robot_sysid.records.option_fields import OptionRecord, option
from robot_sysid.wording import option_name

SHOWN_TURN = 0.3
"""Turn of a joint whose effect is described to a person [rad]: large enough to be seen."""
LEAST_SEEN = 0.02
"""Displacement of the tip of an arm which a person sees, along an axis of the world [m]."""
LEAST_TURN = 0.15
"""Turn from which on a motor was moved by a person [rad]: half of the 20 degrees asked for."""
MOST_DRAGGED = 3.0
"""How many times farther the motor of a moved joint turns, at least, than one that a limp arm drags
along (a judgement)."""
POSE_TOLERANCE = 0.2
"""How far a joint may have been beyond its range, by a zero from a pose that a person makes by hand
[rad]: each joint was moved by more."""
# Names of the negative and the positive direction of each axis of the world.
_DIRECTIONS = ("-x", "+x"), ("-y", "+y"), ("-z (down)", "+z (up)")


@dataclass(frozen=True)
class MapOptions(OptionRecord):
    """The file that ``motors map`` writes, and where its zeros come from."""

    output: Path = option(MAP_PATH, "where to write the map", "FILE")
    zeros_at_stops: bool = option(
        False,
        "zeros from both end stops of each joint, in place of the model's own pose",
    )
    joint_map: Optional[Path] = option(
        None,
        "with {zeros_at_stops}: begin with this map, and renew its zeros alone",
        "FILE",
    )


def movement_texts(robot: RobotModel) -> Iterator[str]:
    """Yield for each of n joints a sentence on what a person sees when that joint alone turns.

    The joint turns in its positive direction from the model's reference. The sentence has the main
    direction in which the tip of the arm moves, or, where the tip hardly moves, the direction from
    which the joint is seen to turn counter-clockwise.
    """
    # Imported here so that setting up and monitoring do not wait for MuJoCo.
    from robot_sysid.dynamics.inverse_dynamics import data_at_pose

    model = robot.mj_model
    joints = model.dof_jntid[robot.dof_index].tolist()
    reference = robot.reference_qpos
    start = data_at_pose(model, reference)
    # Row j of the matrix turns joint j alone.
    turns = SHOWN_TURN * np.eye(model.nq)[robot.qpos_index]
    for joint, turn in zip(joints, turns):
        turned = data_at_pose(model, reference + turn)
        vector = (turned.xipos - start.xipos)[robot.body_id]
        text = "the end of the arm moves towards"
        if not np.max(np.abs(vector)) > LEAST_SEEN:
            vector = start.xaxis[joint]
            text = "it turns counter-clockwise seen from"
        axis = np.argmax(np.abs(vector))
        yield f"{text} {_DIRECTIONS[axis][int(vector[axis] > 0.0)]}"


def map_joints(session: Session, options: MapOptions) -> int:
    """Write the joint map that a person shows by moving the limp arm; return the exit code 0.

    InputError where the map's file exists already or cannot be written, before the arm is moved;
    other errors are those of ``joints_by_hand``, ``zeros_at_pose`` and ``zeros_at_stops``.
    """
    if options.output.exists():
        raise InputError(f"{options.output} exists; choose another --output")
    rows = _rows_to_renew(options)
    with claim([(option_name("output"), options.output)], session.console.note):
        return _map_and_write(session, options, rows)


def _map_and_write(
    session: Session, options: MapOptions, rows: Sequence[DamiaoJoint]
) -> int:
    """Map the joints of the limp arm, and write their map; return the exit code 0.

    ``rows``: of the map whose zeros are renewed; none for a new map.
    """
    robot = session.robot
    with session.open_guarded(protocol.is_motion) as link:
        arm = LimpArm(link, robot.n_joints)
        if rows:
            unnamed = [DamiaoJoint("", 0, 0)] * robot.n_joints
            mounted = select_rows(unnamed, rows, robot.joint_names)
            arm.require(mounted)
            joints = zeros_at_stops(session, arm, robot, mounted, has_zeros=True)
        else:
            turned = joints_by_hand(arm, robot)
            mounted = tuple(joint for joint, _ in turned)
            if options.zeros_at_stops:
                joints = zeros_at_stops(session, arm, robot, mounted, has_zeros=False)
            else:
                joints = zeros_at_pose(arm, robot, turned)
    # A map may have more joints than the model's chain: those of a gripper, or of another model.
    renewed = {joint.name: joint for joint in joints}
    written = [renewed.get(row.name, row) for row in rows] or joints
    write_joint_map(options.output, written)
    can_ids = [joint.can_id for joint in joints]
    step = step_with_motors(session, robot, arm.motors, can_ids, options.output)
    session.conclude(f"Done: written to {options.output}", step)
    return 0


def _rows_to_renew(options: MapOptions) -> tuple[DamiaoJoint, ...]:
    """Return the rows of the joint map whose zeros are renewed; nothing where there is none.

    InputError where it is not said that zeros come from the stops, or the map cannot be read.
    """
    if options.joint_map is None:
        return ()
    if not options.zeros_at_stops:
        raise InputError(
            f"{option_name('joint_map')} is the map whose zeros are renewed; add "
            f"{option_name('zeros_at_stops')}"
        )
    return read_joint_map(options.joint_map)


def joints_by_hand(arm: LimpArm, robot: RobotModel) -> list[tuple[DamiaoJoint, float]]:
    """Return the joints that a person shows by moving one after the other, base to terminal.

    They have motors and directions, and no zeros yet. Beside each is the position to which its
    motor was turned [rad]. HardwareAbort where in three attempts no single motor turned clearly.

    Args:
        arm: the limp arm.
        robot: model of the arm.
    """
    turned: list[tuple[DamiaoJoint, float]] = []
    for name, movement in zip(robot.joint_names, movement_texts(robot)):
        remaining = arm.motors.keys() - {joint.can_id for joint, _ in turned}
        can_id, direction, end = _find_motor(name, movement, remaining, arm.positions)
        master_id = arm.motors[can_id].master_id
        joint = DamiaoJoint("", can_id, master_id, name, direction, verified=BY_HAND)
        turned.append((joint, end))
    return turned


def zeros_at_pose(
    arm: LimpArm, robot: RobotModel, turned: Sequence[tuple[DamiaoJoint, float]]
) -> list[DamiaoJoint]:
    """Return joints with the zeros that a person shows by putting the arm into the model's pose.

    HardwareAbort where a joint would then have been moved to where its range does not reach.

    Args:
        arm: the limp arm.
        robot: model of the arm with n joints.
        turned: joints (n,), each with the position to which its motor was turned [rad].
    """
    names = robot.joint_names
    pose = ", ".join(f"{name} {q:.3f}" for name, q in zip(names, robot.reference))
    ask(
        f"put the arm into the model's own pose ({pose} rad or m) and hold it there; then press "
        "Enter: "
    )
    positions = arm.positions()
    joints = []
    for j, (joint, end) in enumerate(turned):
        position = positions[joint.can_id]
        offset = round(position - joint.direction * robot.reference[j], 4)
        reached = joint.direction * (end - offset)
        farthest = robot.limits.span[j] + POSE_TOLERANCE
        if abs(reached - robot.limits.center[j]) > farthest:
            raise HardwareAbort(
                f"joint {joint.name} would have been moved to {reached:.2f} rad, which is not in "
                "its range: it went the other way than was said, or the pose is another; nothing "
                "was written, begin again"
            )
        joints.append(replace(joint, offset=offset))
    return joints


def _find_motor(
    name: str,
    movement: str,
    can_ids: Collection[int],
    read_positions: Callable[[], Positions],
) -> tuple[int, int, float]:
    """Have a person move a joint; return the motor that turned: its CAN id, direction, position.

    The direction is 1 where the motor's position grows with the joint's, else -1. The person says
    which way the joint went: at an end of its range it goes one way only.

    Args:
        name: name of the joint.
        movement: positive movement of the joint in words.
        can_ids: CAN ids of the motors that do not belong to another joint.
        read_positions: returns the present positions of all motors [rad].

    Raises:
        HardwareAbort: in three attempts no single motor turned clearly, or it was not said which
            way.
    """
    senses = {"yes": 1, "opposite": -1}
    complaint = ""
    for _ in range(3):
        start = read_positions()
        answer = ask(
            f"{complaint}move joint {name} alone, by 20 degrees or more, so that {movement}, or "
            "the opposite way where it cannot go there; then type yes if it moved so, opposite if "
            "it moved the opposite way: "
        )
        end = read_positions()
        turns = {can_id: end[can_id] - start[can_id] for can_id in can_ids}
        *others, (size, can_id) = sorted((abs(turns[i]), i) for i in turns)
        most_dragged = max((dragged for dragged, _ in others), default=0.0)
        if size <= max(LEAST_TURN, MOST_DRAGGED * most_dragged):
            complaint = "no motor, or several, turned clearly; "
        elif answer in senses:
            direction = senses[answer] * (1 if turns[can_id] > 0.0 else -1)
            return can_id, direction, end[can_id]
        else:
            complaint = "it was not said which way it moved; "
    raise HardwareAbort(
        f"it cannot be told which motor drives {name}; nothing was written"
    )
