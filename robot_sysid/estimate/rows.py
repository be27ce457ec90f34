"""Recordings as rows: motion and torque at the instants of equations, and sums over them.

Shapes: a recording has K rows (instants) and n joints; "joints" counts those with equations, J; p
parameters have columns. An equation reads row (k,) x = torque [N m]. Rows are made and squared a
few at a time, so that memory does not grow with a log: of a log only its signals and its sums stay.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.inverse_dynamics import ARRAY_SIZE, LinkDynamics, LinksMotion
from robot_sysid.errors import prefix_input_errors
from robot_sysid.estimate.identifiability import RELATIVE_CUT
from robot_sysid.records import Array, Measurement, Motion, RobotModel
from robot_sysid.signals.process import ProcessedSignals, check_losses, process
from robot_sysid.signals.resampling import resample_uniformly

Mask = NDArray[np.bool_]
"""Boolean mask, True where a row is used."""
LEAST_NOISE = 1e-4
"""Least noise of a joint, as a share of the root mean square torque of all: the error of filtering.
"""
BLOCKS = 10
"""Number of blocks that held-out validation and the jackknife leave out in turn."""


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
        return motion_at(self.signals.decimated_motion(), slice(None, None, self.every))

    @cached_property
    def torque(self) -> Array:
        """The measured torque (K, n), low-passed like the columns [N m]."""
        return self.signals.low_pass.decimate(self.signals.tau)[:: self.every]

    @property
    def has_torque(self) -> Mask:
        """Which joints (n,) have a torque: it is zero throughout where no sensor measured it."""
        return np.any(self.signals.tau, axis=0)

    @cached_property
    def used(self) -> Mask:
        """Which rows (K, n) may be used: of joints with torque, where friction has a direction."""
        return self.signals.usable()[:: self.every] & self.has_torque

    @cached_property
    def at_turns(self) -> Mask:
        """Which rows (K, n) lie where a joint may be standing because it turns round."""
        return self.signals.at_turns()[:: self.every]

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
        size = max(1, ARRAY_SIZE // max(width, 1))
        for start in range(0, len(self), size):
            yield Rows(self, slice(start, min(start + size, len(self))))


@dataclass(frozen=True)
class Rows:
    """Successive rows of a recording: columns of terms are made chunk by chunk, to bound memory."""

    recording: Recording
    span: slice
    _moves: dict[bytes, LinksMotion] = field(default_factory=dict, compare=False)

    @cached_property
    def motion(self) -> Motion:
        """The motion (m, n) at these rows."""
        return motion_at(self.recording.motion, self.span)

    def moves(self, robot: RobotModel, gravity: Array) -> LinksMotion:
        """Return the motion of an arm's links at these rows, gravity (3,) in the world frame."""
        key = gravity.tobytes()
        if key not in self._moves:
            motion = self.motion
            dynamics = LinkDynamics(robot, gravity)
            self._moves[key] = dynamics.motion(motion.q, motion.qd, motion.qdd)
        return self._moves[key]

    def at_rest(self, robot: RobotModel, gravity: Array) -> LinksMotion:
        """Return an arm's links at rest in the positions of these rows, gravity as in ``moves``."""
        q = self.motion.q
        still = np.zeros_like(q)
        return LinkDynamics(robot, gravity).motion(q, still, still)

    @property
    def is_loaded(self) -> bool:
        """Whether the arm carries the payload."""
        return self.recording.is_loaded

    def low_passed(self, key: object, make: Callable[[Motion], Array]) -> Array:
        """Return ``Recording.low_passed`` at these rows."""
        return self.recording.low_passed(key, make)[self.span]


def motion_at(motion: Motion, rows: slice) -> Motion:
    """Return some rows of a motion, without what a motion may have beside."""
    return Motion(motion.time[rows], motion.q[rows], motion.qd[rows], motion.qdd[rows])


def indices_of(names: Sequence[str], all_names: Sequence[str]) -> NDArray[np.int64]:
    """Return the indices of some names among all."""
    return np.array([all_names.index(name) for name in names], dtype=np.int64)


