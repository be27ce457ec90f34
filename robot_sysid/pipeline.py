"""The stages in order, whatever is asked: load, excite, simulate or read, identify, write.

What only some runs do is imported where it is done: the self-test starts in half the time.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from robot_sysid.config import Config, PayloadConfig, SysidConfig
from robot_sysid.errors import InputError, ignore_repeated_ctrl_c
from robot_sysid.estimation.itself import identify_itself
from robot_sysid.export import MotorFile, locked_folder, save
from robot_sysid.model.compilation import meshes_not_kept
from robot_sysid.motion.plan import CheckedPlan, MotionRequest, make_plan
from robot_sysid.motion.plan_options import LimitOptions
from robot_sysid.outcome import Analysis, Outcome
from robot_sysid.parser import load_robot_model
from robot_sysid.records import MotionPlan, RobotModel
from robot_sysid.records.atomic_files import (
    DAMIAO_NAME,
    MODEL_NAMES,
    WholeFiles,
    whole_files,
)
from robot_sysid.records.options import per_joint
from robot_sysid.records.plan_settings import WEIGHT, command_after_weighing
from robot_sysid.records.progress import Detail, Progress
from robot_sysid.records.torque_scale import write_torque_scale
from robot_sysid.results.console import (
    block_lines,
    clamping_lines,
    folder_text,
    more_lines,
)
from robot_sysid.results.model import CHECKPOINTS
from robot_sysid.results.verdict import plan_verdict, shortfalls_of_plan, verdict_lines
from robot_sysid.simulator import ArmTorque
from robot_sysid.trajectory import motion_chunks

if TYPE_CHECKING:
    from robot_sysid.config import MotorOptions
    from robot_sysid.damiao.trajectory import DamiaoExportReport, MotionChunk
    from robot_sysid.motion.prediction import Prediction

# Speed at which dry friction has turned round by three quarters [rad/s]. Wider is gentler, but an
# arm that sticks longer at its reversals tells less: three times this costs a millimetre more.
_SMOOTH_REVERSAL = 0.01


def run(config: Config, progress: Progress | None = None) -> Outcome:
    """Answer what was asked about one arm, and write it.

    Args:
        config: what to do.
        progress: where to tell how far it is; None stays silent.

    Raises:
        SysidError: with the exit code that fits, see ``errors``.
    """
    progress = progress or Progress()
    if isinstance(config, SysidConfig) and config.estimation.torque_from is not None:
        from robot_sysid.servo.run import run_servo

        with meshes_not_kept():
            robot = load(config, progress)
            rest = (config.model.mesh_dir, progress)
            folder = config.output.output_dir
            read = config.read_files()
            return run_servo(robot, config.log, folder, *rest, read)
    with locked_folder(config.output.output_dir, progress):
        robot = load(config, progress)
        if isinstance(config, SysidConfig) and config.trajectory.plan_only:
            with ignore_repeated_ctrl_c():
                return _plan_outcome(
                    config, robot, designed(config, robot, progress)[0]
                )
        return written(config, robot, analysed(config, robot, progress), progress)


def designed(
    config: SysidConfig, robot: RobotModel, progress: Progress
) -> tuple[CheckedPlan, int]:
    """Return the motion that was asked for, checked, and the seed it was drawn with."""
    seed = config.seeded().trajectory.seed or 0
    limits = _within_motors(config.limits, config.motors, robot.n_joints)
    options = config.trajectory, config.excitation, limits, config.estimation.torques
    played = config.motors.export_damiao
    told: tuple[Any, ...] = ()
    if config.excitation.kind == "optimal":
        from robot_sysid.motion.expected_errors import known_of, outlook

        how = config.trajectory.sample_rate, config.estimation, config.poses.asked
        told = (
            partial(known_of, options=how[1], asked=how[2]),
            partial(outlook, how=how),
        )
    request = MotionRequest(
        *options, config.arm.noise_torque, played, config.poses, *told
    )
    request = replace(request, link_uncertainty=config.estimation.link_uncertainty)
    return make_plan(request, robot, seed, progress), seed


def _within_motors(
    limits: LimitOptions, motors: MotorOptions, n_joints: int
) -> LimitOptions:
    """Return limits that the motors which a motion is exported for can keep as well."""
    if not motors.export_damiao:
        return limits
    from robot_sysid.damiao.protocol.motors import motor_spec

    specs = map(motor_spec, motors.motor_type)
    able = [min(spec.peak_torque, spec.limits[2]) for spec in specs]
    asked = per_joint(limits.max_torque or np.inf, n_joints, "--max-torque").tolist()
    return replace(limits, max_torque=tuple(map(min, able, asked)))


def analysed(config: Config, robot: RobotModel, progress: Progress) -> Analysis:
    """Identify, and write no result."""
    config = config.calibrated(robot.joint_names)
    if isinstance(config, PayloadConfig):
        from robot_sysid.estimation.answer import traces_of
        from robot_sysid.payload_pipeline import weighed

        answer, result = weighed(config, robot, progress)
        motion = answer.fit.columns.datasets[-1].motion
        return Analysis(result, motion, partial(traces_of, answer), answer)
    assert isinstance(config, SysidConfig)
    if config.log.measurements:
        from robot_sysid.log_pipeline import of_logs

        return of_logs(config, robot, progress)
    with ignore_repeated_ctrl_c():
        checked, seed = designed(config, robot, progress)
        if checked.failure:
            remedy = "try another --seed, or use --excitation optimal"
            if config.trajectory.file is not None:
                remedy = "slow the motion down with --speed, or design one for this arm"
            raise InputError(f"{checked.failure}; relax that limit, {remedy}")
        with whole_files() as files:
            save_plan(files, config, robot, checked.plan)
    source = _of_itself
    if config.arm.plant_model is not None:
        from robot_sysid.log_pipeline import of_plant as source
    return replace(
        source(config, robot, checked.plan, seed, progress), plan=checked.plan
    )


def load(config: Config, progress: Progress) -> RobotModel:
    """Load the model, find its terminal joint and tell of it."""
    model = config.model
    progress.stage(f"Loading robot model from {model.path}...")
    limits = config.limits if isinstance(config, SysidConfig) else LimitOptions()
    robot = load_robot_model(
        model.path, model.mesh_dir, model.joint, limits.max_velocity, model.keyframe
    )
    progress.stage(f"Identified terminal joint: {robot.terminal_joint}")
    progress.note(*robot.notes)
    progress.stage(Detail(f"Joints that carry it: {', '.join(robot.joint_names)}"))
    if isinstance(config, SysidConfig) and config.motors.export_damiao:
        from robot_sysid.damiao.protocol.joints import damiao_joints

        # Refused before any work where the export could not be done.
        motors = config.motors
        damiao_joints(
            motors.motor_type, robot.n_joints, motors.can_id, motors.master_id
        )
    return robot


def save_plan(
    files: WholeFiles, config: SysidConfig, robot: RobotModel, plan: MotionPlan
) -> tuple[Path, ...]:
    """Write the drafts of the trajectory where it was asked for; returns where it will be."""
    path = config.plan_file
    if path is None:
        return ()
    from robot_sysid.motion.trajectories import save_samples, save_trajectory

    samples = path.with_suffix(".csv")
    with files.open(path) as file:
        save_trajectory(file, plan, robot.joint_names, robot.sha256)
    with files.open(samples) as file:
        save_samples(file, plan, robot.joint_names, config.trajectory.sample_rate)
    return path, samples


def _plan_outcome(
    config: SysidConfig, robot: RobotModel, checked: CheckedPlan
) -> Outcome:
    prediction = predict(config, checked)
    lines = [*promise(config, checked, prediction)]
    failure = checked.failure
    motor_file = None if failure else motor_writer(config, robot, checked.plan)
    with whole_files() as files:
        paths = () if failure else save_plan(files, config, robot, checked.plan)
        if motor_file is not None:
            paths = (*paths, config.output.output_dir / DAMIAO_NAME)
            with files.open(paths[-1]) as file:
                lines += clamping_lines(motor_file(file), robot.joint_names)
    failure = failure and f"{failure}; nothing was written"
    arm, limits = config.words
    purpose = config.poses.purpose, limits, *_shortfalls(config, checked, prediction)
    verdict = plan_verdict(arm, paths, failure, *purpose)
    return Outcome(tuple(lines), verdict, failure, paths, checked=checked)


def _shortfalls(
    config: SysidConfig, checked: CheckedPlan, prediction: Prediction | None
) -> tuple[list[str], str]:
    """Return what keeps a motion from its purpose, and the command that plans another one."""
    from robot_sysid.motion.prediction import contact_before

    if checked.problem is None or checked.failure:
        return [], ""
    share = None
    if prediction is not None and config.poses.purpose != WEIGHT:
        share = prediction.mass_share
    body_name = "" if prediction is None else prediction.of
    contact = contact_before(checked.problem, checked.plan)
    shortfalls = shortfalls_of_plan(body_name, share, contact)
    # Another motion tells more of a mass; it does not clear the way.
    is_mass_unknown = bool(shortfalls_of_plan(body_name, share, None))
    options = (
        prediction.remedy_options()
        if prediction is not None and is_mass_unknown
        else ()
    )
    if not options or config.plan_file is None:
        return shortfalls, ""
    arm, limits = config.words
    # The settings of a motion from a file ask for that motion again.
    settings = ["--config", str(config.plan_file.with_suffix(".toml"))]
    source = settings if config.trajectory.file is None else [*arm, *limits]
    folder = str(config.output.output_dir / "again")
    command = ["robot-sysid", "plan", *source, *options, "--output-dir", folder]
    return shortfalls, shlex.join(command)


def predict(config: SysidConfig, checked: CheckedPlan) -> Prediction | None:
    """Return what an identification will state of a motion; None of sweeps and resting poses."""
    from robot_sysid.motion.expected_errors import expect

    if config.poses.sets_its_time:
        return None
    assert checked.problem is not None
    how = config.trajectory.sample_rate, config.estimation, config.poses.asked
    return expect(checked.problem, checked.plan, *how)


def promise(
    config: SysidConfig, checked: CheckedPlan, prediction: Prediction | None
) -> Iterator[str]:
    """Yield what a motion promises, and what it does beside its limits."""
    from robot_sysid.motion.expected_errors import friction_lines
    from robot_sysid.motion.prediction import kept_lines, motion_lines, plan_lines
    from robot_sysid.motion.static import pose_lines, sweep_lines

    assert checked.problem is not None and checked.check is not None
    made = checked.problem, checked.plan, checked.check
    if prediction is not None:
        yield from plan_lines(*made, prediction)
        return
    yield from kept_lines(*made)
    yield from (pose_lines if config.poses.static else sweep_lines)(*made[:2])
    if not config.poses.static:
        how = config.trajectory.sample_rate, config.estimation
        yield from friction_lines(*made[:2], *how)
    yield from motion_lines(*made)


def _of_itself(
    config: SysidConfig,
    robot: RobotModel,
    plan: MotionPlan,
    seed: int,
    progress: Progress,
) -> Analysis:
    """Simulate the model along the trajectory and identify it, in constant memory."""
    rate = config.trajectory.sample_rate
    save_to = config.arm.save_measurements
    result, traces = identify_itself(
        robot, plan, rate, seed, config.estimation, progress
    )
    if save_to is not None:
        from robot_sysid.logs.text import write_measurement_csv
        from robot_sysid.simulator import simulate_inverse

        simulated = simulate_inverse(robot, motion_chunks(plan, rate))
        write_measurement_csv(save_to, robot.joint_names, simulated)
    return Analysis(
        result, plan.evaluate(np.linspace(0.0, plan.duration, CHECKPOINTS)), traces
    )


def written(
    config: Config, robot: RobotModel, found: Analysis, progress: Progress
) -> Outcome:
    """Write all results and pass on what writing them had to say."""
    folder = config.output.output_dir
    mesh_dir = config.model.mesh_dir
    result = found.result
    refused = None
    as_body = None
    motor_file = None
    scales = None
    if isinstance(config, PayloadConfig):
        as_body = config.payload.as_body
        scales = config.payload.save_torque_scale
    elif isinstance(config, SysidConfig):
        motor_file = (
            None if found.plan is None else motor_writer(config, robot, found.plan)
        )
        if (
            config.log.verify_rollout
            and result.file is not None
            and result.verdict.writes_model
        ):
            from robot_sysid.log_pipeline import played
            from robot_sysid.results.rollout import refusal

            progress.stage("Playing the model on held-out pieces...")
            result = replace(result, rollout=played(config, robot, found))
            refused = refusal(result.rollout, config.log.accept)
    saved = save(
        result,
        folder,
        found.checkpoints,
        mesh_dir=mesh_dir,
        as_body=as_body,
        motor_file=motor_file,
        refused=refused,
        inputs=[Path(path) for path in config.read_files() if path is not None],
    )
    if scales is not None and saved.failure is None and result.payload:
        write_torque_scale(scales, result.payload.torque_scale)
    progress.note(*saved.notes)
    lines = (
        *block_lines(result),
        f"Results saved to {folder_text(folder)}",
        *more_lines(result, config.output.links),
        *clamping_lines(saved.damiao, robot.joint_names),
    )
    verdict = verdict_lines(
        result, saved.failure, _next_plan_command(config, saved.files)
    )
    hashed = saved.result_hash
    return Outcome(
        lines, verdict, saved.failure, saved.files, result, found.traces, hashed
    )


def _next_plan_command(config: Config, files: Sequence[Path]) -> str:
    """Return the command that plans with the written model after a weighing motion, else ""."""
    models = [path for path in files if path.name in MODEL_NAMES.values()]
    if not models or not isinstance(config, SysidConfig) or not config.log.measurements:
        return ""
    return command_after_weighing(
        config.output.output_dir, config.model.path, models[0]
    )


def motor_writer(
    config: SysidConfig, robot: RobotModel, plan: MotionPlan
) -> MotorFile | None:
    """Return what writes the trajectory for Damiao motors, or None where none was asked for."""
    motors = config.motors
    if not motors.export_damiao:
        return None
    from robot_sysid.damiao.trajectory import export_damiao_trajectory

    rate = config.trajectory.sample_rate

    def write(file: TextIO) -> DamiaoExportReport:
        motion = commands(robot, plan, rate)
        ids = (motors.can_id, motors.master_id)
        names = robot.joint_names
        return export_damiao_trajectory(
            motion, motors.motor_type, file, *ids, joint_names=names
        )

    return write


def commands(robot: RobotModel, plan: MotionPlan, rate: float) -> Iterator[MotionChunk]:
    """Yield the motion with the torque it takes at a rate [Hz], for playing it on motors.

    Dry friction turns round smoothly: its step at each reversal would be a blow to the arm.
    """
    torque = ArmTorque(robot)
    for motion in motion_chunks(plan, rate):
        smooth = robot.friction.dry(
            motion.qd, lambda qd: np.tanh(qd / _SMOOTH_REVERSAL)
        )
        tau = torque(motion) + smooth - robot.friction.dry(motion.qd)
        yield motion.time, motion.q, motion.qd, tau
