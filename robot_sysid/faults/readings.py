"""The table of mistakes in a log's columns, and how a log is read without them.

Signs, exchanged joints, turned zeros, degrees, another mounting of the base and time by another
rate change a log by steps, not by a small amount, so that they have no column in the fit: each is
another reading of the log. ``reading_search`` finds the readings that fit.

Throughout, n is the number of joints.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.friction import COULOMB
from robot_sysid.dynamics.inverse_dynamics import gravity_vector
from robot_sysid.estimate.rows import Rows
from robot_sysid.faults import ColumnCorrection
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.fault_names import FaultName
from robot_sysid.signals.process import FilteredRecording

_OF_JOINTS = (
    "record positions and torques of the joints, or convert those of the motors with the ratios of "
    "their gears"
)
_OF_MOTORS = (
    *(np.array([[1.0, 0.0], [ratio, 1.0]]) for ratio in (1.0, -1.0)),
    *(np.array([[1.0, ratio], [0.0, 1.0]]) for ratio in (1.0, -1.0)),
    *(0.5 * np.array([[1.0, 1.0], [ratio, -ratio]]) for ratio in (1.0, -1.0)),
)
"""Positions of two joints (2, 2) from those of their motors."""
_RIGHT_COLUMNS = "put the columns right with {columns FILE}"
_TURNS = tuple(np.radians((90.0, -90.0, 180.0)).tolist())
"""Turns of a joint's zero that are tried: makers and modellers differ by right angles."""
_TIMES = (0.25, 0.35, 0.5, 0.7, 1.4, 2.0, 2.8, 4.0)
"""Factors of time that are tried; the one that is right is found from the nearest."""
GEARS = (0.5, 0.8, 1.25, 2.0)
"""Factors of one joint's positions that are tried, as of another gear: that which is right is found
from there. A ratio is on a motor's torque as well, or on its positions alone."""
TRAVELS = (0.05, 40.0)
"""Least and largest travel of a joint in a log: of positions in another unit, it is some hundredths
of a radian, or tens of turns [rad]."""
ZERO_STEP = np.radians(30.0)
"""Step of the angles of a zero that are tried first: one that is off by half a step reads better
with it than with none."""
_HALF_TURN = round(np.pi / ZERO_STEP)
ANY_ANGLES = tuple(
    ZERO_STEP * step for step in range(1 - _HALF_TURN, _HALF_TURN + 1) if step
)
"""These angles, all around but for none [rad]."""
_RADIANS_PER_DEGREE = np.radians(1.0)


@dataclass(frozen=True)
class Reading:
    """How a log has to be read otherwise: right columns are matrices, with one number per row and
    column, times recorded ones, plus angles.

    Attributes:
        position: (n, n) of positions.
        torque: (n, n) of torques.
        zeros: (n,) added to positions [rad].
        gravity: (3,) [m/s^2]; None for the model's.
        time: by which times are multiplied.
    """

    position: Array
    torque: Array
    zeros: Array
    gravity: Array | None = None
    time: float = 1.0

    @classmethod
    def of(cls, n: int, mistakes: Sequence[Mistake] = ()) -> Reading:
        """Return the reading of the log of n joints without mistakes, one after the other."""
        reading = cls(np.eye(n), np.eye(n), np.zeros(n))
        for mistake in mistakes:
            right = mistake.reading
            reading = cls(
                right.position @ reading.position,
                right.torque @ reading.torque,
                right.position @ reading.zeros + right.zeros,
                reading.gravity if right.gravity is None else right.gravity,
                right.time * reading.time,
            )
        return reading

    @classmethod
    def with_torque_times(cls, factors: Array) -> Reading:
        """Return the reading in which torques are multiplied by factors (n,)."""
        return replace(cls.of(len(factors)), torque=np.diag(factors))

    def apply(self, recording: FilteredRecording) -> FilteredRecording:
        """Return a recording read so, of which as many rows are used."""
        position = self.position.T
        dry = directions(recording)
        # A joint's rows are those in which it moves.
        return recording.using(
            recording.is_used @ (position != 0.0),
            q=recording.q @ position + self.zeros,
            qd=recording.qd @ position / self.time,
            qdd=recording.qdd @ position / self.time**2,
            tau=recording.tau @ self.torque.T,
            touched=(),
            # The direction of friction is that of the speed; one of two motors has its own.
            columns=None if self.mixes else {COULOMB.name: dry @ np.sign(position)},
        )

    @property
    def blamed(self) -> NDArray[np.bool_]:
        """The joints (n,) whose columns or zeros it changes; none of a mounting, or of time."""
        every = np.eye(len(self.zeros))
        is_other = (self.position != every) | (self.torque != every)
        return np.any(is_other, axis=1) | (self.zeros != 0.0)

    @property
    def factors(self) -> Array:
        """By which torques (n,) become larger, as their noise does; what mixes has that of all.

        A log is no likelier because its numbers are smaller.
        """
        if not self.mixes:
            return np.asarray(np.sum(np.abs(self.torque), axis=1))
        is_changed = np.any(self.torque != np.eye(len(self.torque)), axis=1)
        count = max(int(np.count_nonzero(is_changed)), 1)
        size = abs(float(np.linalg.det(self.torque))) ** (1.0 / count)
        return np.where(is_changed, size, 1.0)

    @property
    def mixes(self) -> bool:
        """Whether positions of a joint are made of those of several."""
        return bool(np.any(np.count_nonzero(self.position, axis=1) > 1))

    @property
    def columns(self) -> ColumnCorrection | None:
        """The correction of a log's columns, with zeros; gravity is none.

        None where a joint's columns are made of several: no line of a columns file says that.
        """
        if self.mixes:
            return None
        # Half a turn at the most, in either direction.
        zeros = (self.zeros + np.pi) % (2.0 * np.pi) - np.pi
        return ColumnCorrection(
            sources(self.position),
            sources(self.torque),
            tuple(zeros.tolist()) if np.any(zeros) else (),
        )


