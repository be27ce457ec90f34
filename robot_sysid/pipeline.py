"""The stages in order, whatever is asked: load, excite, simulate or read, identify, write."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import numpy as np

from robot_sysid.config import Config, OutputOptions, PayloadConfig, SysidConfig
from robot_sysid.diagnosis.run import look_at
from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.estimation.answer import Answer, traces_of
from robot_sysid.estimation.dataset import Dataset
from robot_sysid.estimation.identify import (
    Piece,
    answer_link,
    filtered,
    identify_itself,
    refit,
    shared_notes,
)
from robot_sysid.estimation.result import result_of
from robot_sysid.estimation.unknowns import FILE_FRICTION, FILE_ROTORS
from robot_sysid.expected import expect, friction_lines, known_of, outlook
from robot_sysid.export import MotorFile, Saved, locked_folder, save
from robot_sysid.interrupts import only_the_first
from robot_sysid.logs.reader import (
    MeasurementLog,
    earlier_logs,
    open_log,
    origin_of,
    write_measurement_csv,
)
from robot_sysid.motion.plan import CheckedPlan, MotionRequest, make_plan
from robot_sysid.parser import load_robot_model
from robot_sysid.payload_pipeline import weighed
from robot_sysid.records import DataOrigin, Motion, MotionPlan, RobotModel, Source
from robot_sysid.records.arm import InertialParameters
from robot_sysid.records.atomic_files import (
    DAMIAO_NAME,
    MODEL_NAMES,
    WholeFiles,
    temporary_folder,
    whole_files,
)
from robot_sysid.records.data import Traces
from robot_sysid.records.options import per_joint
from robot_sysid.records.progress import Detail, Progress
from robot_sysid.records.results import RolloutTest
from robot_sysid.records.torque_scale import write_torque_scale
from robot_sysid.results.console import block_lines, clamping_lines, folder_text, more_lines
from robot_sysid.results.model import CHECKPOINTS, ModelTarget, write_model
from robot_sysid.results.record import Result
from robot_sysid.results.rollout import (
    LAST_FIFTH,
    fitted_rows,
    play,
    refusal,
    split_time,
    torque_error,
)
from robot_sysid.results.verdict import plan_verdict, verdict_lines
from robot_sysid.signals.resampling import MOST_KEPT, bounded
from robot_sysid.simulation.closed_loop import PlantSimulation
from robot_sysid.simulation.loading import load_plant
from robot_sysid.simulator import ArmTorque
from robot_sysid.trajectory import CHUNK, motion_chunks, sample_count

if TYPE_CHECKING:
    from robot_sysid.damiao.trajectory import DamiaoExportReport, MotionChunk

# Speed at which dry friction has turned round by three quarters [rad/s]. Wider is gentler, but an
# arm that sticks longer at its reversals tells less: three times this costs a millimetre more.
_SMOOTH_REVERSAL = 0.01
_NOISE_STREAM = 1


@dataclass(frozen=True)
class PlanOutcome:
    """What planning a motion produced.

    Attributes:
        lines: what it promises, and what exporting it to motors had to say.
        failure: why it must not be run, or None; nothing is written then.
        files: what was written.
        config, checked: what was asked for, and the motion itself.
    """

    lines: tuple[str, ...]
    failure: str | None
    config: SysidConfig
    files: tuple[Path, ...] = ()
    checked: CheckedPlan | None = None

    @property
    def verdict(self) -> tuple[str, ...]:
        """Whether to use it and what to do next, in two lines, which come last."""
        arm, limits = self.config.words
        return plan_verdict(arm, self.files, self.failure, self.config.poses.purpose, limits)

    def report_lines(self) -> list[str]:
        """Return what the command line prints at the end."""
        return [*self.lines, *(f"Trajectory saved to {path}" for path in self.files)]


@dataclass(frozen=True)
class Analysis:
    """What data led to.

    Attributes:
        result: everything that is said of it.
        checkpoints: motion on which a written model has to reproduce the predicted torque.
        traces: makes what a report draws.
        answer: the estimate behind it; None of the model's own simulation.
        tests: recordings that only test it.
        plan: the motion that a simulation followed; None of logs.
    """

    result: Result
    checkpoints: Motion
    traces: Callable[[], Traces]
    answer: Answer | None = None
    tests: tuple[Dataset, ...] = ()
    plan: MotionPlan | None = None


@dataclass(frozen=True)
class Outcome:
    """What a run produced, what was written, and what was asked of it."""

    result: Result
    traces: Callable[[], Traces]
    saved: Saved
    output: OutputOptions

    @property
    def files(self) -> tuple[Path, ...]:
        """What was written."""
        return self.saved.files

    @property
    def failure(self) -> str | None:
        """Why there is nothing to use, or None."""
        return self.saved.failure

    @property
    def verdict(self) -> tuple[str, ...]:
        """Whether to use it and what to do next, in at most two lines, which come last."""
        return verdict_lines(self.result, self.saved.failure)

    def report_lines(self) -> list[str]:
        """Return what the command line prints at the end."""
        saved = f"Results saved to {folder_text(self.output.output_dir)}"
        more = more_lines(self.result, self.output.links)
        clamping = clamping_lines(self.saved.damiao, self.result.joint_names)
        return [*block_lines(self.result), saved, *more, *clamping]


def run(config: Config, progress: Progress | None = None) -> Outcome | PlanOutcome:
    """Answer what was asked about one arm, and write it.

    Args:
        config: what to do.
        progress: where to tell how far it is; None stays silent.

    Raises:
        SysidError: with the exit code that fits, see ``errors``.
    """
    progress = progress or Progress()
    with locked_folder(config.output.output_dir, progress):
        robot = load(config, progress)
        if isinstance(config, SysidConfig) and config.trajectory.plan_only:
            with only_the_first():
                return _plan_outcome(config, robot, designed(config, robot, progress)[0])
        return written(config, robot, analysed(config, robot, progress), progress)


def designed(config: SysidConfig, robot: RobotModel, progress: Progress) -> tuple[CheckedPlan, int]:
    """Return the motion that was asked for, checked, and the seed it was drawn with."""
    arm, seed = config.arm, config.seeded().trajectory.seed or 0
    played = config.motors.export_damiao or arm.simulation == "forward"
    options = config.trajectory, config.excitation, config.limits, config.estimation.torques
    how = config.trajectory.sample_rate, config.estimation, config.poses.asked
    told = partial(known_of, options=how[1], asked=how[2]), partial(outlook, how=how)
    request = MotionRequest(*options, arm.noise_torque, played, config.poses, *told)
    return make_plan(request, robot, seed, progress), seed


def analysed(config: Config, robot: RobotModel, progress: Progress) -> Analysis:
    """Identify, and write no result."""
    config = config.calibrated(robot.joint_names)
    if isinstance(config, PayloadConfig):
        answer, result = weighed(config, robot, progress)
        motion = answer.fit.columns.datasets[-1].motion
        return Analysis(result, motion, partial(traces_of, answer), answer)
    assert isinstance(config, SysidConfig)
    band = config.estimation.velocity_deadband
    if band is not None:
        per_joint(band, robot.n_joints, "--velocity-deadband")
    if config.log.measurements:
        return _of_logs(config, robot, progress)
    with only_the_first():
        checked, seed = designed(config, robot, progress)
        if checked.failure:
            remedy = "try another --seed, or use --excitation optimal"
            if config.trajectory.file is not None:
                remedy = "slow the motion down with --speed, or design one for this arm"
            raise InputError(f"{checked.failure}; relax that limit, {remedy}")
        with whole_files() as files:
            save_plan(files, config, robot, checked.plan)
    source = _of_itself if config.arm.plant_model is None else _of_plant
    return replace(source(config, robot, checked.plan, seed, progress), plan=checked.plan)


def load(config: Config, progress: Progress) -> RobotModel:
    """Load the model, find its terminal joint and tell of it."""
    model = config.model
    progress.stage(f"Loading robot model from {model.path}...")
    speed = config.limits.max_velocity
    robot = load_robot_model(model.path, model.mesh_dir, model.joint, speed, model.keyframe)
    progress.stage(f"Identified terminal joint: {robot.terminal_joint}")
    for note in robot.notes:
        progress.note(note)
    progress.stage(Detail(f"Joints that carry it: {', '.join(robot.joint_names)}"))
    if isinstance(config, SysidConfig) and config.motors.export_damiao:
        from robot_sysid.damiao.protocol.joints import damiao_joints

        # Refused before any work where the export could not be done.
        motors = config.motors
        damiao_joints(motors.motor_type, robot.n_joints, motors.can_id, motors.master_id)
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


def _plan_outcome(config: SysidConfig, robot: RobotModel, checked: CheckedPlan) -> PlanOutcome:
    lines = tuple(promise(config, robot, checked))
    if checked.failure:
        return PlanOutcome(lines, f"{checked.failure}; nothing was written", config, (), checked)
    motor_file = motor_writer(config, robot, checked.plan)
    with whole_files() as files:
        paths = save_plan(files, config, robot, checked.plan)
        if motor_file is not None:
            paths = (*paths, config.output.output_dir / DAMIAO_NAME)
            with files.open(paths[-1]) as file:
                lines += tuple(clamping_lines(motor_file(file), robot.joint_names))
    return PlanOutcome(lines, None, config, paths, checked)


def promise(config: SysidConfig, robot: RobotModel, checked: CheckedPlan) -> Iterator[str]:
    """Yield what a motion promises, and what it does beside its limits."""
    from robot_sysid.motion.prediction import kept_lines, motion_lines, plan_lines
    from robot_sysid.motion.static import pose_lines, sweep_lines

    assert checked.problem is not None and checked.check is not None
    made = checked.problem, checked.plan, checked.check
    how = config.trajectory.sample_rate, config.estimation
    if config.poses.sets_its_time:
        yield from kept_lines(*made)
        yield from (pose_lines if config.poses.static else sweep_lines)(*made[:2])
        if not config.poses.static:
            yield from friction_lines(*made[:2], *how)
        yield from motion_lines(*made)
    else:
        yield from plan_lines(*made, expect(*made[:2], *how, config.poses.asked))


def _of_itself(
    config: SysidConfig, robot: RobotModel, plan: MotionPlan, seed: int, progress: Progress
) -> Analysis:
    """Simulate the model along the trajectory and identify it, in constant memory."""
    rate, save_to = config.trajectory.sample_rate, config.arm.save_measurements
    result, traces = identify_itself(robot, plan, rate, seed, config.estimation, progress)
    if save_to is not None:
        from robot_sysid.simulator import simulate_inverse

        simulated = simulate_inverse(robot, motion_chunks(plan, rate))
        write_measurement_csv(save_to, robot.joint_names, simulated)
    return Analysis(result, plan.evaluate(np.linspace(0.0, plan.duration, CHECKPOINTS)), traces)


def _of_plant(
    config: SysidConfig, robot: RobotModel, plan: MotionPlan, seed: int, progress: Progress
) -> Analysis:
    """Let another model play the real arm, and identify from what its sensors say."""
    arm, rate = config.arm, config.trajectory.sample_rate
    assert arm.plant_model is not None
    plant = load_plant(robot, arm.plant_model, config.model.mesh_dir)
    progress.stage(f"Running MuJoCo simulation of {arm.plant_model}...")
    rng = np.random.default_rng([seed, _NOISE_STREAM])
    simulation = PlantSimulation(plant, plan, arm, rate, rng)
    count = sample_count(plan.duration, rate)
    label, chunks = "Collecting measurements", math.ceil(count / CHUNK)
    parts, cut = bounded(progress.track(iter(simulation), label, chunks), count)
    least, ramp = _past_the_ramp(config.estimation, simulation)
    if arm.save_measurements is not None:
        whole = simulation if count > MOST_KEPT else parts
        write_measurement_csv(arm.save_measurements, robot.joint_names, whole, ramp)
    notes = (*plant.notes, *simulation.notes(), *ramp, *cut)
    detail = f"{arm.plant_model}, {arm.simulation}"
    origin = DataOrigin(Source.SIMULATED_ARM, detail, plan.duration, rate, seed)
    pieces = [Piece(str(arm.plant_model), part, least_deadband=least) for part in parts]
    found = _identified(config, robot, pieces, origin, notes, (), progress)
    truth = plant.prior
    return replace(found, traces=partial(_with_truth, found.traces, truth))


def _with_truth(traces: Callable[[], Traces], truth: InertialParameters) -> Traces:
    return replace(traces(), truth=truth)


def _past_the_ramp(
    options: EstimationOptions, simulation: PlantSimulation
) -> tuple[tuple[float, ...], tuple[str, ...]]:
    """Return (speeds (n,) below which MuJoCo's dry friction is a ramp, a sentence); () if none."""
    # A little above the ramp, so that three digits say all.
    speeds = tuple(float(f"{1.005 * speed:.3g}") for speed in simulation.least_deadband())
    if not any(speeds) or options.velocity_deadband is not None:
        return (), ()
    listed = ",".join(f"{speed:g}" for speed in speeds)
    return speeds, (
        "MuJoCo's dry friction builds up over a range of speeds; moments in which a joint is "
        "still in that range are left out. With the saved log --velocity-deadband "
        f"{listed} does the same",
    )


def _of_logs(config: SysidConfig, robot: RobotModel, progress: Progress) -> Analysis:
    options, tests = config.log, []
    earlier = () if options.append is None else earlier_logs(options.append, robot)
    logs = []
    for path in (*earlier, *options.measurements):
        progress.stage(f"Reading measurements from {path}...")
        logs.append(open_log(robot, path, options, progress))
    if config.arm.save_measurements is not None:
        write_measurement_csv(config.arm.save_measurements, robot.joint_names, [logs[0].samples])
    if options.validation_measurements is not None:
        tests.append(open_log(robot, options.validation_measurements, options, progress))
        for note in tests[0].notes:
            progress.note(type(note)(f"validation log: {note}"))
    checked(config, robot, [*logs, *tests], progress)
    pieces = [Piece(str(log.path), part) for log in logs for part in log.pieces]
    notes = tuple(shared_notes({str(log.path): log.notes for log in logs}))
    return _identified(config, robot, pieces, origin_of(logs), notes, tests, progress)


def checked(
    config: SysidConfig, robot: RobotModel, logs: Sequence[MeasurementLog], progress: Progress
) -> None:
    """Look at each log against the model; stop at what must not become a number."""
    late = ("delay",) if config.estimation.delay == "auto" else ()
    for done, log in enumerate(logs):
        progress.advance("Looking for what is wrong with the logs", done, len(logs), "")
        look_at(robot, log, (*config.log.accept, *late), progress, config.estimation.cutoff)


def _identified(
    config: SysidConfig,
    robot: RobotModel,
    pieces: Sequence[Piece],
    origin: DataOrigin,
    notes: Sequence[str],
    tests: Sequence[MeasurementLog],
    progress: Progress,
) -> Analysis:
    options = config.estimation
    datasets, said = filtered(robot, pieces, options)
    for note in (*notes, *said):
        progress.note(note)
    cutoff = datasets[0].signals.cutoff if datasets[0].signals else options.cutoff
    same, others = replace(options, cutoff=cutoff), {}
    for log in tests:
        parts = [Piece(str(log.path), part) for part in log.pieces]
        others[str(log.path)] = filtered(robot, parts, same)[0]
    kept = config.output.keep + ((FILE_FRICTION, FILE_ROTORS) if options.no_friction else ())
    answer = answer_link(robot, datasets, options, progress, kept, others)
    answer = replace(answer, notes=(*notes, *said, *answer.notes))
    result = result_of(answer, origin)
    for note in result.notes:
        if note not in (*robot.notes, *notes, *said):
            progress.note(note)
    assert (first := datasets[0].signals) is not None
    checkpoints = first.motion(first.spread(CHECKPOINTS))
    held_out = tuple(each for parts in others.values() for each in parts)
    found = Analysis(result, checkpoints, partial(traces_of, answer), answer, held_out)
    return replace(found, result=_file_tested(robot, found, config.model.mesh_dir))


def _file_tested(robot: RobotModel, found: Analysis, mesh_dir: Path | None) -> Result:
    """Return the result with the written file's own error on other logs, by inverse dynamics."""
    result = found.result
    if result.file is None or not found.tests or not result.verdict.is_trustworthy:
        return result
    pairs = []
    with temporary_folder() as folder:
        path = folder / MODEL_NAMES[robot.kind]
        with whole_files() as files:
            target = ModelTarget(files, path, found.checkpoints, result.estimate.rmse, mesh_dir)
            write_model(result, robot, target)
        for each in found.tests:
            assert each.signals is not None
            old, new = (torque_error(m, robot, each.signals, each.name) for m in (robot.path, path))
            pairs.append((old, new))
    return replace(result, file=replace(result.file, others=tuple(pairs)))


def written(config: Config, robot: RobotModel, found: Analysis, progress: Progress) -> Outcome:
    """Write all results and pass on what writing them had to say."""
    folder, mesh_dir, result = config.output.output_dir, config.model.mesh_dir, found.result
    refused, as_body, motor_file, scales = None, None, None, None
    if isinstance(config, PayloadConfig):
        as_body, scales = config.payload.as_body, config.payload.save_torque_scale
    elif isinstance(config, SysidConfig):
        motor_file = None if found.plan is None else motor_writer(config, robot, found.plan)
        if config.log.verify_rollout and result.file is not None and result.verdict.is_trustworthy:
            progress.stage("Playing the model on held-out pieces...")
            result = replace(result, rollout=_played(config, robot, found))
            refused = refusal(result.rollout, config.log.accept)
    saved = save(
        result,
        robot,
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
    for note in saved.notes:
        progress.note(note)
    return Outcome(result, found.traces, saved, config.output)


def _played(config: SysidConfig, robot: RobotModel, analysis: Analysis) -> RolloutTest:
    """Return how the model before and the one to be written move beside the arm."""
    answer, mesh_dir = analysis.answer, config.model.mesh_dir
    assert answer is not None
    datasets = analysis.tests or answer.fit.columns.datasets
    signals = [each.signals for each in datasets if each.signals is not None]
    if analysis.tests:
        return play(robot, signals, partial(write_model, analysis.result, robot), mesh_dir)

    def again(target: ModelTarget) -> None:
        """Choose everything anew from the beginning of every log alone, and write that."""
        found = refit(answer, [fitted_rows(log) for log in signals], config.output.keep)
        write_model(result_of(found, analysis.result.data), robot, target)

    return play(robot, signals, again, mesh_dir, split_time, LAST_FIFTH)


def motor_writer(config: SysidConfig, robot: RobotModel, plan: MotionPlan) -> MotorFile | None:
    """Return what writes the trajectory for Damiao motors, or None where none was asked for."""
    motors = config.motors
    if not motors.export_damiao:
        return None
    from robot_sysid.damiao.trajectory import export_damiao_trajectory

    rate = config.trajectory.sample_rate

    def write(file: TextIO) -> DamiaoExportReport:
        motion, ids = commands(robot, plan, rate), (motors.can_id, motors.master_id)
        names = robot.joint_names
        return export_damiao_trajectory(motion, motors.motor_type, file, *ids, joint_names=names)

    return write


def commands(robot: RobotModel, plan: MotionPlan, rate: float) -> Iterator[MotionChunk]:
    """Yield the motion with the torque it takes at a rate [Hz], for playing it on motors.

    Dry friction turns round smoothly: its step at each reversal would be a blow to the arm.
    """
    torque = ArmTorque(robot)
    for motion in motion_chunks(plan, rate):
        turned = np.tanh(motion.qd / _SMOOTH_REVERSAL) - np.sign(motion.qd)
        yield motion.time, motion.q, motion.qd, torque(motion) + robot.friction.coulomb * turned
