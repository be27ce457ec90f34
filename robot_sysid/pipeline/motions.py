"""The motion of a run, random, designed or from a file, and the check of its limits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from robot_sysid import trajectory
from robot_sysid.config import MotionConfig, PlanConfig
from robot_sysid.errors import InputError
from robot_sysid.motion import SERVOS, WEIGHT
from robot_sysid.motion.trajectories import at_speed, load_trajectory
from robot_sysid.pipeline.motors import arm_motors
from robot_sysid.records import MotionPlan, RobotModel
from robot_sysid.records.messages import Progress
from robot_sysid.records.option_fields import given_values, require_countable
from robot_sysid.wording import option_name

# A random motion that nothing plays imports nothing that checks and designs.
if TYPE_CHECKING:
    from robot_sysid.motion.limit_check import LimitCheck
    from robot_sysid.motion.problem import ExcitationProblem

LONGEST_CHECKED = 3600.0
"""Longest motion that is checked against all limits, which takes minutes for an hour [s]."""


@dataclass(frozen=True)
class CheckedPlan:
    """A trajectory and the check of its limits.

    Attributes:
        plan: the trajectory.
        problem: the arm and the limits that it has to keep; None where nothing plays it.
        check: of the limits; None where nothing plays it.
    """

    plan: MotionPlan
    problem: ExcitationProblem | None = None
    check: LimitCheck | None = None

    @property
    def path(self) -> MotionPlan:
        """The trajectory without the stops on its way."""
        if isinstance(self.plan, trajectory.StoppingTrajectory):
            return self.plan.path
        return self.plan

    @property
    def failure(self) -> str | None:
        """Why the trajectory must not be run, or None."""
        if self.check is None or not self.check.excesses:
            return None
        from robot_sysid.motion.plan_lines import excess_text

        broken = excess_text(self.check.excesses[0])
        return f"this trajectory must not be run: it breaks the {broken}"

    def contact_at_start(self) -> str | None:
        """Return the two bodies that come too near each other on the straight way from the model's
        pose to the trajectory's start; None where none do, or where nothing plays it.
        """
        if self.problem is None:
            return None
        from robot_sysid.motion.starts import contact_on_the_way

        return contact_on_the_way(self.problem, self.plan.evaluate(np.zeros(1)).q[0])


def design_motion(
    config: MotionConfig, robot: RobotModel, progress: Progress
) -> CheckedPlan:
    """Return the trajectory of a run, checked where anything depends on its limits.

    Args:
        config: settings of motion, design, limits, motors and estimate; without a seed, one is
            drawn.
        robot: the arm.
        progress: receives the stages, their progress and notes for the user.

    Raises:
        InputError: no motion keeps the limits, or it is too long to be checked or sampled.
    """
    options = config.trajectory
    problem = _problem(config, robot)
    rng = np.random.default_rng(config.with_seed().trajectory.seed or 0)
    plan = _plan_at_full_speed(config, robot, problem, rng, progress)
    plan = at_speed(plan, options.speed)
    if problem is None:
        return CheckedPlan(plan)
    from robot_sysid.motion.limit_check import check_limits, with_stops

    progress.note(*problem.notes)
    if config.aim.purpose == SERVOS:
        stopping = with_stops(problem, plan)
        check = check_limits(problem, stopping, config.aim.goal_rate)
        return CheckedPlan(stopping, problem, check)
    # The lines on a plan have these, and its verdict says what to do.
    if not isinstance(config, PlanConfig):
        progress.note(*problem.missing_limits)
    return CheckedPlan(plan, problem, check_limits(problem, plan, options.sample_rate))


def is_checked(config: MotionConfig) -> bool:
    """Return whether a motion has to keep all limits: it is played, saved, planned only, from a
    file or designed, or a limit other than ``--max-velocity`` was given.
    """
    options = config.trajectory
    limits = given_values(config.limits).keys() - {"max_velocity"}
    is_kept = options.save or options.file or isinstance(config, PlanConfig)
    return bool(is_kept or limits or config.motors.are_stated or is_designed(config))


def is_designed(config: MotionConfig) -> bool:
    """Return whether a trajectory is to be designed, unless there is a file."""
    return config.excitation.kind == "optimal"


def _require_possible(config: MotionConfig, duration: float) -> None:
    """Raise InputError where a motion of this duration [s] has too many samples, or takes hours to
    be checked.
    """
    duration = duration / config.trajectory.speed
    require_countable(duration, config.trajectory.sample_rate)
    if is_checked(config) and duration > LONGEST_CHECKED:
        raise InputError(
            f"a motion of {duration:.3g} s takes too long to check against all limits; make it at "
            f"most {LONGEST_CHECKED:g} s long"
        )


def _plan_at_full_speed(
    config: MotionConfig,
    robot: RobotModel,
    problem: ExcitationProblem | None,
    rng: np.random.Generator,
    progress: Progress,
) -> trajectory.SineTrajectory:
    """Return the trajectory at full speed.

    Args:
        config: options and purpose of the motion.
        robot: the arm.
        problem: the arm with the limits that the motion has to keep; None where there are none.
        rng: draws random and designed motions.
        progress: receives the stages, their progress and notes for the user.
    """
    options = config.trajectory
    if options.file is not None:
        progress.stage(f"Loading excitation trajectory from {options.file}...")
        saved = load_trajectory(options.file)
        if saved.joint_names != robot.joint_names:
            raise InputError(
                f"{option_name('trajectory')}: made for the {len(saved.joint_names)} joints "
                f"{', '.join(saved.joint_names)}, but this arm has the {robot.n_joints} joints "
                f"{', '.join(robot.joint_names)}; design one for this arm with robot-sysid plan"
            )
        _require_possible(config, saved.plan.duration)
        if saved.sha256 not in ("", robot.sha256):
            progress.note(
                f"{options.file} was made for another model file; it is checked against the "
                f"limits of {robot.path}"
            )
        return saved.plan
    _require_possible(config, options.duration)
    verb = "Designing" if is_designed(config) else "Generating"
    progress.stage(
        f"{verb} excitation trajectory ({options.duration:.1f}s, {options.sample_rate:g} Hz)..."
    )
    # Ends on a sample, so that the last one is at rest.
    rate = options.sample_rate
    duration = (trajectory.sample_count(options.duration, rate) - 1) / rate
    if problem is None:
        return trajectory.generate_excitation_trajectory(robot, rng, duration)
    if is_designed(config):
        from robot_sysid.expected.recording import prior_knowledge
        from robot_sysid.motion.search import Design, design_excitation

        knowledge = prior_knowledge(problem, config.estimation, config.aim.target)
        design = Design(problem, config.excitation, options, knowledge)
        return design_excitation(design, rng, progress)
    from robot_sysid.motion.limit_check import scale_to_limits

    qpos = robot.reference_qpos.copy()
    qpos[robot.qpos_index] = problem.rest
    arm = replace(robot, reference_qpos=qpos)
    plan = trajectory.generate_excitation_trajectory(arm, rng, duration)
    plan, factor = scale_to_limits(problem, plan, rate)
    if factor < 1.0:
        progress.note(
            f"motion scaled to {100.0 * factor:.3g} % to keep all limits and clearances"
        )
    return plan


def _problem(config: MotionConfig, robot: RobotModel) -> ExcitationProblem | None:
    """Return the arm with all its limits, those of its motors too; for the purpose "weight" with
    half of the torque limits and low speeds. None where the motion does not have to keep any.

    For a new motion (not from a file) the top frequency of the band limits the accelerations too,
    but where a motion for servos stops on its way. The start is a pose that touches nothing and
    that the motors can hold.

    Raises:
        InputError: the arm breaks a limit at rest, or no pose can be a start.
    """
    if not is_checked(config):
        return None
    from robot_sysid.motion.problem import DEFAULT_NOISE_TORQUE, build_problem
    from robot_sysid.motion.starts import gentle_problem, with_free_start

    motors = arm_motors(config.motors, robot)
    is_new = config.trajectory.file is None
    estimation = config.estimation
    problem = build_problem(
        robot,
        config.limits,
        torques=estimation.torques,
        noise_torque=estimation.priors.noise or DEFAULT_NOISE_TORQUE,
        shakes_gently=is_new and config.aim.purpose != SERVOS,
        link_uncertainty=estimation.priors.link,
        motors=motors.limits if motors else None,
    )
    if config.aim.purpose == WEIGHT:
        problem = gentle_problem(problem)
    return with_free_start(problem) if is_new else problem
