"""An arm without torque sensors, from the files to the files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from robot_sysid.errors import ExportError, InputError
from robot_sysid.export import alone_in
from robot_sysid.identify.arm.servo.commands import MOST_PERIODS, commanded_pieces, moving
from robot_sysid.identify.arm.servo.fit import (
    at_limit,
    better_start,
    first_servos,
    fit_servos,
    held_still,
    links_share,
    with_links_error,
)
from robot_sysid.identify.arm.servo.played import parted, play_servos
from robot_sysid.identify.arm.servo.problem import Problem, Scale, problem_of
from robot_sysid.identify.arm.servo.result import changes, delay_to_write, joint_servos, servo_notes
from robot_sysid.identify.judgement.rollout.candidate import refusal
from robot_sysid.identify.simulated import versions
from robot_sysid.logs.options import LogOptions
from robot_sysid.logs.reader import MeasurementLog, open_log, origin_of
from robot_sysid.output.model_writing import ModelTarget, write_joints
from robot_sysid.output.printed.link import folder_text
from robot_sysid.output.printed.servo import SERVO_NAME, servo_json_text, servo_lines
from robot_sysid.records import Motion, RobotModel
from robot_sysid.records.atomic_files import refuse_overwriting, whole_files
from robot_sysid.records.progress import Progress
from robot_sysid.records.results import MODEL_NAMES
from robot_sysid.records.whole_arm import ServoIdentification
from robot_sysid.simulation.rollout.servo import (
    HOLDS_DELAY,
    Actuators,
    Servos,
    actuators_of,
    played_servos,
)

MOST_WINDOWS = 24
"""Windows that are fitted, spread evenly over the logs."""
_POSITIONS = 200


@dataclass(frozen=True)
class ServoOutcome:
    """What a run produced.

    Attributes:
        identification: the result.
        output_dir: where files went.
        files: what was written there.
        failure: why there is no updated model, or None.
        notes: what writing the model had to say.
    """

    identification: ServoIdentification
    output_dir: Path
    files: tuple[Path, ...]
    failure: str | None = None
    notes: tuple[str, ...] = ()

    def report_lines(self, verbose: bool) -> list[str]:
        """Return what the command line prints at the end."""
        saved = f"Results saved to {folder_text(self.output_dir)}"
        return [*servo_lines(self.identification, verbose), saved]


def run_servo(
    robot: RobotModel,
    logs: LogOptions,
    folder: Path,
    mesh_dir: Path | None,
    progress: Progress,
    write_delay: bool = False,
) -> ServoOutcome:
    """Identify servos, friction and rotor inertia from commands and positions; write the results.

    Args:
        robot: the arm, whose links are trusted.
        logs: which logs, and what their columns are.
        folder: where results go.
        mesh_dir: the user's mesh folder, if any.
        progress: where to tell how far it is.
        write_delay: also write the delay of the commands into the model's position actuators.

    Raises:
        SysidError: with the exit code that fits, see ``errors``.
    """
    if write_delay and not HOLDS_DELAY:
        raise InputError(
            "--write-delay: the actuators of the installed MuJoCo cannot act late; install a newer "
            "mujoco, or leave it off"
        )
    read = (robot.path, *logs.measurements, logs.validation_measurements, logs.columns)
    names = (SERVO_NAME, *MODEL_NAMES.values())
    refuse_overwriting(read, (("--output-dir", folder / name) for name in names))
    with alone_in(folder, progress):
        found, q = identify_servos(robot, logs, progress)
        for note in found.notes:
            progress.note(note)
        refused = refusal(found.rollout, logs.accept)
        outcome = _write(robot, found, write_delay, q, folder, mesh_dir, refused)
    for note in outcome.notes:
        progress.note(note)
    return outcome


def identify_servos(
    robot: RobotModel, logs: LogOptions, progress: Progress
) -> tuple[ServoIdentification, np.ndarray]:
    """Identify from logs; returns (result, some positions (m, n))."""
    read = [_read(robot, logs, path, progress) for path in logs.measurements]
    pieces, other = commanded_pieces(read, robot.joint_names), logs.validation_measurements
    fitted, held, words = parted(pieces)
    if other is not None:
        held = commanded_pieces([_read(robot, logs, other, progress)], robot.joint_names)
        fitted, words = pieces, "the validation log"
    actuators, period = actuators_of(robot), float(np.median([p.period for p in pieces]))
    q = np.concatenate([piece.q for piece in pieces])
    q = q[np.linspace(0, len(q) - 1, _POSITIONS).astype(int)]
    start = held_still(first_servos(robot, actuators, q, period), moving(pieces))
    progress.stage("Searching for servos, friction and rotor inertia...")
    problem, longest = problem_of(robot, actuators, fitted, MOST_WINDOWS), MOST_PERIODS * period
    fit = fit_servos(problem, better_start(problem, start, period), longest, progress)
    pair = (_before(start, actuators, fit.servos), fit.servos)
    rollout = play_servos(robot, actuators, held, pair, words)
    if other is None:
        # What was held out has done its work; the numbers come from all that was recorded.
        problem = problem_of(robot, actuators, pieces, MOST_WINDOWS)
        fit = fit_servos(problem, replace(start, start=fit.servos), longest, progress)
    fit = with_links_error(fit, links_share(robot, pieces, fit.servos))
    found = ServoIdentification(
        robot.path,
        robot.sha256,
        joint_servos(robot, actuators, start, fit, _limited(problem, actuators, fit.servos)),
        fit.servos.delay,
        fit.errors.delay,
        dict(zip(robot.joint_names, fit.sigma.tolist())),
        origin_of(read),
        rollout,
        versions(),
        tuple(_notes(robot, [note for log in read for note in log.notes])),
    )
    more = tuple(servo_notes(robot, actuators, found, period))
    return replace(found, notes=tuple(dict.fromkeys((*found.notes, *more)))), q


def _read(robot: RobotModel, logs: LogOptions, path: Path, progress: Progress) -> MeasurementLog:
    progress.stage(f"Reading commands and positions from {path}...")
    return open_log(robot, path, replace(logs, commanded=True), progress)


def _before(start: Scale, actuators: Actuators, found: Servos) -> Servos:
    """Return the model before, with the delay that was found; gains it does not have, too."""
    known = np.isfinite(actuators.stiffness)
    stiffness = np.where(known, start.start.stiffness, found.stiffness)
    damping = np.where(known, start.start.damping, found.damping)
    return replace(start.start, stiffness=stiffness, damping=damping, delay=found.delay)


def _limited(problem: Problem, actuators: Actuators, servos: Servos) -> np.ndarray:
    played = played_servos(problem.robot, actuators, [servos], problem.windows, problem.edges)
    return at_limit(problem, actuators, servos, list(played[0]))


def _notes(robot: RobotModel, said: Sequence[str]) -> Iterator[str]:
    yield from said
    held = robot.mj_model.nv - robot.n_joints
    if held:
        yield (
            f"{held} joints outside the arm (a gripper's, say) are held at rest: what their servos "
            "do is not looked at"
        )


def _write(
    robot: RobotModel,
    found: ServoIdentification,
    write_delay: bool,
    q: np.ndarray,
    folder: Path,
    mesh_dir: Path | None,
    refused: str | None,
) -> ServoOutcome:
    """Write servo.json and, where the new model moves more like the arm, that; all or none."""
    names, failure = [SERVO_NAME], refused
    notes: tuple[str, ...] = ()
    with whole_files() as files:
        if refused is None:
            path = files.reserve_last(folder / MODEL_NAMES[robot.kind])
            rest = Motion(np.arange(len(q), dtype=float), q, 0.0 * q, 0.0 * q)
            target = ModelTarget(files, path, rest, 0.0, mesh_dir)
            delay, said = delay_to_write(robot, found, write_delay)
            try:
                notes = said + write_joints(robot, *changes(robot, found.joints, delay), target)
                names.append(path.name)
            except ExportError as error:
                files.withdraw(path)
                failure = f"{error} (the identified numbers are in {SERVO_NAME})"
        final = replace(found, notes=found.notes + notes)
        files.write(folder / SERVO_NAME, servo_json_text(final))
    stale = folder / MODEL_NAMES[robot.kind]
    if stale.name not in names and stale.exists():
        notes = (*notes, f"{stale} is from an earlier run; this run wrote no model")
    return ServoOutcome(final, folder, tuple(folder / name for name in names), failure, notes)
