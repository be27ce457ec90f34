"""Checks of a motor trajectory against a model of the arm: contacts, torques, gravity.

Between two rows position, velocity and torque change in a straight line, as the player sends them;
the straight lines between the rows are compared with the model's bodies. The torque that is fed
forward is compared with what the motion needs, and that with what the motors can do.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from robot_sysid.damiao.checks.findings import note, stop
from robot_sysid.damiao.checks.motion import torque_bursts
from robot_sysid.damiao.checks.preflight import SMALLER, StatedLimits, limit_checks
from robot_sysid.damiao.joints import peak_torques
from robot_sysid.damiao.safety.holding import torque_doubt, weight_errors
from robot_sysid.damiao.settings import Plan
from robot_sysid.damiao.trajectory import DamiaoTrajectory
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.motion.limit_check import first_contact
from robot_sysid.motion.problem import ExcitationProblem
from robot_sysid.motion.trajectories import LineTrajectory
from robot_sysid.records import Array, Limits, Motion, RobotModel
from robot_sysid.records.messages import Remark
from robot_sysid.records.usual_errors import EXPECTED_SCALES, LINK
from robot_sysid.wording import with_option_names

# Remedy for an arm that needs more torque than its model says, or than its motors make.
_WEIGH_FIRST = "weigh the arm with a smaller motion first (see {for_=weight} of plan)"


ERROR_ROWS = 1000
"""Number of rows in which the errors of the weight are computed: ten a second of a long motion."""
COMMON_FACTOR = 1.5
"""Factor between the torques of a file and those of a model, the same at all loaded joints, from
which on the torques are wrong: gear ratios, torque constants and units make such factors, and no
load does. Masses of models are 20 % off as a rule, 40 % at most."""
BURST_SHARE_BY_MODEL = 0.25
"""Share of a motor's peak torque by which a torque may be away from the model's, beyond what the
rows around it are: less than without a model, whose torque is right but for load and friction."""
USUAL_DIFFERENCE = EXPECTED_SCALES[0] * LINK / 100.0
"""Share of a joint's torque by which the file of one model usually differs from another model of
the arm: that by which a link's mass is expected to be off, 20 %."""

SHORTEST_WAY = 0.02
"""Angle that some joint has to move by before the way to the first point is looked at [rad]: bodies
that touch on a shorter way touch where the arm stands, and the model has a contact too many."""
FOREIGN_ERROR = 0.8
"""Error of a file's torque, over the torque that the motion needs (rms), from which on it is that
of another motion or arm. The error is 1 without any torque, 2 with the other sign, and 0.5 where a
new load doubles the torque of a joint: a judgement between."""


def with_weight_of(robot: RobotModel, trajectory: DamiaoTrajectory) -> DamiaoTrajectory:
    """Return a trajectory with the torques that carry and accelerate a model's arm in it.

    The accelerations are those of the file's velocities. The model's friction and damping are left
    out: they are the part of a model that is least like its arm.
    """
    motion = Motion(trajectory.time, trajectory.q, trajectory.qd, trajectory.qdd)
    dynamics = ArmDynamics(robot)
    weight, inertia = dynamics.weight_and_inertia(motion)
    # Errors of links bend no faster than the path: one row in so many tells them.
    few = np.linspace(0, len(trajectory.time) - 1, num=ERROR_ROWS).round().astype(int)
    errors = weight_errors(robot, trajectory.q[few]).T
    error = np.stack(
        [np.interp(trajectory.time, trajectory.time[few], each) for each in errors], 1
    )
    return replace(
        trajectory,
        weight=weight,
        inertia=inertia,
        weight_error=error,
        weight_slope=dynamics.weight_slopes(trajectory.q[few]),
        foreign_weight=None,
    )


def transfer_checks(
    problem: ExcitationProblem, begin: Array, end: Array
) -> Iterator[Remark]:
    """Yield a stop where the arm touches something on its way to the trajectory's first point.

    The way is the line between two poses (n,) [rad]; one below ``SHORTEST_WAY`` is not looked at.
    """
    if np.max(np.abs(end - begin)) <= SHORTEST_WAY:
        return
    contact = first_contact(problem, LineTrajectory(begin, end))
    if contact is not None:
        yield stop(
            f"on the way to the first point the model's {contact.label} touch; bring the arm "
            "nearer by hand"
        )


def contact_checks(plan: Plan, problem: ExcitationProblem) -> Iterator[Remark]:
    """Yield a stop where bodies of the model, or the user's obstacles, touch along a trajectory.

    Notes name what the model does not limit. ``problem`` has the arm of the model, its geometry and
    obstacles.
    """
    yield from map(note, problem.missing_limits)
    contact = first_contact(problem, plan.trajectory)
    if contact is not None:
        time = contact.time / plan.settings.speed
        remedy = plan.remedy or SMALLER
        yield stop(f"the model's {contact.label} touch at {time:.2f} s; {remedy}")


