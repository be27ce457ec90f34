"""Steps after a command on motors: plan a motion, map the motors, check them, play, identify.

A command that is printed runs as it is printed. So a file is named only where it exists, and a
motion is planned only where a model is known and the registers tell every motor's type.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from robot_sysid.commands import PROGRAM
from robot_sysid.commands.motors.session import USUAL_CHANNEL, Session
from robot_sysid.config import OutputOptions
from robot_sysid.damiao.adapters import BusAddress
from robot_sysid.damiao.bus import InspectedMotor
from robot_sysid.damiao.execution import ArmFiles
from robot_sysid.damiao.joints import MAP_PATH, matching_types, read_joint_map
from robot_sysid.damiao.protocol import BusTiming
from robot_sysid.damiao.settings import Plan
from robot_sysid.damiao.trajectory import read_damiao_trajectory
from robot_sysid.errors import InputError
from robot_sysid.model import ModelOptions
from robot_sysid.pipeline.next_steps import step_after, step_with_motion
from robot_sysid.records import RobotModel
from robot_sysid.records.file_access import DAMIAO_NAME, plan_settings
from robot_sysid.records.messages import NextStep
from robot_sysid.records.option_fields import command_arguments, options_of_all

_PLACES = Path(), Path("planned"), OutputOptions().output_dir
"""Folders in which a planned motion is looked for: this one, that of the command that is printed
for planning, and that in which plans are written by default."""
FIRST_SPEED = 0.3
"""Share of the planned speed at which a motion is played first: someone who watches has the time to
stop the arm."""


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


def step_at_arm(session: Session) -> NextStep:
    """Return the first step with the motors of an arm for which a motion is planned.

    They are mapped to the model's joints, or checked for the motion where a joint map is given or
    lies where ``motors map`` writes it by default.
    """
    options = session.options
    channel = options.address.channel or USUAL_CHANNEL
    joint_map = options.files.joint_map or _written_map(session.robot)
    if joint_map is None and session.robot is not None:
        of_map = options_of_all(BusAddress, BusTiming, ModelOptions)
        of_map += options_of_all(ArmFiles, only=("model",))
        arguments = command_arguments({**options.given, "channel": channel}, of_map)
        sentence = "Next, with the arm connected, find out by hand which motor drives which joint"
        return NextStep(sentence, (PROGRAM, "motors", "map", *arguments))
    changes = dict.fromkeys(("speed", "record", "overwrite"))
    return session.step_to(
        "check",
        "Next, with the arm connected, check its motors",
        joint_map=joint_map,
        channel=channel,
        **changes,
    )


def _written_map(robot: RobotModel | None) -> Path | None:
    """Return the joint map that ``motors map`` has written here for a robot's joints, or None."""
    with contextlib.suppress(InputError):
        named = {joint.name for joint in read_joint_map(MAP_PATH)}
        if robot is not None and named.issuperset(robot.joint_names):
            return MAP_PATH
    return None


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


def play_step(session: Session, plan: Plan) -> NextStep:
    """Return the step that plays a plan's trajectory, slowly unless a speed was given.

    Options that were not given get the usual channel, a low speed and a recording beside the
    trajectory.
    """
    options = {
        "channel": USUAL_CHANNEL,
        "speed": FIRST_SPEED,
        "record": plan.trajectory.path.with_name("slow.csv"),
        **session.options.given,
    }
    sentence = "Next, play it slowly"
    if session.options.address.channel is None:
        sentence += f", on the arm at {USUAL_CHANNEL} (change --channel for another)"
    return session.step_to("play", sentence, **options)


def steps_after_play(session: Session, plan: Plan, is_real: bool) -> list[NextStep]:
    """Return the steps after a trajectory was played: identify from the recording, or play again.

    Behind a simulated arm stands the first step with a real one. A simulated arm of another model
    may have no friction: its torque then looks computed, which ``identify`` has to accept. Of one
    that is exactly as its model nothing is to be found.
    """
    folder = plan.trajectory.path.parent
    planned = plan_settings(folder)
    purpose = planned.get("for_", "")
    record = plan.recording.record
    log = record or folder / "measured.csv"
    is_fast = record is not None and plan.settings.speed >= 1.0
    model = session.options.files.model
    values = {"path": "arm.xml", **planned}
    if model:
        values = {**session.options.given, "path": model}
    results = log.parent if planned and is_real else log.with_suffix("")
    if is_real and not is_fast and purpose != "payload":
        sentence = "Next, play it at full speed and record it, to identify from"
        log = folder / "measured.csv"
        return [session.step_to("play", sentence, speed=None, record=log)]
    if is_real:
        return [step_with_motion("motion recorded", purpose, values, results, log)]
    check = step_at_arm(session)
    plant = session.options.plant.plant_model
    is_model = plant is not None and plant.absolute() == Path(values["path"]).absolute()
    if not is_fast or is_model:
        return [check]
    # From one recording no payload is weighed.
    purpose = purpose.replace("payload", "")
    identify = step_with_motion("motion recorded", purpose, values, results, log)
    sentence = "Next, identify the simulated arm from it, to see what the motion tells"
    words = identify.command
    if not session.simulates_usual_arm:
        words = *words, "--accept", "computed"
    return [NextStep(sentence, words), check]
