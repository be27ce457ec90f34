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
from functools import cache, cached_property
from itertools import chain, combinations, compress
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
from robot_sysid.faults.plausibility import (
    drives,
    fits,
    is_foreign,
    is_plausible,
    model_torque,
    structural,
)
from robot_sysid.faults.reading_scores import ReadingScores, likelihood, of_rows_alone
from robot_sysid.faults.readings import (
    ANY_ANGLES,
    GEARS,
    ZERO_STEP,
    Mistake,
    Reading,
    angle_units,
    exchanges,
    gear_in,
    gear_of,
    gear_ratios,
    is_torque_sign,
    mistakes,
    mountings,
    shared_motors,
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
CLEARLY_LESS = 0.7
"""What a correction leaves unexplained, over what is without it, below which it leaves less."""
HALF = 0.5
"""The same below which a reading explains what was left: exchanged wrists of a right log leave
more."""
MORE = 2.0
"""Torque that is left at a joint, over what real friction leaves, from which on its columns may be
those of another joint."""
OWN_GAIN = 5.0
"""Least gain in the rows of the joints that a reading blames, beyond what friction leaves [nats]:
false readings of logs of real arms gain less there."""
EXPLAINED = 2.5
"""What is left of a blamed joint as it came, over what is left as it is read otherwise, from which
on that was explained, however little it is: false readings reach 1.07, true ones 4.8 to 75."""
LEAST_NOISE = 1e-3
"""Least noise by which two fits are compared, as a share of all torque."""
TURNED = 5.0
"""Angle beside right ones from which on a zero is a mistake of positions; less is a fault of the
torque [degrees]."""
MOUNTING_TILT = 15.0
"""Tilt that is allowed about one of the 26 directions: they are at most some 27 degrees from the
true one, usually half as much [degrees]."""
OF_WRIST = 4
"""Last joints of which two may be exchanged, or turned by motors of both, in a log that fits."""
GEAR_STEP = np.log(GEARS[-1] / GEARS[-2])
"""Step between the factors of a gear that are tried first, as a logarithm."""
GEAR_ROUNDS = 8
"""Rounds in which a gear's factor is found: some to come near it, the others to a percent."""
GEAR_ERROR = 0.03
"""Share by which links that are off make a factor wrong that is found with the model's, at most."""
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
"""Relative distance within which a factor of time is such a ratio: links whose inertia is off as
usual make as much of it."""
INERTIA_OFF = 0.5
"""Share by which inertia may be off between two factors of time that are tried, about."""
KEPT_WEIGHT = 0.7
"""Share of the model's weight, as a median of the joints, below which a balancer carries a part of
it, which is as much inertia too much: a wrong time leaves weight as it is, and so many links are
not so much lighter than in the model."""
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
    """Another reading of a log.

    Attributes:
        findings: what is wrong.
        gain: of putting it right, in log likelihood [nats].
        fit: then.
        explains: whether what was left of a joint that is blamed is explained, or half of all, or
            no more is left of any of them than real friction leaves. Otherwise something else is
            wrong there.
    """

    findings: tuple[Finding, ...]
    gain: float
    fit: Fit
    explains: bool = True


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


class ReadingSearch:
    """Compares readings of a log on a part of its rows, for all searches in it.

    Args:
        fitted: the fit of the log.

    Attributes:
        moving: numbers of the joints that move in it.
        travels: (n,) of all joints, as they were recorded [rad].
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
        every = [each.q for each in fitted.recordings]
        self.travels = np.ptp(np.concatenate(every), axis=0)
        recordings, _ = part_of_rows(fitted, ROWS)
        self._scores = ReadingScores(self.arm, [*map(of_rows_alone, recordings)], terms)

    def score(self, found: Sequence[Mistake], share: float = LEAST_RESIDUAL) -> float:
        """Return the log likelihood of the log without mistakes, but for a constant.

        Residuals below a ``share`` of all torque do not count.
        """
        return self.scores([found], share)[0]

    def scores(
        self, ways: Sequence[Sequence[Mistake]], share: float = LEAST_RESIDUAL
    ) -> list[float]:
        """Return ``score`` of each of some ways to read the log."""
        n = self.arm.robot.n_joints
        return self._scores.scores([Reading.of(n, way) for way in ways], share)

    def one_by_one(self, tried: Sequence[Mistake], evidence: Evidence) -> list[Mistake]:
        """Return mistakes that each gain alone, of joints that make little torque as well."""
        found: list[Mistake] = []
        score = self.score(found, FINE_RESIDUAL)
        first, _ = self._longer(found, tried, FINE_RESIDUAL)[0]
        # Several signs that are wrong leave a log that does not fit. They are taken at once where
        # they gain more than another mistake does.
        after, signs = (-np.inf, []) if fits(self.fitted) else self._signs(tried)
        if after > max(first, score) + CLEAR * (len(signs) - 1):
            score, found = after, signs
        while len(found) < MOST_TOGETHER:
            evidence.advance()
            after, longer = self._longer(found, tried, FINE_RESIDUAL)[0]
            if after < score + CLEAR:
                break
            score, found = after, longer
        return found

    @property
    def mistakes(self) -> list[Mistake]:
        """Every mistake that is tried."""
        return [*mistakes(self.arm.robot, self.moving, self.travels)]

    @property
    def mountings(self) -> list[Mistake]:
        """Other directions of gravity."""
        return [*mountings(self.arm.robot)]

    def best_zero(self) -> list[Mistake]:
        """Return the zero of one joint, to a degree, with which the log reads best; [] for none.

        One that is off by right angles may also be another mounting of the base, with which
        ``best_together`` compares it; one that is off by little is a fault of the torque.
        """
        n = self.arm.robot.n_joints

        tried = [*zeros(self.arm.robot, self.shown, ANY_ANGLES)]
        if not tried:
            return []
        most, best = self._best(tried)
        joint = int(np.argmax(np.abs(best.reading.zeros)))
        step = ZERO_STEP
        for _ in range(ZERO_ROUNDS):
            step *= 0.5
            angle = best.reading.zeros[joint]
            ways = [zero_of(n, joint, angle + side) for side in (-step, step)]
            most, best = self._best([best, *ways])
        is_clear = most > self.score([], FINE_RESIDUAL) + CLEAR
        angle = best.reading.zeros[joint]
        beside = abs(angle - RIGHT_ANGLE * round(angle / RIGHT_ANGLE))
        return [best] if is_clear and beside > np.radians(TURNED) else []

    @cached_property
    def other_units(self) -> list[Mistake]:
        """The other unit, gear or rate of time with which the log reads best; [] for none.

        Where most joints carry little, the few that do show it in some thousandths of all torque.
        No rate is tried for torques in another unit: a factor on them is none on their inertia.
        """
        robot = self.arm.robot
        tried = [*angle_units(robot, self.moving, self.travels)]
        tried += gear_ratios(robot, self.moving, self.shown)
        if not is_foreign(self.fitted):
            tried += time_bases(robot)
        found = self._clear_best(tried)
        gear = gear_in(found[0].reading) if found else None
        if gear is not None:
            joint, factor, is_of_motor = gear
            step = GEAR_STEP
            for _ in range(GEAR_ROUNDS):
                ways = [float(factor * np.exp(way)) for way in (0.0, step, -step)]
                gears = [gear_of(robot, joint, way, is_of_motor) for way in ways]
                _, best = self._best(gears)
                step *= 0.5 if best is gears[0] else 1.0
                factor = next(way for way, each in zip(ways, gears) if each is best)
                found = [best]
        return found

    @cached_property
    def motors(self) -> list[Mistake]:
        """The motors of two joints of a wrist with which the log reads best; [] for none."""
        return self._clear_best(
            [*shared_motors(self.arm.robot, self.moving[-OF_WRIST:])]
        )

    @cached_property
    def unit_corrections(self) -> list[Correction]:
        """The corrections of units, gears or time, and of motors of two joints, if they gain."""
        of_units = correction_of(self.fitted, self.other_units, 1)
        return [*of_units, *correction_of(self.fitted, self.motors, 1)]

    def _best(self, tried: Sequence[Mistake]) -> tuple[float, Mistake]:
        """Return the mistake that alone fits best, the first of equal ones, after its score."""
        scores = self.scores([[each] for each in tried], FINE_RESIDUAL)
        return max(zip(scores, tried), key=lambda way: way[0])

    def _clear_best(self, tried: Sequence[Mistake]) -> list[Mistake]:
        """Return the mistake that alone fits best, if it gains clearly; [] for none."""
        if not tried:
            return []
        most, best = self._best(tried)
        return [best] if most > self.score([], FINE_RESIDUAL) + CLEAR else []

    def _signs(self, tried: Sequence[Mistake]) -> tuple[float, list[Mistake]]:
        """Return the likeliest turned signs of torques, two at least, with their likelihood."""
        turned = [each for each in tried if is_torque_sign(each)]
        if len(turned) > MOST_SIGNS:
            return -np.inf, []
        counts = range(2, len(turned) + 1)
        ways = chain.from_iterable(combinations(turned, count) for count in counts)
        together = [[*way] for way in ways]
        scored = zip(self.scores(together, FINE_RESIDUAL), together)
        return max(scored, key=lambda way: way[0], default=(-np.inf, []))

    def best_together(
        self, tried: Sequence[Mistake], evidence: Evidence
    ) -> list[Mistake]:
        """Return the mistakes that fit best together, one after the other; [] for none."""
        before = self.score([])
        pairs = [*self._pairs(tried)]
        singles_of = {id(pair): singles for pair, singles in pairs}
        firsts = self._longer([], [*tried, *(pair for pair, _ in pairs)])
        likely = [way[0] for _, way in firsts if id(way[0]) not in singles_of][:LIKELY]
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
        best = next((found for score, found in ways if score > likeliest - ALIKE), [])
        # The whole log may be right with the likelier one alone.
        return [*chain(*(singles_of.get(id(each), [each]) for each in best))]

    def _pairs(
        self, tried: Sequence[Mistake]
    ) -> Iterator[tuple[Mistake, list[Mistake]]]:
        """Yield pairs of zeros, each with the two, the likelier first.

        Beside another wrong one, one alone may fit worse than none.
        """
        turned = [each for each in tried if np.any(each.reading.zeros[self.shown])]
        firsts = self._longer([], turned) if turned else []
        for both in combinations([way[0] for _, way in firsts], 2):
            reading = Reading.of(self.arm.robot.n_joints, both)
            # Two of one joint are a third one, or none.
            if np.count_nonzero(reading.zeros) == 2:
                yield Mistake(FaultName.ZERO, "", reading), [*both]

    @cached_property
    def shown(self) -> list[int]:
        """Numbers of the joints of which the log would show a zero.

        That about an upright axis is another heading of the base, and that of the last joint turns
        the last link, which is free. A slide has none that is turned.
        """
        robot = self.arm.robot
        joints = [joint for joint in self.moving if not robot.is_slide[joint]]
        ways = [[zero_of(robot.n_joints, joint, RIGHT_ANGLE)] for joint in joints]
        change = np.subtract(
            self.scores(ways, FINE_RESIDUAL), self.score([], FINE_RESIDUAL)
        )
        return [*compress(joints, np.abs(change) > ALIKE)]

    def _longer(
        self,
        found: list[Mistake],
        tried: Sequence[Mistake],
        share: float = LEAST_RESIDUAL,
    ) -> list[tuple[float, list[Mistake]]]:
        """Return (log likelihood, mistakes) with one more each, the likeliest first."""
        ways = [[*found, each] for each in tried]
        scores = np.array(self.scores(ways, share))
        # Equally likely ones keep their order.
        order = np.argsort((np.max(scores) - scores) // ALIKE, kind="stable")
        return [(scores[k], ways[k]) for k in order.tolist()]


def gain_between(before: Fit, after: Fit, reading: Reading) -> float:
    """Return by how much the second of two fits of one log, read otherwise, is likelier [nats].

    Both have the noise of their own residuals and the memory of the second's.
    """
    counts = np.minimum(
        np.sum(before.sums.counts, axis=0), np.sum(after.sums.counts, axis=0)
    )
    independent = counts / np.minimum(before.correlation, after.correlation)
    least = LEAST_NOISE * np.sqrt(np.mean(before.sums.rms_torque**2))
    noise = np.maximum(before.noise, least)
    earlier = likelihood(before.equations, before.free, independent, noise)
    noise = np.maximum(noise_as_recorded(after, reading), least)
    return likelihood(after.equations, after.free, independent, noise) - earlier


def noise_as_recorded(after: Fit, reading: Reading) -> Array:
    """Return the noise (J,) of a log that is read otherwise, in the size of its own torques."""
    return after.noise / reading.factors[after.arm.indices]


def refit(fitted: Fit, reading: Reading, **priors: float) -> Fit:
    """Return the fit of a log that is read otherwise, some priors of its question changed."""
    robot = fitted.arm.robot
    if reading.gravity is not None:
        robot = with_gravity(robot, reading.gravity)
    recordings = [reading.apply(recording) for recording in fitted.recordings]
    question = with_priors(fitted.question, **priors)
    return solve_question(robot, recordings, question, beside=fault_columns)


def is_own(before: Fit, after: Fit, reading: Reading) -> bool:
    """Return whether another reading of a log explains what the joints that it blames make of it.

    Friction of one joint, which no term has, is followed by any column, in every block of a log
    alike. So the rows of the joints that are blamed have to gain beyond what real friction leaves,
    or what was left of one of them has to be explained, or several other joints have to gain. What
    blames no joint, a mounting or a time, is of all. Nor is it asked where links that cannot be
    take up what is wrong, or friction that drives.

    Args:
        before: the fit of the log as it was recorded.
        after: the same of the log that is read otherwise.
        reading: how.
    """
    own = reading.blamed[before.arm.indices]
    if not np.any(own) or not is_plausible(before) or drives(before):
        return True
    counts = np.minimum(
        np.sum(before.sums.counts, axis=0), np.sum(after.sums.counts, axis=0)
    )
    independent = counts / np.minimum(before.correlation, after.correlation)
    noise = noise_as_recorded(after, reading)
    if explained(before, after, reading) > EXPLAINED:
        return True
    least = structural(before)
    ratio = np.maximum(before.noise, least) / np.maximum(noise, least)
    if float(np.sum((independent * np.log(ratio))[own])) > OWN_GAIN:
        return True
    gains = independent * np.log(before.noise / noise)
    return float(np.sum(gains) - np.max(gains[~own], initial=0.0)) > CLEAR


def explained(before: Fit, after: Fit, reading: Reading) -> float:
    """Return what was left of a blamed joint, over what is left of it as a log is read otherwise.

    It is that of the joint of which most is explained; zero where none is blamed.
    """
    ratio = before.noise / noise_as_recorded(after, reading)
    own = reading.blamed[before.arm.indices]
    return float(np.max(ratio[own], initial=0.0))


def read_once(fitted: Fit, reading: Reading) -> Fit:
    """Return the fit of a log that is read otherwise, by one pass over its rows.

    A log that is solved whole finds its own noise, friction and links, and gains some more.
    """
    arm = fitted.arm.of(t for t in fitted.arm.terms.values() if t.cause)
    recordings = tuple(map(reading.apply, fitted.recordings))
    point = fitted.point
    if reading.gravity is not None:
        point = replace(point, gravity=reading.gravity)
    sums = arm.sums(recordings, point, in_blocks=False)
    problem = replace(fitted, arm=arm, point=point, sums=sums, recordings=recordings)
    terms = fitted.equations.terms
    return problem.fit(terms, None, fitted.noise, fitted.correlation, possible=False)


def sign_correction(search: ReadingSearch, evidence: Evidence) -> Iterator[Correction]:
    """Yield the correction of signs that each gain alone, if there are any.

    A log that fits may have one at joints that make little torque.
    """
    tried = [*turned_signs(search.arm.robot, search.moving)]
    found = search.one_by_one(tried, evidence)
    yield from correction_of(search.fitted, found, len(found))


def zero_correction(search: ReadingSearch, evidence: Evidence) -> Iterator[Correction]:
    """Yield the correction of one joint's zero, by any angle, if it gains clearly.

    A small error of a zero is a row of the faults of torque.
    """
    evidence.advance()
    yield from correction_of(search.fitted, search.best_zero(), 1)


def exchange_correction(
    search: ReadingSearch, evidence: Evidence
) -> Iterator[Correction]:
    """Yield the correction of exchanged joints in a log that fits, if there are any.

    One of them leaves more than friction does, though it is little of all torque. Wrists of real
    arms do, too: other columns have to explain what is left.
    """
    fitted = search.fitted
    left = np.zeros(fitted.arm.robot.n_joints, dtype=bool)
    left[fitted.arm.indices] = fitted.unexplained > MORE * structural(fitted)
    exchanged = exchanges(fitted.arm.robot, search.moving[-OF_WRIST:])
    tried = [each for each in exchanged if np.any(each.reading.blamed & left)]
    found = search.one_by_one(tried, evidence) if tried else []
    yield from correction_of(fitted, found, 1, HALF)


def column_correction(
    search: ReadingSearch, tried: Sequence[Mistake], evidence: Evidence
) -> Iterator[Correction]:
    """Yield the correction of those mistakes that fit best together, if there are any.

    They are the first ones with which the whole log fits.
    """
    yield from correction_of(search.fitted, search.best_together(tried, evidence), 1)


def correction_of(
    fitted: Fit, found: Sequence[Mistake], fewest: int, most_left: float = np.inf
) -> Iterator[Correction]:
    """Yield the correction of the first ones of some mistakes, where the log is right with them.

    They are as few as the whole log fits with, the ``fewest`` at least, and one more where that
    leaves less than half of what is unexplained; all where none are enough. A log is solved whole
    where one pass over its rows gains, in those of the joints that are blamed, and leaves no more
    than ``most_left`` of what is unexplained without it.
    """
    robot = fitted.arm.robot

    @cache
    def first(number: int) -> tuple[Reading, Fit]:
        """Return the reading without so many mistakes, and its fit by one pass."""
        reading = Reading.of(robot.n_joints, found[:number])
        return reading, read_once(fitted, reading)

    for number in range(max(fewest, 1), len(found) + 1):
        reading, once = first(number)
        gain = gain_between(fitted, once, reading)
        left = once.unexplained_share / max(fitted.unexplained_share, 1e-300)
        if gain < 0.0 or left > most_left or not is_own(fitted, once, reading):
            continue
        taken = [*found[:number]]
        if number == 1 and (gear := gear_in(reading)) is not None:
            taken = [best_gear(fitted, *gear)]
            reading = taken[0].reading
        findings = [*column_findings(robot, taken, reading)]
        if reading.gravity is not None:
            after, turned = mounting_correction(fitted, reading, reading.gravity)
            findings.append(turned)
        elif reading.time != 1.0:
            after, timed = time_correction(fitted, reading)
            findings += timed
        else:
            after = refit(fitted, reading)
        is_last = number == len(found)
        if findings and (is_last or fits(after)):
            half = HALF * once.unexplained_share
            if not is_last and first(number + 1)[1].unexplained_share < half:
                continue
            gain = gain_between(fitted, after, reading)
            own = reading.blamed[fitted.arm.indices]
            is_little = np.all((after.unexplained < MORE * structural(after))[own])
            is_half = after.unexplained_share < HALF * fitted.unexplained_share
            is_gone = is_half or explained(fitted, after, reading) > EXPLAINED
            yield Correction(tuple(findings), gain, after, bool(is_little or is_gone))
            return


def best_gear(fitted: Fit, joint: int, factor: float, is_of_motor: bool) -> Mistake:
    """Return a gear with the factor that is likeliest by all rows, and links as they are found.

    The likelihood of three factors is a parabola of their logarithm.
    """
    robot = fitted.arm.robot
    steps = np.array([-GEAR_ERROR, 0.0, GEAR_ERROR])
    gears = [
        gear_of(robot, joint, factor * np.exp(step), is_of_motor) for step in steps
    ]
    gains = [
        gain_between(fitted, read_once(fitted, each.reading), each.reading)
        for each in gears
    ]
    bend, slope, _ = np.polyfit(steps, gains, 2)
    step = np.clip(-0.5 * slope / bend, *steps[[0, -1]]) if bend < 0.0 else 0.0
    return gear_of(robot, joint, float(factor * np.exp(step)), is_of_motor)


def column_findings(
    robot: RobotModel, found: Sequence[Mistake], reading: Reading
) -> Iterator[Finding]:
    """Yield the findings on columns, which one reading puts right, and on zeros."""
    wrong = [each for each in found if each.text]
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
            columns = reading.columns
            yield Finding(
                Level.REFUSES, FaultName.ZERO, text, remedy, correction=columns
            )


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
) -> tuple[Fit, Finding]:
    """Return the fit of an arm whose base is mounted otherwise, and the finding.

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
    return after, finding
