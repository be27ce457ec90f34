"""Identifying from measured data: a simulated arm that plays the real one, or logs of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from operator import add
from pathlib import Path

import numpy as np

from robot_sysid.checks.run import look_at
from robot_sysid.dynamics.gravity import gravity
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.identify.adding.earlier import earlier_logs
from robot_sysid.identify.adding.log_information import (
    LogInformation,
    fit_from,
    log_information,
    settled_options,
)
from robot_sysid.identify.fit import MeasuredFit, fit_measured, validate_on
from robot_sysid.identify.judgement.per_log import compared
from robot_sysid.identify.judgement.rollout.link import LinkRollouts
from robot_sysid.identify.judgement.verdict import judged
from robot_sysid.identify.simulated import Analysis, SimulatedRun, describe
from robot_sysid.logs.options import LogOptions
from robot_sysid.logs.reader import (
    MeasurementLog,
    join_measurements,
    open_log,
    origin_of,
    write_measurement_csv,
)
from robot_sysid.records import DataOrigin, Measurement, RobotModel, Source, Validation
from robot_sysid.records.options import per_joint
from robot_sysid.records.progress import Progress
from robot_sysid.simulation.loading import load_plant
from robot_sysid.simulation.measurements import PlantSimulation
from robot_sysid.simulation.sensors import SimulatedArmOptions

_NOISE_STREAM = 1


@dataclass(frozen=True)
class MeasuredData:
    """What was measured.

    Attributes:
        logs: whole logs.
        origin: where they come from.
        notes: one sentence each.
        least_deadband: (n,) speeds below which a joint's friction is surely not Coulomb's
            [rad/s]; empty where nothing is known.
        named: file name to the pieces of its log.
    """

    logs: tuple[Measurement, ...]
    origin: DataOrigin
    notes: tuple[str, ...] = ()
    least_deadband: tuple[float, ...] = ()
    named: Mapping[str, tuple[Measurement, ...]] = field(default_factory=dict)


def identify_simulated_arm(
    robot: RobotModel,
    arm: SimulatedArmOptions,
    mesh_dir: Path | None,
    run: SimulatedRun,
    options: EstimationOptions,
    progress: Progress,
) -> Analysis:
    """Let another model play the real arm, and identify from what its sensors say."""
    assert arm.plant_model is not None
    _require_fitting(robot, options)
    plant = load_plant(robot, arm.plant_model, mesh_dir)
    progress.stage(f"Running MuJoCo simulation of {arm.plant_model}...")
    rng = np.random.default_rng([run.seed, _NOISE_STREAM])
    simulation = PlantSimulation(plant, run.plan, arm, run.sample_rate, rng)
    chunks = progress.track(iter(simulation), "Collecting measurements", run.n_chunks)
    measurement = join_measurements(chunks)
    least, ramp = _past_the_ramp(options, simulation)
    if run.save is not None:
        write_measurement_csv(run.save, robot.joint_names, [measurement], ramp)
    band = options.velocity_deadband
    advice = simulation.notes((least or None) if band is None else band)
    origin = run.origin(Source.SIMULATED_ARM, f"{arm.plant_model}, {arm.simulation}")
    data = MeasuredData((measurement,), origin, plant.notes + advice + ramp, least)
    analysis = _identify(robot, data, options, (), progress)
    return replace(analysis, traces=lambda: replace(analysis.traces(), truth=plant.prior))


def identify_logs(
    robot: RobotModel,
    options: LogOptions,
    save: Path | None,
    estimation: EstimationOptions,
    progress: Progress,
) -> Analysis:
    """Identify from one log of the real arm, or from several together.

    Args:
        robot: the arm.
        options: which logs, and what their columns are.
        save: file for the measurements of a single log, or None.
        estimation: how.
        progress: where to tell how far it is.
    """
    _require_fitting(robot, estimation)
    logs = []
    earlier = () if options.append is None else earlier_logs(options.append, robot)
    for path in (*earlier, *options.measurements):
        progress.stage(f"Reading measurements from {path}...")
        logs.append(open_log(robot, path, options, progress))
    if save is not None:
        write_measurement_csv(save, robot.joint_names, [logs[0].samples])
    measured = tuple(piece for log in logs for piece in log.pieces)
    tests = []
    if options.validation_measurements is not None:
        tests.append(open_log(robot, options.validation_measurements, options, progress))
        for note in tests[0].notes:
            progress.note(f"validation log: {note}")
    _check(robot, options, estimation, [*logs, *tests], progress)
    named = {str(log.path): log.pieces for log in logs}
    data = MeasuredData(measured, origin_of(logs), _log_notes(logs), named=named)
    analysis = _identify(robot, data, estimation, tests, progress)
    others = tuple(piece for log in tests for piece in log.pieces)
    return replace(analysis, rollouts=LinkRollouts(robot, measured, others, estimation))


def read_information(
    robot: RobotModel,
    options: LogOptions,
    estimation: EstimationOptions,
    around: LogInformation | None,
    progress: Progress,
) -> LogInformation:
    """Return what logs say of the link, each read and looked at as by ``identify_logs``.

    Args:
        robot: the arm.
        options: which logs, and what their columns are.
        estimation: how they will be fitted.
        around: see ``log_information``.
        progress: where to tell what was noticed.
    """
    _require_fitting(robot, estimation)
    chosen, found = settled_options(estimation), []
    for path in options.measurements:
        log = open_log(robot, path, options, progress)
        _check(robot, options, chosen, [log], progress)
        found.append(log_information(robot, log.pieces, chosen, around, log.notes))
    return reduce(add, found)


def identify_information(
    robot: RobotModel, found: LogInformation, validation: LogInformation | None, progress: Progress
) -> Analysis:
    """Identify from the sum of what logs say."""
    fit = fit_from(robot, found, validation)
    for note in fit.notes:
        progress.note(note)
    return analysed(robot, found.origin, found.settled.estimation, fit, fit.notes)


def _require_fitting(robot: RobotModel, options: EstimationOptions) -> None:
    """Refuse a list that does not fit the joints before any work."""
    if options.velocity_deadband is not None:
        per_joint(options.velocity_deadband, robot.n_joints, "--velocity-deadband")


def _check(
    robot: RobotModel,
    options: LogOptions,
    estimation: EstimationOptions,
    logs: Sequence[MeasurementLog],
    progress: Progress,
) -> None:
    """Look at each log against the model; stop at what must not become a number."""
    accepted = (*options.accept, *(("delay",) if estimation.delay == "auto" else ()))
    for log in logs:
        look_at(robot, log, accepted, progress, estimation.cutoff)


def _log_notes(logs: Sequence[MeasurementLog]) -> tuple[str, ...]:
    if len(logs) == 1:
        return logs[0].notes
    return tuple(f"{log.path.name}: {note}" for log in logs for note in log.notes)


def _identify(
    robot: RobotModel,
    data: MeasuredData,
    options: EstimationOptions,
    tests: Sequence[MeasurementLog],
    progress: Progress,
) -> Analysis:
    """Identify from measured data, wherever it came from."""
    for note in data.notes:
        progress.note(note)
    fit = fit_measured(robot, data.logs, options, progress, data.least_deadband)
    others = [validate_on(robot, log.samples, options, fit, str(log.path)) for log in tests]
    notes, apart = compared(robot, data.named, options, fit)
    for note in (*fit.notes, *notes):
        progress.note(note)
    aside = (*others, *apart)
    return analysed(robot, data.origin, options, fit, data.notes + fit.notes + notes, aside)


def analysed(
    robot: RobotModel,
    origin: DataOrigin,
    options: EstimationOptions,
    fit: MeasuredFit,
    notes: tuple[str, ...],
    validation: tuple[Validation, ...] = (),
) -> Analysis:
    """Return a fit with all that is said of it.

    Args:
        robot: the arm.
        origin: where the data comes from.
        options: how it was fitted.
        fit: the fit.
        notes: one sentence each.
        validation: on other logs than the fitted ones.
    """
    own = () if fit.validation is None else (fit.validation,)
    aligned = _alignment(robot, options, fit)
    found = describe(
        robot,
        fit.estimate,
        options.torques,
        origin,
        notes,
        validation=(*own, *validation),
        friction_model=fit.friction.name,
        cutoff=fit.cutoff,
        misfits=fit.misfits,
        **aligned,
    )
    final = judged(found, robot, fit.torque, fit.acceleration_error)
    return Analysis(final, fit.checkpoints, fit.traces)


def _alignment(
    robot: RobotModel, options: EstimationOptions, fit: MeasuredFit
) -> dict[str, object]:
    """Return what was estimated of delay and tilt, as fields of ``Identification``."""
    found: dict[str, object] = {}
    if options.delay == "auto":
        found["delay"] = fit.alignment.delay
    if options.tilt == "auto":
        found["tilt"] = fit.alignment.tilt_from(gravity(robot))
        found["gravity"] = fit.alignment.gravity
    return found


def _past_the_ramp(
    options: EstimationOptions, simulation: PlantSimulation
) -> tuple[tuple[float, ...], tuple[str, ...]]:
    """Return what must be left out of MuJoCo's dry friction, a ramp near standstill.

    Returns:
        (speeds (n,) below which it is incomplete, a sentence on them); both empty where there is
        nothing to leave out.
    """
    # A little above the ramp, so that three digits say all.
    speeds = tuple(float(f"{1.005 * speed:.3g}") for speed in simulation.least_deadband())
    if not any(speeds) or options.velocity_deadband is not None:
        return (), ()
    listed = ",".join(f"{speed:g}" for speed in speeds)
    note = (
        "MuJoCo's dry friction builds up over a range of speeds; moments in which a joint is still "
        f"in that range are left out. With the saved log --velocity-deadband {listed} does the same"
    )
    return speeds, (note,)
