"""A log as linear equations, with the estimate's own columns and priors.

Rows are those of ``estimation.columns`` around the model, with every friction term. Two more kinds
of friction have columns here, because their torque would be mistaken for other faults: friction
that builds up over some distance after a reversal, and dry friction that varies over a turn. Rows
are uniform in time, so that a cosine transform makes autocorrelated noise independent: its variance
is then a function of the frequency alone (``evidence``).

Throughout, K is the number of instants (rows per joint), n that of joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.friction import friction_model
from robot_sysid.dynamics.inverse_dynamics import TILT_NAMES
from robot_sysid.dynamics.spatial import (
    PARAMETER_NAMES,
    characteristic_length,
    parameter_scale,
)
from robot_sysid.estimation.algebra.priors import EXPECTED
from robot_sysid.estimation.choices import WITH_ALL, neighbours
from robot_sysid.estimation.columns import Columns
from robot_sysid.estimation.dataset import Dataset
from robot_sysid.estimation.question import Choice, EstimationOptions, Question
from robot_sysid.estimation.unknowns import build_unknowns
from robot_sysid.records import DELAY_NAME, Array, Measurement, Motion, RobotModel
from robot_sysid.signals.process import LogPiece, ProcessedSignals, process

CUTOFF_HZ = 8.0
"""Highest cut-off of the low-pass [Hz]: faster motion has little information on links."""
CUTOFF_SHARE = 0.6
"""Cut-off over the one that suits accelerations. It is lower because explanations have columns that
are time derivatives of torques: their noise of positions would count as evidence."""
WINDOW = 16.0
"""Longest window of rows that are transformed together [s]."""
MOST_WINDOWS = 4
"""Number of windows of a long log that are used, spread evenly."""
LINK_SCALES = tuple(replace(EXPECTED, mass=scale) for scale in (2.0, 6.0))
"""Scales of the other links' prior over which the evidence is averaged."""
PAYLOAD = 0.3
"""Prior standard deviation of the last link's mass, as a share of the arm's mass."""
REACH = 0.15
"""Least size of the last link in its prior, as a share of the arm's reach."""
FRICTION = {
    **{"coulomb": 1.0, "viscous": 1.0, "offset": 0.3, "armature": 0.5},
    **{"sqrt": 0.05, "stribeck": 0.05, "load": 0.04},
}
"""Prior standard deviation of each friction term: its torque at the joint's typical speed and
acceleration, as a share of the typical torque; of "load" (a gear's loss), as a share of the load.
"""
BUILD_UP = (0.004, 0.02)
"""Distances after a reversal over which friction builds up [rad]."""
BUILT_UP = 0.15
"""Prior standard deviation of friction that builds up after a reversal, as a share of the typical
torque."""
UNEVEN = 0.03
"""Prior standard deviation of dry friction that varies over a turn, as a share of the typical
torque."""
WIDE_TILT = 0.15
"""Prior standard deviation of the base's tilt where the estimate is asked to find it [rad]."""
WIDE_DELAY = 0.04
"""Prior standard deviation of the delay where the estimate is asked to find it [s]."""
WORTH_A_WORD = 2.0
"""Largest prior standard deviation of the delay where the estimate is not asked to find it [ms]: a
larger delay is worth a finding."""
LEAST_TORQUE = 0.02
"""Least typical torque of a joint, as a share of the strongest joint's."""
# Speed below which the direction of a joint's friction is uncertain, as a share of its top speed.
_SLOW = 0.01


def rms(values: Array) -> Array:
    """Return the root mean square (n,) over samples (K, n)."""
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)))