@dataclass(frozen=True)
class Sums:
    """Squares of all rows, block by block: all that a fit needs of recordings.

    Attributes:
        names: (p,) of the parameters.
        joints: names of the J joints with equations.
        columns: per joint (k,) indices of the parameters in its equations, and p for the torque.
        products: per joint (2, B, k, k) the products [A b]' [A b] of each block's rows, and those
            of each row with the next one, made symmetric.
        counts: (B, J) number of rows.
        logs: (B,) the log that a block belongs to.
        triangles: (J, p + 1, p + 1) triangles R of each joint with R' R = [A b]' [A b], of all
            parameters, which keep the digits that products lose; None where nobody asked for them.
    """

    names: tuple[str, ...]
    joints: tuple[str, ...]
    columns: tuple[NDArray[np.int64], ...]
    products: tuple[Array, ...]
    counts: Array
    logs: tuple[str, ...]
    triangles: Array | None = None

    @property
    def blocks(self) -> range:
        """Numbers of all B blocks."""
        return range(len(self.logs))

    def is_of(self, log: str) -> Mask:
        """Return which blocks (B,) are of a log."""
        return np.array(self.logs) == log

    @cached_property
    def totals(self) -> tuple[Array, ...]:
        """Per joint (k, k) the products of all blocks."""
        return tuple(rows.sum(axis=0) for rows, _ in self.products)

    @cached_property
    def lagged_totals(self) -> tuple[Array, ...]:
        """Per joint (k, k) the products of successive rows of all blocks."""
        return tuple(lagged.sum(axis=0) for _, lagged in self.products)

    @cached_property
    def row_counts(self) -> Array:
        """Number (J,) of each joint's rows, one at least."""
        return np.maximum(np.sum(self.counts, axis=0), 1.0)

    @cached_property
    def squared_torque(self) -> Array:
        """Sum of squares (B, J) of the right-hand sides [N^2 m^2]."""
        return np.stack([rows[:, -1, -1] for rows, _ in self.products], axis=1)

    @cached_property
    def rms_torque(self) -> Array:
        """Root mean square (J,) of the right-hand sides [N m]; zero of a joint without rows."""
        return np.sqrt(np.sum(self.squared_torque, axis=0) / self.row_counts)

    def noise(self, squares: Array, leverage: Array) -> Array:
        """Return the noise (J,) of residuals with sums of squares (J,) [N m].

        It is sigma_j^2 = |r_j|^2 / (n_j - l_j), ``leverage`` l_j (J,) the number of parameters that
        the joint's rows determine.
        """
        freedom = np.maximum(self.row_counts - leverage, 1.0)
        return self.noise_above_least(np.sqrt(squares / freedom))

    def noise_above_least(self, noise: Array) -> Array:
        """Return a noise (J,) that is nowhere below the least that rows have [N m]."""
        least = LEAST_NOISE * np.sqrt(np.mean(self.rms_torque**2))
        return np.maximum(noise, max(least, 1e-12))

    @cached_property
    def squares(self) -> Array:
        """Sum of squares (J, p) of each parameter's column in each joint's rows."""
        squares = np.zeros((len(self.joints), len(self.names) + 1))
        for joint, columns in enumerate(self.columns):
            squares[joint, columns] = np.diag(self.totals[joint])
        return squares[:, :-1]

    def at(self, names: Sequence[str]) -> NDArray[np.int64]:
        """Return the indices of named parameters."""
        return indices_of(names, self.names)

    def of_blocks(self, blocks: Sequence[int] | None) -> Sequence[Array]:
        """Return per joint (k, k) the products of some blocks; of all of them with None."""
        if blocks is None:
            return self.totals
        return [rows[list(blocks)].sum(axis=0) for rows, _ in self.products]

    def squared_residuals(
        self, values: Array, blocks: Sequence[int] | None = None
    ) -> Array:
        """Return each joint's sum of squared residuals (J,) at values (p,) [N^2 m^2]."""
        change = np.append(-values, 1.0)
        squares = self.squares_of(change, self.of_blocks(blocks))
        return np.maximum(squares, 0.0)

    def successive(self, values: Array) -> Array:
        """Return each joint's sum of products of successive residuals (J,) at values (p,)."""
        return self.squares_of(np.append(-values, 1.0), self.lagged_totals)

    def squares_of(self, change: Array, products: Sequence[Array]) -> Array:
        """Return each joint's sum of squares (J,) of columns and torque times factors (p + 1,).

        ``products`` are per joint (k, k) those of its rows.
        """
        pairs = zip(self.columns, products)
        return np.array([change[at] @ gram @ change[at] for at, gram in pairs])

    def with_torque_times(self, factors: Array) -> Sums:
        """Return the sums with each joint's right-hand sides times a factor (J,)."""
        products = []
        for own, factor in zip(self.products, factors):
            scale = np.ones(own.shape[-1])
            scale[-1] = factor
            products.append(scale[:, None] * own * scale)
        return replace(self, products=tuple(products))

    def with_columns(
        self,
        names: Sequence[str],
        at: NDArray[np.int64],
        factor: Array,
        joint: int | None = None,
        shares: Array | None = None,
    ) -> Sums:
        """Return the sums with new columns (r,) that are columns (m,) times a factor (m, r).

        Args:
            names: (r,) of the new columns.
            at: (m,) indices of the columns.
            factor: (m, r).
            joint: index of the joint at which they act; None for all.
            shares: (B,) by which the columns are multiplied in each block; None for one.
        """
        size = len(self.names)
        shares = np.ones(len(self.logs)) if shares is None else shares
        new = np.arange(size, size + len(names) + 1)
        products = []
        for number, columns in enumerate(self.columns):
            mix = np.zeros((size + 1, len(names)))
            if joint in (None, number):
                mix[at] = factor
            eye = np.tile(np.eye(len(columns)), (len(shares), 1, 1))
            mixed = shares[:, None, None] * mix[columns]
            turn = np.concatenate((eye[..., :-1], mixed, eye[..., -1:]), axis=2)
            products.append(np.swapaxes(turn, 1, 2) @ self.products[number] @ turn)
        return replace(
            self,
            names=(*self.names, *names),
            columns=tuple(np.append(own[:-1], new) for own in self.columns),
            products=tuple(products),
        )


