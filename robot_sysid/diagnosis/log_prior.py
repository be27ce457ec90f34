"""The prior of a log without faults: the estimate's, with wider links and more friction.

Throughout, n is the number of joints, p that of parameters, k that of estimated parameters. The
typical torque of a joint is ``LogRows.typical_torque``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.diagnosis.log_rows import BUILD_UP, LogRows, rms
from robot_sysid.dynamics.friction import friction_model
from robot_sysid.dynamics.inverse_dynamics import TILT_NAMES
from robot_sysid.dynamics.spatial import (
    PARAMETER_NAMES,
    characteristic_length,
    parameter_scale,
)
from robot_sysid.estimation.algebra.priors import EXPECTED
from robot_sysid.estimation.choices import WITH_ALL
from robot_sysid.estimation.question import Choice, EstimationOptions, Priors, Question
from robot_sysid.estimation.unknowns import build_unknowns
from robot_sysid.records import DELAY_NAME, Array

LINK_SCALES = replace(EXPECTED, mass=6.0)
"""Scales of the prior of all links but the last one."""
PAYLOAD = 0.3
"""Prior standard deviation of the last link's mass, as a share of the arm's mass."""
REACH = 0.15
"""Least size of the last link that its prior assumes, as a share of the arm's length."""
FRICTION = {
    "coulomb": 1.0,
    "viscous": 1.0,
    "offset": 0.3,
    "armature": 0.5,
    "sqrt": 0.05,
    "stribeck": 0.05,
    "fading_fast": 0.05,
    "load": 0.04,
}
"""Prior standard deviation of each friction term: its torque at the joint's typical speed and
acceleration, as a share of the typical torque; of "load" (a gear's loss), as a share of the load.
It is at least the value that the model states, which is seldom measured, or at lower speeds.
"""
BUILT_UP = 0.15
"""Prior standard deviation of friction that builds up after a reversal, as a share of the typical
torque."""
UNEVEN = 0.03
"""Prior standard deviation of dry friction that varies over a turn, as a share of the typical
torque."""
WIDE_TILT = 0.15
"""Prior standard deviation of the base's tilt where the options ask to estimate it [rad]."""
WIDE_DELAY = 0.04
"""Prior standard deviation of the delay where the options ask to estimate it [s]."""
WORTH_A_WORD = 2.0
"""Largest prior standard deviation of the delay where the options do not ask to estimate it [ms]: a
larger delay is worth a finding."""


@dataclass(frozen=True)
class Prior:
    """The normal prior of a log's parameters.

    Attributes:
        estimated: (k,) indices of the estimated parameters, ascending.
        mean: (p,) prior means, and values of the parameters that are not estimated.
        spread: (k,) prior standard deviations.
        precision: (k, k) inverse covariance in units of ``spread``.
    """

    estimated: NDArray[np.int64]
    mean: Array
    spread: Array
    precision: Array

    def positions(self, indices: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the positions (m,) in ``estimated`` of parameters with given indices (m,).

        Every one of these has to be an estimated parameter.
        """
        return np.searchsorted(self.estimated, indices)


def base_prior(log: LogRows, options: EstimationOptions) -> Prior:
    """Return the prior of a log without faults.

    It is the prior of the estimate, with a last link that may carry any tool and with more friction
    terms. The prior of other links is at least as wide as by default.

    Args:
        log: equations of the log.
        options: prior uncertainties of the estimate.
    """
    columns = log.columns
    spread = _plain_spread(log)
    mean = np.zeros(len(spread))
    mean[: len(columns.names)] = columns.model_values
    # A small stated uncertainty of the links must not turn their usual errors into faults. A delay
    # that the estimate would allow for is reported all the same.
    links = max(options.priors.link, Priors.link)
    late = min(options.priors.delay, WORTH_A_WORD)
    priors = replace(options.priors, link=links, delay=late)
    options = replace(options, priors=priors)
    friction = (friction_model(WITH_ALL),) * log.robot.n_joints
    nonzero = np.ones(len(columns.names), dtype=bool)
    choice = Choice(friction, link_scales=LINK_SCALES)
    unknowns = build_unknowns(
        columns, Question(options), choice, log.typical_torque, nonzero
    )
    for group in unknowns.groups:
        at = columns.indices(group.names)
        mean[at] = group.mean
        # The group's prior covariance is factor times its transpose.
        sizes = np.sqrt(np.sum(group.factor**2, axis=1))
        spread[at] = np.maximum(spread[at], sizes)
    # Tilt and delay are unknown if the estimate is asked to find them.
    wide = {**dict.fromkeys(TILT_NAMES, WIDE_TILT), DELAY_NAME: WIDE_DELAY}
    for name in set(wide) & set(unknowns.increments):
        spread[columns.index[name]] = wide[name]

    estimated = np.flatnonzero(spread)
    # Parameters without a group are independent, with a variance of one in these units.
    precision = np.eye(len(estimated))
    for group in unknowns.groups:
        indices = columns.indices(group.names)
        at = np.searchsorted(estimated, indices)
        scaled = group.factor / spread[indices, None]
        precision[np.ix_(at, at)] = np.linalg.inv(scaled @ scaled.T)
    return Prior(estimated, mean, spread[estimated], precision)


def _plain_spread(log: LogRows) -> Array:
    """Return the prior standard deviations (p,) of the last link, which may carry any tool, and of
    friction; zero for all other parameters.
    """
    robot = log.robot
    link = robot.prior
    own_size = characteristic_length(link.theta) if link.mass > 0.0 else 0.0
    distance = float(np.linalg.norm(link.com))
    size = max(REACH * robot.length, own_size, distance)
    # Friction that the estimate does not have (``log_rows``), joint by joint, in column order.
    shares = np.append(np.full(len(BUILD_UP), BUILT_UP), [UNEVEN, UNEVEN])
    further = np.outer(log.typical_torque, shares).ravel()
    spread = np.append(np.zeros(len(log.columns.names)), further)
    spread[: len(PARAMETER_NAMES)] = parameter_scale(PAYLOAD * robot.mass, size)
    speed = np.maximum(rms(log.motion.qd), 1e-9)
    # The typical size of what each term multiplies; coefficients of all other terms are torques.
    units = {
        "viscous": speed,
        "armature": np.maximum(rms(log.motion.qdd), 1e-9),
        "sqrt": np.sqrt(speed),
        "load": log.typical_torque,
    }
    for term, share in FRICTION.items():
        sizes = share * log.typical_torque / units.get(term, np.ones_like(speed))
        indices = log.friction_indices(term)
        # Many models state damping that steadies a simulation and is far above the arm's. With a
        # narrower prior, an exchange of joints that hides the excess would be the likelier log.
        spread[indices] = np.maximum(sizes, np.abs(log.columns.model_values[indices]))
    return spread
