"""One recording, ready to be fitted: filtered motion, or poses at which the arm rests."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.equations import Equations
from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.information import InformationAccumulator
from robot_sysid.records import Array, Measurement, Motion, SampleSource, SquareRootInformation
from robot_sysid.signals.process import ProcessedSignals, with_delay

_CHUNK = 2048

SharedColumns = Callable[[Motion], Array]
"""Columns (m, n, s) of the shared parameters for a motion."""


@dataclass(frozen=True)
class DecimatedSamples:
    """Equations of all joints at K instants; iterating over it is one pass over the data.

    Attributes:
        names: (p,) parameter names.
        joints: the joints that have equations.
        columns: per joint, which parameters its rows contain.
        time: (K,) [s].
        rows: per joint (K, k).
        tau: per joint (K,) right-hand sides [N m]; NaN where a sample is not used.
        measured: per joint (K,) the whole measured torque [N m].
    """

    names: tuple[str, ...]
    joints: tuple[str, ...]
    columns: tuple[NDArray[np.int64], ...]
    time: Array
    rows: tuple[Array, ...]
    tau: tuple[Array, ...]
    measured: tuple[Array, ...]

    def __len__(self) -> int:
        return len(self.time)

    def __iter__(self) -> Iterator[tuple[int, Array, Array]]:
        """Yield (joint number, rows, right-hand sides) of each joint."""
        return zip(range(len(self.rows)), self.rows, self.tau)

    def information(self) -> SquareRootInformation:
        """Return the square-root information of the samples in use."""
        return information_of(self, self.names, self.joints, self.columns)

    def where(self, used: NDArray[np.bool_]) -> DecimatedSamples:
        """Return the samples with those left out for which ``used`` (K,) is false."""
        return replace(self, tau=tuple(np.where(used, tau, np.nan) for tau in self.tau))

    def only(self, names: tuple[str, ...]) -> DecimatedSamples:
        """Return the samples with some of their parameters, in that order."""
        places = {name: place for place, name in enumerate(names)}
        at = [np.array([places.get(self.names[c], -1) for c in each]) for each in self.columns]
        rows = tuple(row[:, each >= 0] for row, each in zip(self.rows, at))
        return replace(self, names=names, columns=tuple(a[a >= 0] for a in at), rows=rows)

    def squared_torque(self) -> Array:
        """Return (joints,) sum of squares of the measured torque where it is used [N^2 m^2]."""
        pairs = zip(self.tau, self.measured)
        return np.array([np.sum(measured[np.isfinite(tau)] ** 2) for tau, measured in pairs])


@dataclass(frozen=True)
class JoinedSamples:
    """Equations of several logs for the same parameters; only one joint's stand together in memory.

    Attributes:
        parts: the logs', at least one.
    """

    parts: tuple[DecimatedSamples, ...]

    def __iter__(self) -> Iterator[tuple[int, Array, Array]]:
        """Yield (joint number, rows, right-hand sides) of each joint."""
        for same in zip(*self.parts):
            rows, tau = (np.concatenate([each[k] for each in same]) for k in (1, 2))
            yield same[0][0], rows, tau

    def information(self) -> SquareRootInformation:
        """Return the square-root information of the samples in use."""
        first = self.parts[0]
        return information_of(self, first.names, first.joints, first.columns)

    def squared_torque(self) -> Array:
        """Return (joints,) sum of squares of the measured torque where it is used [N^2 m^2]."""
        return np.sum([part.squared_torque() for part in self.parts], axis=0)


def information_of(
    samples: SampleSource,
    names: Sequence[str],
    joints: Sequence[str],
    columns: Sequence[NDArray[np.int64]],
) -> SquareRootInformation:
    """Return the square-root information of samples; those that are NaN are not used."""
    accumulator = InformationAccumulator(names, joints, columns)
    for index, rows, tau in samples:
        used = np.isfinite(tau)
        accumulator.add(index, rows[used], tau[used])
    return accumulator.result()


def decimated_equations(
    equations: Equations, signals: ProcessedSignals, shared: SharedColumns | None = None
) -> DecimatedSamples:
    """Build the equations at the full rate, then pass both sides through the same low-pass.

    Args:
        shared: makes the columns of the shared parameters, where the equations have any.

    Raises:
        InputError: a joint never moves fast enough for its equations to be used.
    """
    decimators = [signals.decimator() for _ in equations.joints]
    parts: list[list[Array]] = [[] for _ in equations.joints]
    for motion, tau in signals.chunks(_CHUNK):
        measurement = Measurement(motion.time, motion.q, motion.qd, tau, motion.qdd)
        common = None if shared is None else shared(motion)
        for joint, (rows, right) in enumerate(equations.rows(measurement, common)):
            whole = tau[:, equations.rows_of[joint]]
            parts[joint].append(decimators[joint].push(np.column_stack((rows, right, whole))))
    tables = [np.concatenate(part) for part in parts]
    usable = signals.usable()[:, list(equations.rows_of)]
    if not np.any(usable):
        raise InputError(
            f"none of the joints {', '.join(equations.joints)} moves faster than its velocity "
            "deadband; record a motion, or lower --velocity-deadband"
        )
    return DecimatedSamples(
        equations.names,
        equations.joints,
        equations.columns,
        signals.decimated_time(),
        tuple(table[:, :-2] for table in tables),
        tuple(np.where(ok, table[:, -2], np.nan) for table, ok in zip(tables, usable.T)),
        tuple(table[:, -1] for table in tables),
    )


def equations_at(
    equations: Equations, measurement: Measurement, shared: Array | None = None
) -> DecimatedSamples:
    """Return the equations at every sample of a measurement; ``shared`` as ``Equations.rows``."""
    rows = list(equations.rows(measurement, shared))
    return DecimatedSamples(
        equations.names,
        equations.joints,
        equations.columns,
        measurement.time,
        tuple(block for block, _ in rows),
        tuple(tau for _, tau in rows),
        tuple(measurement.tau[:, joint] for joint in equations.rows_of),
    )


BLOCKS, LONGEST_STRETCH = 5, 10.0
"""How many parts recordings are predicted in, each from the others. A part is every fifth stretch
of a recording; stretches are less than so long [s], as a motion may show a joint for a while."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class RestingPoses:
    """Poses at which the arm rests: no speed, no friction but what was averaged away.

    Attributes:
        poses: one sample per pose, with zero velocities and accelerations.
        used: (K, n) where a joint's friction cancels.
    """

    poses: Measurement
    used: Mask

    @property
    def motion(self) -> Motion:
        """The arm at rest in the poses (K, n)."""
        still = 0.0 * self.poses.q
        return Motion(self.poses.time, self.poses.q, still, still)

    def samples(self, equations: Equations, shared: SharedColumns | None) -> DecimatedSamples:
        """Return the rows of some equations."""
        common = None if shared is None else shared(self.motion)
        found = equations_at(equations, self.poses, common)
        used = self.used.T[list(equations.rows_of)]
        return replace(found, tau=tuple(np.where(ok, t, np.nan) for ok, t in zip(used, found.tau)))


