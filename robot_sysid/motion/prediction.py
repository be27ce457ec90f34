"""What a trajectory promises before it is run, and what it does, as numbers and as lines."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.motion.information import spread_of
from robot_sysid.motion.limit_check import DISTANCE_RESOLUTION, LimitCheck
from robot_sysid.motion.problem import (
    ASKED,
    ASSUMED,
    LIMIT_NAMES,
    MODEL,
    RESERVE_WORDS,
    ExcitationProblem,
)
from robot_sysid.motion.solids import swept_space
from robot_sysid.motion.static import contact_on_the_way
from robot_sysid.records import Array, MotionPlan
from robot_sysid.records.messages import PARAMETER_UNITS, Detail, percent
from robot_sysid.trajectory import TORQUE_MARGIN, spread_motion

LOOSE_SHARE = 0.2
"""A predicted standard deviation above this share of the parameter's size is called loose."""
_TOLD_PART = 0.2
"""Part of the whole error from which a cause is told: 4 % of its square."""
_DIAGONAL = (0, 4, 7, 9)
_OFF_DIAGONAL = {5: (4, 7), 6: (4, 9), 8: (7, 9)}
"""Which parameters are compared with themselves: mass and moments; which with two others."""
_SAME_POSE = 1e-6
"""How near to the model's pose a start counts as it [rad or m]."""
_MOST_POSTURES = 3000
"""Postures from which the swept box is found."""
WEIGHED = 1.0
"""Mass of the payload whose centre of mass is promised [kg]."""


@dataclass(frozen=True)
class Remedy:
    """What would change the errors: in words, with those of mass [kg] and centre of mass [m].

    The options, if any, plan a motion that does.
    """

    words: str
    mass: float
    centre: float
    options: tuple[str, ...] = ()


@dataclass(frozen=True)
class Prediction:
    """What an identification of one recording of a trajectory will state.

    Attributes:
        of: what it is about, in words.
        theta: (10,) of that body.
        size: (10,) magnitude each parameter is compared with: its own value in the model, for a
            first moment m L, for a product of inertia sqrt(Iii Ijj).
        covariance: (10, 10) of theta; infinite on the diagonal where the model's value stays.
        causes: cause to its part (10, 10).
        others: every other link's name to the share that its mass will be known to.
        never: what no motion of these joints can show, in words.
        remedies: what would tell more, what helps most first.
        missing: why it is only a bound, from all samples; "" where it is none.
        scaled: share of a payload's own mass that torque scales leave open beside.
        doubt: how often all torque scales are doubted, with the errors that are stated then.
    """

    of: str
    theta: Array
    size: Array
    covariance: Array
    causes: Mapping[str, Array]
    others: Mapping[str, float]
    never: tuple[str, ...]
    remedies: tuple[Remedy, ...] = ()
    missing: str = ""
    scaled: float = 0.0
    doubt: Remedy | None = None

    @property
    def deviation(self) -> Array:
        """Predicted standard deviation of each parameter (10,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def share(self) -> Array:
        """Predicted standard deviation as share of each parameter's size (10,)."""
        return self.deviation / self.size

    @property
    def mass_share(self) -> float:
        """Predicted standard deviation of the mass as share of the mass; infinite if not seen."""
        return self.spread(self.covariance)[0] / float(self.size[0])

    def remedy_options(self) -> tuple[str, ...]:
        """Return the options of the motion that would know the mass best; none without one."""
        planned = [remedy for remedy in self.remedies if remedy.options]
        return min(planned, key=lambda remedy: remedy.mass).options if planned else ()

    def budget(self) -> Iterator[tuple[str, float, float]]:
        """Yield (cause, its part of the error of the mass [kg], of the centre of mass [m])."""
        found = [(cause, *self.spread(part)) for cause, part in self.causes.items()]
        yield from sorted(found, key=lambda each: -each[1])

    def spread(self, covariance: Array) -> tuple[float, float]:
        """Return the deviations of mass [kg] and centre of mass [m] that a covariance makes."""
        if not np.all(np.isfinite(covariance[:4, :4])):
            return float(np.sqrt(covariance[0, 0])), np.inf
        return spread_of(self.theta, covariance)


def sizes(problem: ExcitationProblem) -> Array:
    """Return (10,) the magnitudes that errors of the terminal link are compared with."""
    theta = problem.robot.prior.theta
    scale = problem.scale
    size = np.where((theta > 0.0) & np.isin(np.arange(10), _DIAGONAL), theta, scale)
    for k, (i, j) in _OFF_DIAGONAL.items():
        size[k] = np.sqrt(size[i] * size[j])
    return size


