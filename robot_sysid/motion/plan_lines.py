"""The printed lines on a planned motion and its limits."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robot_sysid.motion.limit_check import LimitCheck
from robot_sysid.motion.problem import ExcitationProblem
from robot_sysid.motion.starts import contact_on_the_way
from robot_sysid.records import LIMITED, Array, LimitUse, MotionPlan
from robot_sysid.records.messages import Detail, percent, position_unit, torque_unit

PER_TIME = ("", "/s", "/s²")
"""What position, velocity and acceleration add to the unit of a position."""


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
    yield "The way from where the arm stands now to its start is not checked"


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
