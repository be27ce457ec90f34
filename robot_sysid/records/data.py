"""Motion, measurements, what is left of them after one pass, and what a report draws of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records.arm import Array, InertialParameters, JointLimits, check_arrays


@dataclass(frozen=True)
class Motion:
    """Chain joint motion at times (N,) [s], and its derivatives (N, n) [rad, rad/s, rad/s^2]."""

    time: Array
    q: Array
    qd: Array
    qdd: Array

    def __post_init__(self) -> None:
        _check_samples(self, "q", "qd", "qdd")


def _check_samples(record: Motion | Measurement, *names: str) -> None:
    """Check the time (N,) of a record and, where they are there, arrays (N, n)."""
    check_arrays(record, time=(None,))
    shape = (
        len(record.time),
        np.shape(record.q)[1] if np.ndim(record.q) == 2 else None,
    )
    there = (name for name in names if getattr(record, name) is not None)
    check_arrays(record, **dict.fromkeys(there, shape))


class MotionPlan(Protocol):
    """A trajectory: anything with a duration that can be evaluated exactly at any time."""

    @property
    def duration(self) -> float:
        """Length [s]."""

    def evaluate(self, time: Array) -> Motion:
        """Return the motion at times (N,) [s]; exact derivatives."""


@dataclass(frozen=True)
class Measurement:
    """Joint motion and torque samples, from a simulation or a log; one chunk of them or all.

    Attributes:
        time: (N,) [s], increasing.
        q: (N, n) positions [rad].
        tau: (N, n) joint torques [N m]; position errors [rad] where there are commands.
        qd, qdd: (N, n) velocities, accelerations [rad/s, rad/s^2]; None where the log has none.
        joint_time: (N, n) when each joint was sampled [s]; None where ``time`` holds for all.
        command: (N, n) positions that a servo was asked for [rad], of a log that is read for them
            and not for torque; else None.
    """

    time: Array
    q: Array
    qd: Array | None
    tau: Array
    qdd: Array | None = None
    joint_time: Array | None = None
    command: Array | None = None

    def __post_init__(self) -> None:
        _check_samples(self, "q", "qd", "tau", "qdd", "joint_time", "command")

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True)
class JointInformation:
    """Square-root information of one joint's equations, which contain the global parameters in
    ``columns`` (k,): the upper triangle R (k+1, k+1) with R^T R = [Y tau]^T [Y tau], or fewer rows
    with such a product where there are fewer equations.
    """

    joint: str
    columns: NDArray[np.int64]
    triangle: Array
    n_samples: int

    def __post_init__(self) -> None:
        size = len(self.columns) + 1
        check_arrays(self, triangle=(min(len(self.triangle), size), size))


@dataclass(frozen=True)
class SquareRootInformation:
    """All that is left of the data after one pass over it.

    Attributes:
        names: (p,) global parameter names: the ten of ``spatial.PARAMETER_NAMES`` first, then
            nuisances such as ``coulomb[joint6]``.
        prior: (r, p+1) further equations [A b] of unit variance: what was known before the data;
            None where nothing was.
    """

    names: tuple[str, ...]
    joints: tuple[JointInformation, ...]
    prior: Array | None = None

    @property
    def n_samples(self) -> int:
        """Number of scalar equations."""
        return sum(joint.n_samples for joint in self.joints)

    def stacked(self, weights: Array | None = None) -> tuple[Array, Array]:
        """Return (A (M, p), b (M,)) with ||A x - b||^2 = sum_j w_j^2 ||Y_j x - tau_j||^2.

        Args:
            weights: (joints,) weight of each joint's equations, 1/sigma; the prior's equations
                come with them. None weighs all joints alike and leaves the prior out.
        """
        rows = np.vstack(list(self.blocks(weights)))
        return rows[:, :-1], rows[:, -1]

    def blocks(self, weights: Array | None = None) -> Iterator[Array]:
        """Yield the rows (m, p + 1) of what ``stacked`` returns, one joint after the other."""
        scale = np.ones(len(self.joints)) if weights is None else np.asarray(weights)
        for joint, weight in zip(self.joints, scale):
            block = np.zeros((len(joint.triangle), len(self.names) + 1))
            block[:, [*joint.columns, -1]] = weight * joint.triangle
            yield block
        if weights is not None and self.prior is not None:
            yield self.prior

    def squared_residuals(self, values: Array) -> Array:
        """Return sums of squared residuals (joints, ...) [N^2 m^2] at values (p, ...)."""
        pairs = ((j.triangle, values[j.columns]) for j in self.joints)
        return np.array(
            [np.sum((((t[:, :-1] @ x).T - t[:, -1]) ** 2).T, axis=0) for t, x in pairs]
        )


SampleSource = Iterable[tuple[int, Array, Array]]
"""The equations behind an information, sample by sample, for methods that need several passes.

Each pass yields (joint number, rows (N, k), tau (N,)) of every joint, in the order of time. tau is
NaN where a sample is left out of the fit; such a row stays in its place so that time lags keep
their meaning."""

SIGNALS = ("q", "qd", "measured", "predicted", "before", "friction")


@dataclass(frozen=True)
class Signals:
    """K instants of all n joints whose torque was used: arrays (K, n) [s, rad, rad/s, N m].

    Attributes:
        measured: torque; NaN where a sample was not used.
        predicted, friction: torque that the result predicts, and the part that friction makes.
        before: torque that was predicted before: by the model as it is in its file, of a payload
            by the arm without it.
    """

    joints: tuple[str, ...]
    is_slide: tuple[bool, ...]
    time: Array
    q: Array
    qd: Array
    measured: Array
    predicted: Array
    before: Array
    friction: Array

    def __post_init__(self) -> None:
        shape = (len(self.time), len(self.joints))
        for name in SIGNALS:
            if np.shape(getattr(self, name)) != shape:
                raise InputError(
                    f"{name} has shape {np.shape(getattr(self, name))}, not {shape}"
                )


@dataclass(frozen=True)
class Traces(Signals):
    """All instants of a result; the time starts anew with each log. The truth is what a simulated
    arm's link really is, None where nobody knows.
    """

    limits: JointLimits
    truth: InertialParameters | None = None

    @property
    def residual(self) -> Array:
        """Measured minus predicted torque (K, n) [N m]; NaN where a sample was not used."""
        return self.measured - self.predicted
