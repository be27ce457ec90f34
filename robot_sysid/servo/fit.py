"""Servos, friction and rotor inertia fitted to an arm's commands and positions.

The numbers are those with which the arm, played joint by joint in windows of its logs
(``played_fit``), comes nearest to the measured positions. All that a servo does is in them
(``unknowns``), and so are errors of the links, which alone fix the scale. What is found of the
delay in one joint holds for all, because they share a bus; and gains of joints that carry no weight
are taken to be over the model's what the others' are, because servos of one arm are alike. A
torque that a log has beside its commands is one more measurement of a gain (``motor_torque``).

A model file holds less. Its numbers are those of the same windows with the rest left out and the
links as the file has them: friction at the load and speed of the logs, no zeros, no dead zones.

n is the number of joints, u that of unknowns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import robot_sysid.records.usual_errors as usual_errors
from robot_sysid.errors import InputError
from robot_sysid.records import Array, Recording, RobotModel
from robot_sysid.records.messages import Progress
from robot_sysid.servo.loop import LEAST_MOTION, longest_period
from robot_sysid.servo.motor_torque import TorqueGains, gains_by_torque
from robot_sysid.servo.play import Courses, KnownLinks, Tracks
from robot_sysid.servo.played_fit import PASSES, PlayedFit, Searched, Solved
from robot_sysid.servo.unknowns import (
    ABSENT,
    DEVIATIONS,
    IN_FILE,
    LEAST,
    LEAST_ERRORS,
    MOST,
    NAMES,
    UNKNOWNS,
    column,
    numbers_at,
)
from robot_sysid.signals.process import NORMAL_MEDIAN
from robot_sysid.simulation.playback import (
    MAX_WINDOWS,
    ServoParameters,
    chain_actuators,
    servos_in_model,
)
from robot_sysid.wording import option_name

SHORT = 1.0
"""Length of the windows in which a search begins [s]: short ones have few wrong minima."""
LONG = 6.0
"""Length of those in which it ends [s]: what a model does after seconds is what it is used for."""
DRAWS = 200
"""Sets of numbers that are drawn from what is known before."""
BEGINNINGS = 2
"""Number of places at which a search begins."""
FIRST_PASSES = 6
"""Largest number of steps of a first search, after which the places are chosen again."""
LARGEST_ERROR = 0.4
"""Relative standard error up to which a number is identified."""
FIRM = 0.99
"""Firmness of dry friction in the written model: as MuJoCo has it, 0.9, a joint that holds a load
creeps by about 0.01 rad/s, which no gear does."""
LEAST_SHARE = 1e-3
"""Share of the damping within a servo's limit that is none."""
SHOWN = 4.0
"""Rise of squares, over those of independent errors, from which a torque limit is reached."""
FASTEST_TURN = 1.2
"""Angle by which the oscillation of a servo without damping may turn between two samples [rad]."""
FIXED = 1e-6
"""Deviation of an unknown that stays where it is, over its own."""
COMMON = {"command_delay": 0.0, "loop_lag": 0.002}
"""Times that the joints of an arm share, a bus and one kind of servo, and how far off one joint is
[s]."""
LEAST_TIME_ERROR = 1.5e-3
"""Error of such a time by what servos do otherwise than by a delay and one lag [s]."""


