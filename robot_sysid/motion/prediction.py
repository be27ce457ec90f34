"""What a trajectory promises before it is run, and what it does, as numbers and as lines."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.algebra.identifiability import describe
from robot_sysid.motion.information import predicted_information, visible_coordinates
from robot_sysid.motion.limit_check import DISTANCE_RESOLUTION, LimitCheck
from robot_sysid.motion.problem import ASKED, ASSUMED, LIMIT_NAMES, MODEL, ExcitationProblem
from robot_sysid.motion.solids import swept_space
from robot_sysid.motion.static import contact_on_the_way
from robot_sysid.records import Array, Identifiability, MotionPlan
from robot_sysid.records.figures import percent
from robot_sysid.trajectory import TORQUE_MARGIN, sample_count, spread_motion

PREDICTION_RATE_HZ = 100.0
"""Sampling of the motion for the prediction: far above its band, see docs/excitation.md."""
MOST_INSTANTS = 60_000
"""Instants of the motion that are looked at: all of the first ten minutes, or spread over it."""
LOOSE_SHARE = 0.2
"""A predicted standard deviation above this share of the parameter's size is called loose."""
_INVISIBLE = 1e-10
"""Share of the whole signal below which a direction counts as not visible."""
_DIAGONAL, _OFF_DIAGONAL = (0, 4, 7, 9), {5: (4, 7), 6: (4, 9), 8: (7, 9)}
"""Which parameters are compared with themselves: mass and moments; which with two others."""
_SAME_POSE = 1e-6
"""How near to the model's pose a start counts as it [rad or m]."""
_MOST_POSTURES = 3000
"""Postures from which the swept box is found."""


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


Seen = tuple[Array, float]
"""What some equations tell about the terminal link: (information, signal).

The information (10, 10) is about theta in units of ``problem.scale``, nuisances eliminated; the
signal is its trace before they were: what counts as large.
"""


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
    n_samples, scale = sample_count(plan.duration, sample_rate), problem.scale
    covariance, hidden = _inverted(scale, *(seen or _all_samples(problem, plan, n_samples)))
    possible = visible_coordinates(problem) / scale[:, None]
    # What is orthogonal to that, and the part of what is hidden that another motion could show.
    left, singular, _ = np.linalg.svd(possible, full_matrices=True)
    shown = possible @ (np.linalg.pinv(possible) @ hidden)
    inside, part, _ = np.linalg.svd(shown, full_matrices=False)
    never, unseen = (
        describe(space, scale, spatial.PARAMETER_NAMES) if space.shape[1] else ()
        for space in (left[:, len(singular) :], inside[:, part > 1e-6])
    )
    theta = problem.robot.prior.theta
    size = np.where((theta > 0.0) & np.isin(np.arange(10), _DIAGONAL), theta, scale)
    for k, (i, j) in _OFF_DIAGONAL.items():
        size[k] = np.sqrt(size[i] * size[j])
    # The centre of mass c = h / m, to first order.
    slope = np.hstack((-theta[1:4, None] / theta[0], np.eye(3))) / theta[0]
    block = covariance[:4, :4]
    known = np.all(np.isfinite(block))
    com = float(np.sqrt(np.trace(slope @ block @ slope.T))) if known else np.inf
    return Prediction(n_samples, covariance, size, com, never, unseen)


def _all_samples(problem: ExcitationProblem, plan: MotionPlan, n_samples: int) -> Seen:
    motion = spread_motion(plan, MOST_INSTANTS, PREDICTION_RATE_HZ)
    sigma = problem.sigma / np.sqrt(n_samples / len(motion.q))
    information = predicted_information(problem, sigma, np.diag(problem.scale))
    return information.evaluate(motion.q, motion.qd, motion.qdd)[:2]


def _inverted(scale: Array, information: Array, signal: float) -> tuple[Array, Array]:
    """Return covariance of theta and hidden directions (scaled).

    A parameter that a hidden direction contains has infinite variance.
    """
    values, vectors = np.linalg.eigh(information)
    seen = values > _INVISIBLE * signal
    hidden = vectors[:, ~seen]
    root = vectors[:, seen] / np.sqrt(values[seen])
    covariance = np.outer(scale, scale) * (root @ root.T)
    covariance[np.diag_indices(10)] += np.where(np.linalg.norm(hidden, axis=1) > 1e-6, np.inf, 0.0)
    return covariance, hidden


