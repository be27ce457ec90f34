"""The equations of a processed log, low-passed and decimated, held in memory for several passes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.equations import Equations
from robot_sysid.errors import InputError
from robot_sysid.estimation.information import InformationAccumulator
from robot_sysid.records import Array, Measurement, Motion, SampleSource, SquareRootInformation
from robot_sysid.signals.process import ProcessedSignals

_CHUNK = 2048

SharedColumns = Callable[[Motion, slice], Array]
"""Columns (m, n, s) of the shared parameters for a motion and its place in the signals."""


@dataclass(frozen=True)
class DecimatedSamples:
    """Equations of all joints at K instants; iterating over it is one pass over the data.

    Attributes:
        names: (p,) parameter names.
        joints: the joints that have equations.
        columns: per joint, which parameters its rows contain.
        time: (K,) [s].
        blocks: per joint, what its rows (K, k) are made of side by side; kept apart, so that
            samples that differ in their last columns alone share the others.
        tau: per joint (K,) right-hand sides [N m]; NaN where a sample is not used.
        measured: per joint (K,) the whole measured torque [N m].
    """

    names: tuple[str, ...]
    joints: tuple[str, ...]
    columns: tuple[NDArray[np.int64], ...]
    time: Array
    blocks: tuple[tuple[Array, ...], ...]
    tau: tuple[Array, ...]
    measured: tuple[Array, ...]

    def __len__(self) -> int:
        return len(self.time)

    def __iter__(self) -> Iterator[tuple[int, Array, Array]]:
        """Yield (joint number, rows, right-hand sides) of each joint."""
        for index, (blocks, tau) in enumerate(zip(self.blocks, self.tau)):
            yield index, _side_by_side(blocks), tau

    @property
    def rows(self) -> tuple[Array, ...]:
        """Per joint (K, k)."""
        return tuple(_side_by_side(blocks) for blocks in self.blocks)

    def information(self) -> SquareRootInformation:
        """Return the square-root information of the samples in use."""
        return information_of(self, self.names, self.joints, self.columns)

    def where(self, used: NDArray[np.bool_]) -> DecimatedSamples:
        """Return the samples with those left out for which ``used`` (K,) is false."""
        return replace(self, tau=tuple(np.where(used, tau, np.nan) for tau in self.tau))

    def with_columns(
        self,
        names: Sequence[str],
        blocks: Sequence[Array],
        places: Sequence[NDArray[np.int64]] | None = None,
    ) -> DecimatedSamples:
        """Return the samples with further parameters.

        Args:
            names: (s,) of the parameters.
            blocks: per joint (K, t).
            places: per joint, which t of the parameters are in its equations; None for all s.
        """
        every = [np.arange(len(names))] * len(self.blocks) if places is None else places
        new = [len(self.names) + np.asarray(place) for place in every]
        return replace(
            self,
            names=(*self.names, *names),
            columns=tuple(np.concatenate(pair) for pair in zip(self.columns, new)),
            blocks=tuple((*own, block) for own, block in zip(self.blocks, blocks)),
        )

    def deviation(self, prior: Array) -> DecimatedSamples:
        """Return the equations for the deviation from ``prior`` (p,)."""
        right = [tau - rows @ prior[columns] for (_, rows, tau), columns in zip(self, self.columns)]
        return replace(self, tau=tuple(right))

    def used(self) -> DecimatedSamples:
        """Return the samples in use alone; joints may then have different numbers of them."""
        kept = [np.isfinite(tau) for tau in self.tau]
        return replace(
            self,
            blocks=tuple((rows[keep],) for (_, rows, _), keep in zip(self, kept)),
            tau=tuple(tau[keep] for tau, keep in zip(self.tau, kept)),
            measured=tuple(measured[keep] for measured, keep in zip(self.measured, kept)),
        )

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

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names (p,)."""
        return self.parts[0].names

    @property
    def joints(self) -> tuple[str, ...]:
        """The joints that have equations."""
        return self.parts[0].joints

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
        equations: what to build.
        signals: the processed log.
        shared: makes the columns of the shared parameters, where the equations have any.

    Raises:
        InputError: a joint never moves fast enough for its equations to be used.
    """
    decimators = [signals.decimator() for _ in equations.joints]
    parts: list[list[Array]] = [[] for _ in equations.joints]
    for start, (motion, tau) in zip(range(0, len(signals), _CHUNK), signals.chunks(_CHUNK)):
        measurement = Measurement(motion.time, motion.q, motion.qd, tau, motion.qdd)
        place = slice(start, start + len(motion.time))
        common = None if shared is None else shared(motion, place)
        for joint, (rows, right) in enumerate(equations.rows(measurement, common)):
            whole = tau[:, equations.rows_of[joint]]
            parts[joint].append(decimators[joint].push(np.column_stack((rows, right, whole))))
    tables = [np.concatenate(part) for part in parts]
    usable = signals.usable()[:, list(equations.rows_of)]
    _require_usable(usable, equations.joints)
    return DecimatedSamples(
        equations.names,
        equations.joints,
        equations.columns,
        signals.decimated_time(),
        tuple((table[:, :-2],) for table in tables),
        tuple(np.where(ok, table[:, -2], np.nan) for table, ok in zip(tables, usable.T)),
        tuple(table[:, -1] for table in tables),
    )


def joined(parts: Sequence[DecimatedSamples]) -> DecimatedSamples:
    """Return the samples of several logs as one, with equations for the same parameters."""

    def stacked(name: str) -> tuple[Array, ...]:
        return tuple(np.concatenate(same) for same in zip(*(getattr(p, name) for p in parts)))

    if len(parts) == 1:
        return parts[0]
    time = np.concatenate([part.time for part in parts])
    blocks = tuple((rows,) for rows in stacked("rows"))
    tau, measured = stacked("tau"), stacked("measured")
    return replace(parts[0], time=time, blocks=blocks, tau=tau, measured=measured)


def _side_by_side(blocks: Sequence[Array]) -> Array:
    return blocks[0] if len(blocks) == 1 else np.hstack(blocks)


def _require_usable(usable: NDArray[np.bool_], joints: Sequence[str]) -> None:
    if not np.any(usable):
        raise InputError(
            f"none of the joints {', '.join(joints)} moves faster than its velocity deadband; "
            "record a motion, or lower --velocity-deadband"
        )
