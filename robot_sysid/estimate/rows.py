"""Recordings as rows: motion and torque at the instants of equations, and sums over them.

Shapes: a recording has K rows (instants) and n joints; "joints" counts those with equations, J; p
parameters have columns. An equation reads row (k,) x = torque [N m]. Rows are made and squared a
few at a time, so that memory does not grow with a log: of a log only its signals and its sums stay.
"""

from __future__ import annotations

import itertools
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.inverse_dynamics import LinkDynamics, LinksMotion
from robot_sysid.errors import InputError, prefix_input_errors
from robot_sysid.estimate.identifiability import RELATIVE_CUT
from robot_sysid.records import Array, Measurement, Motion, RobotModel
from robot_sysid.signals.process import (
    LogPiece,
    ProcessedSignals,
    check_losses,
    process,
)

Mask = NDArray[np.bool_]
"""Boolean mask, True where a row is used."""
BLOCKS = 10
"""Number of blocks that held-out validation and the jackknife leave out in turn."""
LEAST_BLOCKS = 3
"""Least number of blocks of one log, of several."""
MOTION = ("time", "q", "qd", "qdd")
"""Names of the fields of a motion."""
# Numbers in the columns of one chunk of rows: bounds memory, changes no result.
_NUMBERS = 4_000_000


class Stretch(NamedTuple):
    """A stretch of time in which something touched the arm: begin and end [s], joints (J,)."""

    start: float
    stop: float
    joints: NDArray[np.bool_]