def low_pass(
    pieces: Sequence[Measurement], cutoff: float | None
) -> list[ProcessedSignals]:
    """Return the low-passed signals of each piece of a log, or of evenly spread windows of it where
    the log is longer than ``MOST_WINDOWS`` windows.

    Args:
        pieces: the log without gaps.
        cutoff: cut-off of the low-pass [Hz]; None chooses it from the data.
    """
    signals = []
    for piece in _spread_windows(pieces):
        log_piece = LogPiece.of(piece)
        cutoff_hz = min(cutoff or CUTOFF_SHARE * log_piece.choice[0], CUTOFF_HZ)
        # Every row is used: those of a joint that is too slow are masked later.
        processed = process(log_piece, (), cutoff_hz)
        sure = np.zeros_like(processed.turning)
        signals.append(
            replace(processed, deadband=np.zeros_like(processed.deadband), turning=sure)
        )
    return signals


def _spread_windows(pieces: Sequence[Measurement]) -> list[Measurement]:
    """Return the pieces of a log, or ``MOST_WINDOWS`` windows of them where they are longer."""
    total = sum(float(piece.time[-1] - piece.time[0]) for piece in pieces)
    if total <= MOST_WINDOWS * WINDOW:
        return list(pieces)
    windows = []
    for piece in pieces:
        count = max(1, int((piece.time[-1] - piece.time[0]) / WINDOW))
        windows += [
            _cut(piece, rows) for rows in np.array_split(np.arange(len(piece)), count)
        ]
    spread = np.linspace(0, len(windows) - 1, MOST_WINDOWS)
    return [windows[k] for k in np.unique(spread.astype(int))]


def _cut(piece: Measurement, rows: NDArray[np.int64]) -> Measurement:
    """Return the samples of a measurement with the indices ``rows`` (N,)."""
    arrays: dict[str, Any] = {
        name: None if v is None else v[rows] for name, v in vars(piece).items()
    }
    return Measurement(
        **{name: arrays[name] for name in Measurement.__dataclass_fields__}
    )


@dataclass(frozen=True)
class LogRows:
    """Equations of all joints at K instants of a log.

    Attributes:
        columns: names and indices of the estimate's parameters.
        motion: (K, n) positions, velocities and accelerations at the instants.
        torque: (K, n) measured torque, low-passed [N m].
        indices: per joint (k,) indices of the parameters of its columns; indices from
            len(columns.names) on are those of friction that only ``Prior`` has.
        rows: per joint (K, k) torque per unit of each parameter.
        right_sides: (K, n) right-hand sides [N m].
        used: (K, n) bool, whether a row counts: the joint moves fast enough for its friction to
            have a direction, and all numbers are finite.
        windows: slices of instants without gaps, which are transformed together.
        point_values: (p,) parameters around which the rows are linearised.
    """

    columns: Columns
    motion: Motion
    torque: Array
    indices: tuple[NDArray[np.int64], ...]
    rows: tuple[Array, ...]
    right_sides: Array
    used: NDArray[np.bool_]
    windows: tuple[slice, ...]
    point_values: Array

    @property
    def robot(self) -> RobotModel:
        """The arm."""
        return self.columns.robot

    @cached_property
    def typical_torque(self) -> Array:
        """Root mean square torque (n,), at least ``LEAST_TORQUE`` of the largest [N m]."""
        torque = rms(self.torque)
        return np.maximum(torque, LEAST_TORQUE * float(np.max(torque)))

    def with_torque(self, torque: Array) -> LogRows:
        """Return the equations with the measured torques replaced by others (K, n)."""
        right_sides = self.right_sides + torque - self.torque
        return replace(self, torque=torque, right_sides=right_sides)

    def links_torque(self, values: Array) -> Array:
        """Return the torque (K, n) of all links [N m] for parameters ``values`` (p,)."""
        bodies = np.zeros_like(values)
        links = np.concatenate([*self.columns.bodies().values()])
        bodies[links] = values[links]
        torques = [rows @ bodies[at] for rows, at in zip(self.rows, self.indices)]
        return np.column_stack(torques)

    def column(self, joint: int, name: str) -> Array:
        """Return the column (K,) of the parameter ``name`` in a joint's rows; zero without one."""
        at = np.flatnonzero(self.indices[joint] == self.columns.index.get(name, -1))
        return self.rows[joint][:, at[0]] if len(at) else np.zeros(len(self.torque))


