"""The stages of ``robot-sysid payload`` in order: load, record, identify, write."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from robot_sysid.errors import ExportError, InputError
from robot_sysid.excitation.plan import MotionRequest, make_plan
from robot_sysid.export import alone_in, left_over
from robot_sysid.identify.payload.data.processing import Processed, filtered, resting
from robot_sysid.identify.payload.data.recordings import (
    RawRecording,
    drift_shows,
    places,
    read_recordings,
    simulate_recordings,
)
from robot_sysid.identify.payload.run import identify_payload
from robot_sysid.model.flange import find_flange
from robot_sysid.output.cards import Card, card_text, load_errors, payload_cards
from robot_sysid.output.model_writing import ModelTarget, write_payload
from robot_sysid.output.payload_json import payload_json_text
from robot_sysid.output.printed.link import folder_text
from robot_sysid.output.printed.payload import payload_lines
from robot_sysid.parser import load_robot_model
from robot_sysid.payload_config import CARD_NAME, PayloadConfig
from robot_sysid.records import Motion, RobotModel
from robot_sysid.records.atomic_files import whole_files
from robot_sysid.records.payload import PayloadIdentification
from robot_sysid.records.progress import Progress
from robot_sysid.records.results import MODEL_NAMES, PARAMS_NAME
from robot_sysid.records.torque_scale import write_torque_scale
from robot_sysid.records.traces import Traces
from robot_sysid.report.runs import fingerprint


@dataclass(frozen=True)
class PayloadOutcome:
    """What a payload identification produced.

    Attributes:
        found: the result.
        output_dir: where files went.
        files: what was written there.
        failure: why there is no model and no card, or None.
        traces: makes what a report draws.
        result: hash of the JSON file, taken before another run may write to the folder.
    """

    found: PayloadIdentification
    output_dir: Path
    files: tuple[Path, ...]
    failure: str | None
    traces: Callable[[], Traces] | None = None
    result: str = ""

    def report_lines(self, verbose: bool) -> list[str]:
        """Return what the command line prints at the end."""
        saved = f"Results saved to {folder_text(self.output_dir)}"
        return [*payload_lines(self.found, verbose), saved]


def run(config: PayloadConfig, progress: Progress | None = None) -> PayloadOutcome:
    """Identify a payload and write it.

    Args:
        config: what to do.
        progress: where to tell how far it is; None stays silent.

    Raises:
        SysidError: with the exit code that fits, see ``errors``.
    """
    progress = progress or Progress()
    with alone_in(config.output.output_dir, progress):
        return _run(config, progress)


def _run(config: PayloadConfig, progress: Progress) -> PayloadOutcome:
    robot = load(config, progress)
    found, motion, traces = weighed(config, robot, progress)
    return replace(written(config, robot, found, motion, progress), traces=traces)


def weighed(
    config: PayloadConfig, robot: RobotModel, progress: Progress
) -> tuple[PayloadIdentification, Motion, Callable[[], Traces]]:
    """Identify a payload and write nothing; returns (result, some of the motion, its traces)."""
    flange = find_flange(robot, config.payload.flange)
    if flange.note:
        progress.note(flange.note)
    processed, drifts = _recordings(config, robot, progress)
    found, traces = identify_payload(
        robot, processed, drifts, flange, config.payload, config.estimation, progress
    )
    for note in found.notes[len(robot.notes) :]:
        progress.note(note)
    return found, processed.motion, traces


def load(config: PayloadConfig, progress: Progress) -> RobotModel:
    """Load the model and find its terminal joint."""
    model, speed = config.model, config.limits.max_velocity
    progress.stage(f"Loading robot model from {model.path}...")
    robot = load_robot_model(model.path, model.mesh_dir, model.joint, speed, model.keyframe)
    progress.stage(f"Identified terminal joint: {robot.terminal_joint}")
    for note in robot.notes:
        progress.note(note)
    return robot


def _recordings(
    config: PayloadConfig, robot: RobotModel, progress: Progress
) -> tuple[Processed, bool]:
    """Return the recordings and whether a drift of friction shows in their order."""
    options = config.payload
    if options.empty:
        raw = read_recordings(robot, options, config.log, progress)
        at = places(raw, options.order)
    else:
        raw = _simulated(config, robot, progress)
        at = places(raw, "ABBA")
    if options.static:
        found, drifts = resting(robot, raw, at), False
    else:
        found = filtered(robot, raw, at, config.estimation)
        drifts = at is not None and drift_shows(raw, at)
    for note in found.notes:
        progress.note(note)
    if not drifts and not options.static:
        progress.note(_no_drift(raw, at is not None))
    return found, drifts


def _no_drift(raw: Sequence[RawRecording], known: bool) -> str:
    order = (
        "their order does not tell it from the payload"
        if known
        else "the order in which they were recorded is not known (--order ABBA tells it)"
    )
    return (
        f"a drift of friction over the {len(raw)} logs is not estimated: {order}; record in the "
        "order empty, loaded, loaded, empty"
    )


def _simulated(config: PayloadConfig, robot: RobotModel, progress: Progress) -> list[RawRecording]:
    chosen, rate = config.trajectory.seed, config.trajectory.sample_rate
    seed = secrets.randbelow(2**31) if chosen is None else chosen
    request = MotionRequest(config.trajectory, config.excitation, config.limits)
    checked = make_plan(request, robot, seed, progress)
    if checked.failure:
        raise InputError(f"{checked.failure}; relax that limit, or try another --seed")
    return simulate_recordings(
        robot, config.payload, config.arm, checked.plan, rate, seed, progress
    )


def written(
    config: PayloadConfig,
    robot: RobotModel,
    found: PayloadIdentification,
    checkpoints: Motion,
    progress: Progress,
) -> PayloadOutcome:
    """Write params.json, and model and card where the result may be used."""
    folder, options = config.output.output_dir, config.payload
    failure = _refusal(found)
    names: list[str] = []
    notes: tuple[str, ...] = ()
    cards: tuple[Card, ...] = ()
    with whole_files() as files:
        if failure is None and options.known_mass is None:
            path = files.reserve_last(folder / MODEL_NAMES[robot.kind])
            target = ModelTarget(files, path, checkpoints, found.rmse, config.model.mesh_dir)
            try:
                notes = _write_model(robot, found, target, options.as_body)
                names.append(path.name)
            except ExportError as error:
                failure = f"{error} (the identified numbers are in {PARAMS_NAME})"
            cards = _cards(found)
            files.write(folder / CARD_NAME, card_text(cards, _heading(found)))
            names.append(CARD_NAME)
        names.append(PARAMS_NAME)
        files.write(folder / PARAMS_NAME, payload_json_text(found, cards, notes))
    if options.save_torque_scale is not None and failure is None:
        scales = {joint: scale for joint, (scale, _) in found.torque_scale.items()}
        write_torque_scale(options.save_torque_scale, scales)
    paths = tuple(folder / name for name in names)
    for note in (*notes, *left_over(folder, (MODEL_NAMES[robot.kind], CARD_NAME), paths)):
        progress.note(note)
    result = fingerprint(folder / PARAMS_NAME)
    return PayloadOutcome(found, folder, paths, failure, result=result)


def _refusal(found: PayloadIdentification) -> str | None:
    """Return why nothing may be used, or None."""
    if found.status.is_trustworthy:
        return None
    what = "no torque scales" if found.known_mass is not None else "no model and no card"
    return "; ".join((f"{what} were written: {found.status.value}", *found.reasons))


def _write_model(
    robot: RobotModel, found: PayloadIdentification, target: ModelTarget, as_body: str | None
) -> tuple[str, ...]:
    payload, link = found.payload.inertial, found.link.inertial
    return write_payload(robot, payload, found.flange, target, link, as_body, found.total.errors)


def _cards(found: PayloadIdentification) -> tuple[Card, ...]:
    payload = found.payload
    return payload_cards(
        payload.inertial, found.flange, load_errors(payload.inertial, payload.covariance)
    )


def _heading(found: PayloadIdentification) -> list[str]:
    errors = load_errors(found.payload.inertial, found.payload.covariance)
    return [
        f"Payload of {found.payload.inertial.mass:.4f} ± {errors['mass']:.2g} kg, identified with "
        f"{found.model_path.name} from {len(found.recordings['empty'])} empty and "
        f"{len(found.recordings['loaded'])} loaded recordings."
    ]