def directions(recording: FilteredRecording) -> Array:
    """Return the direction (K, n) of each joint's friction in a recording, low-passed."""
    rows = Rows(recording, slice(None))
    return rows.low_passed(COULOMB.name, lambda motion: np.sign(motion.qd))


def sources(matrix: Array) -> tuple[tuple[int, float], ...]:
    """Return (index, factor) of the only number of each row of a matrix (n, n) that is not zero."""
    indices = np.argmax(matrix != 0.0, axis=1)
    return tuple(zip(indices.tolist(), np.sum(matrix, axis=1).tolist()))


@dataclass(frozen=True)
class Mistake:
    """A row of the table: its name, in words, and how the log is read without it.

    Other columns put right what has words of its own. Those of a zero, of a direction of gravity
    and of a time follow from all that is found together: such a row has none.
    """

    name: FaultName
    text: str
    reading: Reading
    remedy: str = _RIGHT_COLUMNS
    options: tuple[tuple[str, ...], ...] = ()


def mistakes(
    robot: RobotModel, moving: Sequence[int], travels: Array
) -> Iterator[Mistake]:
    """Yield every mistake that is tried.

    ``moving`` are the numbers of the joints that move: columns of a joint that stands still say
    nothing of whose they are. ``travels`` (n,) are as in ``angle_units``.
    """
    yield from turned_signs(robot, moving)
    yield from exchanges(robot, moving)
    yield from angle_units(robot, moving, travels)
    yield from zeros(robot, moving)
    yield from mountings(robot)
    yield from time_bases(robot)


def turned_signs(robot: RobotModel, moving: Sequence[int]) -> Iterator[Mistake]:
    """Yield turned signs of positions, torques and both, of each joint and of all.

    A log may have one and fit all the same, as of a wrist without weight. Exchanged wrists would
    pass for friction that no term has.
    """
    for each in _QUANTITIES:
        yield from signs(robot, moving, each)


def exchanges(robot: RobotModel, moving: Sequence[int]) -> Iterator[Mistake]:
    """Yield exchanges of two joints, reversed orders, and motors that turn two joints."""
    for each in _QUANTITIES:
        yield from orders(robot, moving, each)
    yield from shared_motors(robot, moving)


def is_torque_sign(mistake: Mistake) -> bool:
    """Return whether a mistake is the sign of one joint's torque."""
    turned = np.diag(mistake.reading.torque) < 0.0
    is_position = np.any(np.diag(mistake.reading.position) < 0.0)
    return bool(np.count_nonzero(turned) == 1 and not is_position)


