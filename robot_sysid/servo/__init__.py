"""An arm without torque sensors: servos, friction and rotor inertia from commands and positions.

From the log files to the written files, and the sentences that are printed about them. An arm has
n joints; a piece is a part of a log without gaps.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import ExportError
from robot_sysid.export import Written, remove_earlier, writable_folder
from robot_sysid.logs import FittedLogOptions
from robot_sysid.logs.reader import (
    MeasurementLog,
    open_log,
    origin_of,
    refuse_fitted_log,
    refuse_repeated_logs,
)
from robot_sysid.mjcf.documents import read_document
from robot_sysid.mjcf.updated_model import ActuatorChange, JointChange
from robot_sysid.records import Array, DataOrigin, Motion, RobotModel, file_access
from robot_sysid.records.messages import Progress, with_error
from robot_sysid.results.next_steps import use_lines
from robot_sysid.results.prediction import LAST_FIFTH
from robot_sysid.results.record import (
    ModelTarget,
    RolloutTest,
    json_text,
    rollout_entry,
)
from robot_sysid.results.result_lines import folder_text, rollout_lines
from robot_sysid.results.written_model import versions, write_joints
from robot_sysid.servo.commands import commanded_pieces
from robot_sysid.servo.fit import (
    LARGEST_ERROR,
    LINK_ERROR,
    OWN_GAIN,
    ServoFit,
    fit_servos,
    loop_equations,
    refine_played,
)
from robot_sysid.servo.windows import (
    make_problem,
    play_servos,
    rollout_error,
    servo_fault,
    split_pieces,
)
from robot_sysid.simulation.playback import (
    ServoRollouts,
    chain_actuators,
    servos_in_model,
)

SERVO_SCHEMA = "robot-sysid servo 2"
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
IDENTIFIED = "identified"
FROM_MODEL = "from_model"
ASSUMED = "assumed"
_DOUBTS = {
    FROM_MODEL: " (kept: the model's)",
    ASSUMED: " (not determined alone: goes with the joint's other numbers)",
}
"""What follows a number in the printed lines, by its source, unless it is identified."""
OFTEN_LIMITED = 0.2
"""Share of time at its limit from which on a servo is mentioned."""
_POSES = 200
"""Number of poses of the logs in which a written model is checked."""
_FITTED_WINDOWS = 24
"""Largest number of windows of a fast servo that are played."""
_WINDOW = 3.0
"""Length of such a window [s]."""
_SETTLING_TIME = 0.6
"""Its beginning, in which errors do not count: the start state is uncertain [s]."""


@dataclass(frozen=True)
class ServoIdentification:
    """The result for an arm identified from commands and positions alone.

    Attributes:
        robot: the arm as in the model file.
        fit: the numbers that are written; joints that do not move or that are predicted worse by
            what was found keep all of the model's.
        is_new: (n,) whether the numbers of a joint are not the model's.
        limit_share: (n,) share of time in which a servo needs more than its torque limit.
        data: the logs.
        rollout: the models before and after, played on held-out pieces.
        goal_delay, goal_errors: prediction of the same pieces by the commands of this time before
            [s], and its errors, one per horizon of the rollouts [rad].
        notes: sentences for the user.
    """

    robot: RobotModel
    fit: ServoFit
    is_new: NDArray[np.bool_]
    limit_share: Array
    data: DataOrigin
    rollout: RolloutTest
    goal_delay: float
    goal_errors: tuple[float, ...]
    notes: tuple[str, ...] = ()

    @property
    def joint_numbers(self) -> dict[str, dict[str, dict[str, Any]]]:
        """Each joint's numbers: by the joint's name, then by a key of ``UNITS``.

        A number is a dict of "before" (NaN where the model has none), "value", "standard_error",
        "source" (``IDENTIFIED``, ``FROM_MODEL`` or ``ASSUMED``) and "unit".
        """
        before = servos_in_model(self.robot).numbers
        value = self.fit.numbers
        error = self.fit.errors
        is_shown = self.fit.has_scale & (error < LARGEST_ERROR * value)
        found = np.where(is_shown, IDENTIFIED, ASSUMED)
        source = np.where(self.is_new, found, FROM_MODEL)
        joints = {}
        for k, joint in enumerate(self.robot.joint_names):
            joints[joint] = {
                name: {
                    "before": float(before[row, k]),
                    "value": float(value[row, k]),
                    "standard_error": float(error[row, k]),
                    "source": str(source[row, k]),
                    "unit": unit,
                }
                for row, (name, unit) in enumerate(UNITS.items())
            }
        return joints

    def changes(self) -> tuple[list[JointChange], list[ActuatorChange]]:
        """Return the changes of the model file's joints and of their position actuators.

        Of the damping of joint and servo together, the servo gets its share in the model as its kv,
        the joint the remainder. An actuator's numbers are those at the motor: a gear g makes them
        g^2 times as large at the joint.
        """
        actuators = chain_actuators(self.robot)
        joint_changes = []
        actuator_changes = []
        for k in np.flatnonzero(self.is_new).tolist():
            numbers = dict(zip(UNITS, self.fit.numbers[:, k]))
            stiffness = numbers.pop("gain")
            kv = actuators.damping_share[k] * numbers["damping"]
            numbers["damping"] -= kv
            joint_changes.append(JointChange(self.robot.joint_names[k], numbers))
            if np.isfinite(actuators.stiffness[k]):
                squared_gear = actuators.gear[k] ** 2
                motor_kv = kv / squared_gear if kv > 0.0 else None
                gains = stiffness / squared_gear, motor_kv
                actuator_changes.append(ActuatorChange(actuators.index[k], *gains))
        return joint_changes, actuator_changes

    def json_content(self) -> dict[str, Any]:
        """Return the content of servo.json, which ``json_text`` turns into text.

        It holds each joint's numbers with units, the delay, the comparison of the models before and
        after, and where all of it comes from.
        """
        has_servo = np.isfinite(chain_actuators(self.robot).stiffness)
        joints: dict[str, dict[str, Any]] = self.joint_numbers
        for numbers, *others in zip(
            joints.values(), self.is_new, has_servo, self.limit_share
        ):
            numbers.update(zip(("is_new", "has_servo", "at_limit"), others))
        return {
            "schema": SERVO_SCHEMA,
            "torque": "none measured; from position error",
            "meaning": WITHOUT_TORQUE,
            "delay": {"value": self.fit.delay, "standard_error": self.fit.delay_error},
            "joints": joints,
            "rollout": rollout_entry(self.rollout),
            "goal_prediction": {"delay": self.goal_delay, "errors": self.goal_errors},
            "source": self.data.description,
            "duration": self.data.duration,
            "model": {"path": str(self.robot.path), "sha256": self.robot.sha256},
            "versions": versions(),
            "notes": self.notes,
        }


def servo_lines(result: ServoIdentification) -> list[str]:
    """Return the printed lines of a result: delay, each joint's numbers, errors of rollouts."""
    fit = result.fit
    lines = [
        "Servos, friction and rotor inertia, before -> after, ± one standard error:",
        f"  {WITHOUT_TORQUE}.",
        f"  delay of the commands: {with_error(1e3 * fit.delay, 1e3 * fit.delay_error, 'ms')}",
    ]
    for joint, numbers in result.joint_numbers.items():
        texts = []
        for name, number in numbers.items():
            is_new = number["source"] != FROM_MODEL and np.isfinite(number["before"])
            old = f"{number['before']:.3g} -> " if is_new else ""
            new = with_error(number["value"], number["standard_error"], number["unit"])
            texts.append(f"{name} {old}{new}{_DOUBTS.get(number['source'], '')}")
        lines.append(f"  {joint}: {'; '.join(texts)}")
    lines += rollout_lines(result.rollout)
    errors = ", ".join(f"{error:.3g}" for error in result.goal_errors)
    lines.append(
        f'  "position = command of {1e3 * result.goal_delay:.0f} ms before": {errors}'
    )
    return lines