@dataclass(frozen=True)
class Recording:
    """One log, or a stretch of it without long holes, as K rows.

    Attributes:
        name: of the log, in messages.
        signals: the low-passed signals of its motion.
        is_loaded: whether the arm carries the payload.
        order: position among all recordings in time, from -1 for the first to 1 for the last; 0
            where the order is not known.
        touched: stretches in which torque is left over that is ordinary at no other time.
        every: of how many rows one counts.
    """

    name: str
    signals: ProcessedSignals
    is_loaded: bool = False
    order: float = 0.0
    touched: tuple[Stretch, ...] = ()
    every: int = 1
    _kept: dict[object, Any] = field(default_factory=dict, compare=False)

    def __len__(self) -> int:
        """Return the number K of rows."""
        return len(self.motion.time)

    @cached_property
    def motion(self) -> Motion:
        """Positions, speeds, accelerations (K, n) at the instants of rows."""
        motion = vars(self.signals.decimated_motion())
        return Motion(*(motion[name][:: self.every] for name in MOTION))

    @cached_property
    def torque(self) -> Array:
        """The measured torque (K, n), low-passed like the columns [N m]."""
        return self.signals.low_pass.decimate(self.signals.tau)[:: self.every]

    @cached_property
    def used(self) -> Mask:
        """Which rows (K, n) may be used: of joints with torque, where friction has a direction."""
        has_torque = np.any(self.signals.tau, axis=0)
        return self.signals.usable()[:: self.every] & has_torque

    @cached_property
    def at_turns(self) -> Mask:
        """Which rows (K, n) lie where a joint may be standing because it turns round."""
        return self.signals.at_turns()[:: self.every]

    def without_turns(self, joints: Sequence[int]) -> Recording:
        """Return the recording in which rows at turns of some joints are not used."""
        kept = np.ones_like(self.used)
        kept[:, joints] = ~self.at_turns[:, joints]
        return self.only(kept)

    def only(self, rows: Mask) -> Recording:
        """Return the recording in which some rows, (K,) or (K, n), are used at most."""
        smaller = replace(self)
        smaller.__dict__["used"] = (self.used.T & rows.T).T
        return smaller

    def low_passed(self, key: object, make: Callable[[Motion], Array]) -> Array:
        """Return columns (K, ...) made from the motion at all samples, and low-passed.

        What has the sign of a speed has to pass the filter that the torque has passed. Results are
        kept by their ``key``: do not change them.
        """
        if key not in self._kept:
            self._kept[key] = self.signals.filter_columns(make)[:: self.every]
        return self._kept[key]

    def links_torque(self, robot: RobotModel, gravity: Array, thetas: Array) -> Array:
        """Return the torque (K, n) of links with parameters ``thetas`` (n, 10) [N m]."""
        key = "links", gravity.tobytes(), thetas.tobytes()
        if key not in self._kept:
            chunks = self.chunks(36 * robot.n_joints)
            torques = [rows.moves(robot, gravity).torque(thetas) for rows in chunks]
            self._kept[key] = np.concatenate(torques)
        return self._kept[key]

    def chunks(self, width: int) -> Iterator[Rows]:
        """Yield the rows in chunks, of which columns ``width`` numbers wide fit in memory."""
        size = max(1, _NUMBERS // max(width, 1))
        for start in range(0, len(self), size):
            yield Rows(self, slice(start, min(start + size, len(self))))


@dataclass(frozen=True)
class Rows:
    """Successive rows of a recording: columns of terms are made chunk by chunk, to bound memory."""

    recording: Recording
    span: slice

    @property
    def motion(self) -> Motion:
        """The motion (m, n) at these rows."""
        fields = vars(self.recording.motion)
        return Motion(*(fields[name][self.span] for name in MOTION))

    def moves(self, robot: RobotModel, gravity: Array) -> LinksMotion:
        """Return the motion of an arm's links at these rows, gravity (3,) in the world frame."""
        motion = self.motion
        return LinkDynamics(robot, gravity).motion(motion.q, motion.qd, motion.qdd)

    @property
    def is_loaded(self) -> bool:
        """Whether the arm carries the payload."""
        return self.recording.is_loaded

    def low_passed(self, key: object, make: Callable[[Motion], Array]) -> Array:
        """Return ``Recording.low_passed`` at these rows."""
        return self.recording.low_passed(key, make)[self.span]


@dataclass(frozen=True)
class Sums:
    """Squares of all rows, block by block: all that a fit needs of recordings.

    Attributes:
        names: (p,) of the parameters.
        joints: names of the J joints with equations.
        columns: per joint (k,) indices of the parameters in its equations.
        grams: per joint (B, k + 1, k + 1) the products [A b]' [A b] of each block's rows.
        lagged: per joint (B, k + 1, k + 1) the products of each row with the next one, made
            symmetric.
        counts: (B, J) number of rows.
        logs: (B,) the log that a block belongs to.
    """

    names: tuple[str, ...]
    joints: tuple[str, ...]
    columns: tuple[NDArray[np.int64], ...]
    grams: tuple[Array, ...]
    lagged: tuple[Array, ...]
    counts: Array
    logs: tuple[str, ...]

    @property
    def blocks(self) -> range:
        """Numbers of all B blocks."""
        return range(len(self.logs))

    def at(self, names: Sequence[str]) -> NDArray[np.int64]:
        """Return the indices of named parameters."""
        return np.array([self.names.index(name) for name in names], dtype=np.int64)

    @cached_property
    def totals(self) -> tuple[Array, ...]:
        """Per joint (k + 1, k + 1) the products of all blocks."""
        return tuple(gram.sum(axis=0) for gram in self.grams)

    @cached_property
    def lagged_totals(self) -> tuple[Array, ...]:
        """Per joint (k + 1, k + 1) the products of successive rows of all blocks."""
        return tuple(lagged.sum(axis=0) for lagged in self.lagged)

    @cached_property
    def squared_torque(self) -> Array:
        """Sum of squares (B, J) of the right-hand sides [N^2 m^2]."""
        return np.stack([gram[:, -1, -1] for gram in self.grams], axis=1)

    @cached_property
    def rms_torque(self) -> Array:
        """Root mean square (J,) of the right-hand sides [N m]; zero of a joint without rows."""
        counts = np.maximum(np.sum(self.counts, axis=0), 1.0)
        return np.sqrt(np.sum(self.squared_torque, axis=0) / counts)

    @cached_property
    def squares(self) -> Array:
        """Sum of squares (J, p) of each parameter's column in each joint's rows."""
        squares = np.zeros((len(self.joints), len(self.names)))
        for joint, columns in enumerate(self.columns):
            squares[joint, columns] = np.diag(self.totals[joint])[:-1]
        return squares

    def normal(self, weights: Array, blocks: Sequence[int] | None = None) -> Array:
        """Return the normal matrix (p + 1, p + 1) of weighted rows.

        Args:
            weights: (J,) of each joint's rows [1/(N m)].
            blocks: those that count; None for all.
        """
        size = len(self.names)
        normal = np.zeros((size + 1, size + 1))
        for joint, weight in enumerate(weights):
            gram = self.totals[joint]
            if blocks is not None:
                gram = self.grams[joint][list(blocks)].sum(axis=0)
            at = np.append(self.columns[joint], size)
            normal[np.ix_(at, at)] += weight**2 * gram
        return normal

    def of(self, names: Sequence[str], held: Array) -> Sums:
        """Return the sums in named parameters alone, the torque of all others subtracted.

        ``held`` (p,) are the values of the others.
        """
        index = self.at(names)
        number = np.full(len(self.names), -1, dtype=np.int64)
        number[index] = np.arange(len(index))
        columns = []
        grams = []
        for own, gram in zip(self.columns, self.grams):
            estimated = np.flatnonzero(number[own] >= 0)
            others = np.flatnonzero((number[own] < 0) & (held[own] != 0.0))
            torque = gram[:, :, -1] - gram[:, :, others] @ held[own[others]]
            at = np.append(estimated, len(own))
            reduced = gram[:, at[:, None], at]
            reduced[:, -1] = reduced[:, :, -1] = torque[:, at]
            reduced[:, -1, -1] -= torque[:, others] @ held[own[others]]
            columns.append(number[own[estimated]])
            grams.append(reduced)
        return replace(
            self,
            names=tuple(names),
            columns=tuple(columns),
            grams=tuple(grams),
            lagged=(),
        )

    def squared_residuals(self, values: Array, block: int | None = None) -> Array:
        """Return each joint's sum of squared residuals (J,) at values (p,) [N^2 m^2]."""
        sums = []
        for joint, columns in enumerate(self.columns):
            gram = self.totals[joint] if block is None else self.grams[joint][block]
            change = np.append(-values[columns], 1.0)
            sums.append(max(change @ gram @ change, 0.0))
        return np.array(sums)

    def products(
        self,
        at: NDArray[np.int64],
        joint: int,
        shares: Array | None = None,
        lagged: bool = False,
    ) -> tuple[Array, Array]:
        """Return the products of columns with all others (m, p + 1) and with themselves (m, m).

        Args:
            at: (m,) indices of the columns.
            joint: whose rows are summed.
            shares: (B,) by which the columns are multiplied in each block; None for one.
            lagged: whether products are those of successive rows.
        """
        own = np.append(self.columns[joint], len(self.names))
        places = np.minimum(np.searchsorted(own, at), len(own) - 2)
        is_shown = own[places] == at
        shares = np.ones(len(self.logs)) if shares is None else shares
        of_blocks = (self.lagged if lagged else self.grams)[joint][:, places[is_shown]]
        rows = np.zeros((len(at), len(self.names) + 1))
        rows[np.ix_(is_shown, own)] = np.tensordot(shares, of_blocks, 1)
        squares = np.zeros((len(at), len(at)))
        squares[np.ix_(is_shown, is_shown)] = np.tensordot(
            shares**2, of_blocks[:, :, places[is_shown]], 1
        )
        return rows, squares

    def with_torque_times(self, factors: Array) -> Sums:
        """Return the sums with each joint's right-hand sides times a factor (J,)."""
        kinds = []
        for kind in (self.grams, self.lagged):
            scaled = [gram.copy() for gram in kind]
            for gram, factor in zip(scaled, factors):
                gram[:, -1] *= factor
                gram[:, :, -1] *= factor
            kinds.append(tuple(scaled))
        return replace(self, grams=kinds[0], lagged=kinds[1])

    def with_columns(
        self,
        names: Sequence[str],
        at: NDArray[np.int64],
        factor: Array,
        joint: int | None = None,
        shares: Array | None = None,
    ) -> Sums:
        """Return the sums with new columns (r,) that are columns (m,) times a factor (m, r).

        The other arguments are as in ``products``; without a joint they act at all of them.
        """
        new = np.arange(len(names)) + len(self.names)
        shares = np.ones(len(self.logs)) if shares is None else shares
        all_columns = []
        kinds: tuple[list[Array], list[Array]] = ([], [])
        for number, columns in enumerate(self.columns):
            own = np.append(columns, len(self.names))
            places = np.minimum(np.searchsorted(own, at), len(own) - 2)
            is_shown = own[places] == at
            mix = np.zeros((len(own), len(new)))
            if joint in (None, number):
                mix[places[is_shown]] = factor[is_shown]
            turn = np.zeros((len(shares), len(own), len(own) + len(new)))
            turn[:, :-1, : len(columns)] = np.eye(len(columns))
            turn[:, :, len(columns) : -1] = shares[:, None, None] * mix
            turn[:, -1, -1] = 1.0
            all_columns.append(np.append(columns, new))
            for wider, kind in zip(kinds, (self.grams, self.lagged)):
                wider.append(np.swapaxes(turn, 1, 2) @ kind[number] @ turn)
        return replace(
            self,
            names=(*self.names, *names),
            columns=tuple(all_columns),
            grams=tuple(kinds[0]),
            lagged=tuple(kinds[1]),
        )

    def successive(self, values: Array) -> Array:
        """Return each joint's sum of products of successive residuals (J,) at values (p,)."""
        sums = []
        for columns, lagged in zip(self.columns, self.lagged_totals):
            change = np.append(-values[columns], 1.0)
            sums.append(change @ lagged @ change)
        return np.array(sums)

    def spread(self, covariance: Array, block: int | None = None) -> Array:
        """Return each joint's sum of squares (J,) to expect of errors in parameters [N^2 m^2].

        ``covariance`` (p, p) is that of the errors.
        """
        sums = []
        for joint, columns in enumerate(self.columns):
            gram = self.totals[joint] if block is None else self.grams[joint][block]
            sums.append(np.vdot(gram[:-1, :-1], covariance[np.ix_(columns, columns)]))
        return np.array(sums)


def block_numbers(
    recordings: Sequence[Recording],
) -> tuple[list[NDArray[np.int64]], list[str]]:
    """Return per recording the block (K,) of each row, and the log of each block.

    Blocks are stretches of time of one log; stretches of one name are one log.
    """
    names = list(dict.fromkeys(recording.name for recording in recordings))
    per_log = (
        max(LEAST_BLOCKS, round(BLOCKS / len(names))) if len(names) > 1 else BLOCKS
    )
    numbers: list[NDArray[np.int64]] = []
    in_use = [np.any(recording.used, axis=1) for recording in recordings]
    totals: Counter[str] = Counter()
    for recording, is_used in zip(recordings, in_use):
        totals[recording.name] += int(np.count_nonzero(is_used))
    done: Counter[str] = Counter()
    for recording, is_used in zip(recordings, in_use):
        name = recording.name
        position = done[name] + np.cumsum(is_used) - is_used
        done[name] += int(np.count_nonzero(is_used))
        block = position * per_log // max(totals[name], 1)
        numbers.append(names.index(name) * per_log + np.minimum(block, per_log - 1))
    return numbers, [name for name in names for _ in range(per_log)]


def add_up(
    recordings: Sequence[Recording],
    names: Sequence[str],
    joints: Sequence[str],
    make: Callable[[Rows], tuple[Array, Array, Mask]],
) -> Sums:
    """Return the sums of all rows; columns that are nothing but rounding are zero.

    Args:
        recordings: one at least.
        names: (p,) of the parameters.
        joints: names of the J joints with equations.
        make: returns (columns (m, J, p), right-hand sides (m, J), used (m, J)) of a chunk.

    Raises:
        InputError: no row can be used.
    """
    numbers, logs = block_numbers(recordings)
    width = len(names) * len(joints)
    joint_sums = [_JointSums(len(logs)) for _ in joints]
    for recording, blocks in zip(recordings, numbers):
        for rows in recording.chunks(width):
            columns, tau, used = make(rows)
            for joint, sums in enumerate(joint_sums):
                block = np.where(used[:, joint], blocks[rows.span], -1)
                sums.add(columns[:, joint], tau[:, joint], block)
    counts = np.stack([sums.counts for sums in joint_sums], axis=1)
    if not np.any(counts):
        raise InputError(
            f"none of the joints {', '.join(joints)} moves faster than its velocity deadband for "
            "long enough; move faster, and turn round less often"
        )
    for sums in joint_sums:
        sums.clear_rounding()
    return Sums(
        tuple(names),
        tuple(joints),
        tuple(sums.columns for sums in joint_sums),
        tuple(sums.grams for sums in joint_sums),
        tuple(sums.lagged for sums in joint_sums),
        counts,
        tuple(logs),
    )


class _JointSums:
    """Products of one joint's rows, of the columns that have not been zero so far.

    Attributes:
        columns: (k,) indices of these columns.
        grams: (B, k + 1, k + 1) products of each block.
        lagged: (B, k + 1, k + 1) products of successive rows of each block.
        counts: (B,) number of rows.
    """

    def __init__(self, blocks: int) -> None:
        self.columns = np.zeros(0, dtype=np.int64)
        self.grams = np.zeros((blocks, 1, 1))
        self.lagged = self.grams
        self.counts = np.zeros(blocks)
        self._last: tuple[int, Array] = (-1, np.zeros(0))

    def add(self, rows: Array, tau: Array, block: NDArray[np.int64]) -> None:
        """Add rows (m, p) with right-hand sides (m,); ``block`` (m,) is -1 of an unused one."""
        present = np.flatnonzero(np.any(rows != 0.0, axis=0))
        columns = np.union1d(self.columns, present)
        if len(columns) > len(self.columns):
            size = len(columns) + 1
            at = np.append(np.searchsorted(columns, self.columns), size - 1)
            products = np.zeros((2, len(self.grams), size, size))
            products[:, :, at[:, None], at] = self.grams, self.lagged
            self.columns = columns
            self.grams, self.lagged = products
        full = np.column_stack((rows, tau))
        at = np.append(columns, -1)
        for number in np.unique(block[block >= 0]).tolist():
            own = full[block == number]
            before, last = self._last
            self._last = number, own[-1]
            self.counts[number] += len(own)
            own = own[:, at]
            self.grams[number] += own.T @ own
            if before == number:
                own = np.vstack((last[at], own))
            products = own[:-1].T @ own[1:]
            self.lagged[number] += 0.5 * (products + products.T)

    def clear_rounding(self) -> None:
        """Set the products of columns that are nothing but rounding to zero."""
        squares = np.diag(self.grams.sum(axis=0))[:-1]
        is_noise = squares <= RELATIVE_CUT**2 * np.max(squares, initial=0.0)
        at = np.flatnonzero(is_noise)
        for products in (self.grams, self.lagged):
            products[:, at] = 0.0
            products[:, :, at] = 0.0


@dataclass(frozen=True)
class Piece:
    """A stretch of a recording without long holes, as it was measured.

    Attributes:
        name: the recording's name in messages.
        samples: measured positions and torques.
        is_loaded: whether the arm carries the payload.
        order: its position in the order of recording, from -1 for the first to 1 for the last; 0
            where the order is not known.
    """

    name: str
    samples: Measurement
    is_loaded: bool = False
    order: float = 0.0


def low_pass_recordings(
    robot: RobotModel, pieces: Sequence[Piece], cutoff: float | None = None
) -> tuple[list[Recording], tuple[str, ...]]:
    """Resample every recording to a uniform grid and low-pass it, all with the same cut-off.

    Args:
        robot: the arm with its model.
        pieces: stretches of recordings, each of which becomes one recording.
        cutoff: of the low-pass [Hz]; None for the lowest that any of them requires.

    Returns:
        (recordings, one per piece; notes on them, one sentence each).

    Raises:
        InputError: a recording is too short.
    """
    # Copies, so that what is computed on the way goes when this is done.
    resampled = [LogPiece.of(replace(piece.samples)) for piece in pieces]
    cutoffs = []
    for piece, log in zip(pieces, resampled):
        with prefix_input_errors(piece.name):
            cutoffs.append(cutoff or log.choice.cutoff)
    recordings = []
    processed: defaultdict[str, list[ProcessedSignals]] = defaultdict(list)
    for piece, log, required in zip(pieces, resampled, cutoffs):
        given = min(cutoffs) if required > min(cutoffs) else cutoff
        with prefix_input_errors(piece.name):
            signals = process(log, robot.joint_names, given, robot.slides)
        processed[piece.name].append(signals)
        recordings.append(Recording(piece.name, signals, piece.is_loaded, piece.order))
    notes = {}
    for name, of_log in processed.items():
        with prefix_input_errors(name):
            check_losses(of_log)
        notes[name] = [note for signals in of_log for note in signals.notes]
    return recordings, tuple(shared_notes(notes))


def shared_notes(notes_by_name: Mapping[str, Collection[str]]) -> Iterator[str]:
    """Yield each note once, with the names of its recordings where there are several recordings.

    Args:
        notes_by_name: name of a recording to its notes; a note may be a subclass of ``str``.
    """
    all_notes = dict.fromkeys(itertools.chain(*notes_by_name.values()))
    for note in all_notes:
        about = [name for name, notes in notes_by_name.items() if note in notes]
        where = ", ".join(about)
        if len(about) == len(notes_by_name):
            where = "all recordings"
        yield note if len(notes_by_name) == 1 else type(note)(f"{where}: {note}")
