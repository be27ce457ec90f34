"""What the low-pass of positions leaves in a result.

Equations do not care for a filter that both their sides pass (``signals.low_pass``). Positions x
pass one of their own, F, before anything is built on them. What that takes from motion, x - F x, is
not known; what a second pass takes, F x - F F x, is, and it is the same wherever F hardly changes
motion. The torque of the identified arm differs by d between F x and F F x, which moves the
estimate by C Y^T W d: that is taken for one more standard error, of size and of direction.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robot_sysid.dynamics.equations import Equations
from robot_sysid.estimation.nuisances import NuisanceGroup, with_prior
from robot_sysid.estimation.uncertainty import joint_space
from robot_sysid.identify.samples import DecimatedSamples
from robot_sysid.records import Array, Estimate, Measurement, Motion, SquareRootInformation
from robot_sysid.signals.process import ProcessedSignals

FILTERING = "filtering"
"""What this cause of error is called in results."""


def with_filtering(
    estimate: Estimate,
    information: SquareRootInformation,
    groups: Sequence[NuisanceGroup],
    noise: Array,
    pull: Array,
) -> Estimate:
    """Return the estimate with what the low-pass of positions may have moved it by.

    Args:
        estimate: the result.
        information: the data.
        groups: what was known of the nuisances.
        noise: (joints,) noise as it counts in the estimate [N m].
        pull: (joints, p) see ``filtering_pull``, the sum of all logs.
    """
    weights = 1.0 / noise
    inverse = joint_space(with_prior(information, groups), weights).inverse()
    return estimate.with_bias(FILTERING, inverse @ (weights**2 @ pull))


def filtering_pull(
    samples: DecimatedSamples, equations: Equations, signals: ProcessedSignals, values: Array
) -> Array:
    """Return Y_j^T d_j of each joint j, (joints, p) in all parameters of the samples.

    Args:
        samples: the equations of a log, with nuisances.
        equations: of the arm, without them.
        signals: what the samples were made from.
        values: (p,) the estimate.
    """
    rows, again = signals.refiltered()
    once = signals.decimated_motion()
    first = Motion(once.time[rows], once.q[rows], once.qd[rows], once.qdd[rows])
    same = np.sign(first.qd) == np.sign(again.qd)
    own = values[: len(equations.names)]
    pairs = zip(_torques(equations, first, own), _torques(equations, again, own))
    pull = np.zeros((len(samples.joints), len(samples.names)))
    for (index, block, tau), joint, (one, two) in zip(samples, equations.rows_of, pairs):
        # Where a joint turns round between the two, only the sign of its friction differs.
        counts = np.isfinite(tau[rows]) & same[:, joint]
        apart = (one - two)[counts]
        pull[index, samples.columns[index]] = block[rows][counts].T @ apart
    return pull


def _torques(equations: Equations, motion: Motion, values: Array) -> list[Array]:
    """Return the torque (K,) of each joint by the equations' own parameters (p,) [N m]."""
    still = np.zeros_like(motion.q)
    measurement = Measurement(motion.time, motion.q, motion.qd, still, motion.qdd)
    shared = np.zeros((*motion.q.shape, len(equations.shared)))
    rows = equations.rows(measurement, shared)
    return [
        block @ values[columns] - right for (block, right), columns in zip(rows, equations.columns)
    ]
