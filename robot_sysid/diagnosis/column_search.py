"""The one search beside the fit: which readings of a log's columns fit best.

A mistake in columns is no small change, so that it has no column in the sums of the fit. Logs that
are read without a mistake are fitted anew, to the model's links and friction on a part of the same
rows; the mistake that fits best is taken, and others are tried beside it, so that signs of several
joints are found one after the other. The log that results is solved whole, by the fit.

Throughout, K is the number of rows, n that of joints, J that of joints with equations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from robot_sysid.diagnosis import Finding
from robot_sysid.diagnosis.columns import OF_COLUMNS, Mistake, Reading, mistakes
from robot_sysid.diagnosis.fault_columns import INERTIAL, fault_columns
from robot_sysid.diagnosis.plausibility import fits, model_torque
from robot_sysid.dynamics.inverse_dynamics import (
    TILT_NAMES,
    gravity_vector,
    turn_gravity,
    with_gravity,
)
from robot_sysid.estimate.choose import solve_question
from robot_sysid.estimate.fit import Equations, Fit, equations_of, solve
from robot_sysid.estimate.offers import Effect, Offers
from robot_sysid.estimate.questions import Question, arm_question
from robot_sysid.estimate.terms import MOTORS
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.levels import CLEAR, INTERVAL
from robot_sysid.records.messages import Level, with_error
from robot_sysid.records.usual_errors import GRAVITY_IN_FILE
from robot_sysid.signals.process import FilteredRecording
from robot_sysid.wording import option_name, with_option_names

ROWS = 250
"""Rows by which readings are compared: they tell them apart, and a log has thousands."""
LEAST_RESIDUAL = 0.01
"""Residual that does not count, as a share of all torque: a right log leaves as much."""
FIRST_NOISE = 0.05
"""Noise that a search begins with, as a share of each joint's torque."""
NOISE_ROUNDS = 2
"""Rounds in which the noise is taken from the residuals: noise that is found to the end follows a
joint that other joints' errors were left to."""
FOLLOWED = 3
"""Likeliest first mistakes that are followed, as one that is wrong may fit as well alone."""
MOST_TOGETHER = 8
"""Largest number of mistakes that act together."""
LEAST_OF_FIRST = 0.5
"""Least gain of mistakes together, over that of the likeliest first one."""
ALIKE = 1.0
"""Difference in log likelihood within which two readings are equally likely [nats]."""
LEAST_NOISE = 1e-3
"""Least noise by which two fits are compared, as a share of all torque."""
TURNED = 5.0
"""Angle from which on a base is mounted otherwise; less is a tilt [degrees]."""
MOUNTING_TILT = 15.0
"""Tilt that is allowed about one of the 26 directions: they are at most some 27 degrees from the
true one, usually half as much [degrees]."""
FULL_TURN = 360.0
"""[degrees]"""
RATIOS = np.array([0.2, 0.25, 1.0 / 3.0, 0.4, 0.5, 2.0, 2.5, 3.0, 4.0, 5.0])
"""Ratios of usual rates of controllers; loops of 5 ms are taken for ones of 1 ms, hardly more."""
NEAR_RATIO = 0.08
"""Relative distance within which a factor of time is such a ratio: links that are off by 15 % of
their inertia make as much of it."""
INERTIA_OFF = 0.5
"""Share by which inertia may be off between two factors of time that are tried, about."""
KEPT_WEIGHT = 0.7
"""Share of the model's weight, as a median of the joints, below which a balancer carries a part of
it, which is as much inertia too much: a wrong time leaves weight as it is, and so many links are
not 30 % lighter than in the model."""
LEAST_INERTIA = 0.1
"""Least share of inertia that a factor of time makes up for at once; torque of weight alone has
none at all."""


@dataclass(frozen=True)
class Evidence:
    """What is known of a log beside its rows.

    Attributes:
        divided: (n,) torque scales by which the torques were divided already.
        time_share: by which time is too long, by recorded velocities; None where there are none.
        advance: is called after each round of a search.
    """

    divided: Array
    time_share: float | None
    advance: Callable[[], object]


