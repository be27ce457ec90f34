"""An arm without torque sensors: servos, friction and rotor inertia from commands and positions.

From the log files to the written files, and the sentences that are printed about them. An arm has
n joints; a piece is a part of a log without gaps.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import ExportError
from robot_sysid.export import Outcome, locked_folder, remove_earlier
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
from robot_sysid.records import (
    Array,
    DataOrigin,
    Measurement,
    Motion,
    RobotModel,
    file_access,
)
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
from robot_sysid.servo import fit as servo_fit
from robot_sysid.servo.commands import commanded_pieces, is_moving
from robot_sysid.servo.fit import ErrorDerivatives, ServoFit
from robot_sysid.servo.held_out import (
    GoalPrediction,
    best_goal_delay,
    play_servos,
    servo_refusal,
)
from robot_sysid.servo.loop_equations import LINK_ERROR, LoopFit
from robot_sysid.servo.windows import (
    MAX_DELAY_PERIODS,
    ServoProblem,
    limit_share,
    make_problem,
    split_pieces,
)
from robot_sysid.simulation.playback import (
    NO_ACTUATOR,
    ServoParameters,
    ServoRollouts,
    chain_actuators,
    servos_in_model,
)

SERVO_SCHEMA = "robot-sysid servo 1"
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
    FROM_MODEL: " (not determined: the model's value)",
    ASSUMED: " (not determined: assumed)",
}
"""What follows a number in the printed lines, by its source, unless it is identified."""
_GAIN_ORIGINS = {
    IDENTIFIED: "fitted",
    FROM_MODEL: "the model's",
    ASSUMED: "assumed to be like those of the other joints",
}
"""Source of a gain, in words."""
_KEYS = ("before", "value", "standard_error", "source")
"""Keys of an identified number in servo.json, without its unit."""
OFTEN_LIMITED = 0.2
"""Share of time at its limit from which on a servo is mentioned; chosen, nothing else depends on
it."""
_SAME_LIMIT = 1.5
"""Torque limit of the model over that seen in the logs from which on they differ: the latter has
the scale of the model's masses."""
LARGE_ERROR = 0.5
"""Relative error of a gain from which on only ratios of a joint's numbers are called identified;
chosen, nothing else depends on it."""


