"""The equations of a log: rows that are linear in the parameters of the arm, for every joint.

Rows are those of ``estimation.columns`` around the model, with every friction term. Two more kinds
of friction have columns here, because their torque would be mistaken for other faults: friction
that builds up over some distance after a reversal, and dry friction that varies over a turn.

Throughout, N is the number of samples of a piece, K that of instants at the lower rate of the
equations (rows per joint), n that of joints, p that of parameters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.equations import names_of
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.estimation.choices import neighbours
from robot_sysid.estimation.columns import Columns
from robot_sysid.estimation.dataset import Dataset
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.signals.process import ProcessedSignals

WINDOW = 16.0
"""Longest window of rows that are transformed together [s]."""
BUILD_UP = (0.004, 0.02)
"""Distances after a reversal over which friction builds up [rad]."""
LOADED = 0.1
"""Least model torque of a joint that links load, over that of the strongest joint."""
LEAST_TORQUE = 0.02
"""Least typical torque of a joint, as a share of the strongest joint's."""
# Speed below which the direction of a joint's friction is uncertain, as a share of its top speed.
_SLOW = 0.01


def rms(values: Array) -> Array:
    """Return the root mean square (n,) over samples (K, n)."""
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)))


def rigid_torque(robot: RobotModel, motion: Motion) -> Array:
    """Return the torque (K, n) of the model's links along a motion [N m]."""
    links = LinkDynamics(robot).motion(motion.q, motion.qd, motion.qdd)
    return links.torque(robot.thetas)


def weight_torque(robot: RobotModel, motion: Motion) -> Array:
    """Return the torque (K, n) of the weight of the model's links along a motion [N m]."""
    zero = np.zeros_like(motion.q)
    return rigid_torque(robot, replace(motion, qd=zero, qdd=zero))


@dataclass(frozen=True)
class LogRows:
    """Equations of all joints at K instants of a log, linear in the p parameters of the arm.

    Attributes:
        columns: names and indices of the estimate's parameters.
        motion: (K, n) positions, velocities and accelerations at the instants.
        torque: (K, n) measured torque, low-passed [N m].
        indices: per joint (m,) indices of the parameters of its columns. Indices from
            len(columns.names) on are those of friction that the estimate does not have
            (``_further_friction``), joint by joint.
        rows: per joint (K, m) torque per unit of each parameter; the first ten columns are those of
            the last link.
        right_sides: (K, n) measured torque less the part that depends on no parameter [N m].
        used: (K, n) bool, whether a row counts: the joint moves fast enough for its friction to
            have a direction, and all numbers are finite.
        windows: slices of instants without gaps, which are transformed together.
    """

    columns: Columns
    motion: Motion
    torque: Array
    indices: tuple[NDArray[np.int64], ...]
    rows: tuple[Array, ...]
    right_sides: Array
    used: NDArray[np.bool_]
    windows: tuple[slice, ...]

    @property
    def robot(self) -> RobotModel:
        """The arm."""
        return self.columns.robot

    @cached_property
    def typical_torque(self) -> Array:
        """Root mean square torque (n,), at least ``LEAST_TORQUE`` of the largest [N m]."""
        torque = rms(self.torque)
        return np.maximum(torque, LEAST_TORQUE * float(np.max(torque)))

    @cached_property
    def model_torque(self) -> Array:
        """Root mean square torque (n,) of the model's links along the log [N m]."""
        return rms(rigid_torque(self.robot, self.motion))

    @cached_property
    def is_loaded(self) -> NDArray[np.bool_]:
        """Whether links load a joint (n,): more than by ``LOADED`` of the most loaded one."""
        return np.asarray(self.model_torque > LOADED * np.max(self.model_torque))

    def torque_ratio(self, least_share: float) -> Array:
        """Return the ratio (n,) of root mean square measured torque to the model's.

        The latter counts as at least ``least_share`` of that of the most loaded joint.
        """
        least = least_share * float(np.max(self.model_torque))
        return rms(self.torque) / np.maximum(self.model_torque, least)

    @cached_property
    def model_weight(self) -> Array:
        """Torque (K, n) that the weight of the model's links makes along the log [N m]."""
        return weight_torque(self.robot, self.motion)

    def with_torque(self, torque: Array) -> LogRows:
        """Return the equations with the measured torques replaced by others (K, n) [N m]."""
        right_sides = self.right_sides + torque - self.torque
        return replace(self, torque=torque, right_sides=right_sides)

    def links_torque(self, values: Array) -> Array:
        """Return the torque (K, n) of all links [N m] for parameters ``values`` (p,).

        Values of friction and of all other parameters do not count.
        """
        bodies = np.zeros_like(values)
        for indices in self.columns.bodies().values():
            bodies[indices] = values[indices]
        return self.torque_of(bodies)

    def torque_of(self, values: Array) -> Array:
        """Return the torque (K, n) of the rows [N m] for parameters ``values`` (p,)."""
        torque = np.empty_like(self.right_sides)
        for joint, (rows, indices) in enumerate(zip(self.rows, self.indices)):
            torque[:, joint] = rows @ values[indices]
        return torque

    def friction_indices(self, term: str) -> NDArray[np.int64]:
        """Return the indices (n,) of one friction term of all joints, such as "coulomb"."""
        return self.columns.indices(names_of(term, self.robot.joint_names))

    def columns_of(self, names: Sequence[str]) -> Array:
        """Return the columns (K, n, e) of the e parameters ``names``: torque per unit of each.

        They are zero at joints whose equations do not contain the parameter.
        """
        columns = np.zeros((*self.torque.shape, len(names)))
        for k, name in enumerate(names):
            # No column has the index -1.
            index = self.columns.index.get(name, -1)
            for joint, (indices, rows) in enumerate(zip(self.indices, self.rows)):
                columns[:, joint, k] = np.sum(rows[:, indices == index], axis=1)
        return columns


