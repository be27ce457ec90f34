"""Several logs against each other: what each says alone, and how well the others predict it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from robot_sysid.errors import SysidError
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.identify.fit import MeasuredFit, fit_measured, validate_on
from robot_sysid.records import Measurement, RobotModel, Validation
from robot_sysid.records.progress import Progress

DISAGREE = 2.0
"""Scatter over stated errors beyond which logs do not agree."""

Pieces = Sequence[Measurement]


def compared(
    robot: RobotModel, logs: Mapping[str, Pieces], options: EstimationOptions, fit: MeasuredFit
) -> tuple[tuple[str, ...], tuple[Validation, ...]]:
    """Return (sentences on the logs' own masses and their scatter, one validation per log).

    In each validation one whole log is predicted by a fit to all others.

    Args:
        robot: the arm.
        logs: name to pieces of each log.
        options: of the joint fit.
        fit: of all logs together; its friction model and cut-off are kept.
    """
    if len(logs) < 2:
        return (), ()
    friction = None if options.no_friction else fit.friction.name
    same = replace(options, validate=0.0, friction_model=friction, cutoff=fit.cutoff)
    alone = {name: _fitted(robot, pieces, same) for name, pieces in logs.items()}
    tests = []
    for name, pieces in logs.items():
        rest = [piece for other in logs if other != name for piece in logs[other]]
        others = _fitted(robot, rest, same)
        if others is not None:
            source = f"{name}, predicted from the other logs"
            longest = max(pieces, key=len)
            tests.append(validate_on(robot, longest, same, others, source))
    return tuple(_sentences(alone)), tuple(tests)


def _fitted(robot: RobotModel, pieces: Pieces, options: EstimationOptions) -> MeasuredFit | None:
    """Return the fit of some logs, or None where they do not hold enough for one."""
    try:
        return fit_measured(robot, pieces, options, Progress())
    except SysidError:
        return None


def _sentences(alone: Mapping[str, MeasuredFit | None]) -> Iterator[str]:
    said, masses, errors = [], [], []
    for name, fit in alone.items():
        error = None if fit is None else fit.estimate.error("m")
        if fit is None or error is None or not np.isfinite(error) or error <= 0.0:
            said.append(f"{name} does not tell the mass")
            continue
        masses.append(fit.estimate.inertial.mass)
        errors.append(error)
        said.append(f"{name} {masses[-1]:.4g} \u00b1 {error:.2g} kg")
    yield f"mass of each log alone: {'; '.join(said)}"
    if len(masses) < 2:
        return
    weights = 1.0 / np.square(errors)
    mean = float(np.sum(weights * masses) / np.sum(weights))
    ratio = float(np.sqrt(np.sum(weights * (np.array(masses) - mean) ** 2) / (len(masses) - 1)))
    if ratio > DISAGREE:
        yield (
            f"the logs do not agree: their masses scatter by {ratio:.2g} times their stated "
            "errors; did the arm carry the same, and were all recorded in the same way?"
        )
    else:
        yield f"the logs agree: their masses scatter by {ratio:.2g} times their stated errors"