@dataclass(frozen=True)
class ServoIdentification:
    """The result for an arm identified from commands and positions alone.

    Attributes:
        robot: the arm as in the model file.
        fit: the identified numbers; joints that do not move keep the model's.
        is_moving: (n,) whether a joint moves in the logs.
        limit_share: (n,) share of time in which a servo needs more than its torque limit.
        torque_limit: (n,) torque at which a servo is seen to be limited; NaN where none is seen.
        has_limit: (n,) whether the model has this limit.
        data: the logs.
        rollout: the models before and after, played on held-out pieces.
        goal: prediction of the same pieces by the commands themselves.
        notes: sentences for the user.
    """

    robot: RobotModel
    fit: ServoFit
    is_moving: NDArray[np.bool_]
    limit_share: Array
    torque_limit: Array
    has_limit: NDArray[np.bool_]
    data: DataOrigin
    rollout: RolloutTest
    goal: GoalPrediction
    notes: tuple[str, ...] = ()

    @property
    def has_servo(self) -> NDArray[np.bool_]:
        """Whether the model has a position actuator that takes the gain (n,)."""
        return np.isfinite(chain_actuators(self.robot).stiffness)

    @property
    def joint_numbers(self) -> dict[str, dict[str, dict[str, Any]]]:
        """Each joint's numbers: by the joint's name, then by a key of ``UNITS``.

        A number is a dict of "before" (NaN where the model has none), "value", "standard_error" and
        "source" (``IDENTIFIED``, ``FROM_MODEL`` or ``ASSUMED``).
        """
        model_value = servos_in_model(self.robot).vector()
        value = self.fit.servos.vector()
        error = self.fit.errors.vector()
        # A number that the model does not have (NaN, which differs from every value) is assumed
        # where the data does not show it.
        source = np.where(value == model_value, FROM_MODEL, ASSUMED)
        source = np.where(self.fit.is_identified, IDENTIFIED, source)
        columns = model_value.tolist(), value.tolist(), error.tolist(), source.tolist()
        numbers = [dict(zip(_KEYS, row)) for row in zip(*columns)]
        joint_names = self.robot.joint_names
        n_joints = len(joint_names)
        # The vectors hold n gains, n dampings, n frictions, n rotor inertias and the delay.
        numbers_of_joint = {}
        for k, name in enumerate(joint_names):
            numbers_of_joint[name] = dict(zip(UNITS, numbers[k::n_joints]))
        return numbers_of_joint

    def changes(self) -> tuple[list[JointChange], list[ActuatorChange]]:
        """Return the changes of the model file's joints that move and of their position actuators.

        Of the damping of joint and servo together, the servo gets its share in the model as its kv,
        the joint the remainder. An actuator's numbers are those at the motor: a gear g makes them
        g^2 times as large at the joint.
        """
        actuators = chain_actuators(self.robot)
        servos = self.fit.servos
        joint_changes = []
        actuator_changes = []
        for k in np.flatnonzero(self.is_moving).tolist():
            kv = float(actuators.damping_share[k] * servos.damping[k])
            joint_changes.append(
                JointChange(
                    self.robot.joint_names[k],
                    armature=float(servos.armature[k]),
                    damping=float(servos.damping[k]) - kv,
                    frictionloss=float(servos.frictionloss[k]),
                )
            )
            if self.has_servo[k]:
                squared_gear = float(actuators.gear[k]) ** 2
                gain = float(servos.stiffness[k]) / squared_gear
                index = int(actuators.index[k])
                has_damping = actuators.damping_share[k] > 0.0
                damping = kv / squared_gear if has_damping else None
                actuator_changes.append(ActuatorChange(index, gain, damping))
        return joint_changes, actuator_changes

    def json_content(self) -> dict[str, Any]:
        """Return the content of servo.json, which ``json_text`` turns into text.

        It holds each joint's numbers with units, the delay, the comparison of the models before and
        after, and where all of it comes from.
        """
        joints = {}
        for k, (joint, numbers) in enumerate(self.joint_numbers.items()):
            joints[joint] = {
                **{name: {**numbers[name], "unit": UNITS[name]} for name in UNITS},
                "moves": self.is_moving[k],
                "has_servo": self.has_servo[k],
                "at_limit": self.limit_share[k],
            }
        delay = {
            "value": self.fit.servos.delay,
            "standard_error": self.fit.errors.delay,
        }
        return {
            "schema": SERVO_SCHEMA,
            "torque": "none measured; from position error",
            "meaning": WITHOUT_TORQUE,
            "delay": delay,
            "joints": joints,
            "rollout": rollout_entry(self.rollout),
            "goal_prediction": asdict(self.goal),
            "position_errors": dict(
                zip(self.robot.joint_names, self.fit.position_error)
            ),
            "source": self.data.description,
            "duration": self.data.duration,
            "model": {"path": str(self.robot.path), "sha256": self.robot.sha256},
            "versions": versions(),
            "notes": self.notes,
        }


def servo_lines(result: ServoIdentification) -> list[str]:
    """Return the printed lines of a result: delay, each joint's numbers, errors of rollouts."""
    delay = result.fit.servos.delay
    error = result.fit.errors.delay
    lines = [
        "Servos, friction and rotor inertia, before -> after, ± one standard error:",
        f"  {WITHOUT_TORQUE}.",
        f"  delay of the commands: {with_error(1e3 * delay, 1e3 * error, 'ms')}",
    ]
    for moves, (joint, numbers) in zip(result.is_moving, result.joint_numbers.items()):
        text = "does not move in these logs; all as in the model"
        if moves:
            text = "; ".join(map(_number_text, numbers, numbers.values()))
        lines.append(f"  {joint}: {text}")
    lines += rollout_lines(result.rollout)
    pairs = zip(result.rollout.errors, result.goal.errors)
    goal_errors = [f"{error:.3g} over {test.horizon:g} s" for test, error in pairs]
    if goal_errors:
        lines.append(f"  {result.goal.name}: {', '.join(goal_errors)}")
    return lines


