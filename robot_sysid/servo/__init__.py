"""An arm without torque sensors: servos, friction and rotor inertia from commands and positions.

From the log files to the written files, and the sentences that are printed about them. An arm has
n joints; a piece is a part of a log without gaps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain, compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.config import IdentifyConfig
from robot_sysid.dynamics.friction import stated_tops
from robot_sysid.errors import ExportError, InputError
from robot_sysid.export import (
    Written,
    remove_earlier,
    writable_folder,
    write_simulator_cards,
)
from robot_sysid.logs import FittedLogOptions
from robot_sysid.logs.reader import open_logs, origin_of, refuse_repeated_logs
from robot_sysid.mjcf.updated_model import ElementChange
from robot_sysid.records import (
    Array,
    DataOrigin,
    Motion,
    Recording,
    RobotModel,
    file_access,
)
from robot_sysid.records.messages import Progress
from robot_sysid.records.quantities import DATA, MODEL, Quantity
from robot_sysid.results.lines import card_lines, folder_text, use_lines
from robot_sysid.results.record import ModelTarget
from robot_sysid.results.table import cells, label, table_lines
from robot_sysid.results.written_model import versions, write_joints
from robot_sysid.servo.fit import (
    LINK_ERROR,
    ServoFit,
    fit_servos,
    goal_error,
    refine_played,
)
from robot_sysid.servo.windows import WINDOW, ServoProblem, check_commands, rms
from robot_sysid.signals.resampling import split_at_gaps
from robot_sysid.simulation.playback import (
    ServoRollouts,
    chain_actuators,
    servos_in_model,
)
from robot_sysid.wording import option_setting

SERVO_SCHEMA = "robot-sysid servo 4"
"""Name and version of the format of servo.json."""
WITHOUT_TORQUE = (
    "No torque was measured: all of this follows from commanded and measured positions, and from "
    "the masses of the model, which fix its scale (the errors include links that are "
    f"off by {100.0 * LINK_ERROR:.0f} %)"
)
UNITS = {
    "gain": "N·m/rad",
    "damping": "N·m·s/rad",
    "frictionloss": "N·m",
    "armature": "kg·m²",
}
"""The identified numbers of a joint, in the order of ``ServoParameters``, and their units."""
STILL = "the joint moves too little or too slowly in these logs: it keeps the model's numbers"
"""Reason of a joint's numbers that nothing shows."""
WORSE = (
    "what was found predicts positions worse than the model's numbers, which all stay"
)
"""Reason of numbers that held-out windows, or fitted ones, speak against."""
NOT_ALONE = (
    "these logs do not show its absolute size, only ratios of the joint's numbers"
)
"""Reason of a number that goes with the joint's others."""
HELD_OUT_SHARE = 0.2
"""Share of each log, its end, that is not fitted where there is no validation log."""


