"""What the numbers in a log's columns show: time, motion, and the torque that the model expects.

The rows are averaged to some 40 per second. For a motion (N, n) that columns are taken to hold, the
model's torque m_j of joint j is compared with every column y. Friction, rotor inertia and an offset
are taken out of both first, by least squares on [1, direction, qd_j, qdd_j]. The scale of a column
is the factor of m_j that fits it best. Its misfit is the rms that a scale from ``LEAST_SCALE`` to
``LARGEST_SCALE`` leaves of y, over that of y. A torque column of that joint has a scale of about
one and a small misfit wherever the links load the joint.

Throughout, N is the number of rows, C that of columns, n that of joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.logs.table import LogTable, Mask, read_blocks
from robot_sysid.logs.text import is_number
from robot_sysid.logs.titles import TIME_UNITS, UNITS
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.messages import Progress

LEAST_SCALE = 0.5
"""Least ratio of a torque to the model's; beyond, it has another unit or another cause."""
LARGEST_SCALE = 2.0
"""Largest ratio of a torque to the model's."""
_MOST_ROWS = 60_000
"""Number of rows that are read at most."""
_MOST_SAMPLES = 1_500
"""Number of averaged rows that are used at most."""
_MOST_FITTED = 400
"""Number of these at which torques are compared at most."""
_RATE = 40.0
"""Rows per second that a log is averaged to [Hz]."""
_LOADED = 0.15
"""Model torque of a joint over that of the most loaded one from which on links load it."""
_LONGEST_STEP = 0.2
"""Largest time between two rows [s]."""


@dataclass(frozen=True)
class Clock:
    """A column that may be the time.

    Attributes:
        column: its index.
        unit: "s", "ms", "us" or "ns", by which rows come at 5 to 5000 Hz.
        period: median time between two rows [s].
        counts: whether it grows by one from row to row, as a row number does.
    """

    column: int
    unit: str
    period: float
    counts: bool


def read_numbers(table: LogTable) -> Array:
    """Return the first rows (N, C) of a log; columns that are no numbers are NaN.

    Rows in which a column that is mostly filled is empty are left out.
    """
    first_row = table.first_row or ("0",) * len(table.titles)
    columns = np.flatnonzero(list(map(is_number, first_row)))
    cells = np.empty((0, len(columns)))
    for block in read_blocks(table, columns.tolist(), Progress()):
        if block.recording or len(cells) >= _MOST_ROWS:
            break
        cells = np.concatenate((cells, block.cells))
    is_finite = np.isfinite(cells)
    is_filled = 2 * np.count_nonzero(is_finite, axis=0) > len(cells)
    rows = np.full((len(cells), len(table.titles)), np.nan)
    rows[:, columns[is_filled]] = cells[:, is_filled]
    return rows[np.all(is_finite[:, is_filled], axis=1)]


def clocks(rows: Array) -> list[Clock]:
    """Return the columns of rows (N, C) that grow evenly, as a time does."""
    clock_columns = []
    for column, values in enumerate(rows.T):
        steps = np.diff(values)
        if len(steps) < 10 or not np.all(steps >= 0.0) or np.mean(steps > 0.0) < 0.98:
            continue
        step = float(np.median(steps))
        is_even = float(np.quantile(steps, 0.9)) < 3.0 * step
        periods = {unit: step * UNITS["time"][unit] for unit in TIME_UNITS}
        # The first unit that is not too long.
        unit = next((u for u in TIME_UNITS if periods[u] <= _LONGEST_STEP), "")
        if is_even and unit:
            counts = bool(np.all(steps == 1.0))
            clock_columns.append(Clock(column, unit, periods[unit], counts))
    return clock_columns


