"""``robot-sysid motors map``: each joint's motor, direction and zero.

The arm is limp. A person moves one joint after the other in the model's positive direction, or says
that it moved the opposite way; the motor that turned drives it. Then the arm is put into a pose
that the model has.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robot_sysid.commands.motors.session import Session, ask
from robot_sysid.damiao import protocol
from robot_sysid.damiao.bus import GuardedLink, RegisterClient, inspect_bus
from robot_sysid.damiao.joints import BY_HAND, DamiaoJoint, write_joint_map
from robot_sysid.errors import HardwareAbort, InputError
from robot_sysid.records import RobotModel
from robot_sysid.records.file_access import DAMIAO_NAME, require_writable
from robot_sysid.records.messages import count_text
from robot_sysid.records.option_fields import OptionRecord, option, record_from

Positions = Mapping[int, float]
"""Position of each motor [rad], by its CAN id."""
# Names of the negative and the positive direction of each axis of the world.
_DIRECTIONS = ("-x", "+x"), ("-y", "+y"), ("-z (down)", "+z (up)")


@dataclass(frozen=True)
class MapOptions(OptionRecord):
    """File that ``motors map`` writes."""

    output: Path = option(Path("joint_map.csv"), "where to write the map", "FILE")


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
    # Row j of the matrix turns joint j alone, by 0.3 rad.
    for joint, turn in zip(joints, 0.3 * np.eye(model.nq)[robot.qpos_index]):
        turned = data_at_pose(model, reference + turn)
        vector = (turned.xipos - start.xipos)[robot.body_id]
        text = "the end of the arm moves towards"
        # A person sees a tip that moves by more than 2 cm.
        if not np.max(np.abs(vector)) > 0.02:
            vector = start.xaxis[joint]
            text = "it turns counter-clockwise seen from"
        axis = np.argmax(np.abs(vector))
        yield f"{text} {_DIRECTIONS[axis][int(vector[axis] > 0.0)]}"


def map_joints(session: Session) -> int:
    """Write the joint map that a person shows by moving the limp arm; return the exit code 0.

    InputError where the map's file exists already or cannot be written, before the arm is moved;
    other errors are those of ``map_by_hand``.
    """
    options = record_from(MapOptions, session.values)
    robot = session.robot
    if options.output.exists():
        raise InputError(f"{options.output} exists; choose another --output")
    require_writable(options.output.parent)
    with session.open_guarded(protocol.is_motion) as link:
        write_joint_map(options.output, map_by_hand(link, robot))
    sentence = "Next, check the motors with it"
    changes = {"trajectory": DAMIAO_NAME, "joint_map": options.output}
    step = session.step_to("check", sentence, **changes)
    session.conclude(f"Done: written to {options.output}", step)
    return 0


def map_by_hand(link: GuardedLink, robot: RobotModel) -> Iterator[DamiaoJoint]:
    """Yield the rows of the joint map that a person shows by moving one joint after the other.

    There is one per joint of the robot, base to terminal, without motor types.

    Args:
        link: link of the motors' bus.
        robot: model of the arm.

    Raises:
        InputError: there are fewer motors than joints, or standard input has ended.
        HardwareAbort: a motor is enabled or does not answer, in three attempts no single motor
            turned clearly, or a joint was moved to where its range does not reach.
    """
    client = RegisterClient(link)
    motors = inspect_bus(link).motors
    if len(motors) < robot.n_joints:
        raise InputError(
            f"motors that answer: {len(motors)}, but the model's chain has "
            f"{count_text(robot.n_joints, 'joint')}"
        )
    for motor in motors.values():
        if motor.feedback is None or motor.feedback.status[0] == protocol.ENABLED:
            raise HardwareAbort(
                f"{motor.name} is enabled or does not tell; the arm has to be limp"
            )

    def read_positions() -> Positions:
        """Return the present position of each motor [rad]; HardwareAbort where one is silent."""
        positions = {}
        for can_id, motor in motors.items():
            state = client.state_of(motor)
            if state is None:
                raise HardwareAbort(
                    "a motor does not answer any more; nothing was written"
                )
            positions[can_id] = state.position[0]
        return positions

    # CAN id, direction and last position of each joint's motor.
    found: list[tuple[int, int, float]] = []
    names = robot.joint_names
    for name, movement in zip(names, movement_texts(robot)):
        remaining = motors.keys() - {can_id for can_id, *_ in found}
        found.append(_find_motor(name, movement, remaining, read_positions))
    pose = ", ".join(f"{name} {q:.3f}" for name, q in zip(names, robot.reference))
    ask(
        f"put the arm into the model's own pose ({pose} rad or m) and hold it there; then press "
        "Enter: "
    )
    positions = read_positions()
    for j, (can_id, direction, end) in enumerate(found):
        offset = round(positions[can_id] - direction * robot.reference[j], 4)
        reached = direction * (end - offset)
        # A pose is made by hand to some tenth of a radian; each joint was moved by more.
        if abs(reached - robot.limits.center[j]) > robot.limits.span[j] + 0.2:
            raise HardwareAbort(
                f"joint {names[j]} would have been moved to {reached:.2f} rad, which is not in its "
                "range: it went the other way than was said, or the pose is another; nothing was "
                "written, begin again"
            )
        master_id = motors[can_id].master_id
        yield DamiaoJoint("", can_id, master_id, names[j], direction, offset, BY_HAND)


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
        # Half of the 20 degrees asked for, and thrice what a limp arm drags along (judgements).
        if size <= max([0.15, *(3.0 * dragged for dragged, _ in others)]):
            complaint = "no motor, or several, turned clearly; "
        elif answer in senses:
            direction = senses[answer] * (1 if turns[can_id] > 0.0 else -1)
            return can_id, direction, end[can_id]
        else:
            complaint = "it was not said which way it moved; "
    raise HardwareAbort(
        f"it cannot be told which motor drives {name}; nothing was written"
    )
