"""What a trajectory promises before it is run: how well each parameter will be known."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.identifiability import describe
from robot_sysid.excitation.design.optimise import visible_coordinates
from robot_sysid.excitation.information import InformationCache, PredictedInformation, RowSettings
from robot_sysid.excitation.limit_check import LimitCheck, check_limits
from robot_sysid.excitation.problem import ExcitationProblem
from robot_sysid.records import Array, MotionPlan
from robot_sysid.trajectory import motion_chunks

PREDICTION_RATE_HZ = 100.0
"""Sampling of the motion for the prediction: far above its band, see docs/excitation.md."""
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
        joint_names: of the chain.
        limit_check: peaks against limits.
        limits: (3, n) velocity, acceleration and torque limits.
        n_samples: samples per joint the prediction is for.
        covariance: (10, 10) of theta; infinite on the diagonal where this motion does not show it.
        size: (10,) magnitude each parameter is compared with: its own value in the model, for a
            first moment m L, for a product of inertia sqrt(Iii Ijj).
        com_deviation: standard deviation of the centre of mass, root of summed squares [m].
        condition_number: of the link's equations after friction and offsets are eliminated.
        scaled_condition_number: the same with columns of unit length.
        never: what no motion of these joints can show, in words.
        unseen: what this motion does not show though another one would, in words.
    """

    joint_names: tuple[str, ...]
    limit_check: LimitCheck
    limits: Array
    n_samples: int
    covariance: Array
    size: Array
    com_deviation: float
    condition_number: float
    scaled_condition_number: float
    never: tuple[str, ...]
    unseen: tuple[str, ...]

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


def predict(
    problem: ExcitationProblem,
    plan: MotionPlan,
    sample_rate: float,
    limit_check: LimitCheck | None = None,
) -> Prediction:
    """Predict what least squares will make of a trajectory, with friction and offset of each joint.

    Args:
        problem: the arm, its limits, and the torque noise.
        plan: the trajectory.
        sample_rate: at which torque will be measured, with independent noise in each sample [Hz].
        limit_check: of this trajectory, where it was made already.
    """
    n_samples = max(1, int(np.floor(plan.duration * sample_rate)) + 1)
    covariance, unseen_space, condition = _inverted(problem, _forward(problem, plan, n_samples))
    possible = visible_coordinates(problem) / problem.scale[:, None]
    limits = problem.limits
    return Prediction(
        joint_names=problem.joint_names,
        limit_check=limit_check or check_limits(problem, plan, sample_rate),
        limits=np.stack((limits.velocity, limits.acceleration, limits.torque)),
        n_samples=n_samples,
        covariance=covariance,
        size=parameter_sizes(problem),
        com_deviation=_com_deviation(problem.prior, covariance),
        condition_number=condition[0],
        scaled_condition_number=condition[1],
        never=_words(problem, _complement(possible)),
        unseen=_words(problem, _beyond(unseen_space, possible)),
    )


def parameter_sizes(problem: ExcitationProblem) -> Array:
    """Return the magnitudes (10,) predicted deviations are compared with."""
    theta = problem.prior
    size = problem.scale.copy()
    size[0] = theta[0]
    for k in _DIAGONAL:
        size[k] = theta[k] if theta[k] > 0.0 else size[k]
    for k, (i, j) in _OFF_DIAGONAL.items():
        size[k] = np.sqrt(size[i] * size[j])
    return size


def _forward(problem: ExcitationProblem, plan: MotionPlan, n_samples: int) -> InformationCache:
    """Return the information (10, 10) about theta in units of ``problem.scale``."""
    chunks = list(motion_chunks(plan, PREDICTION_RATE_HZ))
    q, qd, qdd = (np.vstack([getattr(c, name) for c in chunks]) for name in ("q", "qd", "qdd"))
    settings = RowSettings(
        joints=problem.rows,
        sigma=problem.sigma / np.sqrt(n_samples / len(q)),
        smoothing=np.zeros(problem.n_joints),
        coordinates=np.diag(problem.scale),
    )
    return PredictedInformation(problem.chain, settings).evaluate(q, qd, qdd)


def _inverted(
    problem: ExcitationProblem, cache: InformationCache
) -> tuple[Array, Array, tuple[float, float]]:
    """Return covariance of theta, hidden directions (scaled), and both condition numbers.

    A parameter that a hidden direction contains has infinite variance.
    """
    scale, information = problem.scale, cache.information
    values, vectors = np.linalg.eigh(information)
    seen = values > _INVISIBLE * cache.signal
    hidden = vectors[:, ~seen]
    root = vectors[:, seen] / np.sqrt(values[seen])
    covariance = np.outer(scale, scale) * (root @ root.T)
    covariance[np.diag_indices(10)] += np.where(np.linalg.norm(hidden, axis=1) > 1e-6, np.inf, 0.0)
    raw = information / np.outer(scale, scale)
    length = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    unit = information / np.outer(length, length)
    return covariance, hidden, (_condition(raw), _condition(unit))


