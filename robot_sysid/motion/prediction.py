"""The expected errors of an identification from a planned motion, and the printed lines on a plan.

The standard errors that are expected of the estimate are numbers (``Prediction``); all lines that
``robot-sysid plan`` prints about a motion and its limits are written here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from robot_sysid.estimate.fit import NOISE
from robot_sysid.motion.limit_check import LimitCheck
from robot_sysid.motion.problem import ExcitationProblem
from robot_sysid.motion.starts import contact_on_the_way
from robot_sysid.records import LIMITED, Array, LimitUse, MotionPlan
from robot_sysid.records.messages import (
    Detail,
    percent,
    position_unit,
    size_text,
    torque_unit,
)
from robot_sysid.spatial import PARAMETER_NAMES
from robot_sysid.wording import option_setting

PER_TIME = ("", "/s", "/s²")
"""What position, velocity and acceleration add to the unit of a position."""
LEAST_MASS = 1e-4
"""Smallest mass that is written as a number [kg]: no arm shows a tenth of a gram."""
LEAST_MILLIMETRES = 0.01
"""Smallest length that is written as a number [mm]."""
LARGE_SHARE = 0.2
"""Predicted standard error over the parameter's size above which the parameter is named."""


@dataclass(frozen=True)
class ExpectedFile:
    """How far off a written model file is expected to be on motions all over the arm's range.

    Attributes:
        speed: highest speed of these motions.
        speed_unit: its unit.
        before: torque error of the given model over the torque, both root mean squares of all
            joints together; constant torques, which sensors add, are no errors.
        after: the same of the file.
        friction: error of the file's friction over the friction; None where none is estimated.
    """

    speed: float
    speed_unit: str
    before: float
    after: float
    friction: float | None


@dataclass(frozen=True)
class Prediction:
    """Standard errors that are expected of an identification of one recording of a motion.

    Attributes:
        recordings: how the motion is recorded, in words that begin a sentence.
        subject: which body is identified, in words.
        size: (10,) magnitude that each error is compared with: m, m L and m L^2 with a length L
            of the body.
        errors: (10,) of its parameters; infinite where the model's value stays.
        by_cause: cause of errors to the errors that it alone makes of the mass [kg] and of the
            centre of mass [m].
        link_mass_errors: name of every other link to the standard error of its mass over its mass.
        invisible: combinations of parameters that no motion of these joints shows, in words.
        file: what the written file is expected to be; None where a payload is weighed.
    """

    recordings: str
    subject: str
    size: Array
    errors: Array
    by_cause: Mapping[str, tuple[float, float]]
    link_mass_errors: Mapping[str, float]
    invisible: tuple[str, ...]
    file: ExpectedFile | None = None

    @property
    def relative_mass_error(self) -> float:
        """Predicted standard error of the mass over the mass; infinite if not identified."""
        return float(self.errors[0] / self.size[0])

    def relative_mass_error_after(self, factor: float) -> float:
        """Return what it is if the motion lasts so many times as long, and shows as much a second.

        Noise averages out, what the model does not explain stays.
        """
        variances = {cause: mass**2 for cause, (mass, _) in self.by_cause.items()}
        variances[NOISE] = variances.get(NOISE, 0.0) / factor
        return float(math.sqrt(sum(variances.values())) / self.size[0])

    @property
    def centre_error(self) -> float:
        """Predicted standard error of the centre of mass [m]; infinite if not identified."""
        if not np.all(np.isfinite(self.errors[:4])):
            return np.inf
        return math.hypot(*(centre for _, centre in self.by_cause.values()))


def limit_lines(
    problem: ExcitationProblem, plan: MotionPlan, check: LimitCheck
) -> Iterator[str]:
    """Yield a line with the pair that has the least room where the motion keeps all limits, else a
    line for each limit that it breaks.

    Further lines name the links that no distance is known of, and the joints without torque limit.
    """
    closest = check.closest
    if not check.excesses:
        nearness = ""
        if np.isfinite(closest.distance):
            room = _distance_text(closest.distance)
            nearness = f"; least room between {closest.label}, {room}"
        yield f"Keeps all limits for {plan.duration:.1f} s{nearness}"
    for sentence in problem.missing_limits:
        yield sentence[0].upper() + sentence[1:]
    for excess in check.excesses:
        yield f"NOT KEPT: {excess_text(excess)}"


def _distance_text(distance: float) -> str:
    """Return how far apart two bodies are, in words and whole millimetres.

    ``distance`` is negative of bodies that are inside each other, as parked arms are.
    """
    millimetres = round(1e3 * distance)
    if millimetres > 0:
        return f"about {millimetres} mm apart"
    if millimetres == 0:
        return "which touch (0 mm)"
    return f"which are {-millimetres} mm inside each other, as at rest"


def excess_text(excess: LimitUse) -> str:
    """Return which limit is not kept, by how much, and when."""
    over = percent(excess.share - 1.0)
    return f"{excess.name} ({over} over at {excess.time:.2f} s)"


def file_line(file: ExpectedFile, mass_error: float) -> str:
    """Return how far off a file is expected to be, as a sentence.

    ``mass_error`` is the standard error of the mass of what the last link carries [kg].
    """
    details = []
    if file.friction is not None:
        details.append(f"friction to {percent(file.friction)}")
    if np.isfinite(mass_error):
        details.append(f"a load to ± {_mass_text(mass_error)}")
    sentence = (
        f"After this motion the written file is expected to be {percent(file.after)} off on any "
        f"motion up to {file.speed:.2g} {file.speed_unit} (the model: {percent(file.before)})"
    )
    return "; ".join([sentence, ", ".join(details)]) if details else sentence


