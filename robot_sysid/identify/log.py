"""Identifying from measured data: a simulated plant, or a log of the real arm."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from robot_sysid.config import SysidConfig
from robot_sysid.dynamics.friction import DEFAULT_MEASURED
from robot_sysid.dynamics.gravity import gravity
from robot_sysid.identify.fit import MeasuredFit, MeasuredOptions, identify_measured, validate_on
from robot_sysid.identify.simulated import Analysis, describe
from robot_sysid.logs.reader import (
    MeasurementLog,
    join_measurements,
    read_measurements,
    write_measurement_csv,
)
from robot_sysid.output.summary import limitations
from robot_sysid.records import (
    Measurement,
    MotionPlan,
    RobotModel,
    Validation,
)
from robot_sysid.records.progress import Progress
from robot_sysid.simulation.loading import load_plant
from robot_sysid.simulation.measurements import PlantOptions, PlantSimulation, simulate_plant
from robot_sysid.trajectory import CHUNK, sample_count

_NOISE_STREAM = 1


def analyse_plant(
    config: SysidConfig, robot: RobotModel, plan: MotionPlan, seed: int, progress: Progress
) -> Analysis:
    """Let another model play the real arm, and identify from what its sensors say."""
    assert config.plant_model is not None
    plant = load_plant(robot, config.plant_model, config.mesh_dir, config.max_velocity)
    progress.stage(f"Running MuJoCo simulation of {config.plant_model}...")
    options = PlantOptions(config.simulation, config.sample_rate, config.sensors)
    rng = np.random.default_rng([seed, _NOISE_STREAM])
    simulation = simulate_plant(plant, plan, options, rng)
    count = math.ceil(sample_count(plan.duration, config.sample_rate) / CHUNK)
    chunks = progress.track(iter(simulation), "Collecting measurements", count)
    measurement = join_measurements(chunks)
    config, ramp = _past_the_ramp(config, simulation)
    if config.save_measurements is not None:
        write_measurement_csv(config.save_measurements, robot.joint_names, [measurement], ramp)
    deadband = config.signals.velocity_deadband
    advice = simulation.notes(config.signals.least_deadband if deadband is None else deadband)
    notes = plant.notes + advice + ramp
    source = f"simulated plant {config.plant_model}, {config.simulation}"
    analysis = _analyse(config, robot, measurement, source, notes, progress)
    return replace(analysis, identification=replace(analysis.identification, seed=seed))


def analyse_log(config: SysidConfig, robot: RobotModel, progress: Progress) -> Analysis:
    """Identify from a log of the real arm."""
    assert config.measurements is not None
    progress.stage(f"Reading measurements from {config.measurements}...")
    log = _read_log(config, robot, config.measurements)
    if config.save_measurements is not None:
        write_measurement_csv(config.save_measurements, robot.joint_names, log.chunks())
    source = f"log {config.measurements}"
    return _analyse(config, robot, log.load(), source, log.notes, progress)


def _read_log(config: SysidConfig, robot: RobotModel, path: Path) -> MeasurementLog:
    """Open a log of this arm with the columns and units that were declared."""
    return read_measurements(
        path,
        robot.joint_names,
        robot.limits,
        config.columns,
        config.units,
        robot.is_slide.tolist(),
    )


def _analyse(
    config: SysidConfig,
    robot: RobotModel,
    measurement: Measurement,
    source: str,
    notes: tuple[str, ...],
    progress: Progress,
) -> Analysis:
    """Identify from a whole log, wherever it came from."""
    for note in notes:
        progress.note(note)
    options = measured_options(config)
    fit = identify_measured(robot, measurement, options, progress)
    validation = _validations(config, robot, options, fit, progress)
    duration = float(measurement.time[-1] - measurement.time[0])
    rate = (len(measurement) - 1) / duration
    found = describe(config, robot, fit.estimate, duration, rate)
    tilted = fit.alignment.tilt_from(gravity(robot))
    found = replace(
        found,
        source=source,
        validation=validation,
        friction_model=fit.friction.name,
        delay=fit.alignment.delay if config.estimate_delay else None,
        tilt=tilted if config.estimate_tilt else None,
        gravity=fit.alignment.gravity if config.estimate_tilt else None,
        cutoff=fit.cutoff,
        sensitivity=fit.sensitivity,
        notes=robot.notes + notes + fit.notes,
    )
    found = replace(found, limitations=limitations(found))
    for note in fit.notes:
        progress.note(note)
    return Analysis(found, fit.checkpoints)


def measured_options(config: SysidConfig) -> MeasuredOptions:
    """Return how a log is analysed."""
    friction = config.friction_model or DEFAULT_MEASURED
    return MeasuredOptions(
        torques=config.torques,
        friction=friction if config.friction else "none",
        method=config.estimation_method,
        estimator=config.estimator,
        signals=config.signals,
        estimate_delay=config.estimate_delay,
        estimate_tilt=config.estimate_tilt,
        held_out=config.validate,
    )


def _validations(
    config: SysidConfig,
    robot: RobotModel,
    options: MeasuredOptions,
    fit: MeasuredFit,
    progress: Progress,
) -> tuple[Validation, ...]:
    own = () if fit.validation is None else (fit.validation,)
    if config.validation_measurements is None:
        return own
    log = _read_log(config, robot, config.validation_measurements)
    for note in log.notes:
        progress.note(f"validation log: {note}")
    name = str(config.validation_measurements)
    return (*own, validate_on(robot, log.load(), options, fit, name))


def _past_the_ramp(
    config: SysidConfig, simulation: PlantSimulation
) -> tuple[SysidConfig, tuple[str, ...]]:
    """Leave out what MuJoCo's dry friction, a ramp near standstill, would falsify.

    Returns:
        (the configuration with it, a sentence on it where it does anything).
    """
    # A little above the ramp, so that three digits say all.
    speeds = tuple(float(f"{1.005 * speed:.3g}") for speed in simulation.least_deadband())
    if not any(speeds) or config.signals.velocity_deadband is not None:
        return config, ()
    listed = ",".join(f"{speed:g}" for speed in speeds)
    note = (
        "MuJoCo's dry friction builds up over a range of speeds; moments in which a joint is still "
        f"in that range are left out. With the saved log --velocity-deadband {listed} does the same"
    )
    return replace(config, signals=replace(config.signals, least_deadband=speeds)), (note,)
