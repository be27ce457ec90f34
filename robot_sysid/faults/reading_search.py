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
from functools import cached_property
from itertools import chain, combinations
from typing import Any

import numpy as np

from robot_sysid.dynamics.inverse_dynamics import (
    TILT_NAMES,
    gravity_vector,
    turn_gravity,
    with_gravity,
)
from robot_sysid.estimate.choose import solve_question
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.offers import Effect, Offers
from robot_sysid.estimate.questions import Question, arm_question
from robot_sysid.estimate.terms import MOTORS
from robot_sysid.faults import Finding
from robot_sysid.faults.columns import INERTIAL, fault_columns
from robot_sysid.faults.plausibility import fits, is_foreign, model_torque
from robot_sysid.faults.reading_scores import ReadingScores, likelihood
from robot_sysid.faults.readings import (
    ANY_ANGLES,
    OF_COLUMNS,
    ZERO_STEP,
    Mistake,
    Reading,
    angle_units,
    gear_ratios,
    is_torque_sign,
    mistakes,
    time_bases,
    turned_signs,
    zero_of,
    zeros,
)
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
FINE_RESIDUAL = 0.001
"""The same where mistakes are taken one by one: a wrist without weight makes a few thousandths of
all torque, and its sign shows in as much of it."""
ZERO_ROUNDS = 5
"""Rounds in which the step around the best angle of a zero is halved, to a degree."""
MOST_SIGNS = 7
"""Joints of which all signs of torques are tried together, 128 ways."""
FOLLOWED = 3
"""Likeliest first mistakes that are followed, as one that is wrong may fit as well alone."""
LIKELY = 40
"""Likeliest first mistakes that are tried beside others: four wrong signs are among them."""
MOST_TOGETHER = 8
"""Largest number of mistakes that act together."""
LEAST_OF_FIRST = 0.5
"""Least gain of mistakes together, over that of the likeliest first one."""
ALIKE = 1.0
"""Difference in log likelihood within which two readings are equally likely [nats]."""
LEAST_NOISE = 1e-3
"""Least noise by which two fits are compared, as a share of all torque."""
TURNED = 5.0
"""Angle from which on a base is mounted otherwise, or a zero is a mistake of positions; less is a
tilt, or a fault of the torque [degrees]."""
MOUNTING_TILT = 15.0
"""Tilt that is allowed about one of the 26 directions: they are at most some 27 degrees from the
true one, usually half as much [degrees]."""
FULL_TURN = 360.0
"""[degrees]"""
RIGHT_ANGLE = np.pi / 2.0
"""[rad]"""
RATIOS = np.array([0.2, 0.25, 1.0 / 3.0, 0.4, 0.5, 2.0, 2.5, 3.0, 4.0, 5.0])
"""Ratios of usual rates of controllers; loops of 5 ms are taken for ones of 1 ms, hardly more."""
OTHER_RATE = np.log(1.4)
"""Logarithm of a factor of time from which on it is another rate: a fault of the table, which says
what else it may be, names smaller ones."""
NEAR_RATIO = 0.08
"""Relative distance within which a factor of time is such a ratio: links that are off by 15 % of
their inertia make as much of it."""
INERTIA_OFF = 0.5
"""Share by which inertia may be off between two factors of time that are tried, about."""
KEPT_WEIGHT = 0.7
"""Share of the model's weight, as a median of the joints, below which a balancer carries a part of
it, which is as much inertia too much: a wrong time leaves weight as it is, and so many links are
not 30 % lighter than in the model."""
TIME_ROUNDS = 3
"""Most rounds in which a factor of time is found."""
SAME_INERTIA = 0.05
"""Logarithm of the share by which inertia is off from which on the factor of time is found: its
square root, and a few percent of the ratios of usual rates."""
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
    """Compares readings of a log on a part of its rows, for all searches in it.

    Args:
        fitted: the fit of the log.

    Attributes:
        moving: numbers of the joints that move in it.
    """

    def __init__(self, fitted: Fit) -> None:
        self.fitted = fitted
        moves = np.any(fitted.sums.counts, axis=0)
        self.moving: list[int] = fitted.arm.indices[moves].tolist()
        question = with_priors(fitted.question, friction=0.0)
        needed = []
        for key, term in fitted.arm.terms.items():
            if term.bodies or term.cause == MOTORS or key in question.friction:
                needed.append(term)
        self.arm = fitted.arm.of(needed)
        terms = arm_question(self.arm, question, fitted.sums.rms_torque)
        recordings, _ = part_of_rows(fitted, ROWS)
        self.scores = ReadingScores(self.arm, recordings, terms)

    def score(self, found: Sequence[Mistake], share: float = LEAST_RESIDUAL) -> float:
        """Return the log likelihood of the log without mistakes, but for a constant.

        Residuals below a ``share`` of all torque do not count.
        """
        reading = Reading.of(self.arm.robot.n_joints, found)
        return self.scores.score(reading, share)

    def one_by_one(self, tried: Sequence[Mistake], evidence: Evidence) -> list[Mistake]:
        """Return mistakes that each gain alone, of joints that make little torque as well."""
        found: list[Mistake] = []
        score = self.score(found, FINE_RESIDUAL)
        first, _ = self._longer(found, tried, FINE_RESIDUAL)[0]
        after, signs = self._signs(tried)
        # Several signs are taken at once where they gain more than another mistake does.
        if after > max(first, score) + CLEAR * (len(signs) - 1):
            score, found = after, signs
        while len(found) < MOST_TOGETHER:
            evidence.advance()
            after, longer = self._longer(found, tried, FINE_RESIDUAL)[0]
            if after < score + CLEAR:
                break
            score, found = after, longer
        return found

    def best_zero(self) -> list[Mistake]:
        """Return the zero of one joint, to a degree, with which the log reads best; [] for none.

        One that is off by right angles may also be another mounting of the base, with which
        ``best_together`` compares it; one that is off by little is a fault of the torque.
        """
        n = self.arm.robot.n_joints

        def score(zero: Mistake) -> float:
            """Return the log likelihood of the log without a zero."""
            return self.score([zero], FINE_RESIDUAL)

        shown = [joint for joint in self.moving if self._shows_zero(joint)]
        tried = [*zeros(self.arm.robot, shown, ANY_ANGLES)]
        if not tried:
            return []
        most, best = max(((score(each), each) for each in tried), key=lambda w: w[0])
        joint = int(np.argmax(np.abs(best.reading.zeros)))
        step = ZERO_STEP
        for _ in range(ZERO_ROUNDS):
            step *= 0.5
            angle = best.reading.zeros[joint]
            ways = [zero_of(n, joint, angle + side) for side in (-step, step)]
            scored = [(most, best), *((score(each), each) for each in ways)]
            most, best = max(scored, key=lambda way: way[0])
        is_clear = most > self.score([], FINE_RESIDUAL) + CLEAR
        angle = best.reading.zeros[joint]
        beside = abs(angle - RIGHT_ANGLE * round(angle / RIGHT_ANGLE))
        return [best] if is_clear and beside > np.radians(TURNED) else []

    @cached_property
    def other_units(self) -> list[Mistake]:
        """The other unit of positions, or rate of time, with which the log reads best; [] for none.

        Where most joints carry little, the few that do show it in some thousandths of all torque.
        No rate is tried for torques in another unit: a factor on them is none on their inertia.
        """
        robot = self.arm.robot
        tried = [*angle_units(robot, self.moving), *gear_ratios(robot, self.moving)]
        if not is_foreign(self.fitted):
            tried += time_bases(robot)
        scores = [self.score([each], FINE_RESIDUAL) for each in tried]
        most = max(scores, default=-np.inf)
        is_clear = most > self.score([], FINE_RESIDUAL) + CLEAR
        return [tried[scores.index(most)]] if is_clear else []

    def _signs(self, tried: Sequence[Mistake]) -> tuple[float, list[Mistake]]:
        """Return the likeliest turned signs of torques, two at least, with their likelihood."""
        turned = [each for each in tried if is_torque_sign(each)]
        if len(turned) > MOST_SIGNS:
            return -np.inf, []
        counts = range(2, len(turned) + 1)
        ways = chain.from_iterable(combinations(turned, count) for count in counts)
        scored = [(self.score(way, FINE_RESIDUAL), [*way]) for way in ways]
        return max(scored, default=(-np.inf, []), key=lambda way: way[0])

    def best_together(
        self, tried: Sequence[Mistake], evidence: Evidence
    ) -> list[Mistake]:
        """Return the mistakes that fit best together, one after the other; [] for none."""
        before = self.score([])
        pairs = [*self._pairs(tried)]
        firsts = self._longer([], [*tried, *pairs])
        are_pairs = {*map(id, pairs)}
        likely = [way[0] for _, way in firsts if id(way[0]) not in are_pairs][:LIKELY]
        least = before + max(CLEAR, LEAST_OF_FIRST * (firsts[0][0] - before))
        ways = []
        for score, found in firsts[:FOLLOWED]:
            while score > least and len(found) < MOST_TOGETHER:
                evidence.advance()
                after, longer = self._longer(found, likely)[0]
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
        shown = [joint for joint in self.moving if self._shows_zero(joint)]
        turned = [each for each in tried if np.any(each.reading.zeros[shown])]
        for both in combinations(turned, 2):
            reading = Reading.of(self.arm.robot.n_joints, both)
            # Two of one joint are a third one, or none.
            if np.count_nonzero(reading.zeros) == 2:
                yield Mistake(FaultName.ZERO, "", reading)

    def _shows_zero(self, joint: int) -> bool:
        """Return whether the log would show a zero of a joint.

        That about an upright axis is another heading of the base, and that of the last joint turns
        the last link, which is free. A slide has none that is turned.
        """
        if self.arm.robot.is_slide[joint]:
            return False
        turned = zero_of(self.arm.robot.n_joints, joint, RIGHT_ANGLE)
        change = self.score([turned], FINE_RESIDUAL) - self.score([], FINE_RESIDUAL)
        return abs(change) > ALIKE

    def _longer(
        self,
        found: list[Mistake],
        tried: Sequence[Mistake],
        share: float = LEAST_RESIDUAL,
    ) -> list[tuple[float, list[Mistake]]]:
        """Return (log likelihood, mistakes) with one more each, the likeliest first."""
        ways = [[*found, each] for each in tried]
        scores = np.array([self.score(way, share) for way in ways])
        # Equally likely ones keep their order.
        order = np.argsort((np.max(scores) - scores) // ALIKE, kind="stable")
        return [(scores[k], ways[k]) for k in order.tolist()]


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


def sign_correction(columns: ColumnSearch, evidence: Evidence) -> Iterator[Correction]:
    """Yield the correction of signs that each gain alone, if there are any.

    A log that fits may have one at joints that make little torque.
    """
    tried = [*turned_signs(columns.arm.robot, columns.moving)]
    found = columns.one_by_one(tried, evidence)
    yield from correction_of(columns.fitted, found, len(found))


def zero_correction(columns: ColumnSearch, evidence: Evidence) -> Iterator[Correction]:
    """Yield the correction of one joint's zero, by any angle, if it gains clearly.

    A small error of a zero is a row of the faults of torque.
    """
    evidence.advance()
    yield from correction_of(columns.fitted, columns.best_zero(), 1)


def unit_correction(columns: ColumnSearch) -> Iterator[Correction]:
    """Yield the correction of positions in another unit, or of time, if it gains clearly."""
    yield from correction_of(columns.fitted, columns.other_units, 1)


def column_correction(
    columns: ColumnSearch, evidence: Evidence
) -> Iterator[Correction]:
    """Yield the correction of the mistakes that fit best together, if there are any.

    They are the first ones with which the whole log fits.
    """
    tried = [*mistakes(columns.arm.robot, columns.moving)]
    yield from correction_of(columns.fitted, columns.best_together(tried, evidence), 1)


def correction_of(
    fitted: Fit, found: Sequence[Mistake], fewest: int
) -> Iterator[Correction]:
    """Yield the correction of the first ones of some mistakes, if there are any.

    They are as few as the whole log fits with, the ``fewest`` at least; all where none are enough.
    """
    robot = fitted.arm.robot
    after = fitted
    findings: list[Finding] = []
    for number in range(max(fewest, 1), len(found) + 1):
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
            # A smaller one is an encoder's offset, as a row of the faults of torque has it.
            is_turned = np.radians(size) >= ZERO_STEP
            level = Level.REFUSES if is_turned else Level.DOUBTS
            correction = reading.columns
            yield Finding(level, FaultName.ZERO, text, remedy, correction=correction)


def time_correction(fitted: Fit, reading: Reading) -> tuple[Fit, list[Finding]]:
    """Return the fit with time by another rate, and the finding, if it is.

    From one factor on, time is multiplied by what the torque of inertia says, which grows with its
    square; the ratio of two usual rates is taken in place of a number that is next to it.
    """
    after = refit(fitted, reading)
    _, shares, is_loaded = model_torque(after)
    weight = np.median(shares[is_loaded]) if np.any(is_loaded) else 1.0
    # Whatever the time, weight is what it is: where it is missing, inertia looks too large.
    if not KEPT_WEIGHT < weight < 1.0 / KEPT_WEIGHT:
        return after, []
    for _ in range(TIME_ROUNDS):
        offer = Offers(after).weigh(Effect((INERTIAL,), np.array([[INERTIA_OFF]])))
        inertia = max(1.0 + float(offer.values[0]), LEAST_INERTIA)
        reading = replace(reading, time=reading.time / np.sqrt(inertia))
        if abs(np.log(inertia)) < SAME_INERTIA:
            break
        after = refit(fitted, reading)
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
    # Beyond these, torque lacks inertia; near one, it is a small change, or a balancer.
    exists = RATIOS[0] <= factor <= RATIOS[-1] and abs(np.log(factor)) > OTHER_RATE
    return refit(fitted, reading), [finding] if exists else []


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
