"""What the checks look at: some hundred instants of a log, motion and torque low-passed alike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.records import Array, Measurement, RobotModel
from robot_sysid.signals.process import ProcessedSignals, process

INSTANTS = 400
"""So many instants stand for a log."""
DELAYS = (-0.04, -0.02, -0.01, 0.01, 0.02, 0.04, 0.07, 0.1)
"""Delays of torque that are tried [s]."""
TOLERANCE = 0.04
"""Part of a joint's usual torque that a right model may miss."""
# A joint that carries next to nothing is judged by what its neighbours carry.
_LEAST = 0.02


@dataclass(frozen=True)
class Sample:
    """Motion and torque at K instants: what is measured, or what it would be without a mistake.

    Attributes:
        q, qd, qdd: (K, n) low-passed motion.
        tau: (K, n) low-passed torque [N m].
        sigma: (n,) by how much a right model may miss each joint's torque [N m].
    """

    q: Array
    qd: Array
    qdd: Array
    tau: Array
    sigma: Array

    def with_order(self, motion: Sequence[int], torque: Sequence[int]) -> Sample:
        """Return the sample with the joints' columns in another order."""
        to, of = list(motion), list(torque)
        q, qd, qdd = (values[:, to] for values in (self.q, self.qd, self.qdd))
        return Sample(q, qd, qdd, self.tau[:, of], self.sigma[of])

    def with_motion(self, factor: Array | float) -> Sample:
        """Return the sample with its motion multiplied by a factor, one for all or (n,)."""
        q, qd, qdd = (factor * values for values in (self.q, self.qd, self.qdd))
        return replace(self, q=q, qd=qd, qdd=qdd)

    def with_torque(self, factor: Array | float) -> Sample:
        """Return the sample with its torque multiplied by a factor, one for all or (n,)."""
        return replace(self, tau=factor * self.tau, sigma=np.abs(factor) * self.sigma)

    def thinned(self, every: int) -> Sample:
        """Return every so many of the instants."""
        q, qd, qdd, tau = (v[::every] for v in (self.q, self.qd, self.qdd, self.tau))
        return replace(self, q=q, qd=qd, qdd=qdd, tau=tau)


@dataclass(frozen=True)
class Evidence:
    """A log as the checks see it.

    Attributes:
        time: (K,) when [s].
        shifted: torque (K, n) at later instants, by how much later [s].
        noise: (n,) standard deviation of what noise is left in the low-passed torque [N m].
        cutoff: of the low-pass [Hz].
    """

    robot: RobotModel
    pieces: tuple[Measurement, ...]
    sample: Sample
    time: Array
    shifted: Mapping[float, Array]
    noise: Array
    cutoff: float


def evidence_of(
    robot: RobotModel, pieces: Sequence[Measurement], cutoff: float | None = None
) -> Evidence:
    """Return what the checks look at; a ``cutoff`` [Hz] of None is chosen from the data."""
    parts, noises, count = [], [], max(50, INSTANTS // len(pieces))
    for piece in pieces:
        signals = process(piece, robot.joint_names, cutoff)
        smooth, lost = signals.low_pass.filtered(signals.tau), signals.low_pass.half_width
        parts.append(_part(signals, smooth, count))
        rest = signals.tau[lost : len(signals) - lost] - smooth
        noises.append(np.std(rest, axis=0) * np.sqrt(np.sum(signals.low_pass.kernel**2)))
    time, q, qd, qdd, tau, *later = (np.concatenate(same) for same in zip(*parts))
    noise = np.sqrt(np.mean(np.square(noises), axis=0))
    usual = np.sqrt(np.mean(tau**2, axis=0))
    usual = np.maximum(usual, _LEAST * float(np.max(usual)))
    sample = Sample(q, qd, qdd, tau, np.hypot(TOLERANCE * usual, noise))
    return Evidence(
        robot, tuple(pieces), sample, time, dict(zip(DELAYS, later)), noise, signals.cutoff
    )


def _part(signals: ProcessedSignals, smooth: Array, count: int) -> tuple[Array, ...]:
    """Return (time, q, qd, qdd, tau, then tau later by each of ``DELAYS``) of one piece."""
    lost = signals.low_pass.half_width
    inner = slice(lost, lost + len(smooth))
    time = signals.time[inner]
    reach = (time + min(DELAYS) >= time[0]) & (time + max(DELAYS) <= time[-1])
    there = np.flatnonzero(reach & ~signals.bridged[inner])
    places = there[np.unique(np.linspace(0, len(there) - 1, count).astype(int))]
    motion = (values[inner][places] for values in (signals.q, signals.qd, signals.qdd))
    when = time[places]
    later = (
        np.column_stack([np.interp(when + delay, time, channel) for channel in smooth.T])
        for delay in DELAYS
    )
    return (when, *motion, smooth[places], *later)
