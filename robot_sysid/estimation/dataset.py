"""One recording as equations: filtered motion, or poses at which the arm rests.

Shapes: N samples of a recording; K rows (instants of equations), fewer than N because low-passed
signals are decimated; n joints of the chain; "joints" those with equations; p parameters, k of
which have columns in a joint's equations. An equation reads row (k,) x = right-hand side [N m].
Square-root information is one triangle R (k + 1, k + 1) per joint, R^T R = [rows rhs]^T [rows rhs].

Rows of equations take most of the memory. Long recordings keep theirs in a temporary file
(``store_rows``), columns that depend on the linearisation point are put beside them on access
(``AssembledRows``), and ``release_memory`` gives freed rows back to the system.
"""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import os
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.equations import Equations, assemble_rows
from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.least_squares import InformationAccumulator
from robot_sysid.records import Array, Measurement, Motion, SquareRootInformation
from robot_sysid.signals.process import ProcessedSignals, check_losses, with_delay

Mask = NDArray[np.bool_]
"""Boolean mask of rows, True where a row is used."""
BLOCKS = 5
"""Number of blocks of cross-validation: a block is every fifth stretch of a log."""
LONGEST_STRETCH = 10.0
"""Upper bound of a stretch [s]: a motion may move a joint for some seconds only."""
# Largest count of numbers in a recording's rows that stay in memory: half a minute of an arm of
# seven joints.
_IN_MEMORY = 250_000


@dataclass(frozen=True)
class DecimatedSamples:
    """Equations of some joints at K instants of one recording; its arrays must not be changed.

    Attributes:
        names: (p,) parameter names.
        joints: names of the joints that have equations, base to terminal.
        columns: per joint (k,) indices into ``names`` of the parameters in its rows.
        time: (K,) instants [s].
        rows: per joint (K, k) regressor; indexing may assemble it anew or read it from a file.
        tau: per joint (K,) right-hand sides, the measured torque less the torque that depends on no
            parameter [N m]; NaN where a row is not used.
        measured: per joint (K,) the measured torque [N m].
    """

    names: tuple[str, ...]
    joints: tuple[str, ...]
    columns: tuple[NDArray[np.int64], ...]
    time: Array
    rows: Sequence[Array]
    tau: tuple[Array, ...]
    measured: tuple[Array, ...]

    def __len__(self) -> int:
        """Return the number of rows K."""
        return len(self.time)

    def __iter__(self) -> Iterator[tuple[int, Array, Array]]:
        """Yield (joint number, rows (K, k), right-hand sides (K,)) of each joint."""
        return zip(range(len(self.rows)), self.rows, self.tau)

    def torque(self, values: Array) -> list[Array]:
        """Return each joint's torque (K,) that parameters (p,) make in its rows [N m]."""
        torques = []
        for rows, columns in zip(self.rows, self.columns):
            torques.append(rows @ values[columns])
        return torques

    def in_use(self, joint: int) -> tuple[Array, Array]:
        """Return the used rows (m, k) of a joint number and their right-hand sides (m,)."""
        is_used = np.isfinite(self.tau[joint])
        right_side = self.tau[joint][is_used]
        if isinstance(self.rows, AssembledRows):
            return self.rows.select(joint, is_used), right_side
        return self.rows[joint][is_used], right_side

    def information(self) -> SquareRootInformation:
        """Return the square-root information of the used rows of this recording."""
        (information,) = information_of([[self]])
        return information

    def where(self, used: Mask) -> DecimatedSamples:
        """Return the equations with fewer rows in use: those where ``used`` is True.

        Args:
            used: (K,) for all joints, or (K, joints).
        """
        # (joints, K): the transpose of a mask (K,) is the mask itself, repeated for each joint.
        masks = np.broadcast_to(used.T, (len(self.tau), len(self)))
        tau = np.where(masks, self.tau, np.nan)
        return replace(self, tau=tuple(tau))

    def only(self, names: tuple[str, ...]) -> DecimatedSamples:
        """Return the equations with the columns of named parameters only, which become ``names``.

        Columns of all other parameters are dropped, not subtracted from the right-hand sides.
        """
        order = dict(zip(names, range(len(names))))
        # (p,) index of each parameter among ``names``, -1 for one that is dropped.
        new_indices = np.array([order.get(name, -1) for name in self.names])
        columns = []
        rows = []
        for joint_rows, joint_columns in zip(self.rows, self.columns):
            indices = new_indices[joint_columns]
            is_kept = indices >= 0
            columns.append(indices[is_kept])
            rows.append(joint_rows[:, is_kept])
        return replace(self, names=names, columns=tuple(columns), rows=tuple(rows))

    def squared_torque(self) -> Array:
        """Return the sum of squares (joints,) of the measured torque over used rows [N^2 m^2]."""
        squares = []
        for tau, measured in zip(self.tau, self.measured):
            squares.append(np.sum(measured[np.isfinite(tau)] ** 2))
        return np.array(squares)


