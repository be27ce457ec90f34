"""Which trajectory the arm moves along: random, designed, or one from a file; and its limits."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from robot_sysid import trajectory
from robot_sysid.errors import InputError
from robot_sysid.model.contacts import CHECK_RATE_HZ, find_new_contacts
from robot_sysid.motion.plan_options import (
    WEIGHT,
    ExcitationOptions,
    LimitOptions,
    PoseOptions,
)
from robot_sysid.records import Motion, MotionPlan, RobotModel
from robot_sysid.records.messages import Detail, Progress
from robot_sysid.records.option_fields import (
    PerJoint,
    TrajectoryOptions,
    given_options,
    require_countable,
)
from robot_sysid.simulator import ArmTorque

if (
    TYPE_CHECKING
):  # A random motion that nothing plays takes none of what checks and designs.
    from robot_sysid.motion.information import Known
    from robot_sysid.motion.limit_check import LimitCheck
    from robot_sysid.motion.problem import ExcitationProblem

LONGEST_CHECKED = 86400.0
"""Length of a motion beyond which its limits are not checked any more [s]."""


@dataclass(frozen=True)
class MotionRequest:
    """What motion is asked for, and what for.

    Attributes:
        torques: "chain" or "terminal": which torques will be used.
        noise_torque: torque noise that is expected [N m]; zero for the usual.
        played: whether something will play the motion.
        poses: whether it rests in poses, and in which.
        known: what an estimate knows of an arm beforehand; None for all but the terminal link.
        outlook: says before a search, from a motion, what no motion tells; "" for nothing.
        link_uncertainty: how far the links may be off [%]; torque is reserved for that.
    """

    trajectory: TrajectoryOptions
    excitation: ExcitationOptions
    limits: LimitOptions
    torques: str = "chain"
    noise_torque: PerJoint = 0.0
    played: bool = False
    poses: PoseOptions = PoseOptions()
    known: Callable[[ExcitationProblem], Known] | None = None
    outlook: Callable[[ExcitationProblem, MotionPlan], str] | None = None
    link_uncertainty: float = 0.0

    @property
    def is_checked(self) -> bool:
        """Whether the motion has to keep all limits: it is played or kept, or limits were given."""
        plan = self.trajectory
        asked = {given.key for given in given_options(self.limits)}
        kept = plan.plan_only or plan.save is not None or plan.file is not None
        return self.played or kept or self.is_designed or bool(asked - {"max_velocity"})

    @property
    def is_designed(self) -> bool:
        """Whether a trajectory is to be designed."""
        return self.excitation.kind == "optimal"


@dataclass(frozen=True)
class CheckedPlan:
    """A trajectory, and what checking it found.

    The problem is the arm and the limits it has to keep; None where nothing plays it.
    """

    plan: MotionPlan
    problem: ExcitationProblem | None = None
    check: LimitCheck | None = None

    @property
    def failure(self) -> str | None:
        """Why the trajectory must not be run, or None."""
        return None if self.check is None else self.check.failure


def make_plan(
    request: MotionRequest, robot: RobotModel, seed: int, progress: Progress
) -> CheckedPlan:
    """Return the trajectory of a run, checked where anything depends on its limits."""
    options = request.trajectory
    if request.is_checked and options.file is None:
        _require_checkable(options.duration / options.speed)
    made = _new_plan(request, robot, seed, progress)
    if options.speed != 1.0:
        from robot_sysid.motion.trajectories import at_speed

        made = CheckedPlan(at_speed(made.plan, options.speed), made.problem)
    require_countable(made.plan.duration, options.sample_rate)
    if made.problem is None:
        for contact in find_new_contacts(robot, _counted(made.plan, progress)):
            progress.note(f"{contact} along this trajectory; do not play it on the arm")
        return made
    _require_checkable(made.plan.duration)
    progress.note(*(() if request.is_designed else made.problem.notes))
    from robot_sysid.motion.limit_check import check_limits

    check = made.check or check_limits(made.problem, made.plan, options.sample_rate)
    return replace(made, check=check)


def _require_checkable(duration: float) -> None:
    """Raise InputError where going along the whole motion [s] would take hours."""
    if not duration <= LONGEST_CHECKED:
        raise InputError(
            f"a motion of {duration:.3g} s takes too long to check against all limits; make it at "
            f"most {LONGEST_CHECKED:g} s long"
        )


def _new_plan(
    request: MotionRequest, robot: RobotModel, seed: int, progress: Progress
) -> CheckedPlan:
    """Return the trajectory with the limits it has to keep; checked where making it took that."""
    options = request.trajectory
    rng = np.random.default_rng(seed)
    if options.file is not None:
        from robot_sysid.motion.trajectories import load_trajectory

        progress.stage(f"Loading excitation trajectory from {options.file}...")
        saved = load_trajectory(options.file)
        saved.require_fits(robot.joint_names)
        if saved.sha256 not in ("", robot.sha256):
            progress.note(
                f"{options.file} was made for another model file; it is checked against the "
                f"limits of {robot.path}"
            )
        return CheckedPlan(saved.plan, _problem(request, robot))
    what = "Designing" if request.is_designed else "Generating"
    stage = f"{what} excitation trajectory ({options.duration:.1f}s, {options.sample_rate:g} Hz)"
    if request.poses.static:
        stage = f"Choosing {request.poses.poses} poses to rest in"
    elif request.poses.sets_its_time:
        stage = "Looking for room to sweep each joint in"
    progress.stage(f"{stage}...")
    if request.poses.sets_its_time:
        from robot_sysid.motion.static import design_poses, design_sweeps

        problem = _problem(request, robot)
        static = request.poses.static
        plan = (
            design_poses(problem, request.poses, rng)
            if static
            else design_sweeps(problem)
        )
        return CheckedPlan(plan, problem)
    return (_designed if request.is_designed else _random)(
        request, robot, rng, progress
    )


def _random(
    request: MotionRequest,
    robot: RobotModel,
    rng: np.random.Generator,
    progress: Progress,
) -> CheckedPlan:
    rate = request.trajectory.sample_rate
    # Ends on a sample, so that the last one is at rest.
    duration = (trajectory.sample_count(request.trajectory.duration, rate) - 1) / rate
    problem = _problem(request, robot) if request.is_checked else None
    arm = robot
    if problem is not None:
        torque = problem.limits.torque / trajectory.TORQUE_MARGIN
        qpos = robot.reference_qpos.copy()
        qpos[robot.qpos_index] = problem.rest
        arm = replace(
            robot, limits=replace(robot.limits, torque=torque), reference_qpos=qpos
        )
    plan, notes = trajectory.generate_excitation_trajectory(
        arm, rng, duration, ArmTorque(robot)
    )
    progress.note(*notes)
    if problem is None:
        return CheckedPlan(plan)
    from robot_sysid.motion.limit_check import scaled_to_limits

    smaller, factors = scaled_to_limits(problem, plan, rate)
    if np.min(factors) < 1.0:
        share = 100.0 * np.min(factors)
        joint = robot.joint_names[int(np.argmin(factors))]
        progress.note(
            f"motion scaled down to keep all limits and clearances, most at {joint}: {share:.3g} %"
        )
    return CheckedPlan(smaller, problem)


def _designed(
    request: MotionRequest,
    robot: RobotModel,
    rng: np.random.Generator,
    progress: Progress,
) -> CheckedPlan:
    from robot_sysid.motion.design import Design
    from robot_sysid.motion.design_search import design_excitation

    problem = _problem(request, robot)
    known = None if request.known is None else request.known(problem)
    design = Design(problem, request.excitation, request.trajectory, known)

    def before(plan: MotionPlan) -> None:
        told = "" if request.outlook is None else request.outlook(problem, plan)
        if told:
            progress.note(told)

    result = design_excitation(design, rng, progress, before)
    progress.note(*result.notes)
    gain = result.start_objective / result.objective
    better = f"{gain:.2f} times better than the best of {result.n_feasible} feasible random ones"
    progress.stage(Detail(f"Mean standard deviation: {result.objective:.4g}, {better}"))
    return CheckedPlan(result.trajectory, problem, result.limit_check)


def _problem(request: MotionRequest, robot: RobotModel) -> ExcitationProblem:
    """Return the arm with all limits; of a new motion, its band limits the accelerations too."""
    from robot_sysid.motion.problem import DEFAULT_NOISE_TORQUE, build_problem
    from robot_sysid.motion.static import gentle_problem, startable

    is_new = request.trajectory.file is None
    basis = request.excitation.basis
    band = basis(request.trajectory.duration).top_frequency_hz if is_new else None
    noise = (
        request.noise_torque if np.all(request.noise_torque) else DEFAULT_NOISE_TORQUE
    )
    uncertainty = request.link_uncertainty
    problem = build_problem(
        robot, request.limits, request.torques, noise, band, uncertainty
    )
    if request.poses.purpose == WEIGHT:
        problem = gentle_problem(problem)
    return startable(problem) if is_new else problem


def _counted(plan: MotionPlan, progress: Progress) -> Iterator[Motion]:
    """Yield the motion that is checked for contacts, and tell how far it is."""
    total = math.ceil(
        trajectory.sample_count(plan.duration, CHECK_RATE_HZ) / trajectory.CHUNK
    )
    for done, motion in enumerate(
        trajectory.motion_chunks(plan, CHECK_RATE_HZ), start=1
    ):
        yield motion
        progress.advance("Looking for contacts", done, total, "")