@dataclass(frozen=True)
class Dataset:
    """One recording, or a stretch of it without long holes.

    Attributes:
        name: what it is called in messages.
        source: its rows' signals, or the poses at which it rests.
        is_loaded: whether it carries the payload.
        place: its place in the order of recording, -1 the first and 1 the last; 0 where the order
            is not known.
        used: (K,) which rows may be used; None for all.
    """

    name: str
    source: ProcessedSignals | RestingPoses
    is_loaded: bool = False
    place: float = 0.0
    used: Mask | None = None

    @property
    def signals(self) -> ProcessedSignals | None:
        """The filtered motion; None of resting poses."""
        return None if isinstance(self.source, RestingPoses) else self.source

    @property
    def motion(self) -> Motion:
        """The motion (K, n) at the instants of the rows."""
        if isinstance(self.source, RestingPoses):
            return self.source.motion
        return self.source.decimated_motion()

    @property
    def torque(self) -> Array:
        """The measured torque (N, n) [N m]."""
        return (self.source.poses if isinstance(self.source, RestingPoses) else self.source).tau

    def delayed(self, delay: float) -> Dataset:
        """Return the recording with a delay of its torque [s] taken out."""
        if not delay or isinstance(self.source, RestingPoses):
            return self
        return replace(self, source=with_delay(self.source, delay))

    def samples(
        self, equations: Equations, shared: SharedColumns | None = None
    ) -> DecimatedSamples:
        """Return the rows of some equations, those in use."""
        if isinstance(self.source, RestingPoses):
            found = self.source.samples(equations, shared)
        else:
            found = decimated_equations(equations, self.source, shared)
        # A delay shortens recordings at their ends; what is used then ends earlier.
        return found if self.used is None else found.where(self.used[: len(found)])


def block_masks(log: DecimatedSamples) -> Iterator[Mask]:
    """Yield, per block, which rows (K,) of a recording are in it.

    Raises:
        InputError: the recording has fewer rows in use than blocks.
    """
    rows = np.flatnonzero(np.any([np.isfinite(tau) for tau in log.tau], axis=0))
    rounds = int(max((log.time[-1] - log.time[0]) // (BLOCKS * 0.5 * LONGEST_STRETCH), 1))
    rounds = min(rounds, max(len(rows) // BLOCKS, 1))
    stretches = blocks(len(rows), BLOCKS * rounds)
    for block in range(BLOCKS):
        mask = np.zeros(len(log), dtype=bool)
        for stretch in stretches[block::BLOCKS]:
            mask[rows[stretch]] = True
        yield mask


def blocks(n_rows: int, count: int) -> tuple[slice, ...]:
    """Cut consecutive rows into ``count`` blocks of nearly equal length.

    Raises:
        InputError: there are fewer rows than blocks.
    """
    if n_rows < count:
        raise InputError(f"{n_rows} rows cannot be cut into {count} blocks; record longer")
    edges = [round(k * n_rows / count) for k in range(count + 1)]
    return tuple(slice(start, stop) for start, stop in zip(edges, edges[1:]))


def mean_torque(datasets: Sequence[Dataset]) -> Array:
    """Return (n,) root mean square of each joint's measured torque [N m]."""
    squares = sum(np.sum(each.torque**2, axis=0) for each in datasets)
    count = sum(len(each.torque) for each in datasets)
    if not count:
        raise InputError("there is no sample to identify from")
    return np.asarray(np.sqrt(squares / count))