def servo_notes(result: ServoIdentification) -> Iterator[str]:
    """Yield sentences on the weak points of a result."""
    actuators = chain_actuators(result.robot)
    fit = result.fit
    for k, joint in enumerate(result.robot.joint_names):
        gain = fit.numbers[0, k]
        if not fit.is_known[k]:
            yield (
                f"{joint} moves too little or too slowly in these logs: it keeps the model's "
                "numbers"
            )
        elif not result.is_new[k]:
            yield (
                f"the numbers found of {joint} predict held-out positions worse than the model's, "
                "which stay, all of them"
            )
        elif not fit.has_scale[k]:
            yield (
                f"the links' torque on {joint} is too small to show the absolute size of its "
                f"numbers, only their ratios: its gain of {gain:.3g} N·m/rad is assumed to be like "
                "those of the other joints, and the others are right in proportion to it"
            )
        elif abs(np.log(fit.gain_ratio[k])) > 2.0 * OWN_GAIN:
            yield (
                f"the gain of {joint} is {fit.gain_ratio[k]:.2g} times what those of the other "
                "joints lead to expect; check that servo's settings, and the masses of the links"
            )
        if fit.is_known[k] and not np.isfinite(actuators.stiffness[k]):
            yield (
                f"the model has no position actuator on {joint}: the gain of {gain:.3g} N·m/rad is "
                "printed, but not written"
            )
        if result.limit_share[k] > OFTEN_LIMITED:
            yield (
                f"the servo of {joint} asks for more than its limit of {actuators.limit[k]:.3g} "
                f"N·m (the model's) in {100.0 * result.limit_share[k]:.0f} % of the time: what is "
                "found rests on that limit"
            )