@dataclass(frozen=True)
class _Quantities:
    """Quantities whose columns a mistake changes: their names, as subject and verb, as scope."""

    names: tuple[str, ...]
    subject: str
    scope: str


_QUANTITIES = (
    _Quantities(("torque",), "torque of {} has", " in the torques"),
    _Quantities(("position",), "position of {} has", " in the positions"),
    _Quantities(("position", "torque"), "position and torque of {} have", ""),
)


def mirror(across: Array) -> Array:
    """Return the matrix (n, n) that mirrors columns: it turns one, or exchanges two."""
    return np.asarray(
        np.eye(len(across)) - 2.0 * np.outer(across, across) / (across @ across)
    )


def of_columns(
    name: FaultName, text: str, matrix: Array, quantities: Sequence[str]
) -> Mistake:
    """Return a mistake that one matrix (n, n) puts right, of positions, torques or both."""
    changed: dict[str, Any] = dict.fromkeys(quantities, matrix)
    return Mistake(name, text, replace(Reading.of(len(matrix)), **changed))


def signs(
    robot: RobotModel, moving: Sequence[int], of: _Quantities
) -> Iterator[Mistake]:
    """Yield turned signs of each joint's columns and of all."""
    names = robot.joint_names
    every = np.eye(len(names))
    text = f"the {of.subject} the opposite sign of the model's"
    for joint in moving:
        own = text.format(f"joint {names[joint]}")
        yield of_columns(FaultName.SIGN, own, mirror(every[joint]), of.names)
    # With positions and torques of all turned, the arm is mirrored as a whole, and fits as well.
    if len(names) > 1 and of.scope:
        yield of_columns(FaultName.SIGN, text.format("every joint"), -every, of.names)


def orders(
    robot: RobotModel, moving: Sequence[int], of: _Quantities
) -> Iterator[Mistake]:
    """Yield exchanges of two joints' columns, and the reversed order of all."""
    names = robot.joint_names
    every = np.eye(len(names))
    for one, two in combinations(moving, 2):
        text = f"joints {names[one]} and {names[two]} are exchanged{of.scope}"
        exchange = mirror(every[one] - every[two])
        yield of_columns(FaultName.ORDER, text, exchange, of.names)
    if len(names) > 2 and len(moving) == len(names):
        text = f"the order of the joints is reversed{of.scope}"
        yield of_columns(FaultName.ORDER, text, every[::-1], of.names)


def angle_units(
    robot: RobotModel, moving: Sequence[int], travels: Array
) -> Iterator[Mistake]:
    """Yield degrees that were taken for radians, of all joints and of each, and the reverse.

    ``travels`` (n,) are those of the joints as they were recorded: one joint's unit is another only
    where it would have travelled as joints do.
    """
    none = Reading.of(robot.n_joints)
    radians = np.where(robot.is_slide, 1.0, _RADIANS_PER_DEGREE)
    yield Mistake(
        FaultName.ANGLE_UNIT,
        "positions look like degrees",
        replace(none, position=np.diag(radians)),
        "pass {units=deg}",
        (("--units", "deg"),),
    )
    yield Mistake(
        FaultName.ANGLE_UNIT,
        "positions look like radians that were taken for degrees",
        replace(none, position=np.diag(1.0 / radians)),
        "say rad where degrees are said: in {units}, the file of {columns}, a column's title or "
        "the recorder",
    )
    ways = (
        (_RADIANS_PER_DEGREE, "degrees"),
        (1.0 / _RADIANS_PER_DEGREE, "radians that were taken for degrees"),
    )
    for joint, (factor, unit) in product(moving, ways):
        exists = TRAVELS[0] < factor * travels[joint] < TRAVELS[1]
        if exists and not robot.is_slide[joint]:
            yield Mistake(
                FaultName.ANGLE_UNIT,
                f"the position of joint {robot.joint_names[joint]} looks like {unit}",
                position_times(robot.n_joints, joint, factor),
            )


def gear_ratios(
    robot: RobotModel, moving: Sequence[int], weighed: Sequence[int]
) -> Iterator[Mistake]:
    """Yield positions of one joint that are another size than it moves, as of a gear.

    Its torque may be as well where weight shows the position (``weighed``): elsewhere, both
    together are another inertia.
    """
    for joint, factor in product(moving, GEARS):
        yield gear_of(robot, joint, factor, False)
    for joint, factor in product(weighed, GEARS):
        yield gear_of(robot, joint, factor, True)