@dataclass(frozen=True)
class ServoFit:
    """The numbers of an arm's servos and how sure they are.

    Attributes:
        x: (n, u) of all that a servo does (``unknowns``), in deviations from their means.
        link_errors: (n, J) that go with ``x``, in their directions.
        covariance: (n, u + J, u + J) of both together.
        links: as known before, and those directions.
        x_given_links: (n, u) what is most likely if the links are those of the file.
        given_links: (n, u, u) covariance of that.
        likely_gain: (n,) gains of which ``x`` has a factor [N m/rad].
        is_known: (n,) whether a joint moves enough to show its numbers.
        is_fast: (n,) whether a servo swings faster than the samples resolve: many sets of numbers
            then play alike, and its errors are as large as what is known before.
        in_file: numbers that a model file holds, refitted with the rest left out.
        held_x: (k, u) of the file's numbers, in deviations from the unknowns' means, of the k
            joints that move.
        mean, deviation: (k, u) of what is known of the unknowns before, but for what the other
            joints say.
        delay: time by which all commands act late [s].
        delay_error: its standard error [s].
        by_torque: gains by recorded torques; None where no log has any.
    """

    x: Array
    link_errors: Array
    covariance: Array
    links: KnownLinks
    x_given_links: Array
    given_links: Array
    likely_gain: Array
    is_known: NDArray[np.bool_]
    is_fast: NDArray[np.bool_]
    in_file: ServoParameters
    held_x: Array
    mean: Array
    deviation: Array
    delay: float
    delay_error: float
    by_torque: TorqueGains | None = None

    @property
    def over_gain(self) -> Array:
        """Numbers (n, u) of all joints: the gain [N m/rad], and the others as in ``unknowns``."""
        numbers = numbers_at(self.x)
        numbers[:, column("gain")] *= self.likely_gain
        return numbers


def likely_gains(robot: RobotModel) -> Array:
    """Return gains (n,) before the data: the model's, or those of usual servos [N m/rad]."""
    in_model = servos_in_model(robot).numbers[0]
    inertia = robot.mj_model.dof_M0[robot.dof_index] - robot.armature
    usual = np.median(inertia) * usual_errors.SERVO_BANDWIDTH**2
    return np.where(np.isfinite(in_model), in_model, usual)


def moving_joints(pieces: Sequence[Recording]) -> NDArray[np.int64]:
    """Return the numbers of the joints that move in pieces of logs; InputError for none."""
    used = [piece.q[~piece.is_left_out] for piece in pieces]
    ranges = np.max([np.ptp(q, axis=0) for q in used], axis=0)
    moving = np.flatnonzero(ranges >= LEAST_MOTION)
    if not len(moving):
        raise InputError(
            f"no joint moves by {LEAST_MOTION:g} rad (m of a slide) in what is fitted, which is "
            "four fifths of a log where there is no validation log; record a longer "
            f"motion, or give another log with {option_name('validation_measurements')}"
        )
    return moving