def _number_text(name: str, number: dict[str, Any]) -> str:
    """Return the text "name old -> new ± error unit" of one number of a joint.

    ``number`` is a dict as in ``ServoIdentification.joint_numbers``, ``name`` a key of ``UNITS``.
    """
    model_value, value, error, source = (number[key] for key in _KEYS)
    is_changed = source != FROM_MODEL and np.isfinite(model_value)
    old = f"{model_value:.3g} -> " if is_changed else ""
    doubt = _DOUBTS.get(source, "")
    return f"{name} {old}{with_error(value, error, UNITS[name])}{doubt}"


def servo_notes(result: ServoIdentification, period: float) -> Iterator[str]:
    """Yield sentences on the assumptions behind a result and on its weak points.

    Args:
        result: the result, for all joints.
        period: sampling period of the logs [s].
    """
    other_joints = result.robot.mj_model.nv - result.robot.n_joints
    if other_joints:
        yield (
            "joints outside the arm (a gripper's, say) are held at rest: what their servos do is "
            "not looked at"
        )
    yield (
        "damping is that of joint and servo together, which look alike: the servo keeps the share "
        "of it that it has in the model"
    )
    if result.fit.servos.delay > 0.95 * MAX_DELAY_PERIODS * period:
        yield (
            f"the delay is at the end of what is sought ({MAX_DELAY_PERIODS} samples): check the "
            "time stamps of the commands"
        )
    lacks_servo = result.is_moving & ~result.has_servo
    without_servo = list(itertools.compress(result.robot.joint_names, lacks_servo))
    if without_servo:
        yield (
            f"the model has no position actuator on {', '.join(without_servo)}: the gain is "
            "printed, but not written"
        )
    for k, joint in enumerate(result.robot.joint_names):
        if result.is_moving[k]:
            yield from _joint_notes(result, k)
        else:
            yield f"{joint} does not move in these logs: it keeps the model's numbers"


def _joint_notes(result: ServoIdentification, k: int) -> Iterator[str]:
    """Yield sentences on the weak points of the numbers of the joint with index ``k``."""
    joint = result.robot.joint_names[k]
    numbers = result.joint_numbers[joint]
    gain = numbers["gain"]
    from_model = [n for n in numbers if numbers[n]["source"] == FROM_MODEL]
    unseen = [name for name in from_model if name != "gain"]
    if unseen:
        yield (
            f"the servo of {joint} hides its {', '.join(unseen)}: what the model has stays, and "
            "may be off by twice the stated error; a softer servo (a lower gain) would show more"
        )
    if result.limit_share[k] > OFTEN_LIMITED:
        yield (
            f"the servo of {joint} asks for more than its limit of "
            f"{chain_actuators(result.robot).limit[k]:.3g} N·m (the model's) in "
            f"{100.0 * result.limit_share[k]:.0f} % of the time: what is found rests on that limit"
        )
    limit = result.torque_limit[k]
    if np.isfinite(limit) and not result.has_limit[k]:
        yield (
            f"the servo of {joint} reaches a torque limit of about {limit:.2g} N·m that the model "
            "does not have (forcerange of a position actuator); windows of the log with it are not "
            "fitted where enough others are left"
        )
    if gain["standard_error"] > LARGE_ERROR * gain["value"]:
        origin = _GAIN_ORIGINS[gain["source"]]
        yield (
            f"the links' torque on {joint} is too small to show the absolute size of its numbers, "
            f"only their ratios: its gain of {gain['value']:.3g} N·m/rad is {origin}, and the "
            "others are right in proportion to it"
        )