def log_rows(
    robot: RobotModel,
    signals: Sequence[ProcessedSignals],
    used: NDArray[np.bool_] | None = None,
    values: Array | None = None,
) -> LogRows:
    """Return the equations of a log.

    Args:
        robot: the arm with its model.
        signals: of ``low_pass``, one per piece of the log.
        used: (K, n) bool, the rows that count; None for those in which the joint moves.
        values: (p,) parameters around which the rows are linearised; None for the model's.
    """
    datasets = [Dataset("log", piece) for piece in signals]
    columns = Columns(robot, datasets, couplings=tuple(neighbours(robot)))
    start = columns.start()
    point = start if values is None else replace(start, values=values)
    samples = columns.samples(point)
    motions = [dataset.motion for dataset in datasets]
    motion = Motion(*map(np.concatenate, zip(*(vars(m).values() for m in motions))))
    speed = np.abs(motion.qd)
    if used is None:
        used = speed > _SLOW * np.max(speed, axis=0)
    torque = np.concatenate([np.stack(rows.measured, axis=1) for rows in samples])
    right_sides = np.concatenate([np.stack(rows.tau, axis=1) for rows in samples])
    used = used & np.isfinite(right_sides)
    right_sides = np.nan_to_num(right_sides)

    more = np.concatenate([_friction_beside(piece) for piece in signals])
    first = len(columns.names)
    indices = []
    rows = []
    for joint in range(robot.n_joints):
        estimated = np.concatenate([piece.rows[joint] for piece in samples])
        used[:, joint] &= np.all(np.isfinite(estimated), axis=1)
        rows.append(np.nan_to_num(np.hstack((estimated, more[:, joint]))))
        more_places = first + more.shape[2] * joint + np.arange(more.shape[2])
        indices.append(np.append(samples[0].columns[joint], more_places))
    windows = _windows([len(piece) for piece in samples], signals[0])
    return LogRows(
        columns,
        motion,
        torque,
        tuple(indices),
        tuple(rows),
        right_sides,
        used,
        windows,
        point.values,
    )