def release_memory() -> None:
    """Give free memory back to the operating system; no effect without glibc.

    glibc keeps freed blocks that lie between blocks in use: with many joints, whose triangles are
    of all sizes, that is a quarter of all memory.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


class _RowFile:
    """A temporary file of rows, deleted with the last reference to it."""

    def __init__(self, file: IO[bytes]) -> None:
        self.file = file

    def __del__(self) -> None:
        self.file.close()


class _StoredRows(Sequence[Array]):
    """Each joint's rows (K, k) in a file, read on access; indexed by joint number.

    Pickling makes a tuple of arrays in memory.

    Args:
        rows: per joint (K, k), appended to the file.
        row_file: may hold rows of other recordings, too.
    """

    def __init__(self, rows: Sequence[Array], row_file: _RowFile) -> None:
        self._row_file = row_file
        # Per joint (offset in the file [bytes], shape (K, k)).
        self._blocks = list[tuple[int, Any]]()
        for block in rows:
            start = row_file.file.seek(0, os.SEEK_END)
            self._blocks.append((start, block.shape))
            row_file.file.write(np.ascontiguousarray(block).data)
        row_file.file.flush()

    def __len__(self) -> int:
        return len(self._blocks)

    def __getitem__(self, joint: Any) -> Any:
        """Return the rows (K, k) of a joint number, read-only."""
        # Mapped, not read: threads share the file and its read position.
        offset, shape = self._blocks[joint]
        file = self._row_file.file
        rows = np.memmap(file, np.float64, mode="r", offset=offset, shape=shape)
        return np.asarray(rows)

    def __reduce__(self) -> tuple[Any, ...]:
        return tuple, (tuple(map(np.array, self)),)


class AssembledRows(Sequence[Array]):
    """Each joint's rows (K, k), assembled on access from blocks of columns, by joint number.

    Most columns do not depend on the linearisation point: they stay in ``base``, which the rows
    around several points share.

    Args:
        base: per joint (K, m) columns that do not depend on the point.
        blocks: per joint its blocks, each (columns, factor): columns are (K, b), or a slice of the
            columns of ``base``; the factor is a number, or (b,) by column.
    """

    def __init__(
        self,
        base: Sequence[Array],
        blocks: Sequence[tuple[tuple[Array | slice, Any], ...]],
    ) -> None:
        self._base = base
        self._blocks = blocks

    def __len__(self) -> int:
        return len(self._blocks)

    def __getitem__(self, joint: Any) -> Any:
        """Return the rows (K, k) of a joint number, in a new array."""
        return self.select(joint, slice(None))

    def select(self, joint: int, used: Mask | slice) -> Array:
        """Return the used rows (m, k) of a joint, without assembling the other rows.

        Args:
            joint: its number.
            used: (K,) mask, or a slice of rows.
        """
        base = self._base[joint]
        columns = []
        for block, factor in self._blocks[joint]:
            block_columns = base[:, block] if isinstance(block, slice) else block
            columns.append(block_columns[used] * factor)
        return np.hstack(columns)


def store_rows(
    samples: Iterable[DecimatedSamples], limit: int = _IN_MEMORY
) -> list[DecimatedSamples]:
    """Return each recording's equations, those of long recordings with rows in a temporary file.

    All long recordings share one file. Without a writable folder, all rows stay in memory.

    Args:
        samples: consumed one by one, so that a generator keeps one recording in memory.
        limit: largest count of numbers in a recording's rows that stay in memory.
    """
    recordings = []
    row_file = None
    for recording in samples:
        if sum(map(np.size, recording.rows)) > limit:
            with contextlib.suppress(OSError):
                row_file = row_file or _RowFile(tempfile.TemporaryFile())  # noqa: SIM115
                stored = _StoredRows(recording.rows, row_file)
                recording = replace(recording, rows=stored)
        recordings.append(recording)
    return recordings


def information_of(
    groups: Collection[Sequence[DecimatedSamples]],
) -> tuple[SquareRootInformation, ...]:
    """Return the square-root information of the used rows of each group of recordings.

    Args:
        groups: one at least, each of one or several recordings; all recordings have to have the
            same names, joints and columns.
    """
    first = next(iter(groups))[0]
    totals = []
    for _ in groups:
        columns = first.columns
        totals.append(InformationAccumulator(first.names, first.joints, columns))
    # Joint by joint: most rows are assembled on access.
    for joint in range(len(first.joints)):
        for total, group in zip(totals, groups):
            total.add(joint, *_used_rows(group, joint))
    return tuple(map(InformationAccumulator.result, totals))


def _used_rows(group: Sequence[DecimatedSamples], joint: int) -> tuple[Array, Array]:
    """Return the used rows (K, k) and right sides (K,) of a joint in all recordings of a group."""
    # A function of its own frees the rows by recording before the triangle is computed.
    rows, right_sides = zip(*[recording.in_use(joint) for recording in group])
    return np.concatenate(rows), np.concatenate(right_sides)


def decimated_equations(
    equations: Equations, signals: ProcessedSignals
) -> DecimatedSamples:
    """Return the equations of a recorded motion, both sides passed through the torque's low-pass.

    Columns of friction that depends on the load are NaN, as the load follows from an estimate.
    Columns of bodies contain no sign of a speed, so that they are smooth and computed at fewer
    instants.

    Args:
        equations: computes rows of a motion, which are not filtered. Its ``bodies`` and
            ``friction`` yield one array (samples, columns + 1) per joint: the columns of
            parameters, then the torque that depends on no parameter.
        signals: the recording of all n joints, filtered.

    Raises:
        InputError: no joint ever moves fast enough for its equations to be used.
    """
    bodies = signals.filter_columns(equations.bodies, smooth=True)
    unknown_load = itertools.repeat(np.array(np.nan))
    friction = signals.filter_columns(
        lambda motion: equations.friction(motion, unknown_load)
    )
    joint_indices = list(equations.joint_indices)
    usable = signals.usable()[:, joint_indices]
    if not np.any(usable):
        check_losses([signals])
        raise InputError(
            f"none of the joints {', '.join(equations.joints)} moves faster than its velocity "
            "deadband for long enough; move faster, and turn round less often"
        )
    tau = signals.low_pass.decimate(signals.tau)[:, joint_indices].T
    pairs = map(assemble_rows, bodies, friction, tau)
    return _samples_of(equations, signals.decimated_time(), pairs, tau).where(usable)


def equations_at(equations: Equations, measurement: Measurement) -> DecimatedSamples:
    """Return the equations at every sample of a measurement, without any filter."""
    tau = measurement.tau[:, list(equations.joint_indices)].T
    return _samples_of(equations, measurement.time, equations.rows(measurement), tau)


def _samples_of(
    equations: Equations,
    time: Array,
    pairs: Iterable[tuple[Array, Array]],
    measured: Array,
) -> DecimatedSamples:
    """Return the record of equations at K instants.

    Args:
        time: (K,) [s].
        pairs: per joint (rows (K, k), right-hand sides (K,) [N m]).
        measured: (joints, K) measured torques [N m].
    """
    rows, tau = zip(*pairs)
    columns = equations.columns
    return DecimatedSamples(
        equations.names, equations.joints, columns, time, rows, tau, tuple(measured)
    )


@dataclass(frozen=True)
class RestingPoses:
    """K poses at which the arm rests: one row each, without speed or acceleration.

    Attributes:
        poses: positions (K, n) and torques (K, n) at rest, averaged over both directions of
            approach; speeds and accelerations are zero.
        used: (K, n) whether a joint's torque may be used, because its friction was averaged out.
    """

    poses: Measurement
    used: Mask


@dataclass(frozen=True)
class Dataset:
    """One recording, or a stretch of it without long holes.

    Attributes:
        name: name of the recording in messages.
        source: the signals of a motion, or the poses at which the arm rests.
        is_loaded: whether the arm carries the payload.
        order: position among all recordings in time, from -1 for the first to 1 for the last; 0
            where the order is not known.
        used: (K,) which rows may be used, or more than K values, of which the first K count; None
            for all rows.
    """

    name: str
    source: ProcessedSignals | RestingPoses
    is_loaded: bool = False
    order: float = 0.0
    used: Mask | None = None

    @property
    def signals(self) -> ProcessedSignals | None:
        """The filtered signals of a motion; None for poses at rest."""
        return None if isinstance(self.source, RestingPoses) else self.source

    @property
    def motion(self) -> Motion:
        """Positions, speeds, accelerations (K, n) at the instants of rows; zero speed at rest."""
        if isinstance(self.source, RestingPoses):
            poses = self.source.poses
            zero = 0.0 * poses.q
            return Motion(poses.time, poses.q, zero, zero)
        return self.source.decimated_motion()

    @property
    def torque(self) -> Array:
        """The measured torque (N, n) [N m] at all samples, before decimation; (K, n) at rest."""
        if isinstance(self.source, RestingPoses):
            return self.source.poses.tau
        return self.source.tau

    def remove_delay(self, delay: float) -> Dataset:
        """Return the recording with its torque shifted earlier by a delay [s]; poses stay."""
        if not delay or isinstance(self.source, RestingPoses):
            return self
        return replace(self, source=with_delay(self.source, delay))

    def delay_column(self, time: Array, torque: Array) -> Array:
        """Return the column (K,) of a torque's lag [N m/s], for a torque (K,) at ``time`` (K,).

        A torque that lags reads tau(t - delay) = tau(t) - delay tau'(t) + O(delay^2). Estimated,
        taken out by ``remove_delay`` and estimated again, the delay converges in a few rounds.
        Torque that follows smoothly from the motion identifies it; dry friction does not, because a
        reversal that is a little early or late looks like a delay: in a closed loop with MuJoCo's
        friction the whole torque's derivative gives -1.9 ms for none, this 0.03 ms. Poses at rest
        have a column of zeros.
        """
        if self.signals is None or len(time) < 2:
            return np.zeros_like(torque)
        return -np.gradient(torque, time)

    def filter_columns(self, make: Callable[[Motion], Array], exact: bool) -> Array:
        """Return columns (K, ...) that depend on the motion.

        Args:
            make: returns columns (m, ...) of a motion of m samples.
            exact: whether to compute the columns at all samples and low-pass them like the torque,
                where the recording is a motion; else they are computed at the K instants only.
        """
        if self.signals is None or not exact:
            return make(self.motion)
        (columns,) = self.signals.filter_columns(lambda motion: (make(motion),))
        return columns

    def samples(self, equations: Equations) -> DecimatedSamples:
        """Return the recording's equations; the right-hand side of an unused row is NaN.

        Raises:
            InputError: no joint ever moves fast enough for its equations to be used.
        """
        if isinstance(self.source, RestingPoses):
            samples = equations_at(equations, self.source.poses)
            samples = samples.where(self.source.used[:, list(equations.joint_indices)])
        else:
            samples = decimated_equations(equations, self.source)
        if self.used is None:
            return samples
        # Removing a delay shortens a recording at its ends, so that the mask may be longer.
        return samples.where(self.used[: len(samples)])


def block_masks(log: DecimatedSamples) -> Iterator[Mask]:
    """Yield the mask (K,) of the rows of each of the ``BLOCKS`` blocks of cross-validation.

    The rows that any joint uses are cut into consecutive stretches of equal size. Block b has the
    stretches b, b + BLOCKS, b + 2 BLOCKS, ...: one in each round of ``BLOCKS`` stretches. There are
    as many rounds as leave every stretch at half of ``LONGEST_STRETCH`` or more, and at least one.

    Raises:
        InputError: the recording has fewer rows in use than blocks.
    """
    rows = np.flatnonzero(np.any(np.isfinite(log.tau), axis=0))
    if len(rows) < BLOCKS:
        raise InputError(
            f"{len(rows)} rows cannot be cut into {BLOCKS} blocks; record longer"
        )
    duration = log.time[-1] - log.time[0]
    rounds = int(max(duration // (BLOCKS * 0.5 * LONGEST_STRETCH), 1))
    count = BLOCKS * min(rounds, len(rows) // BLOCKS)
    edges = np.rint(np.arange(count + 1) * len(rows) / count).astype(int)
    stretches = np.split(rows, edges[1:-1])
    for block in range(BLOCKS):
        mask = np.zeros(len(log), dtype=bool)
        mask[np.concatenate(stretches[block::BLOCKS])] = True
        yield mask


def rms_torque(datasets: Sequence[Dataset]) -> Array:
    """Return the root mean square (n,) of each joint's measured torque in all recordings [N m].

    Raises:
        InputError: the recordings have no sample.
    """
    count = sum(len(dataset.torque) for dataset in datasets)
    if not count:
        raise InputError("there is no sample to identify from")
    squares = sum(np.sum(dataset.torque**2, axis=0) for dataset in datasets)
    return np.asarray(np.sqrt(squares / count))


def motion_signals(datasets: Iterable[Dataset]) -> list[ProcessedSignals]:
    """Return the filtered signals of the recordings that are motions, not poses at rest."""
    return [dataset.signals for dataset in datasets if dataset.signals is not None]
