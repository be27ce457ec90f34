"""Steps after a command that has seen motors: check a planned motion, plan one, or map the motors.

A command that is printed runs as it is printed. So a file is named only where it exists, and a
motion is planned only where a model is known and the registers tell every motor's type.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from robot_sysid.commands import PROGRAM
from robot_sysid.commands.motors.session import Session
from robot_sysid.config import OutputOptions
from robot_sysid.damiao.adapters import BusAddress
from robot_sysid.damiao.bus import InspectedMotor
from robot_sysid.damiao.execution import ArmFiles
from robot_sysid.damiao.joints import matching_types
from robot_sysid.damiao.protocol import BusTiming
from robot_sysid.damiao.trajectory import read_damiao_trajectory
from robot_sysid.errors import InputError
from robot_sysid.model import ModelOptions
from robot_sysid.pipeline.next_steps import step_after
from robot_sysid.records import RobotModel
from robot_sysid.records.file_access import DAMIAO_NAME
from robot_sysid.records.messages import NextStep
from robot_sysid.records.option_fields import command_arguments, options_of_all

_PLACES = Path(), Path("planned"), OutputOptions().output_dir
"""Folders in which a planned motion is looked for: this one, that of the command that is printed
for planning, and that in which plans are written by default."""


def planned_motion(robot: RobotModel | None) -> Path | None:
    """Return the file of a motion that is planned already, for as many joints as a robot has.

    None where there is none; without a robot any will do.
    """
    for folder in _PLACES:
        path = folder / DAMIAO_NAME
        with contextlib.suppress(InputError):
            trajectory = read_damiao_trajectory(path)
            if robot is None or trajectory.n_joints == robot.n_joints:
                return path
    return None


def plan_step(
    session: Session, motor_types: Iterable[str], joint_map: Path | None = None
) -> NextStep:
    """Return the step that plans a motion for the model's arm with motors of some types (n,).

    It carries the joint map, by default that of the session.
    """
    options = session.options
    values = {**options.given, "path": options.files.model}
    words = ["--for", "arm"]
    for motor_type in motor_types:
        words += ["--motor-type", motor_type]
    joint_map = joint_map or options.files.joint_map
    if joint_map is not None:
        words += ["--joint-map", str(joint_map)]
    return step_after("self-test passed", values, *words, folder=".")


def map_step(session: Session) -> NextStep:
    """Return the step that finds out how the motors are mounted; the session has a model."""
    options = options_of_all(BusAddress, BusTiming, ModelOptions)
    options += options_of_all(ArmFiles, only=("model",))
    arguments = command_arguments(session.options.given, options)
    sentence = "Next, find out by hand which motor drives which joint, and which way"
    return NextStep(sentence, (PROGRAM, "motors", "map", *arguments))


def step_with_motors(
    session: Session,
    robot: RobotModel | None,
    motors: Mapping[int, InspectedMotor],
    can_ids: Sequence[int] = (),
    joint_map: Path | None = None,
) -> NextStep:
    """Return the step after a command that has inspected motors.

    Where a motion is planned, its motors are checked; else one is planned, and where that cannot
    be, the motors are watched.

    Args:
        session: run of the command.
        robot: model of the arm; None without one.
        motors: inspected motors by their CAN ids.
        can_ids: of the motors of the model's joints, base to terminal; 1, 2, 3, ... by default.
        joint_map: file with the joints' mounting, if there is one.
    """
    path = planned_motion(robot)
    if path is not None:
        sentence = "Next, check the motors for the planned motion"
        changes = {"trajectory": path}
        if joint_map is not None:
            changes["joint_map"] = joint_map
        return session.step_to("check", sentence, **changes)
    sentence = "Next, see what they measure"
    if robot is None:
        sentence += (
            "; with --model FILE setup prints the command that plans a motion for them"
        )
    else:
        types = []
        for can_id in can_ids or range(1, robot.n_joints + 1):
            motor = motors.get(can_id)
            types.append(matching_types(motor.limits) if motor else ())
        if all(len(names) == 1 for names in types):
            return plan_step(session, [name for (name,) in types], joint_map)
        sentence += "; to plan a motion, the registers of one motor per joint have to tell its type"
    of_bus = options_of_all(BusAddress, BusTiming)
    arguments = command_arguments(session.options.given, of_bus)
    return NextStep(sentence, (PROGRAM, "motors", "monitor", *arguments))
