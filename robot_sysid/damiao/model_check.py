"""Does a motor trajectory stay within what a model of the arm can do?

Between two rows position, velocity and torque change in a straight line, as the player sends them;
so each row is compared with the model's own joint ranges, speeds and torques, and the straight ways
between the rows with its bodies. How fast a joint moves is also told by its positions, whatever the
velocity column says. The torque that is fed forward is compared with what the motion needs, and
that with what the motors can do.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from robot_sysid.damiao.holding import HoldingCheck, torque_doubt
from robot_sysid.damiao.preflight import OK, STOP, Check, Plan
from robot_sysid.damiao.protocol.joints import DamiaoJoint
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.damiao.trajectory import CANNOT_FOLLOW, NO_LIMITS, DamiaoTrajectory
from robot_sysid.errors import InputError
from robot_sysid.motion.limit_check import first_contact
from robot_sysid.motion.options import LimitOptions
from robot_sysid.motion.problem import build_problem
from robot_sysid.motion.trajectories import straight_way
from robot_sysid.motion.two_arms import BetweenArms
from robot_sysid.records import Array, Motion, MotionPlan, RobotModel
from robot_sysid.simulator import ArmTorque

# Relative; for limits and trajectories that came out of the same numbers.
_ROUNDING = 1e-9
# Two positions with four decimals are this far apart from what was meant at most [rad or m].
_PRINTED = 1e-4


class SampledTrajectory:
    """A motor trajectory as a motion plan, at a share of its speed, with the slope between rows."""

    def __init__(self, trajectory: DamiaoTrajectory, speed: float) -> None:
        self.q, self.tau, self.qd = trajectory.q, trajectory.tau, speed * trajectory.qd
        self.time = (trajectory.time - trajectory.time[0]) / speed
        self.slope = np.diff(self.q, axis=0) / np.diff(self.time)[:, None]
        self.duration, self.n_joints = float(self.time[-1]), trajectory.n_joints

    def evaluate(self, time: Array) -> Motion:
        """Return the motion at times (N,) [s]; the acceleration is left at zero."""
        q = np.stack([np.interp(time, self.time, column) for column in self.q.T], axis=1)
        between = np.searchsorted(self.time, time, side="right") - 1
        qd = self.slope[np.clip(between, 0, len(self.slope) - 1)]
        return Motion(time, q, qd, np.zeros_like(q))


def model_checks(
    trajectory: DamiaoTrajectory,
    speed: float,
    robot: RobotModel,
    pose: Array | None = None,
    limits: LimitOptions = NO_LIMITS,
) -> Iterator[Check]:
    """Yield what a model of the arm says to a motor trajectory.

    It is played at a share of its speed. The arm is loaded without a speed limit, so that only its
    own holds, and left in a pose (n,) afterwards [rad]; None where it ends. Of ``limits`` those
    count that only a model can tell. InputError where the trajectory is for another number of
    joints.
    """
    if robot.n_joints != trajectory.n_joints:
        raise InputError(
            f"{trajectory.path} has {trajectory.n_joints} joints but the chain of {robot.path} has "
            f"{robot.n_joints}: {', '.join(robot.joint_names)}"
        )
    motion = SampledTrajectory(trajectory, speed)
    touches = [
        f"the model's {what} touch at {at:.2f} s" for what, at in _contact(robot, motion, limits)
    ]
    excesses = [*_joint_excesses(robot, motion), *touches]
    yield from (Check(STOP, f"{e}; export a smaller trajectory for this arm") for e in excesses)
    parking = [] if pose is None else [*_parking(robot, motion.q[-1], pose, limits)]
    yield from (Check(STOP, f"{excess}; choose another --park pose") for excess in parking)
    if not excesses and not parking:
        yield Check(OK, f"the trajectory stays within the limits of {robot.path.name}")


# So near the arm is there: a contact on so short a way is the model's error [rad].
_THERE = 0.02


def way_checks(plan: Plan, arms: Sequence[RobotModel], here: Array) -> Iterator[Check]:
    """Yield where arms that stand at ``here`` (n,) [rad] touch something on their ways."""
    said = (
        ("from where it stands", "bring the arm nearer to the first point by hand"),
        ("from the last point", "choose another --park, or let it begin elsewhere"),
    )
    for (words, way), (begin, remedy) in zip(plan.ways(here), said):
        if np.max(np.abs(way.q[-1] - way.q[0])) > _THERE:
            for touching in _touching(way, arms, plan.limits):
                text = f"{words}, straight {begin}, the model's {touching} touch; {remedy}"
                yield Check(STOP, text)


def arm_by_arm(played: DamiaoTrajectory, arms: Sequence[RobotModel]) -> Iterator[DamiaoTrajectory]:
    """Yield what each of the arms does in a trajectory of all of them."""
    begin = 0
    for robot in arms:
        own = slice(begin, begin := begin + robot.n_joints) if len(arms) > 1 else slice(None)
        part = {name: getattr(played, name)[:, own] for name in ("q", "qd", "tau")}
        yield replace(played, joints=played.joints[own], **part)


def _touching(
    way: DamiaoTrajectory, arms: Sequence[RobotModel], limits: LimitOptions
) -> Iterator[str]:
    for robot, alone in zip(arms, arm_by_arm(way, arms)):
        yield from (what for what, _ in _contact(robot, SampledTrajectory(alone, 1.0), limits))
    if len(arms) > 1 and BetweenArms(*arms).touch_at(SampledTrajectory(way, 1.0)) is not None:
        yield "arms"


def _parking(robot: RobotModel, last: Array, pose: Array, asked: LimitOptions) -> Iterator[str]:
    """Yield a sentence for each limit that a pose is beyond, and on a contact on the way there."""
    limits = zip(robot.joint_names, pose, robot.limits.lower, robot.limits.upper)
    for j, (name, q, lower, upper) in enumerate(limits):
        if not lower - _ROUNDING <= q <= upper + _ROUNDING:
            yield (
                f"joint {name} is to be parked at {q:.4g} {_unit('position', robot, j)}, outside "
                f"the model's {lower:g} to {upper:g}"
            )
    for touching, _ in _contact(robot, straight_way(last, pose), asked):
        yield f"on the straight way to where the arm is parked, the model's {touching} touch"


def _joint_excesses(robot: RobotModel, motion: SampledTrajectory) -> Iterator[str]:
    own, shown = robot.limits, np.zeros_like(motion.qd)
    # Up to the next row, if the positions show more than the velocities say.
    shown[:-1] = np.abs(motion.slope) - _PRINTED / np.diff(motion.time)[:, None]
    for what, sign, values, limits in (
        ("position", 1.0, motion.q, own.upper),
        ("position", -1.0, motion.q, own.lower),
        ("velocity", 1.0, np.maximum(np.abs(motion.qd), shown), own.velocity),
        ("torque", 1.0, np.abs(motion.tau), own.torque),
    ):
        for j, row in enumerate(np.argmax(sign * values, axis=0)):
            value, limit = values[row, j], limits[j]
            if sign * value > sign * limit + _ROUNDING * max(abs(limit), 1.0):
                yield (
                    f"joint {robot.joint_names[j]}: {what} {value:.4g} {_unit(what, robot, j)} is "
                    f"beyond the model's limit {limit:g}, at {motion.time[row]:.2f} s"
                )


def _unit(what: str, robot: RobotModel, joint: int) -> str:
    length, force = ("m", "N") if robot.is_slide[joint] else ("rad", "N m")
    return {"position": length, "velocity": f"{length}/s", "torque": force}[what]


def _contact(
    robot: RobotModel, motion: MotionPlan, limits: LimitOptions
) -> Iterator[tuple[str, float]]:
    touched = first_contact(build_problem(robot, limits), motion)
    if touched is not None:
        yield touched.label, touched.time


# How far feed-forward torque is off, of what its motion needs (rms): 1 where there is none, 2 with
# the other sign; 0.5 where a new load doubles what a joint carries. A judgement between them.
_OTHER_TORQUE = 0.8


def torque_checks(
    trajectory: DamiaoTrajectory, settings: PlaySettings, robot: RobotModel
) -> Iterator[Check]:
    """Yield whether the file's torque is what its motion needs, and what the motors can do."""
    time, q, qd, fed = trajectory.time, trajectory.q, trajectory.qd, trajectory.tau
    arm, s, joints = ArmTorque(robot), settings.speed, trajectory.joints
    qdd = np.gradient(qd, time, axis=0)
    needed, slower = arm(Motion(time, q, qd, qdd)), arm(Motion(time, q, s * qd, s * s * qdd))
    doubt = torque_doubt(joints) + robot.friction.coulomb
    off, due, sent = (np.sqrt(np.mean(x * x, axis=0)) for x in (fed - needed, needed, fed))
    lacking, most = np.abs(slower - fed).max(axis=0), np.abs(slower).max(axis=0)
    strongest = np.array([j.spec.peak_torque * j.torque_ratio for j in joints])
    for j in np.flatnonzero(most > strongest).tolist():
        said = f"the motion needs {most[j]:.1f} N m and its motor makes {strongest[j]:g} at most"
        yield Check(STOP, f"{joints[j].label}: {said}; {CANNOT_FOLLOW}, play a smaller motion")
    for j in np.flatnonzero((off > doubt) & (off > _OTHER_TORQUE * due)).tolist():
        against = float(fed[:, j] @ needed[:, j]) < 0.0
        why = "has the other sign" if against else "is another joint's or another arm's"
        yield Check(
            STOP,
            f"{joints[j].label}: the torque that the file feeds forward "
            f"{'is missing' if sent[j] < doubt[j] else why}: it is off by {off[j]:.1f} N m where "
            f"{robot.path.name} needs {due[j]:.1f} (rms), and {CANNOT_FOLLOW}; export the file "
            "again for this arm",
        )
    for j in np.flatnonzero(lacking > np.array(settings.max_torque_error)).tolist():
        yield Check(
            STOP,
            f"{joints[j].label}: the motion needs {lacking[j]:.1f} N m more or less than the file "
            f"feeds forward, limit {settings.max_torque_error[j]:g}; {CANNOT_FOLLOW}, export the "
            "file again for this arm",
        )


def gravity_check(robot: RobotModel, joints: tuple[DamiaoJoint, ...]) -> HoldingCheck:
    """Return what compares holding torques with the model's gravity."""
    arm = ArmTorque(robot)

    def holding(q: Array) -> Array:
        still = np.zeros((1, len(q)))
        return np.asarray(arm(Motion(np.zeros(1), q[None], still, still))[0])

    needs = f"the model {robot.path.name} needs"
    return HoldingCheck(joints, holding, robot.friction.coulomb, needs)


def arms_apart(
    arms: Sequence[RobotModel], both: DamiaoTrajectory, speed: float, pose: Array | None
) -> Iterator[Check]:
    """Yield whether two arms of a model touch while both move, or on the way to a pose (n,)."""
    motion, between = SampledTrajectory(both, speed), BetweenArms(*arms)
    ways: dict[str, MotionPlan] = {"while both move": motion}
    if pose is not None:
        ways["on the straight way to where they are parked"] = straight_way(motion.q[-1], pose)
    for where, way in ways.items():
        if (at := between.touch_at(way)) is None:
            yield Check(OK, f"the arms do not touch {where}")
        else:
            said = f"the arms touch {where}, at {at:.2f} s; play one after the other"
            yield Check(STOP, said)