def run_servo(
    robot: RobotModel,
    logs: FittedLogOptions,
    folder: Path,
    mesh_dir: Path | None,
    progress: Progress,
    input_files: Sequence[Path | None] = (),
) -> Outcome:
    """Identify servos, friction and rotor inertia of an arm whose links are trusted; write results.

    The folder is locked meanwhile. A model is written only if it plays the held-out data better, or
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
    with locked_folder(folder, progress):
        result, poses = identify_servos(robot, logs, progress)
        progress.note(*result.notes)
        with file_access.atomic_files() as files:
            # No torque was measured, so there is no residual to state.
            target = ModelTarget(files, folder, poses, rmse=0.0, mesh_dir=mesh_dir)
            reason = servo_refusal(result.rollout, result.goal, logs.accept)
            outcome = _write_results(result, target, reason)
            model_files = read_document(robot.path).contents
            protected = [*filter(None, input_files), *model_files]
            notes = remove_earlier(files, folder, outcome.files, protected)
    # The notes that were added when the model was written.
    progress.note(*outcome.result.notes[len(result.notes) :], *notes)
    return outcome


def identify_servos(
    robot: RobotModel, logs: FittedLogOptions, progress: Progress
) -> tuple[ServoIdentification, Motion]:
    """Identify servos, friction and rotor inertia; return the result and poses from the logs.

    The poses are a motion (m, n) without velocity; the written model is checked there.
    The beginnings of the logs are fitted and their ends, or the validation log, are held out to
    compare the models. Numbers that the data does not show go back to the model's. Without a
    validation log, the other numbers are at last fitted to the whole logs.

    Args:
        robot: the arm as in the model file.
        logs: names the logs to fit, and the validation log if there is one.
        progress: receives each stage.
    """
    measurement_logs = _open_logs(robot, logs.measurements, logs, progress)
    pieces = commanded_pieces(measurement_logs, robot.joint_names)
    validation_path = logs.validation_measurements
    if validation_path is None:
        fitted, held_out = split_pieces(pieces)
        held_out_text = LAST_FIFTH
    else:
        fitted = pieces
        validation_logs = _open_logs(robot, [validation_path], logs, progress)
        refuse_fitted_log(validation_logs[0], measurement_logs)
        held_out = commanded_pieces(validation_logs, robot.joint_names)
        held_out_text = "the validation log"
    moves = is_moving(pieces)
    progress.stage("Searching for servos, friction and rotor inertia...")
    rollouts = ServoRollouts(robot)
    every_number, loop_fit = servo_fit.initial_parametrisation(robot, fitted, moves)
    derivatives = ErrorDerivatives(unlimited_problem(rollouts, fitted, loop_fit))
    shown_numbers = servo_fit.search_shown_numbers(
        derivatives, every_number, loop_fit, progress
    )
    servos = shown_numbers.start
    is_determined = loop_fit.determines & ~shown_numbers.free

    old_servos = servo_fit.keep_model_values(robot, servos)
    goal_delay = best_goal_delay(derivatives.problem)
    rollout, goal = play_servos(
        rollouts, held_out, (old_servos, servos), held_out_text, goal_delay
    )
    if validation_path is None:
        # The held-out ends have done their work; the numbers come from the whole logs.
        every_number, loop_fit = servo_fit.initial_parametrisation(robot, pieces, moves)
        is_determined &= loop_fit.determines
        in_loop = loop_fit.servos.vector()
        start = np.where(is_determined, in_loop, servos.vector())
        shown_numbers = replace(shown_numbers, start=ServoParameters.from_vector(start))
        derivatives = ErrorDerivatives(unlimited_problem(rollouts, pieces, loop_fit))
        servos = servo_fit.search_servos(derivatives, shown_numbers, progress)

    # The errors are those with all numbers free that the equations do not determine.
    fit = servo_fit.estimate_errors(derivatives, every_number, servos)
    error_vector = np.where(is_determined, loop_fit.errors, fit.errors.vector())
    errors = ServoParameters.from_vector(error_vector)
    is_identified = is_determined | shown_numbers.free
    fit = replace(fit, errors=errors, is_identified=is_identified)
    fit = servo_fit.add_link_errors(robot, fit, loop_fit, moves)
    result = ServoIdentification(
        robot=robot,
        fit=fit,
        is_moving=moves,
        limit_share=limit_share(derivatives.problem, fit.servos),
        torque_limit=loop_fit.limit,
        has_limit=has_torque_limit(robot, loop_fit.limit),
        data=origin_of(measurement_logs),
        rollout=rollout,
        goal=goal,
    )
    notes = [note for log in measurement_logs for note in log.notes]
    notes += servo_notes(result, every_number.typical.delay)
    q = servo_fit.log_positions(pieces)
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


def unlimited_problem(
    rollouts: ServoRollouts, pieces: Sequence[Measurement], loop_fit: LoopFit
) -> ServoProblem:
    """Return the windows of pieces of logs in which no servo is at its torque limit."""
    problem = make_problem(rollouts, pieces)
    return problem.without_samples(loop_fit.limited_samples())


def has_torque_limit(robot: RobotModel, limit: Array) -> NDArray[np.bool_]:
    """Return whether rollouts of a model have the torque limits (n,) [N m] that logs show."""
    actuators = chain_actuators(robot)
    is_as_low = actuators.limit < _SAME_LIMIT * limit
    return np.asarray(is_as_low & (actuators.index != NO_ACTUATOR))


def _write_results(
    result: ServoIdentification, target: ModelTarget, failure: str | None
) -> Outcome:
    """Write servo.json and the new model; return what was written, with the lines to print.

    A URDF holds no rotor inertia, which the rollouts had: an MJCF is written, the URDF beside it.
    The model is left out where ``failure`` is given or it cannot be exported: the outcome then has
    the reason. The outcome's result has the notes that were made while the model was written.

    Args:
        result: the identification to write.
        target: its path is the folder.
        failure: why no model may be written, or None.
    """
    path = target.path / file_access.SERVO_NAME
    models: list[Path] = []
    if failure is None:
        try:
            for file_kind in dict.fromkeys(("mjcf", result.robot.kind)):
                model = target.path / file_access.MODEL_NAMES[file_kind]
                file = replace(target, path=model)
                notes = write_joints(result.robot, *result.changes(), file, file_kind)
                result = replace(result, notes=(*result.notes, *notes))
                models.append(model)
        except ExportError as error:
            for model in models:
                target.files.withdraw(model)
            models = []
            failure = (
                f"{error} (the identified numbers are in {file_access.SERVO_NAME})"
            )
    target.files.write(path, json_text(result.json_content()))
    lines = (*servo_lines(result), f"Results saved to {folder_text(target.path)}")
    verdict: tuple[str, ...] = (f"Not usable: {failure}",)
    if failure is None:
        score = result.rollout.score
        times = "not known" if score is None else f"{score:.2g} times those before"
        verdict = (
            "Usable: position errors of the model, played on what was not fitted, are "
            f"{times}",
            *_lacking_lines(result),
            *use_lines(models[0]),
        )
    return Outcome(lines, verdict, failure, (*models, path), result)


def _lacking_lines(result: ServoIdentification) -> Iterator[str]:
    """Yield what the rollouts had, but the written model cannot hold."""
    if np.any(result.is_moving & ~result.has_servo):
        yield (
            "  together with the gain above, which this file cannot hold: set it in the simulator, "
            "or start from an MJCF with position actuators"
        )