def average_rows(rows: Array, period: float) -> tuple[Array, float]:
    """Return rows (N, C) averaged to ``_RATE``, and the time between two averages [s].

    They are the middle ``_MOST_SAMPLES`` of a longer log. ``period``: time between two rows [s].
    """
    every = max(1, min(round(1.0 / (_RATE * period)), len(rows) // 20))
    count = len(rows) // every
    averaged = rows[: count * every].reshape(count, every, rows.shape[1]).mean(axis=1)
    start = max(0, (count - _MOST_SAMPLES) // 2)
    return averaged[start : start + _MOST_SAMPLES], every * period


@dataclass(frozen=True)
class TorqueFit:
    """How well each column of a log is the torque of each joint, for one assumed motion.

    Attributes:
        scale: (n, C) ratio of a column to the model's torque.
        misfit: (n, C) rms that the model's torque leaves of a column beside friction, over what
            friction alone leaves; 1 where the model explains nothing.
        any_scale_misfit: (n, C) the same with the scale that fits best, however large.
        residual: (n, C) rms that both leave, in the column's unit.
        direction: (n, C) factor of the direction of motion, the dry friction, over the rms of the
            column: positive where the column brakes as a joint's own torque does.
        loaded: (n,) whether links load a joint.
    """

    scale: Array
    misfit: Array
    any_scale_misfit: Array
    residual: Array
    direction: Array
    loaded: Mask

    def of_columns(self, values: Array, columns: Sequence[int]) -> Array:
        """Return the values (n, C) of n torque columns at the joints that links load."""
        joints = np.flatnonzero(self.loaded)
        return np.asarray(values[joints, np.array(columns)[joints]])


def fit_torques(
    robot: RobotModel, q: Array, columns: Array, period: float | None
) -> TorqueFit:
    """Return how well columns (N, C) are the torques of a motion q (N, n) [rad or m].

    ``period``: time between two rows [s]; None where it is not known: then the model's torque is
    that of gravity alone.
    """
    qd = np.gradient(q, period or 1.0, axis=0)
    qdd = np.gradient(qd, period or 1.0, axis=0)
    every = max(1, len(q) // _MOST_FITTED)
    q, qd, qdd, columns = (values[::every] for values in (q, qd, qdd, columns))
    moves = float(period is not None)
    motion = LinkDynamics(robot).motion(q, moves * qd, moves * qdd)
    model_torque = motion.torque(robot.thetas)
    load = np.zeros(q.shape[1])
    fits = []
    with np.errstate(divide="ignore", invalid="ignore"):
        for joint, fastest in enumerate(np.max(np.abs(qd), axis=0)):
            sign = np.tanh(qd[:, joint] / (0.02 * fastest or 1.0))
            friction = (np.ones(len(q)), qd[:, joint], qdd[:, joint], sign)
            torque = model_torque[:, joint]
            load[joint] = _regress(friction, torque[:, None])[1][0]
            coefficients, unexplained = _regress((*friction, torque), columns)
            dry, factor = coefficients[3:]
            size = np.clip(np.abs(factor), LEAST_SCALE, LARGEST_SCALE)
            # What the model's torque explains is orthogonal to what nothing explains.
            spread = np.hypot(unexplained, factor * load[joint])
            missed = (factor - np.sign(factor) * size) * load[joint]
            residual = np.hypot(unexplained, missed)
            direction = dry / np.std(columns, axis=0)
            ratios = (residual / spread, unexplained / spread)
            fits.append((factor, *ratios, residual, direction))
    # A constant column is not explained, and has no direction.
    numbers = np.nan_to_num(np.array(fits), nan=1.0, posinf=1.0, neginf=1.0)
    scale, misfit, any_scale_misfit, residual, direction = np.swapaxes(numbers, 0, 1)
    loaded = _find_loaded(load)
    return TorqueFit(scale, misfit, any_scale_misfit, residual, direction, loaded)


def _find_loaded(load: Array) -> Mask:
    """Return (n,) which joints links load, at least two of several.

    ``load``: (n,) rms of the model's torque of each joint beside friction [N m].
    """
    # One joint alone may match a foreign column by chance.
    count = min(2, len(load))
    second = float(np.sort(load)[-count])
    return load >= max(min(_LOADED * float(np.max(load)), second), 1e-9)


def _regress(regressors: Sequence[Array], values: Array) -> tuple[Array, Array]:
    """Fit regressors, (N,) each, to values (N, c) by least squares.

    Returns:
        The coefficients, (c,) for each regressor, and the rms (c,) that they leave of values.
    """
    matrix = np.column_stack(regressors)
    size = np.maximum(np.max(np.abs(matrix), axis=0), 1e-300)
    scaled, *_ = np.linalg.lstsq(matrix / size, values, rcond=1e-9)
    coefficients = scaled / size[:, None]
    residual = values - matrix @ coefficients
    return coefficients, np.sqrt(np.mean(residual**2, axis=0))
