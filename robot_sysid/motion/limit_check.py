"""Check whether a trajectory keeps all limits, at all times, however it was made.

Positions, velocities, accelerations and torques are compared with their limits at 1 kHz or more.
Clearance is checked between samples as well: two bodies approach each other no faster than
sum_j |qd_j| rate_j, so a configuration with slack s shows that the motion is free until that sum,
integrated over time, has used up s; only there is the next collision test needed (conservative
advancement, Mirtich, "Impulse-based dynamic simulation of rigid body systems", 1996, ch. 2).

Of a motion that repeats itself, one period and both ends are checked.

The check is for one serial chain.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.motion.clearance import Clearance, Closest
from robot_sysid.motion.problem import OBSTACLE_LENGTH, ROUNDING, ExcitationProblem
from robot_sysid.records import Array, Motion, MotionPlan
from robot_sysid.trajectory import SineTrajectory, sample_times

LEAST_RATE_HZ = 1000.0
"""Lowest rate at which a motion is checked [Hz]."""
FEW_RATE_HZ = 100.0
"""Rate of a first coarse check [Hz]: most motions that break a limit break it at these samples."""
CLEARANCE_RESOLUTION = 1e-3
"""Largest error of the reported slack of the tightest pair [m]."""
TOUCH = 1e-6
"""By how much a clearance may be missed [m]: MuJoCo's tolerance for distances of convex shapes. The
approach is a sum with rounding errors, so a motion that just keeps a clearance may miss it by
1e-9 m."""
SMALLEST = 2.0**-9
"""Smallest factor by which ``scale_to_limits`` scales a motion for torque and clearance."""
BISECTIONS = 4
"""Number of bisections, after halving, that refine the factor of ``scale_to_limits``."""
RESERVE = 1e-4
"""Share of speed and acceleration limits that is left for peaks between samples: of a 0.6 Hz motion
at 1 kHz 1 - cos(pi 0.6 / 1000) = 2e-6 is missed; a window bends ten times more."""
FINEST_RATE_HZ = 4000.0
"""Highest rate of collision tests, where bodies are near each other [Hz]: a body at 2 m/s moves
0.5 mm between two tests."""
MOST_TOGETHER = 64
"""Largest number of samples in one collision test; tested together, each takes a quarter of the
time."""
WORTH_SKIPPING = 4
"""Number of samples that have to be skipped after a test for the next test to be of one sample; the
number of samples per test doubles otherwise."""
WHOLE = 1e-9
"""How near the number of samples in a period must be to a whole number for all periods to have
equal samples."""
SHORTEST_PERIOD = 1.0
"""Shortest period of a motion that repeats of which one period is checked for all [s]."""


@dataclass(frozen=True)
class Excess:
    """One limit that is not kept.

    Attributes:
        limit: its name for messages.
        share: the largest value over the limit, above 1; for a clearance 1 + missing distance over
            ``OBSTACLE_LENGTH``.
        time: when it is exceeded most [s].
    """

    limit: str
    share: float
    time: float

    def __str__(self) -> str:
        over = 100.0 * (self.share - 1.0)
        # Never "0.0 %": a limit that is exceeded by next to nothing is not kept either.
        digits = ".1f" if over >= 0.1 else ".1g"
        return f"{self.limit} ({over:{digits}} % over at {self.time:.2f} s)"


@dataclass(frozen=True)
class Peaks:
    """Largest values along a trajectory of the quantities that have limits, except clearances.

    Attributes:
        largest: (4 n + 1,) largest absolute value of each of ``ExcitationProblem.signals``.
        time: (4 n + 1,) when it is reached [s].
        lowest: (n,) lowest position of each joint [rad or m].
        highest: (n,) highest position of each joint [rad or m].
    """

    largest: Array
    time: Array
    lowest: Array
    highest: Array

    @property
    def joints(self) -> Array:
        """Largest distance from the middle of the position limits, speed, acceleration and torque,
        one row each, of each joint (4, n).
        """
        return self.largest[:-1].reshape(4, -1)


@dataclass(frozen=True)
class LimitCheck(Peaks):
    """Peaks of a trajectory against all its limits.

    Attributes:
        closest: the pair with the least slack: distance minus required distance.
        excesses: limits that are not kept, the worst first; () for a trajectory that may be run.
    """

    closest: Closest
    excesses: tuple[Excess, ...]

    @property
    def holds(self) -> bool:
        """Whether every limit is kept."""
        return not self.excesses

    @property
    def failure(self) -> str | None:
        """Why the trajectory must not be run, or None."""
        if self.holds:
            return None
        count = len(self.excesses)
        limits = "" if count == 1 else f"{count} limits, first "
        return (
            f"this trajectory must not be run: it breaks {limits}the {self.excesses[0]}"
        )


def check_limits(
    problem: ExcitationProblem, plan: MotionPlan, sample_rate: float = 0.0
) -> LimitCheck:
    """Return the check of an entire trajectory against all limits.

    Args:
        problem: the arm and its limits.
        plan: the trajectory.
        sample_rate: at which it will be run [Hz]; it is checked at this rate, at least at 1 kHz.
    """
    peaks = _peaks(problem, plan, max(LEAST_RATE_HZ, sample_rate), tool=True)
    closest = _tightest(problem.obstacles, plan, CLEARANCE_RESOLUTION)
    excesses = list(_excesses(problem, peaks))
    if closest.slack < -TOUCH:
        share = 1.0 - closest.slack / OBSTACLE_LENGTH
        excesses.append(Excess(f"clearance of {closest.label}", share, closest.time))
    worst = tuple(sorted(excesses, key=lambda excess: -excess.share))
    return LimitCheck(**vars(peaks), closest=closest, excesses=worst)


def scale_to_limits(
    problem: ExcitationProblem, plan: SineTrajectory, sample_rate: float
) -> tuple[SineTrajectory, Array]:
    """Return a motion with amplitudes scaled down to keep all limits, and each joint's factor (n,).

    Speed and acceleration are proportional to a joint's own motion, so they get a factor per
    joint; for torque and clearance all joints get a common factor, found by halving and then
    bisection. Where even the smallest motion breaks a limit, the smallest motion is returned.

    Args:
        problem: the arm and its limits.
        plan: the motion.
        sample_rate: at which it will be run [Hz]; it is checked at this rate, at least at 1 kHz.
    """
    rate = max(LEAST_RATE_HZ, sample_rate)
    shares = _peaks(problem, plan, rate).joints / problem.limits.largest
    # Rows 1 and 2 are speed and acceleration. A joint at rest has a share of zero, so the maximum
    # keeps the division defined.
    speed_share = np.max(shares[1:3], axis=0)
    factors = np.minimum(1.0, (1.0 - RESERVE) / np.maximum(speed_share, RESERVE))

    def fits(factor: float) -> bool:
        """Return whether the motion with amplitudes times ``factor`` and ``factors`` keeps all
        limits.
        """
        scaled = plan.scale_amplitudes(factor * factors)
        return keeps_limits(problem, scaled, rate)

    high = 1.0
    low = 1.0
    while low > SMALLEST and not fits(low):
        high = low
        low = 0.5 * low
    for _ in range(BISECTIONS if low < high else 0):
        middle = np.sqrt(low * high)
        if fits(middle):
            low = middle
        else:
            high = middle
    return plan.scale_amplitudes(low * factors), low * factors


def keeps_limits(
    problem: ExcitationProblem, plan: MotionPlan, sample_rate: float = LEAST_RATE_HZ
) -> bool:
    """Return whether a motion keeps every limit, sampled at ``sample_rate`` [Hz]; clearances are
    checked between the samples too.
    """
    # Most motions that break a limit break it at the samples of the lower rate too.
    for rate in (FEW_RATE_HZ, sample_rate):
        if any(_excesses(problem, _peaks(problem, plan, rate))):
            return False
    return first_contact(problem, plan) is None


def first_contact(problem: ExcitationProblem, plan: MotionPlan) -> Closest | None:
    """Return the bodies between which a clearance is first not kept along a motion, and when; None
    where all are kept.
    """
    closest = _tightest(problem.obstacles, plan, np.inf, stop_below=0.0)
    return closest if closest.slack < 0.0 else None


def _spans(plan: MotionPlan, rate: float = 0.0) -> tuple[tuple[float, float], ...]:
    """Return the spans of time (start, end) [s] that have to be checked: for a motion that repeats,
    the first period with the rise before it, and the fall at the end; else the entire motion.

    Args:
        plan: the motion.
        rate: of the samples [Hz]; 0 where the check does not depend on samples.
    """
    # Only a Fourier series has a cycle.
    period, ends = getattr(plan, "cycle", (np.inf, 0.0))
    is_repeated = SHORTEST_PERIOD <= period < plan.duration - 2.0 * ends
    # Where a period holds no whole number of samples, the samples of two periods differ.
    if not is_repeated or abs(period * rate - round(period * rate)) > WHOLE:
        return ((0.0, plan.duration),)
    return (0.0, period + ends), (plan.duration - ends, plan.duration)


def _motions(
    plan: MotionPlan, rate: float, spans: tuple[tuple[float, float], ...]
) -> Iterator[Motion]:
    """Yield the motion in chunks, sampled at a rate [Hz] over spans (start, end) of time [s]."""
    for span in spans:
        for time in sample_times(plan.duration, rate, *span):
            yield plan.evaluate(time)


def _peaks(
    problem: ExcitationProblem, plan: MotionPlan, rate: float, tool: bool = False
) -> Peaks:
    """Return the largest values of limited quantities along a motion sampled at a rate [Hz].

    Of a motion that repeats itself, one period and both ends are evaluated (``_spans``). The tool's
    speed is computed where it has a limit or ``tool`` is true; it is zero otherwise.
    """
    columns = np.arange(4 * problem.n_joints + 1)
    largest, time = np.zeros((2, len(columns)))
    lowest = np.full(problem.n_joints, np.inf)
    highest = -lowest
    for motion in _motions(plan, rate, _spans(plan, rate)):
        magnitudes = np.abs(problem.signals(motion, torque=True, tool=tool))
        peak_samples = np.argmax(magnitudes, axis=0)
        peaks = magnitudes[peak_samples, columns]
        time = np.where(peaks > largest, motion.time[peak_samples], time)
        largest = np.maximum(largest, peaks)
        lowest = np.minimum(lowest, np.min(motion.q, axis=0))
        highest = np.maximum(highest, np.max(motion.q, axis=0))
    return Peaks(largest, time, lowest, highest)


def _excesses(problem: ExcitationProblem, peaks: Peaks) -> Iterator[Excess]:
    """Yield the limits of position, speed, acceleration, torque and tool speed that the peaks of a
    motion exceed.
    """
    share = peaks.largest / problem.limits.columns
    # Written with "not", so that NaN counts as an excess.
    for k in np.flatnonzero(~(share <= 1.0 + ROUNDING)):
        yield Excess(problem.signal_names[k], float(share[k]), float(peaks.time[k]))


def _tightest(
    obstacles: Clearance,
    plan: MotionPlan,
    resolution: float,
    stop_below: float = -np.inf,
) -> Closest:
    """Return the pair with the least slack along a motion, and the time of that configuration.

    A slack below -TOUCH anywhere along the motion is found, and no slack is smaller than the one
    returned by more than the resolution.

    Args:
        obstacles: distances of the arm.
        plan: the motion.
        resolution: largest error of the least slack [m]; infinite where only contacts matter.
        stop_below: the search ends at the first slack below this [m].
    """
    spans = _spans(plan)
    start = plan.evaluate(np.zeros(1))
    tightest = _Tightest(start.q[0])
    if resolution < np.inf:
        # A tight configuration from coarse samples lets the search skip all that is less tight.
        for motion in _motions(plan, FEW_RATE_HZ, spans):
            tightest.update(motion, first=0, slacks=obstacles.slack(motion.q).value)
    limits = _NOTHING_TESTED
    tested_until = 0.0
    for motion in _motions(plan, FINEST_RATE_HZ, spans):
        approach = _Approach(np.abs(motion.qd), obstacles.rates)
        if motion.time[0] > tested_until + 2.0 / FINEST_RATE_HZ:  # another span
            limits = _NOTHING_TESTED
        sample = approach.first_beyond(limits)
        batch = 1
        while sample < len(motion.time) and tightest.slack >= stop_below:
            # Up to ``batch`` samples are tested; how far pairs may move on follows from the last.
            last = min(sample + batch, len(motion.time)) - 1
            slacks = obstacles.slack(motion.q[sample:last]).value
            last_slack, row_slacks = obstacles.slack_at(motion.q[last])
            tightest.update(motion, sample, np.append(slacks, last_slack))
            # Slack above the floor may be used up untested: no contact and no lower minimum is
            # missed by it.
            floor = tightest.slack - resolution
            if tightest.slack >= -TOUCH:
                floor = max(-TOUCH, floor)
            limits = approach.limits(last, row_slacks - floor)
            sample = max(last + 1, approach.first_beyond(limits))
            is_near = sample - last <= WORTH_SKIPPING
            batch = min(2 * batch, MOST_TOGETHER) if is_near else 1
        limits = approach.remaining(limits)
        tested_until = motion.time[-1]
    return replace(obstacles.closest(tightest.q), time=tightest.time)


class _Tightest:
    """The configuration with the least slack of all that were tested.

    Attributes:
        q: (n,) joint positions.
        slack: the slack there [m]; infinite before the first test.
        time: when the motion is there [s].
    """

    def __init__(self, q: Array) -> None:
        self.q = q
        self.slack = np.inf
        self.time = 0.0

    def update(self, motion: Motion, first: int, slacks: Array) -> None:
        """Take the sample with the least of ``slacks`` (K,), if that is less than ``self.slack``.

        The slacks [m] are those of K samples of the motion, the first one with index ``first``.
        """
        least = int(np.argmin(slacks))
        if slacks[least] < self.slack:
            self.slack = float(slacks[least])
            self.time = float(motion.time[first + least])
            self.q = motion.q[first + least]


_NOTHING_TESTED = {-1: -np.inf}
"""Limits as ``_Approach.limits`` returns them, before the first test: row -1, the last one, bounds
all pairs, and its path is beyond minus infinity at the first sample."""


class _Approach:
    """Bounds on how far pairs of bodies approach each other along N samples of a motion.

    The path of a row of ``rates`` is how far its pairs may have approached since the sample before
    the first [m]. Paths are computed when they are needed and cached.

    Args:
        speed: (N, n) absolute joint speeds at ``FINEST_RATE_HZ``.
        rates: (P, n) approach bounds, see ``Clearance.rates``.
    """

    def __init__(self, speed: Array, rates: Array) -> None:
        self._speed = speed
        self._rates = rates
        self._paths: dict[int, Array] = {}

    def limits(self, sample: int, slacks: Array) -> dict[int, float]:
        """Return, for each row with a finite slack, how long its path may get before it has used up
        the slack it has at a sample: the path at this sample plus the slack [m].

        Args:
            sample: index of the sample.
            slacks: (P,) of the rows [m]; infinite where no pair is near.
        """
        limits = {}
        for row in np.flatnonzero(np.isfinite(slacks)).tolist():
            slack = max(0.0, float(slacks[row]))
            limits[row] = float(self._path(row)[sample]) + slack
        return limits

    def first_beyond(self, limits: Mapping[int, float]) -> int:
        """Return the index of the first sample at which the path of a row reaches its limit [m]; N
        if no path does.
        """
        first = len(self._speed)
        for row, limit in limits.items():
            reached = np.searchsorted(self._path(row), limit)
            first = min(first, int(reached))
        return first

    def remaining(self, limits: Mapping[int, float]) -> dict[int, float]:
        """Return the limits [m] for an ``_Approach`` of the samples that follow, whose paths begin
        at zero: the limit of each row less its path along all N samples.
        """
        remaining = {}
        for row, limit in limits.items():
            remaining[row] = limit - float(self._path(row)[-1])
        return remaining

    def _path(self, row: int) -> Array:
        """Return the path (N,) of a row of ``rates`` [m]."""
        if row not in self._paths:
            speed = self._speed @ self._rates[row]
            previous = np.concatenate((speed[:1], speed[:-1]))
            self._paths[row] = np.cumsum(np.maximum(speed, previous)) / FINEST_RATE_HZ
        return self._paths[row]
