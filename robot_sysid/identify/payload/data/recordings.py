"""Recordings without and with the payload: read from logs, or simulated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.checks.run import look_at
from robot_sysid.identify.payload.options import LOADED, PayloadOptions
from robot_sysid.logs.options import LogOptions
from robot_sysid.logs.reader import join_measurements, open_log
from robot_sysid.records import Array, Measurement, MotionPlan, RobotModel
from robot_sysid.records.progress import Progress
from robot_sysid.simulation.loading import load_plant
from robot_sysid.simulation.measurements import PlantSimulation
from robot_sysid.simulation.sensors import SimulatedArmOptions

SIMULATED_ORDER = "ABBA"
_NOISE_STREAM = 1
LEAST_WITHIN = 0.15
"""Share of the spread of places within one kind of recording below which a drift and the payload
cannot be told apart: nothing for A B, 1 for A B B A."""


@dataclass(frozen=True)
class RawRecording:
    """A log as it was read or simulated.

    Attributes:
        name: what it is called in messages.
        is_loaded: whether the payload was on the arm.
        samples: the log.
        pieces: it, cut at long holes.
        least_deadband: (n,) see ``signals.process.process``.
        notes: what reading it had to say, one sentence each.
    """

    name: str
    is_loaded: bool
    samples: Measurement
    pieces: tuple[Measurement, ...]
    least_deadband: tuple[float, ...] = ()
    notes: tuple[str, ...] = ()


def read_recordings(
    robot: RobotModel, options: PayloadOptions, logs: LogOptions, progress: Progress
) -> list[RawRecording]:
    """Read all logs, empty ones first."""
    kinds = [(path, False) for path in options.empty] + [(path, True) for path in options.loaded]
    found = []
    for path, is_loaded in kinds:
        progress.stage(f"Reading {'loaded' if is_loaded else 'empty'} log {path}...")
        log = open_log(robot, path, logs, progress)
        if not options.static:  # an arm at rest shows none of what is looked for
            look_at(robot, log, logs.accept, progress, links_known=False)
        found.append(RawRecording(str(path), is_loaded, log.samples, log.pieces, notes=log.notes))
    return found


def simulate_recordings(
    robot: RobotModel,
    options: PayloadOptions,
    arm: SimulatedArmOptions,
    plan: MotionPlan,
    rate: float,
    seed: int,
    progress: Progress,
) -> list[RawRecording]:
    """Let two models play the arm without and with the payload, in the order ABBA."""
    assert options.empty_model is not None and options.loaded_model is not None
    found = []
    for number, letter in enumerate(SIMULATED_ORDER):
        is_loaded = letter == LOADED
        path = options.loaded_model if is_loaded else options.empty_model
        progress.stage(f"Running MuJoCo simulation of {path}...")
        plant = load_plant(robot, path)
        rng = np.random.default_rng([seed, _NOISE_STREAM, number])
        simulation = PlantSimulation(plant, plan, arm, rate, rng)
        samples = join_measurements(simulation)
        least = tuple(1.005 * speed for speed in simulation.least_deadband())
        found.append(RawRecording(f"{path} ({number + 1})", is_loaded, samples, (samples,), least))
    return sorted(found, key=lambda each: each.is_loaded)


def places(recordings: Sequence[RawRecording], order: str | None) -> Array | None:
    """Return each recording's place (k,) from -1, the first, to 1, the last.

    Args:
        recordings: empty ones first.
        order: letters of ``--order``; None goes by the logs' clocks where they share one.

    Returns:
        None where the order is not known.
    """
    if order is not None:
        kinds = [letter == LOADED for letter in order]
        turns = {kind: iter(np.flatnonzero(np.equal(kinds, kind))) for kind in (False, True)}
        return _scaled(np.array([float(next(turns[each.is_loaded])) for each in recordings]))
    spans = sorted((float(r.samples.time[0]), float(r.samples.time[-1])) for r in recordings)
    if any(after[0] <= before[1] for before, after in zip(spans, spans[1:])):
        return None
    return _scaled(np.array([np.mean(r.samples.time[[0, -1]]) for r in recordings]))


def drift_shows(recordings: Sequence[RawRecording], at: Array) -> bool:
    """Tell whether the order lets a drift be told from the payload."""
    kinds = np.array([each.is_loaded for each in recordings])
    within = sum(np.sum((at[kinds == kind] - np.mean(at[kinds == kind])) ** 2) for kind in (0, 1))
    return bool(within >= LEAST_WITHIN * np.sum((at - np.mean(at)) ** 2) > 0.0)


def _scaled(at: Array) -> Array:
    low, high = float(np.min(at)), float(np.max(at))
    return 2.0 * (at - low) / (high - low) - 1.0 if high > low else 0.0 * at