def plan_lines(
    problem: ExcitationProblem, plan: MotionPlan, check: LimitCheck, prediction: Prediction
) -> Iterator[str]:
    """Yield the lines ``robot-sysid plan`` prints.

    Args:
        problem, plan: the arm with its limits, and the motion.
        check, prediction: of this motion.
    """
    noise = ", ".join(f"{value:g}" for value in np.unique(problem.sigma))
    yield f"Predicted standard deviations ({prediction.n_samples} samples, noise {noise} N·m):"
    if prediction.counted:
        yield f"  {prediction.counted}"
    yield from _parameter_lines(prediction)
    shown = prediction.shown
    if shown is not None:
        scaled = f"({shown.scaled_condition_number:.1f} with columns of unit length)"
        yield f"Condition number: {shown.condition_number:.1f} {scaled}"
    yield from motion_lines(problem, plan, check)
    yield from _advice_lines(prediction)


def motion_lines(problem: ExcitationProblem, plan: MotionPlan, check: LimitCheck) -> Iterator[str]:
    """Yield what a motion does beside its limits; arguments as in ``plan_lines``."""
    yield "Peaks (share of limit):"
    yield from _joint_lines(problem, check)
    yield from _origin_lines(problem)
    yield from _space_lines(problem, plan, check)
    yield from _load_lines(problem, plan)
    yield from _start_lines(problem, plan)
    yield from (f"NOT KEPT: {excess}" for excess in check.excesses)


def _parameter_lines(prediction: Prediction) -> Iterator[str]:
    """Say what noise alone leaves, then what else an identification will not know of the arm."""
    units = ("kg", *["kg·m"] * 3, *["kg·m²"] * 6)
    rows = zip(spatial.PARAMETER_NAMES, prediction.deviation, prediction.share, units)
    for name, deviation, share, unit in rows:
        if np.isfinite(deviation):
            yield f"  {name:3s} {deviation:9.2e} {unit:6s} {percent(share):>10s}"
        else:
            yield f"  {name:3s} not identified"
    if np.isfinite(prediction.com_deviation):
        yield f"  centre of mass {1000.0 * prediction.com_deviation:.3g} mm"
    shares = zip(spatial.PARAMETER_NAMES, prediction.stated, prediction.size)
    known = [f"{name} {percent(e / size)}" for name, e, size in shares if np.isfinite(e)]
    if known:
        yield (
            "An identification of one recording will state more, for errors of the model, torque "
            f"scales, joint zeros and friction: {', '.join(known)}"
        )


def _joint_lines(problem: ExcitationProblem, check: LimitCheck) -> Iterator[str]:
    peaks = check.joints[1:]
    width = max(len(name) for name in problem.joint_names)
    limits = problem.limits.largest[1:]
    for j, name in enumerate(problem.joint_names):
        parts = [
            f"{label} {peak:6.2f}{_share_text(peak, limit)}"
            for label, peak, limit in zip(LIMIT_NAMES[1:], peaks[:, j], limits[:, j])
        ]
        reach = f"{check.lowest[j]:+.2f} to {check.highest[j]:+.2f}"
        yield f"  {name:{width}s}  position {reach}  {'  '.join(parts)}"
    share = _share_text(check.tool_speed, problem.limits.tool_speed)
    yield f"Fastest point of the tool: {check.tool_speed:.2f} m/s{share} at {check.time[-1]:.2f} s"


def _share_text(peak: float, limit: float) -> str:
    return f" ({100.0 * peak / limit:3.0f} %)" if np.isfinite(limit) else " (no limit)"


def _origin_lines(problem: ExcitationProblem) -> Iterator[str]:
    """Say which limits are the model's, which were asked for, and which are assumed."""
    for origin, words in (
        (MODEL, "Limits of the model"),
        (ASKED, "Limits that were asked for"),
        (ASSUMED, "Limits assumed, not the model's"),
    ):
        parts = [_of_joints(problem, name, origin) for name in LIMIT_NAMES]
        listed = "; ".join(part for part in parts if part)
        if listed:
            yield f"{words}: {listed}"