def plan_lines(
    problem: ExcitationProblem,
    plan: MotionPlan,
    check: LimitCheck,
    prediction: Prediction,
) -> Iterator[str]:
    """Yield the lines ``robot-sysid plan`` prints; those that are a ``Detail`` on demand."""
    yield from kept_lines(problem, plan, check)
    yield from _promise_lines(prediction)
    yield from _advice_lines(prediction)
    yield from motion_lines(problem, plan, check)


def kept_lines(
    problem: ExcitationProblem, plan: MotionPlan, check: LimitCheck
) -> Iterator[str]:
    """Say whether the motion may be played, and how near it comes to the arm and what is around."""
    if check.holds:
        nearest = check.nearest
        near = "nothing comes near"
        if np.isfinite(nearest.distance):
            near = f"least distance {_at_least(nearest.distance, check.resolution)} mm"
            near = f"{near}, between {nearest.label}"
        yield f"Keeps all limits for {plan.duration:.1f} s; {near}"
    yield from (f"NOT KEPT: {excess}" for excess in check.excesses)
    if any(excess.limit.endswith(RESERVE_WORDS) for excess in check.excesses):
        yield "The reserve is for links known to --link-uncertainty; better known ones need less"


def _promise_lines(prediction: Prediction) -> Iterator[str]:
    """Say what an identification will state, and what of it comes from what."""
    yield f"An identification of one recording will state, of {prediction.of}:"
    if prediction.missing:
        yield f"  {prediction.missing}"
    mass, centre = prediction.spread(prediction.covariance)
    parts = [
        p for p in prediction.budget() if max(p[1] / mass, p[2] / centre) > _TOLD_PART
    ]
    if np.isfinite(mass):
        of_mass = ", ".join(f"{cause} {part:.2g}" for cause, part, _ in parts)
        part = percent(mass / prediction.size[0])
        if prediction.scaled:
            part = f"{part}, and {percent(prediction.scaled)} for torque scales"
        yield f"  mass ± {mass:.2g} kg ({part}): {of_mass}"
    if np.isfinite(centre):
        of_centre = ", ".join(f"{cause} {1e3 * part:.2g}" for cause, _, part in parts)
        yield f"  centre of mass ± {1e3 * centre:.2g} mm: {of_centre}"
    if prediction.doubt:
        yield f"  {prediction.doubt.words}: {remedy_figures(prediction.doubt)}"
    pairs = list(zip(spatial.PARAMETER_NAMES, prediction.share))
    shown = ", ".join(
        f"{name} {percent(share)}" for name, share in pairs if np.isfinite(share)
    )
    if shown:
        yield f"  {shown}"
    hidden = [name for name, share in pairs if not np.isfinite(share)]
    if hidden:
        yield f"  not identified: {', '.join(hidden)}"
    if prediction.others:
        listed = ", ".join(
            f"{name} {percent(s)}" for name, s in prediction.others.items()
        )
        yield f"  mass of the other links: {listed}"
    for name, deviation, unit in zip(
        spatial.PARAMETER_NAMES, prediction.deviation, PARAMETER_UNITS
    ):
        if np.isfinite(deviation):
            yield Detail(f"  {name:3s} ± {deviation:9.2e} {unit}")


def _advice_lines(prediction: Prediction) -> Iterator[str]:
    """Say what stays unknown, and what would show it."""
    for what in prediction.never:
        yield (
            f"No motion of these joints shows {what}: use --torques chain if only the last joint "
            "is used now, or mount the base at another angle"
        )
    loose = [
        f"{name} {percent(share)}"
        for name, share in zip(spatial.PARAMETER_NAMES, prediction.share)
        if LOOSE_SHARE < share < np.inf
    ]
    if loose:
        yield f"Stays loose: {', '.join(loose)}"
    for number, remedy in enumerate(prediction.remedies):
        line = f"{remedy.words}: {remedy_figures(remedy)}"
        yield (
            f"What would help first: {line}" if number == 0 else Detail(f"  or {line}")
        )


def remedy_figures(remedy: Remedy) -> str:
    """Return the errors that something leads to, in words."""
    mass = (
        f"mass ± {remedy.mass:.2g} kg, " if remedy.mass else ""
    )  # none where it is known
    return f"{mass}centre of mass ± {1e3 * remedy.centre:.2g} mm"


