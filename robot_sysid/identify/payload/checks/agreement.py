"""Do recordings of one kind carry the same mass? Asked without trusting their kinds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robot_sysid.dynamics.equations import N_INERTIAL
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimation.identifiability import visible_space
from robot_sysid.estimation.information import combined, restricted
from robot_sysid.estimation.least_squares import least_squares, weighted
from robot_sysid.estimation.nuisances import with_prior
from robot_sysid.identify.payload.equations import PAYLOAD_NAMES, Recording
from robot_sysid.identify.payload.joint_fit import JointFit
from robot_sysid.identify.payload.nuisances import WEIGHT
from robot_sysid.identify.samples import DecimatedSamples
from robot_sysid.records import Array

LEAST_MISFIT = 0.1
"""Share of the payload by which recordings of one kind differ at least where that is refused."""
SURE = 4.0
"""Standard errors by which they differ at least then."""


def contradictions(fit: JointFit, recordings: Sequence[Recording]) -> tuple[tuple[str, float], ...]:
    """Return (name, mass on the arm) of all recordings where those of one kind are not alike.

    A fit to recordings on the wrong side has scaled torques to explain them; the masses are then
    taken around the model's values instead.
    """
    if not misfits(recordings, *masses_apart(fit, fit.samples)):
        return ()
    prior = fit.equations.prior
    anew = [fit.equations.samples(recording, prior) for recording in recordings]
    return misfits(recordings, *masses_apart(fit, anew))


def masses_apart(fit: JointFit, samples: Sequence[DecimatedSamples]) -> tuple[Array, Array]:
    """Return (masses (k,), standard errors (k,)) on the arm, each recording with its own.

    The first recording is the reference: its mass is zero and so is its error. Nothing is taken
    from what a recording was said to be.
    """
    first, *others = samples
    names = [f"{name}({k})" for k in range(len(others)) for name in PARAMETER_NAMES]
    numbered = [(first, None), *((part, k) for k, part in enumerate(others))]
    parts = [
        part.with_columns(names, _own_columns(part, k, len(others))).information()
        for part, k in numbered
    ]
    information = combined(parts)
    kept = [name for name in information.names if name not in PAYLOAD_NAMES]
    # Recordings on the wrong side widen priors that have nothing to do with it.
    priors = [replace(group, widened=1.0) for group in fit.groups if group.cause != WEIGHT]
    known = with_prior(restricted(information, kept), priors)
    prior = np.zeros(len(known.names))
    found = weighted(known, prior)
    space = visible_space(found.whitened()[0])
    values = least_squares(known, prior, 1.0 / found.noise)
    places = [known.names.index(f"m({k})") for k in range(len(others))]
    errors = np.sqrt(np.diag(space.inverse())[places])
    return np.append(0.0, values[places]), np.append(0.0, errors)


def _own_columns(part: DecimatedSamples, number: int | None, count: int) -> list[Array]:
    """Return per joint (K, 10 count) the terminal link's columns again, in one place of many."""
    blocks = []
    for rows in part.rows:
        block = np.zeros((len(rows), N_INERTIAL * count))
        if number is not None:
            block[:, N_INERTIAL * number : N_INERTIAL * (number + 1)] = rows[:, :N_INERTIAL]
        blocks.append(block)
    return blocks


def misfits(
    recordings: Sequence[Recording], masses: Array, errors: Array
) -> tuple[tuple[str, float], ...]:
    """Return (name, mass) of all recordings where those of one kind are not alike, else nothing.

    Args:
        recordings: they.
        masses, errors: (k,) see ``masses_apart``.
    """
    kinds = np.array([each.is_loaded for each in recordings])
    middle = {kind: float(np.median(masses[kinds == kind])) for kind in (False, True)}
    size = abs(middle[True] - middle[False])
    off = np.abs(masses - np.where(kinds, middle[True], middle[False]))
    allowed = np.maximum(SURE * np.hypot(errors, np.max(errors)), LEAST_MISFIT * size)
    if not np.any(off > allowed):
        return ()
    return tuple((each.name, float(mass)) for each, mass in zip(recordings, masses))
