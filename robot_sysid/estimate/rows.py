"""Recordings as rows: motion and torque at the instants of equations, and sums over them.

Shapes: a recording has K rows (instants) and n joints; "joints" counts those with equations, J; p
parameters have columns. An equation reads row (k,) x = torque [N m]. Rows are made and squared a
few at a time, so that memory does not grow with a log: of a log only its signals and its sums stay.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.inverse_dynamics import ARRAY_SIZE, LinkDynamics, LinksMotion
from robot_sysid.estimate.identifiability import RELATIVE_CUT
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.signals.process import FilteredRecording, Mask

LEAST_NOISE = 1e-4
"""Least noise of a joint, as a share of the root mean square torque of all: the error of filtering.
"""
BLOCKS = 10
"""Number of blocks that held-out validation and the jackknife leave out in turn."""


@dataclass(frozen=True)
class Rows:
    """Successive rows of a recording: columns of terms are made chunk by chunk, to bound memory."""

    recording: FilteredRecording
    span: slice
    _moves: dict[bytes, LinksMotion] = field(default_factory=dict, compare=False)

    @cached_property
    def motion(self) -> Motion:
        """The motion (m, n) at these rows."""
        return self.recording.motion[self.span]

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
        """Return columns (m, ...) made from the motion at all samples, and low-passed.

        They are kept with the recording by their ``key``: do not change them.
        """
        recording = self.recording
        columns = recording.kept.get(key, lambda: recording.filter_columns(make))
        return columns[self.span]

    def links_torque(self, robot: RobotModel, gravity: Array, thetas: Array) -> Array:
        """Return the torque (m, n) of links with parameters ``thetas`` (n, 10) [N m], kept like
        columns.
        """
        chunks = row_chunks(self.recording, 36 * robot.n_joints)

        def make() -> Array:
            """Return the torque of all rows."""
            torques = (rows.moves(robot, gravity).torque(thetas) for rows in chunks)
            return np.concatenate([*torques])

        key = "links", gravity.tobytes(), thetas.tobytes()
        return self.recording.kept.get(key, make)[self.span]


def row_chunks(
    recording: FilteredRecording, width: int, array_size: int = ARRAY_SIZE
) -> Iterator[Rows]:
    """Yield the rows of a recording in chunks, of which columns ``width`` numbers wide fit in
    memory: in an array of so many numbers.
    """
    size = max(1, array_size // max(width, 1))
    for start in range(0, len(recording), size):
        yield Rows(recording, slice(start, min(start + size, len(recording))))


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
        return np.array([self._numbers[name] for name in names], dtype=np.int64)

    @cached_property
    def _numbers(self) -> dict[str, int]:
        """Name of each parameter to its index."""
        return {name: number for number, name in enumerate(self.names)}

    def of_blocks(self, blocks: Sequence[int] | None) -> Sequence[Array]:
        """Return per joint (k, k) the products of some blocks; of all of them with None."""
        if blocks is None:
            return self.totals
        if len(blocks) == 1:
            return [rows[blocks[0]] for rows, _ in self.products]
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

    def mixed(self, names: Sequence[str], mix: Array) -> Sums:
        """Return the sums of new parameters (r,) alone.

        Args:
            names: (r,) of them.
            mix: (J, p, r) their columns in each joint's rows, in terms of the columns that are.
        """
        columns = []
        products = []
        for at, own, turn in zip(self.columns, self.products, mix):
            used = np.flatnonzero(np.any(turn[at[:-1]], axis=0))
            full = np.zeros((len(at), len(used) + 1))
            full[:-1, :-1] = turn[at[:-1]][:, used]
            full[-1, -1] = 1.0
            columns.append(np.append(used, len(names)))
            products.append(full.T @ own @ full)
        return replace(
            self,
            names=tuple(names),
            columns=tuple(columns),
            products=tuple(products),
            triangles=None,
        )


def block_numbers(
    recordings: Sequence[FilteredRecording], in_blocks: bool = True
) -> tuple[list[NDArray[np.int64]], list[str]]:
    """Return per recording the block (K,) of each row, and the log of each block.

    Blocks are stretches of time of one log; stretches of one name are one log, which is one block
    where it is not cut ``in_blocks``.
    """
    lengths = [len(recording) for recording in recordings]
    log_of_row = np.repeat([recording.name for recording in recordings], lengths)
    is_used = np.concatenate([np.any(log.is_used, axis=1) for log in recordings])
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
        is_present = np.any(rows, axis=0)
        is_present[self.columns] = True
        columns = np.flatnonzero(is_present)
        if len(columns) > len(self.columns):
            at = np.searchsorted(columns, self.columns)
            products = np.zeros((2, len(self.counts), len(columns), len(columns)))
            products[:, :, at[:, None], at] = self.products
            self.columns = columns
            self.products = products
        grams, lagged = self.products
        present = rows.T[columns]
        for number in np.unique(block[block >= 0]).tolist():
            at = np.flatnonzero(block == number)
            before, last = self._last
            self._last = number, rows[at[-1]]
            self.counts[number] += len(at)
            # A slice, where rows follow each other, is no copy.
            follow = at[-1] - at[0] == len(at) - 1
            own = present[:, at[0] : at[-1] + 1] if follow else present[:, at]
            grams[number] += own @ own.T
            lagged[number] += own[:, :-1] @ own[:, 1:].T
            if before == number:
                lagged[number] += np.outer(last[columns], own[:, 0])

    def finish(self) -> None:
        """Make products of successive rows symmetric, and those of rounding alone zero."""
        lagged = self.products[1]
        self.products[1] = 0.5 * (lagged + np.swapaxes(lagged, 1, 2))
        at = of_rounding(np.diag(self.products[0].sum(axis=0)))
        self.products[:, :, at] = 0.0
        self.products[..., at] = 0.0


def of_rounding(squares: Array) -> NDArray[np.int64]:
    """Return which columns are nothing but rounding, from their sums of squares and a torque's."""
    own = squares[:-1]
    return np.flatnonzero(own <= RELATIVE_CUT**2 * np.max(own, initial=0.0))
