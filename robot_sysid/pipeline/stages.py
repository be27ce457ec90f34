"""The stages of a run in order: load, plan, simulate or read, identify, write; and the self-test.

Modules that only some runs need are imported where they are used: the self-test starts in half the
time.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from robot_sysid.config import (
    Config,
    IdentifyConfig,
    LogConfig,
    MotionConfig,
    PayloadConfig,
    PlanConfig,
    SelfTestConfig,
    with_scale_prior,
)
from robot_sysid.errors import InputError, ignore_repeated_ctrl_c
from robot_sysid.export import Written, save, writable_folder
from robot_sysid.parser import load_robot_model
from robot_sysid.pipeline.motions import design_motion
from robot_sysid.pipeline.next_steps import step_after
from robot_sysid.pipeline.planning import (
    draft_motor_file,
    draft_plan,
    predict_plan,
    write_plan,
)
from robot_sysid.records import ITSELF, DataOrigin, MotionPlan, RobotModel
from robot_sysid.records.file_access import atomic_files
from robot_sysid.records.messages import Detail, NextStep, Progress, percent
from robot_sysid.records.option_fields import (
    command_arguments,
    given_values,
    options_of_all,
)
from robot_sysid.records.quantities import BEYOND, DIFFERENCE
from robot_sysid.results.record import Identification
from robot_sysid.results.self_test import self_test_result
from robot_sysid.results.verification import CHECKPOINTS
from robot_sysid.results.written_model import can_bend
from robot_sysid.simulator import simulate_inverse
from robot_sysid.solver import TERMINAL_FRICTION, LastLinkTerms, identify_parameters
from robot_sysid.trajectory import CHUNK, motion_chunks, sample_count
from robot_sysid.wording import option_name

WELL_WEIGHED = 20.0
"""Standard errors of what is bolted on from which weighing it by difference gains little."""


def run(config: Config, progress: Progress | None = None) -> Written:
    """Run a command on one arm and write its files.

    Where the torque follows from a servo's position error (``torque_from``), the servo is
    identified by ``servo.run_servo``, which locks the folder of results itself and plays no motion,
    so that it needs no limits and no motors. Otherwise a motion is designed, or an arm identified.

    Args:
        config: the options of the command.
        progress: receives stages and notes while the run goes on; None keeps it silent.

    Raises:
        SysidError: with the exit code that fits, see ``errors``.
    """
    progress = progress or Progress()
    if isinstance(config, IdentifyConfig) and config.output.torque_from is not None:
        from robot_sysid.pipeline.servo_step import step_after_servos
        from robot_sysid.servo import run_servo

        step_after = partial(step_after_servos, config)
        return run_servo(config, load_arm(config, progress), progress, step_after)
    with writable_folder(config.output.output_dir, progress):
        robot = load_arm(config, progress)
        if isinstance(config, PlanConfig):
            with ignore_repeated_ctrl_c():
                checked = design_motion(config, robot, progress)
                predicted = predict_plan(config, checked)
                return write_plan(config, robot, checked, *predicted)
        result, plan = identify(config, robot, progress)
        return write_results(config, result, progress, plan)


def load_arm(config: Config, progress: Progress) -> RobotModel:
    """Load the model, find its terminal joint, and report both.

    A self-test simulates and identifies the model's own numbers. What stands for placeholders is
    for logs, and for plants in place of them.

    Args:
        config: names the model file, and a limit of speed if there is a motion.
        progress: receives stages and notes.

    Raises:
        InputError: the model cannot be used.
    """
    model = config.model
    # Of a log, the answer names link and joint.
    line = Detail if isinstance(config, LogConfig) else str
    progress.stage(line(f"Loading robot model from {model.path}..."))
    options = given_values(model)
    if isinstance(config, MotionConfig):
        options["max_velocity"] = config.limits.max_velocity
    if isinstance(config, SelfTestConfig) and config.arm.plant_model is None:
        options["as_stated"] = True
    robot = load_robot_model(model.path, **options)
    progress.stage(line(f"Identified terminal joint: {robot.terminal_joint}"))
    notes = map(str, robot.notes) if isinstance(config, MotionConfig) else robot.notes
    progress.note(*notes)
    progress.stage(Detail(f"Joints that carry it: {', '.join(robot.joint_names)}"))
    return robot


def identify(
    config: Config, robot: RobotModel, progress: Progress
) -> tuple[Identification, MotionPlan | None]:
    """Identify an arm or a payload from logs or a simulation; no result file is written.

    Args:
        config: says what is identified from which data, and how.
        robot: the arm as in the model.
        progress: receives stages and notes.

    Returns:
        The result, and the motion of a simulation.

    Raises:
        InputError: a log cannot be used, or the motion breaks a limit.
    """
    if isinstance(config, SelfTestConfig):
        return identify_simulated(config, robot, progress)
    from robot_sysid.pipeline.recordings import identify_logs, identify_payload

    assert isinstance(config, LogConfig)
    estimation = with_scale_prior(config.estimation, config.log, robot.joint_names)
    config = replace(config, estimation=estimation)
    if isinstance(config, PayloadConfig):
        return identify_payload(config, robot, progress), None
    assert isinstance(config, IdentifyConfig)
    return identify_logs(config, robot, progress), None


def identify_simulated(
    config: SelfTestConfig, robot: RobotModel, progress: Progress
) -> tuple[Identification, MotionPlan]:
    """Identify an arm from a simulation, as ``identify``.

    The motion is saved where the configuration names a file for it.
    """
    config = config.with_seed()
    with ignore_repeated_ctrl_c():
        checked = design_motion(config, robot, progress)
        if checked.failure:
            remedy = f"try another {option_name('seed')}, or plan a motion"
            if config.trajectory.file is not None:
                speed = option_name("speed")
                remedy = (
                    f"slow the motion down with {speed}, or design one for this arm"
                )
            raise InputError(f"{checked.failure}; relax that limit, {remedy}")
        with atomic_files() as files:
            draft_plan(config, robot, checked, files)
    plan = checked.plan
    if config.arm.plant_model is None:
        result = run_self_test(config, robot, plan, progress)
        log_path = config.arm.save_measurements
        if log_path is not None:
            from robot_sysid.logs.text import write_measurement_csv

            simulated = simulate_inverse(
                robot, motion_chunks(plan, config.trajectory.sample_rate)
            )
            write_measurement_csv(log_path, robot.joint_names, simulated)
    else:
        from robot_sysid.pipeline.recordings import identify_plant

        result = identify_plant(config, robot, plan, progress)
    return result, plan


def write_results(
    config: Config,
    result: Identification,
    progress: Progress,
    plan: MotionPlan | None = None,
) -> Written:
    """Write all files of a result, and the data of a later report.

    The data are left of measured torques, or where a report is wanted; without them, the results
    stand. InputError where a file cannot be written.

    Args:
        config: names the output folder, and what is written there.
        result: of ``identify``.
        progress: receives stages, and notes on the written files.
        plan: the motion that a simulation followed.
    """
    motor_file = None
    if isinstance(config, MotionConfig) and plan is not None:
        motor_file = partial(draft_motor_file, config, result.robot, plan)
    step = step_after_run(config, result)
    written = save(result, config, progress, motor_file, step)
    if result.traces and (config.output.report or result.is_measured):
        from robot_sysid.report import runs

        folder = config.output.output_dir
        # Of this run, whatever another one writes to the folder in the meantime.
        fingerprint = runs.fingerprint(folder)
        try:
            traces = result.traces(every_sample=False)
            runs.save_data(folder, traces, fingerprint)
        except Exception as error:  # The results must stand.
            progress.note(f"nothing was left for a later report: {error}")
    return written


def step_after_run(config: Config, result: Identification) -> NextStep | None:
    """Return what to do after an identification that may be used, or None for nothing more."""
    arm = vars(config.model)
    folder = config.output.output_dir
    if isinstance(config, SelfTestConfig) and not result.is_measured:
        motors = config.motors
        export = command_arguments(vars(motors), options_of_all(motors))
        return step_after("self-test passed", arm, *export, folder=folder)
    if isinstance(config, PayloadConfig):
        payload = config.payload
        scales = payload.save_torque_scale
        empty = [log for log in payload.empty if isinstance(log, Path)]
        if scales is None or not empty:
            return None
        # The scales that the run began with are in those that it writes.
        values = {**vars(config.model), **vars(config.log)}
        return step_after("torque scales known", values, log=empty, scales=scales)
    further = _step_to_further_motion(config, result)
    mass = result.quantity("mass", BEYOND)
    difference = result.quantity(DIFFERENCE, BEYOND)
    if not isinstance(config, IdentifyConfig) or mass is None or difference is None:
        return further
    if not mass.error or not math.isfinite(mass.error):
        return further
    if mass.value > WELL_WEIGHED * mass.error:
        return further
    is_seen = difference.value >= 1.0
    state = "part bolted on" if is_seen else "part not seen"
    logs = config.log.measurements
    values = {**vars(config.model), **vars(config.log)}
    weighing = step_after(state, values, log=logs, folder=folder)
    return weighing if is_seen or further is None else further.before(weighing)


def _step_to_further_motion(config: Config, result: Identification) -> NextStep | None:
    """Return the second motion that makes the written file better elsewhere, or None."""
    if result.file is None:
        return None
    curved = result.file.curved if can_bend() else None
    elsewhere = (curved or result.file).elsewhere
    if elsewhere is None or elsewhere.next is None:
        return None
    folder = config.output.output_dir
    step = step_after(
        "further motion",
        vars(config.model),
        *elsewhere.next.plan,
        folder=folder,
        now=percent(elsewhere.after.relative_error),
        expected=percent(elsewhere.next.relative_error),
    )
    if not isinstance(config, IdentifyConfig):
        return step
    values = {**vars(config.model), **vars(config.log)}
    logs = config.log.measurements
    then = step_after("further motion recorded", values, log=logs, folder=folder)
    return replace(step, then=then)


def run_self_test(
    config: SelfTestConfig, robot: RobotModel, plan: MotionPlan, progress: Progress
) -> Identification:
    """Simulate the model along a trajectory and identify its terminal link, in constant memory.

    Args:
        config: holds the rate of the simulated samples, and which torques and friction are fitted.
        robot: the arm that is simulated and identified.
        plan: the motion.
        progress: receives stages.
    """
    options = config.estimation
    rate = config.trajectory.sample_rate
    progress.stage("Running MuJoCo simulation...")
    terms = () if options.no_friction else TERMINAL_FRICTION
    arm = LastLinkTerms(robot, options.torques, terms)
    simulated = simulate_inverse(robot, motion_chunks(plan, rate))
    count = math.ceil(sample_count(plan.duration, rate) / CHUNK)
    tracked = progress.track(simulated, "Collecting regressor data", count)
    sums = arm.exact_sums(tracked)
    progress.stage("Solving for parameters...")
    values, errors, quality = identify_parameters(sums, arm.prior, possible=True)
    return self_test_result(
        robot,
        [each for term in arm.terms.values() for each in term.parameters],
        arm.prior,
        values,
        float(errors[0]),
        quality,
        DataOrigin(ITSELF, plan.duration, rate, config.trajectory.seed or 0),
        plan.evaluate(np.linspace(0.0, plan.duration, CHECKPOINTS)),
        options.torques,
    )
