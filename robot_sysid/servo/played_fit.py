"""Servos that are too fast for the samples of a log: numbers with which a model plays it best.

The one estimator that is no linear fit: where a servo swings faster than the samples resolve, no
equation holds at an instant, and what is left is where its motion ends up. So the model plays
windows of the log, driven by the commands, and its numbers and the delay move to where positions
come nearest to the measured ones (nonlinear least squares; residuals beyond their scale count less,
because a rollout at its torque limit is far off).

n is the number of joints.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from robot_sysid.records import Array
from robot_sysid.records.usual_errors import SERVO_FRICTION, SERVO_NUMBERS
from robot_sysid.servo.equations import LINK_ERROR
from robot_sysid.servo.fit import ServoFit
from robot_sysid.servo.windows import ServoProblem
from robot_sysid.simulation.playback import STEP, servos_in_model

BY_LINKS = 2.0 * LINK_ERROR
"""Relative error of numbers by the links, which fix the scale: their errors add up to about two
single ones."""
LEAST_ERRORS = np.array([[BY_LINKS], [BY_LINKS], [SERVO_FRICTION], [BY_LINKS]])
"""Relative errors (4, 1) of gain, damping, friction and rotor inertia beside those of noise."""
DELAY_UNIT = 0.004
"""Delay of a factor of one [s], so that its steps are like those of the other factors."""
LEAST_START = 1e-4
"""Least number from which a factor is searched, in its units: a factor on zero would stay zero."""
LEAST_FACTOR = 0.01
"""Least factor on a number."""
LARGEST_FACTOR = 100.0
"""Largest factor on a number."""
FINE_STEP = 0.00025
"""Time step of the rollouts from which the last numbers come [s]. A servo at its torque limit is
not damped: what half a step of its damping takes from the rotor (``set_servos``) is then missing,
and steps of 1 ms make rotors of stiff servos 9 % too large, and gains with them."""
PASSES = ((STEP, 5), (STEP, 5), (0.5 * STEP, 3), (FINE_STEP, 2))
"""Time steps of the rollouts, and how many sets of numbers are tried at the most, each with new
scales of the position errors: most of the way is gone in large steps, in a quarter of the time."""
DIFFERENCE = 0.3
"""Relative step of numerical derivatives: a servo that is at its limit again and again makes
rollouts rough on smaller scales."""
STICKING_DELAY = 5e-4
"""Error of the delay by friction that sticks, which creeps in rollouts [s]."""
CORRELATED_SAMPLES = 30.0
"""Samples that count as one: errors of positions last until the servo brings them back."""
LEAST_SCALE = 1e-9
"""Least scale of position errors [rad or m]."""


def refine_by_playing(problem: ServoProblem, fit: ServoFit) -> ServoFit:
    """Return a fit with a delay, and numbers of fast servos, with which a model plays the windows.

    Unknown are factors on the model's numbers, the means of wide priors, or on those of the
    equations where it has none, and on the delay.

    Args:
        problem: windows of the log.
        fit: numbers of the equations.
    """
    from scipy.optimize import least_squares

    fast = fit.is_fast
    if not np.any(fast):
        return fit
    in_model = servos_in_model(problem.rollouts.robot).numbers
    start = np.where(in_model > 0.0, in_model, np.maximum(fit.numbers, LEAST_START))
    start = start[:, fast]

    def fit_at(factors: Array) -> ServoFit:
        """Return the fit with the numbers and the delay that factors stand for."""
        numbers = fit.numbers.copy()
        numbers[:, fast] = start * factors[:-1].reshape(4, -1)
        return replace(fit, numbers=numbers, delay=DELAY_UNIT * (factors[-1] - 1.0))

    def residuals(factors: Array, scale: Array, step: float) -> Array:
        """Return the position errors over their scale, then the prior's residuals."""
        errors = problem.errors(fit_at(factors), step) / scale
        return np.append(errors, np.log(factors[:-1]) / SERVO_NUMBERS)

    factors = np.append(np.ones(start.size), 1.0 + fit.delay / DELAY_UNIT)
    least = np.append(np.full(start.size, LEAST_FACTOR), 1.0)
    for step, count in PASSES:
        squares = problem.errors(fit_at(factors), step) ** 2
        scale = np.sqrt(CORRELATED_SAMPLES * np.mean(squares, axis=(0, 1)))
        fitted = least_squares(
            residuals,
            factors,
            jac="3-point",
            bounds=(least, LARGEST_FACTOR),
            diff_step=DIFFERENCE,
            loss="soft_l1",
            max_nfev=count,
            args=(scale + LEAST_SCALE, step),
        )
        factors = fitted.x
    refined = fit_at(factors)
    deviation = np.sqrt(np.diag(np.linalg.inv(fitted.jac.T @ fitted.jac)))
    by_noise = (deviation / factors)[:-1].reshape(4, -1)
    relative = np.hypot(by_noise, LEAST_ERRORS)
    errors = fit.errors.copy()
    errors[:, fast] = relative * refined.numbers[:, fast]
    delay_error = np.hypot(STICKING_DELAY, DELAY_UNIT * deviation[-1])
    if np.isinf(fit.delay_error):
        # A search from a delay that is not known ends at any.
        delay_error = np.inf
    return replace(refined, errors=errors, delay_error=float(delay_error))
