"""The stages of a recorded motion, of a real arm or of another model that plays it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from robot_sysid.config import SysidConfig
from robot_sysid.diagnosis.run import look_at
from robot_sysid.estimation.answer import traces_of
from robot_sysid.estimation.dataset import Dataset
from robot_sysid.estimation.fit import release_memory
from robot_sysid.estimation.identify import (
    Piece,
    answer_link,
    low_pass_recordings,
    refit,
    shared_notes,
)
from robot_sysid.estimation.result import result_of
from robot_sysid.estimation.unknowns import FILE_FRICTION, FILE_ROTORS
from robot_sysid.logs.reader import MeasurementLog, open_log, origin_of
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.outcome import Analysis
from robot_sysid.records import DataOrigin, MotionPlan, RobotModel, Source
from robot_sysid.records.arm import InertialParameters
from robot_sysid.records.atomic_files import MODEL_NAMES, temporary_folder, whole_files
from robot_sysid.records.data import Traces
from robot_sysid.records.progress import Progress
from robot_sysid.records.results import RolloutTest
from robot_sysid.results.model import CHECKPOINTS, ModelTarget, write_model
from robot_sysid.results.record import Result
from robot_sysid.results.rollout import (
    LAST_FIFTH,
    fitted_rows,
    play,
    split_time,
    torque_error,
)
from robot_sysid.signals.resampling import MOST_KEPT, bounded
from robot_sysid.simulation.plant import PlantSimulation, load_plant
from robot_sysid.trajectory import CHUNK, sample_count

_NOISE_STREAM = 1


@dataclass(frozen=True)
class _Recorded:
    """Recordings to identify an arm from, those by name that only test it, and what is to be said
    of them; what was measured itself is needed no more.
    """

    datasets: Sequence[Dataset]
    tests: Mapping[str, Sequence[Dataset]]
    origin: DataOrigin
    notes: tuple[str, ...]


def of_logs(config: SysidConfig, robot: RobotModel, progress: Progress) -> Analysis:
    """Read logs, look at them and identify the arm from them."""
    return _identified(config, robot, _read(config, robot, progress), progress)


def _read(config: SysidConfig, robot: RobotModel, progress: Progress) -> _Recorded:
    options = config.log
    tests = []
    logs = []
    for path in options.measurements:
        progress.stage(f"Reading measurements from {path}...")
        logs.append(open_log(robot, path, options, progress))
    if config.arm.save_measurements is not None:
        write_measurement_csv(
            config.arm.save_measurements, robot.joint_names, [logs[0].samples]
        )
    if options.validation_measurements is not None:
        tests.append(
            open_log(robot, options.validation_measurements, options, progress)
        )
        progress.note(*(type(n)(f"validation log: {n}") for n in tests[0].notes))
    checked(config, robot, [*logs, *tests], progress)
    pieces = [
        Piece(str(log.path), p.without_velocities()) for log in logs for p in log.pieces
    ]
    notes = tuple(shared_notes({str(log.path): log.notes for log in logs}))
    origin = origin_of(logs)
    del logs  # and with them the velocities, before signals are made
    return _filtered(config, robot, pieces, origin, notes, tests)


def of_plant(
    config: SysidConfig,
    robot: RobotModel,
    plan: MotionPlan,
    seed: int,
    progress: Progress,
) -> Analysis:
    """Let another model play the real arm, and identify from what its sensors say."""
    arm = config.arm
    rate = config.trajectory.sample_rate
    assert arm.plant_model is not None
    plant = load_plant(robot, arm.plant_model, config.model.mesh_dir)
    progress.stage(f"Running MuJoCo simulation of {arm.plant_model}...")
    rng = np.random.default_rng([seed, _NOISE_STREAM])
    simulation = PlantSimulation(plant, plan, arm, rate, rng)
    count = sample_count(plan.duration, rate)
    label = "Collecting measurements"
    chunks = math.ceil(count / CHUNK)
    parts, cut = bounded(progress.track(iter(simulation), label, chunks), count)
    if arm.save_measurements is not None:
        whole = simulation if count > MOST_KEPT else parts
        write_measurement_csv(arm.save_measurements, robot.joint_names, whole)
    notes = (*plant.notes, *cut)
    name = str(arm.plant_model)
    origin = DataOrigin(Source.SIMULATED_ARM, name, plan.duration, rate, seed)
    pieces = [Piece(name, part) for part in parts]
    recorded = _filtered(config, robot, pieces, origin, notes)
    del parts, pieces  # what was measured itself is needed no more
    found = _identified(config, robot, recorded, progress)
    truth = plant.prior
    return replace(found, traces=partial(_with_truth, found.traces, truth))


def _with_truth(traces: Callable[[], Traces], truth: InertialParameters) -> Traces:
    return replace(traces(), truth=truth)


def checked(
    config: SysidConfig,
    robot: RobotModel,
    logs: Sequence[MeasurementLog],
    progress: Progress,
) -> None:
    """Look at each log against the model; stop at what must not become a number."""
    late = ("delay",) if config.estimation.delay == "auto" else ()
    for done, log in enumerate(logs):
        progress.advance("Looking for what is wrong with the logs", done, len(logs), "")
        release_memory()
        look_at(robot, log, (*config.log.accept, *late), progress, config.estimation)


def _filtered(
    config: SysidConfig,
    robot: RobotModel,
    pieces: Sequence[Piece],
    origin: DataOrigin,
    notes: Sequence[str],
    tests: Sequence[MeasurementLog] = (),
) -> _Recorded:
    options = config.estimation
    others = {}
    datasets, said = low_pass_recordings(robot, pieces, options)
    cutoff = datasets[0].signals.cutoff if datasets[0].signals else options.cutoff
    for log in tests:
        parts = [Piece(str(log.path), part) for part in log.pieces]
        others[str(log.path)] = low_pass_recordings(
            robot, parts, replace(options, cutoff=cutoff)
        )[0]
    return _Recorded(datasets, others, origin, (*notes, *said))


def _identified(
    config: SysidConfig, robot: RobotModel, recorded: _Recorded, progress: Progress
) -> Analysis:
    options = config.estimation
    datasets = recorded.datasets
    notes = recorded.notes
    progress.note(*notes)
    kept = config.output.keep + (
        (FILE_FRICTION, FILE_ROTORS) if options.no_friction else ()
    )
    answer = answer_link(robot, datasets, options, progress, kept, recorded.tests)
    answer = replace(answer, notes=(*notes, *answer.notes))
    result = result_of(answer, recorded.origin)
    progress.note(
        *(note for note in result.notes if note not in (*robot.notes, *notes))
    )
    assert (first := datasets[0].signals) is not None
    checkpoints = first.motion(first.spread(CHECKPOINTS))
    held_out = tuple(each for parts in recorded.tests.values() for each in parts)
    found = Analysis(result, checkpoints, partial(traces_of, answer), answer, held_out)
    return replace(found, result=_file_tested(robot, found, config.model.mesh_dir))


def _file_tested(robot: RobotModel, found: Analysis, mesh_dir: Path | None) -> Result:
    """Return the result with the written file's own error on other logs, by inverse dynamics."""
    result = found.result
    if result.file is None or not found.tests or not result.verdict.writes_model:
        return result
    pairs = []
    with temporary_folder() as folder:
        path = folder / MODEL_NAMES["mjcf"]  # what is in it tells its kind
        with whole_files() as files:
            target = ModelTarget(
                files, path, found.checkpoints, result.estimate.rmse, mesh_dir
            )
            write_model(result, target)
        for each in found.tests:
            assert each.signals is not None
            old, new = (
                torque_error(m, robot, each.signals, each.name)
                for m in (robot.path, path)
            )
            pairs.append((old, new))
    return replace(result, file=replace(result.file, others=tuple(pairs)))


def played(config: SysidConfig, robot: RobotModel, analysis: Analysis) -> RolloutTest:
    """Return how the model before and the one to be written move beside the arm."""
    answer = analysis.answer
    mesh_dir = config.model.mesh_dir
    assert answer is not None
    datasets = analysis.tests or answer.fit.columns.datasets
    signals = [each.signals for each in datasets if each.signals is not None]
    if analysis.tests:
        return play(robot, signals, partial(write_model, analysis.result), mesh_dir)

    def again(target: ModelTarget) -> None:
        """Choose everything anew from the beginning of every log alone, and write that."""
        found = refit(answer, [fitted_rows(log) for log in signals], config.output.keep)
        write_model(result_of(found, analysis.result.data), target)

    return play(robot, signals, again, mesh_dir, split_time, LAST_FIFTH)
