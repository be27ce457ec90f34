"""The planning stage: design or check a motion, predict an identification from it, write it."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import numpy as np

from robot_sysid.config import SysidConfig
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.export import MotorFile
from robot_sysid.motion import WEIGHT, LimitOptions, PoseOptions
from robot_sysid.motion.plan import CheckedPlan, MotionRequest, make_plan
from robot_sysid.pipeline.outcome import Outcome
from robot_sysid.records import MotionPlan, RobotModel
from robot_sysid.records.file_access import DAMIAO_NAME, AtomicFiles, atomic_files
from robot_sysid.records.messages import Progress
from robot_sysid.records.option_fields import joint_values
from robot_sysid.results.result_lines import clamping_lines
from robot_sysid.results.verdict import plan_verdict, shortfalls_of_plan
from robot_sysid.simulator import ArmTorque
from robot_sysid.trajectory import motion_chunks

if TYPE_CHECKING:
    from robot_sysid.config import MotorOptions
    from robot_sysid.damiao.trajectory import DamiaoExportReport, MotionChunk
    from robot_sysid.motion.prediction import Prediction

_SMOOTH_REVERSAL = 0.01
"""Speed at which exported dry friction has reached 76 % of its size [rad/s]. A wider transition is
gentler, but an arm that sticks longer at its reversals shows less: 0.03 costs a millimetre more."""


def design_motion(
    config: SysidConfig, robot: RobotModel, progress: Progress
) -> tuple[CheckedPlan, int]:
    """Return the motion of a run with its limit check, and the seed it was drawn with."""
    seed = config.with_seed().trajectory.seed or 0
    limits = _limits_with_motors(config.limits, config.motors, robot.n_joints)
    estimation = config.estimation
    request = MotionRequest(
        config.trajectory,
        config.excitation,
        limits,
        torques=estimation.torques,
        noise_torque=config.arm.noise_torque,
        played=config.motors.export_damiao,
        poses=config.poses,
        link_uncertainty=estimation.link_uncertainty,
    )
    if config.excitation.kind == "optimal":
        from robot_sysid.motion.expected_errors import (
            RecordingPlan,
            identifiability_note,
            prior_knowledge,
        )

        target = config.poses.target
        recording = RecordingPlan(config.trajectory.sample_rate, estimation, target)
        request = replace(
            request,
            prior_knowledge=partial(prior_knowledge, options=estimation, target=target),
            identifiability_note=partial(identifiability_note, recording=recording),
        )
    return make_plan(request, robot, seed, progress), seed


def _limits_with_motors(
    limits: LimitOptions, motors: MotorOptions, n_joints: int
) -> LimitOptions:
    """Return torque limits that the motors of an export can keep too; without one the limits."""
    if not motors.export_damiao:
        return limits
    from robot_sysid.damiao.joints import motor_spec

    option_limits = joint_values(limits.max_torque or np.inf, n_joints, "--max-torque")
    max_torque = []
    for motor_type, option_limit in zip(motors.motor_type, option_limits.tolist()):
        spec = motor_spec(motor_type)
        max_torque.append(min(spec.peak_torque, spec.limits[2], option_limit))
    return replace(limits, max_torque=tuple(max_torque))


def predict_identification(
    checked: CheckedPlan, poses: PoseOptions, rate: float, options: EstimationOptions
) -> Prediction | None:
    """Return the errors to expect of an identification from a motion, recorded at a rate [Hz].

    None of friction sweeps and resting poses.
    """
    from robot_sysid.motion.expected_errors import RecordingPlan, predict

    if poses.sets_its_time:
        return None
    assert checked.problem is not None
    recording = RecordingPlan(rate, options, poses.target)
    return predict(checked.problem, checked.plan, recording)


def plan_lines(
    checked: CheckedPlan,
    prediction: Prediction | None,
    poses: PoseOptions,
    rate: float,
    options: EstimationOptions,
) -> Iterator[str]:
    """Yield the printed lines on a checked motion: its limits and the errors to expect of it."""
    from robot_sysid.motion import prediction as predictions
    from robot_sysid.motion.expected_errors import friction_lines
    from robot_sysid.motion.static import pose_lines, sweep_lines

    problem = checked.problem
    plan = checked.plan
    assert problem is not None and checked.check is not None
    if prediction is not None:
        yield from predictions.plan_lines(problem, plan, checked.check, prediction)
        return
    yield from predictions.limit_lines(problem, plan, checked.check)
    if poses.static:
        yield from pose_lines(problem, plan)
    else:
        yield from sweep_lines(problem, plan)
        yield from friction_lines(problem, plan, rate, options)
    yield from predictions.motion_lines(problem, plan, checked.check)


def write_plan(config: SysidConfig, robot: RobotModel, checked: CheckedPlan) -> Outcome:
    """Write a planned motion, unless it breaks a limit, and return the outcome of the command."""
    rate = config.trajectory.sample_rate
    settings = config.poses, rate, config.estimation
    prediction = predict_identification(checked, *settings)
    lines = [*plan_lines(checked, prediction, *settings)]
    failure = checked.failure
    paths: tuple[Path, ...] = ()
    if failure:
        failure = f"{failure}; nothing was written"
    else:
        paths, clamping = _write_motion(config, robot, checked.plan)
        lines += clamping
    arm_words, limit_words = config.command_words()
    shortfalls, command = _shortfalls(config, checked, prediction)
    verdict = plan_verdict(
        arm_words,
        paths,
        failure,
        config.poses.purpose,
        limit_words,
        shortfalls,
        command,
    )
    return Outcome(tuple(lines), verdict, failure, paths, checked=checked)


def _write_motion(
    config: SysidConfig, robot: RobotModel, plan: MotionPlan
) -> tuple[tuple[Path, ...], list[str]]:
    """Write all files of a planned motion; return their paths, and lines on clamped torques."""
    rate = config.trajectory.sample_rate
    motor_file = motor_writer(config.motors, robot, plan, rate)
    with atomic_files() as files:
        paths = draft_plan(files, config.plan_file, robot, plan, rate)
        if motor_file is None:
            return paths, []
        motor_path = config.output.output_dir / DAMIAO_NAME
        with files.open(motor_path) as file:
            report = motor_file(file)
    return (*paths, motor_path), list(clamping_lines(report, robot.joint_names))


def _shortfalls(
    config: SysidConfig, checked: CheckedPlan, prediction: Prediction | None
) -> tuple[list[str], str]:
    """Return what keeps a motion from its purpose, and the command that plans a better one."""
    from robot_sysid.motion.prediction import contact_before

    if checked.problem is None or checked.failure:
        return [], ""
    mass_share = None
    if prediction is not None and config.poses.purpose != WEIGHT:
        mass_share = prediction.relative_mass_error
    body_name = "" if prediction is None else prediction.subject
    contact = contact_before(checked.problem, checked.plan)
    shortfalls = shortfalls_of_plan(body_name, mass_share, contact)
    # Another motion shows more of a mass; it does not clear the way.
    is_mass_unknown = bool(shortfalls_of_plan(body_name, mass_share, None))
    if prediction is None or not is_mass_unknown or config.plan_file is None:
        return shortfalls, ""
    options = prediction.improvement_options()
    if not options:
        return shortfalls, ""
    arm_words, limit_words = config.command_words()
    source = [*arm_words, *limit_words]
    # The settings of a motion from a file ask for that motion again.
    if config.trajectory.file is None:
        source = ["--config", str(config.plan_file.with_suffix(".toml"))]
    folder = str(config.output.output_dir / "again")
    command = ["robot-sysid", "plan", *source, *options, "--output-dir", folder]
    return shortfalls, shlex.join(command)


def draft_plan(
    files: AtomicFiles,
    path: Path | None,
    robot: RobotModel,
    plan: MotionPlan,
    rate: float,
) -> tuple[Path, ...]:
    """Draft a trajectory, and beside it its samples at a rate [Hz], among ``files``.

    Returns:
        the paths that both will have; empty where ``path`` is None.
    """
    if path is None:
        return ()
    from robot_sysid.motion.trajectories import save_samples, save_trajectory

    samples_path = path.with_suffix(".csv")
    with files.open(path) as file:
        save_trajectory(file, plan, robot.joint_names, robot.sha256)
    with files.open(samples_path) as file:
        save_samples(file, plan, robot.joint_names, rate)
    return path, samples_path


def require_motors(motors: MotorOptions, robot: RobotModel) -> None:
    """Raise InputError where an export for motors is wanted that is impossible for this arm."""
    if motors.export_damiao:
        from robot_sysid.damiao.joints import damiao_joints

        damiao_joints(
            motors.motor_type, robot.n_joints, motors.can_id, motors.master_id
        )


def motor_writer(
    motors: MotorOptions, robot: RobotModel, plan: MotionPlan, rate: float
) -> MotorFile | None:
    """Return the function that writes a motion, sampled at a rate [Hz], for Damiao motors.

    None where no option asks for that.
    """
    if not motors.export_damiao:
        return None
    from robot_sysid.damiao.trajectory import export_damiao_trajectory

    def write(file: TextIO) -> DamiaoExportReport:
        return export_damiao_trajectory(
            motor_commands(robot, plan, rate),
            motors.motor_type,
            file,
            motors.can_id,
            motors.master_id,
            joint_names=robot.joint_names,
        )

    return write


def motor_commands(
    robot: RobotModel, plan: MotionPlan, rate: float
) -> Iterator[MotionChunk]:
    """Yield time, positions, speeds and feed-forward torques of a motion, sampled at a rate [Hz].

    The step of dry friction at a reversal would be a blow to the arm, so it is made smooth:
    coulomb tanh(qd / 0.01 rad/s) in place of coulomb sign(qd).
    """
    torque = ArmTorque(robot)
    for motion in motion_chunks(plan, rate):
        smooth = robot.friction.dry(
            motion.qd, lambda qd: np.tanh(qd / _SMOOTH_REVERSAL)
        )
        tau = torque(motion) + smooth - robot.friction.dry(motion.qd)
        yield motion.time, motion.q, motion.qd, tau