def _windows(counts: Sequence[int], signals: ProcessedSignals) -> tuple[slice, ...]:
    """Return the slices of rows that are transformed together: pieces, or parts of long ones.

    ``counts`` are the numbers of rows of the pieces.
    """
    longest = int(WINDOW * signals.rate / signals.low_pass.step)
    windows = []
    start = 0
    for count in counts:
        windows_of_piece = -(-count // longest)
        edges = start + np.linspace(0, count, windows_of_piece + 1).astype(int)
        windows += [slice(int(a), int(b)) for a, b in zip(edges[:-1], edges[1:])]
        start += count
    return tuple(windows)


def _friction_beside(signals: ProcessedSignals) -> Array:
    """Return columns (K, n, k) of friction that builds up after reversals and of uneven friction.

    The first len(BUILD_UP) columns are this friction minus dry friction, which acts at once; the
    last two are dry friction times sine and cosine of the position.
    """
    stride = signals.low_pass.stride
    q = signals.q[::stride]
    sign = np.sign(signals.qd[::stride])
    decay = np.exp(-np.abs(np.diff(q, axis=0))[..., None] / np.array(BUILD_UP))
    built = np.empty((*q.shape, len(BUILD_UP)))
    state = built[0] = np.repeat(sign[0][:, None], len(BUILD_UP), axis=1)
    for k, direction in enumerate(sign[1:, :, None]):
        state = built[k + 1] = direction + decay[k] * (state - direction)
    late = built - sign[..., None]
    uneven = sign[..., None] * np.stack((np.sin(q), np.cos(q)), axis=-1)
    low_pass = signals.low_pass.at_lower_rate(stride)
    return low_pass.decimate(np.concatenate((late, uneven), axis=-1))


@dataclass(frozen=True)
class Prior:
    """The normal prior of the base model's parameters, a mixture over the widths of links' priors.

    Attributes:
        estimated: (k,) indices of the estimated parameters.
        mean: (p,) prior means, and values of the parameters that are not estimated.
        spread: (k,) prior standard deviations.
        precisions: inverse covariances (k, k) in units of ``spread``, one per scale of the links'
            prior.
    """

    estimated: NDArray[np.int64]
    mean: Array
    spread: Array
    precisions: tuple[Array, ...]

    def parameters(self, coefficients: Array) -> Array:
        """Return the parameters (p,) for deviations from the mean in units of ``spread``.

        The first k ``coefficients`` are these deviations; further ones, of explanations, do not
        count.
        """
        values = self.mean.copy()
        values[self.estimated] += self.spread * coefficients[: len(self.estimated)]
        return values


def base_prior(log: LogRows, options: EstimationOptions) -> Prior:
    """Return the prior of a log without faults: that of the estimate, with wider friction.

    ``options`` holds the prior uncertainties of the estimate.
    """
    columns = log.columns
    robot = log.robot
    more = 2 + len(BUILD_UP)
    count = len(columns.names)
    mean = np.append(columns.model_values, np.zeros(more * robot.n_joints))
    spread = np.append(np.zeros(count), np.zeros(more * robot.n_joints))
    spread[: len(PARAMETER_NAMES)] = _last_link_spread(robot)
    speed = np.maximum(rms(log.motion.qd), 1e-9)
    turning = np.maximum(rms(log.motion.qdd), 1e-9)
    units = {
        "viscous": speed,
        "armature": turning,
        "sqrt": np.sqrt(speed),
        "load": log.typical_torque,
    }
    for term, share in FRICTION.items():
        sizes = share * log.typical_torque / units.get(term, np.ones_like(speed))
        spread[columns.indices([f"{term}[{joint}]" for joint in robot.joint_names])] = (
            sizes
        )
    shares = np.array([BUILT_UP] * len(BUILD_UP) + [UNEVEN] * 2)
    spread[count:] = np.outer(log.typical_torque, shares).ravel()

    # Faults of a log do not depend on the stated uncertainty of the links; a delay that the
    # estimate would allow for is reported all the same.
    links = max(options.link_uncertainty, EstimationOptions().link_uncertainty)
    late = min(options.delay_uncertainty, WORTH_A_WORD)
    question = Question(
        replace(options, link_uncertainty=links, delay_uncertainty=late)
    )
    model = friction_model(WITH_ALL)
    nonzero = np.ones(count, dtype=bool)
    factors = []
    for link_scales in LINK_SCALES:
        choice = Choice((model,) * robot.n_joints, link_scales=link_scales)
        unknowns = build_unknowns(
            columns, question, choice, log.typical_torque, nonzero
        )
        groups = unknowns.groups
        for group in groups:
            at = columns.indices(group.names)
            mean[at] = group.mean
            spread[at] = np.maximum(
                spread[at], np.sqrt(np.sum(group.factor**2, axis=1))
            )
        factors.append(groups)
    wide = {**dict.fromkeys(TILT_NAMES, WIDE_TILT), DELAY_NAME: WIDE_DELAY}
    for name in set(wide) & set(unknowns.increments):
        spread[columns.index[name]] = wide[name]
    estimated = np.flatnonzero(spread)
    position = np.zeros(len(spread), dtype=np.int64)
    position[estimated] = np.arange(len(estimated))
    precisions = []
    for groups in factors:
        precision = np.eye(len(estimated))
        for group in groups:
            at = position[columns.indices(group.names)]
            scaled = group.factor / spread[estimated[at], None]
            precision[np.ix_(at, at)] = np.linalg.inv(scaled @ scaled.T)
        precisions.append(precision)
    return Prior(estimated, mean, spread[estimated], tuple(precisions))


def _last_link_spread(robot: RobotModel) -> Array:
    """Return prior standard deviations (10,) of the last link: it may carry any tool."""
    own_size = (
        characteristic_length(robot.prior.theta) if robot.prior.mass > 0.0 else 0.0
    )
    distance = float(np.linalg.norm(robot.prior.com))
    return parameter_scale(
        PAYLOAD * robot.mass, max(REACH * robot.length, own_size, distance)
    )