class ArmFit:
    """The search for all numbers of an arm, pass by pass.

    Args:
        robot: the arm as in the model file.
        pieces: of logs, which have commands.
        moving: (k,) numbers of the joints that are searched.
        progress: receives what is fitted and the error so far.
    """

    def __init__(
        self,
        robot: RobotModel,
        pieces: Sequence[Recording],
        moving: NDArray[np.int64],
        progress: Progress,
    ) -> None:
        self._progress = progress
        self.moving = moving
        self.likely_gain = likely_gains(robot)[self.moving]
        self.courses = Courses(robot, pieces)
        self._tracks: dict[float, Tracks] = {}
        shape = (len(self.moving), len(NAMES))
        self.mean = np.zeros(shape)
        self.deviation = np.ones(shape)
        k = column("limited_damping")
        in_model = chain_actuators(robot).damping_share[self.moving]
        self.mean[:, k] = in_model / DEVIATIONS[k]

    def problem(
        self, length: float, free: Sequence[str], with_links: bool, copies: int = 1
    ) -> PlayedFit:
        """Return the search of some unknowns in windows of a length, of copies of each joint."""
        if length not in self._tracks:
            tracks = self.courses.tracks(length, MAX_WINDOWS)
            is_moving = np.isin(tracks.joint, self.moving)
            self._tracks[length] = tracks.at(np.flatnonzero(is_moving))
        tracks = self._tracks[length]
        count = len(tracks)
        own = np.searchsorted(self.moving, tracks.joint)
        copy = np.repeat(np.arange(copies), count)
        return PlayedFit(
            tracks.at(np.tile(np.arange(count), copies)),
            np.tile(own, copies) + copy * len(self.moving),
            np.tile(self.likely_gain, copies),
            np.tile(self.mean, (copies, 1)),
            np.tile(self.deviation, (copies, 1)),
            np.isin(NAMES, free),
            with_links,
        )

    def search(self, label: str, free: Sequence[str], base: Array) -> Solved:
        """Return the best of the searches in short windows that begin at the best draws.

        Args:
            label: what is fitted, for the progress.
            free: names of the unknowns that are searched.
            base: (n, u) of the others, and one place to begin.
        """
        problem = self.problem(SHORT, free, False)
        report = self._report(label)
        places = problem.begin(self._draws(free, base), BEGINNINGS)
        rough = self._best_of(free, places, FIRST_PASSES, report)
        # Servos of one arm are alike, and have one delay: where one joint ended, another one may
        # begin.
        others = np.stack([np.tile(x, (len(base), 1)) for x in rough.at.x])
        again = self._draws(free, base)
        for name in COMMON:
            time, _ = common(name, rough.at.x, rough.covariance)
            again[:, :, column(name)] = time / DEVIATIONS[column(name)]
        candidates = np.concatenate((rough.at.x[None], others, again))
        places = problem.begin(candidates, BEGINNINGS)
        return self._best_of(free, places, PASSES, report)

    def _draws(self, free: Sequence[str], base: Array) -> Array:
        """Return sets of unknowns (v, n, u) as they are known before; the first is the base."""
        rng = np.random.default_rng(0)
        drawn = self.mean + self.deviation * rng.normal(size=(DRAWS, *base.shape))
        drawn = np.where(drawn > LEAST, drawn, 2.0 * LEAST - drawn)
        drawn = np.minimum(drawn, MOST)
        is_drawn = np.isin(NAMES, free) & (np.arange(DRAWS) > 0)[:, None, None]
        return np.where(is_drawn, drawn, base)

    def _best_of(
        self,
        free: Sequence[str],
        places: Sequence[Searched],
        passes: int,
        report: Callable[[int, int, Array], None],
    ) -> Solved:
        """Return the best of each joint's searches from several places, in short windows."""
        count = len(places)
        search = self.problem(SHORT, free, False, count).search
        solved = search(_joined(places), passes, report)
        n = len(self.moving)
        best = np.argmin(solved.cost.reshape(count, n), axis=0) * n + np.arange(n)
        return _picked(solved, best)

    def refine(
        self, label: str, free: Sequence[str], x: Array, with_links: bool
    ) -> Solved:
        """Return the search in long windows that begins at x (n, u)."""
        problem = self.problem(LONG, free, with_links)
        tracks = problem.tracks
        links = np.zeros((len(x), len(tracks.errors)))
        begin = Searched(x, links, np.zeros((2, len(tracks))))
        solved = problem.search(begin, report=self._report(label))
        # A limit that no motion reaches may be any larger one.
        k = column("torque_limit")
        larger = solved.at.x[:, k] + 1.0
        is_beyond = problem.rise(solved.at, "torque_limit", larger) < SHOWN
        solved.covariance[is_beyond, k] = 0.0
        solved.covariance[is_beyond, :, k] = 0.0
        solved.covariance[is_beyond, k, k] = 1.0
        return solved

    def know(self, name: str, mean: Array | float, deviation: Array | float) -> None:
        """State what is known of an unknown: mean in its deviations from its own, and deviation."""
        self.mean[:, column(name)] = mean
        self.deviation[:, column(name)] = deviation

    def know_time(self, name: str, time: float, error: float) -> None:
        """State a time that all joints share, and its standard error [s]."""
        scale = UNKNOWNS[name].deviation
        self.know(name, time / scale, max(error / scale, FIXED))

    def with_delay(self, x: Array) -> Array:
        """Return unknowns x (n, u) with the delay of all joints."""
        k = column("command_delay")
        x = x.copy()
        x[:, k] = self.mean[:, k]
        return x

    def _report(self, label: str) -> Callable[[int, int, Array], None]:
        """Return a function that shows passes and the error so far."""

        def report(done: int, total: int, error: Array) -> None:
            """Show how far a search is."""
            text = f"best position error {1e3 * np.sqrt(np.mean(error**2)):.2g} mrad"
            self._progress.advance(label, done, total, text)

        return report


