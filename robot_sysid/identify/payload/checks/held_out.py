"""How well stretches of the recordings are predicted from the rest, and with which friction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robot_sysid.dynamics.friction import FrictionModel
from robot_sysid.estimation.cross_validation import ModelChoice, blocks, choose_model, validate
from robot_sysid.estimation.information import combined, restricted
from robot_sysid.estimation.least_squares import least_squares
from robot_sysid.estimation.nuisances import with_prior
from robot_sysid.identify.payload.equations import PayloadEquations, Recording
from robot_sysid.identify.payload.joint_fit import JointFit, Task
from robot_sysid.identify.samples import DecimatedSamples
from robot_sysid.records import Array, SquareRootInformation, Validation

FOLDS = 5
"""Into how many stretches of time each recording is cut."""
ROOT = "sqrt"
"""The friction term that has to earn its place."""


def folds(samples: Sequence[DecimatedSamples]) -> list[list[DecimatedSamples]]:
    """Return per fold the samples of each recording that belong to it.

    Only rows in use count, so that no fold is a standstill.
    """
    parts: list[list[DecimatedSamples]] = [[] for _ in range(FOLDS)]
    for recording in samples:
        moving = np.flatnonzero(np.any([np.isfinite(tau) for tau in recording.tau], axis=0))
        for fold, block in zip(parts, blocks(len(moving), FOLDS)):
            used = np.zeros(len(recording), dtype=bool)
            used[moving[block]] = True
            fold.append(recording.where(used))
    return parts


def choose_terms(task: Task, recordings: Sequence[Recording], fit: JointFit) -> ModelChoice:
    """Tell whether the square-root term of friction predicts better than none.

    Args:
        task: without the term.
        recordings: all of them.
        fit: without the term.
    """
    richer = PayloadEquations(task.robot, with_root(task.friction), task.drifts)
    known = dict(zip(fit.equations.names, fit.values))
    values = np.array([known.get(name, 0.0) for name in richer.names])
    every = [
        combined([part.information() for part in fold])
        for fold in folds([richer.samples(recording, values) for recording in recordings])
    ]
    candidates = {"with": richer.names, "without": fit.equations.names}
    parts = {key: [restricted(each, names) for each in every] for key, names in candidates.items()}
    weights = 1.0 / fit.weighted.noise

    def solve(information: SquareRootInformation) -> Array:
        known = with_prior(information, fit.groups)
        return least_squares(known, np.zeros(len(information.names)), weights)

    return choose_model(parts, solve)


def with_root(friction: FrictionModel) -> FrictionModel:
    """Return the friction terms with that of the square root of speed."""
    return FrictionModel((*friction.terms, ROOT))


def held_out_error(fit: JointFit) -> Validation:
    """Return the error with which each fifth of the recordings is predicted from the others."""
    parts = folds(fit.samples)
    every = [combined([part.information() for part in fold]) for fold in parts]
    weights = 1.0 / fit.weighted.noise
    found = []
    for held, fold in enumerate(parts):
        others = combined([each for k, each in enumerate(every) if k != held])
        values = least_squares(with_prior(others, fit.groups), fit.equations.prior, weights)
        torque = np.sum([part.squared_torque() for part in fold], axis=0)
        found.append(validate(every[held], values, f"fold {held + 1}", torque))
    return _pooled(found)


def _pooled(parts: Sequence[Validation]) -> Validation:
    """Return the errors of all parts together, each counted by its samples."""
    counts = np.array([part.n_samples for part in parts], dtype=float)

    def together(values: Sequence[float | None]) -> float:
        known = np.array([0.0 if value is None else value for value in values])
        return float(np.sqrt(np.sum(counts * known**2) / np.sum(counts)))

    joints = parts[0].rmse_per_joint
    return Validation(
        "each fifth of the recordings, predicted from the other four",
        int(np.sum(counts)),
        together([part.rmse for part in parts]),
        together([part.relative_error for part in parts]),
        {joint: together([part.rmse_per_joint[joint] for part in parts]) for joint in joints},
        {
            joint: together([part.relative_error_per_joint[joint] for part in parts])
            for joint in joints
        },
    )
