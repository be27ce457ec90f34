"""Motions that nobody recorded, on which a model file is judged: all over an arm's range.

Torque is linear in the parameters around a point, so that the squares of a file's errors on them
follow from sums of their rows alone, whatever the errors are.

Shapes: n joints of the chain; N samples of a motion.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from robot_sysid.estimate.rows import Sums
from robot_sysid.estimate.terms import DELAY, ArmTerms, Point
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.records.messages import position_unit
from robot_sysid.signals.filters import LowPass
from robot_sysid.signals.process import FilteredRecording
from robot_sysid.trajectory import assumed_reach, random_sinusoids

MOTIONS = 10
"""Number of made-up motions: enough that others in their place change the promise by a few per
cent."""
DURATION = 20.0
"""Length of each [s], two periods of the slowest sinusoid."""
RATE = 5.0
"""Samples of each per second: a sinusoid of 0.6 Hz has eight in a period [Hz]."""


def made_up_motions(
    robot: RobotModel, speeds: Array, rng: np.random.Generator
) -> Iterator[Motion]:
    """Yield motions of an arm all over its range: sums of sinusoids of 0.1 to 0.6 Hz.

    Each joint moves as widely as its range and its speed allow, about a random position. Whether
    parts touch is not asked: nobody plays them.

    Args:
        robot: the arm; a joint without limits has half a turn to each side.
        speeds: (n,) highest speed of each joint [rad/s or m/s].
        rng: source of randomness.
    """
    time = np.arange(round(DURATION * RATE)) / RATE
    for _ in range(MOTIONS):
        motion = random_sinusoids(robot.n_joints, time, rng)
        yield within_range(robot, motion, speeds, rng)


def within_range(
    robot: RobotModel, shape: Motion, speeds: Array, rng: np.random.Generator
) -> Motion:
    """Return a motion about zero (N, n) scaled to an arm's ranges and speeds, about random places.

    The arguments are those of ``made_up_motions``.
    """
    limits = robot.limits.around(robot.reference, assumed_reach(robot))
    reach = np.max(np.abs(shape.q), axis=0)
    fastest = np.max(np.abs(shape.qd), axis=0)
    factor = np.minimum(limits.span / reach, speeds / fastest)
    room = limits.span - factor * reach
    center = limits.center + room * rng.uniform(-1.0, 1.0, robot.n_joints)
    q = center + factor * shape.q
    return Motion(shape.time, q, factor * shape.qd, factor * shape.qdd)


def highest_speed(robot: RobotModel, speeds: Array) -> tuple[float, str]:
    """Return the highest of speeds (n,) of an arm's hinges and its unit; of slides, if all are."""
    are_slides = bool(np.all(robot.is_slide))
    highest = float(np.max(speeds[robot.is_slide == are_slides]))
    return highest, f"{position_unit(are_slides)}/s"


def grams(sums: Sums) -> Iterator[Array]:
    """Yield the products (p + 1, p + 1) of each joint's rows, of all columns and the torque."""
    size = len(sums.names) + 1
    for columns, total in zip(sums.columns, sums.totals):
        gram = np.zeros((size, size))
        gram[columns[:, None], columns] = total
        yield gram


def without_constant(products: Array, offset: int) -> Array:
    """Return products (p, p) of rows from which the constant torque of one joint is taken out.

    ``offset`` is the index of the column of its sensor's offset, which looks the same.
    """
    own = products[offset]
    count = own[offset]
    return products - np.outer(own, own) / count if count else products


def sums_elsewhere(
    arm: ArmTerms, point: Point, motions: Sequence[Motion], is_loaded: bool = False
) -> Sums:
    """Return the sums of made-up motions, whose torque is minus what no term has.

    So the squares of a torque as a whole are those at the parameters' values: springs and tendons,
    which no term has, are in them. A delay has no column: it is the log's, not the arm's.

    Args:
        arm: terms that have columns.
        point: around which they are linearised.
        motions: of the arm.
        is_loaded: whether the arm carries the payload.
    """
    terms = arm.of(term for term in arm.terms.values() if term.cause != DELAY)
    # One after the other: no column depends on the rows beside its own.
    parts = zip(*((motion.q, motion.qd, motion.qdd) for motion in motions))
    states = [np.concatenate(part) for part in parts]
    nothing = np.zeros_like(states[0])
    motion = Motion(np.arange(len(nothing)) / RATE, *states)
    unfiltered = LowPass(RATE, RATE, np.ones(1), 1)
    recording = FilteredRecording.exact(
        motion, nothing, unfiltered, is_loaded=is_loaded
    )
    every_row = np.ones_like(nothing, dtype=bool)
    return terms.sums([recording.using(every_row)], point, in_blocks=False)