def _joined(places: Sequence[Searched]) -> Searched:
    """Return places of copies of problems, one after the other."""
    return Searched(
        np.concatenate([place.x for place in places]),
        np.concatenate([place.links for place in places]),
        np.concatenate([place.start for place in places], axis=1),
    )


def _picked(solved: Solved, chosen: NDArray[np.int64]) -> Solved:
    """Return what was found of some problems, without the starts."""
    at = Searched(solved.at.x[chosen], solved.at.links[chosen], np.zeros((2, 0)))
    return Solved(
        at, solved.error[chosen], solved.cost[chosen], solved.covariance[chosen]
    )


def common(name: str, x: Array, covariance: Array) -> tuple[float, float]:
    """Return a time that all joints share, and its standard error [s].

    Args:
        name: of the delay or the lag.
        x: (n, u) of each joint by itself.
        covariance: of x (n, u + J, u + J).
    """
    k = column(name)
    own = DEVIATIONS[k] * x[:, k]
    errors = np.hypot(DEVIATIONS[k] * np.sqrt(covariance[:, k, k]), LEAST_TIME_ERROR)
    # One joint that ended elsewhere than the others moves no median.
    middle = _weighted_median(own, errors**-2.0)
    weights = np.hypot(errors, own - middle) ** -2.0
    time = float(np.sum(weights * own) / np.sum(weights))
    # Where most joints differ by more than their errors, so is the time less sure.
    spread = np.median(np.abs(own - time) / errors) / NORMAL_MEDIAN
    error = float(np.sum(weights) ** -0.5 * max(1.0, spread))
    return time, max(error, LEAST_TIME_ERROR)


def _weighted_median(values: Array, weights: Array) -> float:
    """Return the value up to which half of the weights are."""
    order = np.argsort(values)
    share = np.cumsum(weights[order]) / np.sum(weights)
    return float(values[order][np.searchsorted(share, 0.5)])