def _condition(information: Array) -> float:
    """Return the condition number of a regressor with this information; infinite if singular."""
    values = np.linalg.eigvalsh(information)
    return float(np.sqrt(values[-1] / values[0])) if values[0] > 0.0 else np.inf


def _com_deviation(prior: Array, covariance: Array) -> float:
    """Return the root of the summed variances of c = h / m, to first order [m]."""
    mass, com = prior[0], prior[1:4] / prior[0]
    slope = np.hstack((-com[:, None], np.eye(3))) / mass
    block = covariance[:4, :4]
    if not np.all(np.isfinite(block)):
        return np.inf
    return float(np.sqrt(np.trace(slope @ block @ slope.T)))


def _complement(basis: Array) -> Array:
    """Return an orthonormal basis of what is orthogonal to the columns of ``basis``."""
    left, singular, _ = np.linalg.svd(basis, full_matrices=True)
    return left[:, len(singular) :]


def _beyond(hidden: Array, possible: Array) -> Array:
    """Return the part of the hidden directions that another motion could show."""
    inside = possible @ (np.linalg.pinv(possible) @ hidden)
    left, singular, _ = np.linalg.svd(inside, full_matrices=False)
    return left[:, singular > 1e-6]


def _words(problem: ExcitationProblem, space: Array) -> tuple[str, ...]:
    if space.shape[1] == 0:
        return ()
    return describe(space, problem.scale, spatial.PARAMETER_NAMES)


def prediction_lines(prediction: Prediction, sigma: Array) -> Iterator[str]:
    """Yield the lines ``--plan-only`` prints.

    Args:
        prediction: of the trajectory.
        sigma: (rows,) torque noise it was made for [N m].
    """
    noise = ", ".join(f"{value:g}" for value in np.unique(sigma))
    yield f"Predicted standard deviations ({prediction.n_samples} samples, noise {noise} N·m):"
    yield from _parameter_lines(prediction)
    yield (
        f"Condition number: {prediction.condition_number:.1f} "
        f"({prediction.scaled_condition_number:.1f} with columns of unit length)"
    )
    yield "Peaks (share of limit):"
    yield from _joint_lines(prediction)
    yield _clearance_line(prediction.limit_check)
    yield from _excess_lines(prediction.limit_check)
    yield from _advice_lines(prediction)


def _parameter_lines(prediction: Prediction) -> Iterator[str]:
    units = ("kg", *["kg·m"] * 3, *["kg·m²"] * 6)
    rows = zip(spatial.PARAMETER_NAMES, prediction.deviation, prediction.share, units)
    for name, deviation, share, unit in rows:
        if np.isfinite(deviation):
            yield f"  {name:3s} {deviation:9.2e} {unit:6s} {100.0 * share:8.3g} %"
        else:
            yield f"  {name:3s} not identified"
    if np.isfinite(prediction.com_deviation):
        yield f"  centre of mass {1000.0 * prediction.com_deviation:.3g} mm"


def _joint_lines(prediction: Prediction) -> Iterator[str]:
    check = prediction.limit_check
    peaks = np.stack((check.velocity, check.acceleration, check.torque))
    width = max(len(name) for name in prediction.joint_names)
    for j, name in enumerate(prediction.joint_names):
        parts = [
            f"{label} {peak:6.2f}{_share_text(peak, limit)}"
            for label, peak, limit in zip(
                ("velocity", "acceleration", "torque"), peaks[:, j], prediction.limits[:, j]
            )
        ]
        reach = f"{check.lowest[j]:+.2f} to {check.highest[j]:+.2f}"
        yield f"  {name:{width}s}  position {reach}  {'  '.join(parts)}"


def _share_text(peak: float, limit: float) -> str:
    return f" ({100.0 * peak / limit:3.0f} %)" if np.isfinite(limit) else " (no limit)"


def _clearance_line(check: LimitCheck) -> str:
    if not np.isfinite(check.closest.distance):
        return "Clearance: nothing comes near"
    return (
        f"Clearance: {1000.0 * check.closest.distance:.1f} mm between {check.closest.label} "
        f"at {check.closest_time:.2f} s"
    )


def _excess_lines(check: LimitCheck) -> Iterator[str]:
    for excess in check.excesses:
        yield f"NOT KEPT: {excess}"


def _advice_lines(prediction: Prediction) -> Iterator[str]:
    """Say what stays unknown, and what would show it."""
    for what in prediction.never:
        yield (
            f"No motion of these joints shows {what}: use --torques chain if only the last joint "
            "is used now, or mount the base at another angle"
        )
    for what in prediction.unseen:
        yield (
            f"This motion does not show {what}: move more joints (--excitation optimal does), or "
            "make it longer"
        )
    for k in prediction.loose:
        factor = (prediction.share[k] / LOOSE_SHARE) ** 2
        yield (
            f"{spatial.PARAMETER_NAMES[k]} stays loose ({100.0 * prediction.share[k]:.0f} %): "
            f"{100.0 * LOOSE_SHARE:.0f} % would take {factor:.1f} times the duration, or faster "
            "motion (higher speed limits, --harmonics)"
        )
