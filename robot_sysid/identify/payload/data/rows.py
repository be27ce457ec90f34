"""Where a recording's rows come from: filtered motion, or poses at which the arm rests."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.equations import Equations
from robot_sysid.identify.samples import DecimatedSamples, decimated_equations
from robot_sysid.records import Array, Measurement, Motion
from robot_sysid.signals.process import ProcessedSignals, delay_columns


class RowSource(Protocol):
    """K instants at which a recording has one equation per joint."""

    @property
    def motion(self) -> Motion:
        """The motion (K, n) at these instants."""

    @property
    def lag(self) -> Array:
        """The column (K, n) of a lag of the torque behind the position [N m/s]."""

    @property
    def duration(self) -> float:
        """Length of the recording [s]."""

    def samples(self, equations: Equations) -> DecimatedSamples:
        """Return the rows of these equations."""


@dataclass(frozen=True)
class FilteredRows:
    """Rows of a motion, both sides low-passed and decimated.

    Attributes:
        signals: the processed log.
    """

    signals: ProcessedSignals

    @property
    def motion(self) -> Motion:
        """See ``ProcessedSignals.decimated_motion``."""
        return self.signals.decimated_motion()

    @property
    def lag(self) -> Array:
        """See ``signals.process.delay_columns``."""
        return delay_columns(self.signals)[self.signals.low_pass.centres(len(self.signals))]

    @property
    def duration(self) -> float:
        """Length of the recording [s]."""
        return float(np.ptp(self.signals.time))

    def samples(self, equations: Equations) -> DecimatedSamples:
        """Return the rows of these equations."""
        return decimated_equations(equations, self.signals)


@dataclass(frozen=True)
class RestingRows:
    """Rows of poses at which the arm rests: no speed, no friction but what was averaged away.

    Attributes:
        poses: one sample per pose, with zero velocities and accelerations.
        used: (K, n) where a joint's friction cancels.
        duration: length of the recording [s].
    """

    poses: Measurement
    used: NDArray[np.bool_]
    duration: float

    @property
    def motion(self) -> Motion:
        """The poses."""
        still = np.zeros_like(self.poses.q)
        return Motion(self.poses.time, self.poses.q, still, still)

    @property
    def lag(self) -> Array:
        """At rest nothing lags."""
        return np.zeros_like(self.poses.q)

    def samples(self, equations: Equations) -> DecimatedSamples:
        """Return the rows of these equations."""
        rows = list(equations.rows(self.poses))
        measured = tuple(self.poses.tau[:, joint] for joint in equations.rows_of)
        return DecimatedSamples(
            equations.names,
            equations.joints,
            equations.columns,
            self.poses.time,
            tuple((block,) for block, _ in rows),
            tuple(
                np.where(self.used[:, joint], tau, np.nan)
                for joint, (_, tau) in zip(equations.rows_of, rows)
            ),
            measured,
        )
