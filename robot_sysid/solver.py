"""From square-root information to an estimate by plain least squares."""

from __future__ import annotations

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.algebra.consistent_bodies import (
    ConsistentLinks,
    LinksProblem,
)
from robot_sysid.estimation.algebra.identifiability import (
    N_INERTIAL,
    analyse_identifiability,
)
from robot_sysid.estimation.algebra.least_squares import (
    ordinary,
    residual_errors,
    solver,
)
from robot_sysid.estimation.algebra.uncertainty import uncertainty
from robot_sysid.records import Array, Estimate, SquareRootInformation


def identify_parameters(
    information: SquareRootInformation, prior: Array, possible: bool = False
) -> Estimate:
    """Estimate all parameters; what the data cannot see keeps the prior's value.

    Args:
        prior: (p,) the model's own values, in the order of ``information.names``.
        possible: replace a link that no rigid body can be by the best that one can.
    """
    solved = solver(information, prior)
    noise = ordinary(information, solved)
    values = free = solved(1.0 / noise)[0]
    if possible and not spatial.is_consistent(free[:N_INERTIAL]):
        usual = np.append(prior[:N_INERTIAL], np.zeros(len(prior) - N_INERTIAL))
        problem = LinksProblem((np.arange(N_INERTIAL),), usual)
        values = ConsistentLinks(*information.stacked(1.0 / noise), problem).best()
    errors = uncertainty(information, 1.0 / noise, noise)
    counts = {joint.joint: joint.n_samples for joint in information.joints}
    each = dict(zip(counts, noise.tolist()))
    return Estimate(
        names=information.names,
        values=values,
        identifiability=analyse_identifiability(information),
        **residual_errors(information, values),
        method="ols",
        covariance=errors.covariance,
        standard_errors=errors.standard_errors,
        noise_per_joint={
            joint: each[joint] for joint, count in counts.items() if count
        },
        effective_samples={joint: float(count) for joint, count in counts.items()},
        constrained=bool(np.any(values != free)),
    )
