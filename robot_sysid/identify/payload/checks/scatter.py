"""The payload according to each recording alone: do they agree within the errors they state?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from robot_sysid.estimation.identifiability import visible_space
from robot_sysid.estimation.information import combined
from robot_sysid.estimation.nuisances import with_prior
from robot_sysid.identify.payload.equations import PAYLOAD_NAMES, Recording
from robot_sysid.identify.payload.joint_fit import JointFit
from robot_sysid.records import Flange, SquareRootInformation
from robot_sysid.records.payload import OneRecording

SURE = 3.0
"""Standard errors between a recording and all others above which it is said to disagree."""


def each_recording(
    fit: JointFit, recordings: Sequence[Recording], flange: Flange, inflation: float
) -> tuple[OneRecording, ...]:
    """Return the payload of each recording against all of the other kind.

    Args:
        fit: of all recordings.
        recordings: they, in the order of ``fit.samples``.
        flange: frame of the centres of mass.
        inflation: by how much correlated noise makes errors larger than white noise would.
    """
    informations = [part.information() for part in fit.samples]
    found = []
    for kind in (False, True):
        same = [k for k, each in enumerate(recordings) if each.is_loaded is kind]
        others = [k for k, each in enumerate(recordings) if each.is_loaded is not kind]
        for k in same if len(same) > 1 else ():
            part = [informations[i] for i in (k, *others)]
            found.append(_alone(fit, recordings[k], combined(part), flange, inflation))
    return tuple(found)


def _alone(
    fit: JointFit,
    recording: Recording,
    information: SquareRootInformation,
    flange: Flange,
    inflation: float,
) -> OneRecording:
    weights = 1.0 / fit.weighted.noise
    known = with_prior(information, fit.groups)
    matrix, right = known.stacked(weights)
    of_data = information.stacked(weights)[0]
    space = visible_space(matrix)
    values = fit.equations.prior + space.solve(right - matrix @ fit.equations.prior)
    places = fit.equations.places(PAYLOAD_NAMES)
    theta = flange.to_flange(values[places])
    inverse = space.inverse()
    row = inverse[places[0]]
    data = float(np.sum((of_data @ row) ** 2))
    noise = inflation * float(np.sqrt(data))
    return OneRecording(
        recording.name,
        recording.is_loaded,
        float(theta[0]),
        theta[1:4] / theta[0],
        noise,
        float(np.sqrt(max(inverse[places[0], places[0]] - data, 0.0) + noise**2)),
    )


def disagreements(scatter: Sequence[OneRecording], mass: float) -> Iterator[OneRecording]:
    """Yield the recordings that are further from the mass [kg] of all than noise explains."""
    for one in scatter:
        if abs(one.mass - mass) > SURE * one.noise_error:
            yield one