def gear_of(robot: RobotModel, joint: int, factor: float, is_of_motor: bool) -> Mistake:
    """Return a gear of one joint that a factor of positions puts right.

    ``is_of_motor``: whether the torque was made with the same ratio, which divides it.
    """
    text = f"the position of joint {robot.joint_names[joint]} reads {1.0 / factor:.3g} times as "
    text += "much as it moves, as of another gear ratio"
    if is_of_motor:
        text += f", and its torque {factor:.3g} times as much as it is"
    reading = position_times(robot.n_joints, joint, factor)
    torque = reading.torque.copy()
    torque[joint, joint] = 1.0 / factor if is_of_motor else 1.0
    return Mistake(FaultName.ANGLE_UNIT, text, replace(reading, torque=torque))


def position_times(n: int, joint: int, factor: float) -> Reading:
    """Return the reading in which positions of one of n joints are multiplied by a factor."""
    factors = np.ones(n)
    factors[joint] = factor
    return replace(Reading.of(n), position=np.diag(factors))


def gear_in(reading: Reading) -> tuple[int, float, bool] | None:
    """Return what ``gear_of`` takes of a gear's reading: joint, factor, kind; None of another one.

    Degrees are no gear.
    """
    factors = np.diag(reading.position)
    (joints,) = np.nonzero(factors != 1.0)
    if len(joints) != 1:
        return None
    joint = int(joints[0])
    factor = float(factors[joint])
    if not 1.0 < max(factor, 1.0 / factor) < 1.0 / _RADIANS_PER_DEGREE:
        return None
    return joint, factor, bool(reading.torque[joint, joint] != 1.0)


def shared_motors(robot: RobotModel, moving: Sequence[int]) -> Iterator[Mistake]:
    """Yield positions and torques of two neighbours' motors, which turn both joints.

    One motor turns with its joint and, through a bevel or a belt, with the next; or both turn a
    differential. Power is the same on both sides.
    """
    names = robot.joint_names
    for one, two in zip(moving, moving[1:]):
        if two != one + 1:
            continue
        for joints in _OF_MOTORS:
            position = np.eye(len(names))
            position[one : two + 1, one : two + 1] = joints
            text = (
                f"position and torque of joints {names[one]} and {names[two]} are those of "
                "motors that turn both"
            )
            reading = Reading.of(len(names))
            torque = np.asarray(np.linalg.inv(position).T, dtype=float)
            reading = replace(reading, position=position, torque=torque)
            yield Mistake(FaultName.COUPLING, text, reading, _OF_JOINTS)


def zeros(
    robot: RobotModel, moving: Sequence[int], angles: Sequence[float] = _TURNS
) -> Iterator[Mistake]:
    """Yield zeros of each joint that are turned by angles [rad], by right ones unless stated."""
    for joint, angle in product(moving, angles):
        if not robot.is_slide[joint]:
            yield zero_of(robot.n_joints, joint, angle)


def zero_of(n: int, joint: int, angle: float) -> Mistake:
    """Return the zero of one of n joints that an angle puts right [rad]."""
    turned = angle * np.eye(n)[joint]
    return Mistake(FaultName.ZERO, "", replace(Reading.of(n), zeros=turned))


def mountings(robot: RobotModel) -> Iterator[Mistake]:
    """Yield directions of gravity along axes and diagonals; none where there is no gravity."""
    none = Reading.of(robot.n_joints)
    size = np.linalg.norm(gravity_vector(robot))
    for axis in product((-1.0, 0.0, 1.0), repeat=3):
        if size * any(axis):
            gravity = size * np.array(axis) / np.linalg.norm(axis)
            yield Mistake(FaultName.TILT, "", replace(none, gravity=gravity))


def time_bases(robot: RobotModel) -> Iterator[Mistake]:
    """Yield times by another rate: what is off by less is a fault of the table, a small change.

    Where there is no gravity, another rate is other masses.
    """
    none = Reading.of(robot.n_joints)
    for factor in _TIMES if np.any(gravity_vector(robot)) else ():
        yield Mistake(FaultName.CLOCK, "", replace(none, time=factor))