def fit_servos(
    robot: RobotModel,
    pieces: Sequence[Recording],
    progress: Progress,
    before: ServoFit | None = None,
) -> ServoFit:
    """Return the numbers with which an arm plays pieces of its logs best.

    Joints that do not move keep the model's numbers.

    Args:
        robot: the arm as in the model file.
        pieces: of logs, which have commands.
        progress: receives what is fitted and the error so far.
        before: of a part of these pieces: where the search may begin, and which joints are
            searched.

    Raises:
        InputError: no joint moves in the pieces.
    """
    moving = (
        moving_joints(pieces) if before is None else np.flatnonzero(before.is_known)
    )
    arm = ArmFit(robot, pieces, moving, progress)
    n = robot.n_joints
    start = arm.mean.copy() if before is None else before.x[moving]
    first = arm.search("Servos, each joint by itself", NAMES, start)
    for name, spread in COMMON.items():
        time, error = common(name, first.at.x, first.covariance)
        arm.know_time(name, time, float(np.hypot(error, spread)))
        if name == "command_delay":
            delay, delay_error = time, error
    _liken_gains(robot, arm, first)
    base = first.at.x.copy()
    for name in set(NAMES) - set(IN_FILE):
        base[:, column(name)] = ABSENT[column(name)]
    if before is not None:
        base = before.held_x
    less = arm.search("What the file holds", IN_FILE, arm.with_delay(base))
    # A form that holds more plays no worse: where it does, its search ended in a wrong place.
    is_wrong = less.error < first.error
    wrong = np.flatnonzero(is_wrong)
    first.at.x[wrong] = less.at.x[wrong]
    first.covariance[wrong] = less.covariance[wrong]
    by_torque = _gains_by_torque(robot, arm, pieces, first)
    begin = arm.with_delay(first.at.x)
    second = arm.refine("Servos, in long windows", NAMES, begin, True)
    mean, deviation = arm.mean.copy(), arm.deviation.copy()
    if by_torque is not None:
        second = by_torque.weigh_into(second)
        arm.know("gain", *by_torque.beside(mean, deviation))
    held = arm.refine("What the file holds, in long windows", IN_FILE, less.at.x, False)
    likely = likely_gains(robot)
    n_unknowns = len(NAMES)
    n_all = second.covariance.shape[1]
    whole = np.zeros((n, n_all))
    whole[arm.moving] = np.hstack((second.at.x, second.at.links))
    covariance = np.tile(np.eye(n_all), (n, 1, 1))
    covariance[arm.moving] = second.covariance
    is_known = np.isin(np.arange(n), arm.moving)
    x = whole[:, :n_unknowns]
    is_fast = is_too_fast(robot, x, likely, pieces)
    unresolved = np.minimum(DEVIATIONS, 1.0) ** -2.0
    misfit = np.where(is_fast[:, None], unresolved, LEAST_ERRORS**2)
    known = np.arange(n_unknowns)
    covariance[:, known, known] += misfit
    x_given_links, given_links = _given_links(whole, covariance)
    return ServoFit(
        x=x,
        link_errors=whole[:, n_unknowns:],
        covariance=covariance,
        links=arm.courses.links,
        x_given_links=x_given_links,
        given_links=given_links,
        likely_gain=likely,
        is_known=is_known,
        is_fast=is_fast & is_known,
        in_file=_in_file(robot, arm, second, held, delay),
        held_x=held.at.x,
        mean=mean,
        deviation=deviation,
        delay=delay,
        delay_error=delay_error,
        by_torque=by_torque,
    )


def _given_links(whole: Array, covariance: Array) -> tuple[Array, Array]:
    """Return unknowns (n, u) and their covariance (n, u, u) if the links are those of the file.

    Args:
        whole: unknowns and link errors (n, u + J).
        covariance: of both (n, u + J, u + J).
    """
    u = len(NAMES)
    shared = covariance[:, :u, u:]
    share = shared @ np.linalg.inv(covariance[:, u:, u:])
    x = whole[:, :u] - np.einsum("nuj,nj->nu", share, whole[:, u:])
    own = covariance[:, :u, :u] - share @ np.swapaxes(shared, 1, 2)
    return np.clip(x, LEAST, MOST), own


def is_too_fast(
    robot: RobotModel, x: Array, likely_gain: Array, pieces: Sequence[Recording]
) -> NDArray[np.bool_]:
    """Return which servos (n,) swing faster, without damping, than the samples resolve.

    Args:
        robot: the arm as in the model file.
        x: (n, u) of its servos.
        likely_gain: (n,) gains of which x has a factor [N m/rad].
        pieces: of logs.
    """
    numbers = numbers_at(x)
    inertia = robot.mj_model.dof_M0[robot.dof_index] - robot.armature
    gain = likely_gain * numbers[:, column("gain")]
    per_gain = numbers[:, column("armature")] + inertia / gain
    return np.asarray(longest_period(pieces) > FASTEST_TURN * np.sqrt(per_gain))