def motion_lines(
    problem: ExcitationProblem, plan: MotionPlan, check: LimitCheck
) -> Iterator[str]:
    """Yield what a motion does beside its limits."""
    lines = (
        ["Peaks (share of limit):"],
        _joint_lines(problem, check),
        _origin_lines(problem),
        _space_lines(problem, plan, check),
        _load_lines(problem, plan),
    )
    yield from (Detail(line) for some in lines for line in some)
    yield from _start_lines(problem, plan)


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
    fastest = check.largest[-1]
    limit = problem.limits.tool_speed
    share = _share_text(fastest, limit)
    when = f"at {check.time[-1]:.2f} s"
    yield f"Fastest point of the tool: {fastest:.2f} m/s{share} {when}"


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
    names = (
        "all joints"
        if everywhere
        else ", ".join(problem.joint_names[j] for j in chosen)
    )
    if family == "position":
        return f"position of {names}"
    limit = problem.limits.largest[LIMIT_NAMES.index(family), chosen]
    limit = limit / TORQUE_MARGIN if family == "torque" else limit
    return (
        f"{family} {', '.join(f'{value:.4g}' for value in np.unique(limit))} of {names}"
    )


def _space_lines(
    problem: ExcitationProblem, plan: MotionPlan, check: LimitCheck
) -> Iterator[str]:
    """Say where the moving parts get to, and what comes near what."""
    lower, upper, lowest = swept_space(
        problem.robot, spread_motion(plan, _MOST_POSTURES).q
    )
    # Rounded outwards, to a centimetre.
    lower = np.floor(100.0 * lower) / 100.0
    upper = np.ceil(100.0 * upper) / 100.0
    sides = [
        f"{axis} {low:+.2f} to {high:+.2f}"
        for axis, low, high in zip("xyz", lower, upper)
    ]
    yield f"Swept box: {', '.join(sides)} m; the lowest point is one of {lowest}"
    if not problem.has_floor:
        below = max(0.0, -float(lower[2]))
        reach = f"gets {below:.2f} m below z = 0" if below else "stays above z = 0"
        advice = "--keep-out 0 0 1 0 keeps all parts above it"
        yield f"The model has no floor: this motion {reach}; {advice}"
    nearest = check.nearest
    tightest = check.closest
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
    """Say what load the torque limits leave room for, and what errors of the links."""
    if not np.any(np.isfinite(problem.limits.torque)):
        return
    motion = spread_motion(plan, _MOST_POSTURES)
    if problem.has_torque_reserve:
        reserves = np.max(problem.torque_reserve(motion), axis=0)
        pairs = zip(problem.joint_names, reserves)
        listed = ", ".join(
            f"{name} {reserve:.2g}" for name, reserve in pairs if reserve > 0.0
        )
        yield f"Torque reserve for errors of the links (--link-uncertainty), up to: {listed}"
    left, joint = problem.load_left(motion)
    name = problem.joint_names[joint]
    kept = problem.reserve
    reserved = f" (--payload-reserve {kept:g} kept)" if kept > 0.0 else ""
    room = np.floor(100.0 * left) / 100.0
    yield f"Torque left: a load of {room:.2f} kg at the tool's tip, then {name} is full{reserved}"


def contact_before(problem: ExcitationProblem, plan: MotionPlan) -> str | None:
    """Say between what a clearance is not kept on the straight way from the model's pose at rest to
    the start of a motion; None where it is free, or the motion starts there.
    """
    start = plan.evaluate(np.zeros(1)).q[0]
    if np.allclose(start, problem.robot.reference, atol=_SAME_POSE):
        return None
    return contact_on_the_way(problem, start)


def _start_lines(problem: ExcitationProblem, plan: MotionPlan) -> Iterator[str]:
    """Say where the motion starts, and what is known of the way there."""
    start = plan.evaluate(np.zeros(1)).q[0]
    pose = ", ".join(f"{name} {q:.3f}" for name, q in zip(problem.joint_names, start))
    if np.allclose(start, problem.robot.reference, atol=_SAME_POSE):
        yield Detail(f"Start: the model's pose at rest, {pose}")
    else:
        touched = contact_before(problem, plan)
        way = "free" if touched is None else f"NOT free, by the clearance of {touched}"
        yield f"Start: {pose}"
        yield f"  the straight way in joint space there from the model's pose at rest is {way}"
    yield "The way there from where the arm stands now is no part of this motion, and not checked"