def _of_joints(problem: ExcitationProblem, family: str, origin: str) -> str:
    """Return "velocity 2 of joint0, joint1" for the limits of a family with one origin, or ""."""
    chosen = [j for j, each in enumerate(problem.origins[family]) if each == origin]
    if not chosen:
        return ""
    everywhere = len(chosen) == problem.n_joints
    names = "all joints" if everywhere else ", ".join(problem.joint_names[j] for j in chosen)
    if family == "position":
        return f"position of {names}"
    limit = problem.limits.largest[LIMIT_NAMES.index(family), chosen]
    limit = limit / TORQUE_MARGIN if family == "torque" else limit
    return f"{family} {', '.join(f'{value:.4g}' for value in np.unique(limit))} of {names}"


def _space_lines(problem: ExcitationProblem, plan: MotionPlan, check: LimitCheck) -> Iterator[str]:
    """Say where the moving parts get to, and what comes near what."""
    lower, upper, lowest = swept_space(problem.robot, spread_motion(plan, _MOST_POSTURES).q)
    # Rounded outwards, to a centimetre.
    lower, upper = np.floor(100.0 * lower) / 100.0, np.ceil(100.0 * upper) / 100.0
    sides = [f"{axis} {low:+.2f} to {high:+.2f}" for axis, low, high in zip("xyz", lower, upper)]
    yield f"Swept box: {', '.join(sides)} m; the lowest point is one of {lowest}"
    if not problem.has_floor:
        below = max(0.0, -float(lower[2]))
        reach = f"gets {below:.2f} m below z = 0" if below else "stays above z = 0"
        advice = "--keep-out 0 0 1 0 keeps all parts above it"
        yield f"The model has no floor: this motion {reach}; {advice}"
    nearest, tightest = check.nearest, check.closest
    if np.isfinite(nearest.distance):
        place = f"between {nearest.label} at {nearest.time:.2f} s"
        yield f"Clearance: {_at_least(nearest.distance, check.resolution)} mm {place}"
    else:
        yield "Clearance: nothing comes near"
    if np.isfinite(tightest.distance) and tightest.label != nearest.label:
        room = f"{1000.0 * tightest.slack:.1f} mm more than required"
        yield f"Least room: {room}, between {tightest.label} at {tightest.time:.2f} s"
    neighbours = problem.obstacles.neighbours
    if np.isfinite(neighbours.distance):
        apart = _at_least(neighbours.distance)
        yield f"No motion brings these nearer than {apart} mm: {neighbours.label}"


def _at_least(distance: float, resolution: float = DISTANCE_RESOLUTION) -> str:
    """Return a distance in mm, rounded so that nothing comes nearer."""
    return f"{np.floor(1e4 * (distance - resolution) + 1e-6) / 10.0:.1f}"


def _load_lines(problem: ExcitationProblem, plan: MotionPlan) -> Iterator[str]:
    """Say what load the torque limits leave room for."""
    if not np.any(np.isfinite(problem.limits.torque)):
        return
    left, joint = problem.load_left(spread_motion(plan, _MOST_POSTURES))
    name, kept = problem.joint_names[joint], problem.reserve
    reserved = f" (--payload-reserve {kept:g} kept)" if kept > 0.0 else ""
    room = np.floor(100.0 * left) / 100.0
    yield f"Torque left: a load of {room:.2f} kg at the tool's tip, then {name} is full{reserved}"


def _start_lines(problem: ExcitationProblem, plan: MotionPlan) -> Iterator[str]:
    """Say where the motion starts, and what is known of the way there."""
    start, home = plan.evaluate(np.zeros(1)).q[0], problem.robot.reference
    pose = ", ".join(f"{name} {q:.3f}" for name, q in zip(problem.joint_names, start))
    if np.allclose(start, home, atol=_SAME_POSE):
        yield f"Start: the model's pose at rest, {pose}"
    else:
        touched = contact_on_the_way(problem, start)
        way = "free" if touched is None else f"NOT free, by the clearance of {touched}"
        yield f"Start: {pose}"
        yield f"  the straight way in joint space there from the model's pose at rest is {way}"
    yield "  the way there from where the arm stands now is no part of this motion, and not checked"


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
            f"{spatial.PARAMETER_NAMES[k]} stays loose ({percent(prediction.share[k])}): "
            f"{100.0 * LOOSE_SHARE:.0f} % would take {factor:.1f} times the duration, or faster "
            "motion (higher speed limits)"
        )