def log_rows(
    robot: RobotModel,
    signals: Sequence[ProcessedSignals],
    used: NDArray[np.bool_] | None = None,
) -> LogRows:
    """Return the equations of a log, linearised around the model.

    Args:
        robot: the arm with its model.
        signals: low-passed signals, one per piece of the log.
        used: (K, n) bool, the rows that count; None for those in which the joint is faster than
            ``_SLOW`` of its top speed and does not dwell at a lower speed just before or after.
            Rows that are not finite never count.
    """
    from scipy.ndimage import binary_dilation, binary_opening

    datasets = [Dataset("log", piece) for piece in signals]
    columns = Columns(robot, datasets, couplings=tuple(neighbours(robot)))
    pieces = columns.samples(columns.start())
    motion = _join_motions([dataset.motion for dataset in datasets])
    measured = []
    tau = []
    further_columns = []
    for piece, piece_signals in zip(pieces, signals):
        measured.append(np.stack(piece.measured, axis=1))
        tau.append(np.stack(piece.tau, axis=1))
        further_columns.append(_further_friction(piece_signals))
    right_sides = np.concatenate(tau)
    further = np.concatenate(further_columns)
    if used is None:
        speed = np.abs(motion.qd)
        is_slow = speed <= _SLOW * np.max(speed, axis=0)
        # Where a joint dwells, the low-pass spreads friction of an uncertain direction further.
        dwells = binary_opening(is_slow, np.ones((2, 1)))
        used = ~(is_slow | binary_dilation(dwells, np.ones((3, 1))))
    used = used & np.isfinite(right_sides)

    count = further.shape[2]
    indices = []
    rows = []
    for joint in range(robot.n_joints):
        estimated = np.concatenate([piece.rows[joint] for piece in pieces])
        used[:, joint] &= np.all(np.isfinite(estimated), axis=1)
        rows.append(np.nan_to_num(np.hstack((estimated, further[:, joint]))))
        first = len(columns.names) + count * joint
        further_indices = np.arange(first, first + count)
        indices.append(np.append(pieces[0].columns[joint], further_indices))
    return LogRows(
        columns,
        motion,
        np.concatenate(measured),
        tuple(indices),
        tuple(rows),
        np.nan_to_num(right_sides),
        used,
        tuple(_windows(list(map(len, pieces)), signals[0])),
    )


def _join_motions(motions: Sequence[Motion]) -> Motion:
    """Return one motion that joins motions end to end; each has arrays (K, n), K may differ."""
    fields = zip(*(vars(motion).values() for motion in motions))
    return Motion(*map(np.concatenate, fields))


def _windows(counts: Sequence[int], signals: ProcessedSignals) -> list[slice]:
    """Return the slices of rows that are transformed together: a piece each, or part of a long one.

    Args:
        counts: number of rows of each piece.
        signals: signals of any piece; all pieces have the same rate and filter.
    """
    longest = int(WINDOW * signals.rate / signals.low_pass.step)
    windows: list[slice] = []
    start = 0
    for count in counts:
        n_windows = math.ceil(count / longest)
        edges = start + np.linspace(0, count, n_windows + 1).astype(int)
        windows += map(slice, edges[:-1].tolist(), edges[1:].tolist())
        start += count
    return windows


def _further_friction(signals: ProcessedSignals) -> Array:
    """Return columns (K, n, m) of friction that builds up after reversals and of uneven friction.

    The first len(BUILD_UP) of the m columns are friction that builds up minus dry friction, which
    acts at once; the last two are dry friction times sine and cosine of the position. Friction that
    builds up approaches the sign of the speed exponentially with the distance travelled.
    """
    low_pass = signals.low_pass
    window = low_pass.window(0, len(low_pass.centres(len(signals))), smooth=True)
    q = signals.q[window]
    # (N, n, 1), to be combined with columns (N, n, len(BUILD_UP)).
    sign = np.sign(signals.qd[window])[..., None]
    distance = np.abs(np.diff(q, axis=0))[..., None]
    decay = np.exp(-distance / np.array(BUILD_UP))
    built = np.empty((*q.shape, len(BUILD_UP)))
    built[0] = sign[0]
    for k, direction in enumerate(sign[1:]):
        built[k + 1] = direction + decay[k] * (built[k] - direction)
    late = built - sign
    uneven = sign * np.stack((np.sin(q), np.cos(q)), axis=-1)
    return low_pass.decimate_smooth(np.concatenate((late, uneven), axis=-1))
