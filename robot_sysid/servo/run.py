"""An arm without torque sensors, from the files to the files, and what is said of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import ExportError, InputError
from robot_sysid.export import locked_folder, remove_earlier
from robot_sysid.logs import LogOptions
from robot_sysid.logs.reader import MeasurementLog, open_log, origin_of
from robot_sysid.mjcf.documents import read_document
from robot_sysid.mjcf.updated_model import ActuatorChange, JointChange
from robot_sysid.pipeline.outcome import Outcome
from robot_sysid.records import (
    Array,
    DataOrigin,
    Measurement,
    Motion,
    RobotModel,
    atomic_files,
)
from robot_sysid.records.progress import Progress
from robot_sysid.records.results import RolloutTest
from robot_sysid.results.console import folder_text, rollout_lines
from robot_sysid.results.json import json_text, rollout_entry
from robot_sysid.results.model import ModelTarget, versions, write_joints
from robot_sysid.results.rollout import LAST_FIFTH, refusal
from robot_sysid.results.verdict import two_lines
from robot_sysid.servo import search
from robot_sysid.servo.search import MOST_PERIODS, ServoFit
from robot_sysid.signals.resampling import sampling_period
from robot_sysid.simulation.servos import ServoRollouts, actuators_of, model_servos

SERVO_SCHEMA = "robot-sysid servo 1"
WITHOUT_TORQUE = (
    "No torque was measured: all of this follows from commanded and measured positions, and from "
    "the masses of the model, which fix its scale"
)
UNITS = {
    "gain": "N·m/rad",
    "damping": "N·m·s/rad",
    "frictionloss": "N·m",
    "armature": "kg·m²",
}
"""What is found of a joint, in the order of ``Servos``, and its unit."""
_KEYS = ("before", "value", "standard_error", "source")
OFTEN = 0.2
UNSURE = 0.5
"""Share of time at its limit from which on that is said, and relative error from which on only the
ratios of a joint's numbers are; chosen, nothing else depends on them."""
_POSITIONS = 200


# Range of positions from which on a joint moves [rad or m]; slopes of commands in other units; how
# much is alike, followed, off.
MOVES = 0.02
_SLOPES = {"degrees": 180.0 / np.pi, "steps of 4096 a turn": 4096 / (2 * np.pi)}
_ALIKE = 0.98
_FOLLOWS = 0.5
_OFFSET = 0.3


def commanded_pieces(
    logs: Sequence[MeasurementLog], joints: Sequence[str]
) -> list[Measurement]:
    """Return the pieces between the gaps of some logs that were read for their commands.

    InputError where these cannot be what they seem; says which joint's and why.
    """
    for log in logs:
        for joint in np.flatnonzero(moving(log.pieces)).tolist():
            asked = [(p.q, p.command) for p in log.pieces if p.command is not None]
            pairs = [(q[:, joint], command[:, joint]) for q, command in asked]
            for fault in _faults(pairs):
                raise InputError(
                    f"{log.path}: the commands of joint {joints[joint]} {fault}"
                )
    return [part for log in logs for part in log.pieces]


def moving(parts: Sequence[Measurement]) -> NDArray[np.bool_]:
    """Return (n,) which joints move."""
    return np.asarray(
        np.ptp(np.concatenate([part.q for part in parts]), axis=0) >= MOVES
    )


def _faults(pairs: Sequence[tuple[Array, Array]]) -> Iterator[str]:
    """Yield what is wrong with a joint's commands, as the end of a sentence."""
    best, at, slope = _best_lag(pairs)
    same = [
        [np.abs(c[: len(c) - lag] - q[lag:]) < 1e-9 for q, c in pairs]
        for lag in range(4)
    ]
    unit = next((u for u, k in _SLOPES.items() if 0.7 < abs(slope) / k < 1.4), None)
    offset = float(np.median(np.concatenate([c - q for q, c in pairs])))
    if max(float(np.mean(np.concatenate(each))) for each in same) > _ALIKE:
        yield (
            "repeat the measured positions: the log holds no real commands; record what was sent "
            "to the servos"
        )
    if unit is not None:
        yield (
            f"change {abs(slope):.3g} times as much as its positions: they look like {unit}; say "
            "what they are with --units, or scale the columns with --columns FILE, such as "
            f"'command.JOINT = {1.0 / slope:.4g} * TITLE'"
        )
    if best < _FOLLOWS:
        yield (
            f"are not followed (correlation {best:.2f} at the best delay); check the columns, and "
            "that the servos were on"
        )
    if not 0.5 < slope < 2.0:
        yield f"change {slope:.3g} times as much as its positions; check their units and sign"
    if at < 0:
        yield (
            f"come {-at} samples after its positions; check the time stamps, and whether the "
            "columns of commands and positions were exchanged"
        )
    if at > MOST_PERIODS:
        yield (
            f"come {at} samples before its positions, more than the {MOST_PERIODS} that are "
            "sought; check the time stamps, or record faster"
        )
    if abs(offset) > _OFFSET:
        yield (
            f"differ from its positions by {offset:.3g} all the time; check that both count from "
            "the same zero"
        )