@dataclass(frozen=True)
class ServoIdentification:
    """The result for an arm identified from commands and positions alone.

    Attributes:
        robot: the arm as in the model file.
        fit: the numbers that are written; joints that do not move or that are predicted worse by
            what was found keep all of the model's.
        is_new: (n,) whether the numbers of a joint are not the model's.
        data: the logs.
        before, after: (n,) root mean square position errors of the models before and after, played
            on held-out windows [rad or m].
        goal: error of the commands of some time before, where that fits best [rad or m].
        notes: sentences for the user.
    """

    robot: RobotModel
    fit: ServoFit
    is_new: NDArray[np.bool_]
    data: DataOrigin
    before: Array
    after: Array
    goal: float
    notes: tuple[str, ...]

    @property
    def quantities(self) -> Iterator[Quantity]:
        """Yield the delay of the commands, then each of ``UNITS`` of all joints.

        A gain of a joint without a position actuator has a NaN model.
        """
        fit = self.fit
        yield Quantity("command_delay", "arm", "s", None, fit.delay, fit.delay_error)
        before = servos_in_model(self.robot).numbers
        cases = [~fit.is_known, ~self.is_new, ~fit.is_shown]
        reasons = np.select(cases, [STILL, WORSE, NOT_ALONE], "")
        arrays = before, fit.numbers, fit.errors, reasons
        for (name, unit), *rows in zip(UNITS.items(), *arrays):
            for of, model, value, error, reason in zip(self.robot.joint_names, *rows):
                source = MODEL if reason else DATA
                yield Quantity(name, of, unit, model, value, error, source, reason)

    def changes(self) -> Iterator[ElementChange]:
        """Yield the changes of the model file's joints and of their position actuators.

        Of the damping of joint and servo together, the servo gets its share in the model as its kv,
        the joint the remainder. An actuator's numbers are those at the motor: a gear g makes them
        g^2 times as large at the joint.
        """
        actuators = chain_actuators(self.robot)
        for k in np.flatnonzero(self.is_new):
            numbers = dict(zip(UNITS, self.fit.numbers[:, k]))
            stiffness = numbers.pop("gain")
            kv = actuators.damping_share[k] * numbers["damping"]
            numbers["damping"] -= kv
            yield ElementChange("joint", self.robot.joint_names[k], numbers)
            if np.isfinite(actuators.stiffness[k]):
                squared_gear = actuators.gear[k] ** 2
                gains = {"kp": stiffness / squared_gear}
                if kv:
                    gains["kv"] = kv / squared_gear
                yield ElementChange("actuator", int(actuators.index[k]), gains)

    def json_content(self) -> dict[str, Any]:
        """Return the content of servo.json, which ``json_text`` turns into text."""
        return {
            "schema": SERVO_SCHEMA,
            "torque": WITHOUT_TORQUE,
            "quantities": [*self.quantities],
            "joint_names": self.robot.joint_names,
            "rollout": {"before": self.before, "after": self.after, "goal": self.goal},
            "source": self.data.description,
            "duration": self.data.duration,
            "model": {"path": str(self.robot.path), "sha256": self.robot.sha256},
            "versions": versions(),
            "notes": self.notes,
        }


def servo_lines(result: ServoIdentification) -> Iterator[str]:
    """Yield the printed lines of a result: the table of its numbers, and errors of rollouts."""
    yield "Servos, friction and rotor inertia (prior: the logs do not show a number alone):"
    yield f"  {WITHOUT_TORQUE}."
    rows = file_access.strict_json([*result.quantities])
    yield from table_lines(cells(row, f"{row['of']} {label(row)}") for row in rows)
    yield (
        f"Played on held-out windows of {WINDOW:g} s: root mean square position error "
        f"{rms(result.before):.3g} rad of the model before, {rms(result.after):.3g} of the new "
        f'one, {result.goal:.3g} of "position = command of some time before"'
    )


def servo_notes(result: ServoIdentification) -> Iterator[str]:
    """Yield sentences on the weak points of a result."""
    for row in result.quantities:
        if row.name == "gain" and row.reason:
            yield f"gain of {row.of}: {row.reason}"
    has_servo = np.isfinite(chain_actuators(result.robot).stiffness)
    without = np.array(result.robot.joint_names)[result.is_new & ~has_servo]
    if len(without):
        yield (
            f"the model has no position actuator on {', '.join(without)}: the gain is printed, but "
            "not written"
        )


def refuse_bends(robot: RobotModel) -> None:
    """Raise InputError where friction of a model bends: other damping beside it would fall."""
    bent = ", ".join(compress(robot.joint_names, stated_tops(robot) > 0.0))
    if bent:
        raise InputError(
            f"{robot.path}: friction of {bent} bends with speed, and servos are identified beside "
            f"straight friction; give {file_access.MODEL_NAMES['mjcf']}, which is written beside it"
        )