def block_numbers(
    recordings: Sequence[Recording], in_blocks: bool = True
) -> tuple[list[NDArray[np.int64]], list[str]]:
    """Return per recording the block (K,) of each row, and the log of each block.

    Blocks are stretches of time of one log; stretches of one name are one log, which is one block
    where it is not cut ``in_blocks``.
    """
    lengths = [len(recording) for recording in recordings]
    log_of_row = np.repeat([recording.name for recording in recordings], lengths)
    is_used = np.concatenate([np.any(log.used, axis=1) for log in recordings])
    names = list(dict.fromkeys(recording.name for recording in recordings))
    per_log = max(3, round(BLOCKS / len(names))) if in_blocks else 1
    blocks = np.zeros(len(is_used), dtype=np.int64)
    for number, name in enumerate(names):
        own = log_of_row == name
        position = np.cumsum(is_used[own]) - is_used[own]
        block = position * per_log // max(np.count_nonzero(is_used[own]), 1)
        blocks[own] = number * per_log + np.minimum(block, per_log - 1)
    numbers = np.split(blocks, np.cumsum(lengths)[:-1])
    return numbers, [name for name in names for _ in range(per_log)]


class JointSums:
    """Products of one joint's rows, of the torque and of columns that were not always zero so far.

    Attributes:
        columns: (k,) indices of these columns; the last one is that of the torque.
        products: (2, B, k, k) products of each block's rows, and of its successive rows.
        counts: (B,) number of rows.
    """

    def __init__(self, blocks: int, size: int) -> None:
        self.columns = np.array([size - 1])
        self.products = np.zeros((2, blocks, 1, 1))
        self.counts = np.zeros(blocks)
        self._last: tuple[int, Array] = (-1, np.zeros(size))

    def add(self, rows: Array, block: NDArray[np.int64]) -> None:
        """Add rows [A b] (m, p + 1); ``block`` (m,) is -1 of an unused one."""
        present = np.flatnonzero(np.any(rows != 0.0, axis=0))
        columns = np.union1d(self.columns, present)
        if len(columns) > len(self.columns):
            at = np.searchsorted(columns, self.columns)
            products = np.zeros((2, len(self.counts), len(columns), len(columns)))
            products[:, :, at[:, None], at] = self.products
            self.columns = columns
            self.products = products
        grams, lagged = self.products
        for number in np.unique(block[block >= 0]).tolist():
            own = rows[block == number]
            before, last = self._last
            self._last = number, own[-1]
            self.counts[number] += len(own)
            own = own[:, columns]
            grams[number] += own.T @ own
            if before == number:
                own = np.vstack((last[columns], own))
            successive = own[:-1].T @ own[1:]
            lagged[number] += 0.5 * (successive + successive.T)

    def clear_rounding(self) -> None:
        """Set the products of columns that are nothing but rounding to zero."""
        squares = np.diag(self.products[0].sum(axis=0))[:-1]
        is_noise = squares <= RELATIVE_CUT**2 * np.max(squares, initial=0.0)
        at = np.flatnonzero(is_noise)
        self.products[:, :, at] = 0.0
        self.products[..., at] = 0.0


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
    resampled = []
    cutoffs = []
    for piece in pieces:
        with prefix_input_errors(piece.name):
            uniform = resample_uniformly(piece.samples)
            cutoffs.append(cutoff or uniform.choice.cutoff)
        resampled.append(uniform)
    recordings = []
    processed: defaultdict[str, list[ProcessedSignals]] = defaultdict(list)
    for piece, uniform, required in zip(pieces, resampled, cutoffs):
        given = min(cutoffs) if required > min(cutoffs) else cutoff
        with prefix_input_errors(piece.name):
            signals = process(uniform, robot.joint_names, given, robot.slides)
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
