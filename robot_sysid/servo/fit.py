"""Servos, friction and rotor inertia fitted to an arm's commands and positions.

What is searched in the equations (``equations``) comes first: the delay of all joints, samples at
torque limits, dead zones. 1/K is a torque scale without a unit, and shows only where the links'
torque is no small part. Elsewhere it comes from its prior: the gains of the other joints, because
servos of one arm are alike. What is found of a joint stays together, so that the ratios of its
numbers, which set the motion, are right whatever the gain.

The terms are those of every fit, formulas of ``dynamics.friction`` with a ``Prior`` each, and their
normal equations have its solver (``estimate.fit.solve``). What is not the one fit's:

* The delay is no small error here but up to half a second, and is searched: each has other
  position errors, and the best is the one that leaves least.
* Links are not fitted, because the file keeps them; all that they may be off by is in the errors.
* All samples are rows, behind a short low-pass (``loop``), and those are left out that are far from
  what fits the others, or at a torque limit, for which no linear term stands.

The equation is valid as long as the samples resolve the motion. The numbers of a joint whose servo
is faster are those of ``played_fit``.

n is the number of joints, p that of terms of a joint, four.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import robot_sysid.records.usual_errors as usual_errors
from robot_sysid.records import Array, Recording, RobotModel
from robot_sysid.servo.equations import (
    DEAD_ZONE_DIGITS,
    N_VALUES,
    NEAR_LIMIT,
    LoopEquations,
)
from robot_sysid.servo.loop import GRID, longest_period
from robot_sysid.simulation.playback import ServoParameters, servos_in_model

LARGEST_ERROR = 0.4
"""Relative standard error up to which a number is identified, and up to which a joint's resistance
at 1 rad/s is known well enough for its numbers to be written."""
LEAST_COMPLIANCE = 1e-9
"""Least 1/K of a joint [rad/(N m)]."""
SEARCHES = 6
"""Largest number of searches for the delay: it and what else is searched depend on one another."""
NEARBY = GRID * np.arange(-2.0, 3.0)
"""Delays around the last that are tried again [s]: an unseen torque limit moves it by 0.016 s."""
CREEP_DEAD_ZONE = 3e-4
"""Error of a dead zone by friction that creeps, and by commands between samples [rad]."""
STICKING_DEAD_ZONE = 0.25
"""Error of a dead zone by friction that sticks or creeps at each turn, over the position error by
which a servo overcomes it: of joints that carry no link, it looks like so much of a dead zone."""
SAMPLING_DELAY = 0.01
"""Error of the delay by sampling, over the sampling period: of 40 simulated arms at 25 to 200 Hz,
errors are 0.8 of the stated ones with it, and 1.2 without."""
LIMIT_DELAY = 5e-4
"""Error of the delay where samples at a torque limit are left out [s]: what is left beside them is
up to 1.1 ms late on eleven simulated arms, and 2.1 ms on a twelfth."""

MOST_LIMITED = 0.3
"""Share of the motion at torque limits, of all joints together, from which the delay is not known:
of 24 simulated arms with more, the delay of ten was 11 to 70 ms off, six to fifteen of its errors;
of 24 with less, 2.5 errors at the most."""

# ---- servos that are too fast

FASTEST_TURN = 1.2
"""Angle by which the oscillation of a servo without damping may turn between two samples [rad]:
differences of faster motion are no derivatives, and its equations are wrong."""
SHORTEST_PERIOD = 0.01
"""Sampling period below which none resolves a faster motion [s]: the low-pass hides it."""


@dataclass(frozen=True)
class ServoFit(ServoParameters):
    """The fitted numbers of an arm and how sure they are.

    Attributes:
        errors: (4, n) standard errors of the numbers.
        is_fast: (n,) whether the samples do not resolve the motion of the servo.
        is_known: (n,) whether a joint moves enough to show its numbers.
        delay_error: standard error of the delay, infinite where no joint shows it [s].
        dead_zone_errors: (n,) standard errors of the dead zones, zero where there is none [rad].
        limited_share: (n,) share of the moving samples that a servo's torque limit makes wrong.
    """

    errors: Array
    is_fast: NDArray[np.bool_]
    is_known: NDArray[np.bool_]
    delay_error: float
    dead_zone_errors: Array
    limited_share: Array

    @property
    def is_shown(self) -> NDArray[np.bool_]:
        """Which numbers (4, n) the data shows, and not only in proportion to the gain."""
        return self.errors < LARGEST_ERROR * self.numbers


def fit_servos(robot: RobotModel, pieces: Sequence[Recording]) -> ServoFit:
    """Return the servo numbers that solve the equations best, with one delay for all joints.

    The delay is found first. Links then show the gains of the joints that carry them, and the
    others' are taken to be like these. Joints that do not move keep the model's numbers.
    """
    equations = LoopEquations(robot, pieces)
    moves = equations.moves
    equations.search_delay()
    for _ in range(SEARCHES):
        before = np.append(equations.limits, equations.dead_zones)
        equations.search_shapes()
        after = np.append(equations.limits, equations.dead_zones)
        if np.allclose(after, before, rtol=1.0 - NEAR_LIMIT, atol=DEAD_ZONE_DIGITS):
            break
        equations.search_delay(np.maximum(equations.delay + NEARBY, 0.0))
    if np.any(np.isfinite(equations.limits)):
        equations.leave_out_limited()
        equations.search_delay(np.maximum(equations.delay + NEARBY, 0.0))
    delay = equations.delay
    in_model = servos_in_model(robot).numbers
    has_gain = np.isfinite(in_model[0])
    compliance = equations.values[:, 0]
    compliance_error = np.sqrt(equations.covariances[:, 0, 0])
    has_scale = compliance_error < LARGEST_ERROR * compliance
    equations.gain_error[:] = usual_errors.SERVO_GAIN
    if np.any(has_scale):
        equations.gain *= np.median(1.0 / (compliance * equations.gain)[has_scale])
        equations.gain_error[has_gain] = usual_errors.SERVO_GAIN_SPREAD
    equations.solve_at(delay)
    values = equations.values
    searched = np.sqrt(equations.covariances[:, -1, -1])
    covariances = equations.covariances[:, :N_VALUES, :N_VALUES]

    found = np.where(
        moves, 1.0 / np.maximum(values[:, 0], LEAST_COMPLIANCE), equations.gain
    )
    numbers = found * values.T
    numbers[0] = found
    # The derivative of each number by the joint's values.
    slopes = found[:, None, None] * np.eye(N_VALUES)
    slopes[:, :, 0] = -(numbers * found).T
    variance = np.einsum("kij,kjl,kil->ik", slopes, covariances, slopes)
    period = longest_period(pieces)
    frequency = np.sqrt(found / (numbers[3] + equations.inertia))
    is_fast = moves & (max(period, SHORTEST_PERIOD) * frequency > FASTEST_TURN)
    # Over the gain, by which all numbers of the joint are off alike.
    at_speed = np.array([0.0, 1.0, 1.0, 0.0])
    doubt = np.sqrt(at_speed @ covariances @ at_speed)
    resists = doubt < LARGEST_ERROR * (values @ at_speed)
    is_known = is_fast | (resists & ~equations.is_mostly_limited)
    delay_error = equations.delay_error(equations.shows_delay & is_known)
    by_samples = SAMPLING_DELAY * period
    by_limits = LIMIT_DELAY if np.any(equations.limited_share > 0.0) else 0.0
    # The equations of a fast servo are wrong, and show no limit.
    shares = equations.limited_share[moves & ~is_fast]
    if np.sum(shares) > MOST_LIMITED * len(shares):
        by_limits = np.inf
    # The equations of a fast servo are wrong, and what bends them is no limit and no dead zone.
    has_dead_zone = ~is_fast & (equations.dead_zones > 0.0)
    by_sticking = STICKING_DEAD_ZONE * values[:, 2]
    dead_zone_error = np.hypot(np.hypot(searched, CREEP_DEAD_ZONE), by_sticking)
    return ServoFit(
        numbers=np.where(moves | np.isnan(in_model), numbers, in_model),
        errors=np.sqrt(variance),
        delay=delay,
        dead_zones=np.where(has_dead_zone, equations.dead_zones, 0.0),
        is_fast=is_fast,
        is_known=is_known,
        delay_error=float(np.hypot(np.hypot(by_samples, by_limits), delay_error)),
        dead_zone_errors=has_dead_zone * dead_zone_error,
        limited_share=np.where(is_fast, 0.0, equations.limited_share),
    )
