"""The stages of a run in order: load, plan, simulate or read, identify, write.

Modules that only some runs need are imported where they are used: the self-test starts in half the
time.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from robot_sysid.config import Config, PayloadConfig, SysidConfig
from robot_sysid.errors import InputError, ignore_repeated_ctrl_c
from robot_sysid.export import locked_folder, save
from robot_sysid.model import ModelOptions
from robot_sysid.model.compilation import meshes_not_kept
from robot_sysid.motion import LimitOptions
from robot_sysid.parser import load_robot_model
from robot_sysid.pipeline.outcome import Identification, Outcome
from robot_sysid.pipeline.planning import (
    design_motion,
    draft_plan,
    motor_writer,
    require_motors,
    write_plan,
)
from robot_sysid.pipeline.self_test import run_self_test
from robot_sysid.records import RobotModel
from robot_sysid.records.file_access import MODEL_NAMES, atomic_files
from robot_sysid.records.messages import Detail, Progress
from robot_sysid.records.option_fields import PerJoint
from robot_sysid.records.torque_scale import write_torque_scale
from robot_sysid.results.result_lines import (
    block_lines,
    clamping_lines,
    folder_text,
    more_lines,
)
from robot_sysid.results.verdict import command_after_weighing, verdict_lines
from robot_sysid.simulator import simulate_inverse
from robot_sysid.trajectory import motion_chunks


def run(config: Config, progress: Progress | None = None) -> Outcome:
    """Run a command on one arm and write its files.

    Args:
        config: the options of the command.
        progress: receives stages and notes while the run goes on; None keeps it silent.

    Raises:
        SysidError: with the exit code that fits, see ``errors``.
    """
    progress = progress or Progress()
    if isinstance(config, SysidConfig) and config.estimation.torque_from is not None:
        from robot_sysid.servo import run_servo

        with meshes_not_kept():
            robot = load_arm(config.model, progress)
            return run_servo(
                robot,
                config.log,
                config.output.output_dir,
                config.model.mesh_dir,
                progress,
                config.input_files(),
            )
    with locked_folder(config.output.output_dir, progress):
        max_velocity = LimitOptions.max_velocity
        if isinstance(config, SysidConfig):
            max_velocity = config.limits.max_velocity
        robot = load_arm(config.model, progress, max_velocity)
        if isinstance(config, SysidConfig):
            require_motors(config.motors, robot)
        if isinstance(config, SysidConfig) and config.trajectory.plan_only:
            with ignore_repeated_ctrl_c():
                checked, _ = design_motion(config, robot, progress)
                return write_plan(config, robot, checked)
        identification = identify(config, robot, progress)
        return write_results(config, identification, progress)


def load_arm(
    model: ModelOptions,
    progress: Progress,
    max_velocity: PerJoint = LimitOptions.max_velocity,
) -> RobotModel:
    """Load the model, find its terminal joint, and report both.

    Args:
        max_velocity: of joints to which the model gives none, one or one per joint [rad/s].
    """
    progress.stage(f"Loading robot model from {model.path}...")
    robot = load_robot_model(
        model.path, model.mesh_dir, model.joint, max_velocity, model.keyframe
    )
    progress.stage(f"Identified terminal joint: {robot.terminal_joint}")
    progress.note(*robot.notes)
    progress.stage(Detail(f"Joints that carry it: {', '.join(robot.joint_names)}"))
    return robot


def identify(config: Config, robot: RobotModel, progress: Progress) -> Identification:
    """Identify an arm or a payload from logs or a simulation; no result file is written."""
    config = config.with_scale_uncertainty(robot.joint_names)
    if isinstance(config, PayloadConfig):
        from robot_sysid.pipeline.payload import identify_payload

        return identify_payload(config, robot, progress)
    assert isinstance(config, SysidConfig)
    if config.log.measurements:
        from robot_sysid.pipeline.recordings import identify_logs

        return identify_logs(config, robot, progress)
    rate = config.trajectory.sample_rate
    with ignore_repeated_ctrl_c():
        checked, seed = design_motion(config, robot, progress)
        if checked.failure:
            remedy = "try another --seed, or use --excitation optimal"
            if config.trajectory.file is not None:
                remedy = "slow the motion down with --speed, or design one for this arm"
            raise InputError(f"{checked.failure}; relax that limit, {remedy}")
        with atomic_files() as files:
            draft_plan(files, config.plan_file, robot, checked.plan, rate)
    plan = checked.plan
    if config.arm.plant_model is None:
        identification = run_self_test(
            robot, plan, rate, seed, config.estimation, progress
        )
        log_path = config.arm.save_measurements
        if log_path is not None:
            from robot_sysid.logs.text import write_measurement_csv

            simulated = simulate_inverse(robot, motion_chunks(plan, rate))
            write_measurement_csv(log_path, robot.joint_names, simulated)
    else:
        from robot_sysid.pipeline.recordings import identify_plant

        identification = identify_plant(config, robot, plan, seed, progress)
    return replace(identification, plan=plan)


def write_results(
    config: Config, identification: Identification, progress: Progress
) -> Outcome:
    """Write all files of an identification and return the outcome of the command."""
    result = identification.result
    robot = result.robot
    mesh_dir = config.model.mesh_dir
    refusal = None
    as_body = None
    motor_file = None
    scale_path = None
    if isinstance(config, PayloadConfig):
        as_body = config.payload.as_body
        scale_path = config.payload.save_torque_scale
    elif isinstance(config, SysidConfig):
        if identification.plan is not None:
            rate = config.trajectory.sample_rate
            motor_file = motor_writer(config.motors, robot, identification.plan, rate)
        has_model = result.file is not None and result.verdict.writes_model
        if config.log.verify_rollout and has_model:
            from robot_sysid.pipeline.recordings import play_models
            from robot_sysid.results import verification

            progress.stage("Playing the model on held-out pieces...")
            played = play_models(identification, config.output.keep, mesh_dir)
            result = replace(result, rollout=played)
            refusal = verification.rollout_refusal(played, config.log.accept)
    saved = save(
        result,
        config.output.output_dir,
        identification.checkpoints,
        mesh_dir=mesh_dir,
        as_body=as_body,
        motor_file=motor_file,
        refused=refusal,
        inputs=[Path(path) for path in config.input_files() if path is not None],
    )
    if scale_path is not None and saved.failure is None and result.payload:
        write_torque_scale(scale_path, result.payload.torque_scale)
    progress.note(*saved.notes)
    lines = (
        *block_lines(result),
        f"Results saved to {folder_text(config.output.output_dir)}",
        *more_lines(result, config.output.links),
        *clamping_lines(saved.damiao, robot.joint_names),
    )
    command = ""
    if isinstance(config, SysidConfig) and config.log.measurements:
        models = [path for path in saved.files if path.name in MODEL_NAMES.values()]
        if models:
            folder = config.output.output_dir
            command = command_after_weighing(folder, config.model.path, models[0])
    verdict = verdict_lines(result, saved.failure, command)
    return Outcome(
        lines,
        verdict,
        saved.failure,
        saved.files,
        result,
        identification.traces,
        saved.result_hash,
    )
