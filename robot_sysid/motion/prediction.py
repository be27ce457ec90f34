"""What a trajectory promises before it is run: how well each parameter will be known."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.algebra.identifiability import describe
from robot_sysid.motion.information import predicted_information, visible_coordinates
from robot_sysid.motion.problem import ExcitationProblem
from robot_sysid.records import Array, Identifiability, MotionPlan
from robot_sysid.trajectory import sample_count, spread_motion

PREDICTION_RATE_HZ = 100.0
"""Sampling of the motion for the prediction: far above its band, see docs/excitation.md."""
MOST_INSTANTS = 60_000
"""Instants of the motion that are looked at: all of the first ten minutes, or spread over it."""
LOOSE_SHARE = 0.2
"""A predicted standard deviation above this share of the parameter's size is called loose."""
_INVISIBLE = 1e-10
"""Share of the whole signal below which a direction counts as not visible."""
_DIAGONAL = {4: (0, 0), 7: (1, 1), 9: (2, 2)}
_OFF_DIAGONAL = {5: (4, 7), 6: (4, 9), 8: (7, 9)}


@dataclass(frozen=True)
class Prediction:
    """What a trajectory promises.

    Attributes:
        n_samples: per joint.
        covariance: (10, 10) of theta; infinite on the diagonal where this motion does not show it.
        size: (10,) magnitude each parameter is compared with: its own value in the model, for a
            first moment m L, for a product of inertia sqrt(Iii Ijj).
        com_deviation: standard deviation of the centre of mass, root of summed squares [m].
        never: what no motion of these joints can show, in words.
        unseen: what this motion does not show though another one would, in words.
        counted: which errors it counts, in words.
        stated: (10,) standard errors that an identification will state, with all that is not known
            of the arm; infinite where the model's value stays, empty where nothing can be said.
        shown: what a run of the motion will say of its regressor.
    """

    n_samples: int
    covariance: Array
    size: Array
    com_deviation: float
    never: tuple[str, ...]
    unseen: tuple[str, ...]
    counted: str = ""
    stated: Array = field(default_factory=lambda: np.zeros(0))
    shown: Identifiability | None = None

    @property
    def deviation(self) -> Array:
        """Predicted standard deviation of each parameter (10,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def share(self) -> Array:
        """Predicted standard deviation as share of each parameter's size (10,)."""
        return self.deviation / self.size

    @property
    def loose(self) -> tuple[int, ...]:
        """Which parameters are visible, but more uncertain than a fifth of their size."""
        share = self.share
        return tuple(k for k in range(10) if np.isfinite(share[k]) and share[k] > LOOSE_SHARE)


@dataclass(frozen=True)
class Seen:
    """What some equations tell about the terminal link.

    Attributes:
        information: (10, 10) about theta in units of ``problem.scale``, nuisances eliminated.
        signal: trace of it before they were: what counts as large.
    """

    information: Array
    signal: float


def predict(
    problem: ExcitationProblem, plan: MotionPlan, sample_rate: float, seen: Seen | None = None
) -> Prediction:
    """Predict what least squares will make of a trajectory, with friction and offset of each joint.

    Args:
        problem, plan: the arm with its torque noise, and the trajectory.
        sample_rate: at which torque will be measured, with independent noise in each sample [Hz].
        seen: what the estimate will be made from; None takes all samples, the bound for any
            unbiased estimate.
    """
    n_samples = sample_count(plan.duration, sample_rate)
    seen = seen or _all_samples(problem, plan, n_samples)
    covariance, hidden = _inverted(problem, seen)
    possible = visible_coordinates(problem) / problem.scale[:, None]
    # What is orthogonal to that, and the part of what is hidden that another motion could show.
    left, singular, _ = np.linalg.svd(possible, full_matrices=True)
    inside, size, _ = np.linalg.svd(
        possible @ (np.linalg.pinv(possible) @ hidden), full_matrices=False
    )
    return Prediction(
        n_samples=n_samples,
        covariance=covariance,
        size=parameter_sizes(problem),
        com_deviation=_com_deviation(problem.robot.prior.theta, covariance),
        never=_words(problem, left[:, len(singular) :]),
        unseen=_words(problem, inside[:, size > 1e-6]),
    )


def parameter_sizes(problem: ExcitationProblem) -> Array:
    """Return the magnitudes (10,) predicted deviations are compared with."""
    theta = problem.robot.prior.theta
    size = problem.scale.copy()
    size[0] = theta[0]
    for k in _DIAGONAL:
        size[k] = theta[k] if theta[k] > 0.0 else size[k]
    for k, (i, j) in _OFF_DIAGONAL.items():
        size[k] = np.sqrt(size[i] * size[j])
    return size


def _all_samples(problem: ExcitationProblem, plan: MotionPlan, n_samples: int) -> Seen:
    motion = spread_motion(plan, MOST_INSTANTS, PREDICTION_RATE_HZ)
    sigma = problem.sigma / np.sqrt(n_samples / len(motion.q))
    information = predicted_information(problem, sigma, np.diag(problem.scale))
    cache = information.evaluate(motion.q, motion.qd, motion.qdd)
    return Seen(cache.information, cache.signal)


def _inverted(problem: ExcitationProblem, seen_at_all: Seen) -> tuple[Array, Array]:
    """Return covariance of theta and hidden directions (scaled).

    A parameter that a hidden direction contains has infinite variance.
    """
    scale, information = problem.scale, seen_at_all.information
    values, vectors = np.linalg.eigh(information)
    seen = values > _INVISIBLE * seen_at_all.signal
    hidden = vectors[:, ~seen]
    root = vectors[:, seen] / np.sqrt(values[seen])
    covariance = np.outer(scale, scale) * (root @ root.T)
    covariance[np.diag_indices(10)] += np.where(np.linalg.norm(hidden, axis=1) > 1e-6, np.inf, 0.0)
    return covariance, hidden


def _com_deviation(prior: Array, covariance: Array) -> float:
    """Return the root of the summed variances of c = h / m, to first order [m]."""
    slope = np.hstack((-prior[1:4, None] / prior[0], np.eye(3))) / prior[0]
    block = covariance[:4, :4]
    if not np.all(np.isfinite(block)):
        return np.inf
    return float(np.sqrt(np.trace(slope @ block @ slope.T)))


def _words(problem: ExcitationProblem, space: Array) -> tuple[str, ...]:
    return describe(space, problem.scale, spatial.PARAMETER_NAMES) if space.shape[1] else ()