@dataclass(frozen=True)
class Correction:
    """What is wrong, the gain of putting it right in log likelihood [nats], and the fit then."""

    findings: tuple[Finding, ...]
    gain: float
    fit: Fit


def with_priors(question: Question, **priors: Any) -> Question:
    """Return a question with other priors."""
    options = question.options
    changed = replace(options, priors=replace(options.priors, **priors))
    return replace(question, options=changed)


def part_of_rows(fitted: Fit, count: int) -> tuple[tuple[FilteredRecording, ...], int]:
    """Return recordings of a fit with about ``count`` rows in all, each one of so many."""
    every = max(1, sum(map(len, fitted.recordings)) // count)
    recordings = (
        recording.using(recording.is_used[::every], every=every)
        for recording in fitted.recordings
    )
    return tuple(recordings), every


class ColumnSearch:
    """Compares readings of a log on a part of its rows.

    Args:
        fitted: the fit of the log.
    """

    def __init__(self, fitted: Fit) -> None:
        question = with_priors(fitted.question, friction=0.0)
        needed = []
        for key, term in fitted.arm.terms.items():
            if term.bodies or term.cause == MOTORS or key in question.friction:
                needed.append(term)
        self.arm = fitted.arm.of(needed)
        self.terms = arm_question(self.arm, question, fitted.sums.rms_torque)
        self.recordings, _ = part_of_rows(fitted, ROWS)

    def score(self, found: Sequence[Mistake]) -> float:
        """Return the log likelihood of the log without mistakes, but for a constant."""
        arm = self.arm
        reading = Reading.of(arm.robot.n_joints, found)
        point = arm.start()
        if reading.gravity is not None:
            point = replace(point, gravity=reading.gravity)
        # Likelihoods need no blocks.
        sums = arm.sums([reading.apply(each) for each in self.recordings], point, False)
        torque = sums.rms_torque
        equations = equations_of(arm, sums, self.terms, {})
        least = LEAST_RESIDUAL * np.sqrt(np.mean(torque**2))
        counts = sums.row_counts
        noise = np.maximum(FIRST_NOISE * torque, least)
        for _ in range(NOISE_ROUNDS):
            normal = equations.normal(1.0 / noise)
            values, _ = solve(normal, equations.reference)
            crosses = equations.crossing(values)
            if np.any(crosses):
                start = np.where(crosses, equations.inside(values), equations.reference)
                values, _ = solve(normal, start, ~crosses)
            squares = equations.squared_residuals(values)
            noise = np.maximum(np.sqrt(squares / counts), least)
        return likelihood(equations, values, counts, noise)

    def best_together(
        self, tried: Sequence[Mistake], evidence: Evidence
    ) -> list[Mistake]:
        """Return the mistakes that fit best together, one after the other; [] for none."""
        before = self.score([])
        firsts = self._longer([], [*tried, *self._pairs(tried)])
        least = before + max(CLEAR, LEAST_OF_FIRST * (firsts[0][0] - before))
        ways = []
        for score, found in firsts[:FOLLOWED]:
            while score > least and len(found) < MOST_TOGETHER:
                evidence.advance()
                after, longer = self._longer(found, tried)[0]
                if after < score + CLEAR:
                    break
                score = after
                found = longer
            if score > least:
                ways.append((score, found))
        likeliest = max(ways, default=(0.0,), key=lambda way: way[0])[0]
        return next((found for score, found in ways if score > likeliest - ALIKE), [])

    def _pairs(self, tried: Sequence[Mistake]) -> Iterator[Mistake]:
        """Yield pairs of zeros: beside another wrong one, one alone may fit worse than none."""
        zeros = [each for each in tried if each.name is FaultName.ZERO]
        for both in combinations(zeros, 2):
            reading = Reading.of(self.arm.robot.n_joints, both)
            yield Mistake(FaultName.ZERO, "", reading)

    def _longer(
        self, found: list[Mistake], tried: Sequence[Mistake]
    ) -> list[tuple[float, list[Mistake]]]:
        """Return (log likelihood, mistakes) with one more each, the likeliest first."""
        ways = [[*found, each] for each in tried]
        scores = np.array([self.score(way) for way in ways])
        # Equally likely ones keep their order.
        order = np.argsort((np.max(scores) - scores) // ALIKE, kind="stable")
        return [(scores[k], ways[k]) for k in order.tolist()]


def likelihood(
    equations: Equations, values: Array, independent: Array, noise: Array
) -> float:
    """Return the log likelihood of values and of their priors, but for a constant.

    Args:
        equations: of the values.
        values: (k,) that solve them.
        independent: (J,) number of independent rows.
        noise: (J,) of the residuals [N m].
    """
    change = np.append(values, -1.0)
    pull = change @ equations.prior @ change
    return -float(independent @ np.log(noise) + 0.5 * pull)


def gain_between(before: Fit, after: Fit, factors: Array | float = 1.0) -> float:
    """Return by how much the second of two fits of one log, read otherwise, is likelier [nats].

    Both have the noise of their own residuals and the memory of the second's. ``factors`` (J,) are
    those by which its torques were multiplied.
    """
    counts = np.minimum(
        np.sum(before.sums.counts, axis=0), np.sum(after.sums.counts, axis=0)
    )
    independent = counts / np.minimum(before.correlation, after.correlation)
    least = LEAST_NOISE * np.sqrt(np.mean(before.sums.rms_torque**2))
    noise = np.maximum(before.noise, least)
    earlier = likelihood(before.equations, before.free, independent, noise)
    noise = np.maximum(after.noise / np.abs(factors), least)
    return likelihood(after.equations, after.free, independent, noise) - earlier


def refit(fitted: Fit, reading: Reading, **priors: float) -> Fit:
    """Return the fit of a log that is read otherwise, some priors of its question changed."""
    robot = fitted.arm.robot
    if reading.gravity is not None:
        robot = with_gravity(robot, reading.gravity)
    recordings = [reading.apply(recording) for recording in fitted.recordings]
    question = with_priors(fitted.question, **priors)
    return solve_question(robot, recordings, question, beside=fault_columns)


def column_correction(fitted: Fit, evidence: Evidence) -> Iterator[Correction]:
    """Yield the correction of the mistakes that fit best together, if there are any.

    They are the first ones with which the whole log fits.
    """
    robot = fitted.arm.robot
    moves = np.any(fitted.sums.counts, axis=0)
    moving = fitted.arm.indices[moves].tolist()
    found = ColumnSearch(fitted).best_together([*mistakes(robot, moving)], evidence)
    after = fitted
    findings: list[Finding] = []
    for number in range(1, len(found) + 1):
        reading = Reading.of(robot.n_joints, found[:number])
        findings = [*column_findings(robot, found[:number], reading)]
        if reading.gravity is not None:
            after, turned = mounting_correction(fitted, reading, reading.gravity)
            findings += turned
        elif reading.time != 1.0:
            after, timed = time_correction(fitted, reading)
            findings += timed
        else:
            after = refit(fitted, reading)
        if fits(after):
            break
    if findings:
        yield Correction(tuple(findings), gain_between(fitted, after), after)


def column_findings(
    robot: RobotModel, found: Sequence[Mistake], reading: Reading
) -> Iterator[Finding]:
    """Yield the findings on columns, which one reading puts right, and on zeros."""
    wrong = [each for each in found if each.name in OF_COLUMNS]
    if wrong:
        first = wrong[0]
        yield Finding(
            Level.REFUSES,
            first.name,
            "; ".join(dict.fromkeys(each.text for each in wrong)),
            with_option_names(first.remedy),
            first.options if len(wrong) == 1 else (),
            correction=reading.columns,
        )
    turned = np.rint(np.degrees(reading.zeros)) % FULL_TURN
    for name, degrees in zip(robot.joint_names, turned):
        if degrees:
            way = "little" if degrees <= 180.0 else "much"
            size = min(degrees, FULL_TURN - degrees)
            text = f"the position of joint {name} reads {size:.0f} degrees too {way}"
            remedy = "correct the joint's zero"
            if name == robot.joint_names[0] and robot.gravity is not None:
                # About an upright axis, a base that is turned is the same.
                remedy += f", or the direction of {option_name('gravity')}"
            yield Finding(Level.REFUSES, FaultName.ZERO, text, remedy)


def time_correction(fitted: Fit, reading: Reading) -> tuple[Fit, list[Finding]]:
    """Return the fit with time by another rate, and the finding, if it is.

    From one factor on, time is multiplied by what the torque of inertia says, which grows with its
    square; the ratio of two usual rates is taken in place of a number that is next to it.
    """
    for _ in range(3):
        after = refit(fitted, reading)
        offer = Offers(after).weigh(Effect((INERTIAL,), np.array([[INERTIA_OFF]])))
        inertia = max(1.0 + float(offer.values[0]), LEAST_INERTIA)
        reading = replace(reading, time=reading.time / np.sqrt(inertia))
    distances = np.abs(np.log(reading.time / RATIOS))
    if np.min(distances) < NEAR_RATIO:
        reading = replace(reading, time=float(RATIOS[np.argmin(distances)]))
    factor = reading.time
    finding = Finding(
        Level.REFUSES,
        FaultName.CLOCK,
        f"time in the log is {1.0 / factor:.3g} times as long as it was, as the torque of inertia "
        "shows beside that of gravity",
        "record the controller's own time stamps, or scale these with a line in "
        f"{option_name('columns', 'FILE')}: time = {factor:.4g} * TITLE",
    )
    after = refit(fitted, reading)
    _, shares, is_loaded = model_torque(after)
    weight = np.median(shares[is_loaded]) if np.any(is_loaded) else 1.0
    # Beyond these, torque lacks inertia or weight.
    exists = RATIOS[0] <= factor <= RATIOS[-1]
    is_whole = KEPT_WEIGHT < weight < 1.0 / KEPT_WEIGHT
    return after, [finding] if exists and is_whole else []


def mounting_correction(
    fitted: Fit, reading: Reading, gravity: Array
) -> tuple[Fit, list[Finding]]:
    """Return the fit of an arm whose base is mounted otherwise, and the finding, if it is.

    From one direction on, gravity (3,) is turned until the fit, which allows it a wide tilt, agrees
    with it.
    """
    for _ in range(2):
        turned = replace(reading, gravity=gravity)
        after = refit(fitted, turned, gravity=MOUNTING_TILT)
        at = after.at(TILT_NAMES)
        gravity = turn_gravity(gravity, after.free[at])
    level = gravity_vector(fitted.arm.robot)
    cosine = np.clip(level @ gravity / (level @ level), -1.0, 1.0)
    angle = float(np.degrees(np.arccos(cosine)))
    error = np.degrees(np.sqrt(np.max(np.diag(after.inverse)[at])))
    direction = gravity / np.linalg.norm(gravity)
    largest = np.argmax(np.abs(direction))
    axis = np.eye(3)[largest] * np.sign(direction[largest])
    off = np.degrees(np.arccos(min(direction @ axis, 1.0)))
    # Arms are mounted along an axis, but for what the fit of a file turns gravity by.
    if off < max(INTERVAL * error, GRAVITY_IN_FILE):
        direction = axis
    numbers = [f"{value:.4g}" for value in np.round(direction, 3) + 0.0]
    finding = Finding(
        Level.REFUSES,
        FaultName.TILT,
        f"gravity acts {with_error(angle, error, 'degrees')} from the model's: the base is mounted "
        "otherwise, on a wall or a ceiling",
        f"state the direction of gravity ({', '.join(numbers)}) with {option_name('gravity')}",
        (("--gravity", *numbers),),
    )
    # A base that is less tilted is mounted as the model says.
    return after, [finding] if angle > TURNED else []
