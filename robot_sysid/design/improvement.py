"""One round of improving a trajectory: minimise, update multipliers, prove or repair.

Constraints hold at all times, the optimiser knows finitely many. After each round the whole motion
is checked and times at which a limit was exceeded join the optimiser's (exchange method for
semi-infinite programs, Hettich, Kortanek, SIAM Review 35(3), 1993, section 7). What little is still
over a limit is taken off by shrinking the whole motion towards rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.design.certificate import first_contact, joint_share, tight_times
from robot_sysid.design.design_objective import Design, PenalisedDesign
from robot_sysid.design.motion_constraints import ROUNDING
from robot_sysid.records import Array

FIRST_WEIGHT = 10.0
WEIGHT_GROWTH = 1.5
PLAIN_ROUNDS = 2
"""Rounds before the weight begins to grow: the multipliers should do the work."""
MEMORY = 20
"""Gradient pairs L-BFGS keeps."""
REPAIRS = (1.0, 0.999, 0.998, 0.996, 0.992, 0.985, 0.97, 0.94, 0.9, 0.8, 0.6, 0.4, 0.2, 0.1)
"""Factors tried until a motion obeys everything."""
MOST_EXTRA_TIMES = 60


@dataclass(frozen=True)
class Candidate:
    """A trajectory on its way to the optimum.

    Attributes:
        number: which start it came from.
        x: (n, M) free coefficients, possibly beyond a limit.
        multipliers: (N + E, 4 n + 1).
        extra_times: (E,) [s].
        weight: of the penalty.
        rounds: how many are done.
        proven_x: (n, M) the best one so far that obeys everything, or None.
        proven_score: its criterion.
    """

    number: int
    x: Array
    multipliers: Array
    extra_times: Array
    weight: float
    rounds: int
    proven_x: Array | None
    proven_score: float


def first_candidate(design: Design, number: int, x: Array) -> Candidate:
    """Return a candidate at free coefficients x (n, M), proven where it can be."""
    width = 4 * design.problem.n_joints + 1
    none = np.zeros((len(design.grid), width))
    start = Candidate(number, x, none, np.zeros(0), FIRST_WEIGHT, 0, None, np.inf)
    return _prove(design, start)


def improve(design: Design, candidate: Candidate) -> Candidate:
    """Return the candidate after one more round."""
    objective = PenalisedDesign(
        design, candidate.extra_times, candidate.multipliers, candidate.weight
    )
    x = _minimise(objective, candidate.x, design.options.iterations)
    multipliers = objective.updated_multipliers(objective.evaluate(x).constraints.value)
    grow = WEIGHT_GROWTH if candidate.rounds >= PLAIN_ROUNDS else 1.0
    moved = replace(
        candidate,
        x=x,
        multipliers=multipliers,
        weight=grow * candidate.weight,
        rounds=candidate.rounds + 1,
    )
    return _prove(design, _with_extra_times(design, moved))


def _minimise(objective: PenalisedDesign, x: Array, iterations: int) -> Array:
    """Return the free coefficients after some L-BFGS iterations."""
    from scipy.optimize import minimize

    def function(flat: Array) -> tuple[float, Array]:
        evaluation = objective.evaluate(flat.reshape(x.shape))
        return evaluation.value, evaluation.gradient.ravel()

    options = {"maxiter": iterations, "maxcor": MEMORY, "maxls": 30}
    result = minimize(function, x.ravel(), jac=True, method="L-BFGS-B", options=options)
    return np.asarray(result.x).reshape(x.shape)


def _with_extra_times(design: Design, candidate: Candidate) -> Candidate:
    """Return the candidate with the times at which the whole motion exceeds a limit."""
    plan = design.trajectory(candidate.x)
    _, over = joint_share(design.problem, plan)
    found = np.concatenate((over, tight_times(design.problem, plan)))
    known = np.round(candidate.extra_times, 3)
    new = np.setdiff1d(np.round(found, 3), known)[: MOST_EXTRA_TIMES - len(known)]
    none = np.zeros((len(new), candidate.multipliers.shape[1]))
    return replace(
        candidate,
        extra_times=np.concatenate((candidate.extra_times, new)),
        multipliers=np.vstack((candidate.multipliers, none)),
    )


def _prove(design: Design, candidate: Candidate) -> Candidate:
    """Return the candidate with its proven trajectory updated, if the present one is better."""
    for factor in REPAIRS:
        x = factor * candidate.x
        score = design.criterion_of(x)
        if not score < candidate.proven_score:
            break
        if obeys_everything(design, x):
            return replace(candidate, proven_x=x, proven_score=score)
    return candidate


def obeys_everything(design: Design, x: Array) -> bool:
    """Tell whether the whole motion keeps every limit."""
    plan = design.trajectory(x)
    share, _ = joint_share(design.problem, plan)
    return share <= 1.0 + ROUNDING and first_contact(design.problem, plan) is None