def error_lines(prediction: Prediction) -> Iterator[str]:
    """Yield the errors to expect of the written file, those that an identification will state, and
    the largest causes of these.
    """
    if prediction.file is not None:
        yield file_line(prediction.file, float(prediction.errors[0]))
    is_arm = prediction.file is not None
    note = (
        "; the torques that these numbers make together are known better"
        if is_arm
        else ""
    )
    yield (
        f"{prediction.recordings}, it determines {prediction.subject} with these errors{note}:"
    )
    mass = prediction.errors[0]
    centre = prediction.centre_error
    # The causes, the one with the largest error of the mass first.
    causes = sorted(prediction.by_cause.items(), key=lambda cause: -cause[1][0])
    if np.isfinite(mass):
        share = percent(prediction.relative_mass_error)
        yield f"  mass ± {_mass_text(mass)} ({share}), limited by {causes[0][0]}"
    if np.isfinite(centre):
        cause = max(causes, key=lambda cause: cause[1][1])[0]
        yield f"  centre of mass ± {_length_text(centre)}, limited by {cause}"
    if prediction.link_mass_errors:
        listed = ", ".join(
            f"{name} {percent(error)}"
            for name, error in prediction.link_mass_errors.items()
        )
        yield f"  mass of the other links: {listed}"
    uncertain = []
    relative_errors = prediction.errors / prediction.size
    for name, error in zip(PARAMETER_NAMES, relative_errors):
        if error > LARGE_SHARE:
            known = percent(error) if np.isfinite(error) else "not identified"
            uncertain.append(f"{name} {known}")
    if uncertain:
        yield f"  above {percent(LARGE_SHARE)} of their size: {', '.join(uncertain)}"
    for combination in prediction.invisible:
        yield (
            f"No motion of these joints identifies {combination}: use "
            f"{option_setting('torques', 'chain')} if only the last joint is used now, or "
            "mount the base at another angle"
        )
    for cause, (mass_error, centre_error) in causes:
        yield Detail(
            f"  by {cause}: mass {_mass_text(mass_error)}, centre of mass "
            f"{_length_text(centre_error)}"
        )


def _mass_text(kilograms: float) -> str:
    """Return a mass with two digits."""
    return size_text(kilograms, LEAST_MASS, "kg")


def _length_text(metres: float) -> str:
    """Return a length in millimetres with two digits."""
    return size_text(1e3 * metres, LEAST_MILLIMETRES, "mm")


def motion_lines(
    problem: ExcitationProblem, plan: MotionPlan, check: LimitCheck
) -> Iterator[str]:
    """Yield, mostly as details, how a motion uses its limits, and where it starts;
    assumed limits are no detail.
    """
    yield Detail("Largest values, a position from the middle of its range:")
    for use, unit in zip(check.uses, _units_of_uses(problem)):
        numbers = f"{abs(use.value):.2f} {unit}"
        if np.isfinite(use.limit):
            numbers = f"{abs(use.value):.2f} of {abs(use.limit):.2f} {unit}"
        yield Detail(f"  {numbers} at {use.time:.2f} s: {use.name}")
    limits_text = "; ".join(_assumed_limits(problem))
    if limits_text:
        yield f"Limits of this program (check them against the arm's): {limits_text}"
    start = plan.evaluate(np.zeros(1)).q[0]
    pose = ", ".join(_pose_texts(problem, start))
    if np.allclose(start, problem.robot.reference):
        yield Detail(f"Start: the model's pose at rest, {pose}")
    else:
        contact = contact_on_the_way(problem, start)
        state = (
            "free" if contact is None else f"NOT free, by the clearance of {contact}"
        )
        yield f"Start: {pose}"
        yield f"  the straight way in joint space there from the model's pose at rest is {state}"
    yield "The way there from where the arm stands now is no part of this motion, and not checked"


def _units_of_uses(problem: ExcitationProblem) -> list[str]:
    """Return the unit of each limited quantity, in the order of a check's uses."""
    is_slide = problem.robot.is_slide
    units = [
        f"{position_unit(slides)}{per_time}"
        for per_time in PER_TIME
        for slides in is_slide
    ]
    return [*units, *map(torque_unit, is_slide), "m/s"]


def _pose_texts(problem: ExcitationProblem, pose: Array) -> Iterator[str]:
    """Yield each joint's name with its position in a pose (n,) and the unit."""
    for name, q, is_slide in zip(problem.joint_names, pose, problem.robot.is_slide):
        # Adding zero takes the sign from the -0.000 that rounding leaves.
        yield f"{name} {round(q, 3) + 0.0:.3f} {position_unit(is_slide)}"


def _assumed_limits(problem: ExcitationProblem) -> Iterator[str]:
    """Yield the limits that neither the model nor an option states, such as "velocity 2 rad/s of
    joint0, joint1": a real arm may allow less than that.
    """
    largest = problem.limits.largest
    quantities = [*LIMITED]
    joints: dict[str, list[str]] = {}
    for row, joint in np.argwhere(problem.assumed):
        unit = position_unit(problem.robot.is_slide[joint]) + PER_TIME[row]
        limit = f"{quantities[row]} {largest[row, joint]:.4g} {unit}"
        joints.setdefault(limit, []).append(problem.joint_names[joint])
    for limit, names in joints.items():
        is_general = len(names) == problem.n_joints
        yield f"{limit} of {'all joints' if is_general else ', '.join(names)}"
