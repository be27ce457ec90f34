"""What a trajectory promises before it is run: how well each parameter will be known."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.friction import DEFAULT_MEASURED, friction_model
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.estimation.algebra.identifiability import describe
from robot_sysid.motion.information import PredictedInformation
from robot_sysid.motion.problem import ExcitationProblem
from robot_sysid.records import Array, Identifiability, MotionPlan
from robot_sysid.trajectory import sample_count, spread_motion

PREDICTION_RATE_HZ = 100.0
"""Sampling of the motion for the prediction: far above its band, see docs/excitation.md."""
MOST_INSTANTS = 60_000
"""Instants of the motion that are looked at: all of the first ten minutes, or spread over it."""
ARM_RATE_HZ = 20.0
"""How densely a candidate for a whole arm is looked at."""
KNOWN = 0.3
"""How well the model is taken to know each link, as a share of its numbers."""
_OWN = friction_model("coulomb-viscous-offset-armature")
_UNIT_ROTOR = 0.1
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


def predicted_information(
    problem: ExcitationProblem, sigma: Array, coordinates: Array, smoothing: float = 0.0
) -> PredictedInformation:
    """Return what tells the information of motions about x, theta = coordinates @ x (10, r).

    From torques with noise sigma (rows,) [N m]; Coulomb friction's jump is rounded off below a
    share of the speed limits.
    """
    smooth = smoothing * problem.limits.velocity
    # From one torque rotor inertias are not estimated: they are the link's.
    rotors = "armature" in DEFAULT_MEASURED and len(problem.rows) > 1
    return PredictedInformation(problem.chain, problem.rows, sigma, smooth, coordinates, rotors)


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


def visible_coordinates(problem: ExcitationProblem) -> Array:
    """Return (10, r): scaled directions of theta that some motion of this arm can show.

    Found from unrelated positions, velocities and accelerations, a fixed set of random numbers.
    What such data cannot see, no trajectory of these joints can.
    """
    scale = np.diag(problem.scale)
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.normal(size=(3, 400, problem.n_joints))
    q = np.clip(problem.rest + 2.0 * q, problem.limits.lower, problem.limits.upper)
    information = predicted_information(problem, np.ones(len(problem.rows)), scale)
    matrix = information.evaluate(q, qd, qdd).information
    values, vectors = np.linalg.eigh(matrix)
    return scale @ vectors[:, values > 1e-9 * values[-1]]


def arm_criterion(problem: ExcitationProblem, plan: MotionPlan) -> float:
    """Return -ln det L / 2r of what a motion says of all links, rotors and friction, r unknowns.

    L = Y^T Y / sigma^2 + P, with P what the model knows beforehand, so that what no motion shows
    does not count (Bayesian D-optimality; Chaloner, Verdinelli, "Bayesian experimental design: a
    review", Statistical Science 10(3), 1995).
    """
    motion = plan.evaluate(np.arange(0.0, plan.duration, 1.0 / ARM_RATE_HZ))
    robot = problem.robot
    links = [k for k, link in enumerate(robot.links) if link.has_mass]
    columns = LinkDynamics(robot).motion(motion.q, motion.qd, motion.qdd).columns(links)
    scale = []
    for theta in (robot.links[k].theta for k in links):
        length = max(spatial.characteristic_length(theta), 1e-3)
        scale.append(KNOWN * spatial.parameter_scale(float(theta[0]), length))
    columns = columns * np.concatenate(scale)
    sigma = np.full(problem.n_joints, np.inf)
    sigma[list(problem.rows)] = problem.sigma
    size = np.where(np.array(_OWN.terms) == "armature", _UNIT_ROTOR, 1.0)
    total = np.eye(columns.shape[-1] + len(size) * problem.n_joints)
    for joint in range(problem.n_joints):
        nothing = np.zeros(len(motion.time))
        own = _OWN.columns(motion.qd[:, joint], motion.qdd[:, joint], nothing) * size
        rows = np.zeros((len(motion.time), len(total)))
        rows[:, : columns.shape[-1]] = columns[:, joint]
        place = columns.shape[-1] + joint * len(size)
        rows[:, place : place + len(size)] = own
        total += rows.T @ rows / sigma[joint] ** 2
    return -float(np.linalg.slogdet(total)[1]) / (2.0 * len(total))
