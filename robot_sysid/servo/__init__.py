"""An arm without torque sensors: servos, friction and rotor inertia from commands and positions.

From the log files to the written files. An arm has n joints; a piece is a part of a log without
gaps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import chain, compress
from typing import Optional

import numpy as np
from numpy.typing import NDArray

from robot_sysid.config import IdentifyConfig
from robot_sysid.dynamics.friction import stated_tops
from robot_sysid.errors import ExportError, InputError
from robot_sysid.export import Written, remove_earlier, writable_folder, write_arm_cards
from robot_sysid.logs import FittedLogOptions
from robot_sysid.logs.reader import (
    open_logs,
    origin_of,
    refuse_repeated_logs,
    with_settings,
)
from robot_sysid.records import Array, Motion, Recording, RobotModel, file_access
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.messages import NextStep, Progress
from robot_sysid.results.lines import card_lines, folder_line, load_lines
from robot_sysid.results.record import ModelTarget
from robot_sysid.results.written_model import write_joints
from robot_sysid.servo.command_check import check_commands
from robot_sysid.servo.fit import ServoFit, fit_servos
from robot_sysid.servo.held_out import hold_out
from robot_sysid.servo.loop import goal_error, rms
from robot_sysid.servo.result import ServoIdentification, servo_lines, servo_notes
from robot_sysid.servo.windows import ServoProblem
from robot_sysid.signals.resampling import split_at_gaps
from robot_sysid.simulation.playback import ServoParameters, servos_in_model
from robot_sysid.wording import option_setting

StepAfter = Callable[[ServoIdentification], Optional[NextStep]]
"""Returns what to do after a result that may be used; None for nothing more."""
FINE_STEP = 0.0005
"""Time step in which models are judged [s]."""


def refuse_bends(robot: RobotModel) -> None:
    """Raise InputError where friction of a model bends: other damping beside it would fall."""
    bent = ", ".join(compress(robot.joint_names, stated_tops(robot) > 0.0))
    if bent:
        raise InputError(
            f"{robot.path}: friction of {bent} bends with speed, and servos are identified beside "
            f"straight friction; give {file_access.MODEL_NAMES['mjcf']}, which is written beside it"
        )


def run_servo(
    config: IdentifyConfig,
    robot: RobotModel,
    progress: Progress,
    step_after: StepAfter = lambda result: None,
) -> Written:
    """Identify servos, friction and rotor inertia of an arm whose links are trusted; write results.

    Args:
        config: names the logs, and the folder of the results, in which those of an earlier run are
            removed.
        robot: the arm as in the model file.
        progress: receives stages and notes.
        step_after: says what to do next.

    Raises:
        InputError: the logs cannot be used, or friction of the model bends; nothing is written.
    """
    refuse_bends(robot)
    with writable_folder(config.output.output_dir, progress):
        result, poses = identify_servos(robot, config.log, progress)
        written, notes = write_servos(config, result, poses, step_after)
    progress.note(*notes)
    return written


def write_servos(
    config: IdentifyConfig,
    result: ServoIdentification,
    poses: Motion,
    step_after: StepAfter = lambda result: None,
) -> tuple[Written, tuple[str, ...]]:
    """Write servo.json and the model; return the written files with the lines on them, and notes.

    A model is written only if it plays the held-out data better, or the log options accept it
    anyway.

    Args:
        config: names the folder of the results, in which those of an earlier run are removed.
        result: what was identified.
        poses: (m, n) where the written model is checked.
        step_after: says what to do next.
    """
    robot = result.robot
    folder = config.output.output_dir
    old = rms(result.before)
    new = rms(result.after)
    model = folder / file_access.MODEL_NAMES["mjcf"]
    verdict = (
        f"Usable: {model}; position error {old:.2g} -> {new:.2g} rad over {result.window:.2g} s, "
        f"about {result.expected:.2g} rad on other motions"
    )
    failure = None
    if not result.is_better:
        fault = (
            "on held-out pieces the new model does not predict positions better than what is "
            f"there without it ({new:.3g} rad over {result.window:.2g} s, the model before "
            f"{old:.3g}, the delayed commands {result.goal:.3g})"
        )
        accepting = option_setting("accept", FaultName.ROLLOUT)
        verdict = f"Not usable, but written because of {accepting}: {fault}"
        if FaultName.ROLLOUT not in config.log.accept:
            remedy = f"to write it all the same: {accepting}"
            failure = f"no model was written: {fault}; {remedy}"
    written = []
    with file_access.atomic_files() as files:
        try:
            if failure is None:
                # A URDF holds neither the rotor inertia nor the gains that were judged.
                target = ModelTarget(files, model, poses, config.model.mesh_dir)
                write_joints(robot, tuple(result.changes()), target)
                written.append(model)
                written += write_arm_cards(config, robot, files, written, result)
        except ExportError as error:
            failure = (
                f"{error} (the identified numbers are in {file_access.SERVO_NAME})"
            )
        notes = dict.fromkeys([*result.notes, *servo_notes(result)])
        result = replace(result, notes=tuple(notes))
        written.append(folder / file_access.SERVO_NAME)
        files.write(written[-1], file_access.json_text(result.json_content()))
        removed = remove_earlier(files, config, robot, written)
    lines = (*servo_lines(result), folder_line(folder, is_detail=failure is None))
    last_lines = [verdict, *load_lines(model), *card_lines(written)]
    if failure is not None:
        last_lines = [f"Not usable: {failure}"]
    elif step := step_after(result):
        last_lines += step.lines()
    files_and_lines = Written(tuple(written), lines, tuple(last_lines), failure, result)
    return files_and_lines, (*result.notes, *removed)


def identify_servos(
    robot: RobotModel, logs: FittedLogOptions, progress: Progress
) -> tuple[ServoIdentification, Motion]:
    """Identify servos, friction and rotor inertia; return the result and poses from the logs.

    The poses are a motion (m, n) without velocity; the written model is checked there. Blocks of
    the logs, or the validation log, are held out to judge the numbers. Blocks that were held out
    are fitted with the rest once the numbers were judged.

    Args:
        robot: the arm as in the model file.
        logs: names the logs to fit, and the validation log if there is one.
        progress: receives each stage.
    """
    kind = "commands and positions from"
    options = replace(logs, commanded=True)
    fitted_logs = open_logs(robot, logs.measurements, options, progress, kind)
    tests = open_logs(robot, logs.validation_measurements, options, progress, kind)
    refuse_repeated_logs([*fitted_logs, *tests])
    opened = with_settings([*fitted_logs, *tests], logs.servo_setting)
    fitted_logs, tests = opened[: len(fitted_logs)], opened[len(fitted_logs) :]
    check_commands(opened, robot.joint_names)
    fitted: list[Recording] = [*chain(*map(split_at_gaps, fitted_logs))]
    held_out: list[Recording] = [*chain(*map(split_at_gaps, tests))]
    whole = fitted
    if not tests:
        parts = [hold_out(piece) for piece in fitted]
        fitted = [part for part, _ in parts]
        held_out = [part for _, part in parts]
    fit = fit_servos(robot, fitted, progress)
    first = fitted[0].setting
    problem = ServoProblem(robot, fitted, first, fit.delay)
    test_problem = ServoProblem(robot, held_out, first, fit.delay)
    is_new, before, after, fitted_error = judged(fit, problem, test_problem)
    if not tests:
        # Judged without these blocks, the numbers that are used follow from all of the logs.
        fit = fit_servos(robot, whole, progress, fit)
    result = ServoIdentification(
        robot=robot,
        fit=fit,
        is_new=is_new,
        data=origin_of(fitted_logs, logs.measurements),
        before=before,
        after=after,
        fitted=fitted_error,
        goal=goal_error(held_out),
        window=test_problem.length,
        setting=first,
        notes=tuple(chain(*(log.notes for log in fitted_logs))),
    )
    q = problem.measured[:, 0]
    poses = Motion(np.arange(len(q), dtype=float), q, 0.0 * q, 0.0 * q)
    return result, poses


def judged(
    fit: ServoFit, problem: ServoProblem, test_problem: ServoProblem
) -> tuple[NDArray[np.bool_], Array, Array, Array]:
    """Return which joints' numbers are written, and how a file with them plays held-out windows.

    Joints that do not move, and those that what was found plays clearly worse than the model's
    numbers, keep all of the model's.

    Args:
        fit: what was found.
        problem: windows that were fitted.
        test_problem: windows that were not.

    Returns:
        (n,) whether a joint has new numbers, and (n,) root mean square position errors in held-out
        windows of the model before and of the new one, and in fitted ones of the new one [rad or
        m].
    """
    # Where the model has no servo, its joint's damping is not that of both: what was found stands
    # for gain and damping.
    kept = servos_in_model(problem.robot)
    without = np.isnan(kept.numbers[0])
    kept.numbers[:2, without] = fit.in_file.numbers[:2, without]
    kept = replace(kept, delay=fit.delay)
    is_new = fit.is_known
    while True:
        new = chosen(fit.in_file, kept, is_new)
        before, after, is_worse = test_problem.test(kept, new, FINE_STEP)
        # What was fitted may only become worse where joints move one another otherwise than as
        # measured.
        _, fitted, is_worse_fitted = problem.test(kept, new, FINE_STEP)
        is_kept = is_new & (is_worse | is_worse_fitted)
        if not np.any(is_kept):
            return is_new, before, after, fitted
        is_new = is_new & ~is_kept


def chosen(
    new: ServoParameters, old: ServoParameters, is_new: NDArray[np.bool_]
) -> ServoParameters:
    """Return new parameters of some joints and old ones of the others."""
    return replace(
        new,
        numbers=np.where(is_new, new.numbers, old.numbers),
        limits=np.where(is_new, new.limits, old.limits),
        servo_damping=np.where(is_new, new.servo_damping, old.servo_damping),
        firmness=np.where(is_new, new.firmness, old.firmness),
    )