def run_servo(config: IdentifyConfig, robot: RobotModel, progress: Progress) -> Written:
    """Identify servos, friction and rotor inertia of an arm whose links are trusted; write results.

    A model is written only if it plays the held-out data better, or the log options accept it
    anyway.

    Args:
        config: names the logs, and the folder of the results, in which those of an earlier run are
            removed.
        robot: the arm as in the model file.
        progress: receives stages and notes.

    Raises:
        InputError: the logs cannot be used, or friction of the model bends; nothing is written.
    """
    refuse_bends(robot)
    folder = config.output.output_dir
    with writable_folder(folder, progress), file_access.atomic_files() as files:
        result, poses = identify_servos(robot, config.log, progress)
        old = rms(result.before)
        new = rms(result.after)
        verdict = (
            "Usable: position errors of the model, played on what was not fitted, are "
            f"{new / old:.2g} times those before"
        )
        failure = None
        if new >= min(old, result.goal):
            fault = (
                "on held-out pieces the new model does not predict positions better than what is "
                f"there without it ({new:.3g} rad over {WINDOW:g} s, the model before {old:.3g}, "
                f"the delayed commands {result.goal:.3g})"
            )
            accepting = option_setting("accept", "rollout")
            verdict = f"Not usable, but written because of {accepting}: {fault}"
            if "rollout" not in config.log.accept:
                remedy = f"to write it all the same: {accepting}"
                failure = f"no model was written: {fault}; {remedy}"
        written = []
        notes = [*result.notes, *servo_notes(result)]
        try:
            if failure is None:
                # A URDF holds neither the rotor inertia nor the gains that were judged.
                path = folder / file_access.MODEL_NAMES["mjcf"]
                target = ModelTarget(files, path, poses, config.model.mesh_dir)
                write_joints(robot, tuple(result.changes()), target)
                written.append(path)
                written += write_simulator_cards(config, robot, files, written)
        except ExportError as error:
            failure = (
                f"{error} (the identified numbers are in {file_access.SERVO_NAME})"
            )
        result = replace(result, notes=tuple(dict.fromkeys(notes)))
        written.append(folder / file_access.SERVO_NAME)
        files.write(written[-1], file_access.json_text(result.json_content()))
        removed = remove_earlier(files, config, robot, written)
    progress.note(*result.notes, *removed)
    lines = (*servo_lines(result), f"Results saved to {folder_text(folder)}")
    last_lines = [verdict, *use_lines(written[0]), *card_lines(written)]
    if failure is not None:
        last_lines = [f"Not usable: {failure}"]
    return Written(tuple(written), lines, tuple(last_lines), failure, result)


def identify_servos(
    robot: RobotModel, logs: FittedLogOptions, progress: Progress
) -> tuple[ServoIdentification, Motion]:
    """Identify servos, friction and rotor inertia; return the result and poses from the logs.

    The poses are a motion (m, n) without velocity; the written model is checked there. The
    beginnings of the logs are fitted and their ends, or the validation log, are held out to judge
    the numbers, which are written as they were judged.

    Args:
        robot: the arm as in the model file.
        logs: names the logs to fit, and the validation log if there is one.
        progress: receives each stage.
    """
    kind = "commands and positions from"
    options = replace(logs, commanded=True)
    fitted_logs = open_logs(robot, logs.measurements, options, progress, kind)
    tests = open_logs(robot, logs.validation_measurements, options, progress, kind)
    opened = [*fitted_logs, *tests]
    refuse_repeated_logs(opened)
    check_commands(opened, robot.joint_names)
    fitted: list[Recording] = [*chain(*map(split_at_gaps, fitted_logs))]
    held_out: list[Recording] = [*chain(*map(split_at_gaps, tests))]
    if not tests:
        ends = [round((1.0 - HELD_OUT_SHARE) * len(piece)) for piece in fitted]
        held_out = [piece[end:] for piece, end in zip(fitted, ends)]
        fitted = [piece[:end] for piece, end in zip(fitted, ends)]
    progress.stage("Searching for servos, friction and rotor inertia...")
    rollouts = ServoRollouts(robot)
    problem = ServoProblem(rollouts, fitted)
    test_problem = ServoProblem(rollouts, held_out)
    found = refine_played(problem, fit_servos(robot, fitted))

    # Where the model has no servo, its joint's damping is not that of both: what was found stands
    # for gain and damping.
    kept = servos_in_model(robot).numbers
    without = np.isnan(kept[0])
    kept[:2, without] = found.numbers[:2, without]
    old = replace(found, numbers=kept)
    is_new = found.is_known
    while True:
        fit = replace(found, numbers=np.where(is_new, found.numbers, kept))
        before, after, is_worse = test_problem.test(old, fit)
        # Rollouts of what was fitted may only become worse where the equations miss something.
        *_, is_worse_fitted = problem.test(old, fit)
        is_kept = is_new & (is_worse | is_worse_fitted)
        if not np.any(is_kept):
            break
        is_new = is_new & ~is_kept
    result = ServoIdentification(
        robot=robot,
        fit=fit,
        is_new=is_new,
        data=origin_of(fitted_logs, logs.measurements),
        before=before,
        after=after,
        goal=goal_error(held_out),
        notes=tuple(chain(*(log.notes for log in fitted_logs))),
    )
    q = problem.measured[:, 0]
    poses = Motion(np.arange(len(q), dtype=float), q, 0.0 * q, 0.0 * q)
    return result, poses
