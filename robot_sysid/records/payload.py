"""What a payload identification found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robot_sysid.records.arm import Flange, InertialParameters
from robot_sysid.records.arrays import Array
from robot_sysid.records.results import Validation


class PayloadStatus(Enum):
    """How a payload identification ended: cause and remedy."""

    OK = "the payload is identified from the difference between loaded and empty recordings"
    SWAPPED = (
        "the loaded recordings weigh less than the empty ones: --empty and --loaded look swapped; "
        "exchange them"
    )
    NOT_SEEN = (
        "the recordings do not tell the payload's mass: move joints that lift it, faster, wider or "
        "longer, or check that the loaded recordings were made with the payload"
    )
    TOO_UNCERTAIN = (
        "the whole error of the payload's mass is above 10 %; record more and longer logs that "
        "move all joints, calibrate the torques (--known-mass), or tell of better sensors with "
        "--scale-uncertainty"
    )
    IMPLAUSIBLE = (
        "no payload of this mass has its centre of mass so far from the flange, or is so large; "
        "check the units, the joint order and the model's geometry"
    )
    DISAGREE = (
        "the recordings contradict each other about the payload: one of them was made with "
        "another payload, or is listed on the wrong side"
    )
    UNPREDICTED = (
        "the estimate does not predict the torques of stretches that it was not fitted to; check "
        "units, joint order and that all recordings are of this arm"
    )

    WRONG_WEIGHT = (
        "the known mass does not fit the recordings: weighed with torques as they are it comes "
        "out far from what --known-mass says; check the weight, its unit (kg), and that nothing "
        "else was changed between empty and loaded"
    )

    @property
    def is_trustworthy(self) -> bool:
        """Whether the result may go into a model or a controller."""
        return self is PayloadStatus.OK


@dataclass(frozen=True)
class BodyEstimate:
    """Ten inertial parameters and how far they may be off.

    Attributes:
        inertial: the parameters.
        covariance: (10, 10) of their whole error, as far as anything shows it.
        shown: (10,) whether recordings and priors show a parameter at all.
        noise_errors: (10,) the part of the standard errors that torque noise explains.
        budget: cause to the part of the standard errors (10,) that it explains.
    """

    inertial: InertialParameters
    covariance: Array
    shown: NDArray[np.bool_]
    noise_errors: Array
    budget: Mapping[str, Array] = field(default_factory=dict)

    @property
    def errors(self) -> Array:
        """Standard errors (10,), all causes together; infinite where nothing shows a parameter."""
        spread = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return np.where(self.shown, spread, np.inf)


@dataclass(frozen=True)
class OneRecording:
    """The payload according to one recording alone, against all of the other kind.

    Attributes:
        name: the recording.
        is_loaded: of which kind it is.
        mass: of the payload [kg].
        com: (3,) its centre of mass in the flange frame [m].
        noise_error, error: standard errors of the mass [kg]: of noise alone, and whole.
    """

    name: str
    is_loaded: bool
    mass: float
    com: Array
    noise_error: float
    error: float


@dataclass(frozen=True)
class PayloadIdentification:
    """A payload, where it came from and how far to trust it.

    Attributes:
        model_path, model_sha256: of the arm's model.
        joint_name, body_name: terminal joint and body.
        joint_names: the n chain joints.
        flange: the frame in which the payload is stated.
        payload: in the FLANGE frame, inertia about its origin.
        link, total: the terminal link without and with the payload, in the terminal body's frame.
        recordings: names of the recordings, empty ones first.
        scatter: the payload according to each recording alone.
        status: how it ended.
        reasons: one sentence each: what stands behind the status.
        validation: prediction of stretches that were not fitted.
        friction_model: name of the friction terms.
        parameters: all further parameters with their standard errors: friction, drift, nuisances.
        torque_scale: joint name to (scale, standard error), where a known mass was given.
        known_mass: that mass [kg], or None.
        rmse: root mean square torque residual [N m].
        duration: of all recordings [s].
        cutoff: of the low-pass [Hz]; None where resting poses were used.
        versions: package name to version.
        notes: one sentence each.
    """

    model_path: Path
    model_sha256: str
    joint_name: str
    body_name: str
    joint_names: tuple[str, ...]
    flange: Flange
    payload: BodyEstimate
    link: BodyEstimate
    total: BodyEstimate
    recordings: Mapping[str, tuple[str, ...]]
    scatter: tuple[OneRecording, ...]
    status: PayloadStatus
    reasons: tuple[str, ...]
    validation: Validation | None
    friction_model: str
    parameters: Mapping[str, tuple[float, float]]
    torque_scale: Mapping[str, tuple[float, float]]
    known_mass: float | None
    rmse: float
    duration: float
    cutoff: float | None
    versions: Mapping[str, str]
    notes: tuple[str, ...] = ()
