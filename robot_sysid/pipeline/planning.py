"""The planning stage: design or check a motion, predict an identification from it, write it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robot_sysid.config import MotionConfig, PlanConfig
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.errors import InputError
from robot_sysid.export import Written
from robot_sysid.motion import SERVOS, WEIGHT
from robot_sysid.pipeline.motions import CheckedPlan
from robot_sysid.pipeline.motors import ArmMotors, arm_motors
from robot_sysid.pipeline.next_steps import step_after, step_with_motion
from robot_sysid.records import MotionPlan, RobotModel
from robot_sysid.records.file_access import (
    DAMIAO_NAME,
    DAMIAO_WEIGHT_NAME,
    GOALS_NAME,
    AtomicFiles,
    atomic_files,
    file_sha256,
)
from robot_sysid.records.levels import INTERVAL
from robot_sysid.records.messages import NextStep, percent
from robot_sysid.records.option_fields import (
    command_arguments,
    given_values,
    options_of_all,
)
from robot_sysid.results.lines import error_lines, subject_text
from robot_sysid.trajectory import motion_chunks
from robot_sysid.wording import option_name

# Poses of a motion in which the slopes of the weight are looked at.
_SLOPE_ROWS = 1000
REVERSAL_SPEED = 0.01
"""Speed over which the feed-forward of dry friction turns its sign [rad/s]: a wider transition is
gentler, but an arm that sticks longer at its reversals shows less."""
LONG = 60.0
"""Duration of a motion that is proposed where a shorter one tells too little of a load [s]."""
LEAST_GAIN = 0.05
"""Least share by which a motion has to lower the error to expect of a file, to be worth playing:
what is promised of a file changes by as much with other made-up motions."""

if TYPE_CHECKING:
    from robot_sysid.expected.recording import Prediction
    from robot_sysid.motion.problem import ExcitationProblem
    from robot_sysid.pipeline.motors import MotionChunk, WeightChunk


def predict_plan(
    config: PlanConfig, checked: CheckedPlan
) -> tuple[Prediction | None, list[str]]:
    """Return the errors to expect of an identification from a checked motion, and printed lines.

    There is no prediction where the motion cannot be processed like a log, or no torques will be
    measured. The lines state limits and expected errors.
    """
    from robot_sysid.expected.recording import predict
    from robot_sysid.motion.plan_lines import limit_lines, motion_lines

    problem = checked.problem
    plan = checked.plan
    check = checked.check
    assert problem is not None and check is not None
    prediction = None
    lines = [*limit_lines(problem, plan, check)]
    rate = config.trajectory.sample_rate
    has_torques = config.aim.purpose != SERVOS
    try:
        if has_torques:
            target = config.aim.target
            prediction = predict(problem, plan, rate, config.estimation, target)
            lines += error_lines(prediction)
    except InputError as error:
        lines.append(f"What errors it will leave cannot be predicted: {error}")
    lines += motion_lines(problem, plan, check)
    return prediction, lines


def write_plan(
    config: PlanConfig,
    robot: RobotModel,
    checked: CheckedPlan,
    prediction: Prediction | None,
    lines: Sequence[str],
) -> Written:
    """Write a planned motion, unless it breaks a limit, and return what was written.

    Args:
        config: names the files, and says what the motion is for.
        robot: the arm.
        checked: the motion with its limit check.
        prediction, lines: what to expect of the motion, and lines on it, see ``predict_plan``.
    """
    failure = checked.failure
    shortfall = purpose_shortfall(config, prediction)
    paths: tuple[Path, ...] = ()
    step = None
    if failure:
        failure = f"{failure}; nothing was written"
        verdict = [f"Not usable: {failure}"]
    else:
        with atomic_files() as files:
            paths = draft_plan(config, robot, checked, files)
            motor_paths, clamping = draft_motor_file(
                config, robot, checked.plan, files, config.output.output_dir
            )
        paths += motor_paths
        lines = [*lines, *clamping]
        conditions = plan_conditions(checked.problem, checked.contact_at_start())
        verdict = [plan_verdict(shortfall, conditions)]
        if not shortfall:
            step = _step_after(config, arm_motors(config.motors, robot))
        elif prediction is not None:
            step = _step_to_longer_motion(config, prediction)
        verdict += step.lines() if step else ()
    answer = {
        "verdict": verdict,
        "next_step": step,
        "failure": failure,
        "prediction": lines,
        "elsewhere": elsewhere_answer(prediction),
        "files": list(map(str, paths)),
    }
    if paths:
        lines = [*lines, f"Trajectory saved to {', '.join(map(str, paths))}"]
    return Written(paths, lines, verdict, failure, answer)


def elsewhere_answer(prediction: Prediction | None) -> dict[str, Any] | None:
    """Return what the written file is expected to be on motions all over the arm's range.

    That is the highest speed of these motions, relative errors of the file, of an arm with much
    friction (``after``) and of one with little (``least``), and of its friction, and the error of
    the mass of a load [kg]; null where one is not determined. None where nothing is
    expected of a file. The error of the model before is what models usually have, whatever the arm.
    """
    if prediction is None or prediction.file is None:
        return None
    file = prediction.file
    load = float(prediction.errors[0])
    return {
        "speed": file.speed,
        "speed_unit": file.speed_unit,
        "after": file.after,
        "least": file.least,
        "friction": file.friction,
        "load": load if np.isfinite(load) else None,
    }


def plan_verdict(shortfall: str, conditions: Sequence[str]) -> str:
    """Return one line: whether to play a motion that keeps all limits.

    Args:
        shortfall: why the motion does not serve its purpose; "" where it does.
        conditions: what has to be done before it is played, each with its reason.
    """
    if shortfall:
        return f"Not ready: {shortfall}"
    if conditions:
        return f"Usable once {', and once '.join(conditions)}"
    return "Usable: play it on the arm, slowly at first, then record it as planned"


def plan_conditions(
    problem: ExcitationProblem | None, contact: str | None
) -> list[str]:
    """Return what has to be done before a motion is played, each with its reason.

    Args:
        problem: the arm and the limits that the motion has to keep; None where nothing plays it.
        contact: what is in the way to its start, see ``CheckedPlan.contact_at_start``.
    """
    if problem is None:
        return []
    conditions = []
    if contact is not None:
        conditions.append(
            "the arm has been brought to the start of this motion another way: the straight way "
            f"from the model's pose at rest is not free, by the clearance of {contact}"
        )
    n_unguarded = len(problem.unguarded)
    if n_unguarded:
        remedy = "watch it in a viewer that shows them"
        if problem.robot.lacks_meshes:
            meshes = f"{option_name('mesh_dir', 'FOLDER')}, the folder of its meshes (STL or OBJ)"
            remedy = f"plan again with {meshes}, or {remedy}"
        conditions.append(
            f"contacts have been checked: without collision geometry, {n_unguarded} of "
            f"{problem.n_joints} moving links may touch anything; {remedy}"
        )
    return conditions


def _step_after(config: PlanConfig, motors: ArmMotors | None) -> NextStep:
    """Return what to do with a planned motion: rehearse it on motors, or record and identify.

    ``motors``: that the motion is written for, or None.
    """
    values = vars(config.model)
    if motors is not None:
        given = given_values(config.limits)
        options = options_of_all(config.limits, only=motors.kept_options)
        arguments = command_arguments(given, options)
        mounting = options_of_all(config.motors, only=("joint_map",))
        arguments += command_arguments(vars(config.motors), mounting)
        folder = config.output.output_dir
        words = {"folder": folder, "trajectory": folder / DAMIAO_NAME}
        return step_after("motion planned for motors", values, *arguments, **words)
    folder = config.plan_file.parent
    log = folder / "log.csv"
    if config.aim.purpose == SERVOS:
        return step_after("motion planned for servos", values, folder=folder, log=log)
    return step_with_motion("motion planned", config.aim.purpose, values, folder, log)


def _step_to_longer_motion(
    config: PlanConfig, prediction: Prediction
) -> NextStep | None:
    """Return the longer motion that shows the load that is to be weighed, or None if none does.

    Noise falls with the root of the duration, and nothing else does.
    """
    trajectory = config.trajectory
    is_designed = trajectory.file is None and trajectory.duration < LONG
    if prediction.file is not None or not is_designed:
        return None
    share = prediction.relative_mass_error_after(LONG / trajectory.duration)
    if INTERVAL * share >= 1.0:
        return None
    given: dict[str, Any] = {"duration": LONG}
    stated = {name: o for name, o in config.options().items() if name != "model"}
    for name in stated:
        given = {**given_values(getattr(config, name)), **given}
    options = command_arguments(given, chain(*stated.values()))
    values = vars(config.model)
    return step_after(
        "load not seen", values, plan_options=options, share=percent(share)
    )


def purpose_shortfall(config: PlanConfig, prediction: Prediction | None) -> str:
    """Return why nothing gets better by a motion, the written file or a weighing; "" if it does.

    Args:
        config: the settings with which the motion was planned.
        prediction: errors to expect of an identification from it; None where they cannot be
            predicted.
    """
    if config.aim.purpose in (WEIGHT, SERVOS):
        return ""
    if prediction is None:
        return "the errors that it will leave cannot be predicted"
    if prediction.file is None:
        return _weighing_shortfall(prediction)
    file = prediction.file
    if file.after > (1.0 - LEAST_GAIN) * file.before:
        return (
            "after this motion the written file is expected to be no better than the model, "
            f"{percent(file.after)} off on any motion: use the model, or plan a longer motion"
        )
    return ""


def _weighing_shortfall(prediction: Prediction) -> str:
    """Return why a motion tells nothing of the load that it is to weigh; "" where it does."""
    mass = f"the mass of {subject_text(prediction)}"
    share = prediction.relative_mass_error
    if np.isinf(share):
        # Where no motion determines the mass by these torques, the lines on the plan say so.
        is_said = bool(prediction.invisible)
        return "" if is_said else f"this motion does not determine {mass}"
    if INTERVAL * share >= 1.0:
        least = INTERVAL * float(prediction.errors[0])
        return (
            f"after this motion {mass} is known to {percent(share)} only; it shows loads from "
            f"{least:.2g} kg on: weigh a lighter one on scales"
        )
    return ""


def draft_plan(
    config: MotionConfig, robot: RobotModel, checked: CheckedPlan, files: AtomicFiles
) -> tuple[Path, ...]:
    """Draft a trajectory, beside it a table of its samples and, of a motion for servos, one of
    their goals, among files that appear together.

    Args:
        config: names the trajectory's file, if there is one, and the rates of the tables.
        robot: the arm that the motion was planned for.
        checked: the motion; the trajectory is its path without stops.
        files: which receive the drafts.

    Returns:
        The paths that they will have; empty where the options name no file.
    """
    path = config.plan_file
    if path is None:
        return ()
    from robot_sysid.motion.goals import save_goals
    from robot_sysid.motion.trajectories import save_samples, save_trajectory

    samples_path = path.with_suffix(".csv")
    paths = [path, samples_path]
    with files.open(path) as file:
        save_trajectory(file, checked.path, robot.joint_names, robot.sha256)
    with files.open(samples_path) as file:
        rate = config.trajectory.sample_rate
        save_samples(file, checked.path, robot.joint_names, rate)
    if config.aim.purpose == SERVOS:
        paths.append(path.with_name(GOALS_NAME))
        with files.open(paths[-1]) as file:
            save_goals(file, checked.plan, robot, config.aim.goal_rate)
    return tuple(paths)


def draft_motor_file(
    config: MotionConfig,
    robot: RobotModel,
    plan: MotionPlan,
    files: AtomicFiles,
    folder: Path,
) -> tuple[tuple[Path, ...], list[str]]:
    """Draft a motion for motors, if an option asks for it, among files in a folder.

    Beside it stands the torque that carries and accelerates the arm, without which motors that play
    the motion slower would be fed the torque of its full speed.

    Returns:
        The paths of both, the motion first, and lines on what was clamped of the commands.
    """
    motors = arm_motors(config.motors, robot)
    if motors is None:
        return (), []
    path = folder / DAMIAO_NAME
    weight_path = folder / DAMIAO_WEIGHT_NAME
    rate = config.trajectory.sample_rate
    with files.open(path) as file:
        lines = motors.write(motor_commands(robot, plan, rate), file)
    # The motion is computed a second time: its hash is known when its file is complete, and a long
    # motion is not kept in memory.
    sha256 = file_sha256(files.draft_of(path))
    with files.open(weight_path) as file:
        time = np.linspace(0.0, plan.duration, _SLOPE_ROWS)
        slope = ArmDynamics(robot).weight_slopes(plan.evaluate(time).q)
        motors.write_weight(weights_of_motion(robot, plan, rate), slope, sha256, file)
    return (path, weight_path), lines


def motor_commands(
    robot: RobotModel, plan: MotionPlan, rate: float
) -> Iterator[MotionChunk]:
    """Yield stretches of a motion, sampled at a rate [Hz], as motors are commanded.

    Each is (time (N,) [s], positions (N, n) [rad or m], speeds (N, n), feed-forward torques (N, n)
    [N m or N]).

    The step of dry friction at a reversal would be a blow to the arm, so it is made smooth:
    coulomb tanh(qd / ``REVERSAL_SPEED``) in place of coulomb sign(qd).
    """
    torque = ArmDynamics(robot)
    for motion in motion_chunks(plan, rate):
        smooth = robot.friction.dry(motion.qd, lambda qd: np.tanh(qd / REVERSAL_SPEED))
        tau = torque(motion) + smooth - robot.friction.dry(motion.qd)
        yield motion.time, motion.q, motion.qd, tau


def weights_of_motion(
    robot: RobotModel, plan: MotionPlan, rate: float
) -> Iterator[WeightChunk]:
    """Yield stretches of what carries and accelerates an arm in a motion, sampled at a rate [Hz].

    Each is (time (N,) [s], and two torques (N, n) as ``ArmDynamics.weight_and_inertia`` returns
    them [N m or N]).
    """
    arm = ArmDynamics(robot)
    for motion in motion_chunks(plan, rate):
        weight, inertia = arm.weight_and_inertia(motion)
        yield motion.time, weight, inertia
