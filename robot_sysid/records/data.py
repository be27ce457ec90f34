"""Motion and measurements, and what follows from them.

``FitQuality`` and ``Validation`` say how well a fit describes samples; ``Traces`` are what a report
draws of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records.arrays import Array, check_arrays


@dataclass(frozen=True)
class Motion:
    """Motion of the n chain joints at N instants.

    Attributes:
        time: (N,) instants [s].
        q, qd, qdd: (N, n) positions [rad], velocities [rad/s] and accelerations [rad/s^2]; m in
            place of rad for a slide. Columns are the joints, base to terminal.
    """

    time: Array
    q: Array
    qd: Array
    qdd: Array

    def __post_init__(self) -> None:
        _check_samples(self, "qd", "qdd")


def _check_samples(record: Motion | Measurement, *names: str) -> None:
    """Make the arrays of a record read-only and check their shapes.

    Args:
        record: the record, whose fields are replaced by views; its ``time`` has the shape (N,), its
            ``q`` (N, n).
        names: of its further fields of the shape (N, n); one that is None is left out.

    Raises:
        InputError: a shape differs, or an element is not finite.
    """
    check_arrays(record, time=(None,))
    check_arrays(record, q=(len(record.time), None))
    given = (name for name in names if getattr(record, name) is not None)
    check_arrays(record, **dict.fromkeys(given, record.q.shape))


class MotionPlan(Protocol):
    """A trajectory: anything with a duration that can be evaluated exactly at any time."""

    @property
    def duration(self) -> float:
        """Length [s]."""

    def evaluate(self, time: Array) -> Motion:
        """Return the motion at times (N,) [s], with exact derivatives."""


@dataclass(frozen=True)
class Measurement:
    """Joint motion and torque samples, from a simulation or a log: all of them or one chunk.

    Attributes:
        time: (N,) [s], increasing.
        q: (N, n) positions [rad].
        tau: (N, n) joint torques [N m]; position errors [rad] where ``command`` is not None.
        qd, qdd: (N, n) velocities, accelerations [rad/s, rad/s^2]; None where the log has none.
        joint_time: (N, n) when each joint was sampled [s]; None where ``time`` holds for all.
        command: (N, n) commanded positions [rad], of a log of servos; else None.
        left_out: (N,) bool, samples that something is wrong with and no estimate uses; or None.
    """

    time: Array
    q: Array
    qd: Array | None
    tau: Array
    qdd: Array | None = None
    joint_time: Array | None = None
    command: Array | None = None
    left_out: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        _check_samples(self, "qd", "tau", "qdd", "joint_time", "command")

    def __len__(self) -> int:
        return len(self.time)


def rms_of_joints(
    joint_names: Sequence[str], squares: Array, counts: Array
) -> tuple[float, dict[str, float]]:
    """Return the root mean square of all samples, and joint to that of its own.

    Args:
        joint_names: the J joints.
        squares: (J,) sum of squares of each joint.
        counts: (J,) number of samples in these sums.
    """
    per_joint = np.sqrt(squares / np.maximum(counts, 1.0)).tolist()
    overall = float(np.sqrt(np.sum(squares) / max(np.sum(counts), 1.0)))
    return overall, dict(zip(joint_names, per_joint))


@dataclass(frozen=True)
class FitQuality:
    """What the equations of a fit determine, and how well it describes them, by the keys of
    params.json.

    Attributes:
        rmse: root mean square torque residual of all joints [N m].
        condition_number: of the stacked regressor, or of its identifiable part where it has less
            than full rank.
        n_base_params: number of identifiable combinations of the terminal link's parameters and its
            joint's friction.
        unidentifiable: parameters that the data alone does not determine, in words, for instance
            "mass".
        rmse_per_joint: joint name to the root mean square of its residual [N m].
        noise_per_joint: joint name to standard deviation of its torque noise [N m], where used.
        samples_per_joint: joint name to the number of samples of its equations.
    """

    rmse: float
    condition_number: float
    n_base_params: int
    unidentifiable: tuple[str, ...]
    rmse_per_joint: Mapping[str, float]
    noise_per_joint: Mapping[str, float]
    samples_per_joint: Mapping[str, int]


@dataclass(frozen=True)
class Validation:
    """Torque prediction errors on some data.

    Attributes:
        source: description of the data.
        n_samples: number of samples of the joint that has most.
        rmse: root mean square error of all joints [N m].
        relative_error: ||tau - prediction|| / ||tau|| of all joints; None where tau is zero.
        rmse_per_joint: joint name to its root mean square error [N m].
        relative_error_per_joint: joint name to its relative error, or None.
        is_informative: whether the fitted data determines the torque of such a motion well enough
            for these errors to speak against the fit.
        blocks: (B, n) sums of the squared errors of each joint in blocks of time [N^2 m^2].
    """

    source: str
    n_samples: int
    rmse: float
    relative_error: float | None
    rmse_per_joint: Mapping[str, float]
    relative_error_per_joint: Mapping[str, float | None]
    is_informative: bool
    blocks: Array = field(compare=False)


ITSELF = "simulation of the model itself"
"""Description of the data of a self-test."""


@dataclass(frozen=True)
class DataOrigin:
    """Where the data of an identification comes from.

    Attributes:
        description: such as "log arm.csv", or ``ITSELF``.
        duration: [s].
        sample_rate: [Hz].
        seed: of trajectory and simulated noise; None for a log.
        files: full paths of the logs.
    """

    description: str
    duration: float
    sample_rate: float
    seed: int | None = None
    files: tuple[str, ...] = ()


SIGNAL_NAMES = ("qd", "measured", "predicted", "prior_prediction", "friction")
"""The fields of ``Traces`` with one column per joint."""


@dataclass(frozen=True)
class Traces:
    """Speeds and torques of n joints at all K instants of a result's data, which figures draw.

    Attributes:
        joints: names, base to terminal.
        is_slide: (n,) whether a joint is a slide.
        time: (K,), which starts anew with each log [s].
        qd: (K, n) velocities [rad/s].
        measured: (K, n) torque [N m]; NaN where a sample was not used.
        predicted: (K, n) torque that the result predicts [N m].
        prior_prediction: (K, n) torque [N m] that the model predicts as its file has it; of a
            payload, torque of the arm without it.
        friction: (K, n) the part of ``predicted`` that is friction [N m].
    """

    joints: tuple[str, ...]
    is_slide: tuple[bool, ...]
    time: Array
    qd: Array
    measured: Array
    predicted: Array
    prior_prediction: Array
    friction: Array

    def __post_init__(self) -> None:
        shapes = {np.shape(getattr(self, name)) for name in SIGNAL_NAMES}
        if shapes != {(len(self.time), len(self.joints))}:
            raise InputError(f"signals of a result have the shapes {shapes}")

    @property
    def residual(self) -> Array:
        """Measured minus predicted torque (K, n) [N m]; NaN where a sample was not used."""
        return self.measured - self.predicted