def run_servo(
    robot: RobotModel,
    logs: FittedLogOptions,
    folder: Path,
    mesh_dir: Path | None,
    progress: Progress,
    input_files: Sequence[Path | None] = (),
) -> Written:
    """Identify servos, friction and rotor inertia of an arm whose links are trusted; write results.

    A model is written only if it plays the held-out data better, or
    the log options accept it anyway.

    Args:
        robot: the arm as in the model file.
        logs: names the logs to fit, and the validation log.
        folder: for the results; those of an earlier run in it are removed.
        mesh_dir: folder of the model's meshes; None where the file says.
        input_files: files that the run reads, which are never removed.

    Raises:
        InputError: the logs cannot be used; nothing is written then.
    """
    with writable_folder(folder, progress), file_access.atomic_files() as files:
        result, poses = identify_servos(robot, logs, progress)
        progress.note(*result.notes)
        fault = servo_fault(result.rollout, result.goal_errors)
        failure = None
        # A URDF holds no rotor inertia, which the rollouts had: an MJCF is written beside it.
        kinds = list(dict.fromkeys(("mjcf", robot.kind)))
        if fault is not None and "rollout" not in logs.accept:
            failure = f"no model was written: {fault}; to write it all the same: --accept rollout"
            kinds = []
        models: list[Path] = []
        notes: list[str] = []
        try:
            for kind in kinds:
                path = folder / file_access.MODEL_NAMES[kind]
                # No torque was measured, so there is no residual to state.
                target = ModelTarget(files, path, poses, rmse=0.0, mesh_dir=mesh_dir)
                notes += write_joints(robot, *result.changes(), target, kind)
                models.append(path)
        except ExportError as error:
            for model in models:
                files.withdraw(model)
            models = []
            failure = (
                f"{error} (the identified numbers are in {file_access.SERVO_NAME})"
            )
        result = replace(result, notes=(*result.notes, *notes))
        written = (*models, folder / file_access.SERVO_NAME)
        files.write(written[-1], json_text(result.json_content()))
        read = [*filter(None, input_files), *read_document(robot.path).contents]
        notes += remove_earlier(files, folder, written, read)
    progress.note(*notes)
    lines = (*servo_lines(result), f"Results saved to {folder_text(folder)}")
    if failure is not None:
        return Written(written, lines, (f"Not usable: {failure}",), failure, result)
    judgement = f"Not usable, but written because of --accept rollout: {fault}"
    if fault is None:
        judgement = (
            "Usable: position errors of the model, played on what was not fitted, are "
            f"{result.rollout.score:.2g} times those before"
        )
    return Written(written, lines, (judgement, *use_lines(models[0])), None, result)


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
    fitted_logs = _open_logs(robot, logs.measurements, logs, progress)
    fitted = commanded_pieces(fitted_logs, robot.joint_names)
    if logs.validation_measurements is None:
        fitted, held_out = split_pieces(fitted)
        held_out_text = LAST_FIFTH
    else:
        test_logs = _open_logs(robot, [logs.validation_measurements], logs, progress)
        refuse_fitted_log(test_logs[0], fitted_logs)
        held_out = commanded_pieces(test_logs, robot.joint_names)
        held_out_text = "the validation log"
    progress.stage("Searching for servos, friction and rotor inertia...")
    in_model = servos_in_model(robot).numbers
    rollouts = ServoRollouts(robot)
    problem = make_problem(rollouts, fitted, _FITTED_WINDOWS, _WINDOW, _SETTLING_TIME)
    equations = loop_equations(robot, fitted)
    goal_delay = equations.best_goal_delay()
    found = refine_played(problem, fit_servos(robot, equations), in_model)

    # Where the model has no servo, its joint's damping is not that of both: what was found stands
    # for gain and damping.
    kept = in_model.copy()
    without = np.isnan(in_model[0])
    kept[:2, without] = found.numbers[:2, without]
    old = replace(found, numbers=kept)
    is_new = found.is_known
    while True:
        fit = replace(found, numbers=np.where(is_new, found.numbers, kept))
        pair = (old.servos, fit.servos)
        rollout, goal_errors = play_servos(
            rollouts, held_out, pair, held_out_text, goal_delay
        )
        # Rollouts of what was fitted may only become worse where the equations miss something.
        errors = (rollout_error(problem, pair), *rollout.errors)
        is_worse = is_new & np.any([error.is_worse for error in errors], axis=0)
        if "rollout" in logs.accept or not np.any(is_worse):
            break
        is_new = is_new & ~is_worse
    distance = np.abs(fit.numbers[0] * equations.distances(fit.delay))
    result = ServoIdentification(
        robot=robot,
        fit=fit,
        is_new=is_new,
        limit_share=np.mean(distance > chain_actuators(robot).limit, axis=0),
        data=origin_of(fitted_logs),
        rollout=rollout,
        goal_delay=goal_delay,
        goal_errors=goal_errors,
    )
    notes = [note for log in fitted_logs for note in log.notes]
    notes += servo_notes(result)
    q = equations.position[:: max(1, len(equations.position) // _POSES)]
    poses = Motion(np.arange(len(q), dtype=float), q, 0.0 * q, 0.0 * q)
    return replace(result, notes=tuple(dict.fromkeys(notes))), poses


def _open_logs(
    robot: RobotModel, paths: Sequence[Path], logs: FittedLogOptions, progress: Progress
) -> list[MeasurementLog]:
    """Return the logs in files, with their commands; announce each that is read."""
    opened = []
    for path in paths:
        progress.stage(f"Reading commands and positions from {path}...")
        opened.append(open_log(robot, path, replace(logs, commanded=True), progress))
    refuse_repeated_logs((str(log.path), log.samples) for log in opened)
    return opened
