"""One recording as equations: filtered motion, or poses at which the arm rests."""

from __future__ import annotations

import contextlib
import itertools
import tempfile
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.equations import Equations, joined
from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.information import InformationAccumulator
from robot_sysid.records import Array, Measurement, Motion, SquareRootInformation
from robot_sysid.signals.process import ProcessedSignals, with_delay

Mask = NDArray[np.bool_]
BLOCKS, LONGEST_STRETCH = 5, 10.0
"""How many parts recordings are predicted in, each from the others. A part is every fifth stretch
of a recording; stretches are less than so long [s], as a motion may show a joint for a while."""
# Numbers per pass: memory stays small, results are the same for any.
_NUMBERS = 8_000_000
# Numbers in a recording's rows that are kept in memory: of an arm of seven joints, half a minute's.
_IN_MEMORY = 250_000


@dataclass(frozen=True)
class DecimatedSamples:
    """Equations of some joints at K instants; iterating over it is one pass over the data.

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
    rows: Sequence[Array]
    tau: tuple[Array, ...]
    measured: tuple[Array, ...]

    def __len__(self) -> int:
        return len(self.time)

    def __iter__(self) -> Iterator[tuple[int, Array, Array]]:
        """Yield (joint number, rows, right-hand sides) of each joint."""
        return zip(range(len(self.rows)), self.rows, self.tau)

    def in_use(self, joint: int) -> tuple[Array, Array]:
        """Return a joint's rows (m, k) and right-hand sides (m,) of the samples in use."""
        used, rows = np.isfinite(self.tau[joint]), self.rows
        some = rows.some(joint, used) if isinstance(rows, RowsBeside) else rows[joint][used]
        return some, self.tau[joint][used]

    def information(self) -> SquareRootInformation:
        """Return the square-root information of the samples in use."""
        return information_of([[self]])[0]

    def where(self, used: Mask) -> DecimatedSamples:
        """Return the samples without those for which ``used``, (K,) or (K, joints), is false."""
        each = np.broadcast_to(used.T, (len(self.tau), len(self)))
        return replace(self, tau=tuple(np.where(ok, t, np.nan) for ok, t in zip(each, self.tau)))

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


class _RowFile:
    """A temporary file of rows; it goes with the last of them."""

    def __init__(self, file: IO[bytes]) -> None:
        self.file = file

    def __del__(self) -> None:
        self.file.close()


class _StoredRows(Sequence[Array]):
    """Each joint's rows in a file, looked up when they are asked for."""

    def __init__(self, rows: Sequence[Array], to: _RowFile) -> None:
        self._in, self._places = to, list[tuple[int, Any]]()
        for each in rows:
            self._places.append((to.file.seek(0, 2), each.shape))
            to.file.write(np.ascontiguousarray(each).data)
        to.file.flush()

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, joint: Any) -> Any:
        # Mapped, not read: threads share the file, and the place at which it is read.
        start, shape = self._places[joint]
        return np.asarray(np.memmap(self._in.file, np.float64, "r", start, shape))

    def __reduce__(self) -> tuple[Any, ...]:
        return tuple, (tuple(map(np.array, self)),)


class RowsBeside(Sequence[Array]):
    """Each joint's rows, from parts side by side, each with what it is multiplied by.

    They are put together when they are asked for: most of them are the same around any point, and
    stand in ``base``, of which a part may be some columns.
    """

    def __init__(
        self, base: Sequence[Array], parts: Sequence[tuple[tuple[Array | slice, Any], ...]]
    ) -> None:
        self._base, self._parts = base, parts

    def __len__(self) -> int:
        return len(self._parts)

    def __getitem__(self, joint: Any) -> Any:
        return self.some(joint, slice(None))

    def some(self, joint: int, used: Mask | slice) -> Array:
        """Return some rows of a joint, which is less than all of them take."""
        base = self._base[joint]
        pairs = [(base[:, p] if isinstance(p, slice) else p, f) for p, f in self._parts[joint]]
        return np.hstack([part[used] * factor for part, factor in pairs])


def stored(samples: Iterable[DecimatedSamples], most: int = _IN_MEMORY) -> list[DecimatedSamples]:
    """Return each recording's samples, with rows of more than so many numbers in a file."""
    found, file = list[DecimatedSamples](), None
    for each in samples:
        if sum(rows.size for rows in each.rows) > most:
            with contextlib.suppress(OSError):  # where nothing can be written, memory has to do
                file = file or _RowFile(tempfile.TemporaryFile())  # noqa: SIM115
                each = replace(each, rows=_StoredRows(each.rows, file))
        found.append(each)
    return found