def _best_lag(pairs: Sequence[tuple[Array, Array]]) -> tuple[float, int, float]:
    """Return (correlation, by how many samples positions are behind, slope of commands) there."""
    reach = min(3 * MOST_PERIODS, min(len(q) for q, _ in pairs) // 4)
    found = []
    for lag in range(-reach, reach + 1):
        first = max(0, lag)
        last = min(0, lag)
        same = [(q[first : len(q) + last], c[-last : len(c) - first]) for q, c in pairs]
        position, asked = (
            np.concatenate([v - np.mean(v) for v in side]) for side in zip(*same)
        )
        own = float(position @ position)
        both = float(position @ asked)
        norm = np.sqrt(own) * float(np.linalg.norm(asked))
        alike, slope = (abs(both) / norm, both / own) if norm > 0.0 else (0.0, 0.0)
        found.append((alike, -abs(lag), lag, slope))
    alike, _, lag, slope = max(found)
    return alike, lag, slope


@dataclass(frozen=True)
class ServoIdentification:
    """Everything that is told of an arm identified from commands and positions alone.

    Attributes:
        fit: what was found; joints that do not move keep the model's numbers.
        moves: (n,) whether a joint moves in the logs.
        at_limit: (n,) share of time in which a servo asks for more than its limit.
        rollout: the model before and after, played on held-out pieces.
    """

    robot: RobotModel
    fit: ServoFit
    moves: NDArray[np.bool_]
    at_limit: Array
    data: DataOrigin
    rollout: RolloutTest
    notes: tuple[str, ...] = ()

    @property
    def has_servo(self) -> NDArray[np.bool_]:
        """Whether the model has a position actuator that takes the gain (n,)."""
        return np.isfinite(actuators_of(self.robot).stiffness)

    @property
    def numbers(self) -> dict[str, dict[str, dict[str, Any]]]:
        """Joint to name, as in ``UNITS``, to what was found; before is NaN where there is none."""
        names = self.robot.joint_names
        servos = (self.fit.servos, self.fit.errors)
        before, value, error = (s.vector() for s in (model_servos(self.robot), *servos))
        source = np.where(self.fit.seen | (value != before), "identified", "from_model")
        columns = (column.tolist() for column in (before, value, error, source))
        rows = [dict(zip(_KEYS, row)) for row in zip(*columns)]
        return {
            joint: dict(zip(UNITS, rows[k : -1 : len(names)]))
            for k, joint in enumerate(names)
        }

    def changes(self) -> tuple[list[JointChange], list[ActuatorChange]]:
        """Return what the joints and the position actuators of the model get."""
        own = actuators_of(self.robot)
        joints = []
        servos = []
        for k in np.flatnonzero(self.moves).tolist():
            gain, damping, friction, armature = self.fit.servos.vector()[:-1].reshape(
                4, -1
            )[:, k]
            kv = float(own.share[k] * damping)
            gear = float(own.gear[k]) ** 2
            rest = float(armature), float(damping) - kv, float(friction)
            joints.append(JointChange(self.robot.joint_names[k], *rest))
            if self.has_servo[k]:
                servos.append(
                    ActuatorChange(int(own.index[k]), float(gain) / gear, kv / gear)
                )
        return joints, servos

    def entries(self) -> dict[str, Any]:
        """Return the content of servo.json."""
        joints = {
            joint: {
                **{name: {**n, "unit": UNITS[name]} for name, n in numbers.items()},
                **{
                    name: getattr(self, name)[k]
                    for name in ("moves", "has_servo", "at_limit")
                },
            }
            for k, (joint, numbers) in enumerate(self.numbers.items())
        }
        return {
            "schema": SERVO_SCHEMA,
            "torque": "none measured; from position error",
            "meaning": WITHOUT_TORQUE,
            "delay": {
                "value": self.fit.servos.delay,
                "standard_error": self.fit.errors.delay,
            },
            "joints": joints,
            "rollout": rollout_entry(self.rollout),
            "position_errors": dict(zip(self.robot.joint_names, self.fit.sigma)),
            "source": self.data.words,
            "duration": self.data.duration,
            "model": {"path": str(self.robot.path), "sha256": self.robot.sha256},
            "versions": versions(),
            "notes": self.notes,
        }


def servo_lines(found: ServoIdentification) -> list[str]:
    """Return the block line by line."""
    delay = found.fit.servos.delay
    error = found.fit.errors.delay
    return [
        "Servos, friction and rotor inertia, before -> after, ± one standard error:",
        f"  {WITHOUT_TORQUE}.",
        f"  delay of the commands: {1e3 * delay:.1f} ± {1e3 * error:.1g} ms",
        *(
            f"  {joint}: {'; '.join(_figures(found, joint))}"
            for joint in found.robot.joint_names
        ),
        *rollout_lines(found.rollout),
    ]


def _figures(found: ServoIdentification, joint: str) -> Iterator[str]:
    if not found.moves[found.robot.joint_names.index(joint)]:
        yield "does not move in these logs; all as in the model"
        return
    for name, number in found.numbers[joint].items():
        before, value, error, source = number.values()
        old = "" if np.isnan(before) or source == "from_model" else f"{before:.3g} -> "
        doubt = "" if source == "identified" else " (not seen: as in the model)"
        yield f"{name} {old}{value:.3g} ± {error:.1g} {UNITS[name]}{doubt}"


def servo_notes(found: ServoIdentification, period: float) -> Iterator[str]:
    """Yield a sentence on each thing that the numbers do not say; ``period`` of samples in s."""
    outside = found.robot.mj_model.nv - found.robot.n_joints
    if outside:
        yield (
            f"{outside} joints outside the arm (a gripper's, say) are held at rest: what their "
            "servos do is not looked at"
        )
    yield (
        "damping is that of joint and servo together, which look alike: the servo keeps the share "
        "of it that it has in the model"
    )
    if found.fit.servos.delay > 0.95 * MOST_PERIODS * period:
        yield (
            f"the delay is at the end of what is sought ({MOST_PERIODS} samples): check the time "
            "stamps of the commands"
        )
    for k, (joint, numbers) in enumerate(found.numbers.items()):
        if found.moves[k]:
            yield from _joint_notes(found, k, joint, numbers)
        else:
            yield f"{joint} does not move in these logs: it keeps the model's numbers"


def _joint_notes(
    found: ServoIdentification, k: int, joint: str, numbers: dict[str, dict[str, Any]]
) -> Iterator[str]:
    gain = numbers["gain"]
    unseen = [name for name, own in numbers.items() if own["source"] == "from_model"]
    if unseen:
        yield (
            f"the servo of {joint} hides its {', '.join(unseen)}: what the model has stays, and "
            "may be off by twice the stated error; a softer servo (a lower gain) would show more"
        )
    if found.at_limit[k] > OFTEN:
        yield (
            f"the servo of {joint} asks for more than its limit of "
            f"{actuators_of(found.robot).limit[k]:.3g} N·m (the model's) in "
            f"{100.0 * found.at_limit[k]:.0f} % of the time: what is found rests on that limit"
        )
    if (
        gain["source"] == "identified"
        and gain["standard_error"] > UNSURE * gain["value"]
    ):
        yield (
            "these logs hardly show the absolute size of gain, friction and rotor inertia of "
            f"{joint}, only their ratios (gravity and the links' inertia would); the size "
            "stays near where the search began"
        )
    if not found.has_servo[k]:
        yield (
            f"the model has no position actuator on {joint}: its gain of {gain['value']:.4g} "
            "N·m/rad is told, not written"
        )


def run_servo(
    robot: RobotModel,
    logs: LogOptions,
    folder: Path,
    mesh_dir: Path | None,
    progress: Progress,
    read: Sequence[Path | None] = (),
) -> Outcome:
    """Identify servos, friction and rotor inertia of an arm whose links are trusted; write results.

    The files that are ``read`` stay.
    """
    with locked_folder(folder, progress):
        found, rest = identify_servos(robot, logs, progress)
        progress.note(*found.notes)
        with atomic_files.whole_files() as files:
            path = folder / atomic_files.MODEL_NAMES[robot.kind]
            target = ModelTarget(files, path, rest, 0.0, mesh_dir)
            outcome = _write(robot, found, target, refusal(found.rollout, logs.accept))
            model = (file.path for file in read_document(robot.path).files)
            removed = remove_earlier(
                files, folder, outcome.files, [*filter(None, read), *model]
            )
    progress.note(*outcome.result.notes[len(found.notes) :], *removed)
    return outcome


def identify_servos(
    robot: RobotModel, logs: LogOptions, progress: Progress
) -> tuple[ServoIdentification, Motion]:
    """Identify from logs; returns (result, some poses at rest)."""

    def read(path: Path) -> MeasurementLog:
        progress.stage(f"Reading commands and positions from {path}...")
        return open_log(robot, path, replace(logs, commanded=True), progress)

    opened = [read(path) for path in logs.measurements]
    other = logs.validation_measurements
    pieces = commanded_pieces(opened, robot.joint_names)
    words = LAST_FIFTH
    fitted, held = search.parted(pieces)
    if other is not None:
        held = commanded_pieces([read(other)], robot.joint_names)
        fitted = pieces
        words = "the validation log"
    moves = moving(pieces)
    period = float(np.median([sampling_period(piece.time) for piece in pieces]))
    q = np.concatenate([piece.q for piece in pieces])
    q = q[np.linspace(0, len(q) - 1, _POSITIONS).astype(int)]
    whole = search.first_servos(robot, q, period, moves)
    progress.stage("Searching for servos, friction and rotor inertia...")
    rollouts = ServoRollouts(robot)
    slopes = search.Slopes(search.problem_of(rollouts, fitted))
    servos = search.searched(
        slopes, search.better_start(slopes.problem, whole), progress
    )
    seen = search.judged(slopes, whole, servos).seen
    sought = replace(whole, free=whole.free & seen)
    if not np.array_equal(sought.free, whole.free):
        sought = replace(sought, start=search.as_in_model(robot, servos, ~seen))
        servos = search.searched(slopes, sought, progress)
    before = search.as_in_model(robot, servos)
    rollout = search.play_servos(rollouts, held, (before, servos), words)
    if other is None:
        # What was held out has done its work; the numbers come from all that was recorded.
        slopes = search.Slopes(search.problem_of(rollouts, pieces))
        servos = search.searched(slopes, replace(sought, start=servos), progress)
    fit = replace(search.judged(slopes, whole, servos), seen=seen)
    fit = search.with_links_error(fit, search.links_share(robot, pieces, fit.servos))
    limited = search.at_limit(slopes.problem, fit.servos)
    found = ServoIdentification(robot, fit, moves, limited, origin_of(opened), rollout)
    notes = [note for log in opened for note in log.notes]
    notes += servo_notes(found, period)
    rest = Motion(np.arange(len(q), dtype=float), q, 0.0 * q, 0.0 * q)
    return replace(found, notes=tuple(dict.fromkeys(notes))), rest


def _write(
    robot: RobotModel,
    found: ServoIdentification,
    target: ModelTarget,
    refused: str | None,
) -> Outcome:
    """Write servo.json and, where the new model moves more like the arm, that."""
    path = target.path.parent / atomic_files.SERVO_NAME
    failure = refused
    notes = found.notes
    written = [path]
    if refused is None:
        try:
            notes = (*notes, *write_joints(robot, *found.changes(), target))
            written = [target.path, path]
        except ExportError as error:
            failure = (
                f"{error} (the identified numbers are in {atomic_files.SERVO_NAME})"
            )
    found = replace(found, notes=notes)
    target.files.write(path, json_text(found.entries()))
    lines = (*servo_lines(found), f"Results saved to {folder_text(path.parent)}")
    score = found.rollout.score
    model = f"{target.path.name} in place of {robot.path}"
    times = "not known" if score is None else f"{score:.2g} times those before"
    use = f"Usable: position errors of the model, played on what was not fitted, are {times}"
    verdict = (
        two_lines(use, f"load {model}")
        if failure is None
        else (f"Not usable: {failure}",)
    )
    return Outcome(lines, verdict, failure, tuple(written), found)
