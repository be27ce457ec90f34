"""From recordings to a payload with its errors and a verdict."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from robot_sysid.dynamics.friction import friction_model
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.identify.payload.bodies import possible_values, with_ball
from robot_sysid.identify.payload.checks.held_out import choose_terms, with_root
from robot_sysid.identify.payload.checks.judge import of_known_mass
from robot_sysid.identify.payload.checks.scatter import disagreements
from robot_sysid.identify.payload.data.processing import Processed
from robot_sysid.identify.payload.equations import Recording
from robot_sysid.identify.payload.joint_fit import JointFit, Task, fit_jointly
from robot_sysid.identify.payload.options import PayloadOptions
from robot_sysid.identify.payload.result import Result
from robot_sysid.identify.simulated import versions
from robot_sysid.records import Array, Flange, RobotModel
from robot_sysid.records.payload import OneRecording, PayloadIdentification, PayloadStatus
from robot_sysid.records.progress import Progress
from robot_sysid.records.traces import Traces

TERMS = "coulomb-viscous-offset-armature-load"
"""Friction of every joint, where the user does not say otherwise."""
CLEARLY_WIDER = 2.0
"""Factor beyond which a prior that had to be widened is told of."""
SCALE_PRIOR = 3.0
"""How far torque scales may be off where a known mass is to tell them [%]."""
AT_REST = "offset"
"""What is left of it at rest, approached from both sides."""


def identify_payload(
    robot: RobotModel,
    processed: Processed,
    drifts: bool,
    flange: Flange,
    options: PayloadOptions,
    estimation: EstimationOptions,
    progress: Progress,
) -> tuple[PayloadIdentification, Callable[[], Traces]]:
    """Identify a payload from recordings without and with it.

    Returns:
        (the result, what makes the traces that a report draws).

    Args:
        robot: the arm as its model describes it.
        processed: all recordings.
        drifts: whether their order lets a drift of friction be estimated.
        flange: frame in which the payload is wanted.
        options: what is known of the payload.
        estimation: how far nuisances may be off.
        progress: where to tell how far it is.
    """
    progress.stage("Estimating arm, friction and payload together...")
    given = AT_REST if options.static else estimation.friction_model
    task = Task(robot, friction_model(given or TERMS), drifts, estimation)
    recordings, mass = processed.recordings, options.known_mass
    fit, notes = _fitted(task, recordings, given is None)
    progress.stage("Finding out how far off it may be...")
    result = Result(fit, flange, recordings)
    status, reasons = result.verdict(robot)
    if mass is not None:
        status, reasons = of_known_mass(status, result.free, mass)
        scaled = replace(task, friction=fit.equations.friction, known_mass=mass)
        scaled = replace(scaled, scale_prior=options.scale_prior or SCALE_PRIOR)
        result = Result(fit_jointly(scaled, recordings), flange, recordings)
    else:
        notes = (*notes, *_disagreeing(result.scatter, result.free.inertial.mass))
    values = result.fit.values
    if status is PayloadStatus.OK:
        values = possible_values(with_ball(result.fit) if options.static else result.fit)
    found = _described(robot, processed, result, values, mass)
    notes = (*notes, *_wide(result.fit))
    found = replace(found, status=status, reasons=reasons, notes=(*robot.notes, *notes))
    return found, lambda: result.fit.traces(robot, recordings)


def _described(
    robot: RobotModel, processed: Processed, result: Result, values: Array, mass: float | None
) -> PayloadIdentification:
    """Return the result with all that it says but the verdict.

    Args:
        robot: the arm.
        processed: all recordings.
        result: of them.
        values: (p,) the estimate with possible bodies.
        mass: of the payload [kg], where it was known.
    """
    return PayloadIdentification(
        model_path=robot.path,
        model_sha256=robot.sha256,
        joint_name=robot.terminal_joint,
        body_name=robot.body_name,
        joint_names=robot.joint_names,
        flange=result.flange,
        payload=result.payload(values),
        link=result.link(values),
        total=result.total(values),
        recordings=_names(processed.recordings),
        scatter=result.scatter if mass is None else (),
        status=PayloadStatus.OK,
        reasons=(),
        validation=result.validation,
        friction_model=result.fit.equations.friction.name,
        parameters=result.parameters(),
        torque_scale={} if mass is None else result.torque_scale(),
        known_mass=mass,
        rmse=result.rmse,
        duration=sum(each.source.duration for each in processed.recordings),
        cutoff=processed.cutoff,
        versions=versions(),
    )


def _fitted(
    task: Task, recordings: Sequence[Recording], choose: bool
) -> tuple[JointFit, tuple[str, ...]]:
    """Return the fit with the friction terms that predict best, and a sentence on them."""
    fit = fit_jointly(task, recordings)
    if not choose:
        return fit, ()
    choice = choose_terms(task, recordings, fit)
    if choice.name == "without":
        return fit, ()
    richer = replace(task, friction=with_root(task.friction))
    return fit_jointly(richer, recordings), (f"friction with the root of speed: {choice.note}",)


def _wide(fit: JointFit) -> tuple[str, ...]:
    """Return a sentence per cause that the recordings ask clearly more of than was said."""
    return tuple(
        f"the recordings ask for errors by {group.cause} {group.widened:.1f} times as large as was "
        "thought; those that are printed allow for it"
        for group in fit.widened
        if group.widened > CLEARLY_WIDER
    )


def _disagreeing(scatter: Sequence[OneRecording], mass: float) -> tuple[str, ...]:
    return tuple(
        f"{one.name} alone says {one.mass:.4g} ± {one.noise_error:.2g} kg (noise alone), all "
        f"recordings together say {mass:.4g} kg: more apart than noise explains"
        for one in disagreements(scatter, mass)
    )


def _names(recordings: Sequence[Recording]) -> Mapping[str, tuple[str, ...]]:
    return {
        kind: tuple(each.name for each in recordings if each.is_loaded is loaded)
        for kind, loaded in (("empty", False), ("loaded", True))
    }