def _liken_gains(robot: RobotModel, arm: ArmFit, first: Solved) -> None:
    """Let joints whose gain does not show have that of the others, over the model's."""
    k = column("gain")
    factor = DEVIATIONS[k] * first.at.x[:, k]
    error = DEVIATIONS[k] * np.sqrt(first.covariance[:, k, k])
    shows = error < LARGEST_ERROR
    if not np.any(shows):
        return
    common = np.median(factor[shows])
    spread = usual_errors.SERVO_GAIN_SPREAD
    has_gain = np.isfinite(servos_in_model(robot).numbers[0])[arm.moving]
    width = np.where(has_gain, spread / DEVIATIONS[k], 1.0)
    arm.know("gain", common / DEVIATIONS[k], width)


def _gains_by_torque(
    robot: RobotModel, arm: ArmFit, pieces: Sequence[Recording], first: Solved
) -> TorqueGains | None:
    """Return the gains that recorded torques show, or None where no piece has any.

    They depend on delay and lag, which are those of all joints.
    """
    x = first.at.x.copy()
    error = np.sqrt(np.diagonal(first.covariance, axis1=1, axis2=2))[:, : len(NAMES)]
    for name in COMMON:
        x[:, column(name)] = arm.mean[:, column(name)]
        error[:, column(name)] = arm.deviation[:, column(name)]
    # So are gains of joints that carry nothing.
    k = column("gain")
    is_likened = arm.deviation[:, k] < error[:, k]
    x[:, k] = np.where(is_likened, arm.mean[:, k], x[:, k])
    error[:, k] = np.where(is_likened, arm.deviation[:, k], error[:, k])
    return gains_by_torque(robot, pieces, arm.moving, arm.likely_gain, x, error)


def _in_file(
    robot: RobotModel, arm: ArmFit, second: Solved, held: Solved, delay: float
) -> ServoParameters:
    """Return what a model file holds; joints that do not move keep the model's numbers.

    Args:
        robot: the arm as in the model file.
        arm: the search.
        second: what was found of all that a servo does.
        held: what was found with the rest left out.
        delay: of the commands [s].
    """
    in_model = servos_in_model(robot)
    numbers = in_model.numbers.copy()
    limits = chain_actuators(robot).limit.copy()
    found = numbers_at(held.at.x)
    gain = found[:, column("gain")] * arm.likely_gain
    columns = [column(name) for name in ("damping", "frictionloss", "armature")]
    numbers[0, arm.moving] = gain
    numbers[1:, arm.moving] = gain * found[:, columns].T
    k = column("torque_limit")
    shows = DEVIATIONS[k] * np.sqrt(held.covariance[:, k, k]) < LARGEST_ERROR
    of_model = limits[arm.moving]
    reached = gain * found[:, k]
    # An infinite one is what no motion reaches.
    over_gain = np.where(np.isinf(of_model), reached, of_model) / gain
    to = np.log(over_gain / UNKNOWNS["torque_limit"].mean) / DEVIATIONS[k]
    rise = arm.problem(LONG, IN_FILE, False).rise(held.at, "torque_limit", to)
    # What no motion reaches stays the model's, unless the motion needs more. Where friction under
    # load hides the limit, with the rest left out, it is that of the whole.
    whole = numbers_at(second.at.x)
    of_whole = whole[:, k] * whole[:, column("gain")] * arm.likely_gain
    shows_whole = DEVIATIONS[k] * np.sqrt(second.covariance[:, k, k]) < LARGEST_ERROR
    limits[arm.moving] = np.select(
        [shows, shows_whole, rise < SHOWN], [reached, of_whole, of_model], reached
    )
    servo_damping = in_model.servo_damping.copy()
    # A spring stands for the servo that a model does not have.
    has_servo = np.isfinite(in_model.numbers[0])[arm.moving]
    limited = has_servo * found[:, column("limited_damping")]
    limited[limited < LEAST_SHARE] = 0.0
    servo_damping[arm.moving] = limited * numbers[1, arm.moving]
    firmness = in_model.firmness.copy()
    firmness[arm.moving] = FIRM
    return ServoParameters(numbers, delay, limits, servo_damping, firmness)