def information_of(
    parts: Collection[Sequence[DecimatedSamples]],
) -> tuple[SquareRootInformation, ...]:
    """Return the square-root information of all samples in use, of several recordings in each."""
    (first, *_), *_ = parts
    found = [InformationAccumulator(first.names, first.joints, first.columns) for _ in parts]
    # Joint by joint: most rows are made when they are asked for.
    for index, (accumulator, part) in itertools.product(
        range(len(first.joints)), zip(found, parts)
    ):
        accumulator.add(index, *map(np.concatenate, zip(*[e.in_use(index) for e in part])))
    return tuple(each.result() for each in found)


def decimated_equations(equations: Equations, signals: ProcessedSignals) -> DecimatedSamples:
    """Build the equations of the motion and pass both sides through the same low-pass.

    Friction that depends on the load is not among them: its columns are NaN.

    Raises:
        InputError: no joint ever moves fast enough for its equations to be used.
    """
    width = sum(len(each) for each in equations.columns)
    bodies = signals.passed(equations.bodies, smooth=True, most=max(1, _NUMBERS // width))
    unknown = itertools.repeat(np.array(np.nan))
    friction = signals.passed(lambda motion: equations.friction(motion, unknown))
    usable = signals.usable()[:, list(equations.rows_of)]
    if not np.any(usable):
        raise InputError(
            f"none of the joints {', '.join(equations.joints)} moves faster than its velocity "
            "deadband for long enough; move faster, and turn round less often"
        )
    tau = signals.low_pass.decimated(signals.tau)[:, list(equations.rows_of)].T
    pairs = map(joined, bodies, friction, tau)
    return _samples_of(equations, signals.decimated_time(), pairs, tau).where(usable)


def equations_at(equations: Equations, measurement: Measurement) -> DecimatedSamples:
    """Return the equations at every sample of a measurement."""
    tau = measurement.tau[:, list(equations.rows_of)].T
    return _samples_of(equations, measurement.time, equations.rows(measurement), tau)


def _samples_of(
    equations: Equations, time: Array, pairs: Iterable[tuple[Array, Array]], measured: Array
) -> DecimatedSamples:
    """Return samples from rows and right-hand side per joint, and the whole torque (joints, K)."""
    rows, tau = zip(*pairs)
    columns = equations.columns
    return DecimatedSamples(
        equations.names, equations.joints, columns, time, rows, tau, tuple(measured)
    )


@dataclass(frozen=True)
class RestingPoses:
    """Poses at which the arm rests: one sample each, without speed or acceleration, ``used`` (K, n)
    where a joint's friction was averaged away.
    """

    poses: Measurement
    used: Mask


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
            poses, still = self.source.poses, 0.0 * self.source.poses.q
            return Motion(poses.time, poses.q, still, still)
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

    def samples(self, equations: Equations) -> DecimatedSamples:
        """Return the rows of some equations, those in use."""
        if isinstance(self.source, RestingPoses):
            found = equations_at(equations, self.source.poses)
            found = found.where(self.source.used[:, list(equations.rows_of)])
        else:
            found = decimated_equations(equations, self.source)
        # A delay shortens recordings at their ends; what is used then ends earlier.
        return found if self.used is None else found.where(self.used[: len(found)])


def block_masks(log: DecimatedSamples) -> Iterator[Mask]:
    """Yield, per block, which rows (K,) of a recording are in it.

    Raises:
        InputError: the recording has fewer rows in use than blocks.
    """
    rows = np.flatnonzero(np.any([np.isfinite(tau) for tau in log.tau], axis=0))
    if len(rows) < BLOCKS:
        raise InputError(f"{len(rows)} rows cannot be cut into {BLOCKS} blocks; record longer")
    rounds = int(max((log.time[-1] - log.time[0]) // (BLOCKS * 0.5 * LONGEST_STRETCH), 1))
    count = BLOCKS * min(rounds, len(rows) // BLOCKS)
    edges = [round(k * len(rows) / count) for k in range(count + 1)]
    for block in range(BLOCKS):
        mask = np.zeros(len(log), dtype=bool)
        for k in range(block, count, BLOCKS):
            mask[rows[edges[k] : edges[k + 1]]] = True
        yield mask


def mean_torque(datasets: Sequence[Dataset]) -> Array:
    """Return (n,) root mean square of each joint's measured torque [N m]."""
    squares = sum(np.sum(each.torque**2, axis=0) for each in datasets)
    count = sum(len(each.torque) for each in datasets)
    if not count:
        raise InputError("there is no sample to identify from")
    return np.asarray(np.sqrt(squares / count))