def torque_checks(plan: Plan, robot: RobotModel) -> Iterator[Remark]:
    """Yield a stop for each joint whose motion needs more torque than its motor can make.

    Further stops are yielded where the file feeds forward another torque than the motion needs, and
    notes where it differs by more than models of an arm usually do. The needed torques are those of
    ``robot``, the model of the arm.
    """
    arm = ArmDynamics(robot)
    trajectory = plan.trajectory
    joints = trajectory.joints
    speed = plan.settings.speed
    q, qd, qdd = trajectory.q, trajectory.qd, trajectory.qdd
    weigh_first = with_option_names(_WEIGH_FIRST)
    needed = arm(Motion(trajectory.time, q, speed * qd, speed**2 * qdd))
    most = StatedLimits(
        Limits(torque=peak_torques(joints)),
        "what its motor can do",
        f"the motion needs it by the model, it cannot follow; {weigh_first}",
    )
    yield from limit_checks(replace(trajectory, tau=needed), speed, [most])
    # The torque in the file is that of the file's own speed.
    at_full_speed = arm(Motion(trajectory.time, q, qd, qdd))
    needed_rms = np.sqrt(np.mean(at_full_speed**2, axis=0))
    error = np.sqrt(np.mean((trajectory.tau - at_full_speed) ** 2, axis=0))
    # Torque (n,) that friction alone may explain [N m].
    doubt = torque_doubt(joints) + robot.friction.largest_dry
    is_foreign = (error > doubt) & (error > FOREIGN_ERROR * needed_rms)
    factor = common_torque_factor(trajectory.tau, at_full_speed, doubt)
    if factor is not None:
        yield stop(
            f"the torque that the file feeds forward is {factor:.2g} times that of "
            f"{robot.path.name} at all loaded joints: a unit, a gear ratio or a torque constant; "
            f"export the file again for this arm, or {weigh_first}"
        )
        return
    bounds = BURST_SHARE_BY_MODEL * peak_torques(joints) + robot.friction.largest_dry
    bursts = torque_bursts(trajectory, trajectory.tau - at_full_speed, bounds)
    for burst in bursts:
        by_model = at_full_speed[burst.row, burst.joint]
        yield stop(
            f"{joints[burst.joint].label}: the torque in the file is "
            f"{by_model + burst.torque:.3g} N·m at {trajectory.place(burst.row)}, where "
            f"{robot.path.name} needs {by_model:.3g} and the rows around it are "
            f"{by_model + burst.smooth:.3g}; export the file again"
        )
    for j in np.flatnonzero(is_foreign):
        yield stop(
            f"{joints[j].label}: the torque that the file feeds forward is that of another motion "
            f"or arm: it is off by {error[j]:.1f} N·m where {robot.path.name} needs "
            f"{needed_rms[j]:.1f} (rms), and it cannot follow; export the file again for this arm, "
            f"or {weigh_first}"
        )
    # What is fed is the model's torque: where links are as far off as they usually are, no word.
    is_other = (error > doubt) & (error > USUAL_DIFFERENCE * needed_rms) & ~is_foreign
    for j in np.flatnonzero(is_other):
        yield note(
            f"{joints[j].label}: the torque that {robot.path.name} needs is fed, and not that of "
            f"the file, which differs by {error[j]:.1f} N·m of {needed_rms[j]:.1f} (rms); if the "
            "file is right, give the model that it was made with"
        )


def common_torque_factor(file: Array, needed: Array, doubt: Array) -> float | None:
    """Return the factor by which torques are those of a model at all loaded joints, if too large.

    None where it is within ``COMMON_FACTOR``, where joints have different ones, as a load makes
    them, where fewer than two joints are loaded, or where a factor does not explain the difference.

    Args:
        file: torques (N, n) of the file [N m].
        needed: torques (N, n) of the same motion by the model [N m].
        doubt: torque (n,) that friction alone may explain [N m].
    """
    size = np.sqrt(np.mean(needed**2, axis=0))
    is_loaded = size > doubt
    if np.sum(is_loaded) < 2:
        return None
    file = file[:, is_loaded]
    needed = needed[:, is_loaded]
    size = size[is_loaded]
    factors = np.sum(file * needed, axis=0) / np.sum(needed**2, axis=0)
    factor = float(np.median(factors))
    # To two decimals: those of the file are rounded.
    if round(factor, 2) <= COMMON_FACTOR:
        return None
    left = np.sqrt(np.mean((file - factor * needed) ** 2, axis=0))
    # What is left is friction, and how far models of one arm usually differ.
    usual = USUAL_DIFFERENCE * factor * size + doubt[is_loaded]
    is_common = np.all(np.abs(factors / factor - 1.0) < USUAL_DIFFERENCE)
    return factor if is_common and np.all(left < usual) else None
