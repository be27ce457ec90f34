"""Torque prediction by fits and written files on logs of real arms, ranks, and time.

Run from the checkout, for all parts or some of them:

    OMP_NUM_THREADS=1 python -m benchmarks.whole_arm [kuka] [tx40] [friction] [ranks] [time]

Relative error: norm(measured - predicted) / norm(measured), all joints stacked, rows in which a
joint hardly moves left out. "file" is the written model, asked by MuJoCo's inverse dynamics, each
joint's mean error (its sensor's offset) taken out; in brackets the model before. "least squares"
fits the same links and friction terms without anything held. All settings but the cut-off come from
the fitted data alone; nothing differs between arms.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from benchmarks import whole_arm_runs as runs_of
from robot_sysid.dynamics import spatial
from robot_sysid.errors import SysidError
from robot_sysid.estimation.algebra.base_parameters import base_combinations
from robot_sysid.estimation.algebra.information import combined, restricted
from robot_sysid.estimation.algebra.least_squares import least_squares
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.estimation.answer import parameter_scale, structural_base
from robot_sysid.estimation.choices import CANDIDATES
from robot_sysid.estimation.columns import Columns
from robot_sysid.estimation.dataset import Dataset
from robot_sysid.estimation.identify import Piece, answer_link, filtered, refit, tested
from robot_sysid.estimation.result import result_of
from robot_sysid.export import save
from robot_sysid.model.compilation import compile_model
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Measurement
from robot_sysid.records.progress import Progress
from robot_sysid.results.model import CHECKPOINTS
from robot_sysid.signals.process import process
from robot_sysid.simulator import ArmTorque
from robot_sysid.trajectory import generate_excitation_trajectory, motion_chunks
from tests.support.core_fits import ORIGIN
from tests.support.log_files import read_measurements
from tests.support.places import DATA, MODELS

KUKA_CUTOFF = 4.5
KUKA_SPLITS = (((1,), 3, "3.3"), ((1, 2), 3, "3.0"), ((1,), 2, "1.8"), ((2, 3), 1, "2.2"))
LAST = {
    "aloha/": ("left/wrist_rotate", "right/wrist_rotate"),
    "openarm_v2/": ("openarm_left_joint7", "openarm_right_joint7"),
    "so101/": ("wrist_roll",),
}
"""Terminal joints of models that hold two arms, or whose last joint is a gripper's."""
FRICTION_ARMS = ("kuka_lwr4/kuka_lwr4.urdf", "tx40/tx40.urdf")
TX40_FOLDS = ((25.0, "4.3"), (10.0, "3.9"))
TX40_LAST = (20.0, 0.2, "4.8")


def main(*parts: str) -> None:
    """Print the parts of the table."""
    for name in parts or ("kuka", "tx40", "friction", "ranks", "time"):
        {"kuka": kuka, "tx40": tx40, "friction": friction, "ranks": ranks, "time": duration}[name]()


def kuka() -> None:
    """Fit some runs, predict another."""
    robot = load_robot_model(DATA / "kuka_lwr4" / "kuka_lwr4.urdf")
    logs = {k: read(robot, DATA / "kuka_lwr4" / f"lwr4_hw{k}_200Hz.csv") for k in (1, 2, 3)}
    print(f"KUKA LWR4+, low-pass {KUKA_CUTOFF} Hz: relative torque error on a run not fitted")
    for fitted, other, anchor in KUKA_SPLITS:
        answer = answer_of(robot, [logs[k] for k in fitted], KUKA_CUTOFF)
        datasets, _ = filtered(robot, [Piece("", logs[other])], options_of(KUKA_CUTOFF))
        error = tested(answer.fit, datasets, str(other)).relative_error
        plain = least_squares_error(answer.fit, datasets)
        runs = "+".join(map(str, fitted))
        print(
            f"  {runs} -> {other}: {percent(error)} (anchor {anchor}), "
            f"{of_file(answer, datasets[0].signals)}; least squares {percent(plain)}; "
            f"{described(answer.fit)}",
            flush=True,
        )


def tx40() -> None:
    """Five blocked folds, and the last fifth of the moving rows."""
    robot = load_robot_model(DATA / "tx40" / "tx40.urdf")
    log = read(robot, DATA / "tx40" / "tx40_500Hz.csv")
    print("TX40: relative torque error on rows not fitted")
    for cutoff, anchor in TX40_FOLDS:
        answer = answer_of(robot, [log], cutoff)
        before, after = (percent(v.relative_error) for v in (answer.file.before, answer.file.after))
        print(
            f"  5 blocked folds, {cutoff:g} Hz: {percent(answer.validation.relative_error)} "
            f"(anchor {anchor}), what a file holds {after} (model {before}); least squares "
            f"{percent(least_squares_folds(answer.fit))}; {described(answer.fit)}"
        )
    cutoff, share, anchor = TX40_LAST
    whole = answer_of(robot, [log], cutoff)
    (dataset,) = whole.fit.columns.datasets
    usable = dataset.signals.usable()
    moving = np.flatnonzero(usable.any(axis=1))
    last = np.zeros(len(usable), dtype=bool)
    last[moving[int((1.0 - share) * len(moving)) :]] = True
    answer = refit(whole, [~last], ())
    error = tested(answer.fit, [replace(dataset, used=last)], "last").relative_error
    print(
        f"  last {share:.0%} of the moving rows, {cutoff:g} Hz: {percent(error)} (anchor {anchor})"
        f", {of_file(answer, dataset.signals, last)}; {described(answer.fit)}"
    )


def options_of(cutoff: float) -> EstimationOptions:
    """The usual ones."""
    return EstimationOptions(cutoff=cutoff)


def answer_of(robot, logs, cutoff: float):
    """The answer from some logs."""
    options = options_of(cutoff)
    datasets, _ = filtered(robot, [Piece(str(k), log) for k, log in enumerate(logs)], options)
    return answer_link(robot, datasets, options, Progress())


def of_file(answer, signals, rows=None) -> str:
    """The error of the file that is written, and of the model, on another log."""
    robot, own = answer.robot, answer.fit.columns.datasets[0].signals
    checkpoints = own.motion(own.spread(CHECKPOINTS))
    with tempfile.TemporaryDirectory() as folder:
        saved = save(result_of(answer, ORIGIN), robot, Path(folder), checkpoints)
        if saved.failure is not None:
            return f"no file: {saved.failure}"
        before, after = (file_error(p, robot, signals, rows) for p in (robot.path, saved.files[0]))
    return f"file {percent(after)} (model {percent(before)})"


def file_error(path: Path, robot, signals, rows=None) -> float:
    """Relative error of a file's inverse dynamics in some rows (K,), each joint's mean out."""
    model = compile_model(path).mj_model
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    data = mujoco.MjData(model)
    data.qpos[:] = robot.reference_qpos
    torque = np.empty_like(signals.tau)
    for k, (q, qd, qdd) in enumerate(zip(signals.q, signals.qd, signals.qdd)):
        data.qpos[robot.qpos_index], data.qvel[robot.dof_index] = q, qd
        data.qacc[robot.dof_index] = qdd
        mujoco.mj_inverse(model, data)
        torque[k] = data.qfrc_inverse[robot.dof_index]
    torque += model.dof_frictionloss[robot.dof_index] * np.sign(signals.qd)
    used = signals.usable() if rows is None else signals.usable() & rows[:, None]
    measured, found = (
        np.where(used, signals.low_pass.decimated(each), np.nan) for each in (signals.tau, torque)
    )
    off = measured - found
    off -= np.nanmean(off, axis=0)
    return float(np.sqrt(np.nansum(off**2) / np.nansum(measured**2)))


def friction() -> None:
    """Held-out torque error of each joint by friction model, and the model that is taken."""
    lwr4, tx40_arm = (load_robot_model(DATA / name) for name in FRICTION_ARMS)
    runs = [read(lwr4, DATA / "kuka_lwr4" / f"lwr4_hw{k}_200Hz.csv") for k in (1, 2, 3)]
    log = read(tx40_arm, DATA / "tx40" / "tx40_500Hz.csv")
    for name, robot, logs, cutoff in (
        ("KUKA LWR4+, three runs", lwr4, runs, KUKA_CUTOFF),
        ("TX40", tx40_arm, [log], TX40_FOLDS[0][0]),
    ):
        answer = answer_of(robot, logs, cutoff)
        taken = dict(zip(robot.joint_names, (each.name for each in answer.fit.choice.friction)))
        print(f"{name}, low-pass {cutoff:g} Hz: root mean square held-out torque error [N m]")
        models = [short(model) for model in CANDIDATES]
        print("| | " + " | ".join(taken) + " |")
        for model, label in zip(CANDIDATES, models):
            cells = [
                f"{'**' if taken[joint] == model else ''}{errors[model]:.3f}"
                f"{'**' if taken[joint] == model else ''}"
                for joint, errors in answer.candidates.items()
            ]
            print(f"| {label} | " + " | ".join(cells) + " |")


def short(model: str) -> str:
    """A friction model's name without what all have."""
    return model.replace("-offset-armature", "")


def ranks() -> None:
    """Rank of a short log's link columns against the structural one, for every public model."""
    wrong = 0
    for path in sorted([*MODELS.rglob("*.xml"), *MODELS.rglob("*.urdf")]):
        name = str(path.relative_to(MODELS))
        for joint in next(
            (own for folder, own in LAST.items() if name.startswith(folder)), (None,)
        ):
            try:
                robot = load_robot_model(path, joint=joint)
            except SysidError as error:
                print(f"  {name}: no arm ({str(error)[:60]}...)")
                continue
            structural, seen = structural_base(robot).rank, rank_of_log(robot)
            wrong += structural != seen
            print(f"  {name} to {robot.terminal_joint}: {seen} of {structural}")
    print(f"whole-arm rank differs from the structural rank on {wrong} models")


def rank_of_log(robot, seconds: float = 15.0, rate: float = 200.0) -> int:
    """Rank of the columns of all links after filtering and decimation."""
    rng = np.random.default_rng(0)
    plan = generate_excitation_trajectory(robot, rng, seconds, ArmTorque(robot))[0]
    q = np.vstack([motion.q for motion in motion_chunks(plan, rate)])
    log = Measurement(np.arange(len(q)) / rate, q, None, rng.normal(size=q.shape))
    columns = Columns(robot, [Dataset("log", process(log, robot.joint_names, 8.0, 0.0))])
    (samples,) = columns.samples(columns.start())
    matrix, _ = samples.information().stacked()
    places = [at for name, at in columns.bodies().items() if name != "payload"]
    order = np.concatenate(places)
    return base_combinations(matrix[:, order], parameter_scale(len(places))).rank


def durations() -> dict[str, float]:
    """Processor time of a whole-arm run and of pinocchio's regressor loop with lstsq [s]."""
    import pinocchio

    path = DATA / "kuka_lwr4" / "kuka_lwr4.urdf"
    robot, model = load_robot_model(path), pinocchio.buildModelFromUrdf(str(path))
    log, motion = runs_of.measured(robot)
    runs = {
        "pinocchio's regressor loop and lstsq": lambda: runs_of.pinocchio_fit(
            model, model.createData(), motion, log.tau
        ),
        "whole arm, friction given": lambda: runs_of.ours(robot, log),
        "whole arm, everything chosen": lambda: runs_of.ours(robot, log, runs_of.CHOSEN),
    }
    for run in runs.values():
        run()
    # In turns, so that what else the machine does slows all of them.
    rounds = [{name: timed(run) for name, run in runs.items()} for _ in range(5)]
    return {name: min(each[name] for each in rounds) for name in runs}


def duration() -> None:
    """Print the processor times."""
    print("7 joints, 15 000 samples, best of 5, processor time")
    spent = durations()
    base = next(iter(spent.values()))
    for name, seconds in spent.items():
        print(f"  {name}: {seconds:.2f} s, {seconds / base:.1f} times")


def timed(run) -> float:
    """Processor time of one call [s]."""
    before = time.process_time()
    run()
    return time.process_time() - before


def read(robot, path: Path) -> Measurement:
    """The whole log."""
    slides = robot.is_slide.tolist()
    return read_measurements(path, robot.joint_names, robot.limits, is_slide=slides).samples


def plain_names(fit) -> list[str]:
    """Names of the fit's links and friction, without what people do not fit."""
    gone = ("zero", "tilt", "scale", "delay")
    known = {
        name for group in fit.unknowns.groups if group.cause != "links" for name in group.names
    }
    return [n for n in fit.unknowns.kept_names if n not in known and not n.startswith(gone)]


def least_squares_error(fit, datasets) -> float:
    """Relative error on other logs of least squares on the same columns."""
    names, own = plain_names(fit), fit.columns
    values = solved(fit.evidence.whole, names)
    other = Columns(own.robot, datasets, own.torques, own.couplings)
    test = other.samples(replace(fit.point, values=own.prior))
    seen = combined([each.information() for each in test])
    wrong = np.sum(restricted(seen, names).squared_residuals(values))
    return float(np.sqrt(wrong / np.sum([each.squared_torque() for each in test])))


def least_squares_folds(fit) -> float:
    """The same for the blocks of the fitted log."""
    names, wrong, parts = plain_names(fit), 0.0, fit.evidence.blocks
    for block, part in enumerate(parts):
        rest = combined([other for k, other in enumerate(parts) if k != block])
        values = solved(rest, names)
        wrong += float(np.sum(restricted(part, names).squared_residuals(values)))
    return float(np.sqrt(wrong / np.sum(fit.evidence.squared_torque)))


def solved(information, names):
    """Least squares in some of the columns."""
    few = restricted(information, names)
    return least_squares(few, np.zeros(len(few.names)), np.ones(len(few.joints)))


def described(fit) -> str:
    """What was chosen, and whether every link can exist."""
    possible = all(spatial.is_consistent(fit.values[at]) for at, _ in fit.unknowns.bodies.values())
    shared = ", ".join(each.name for each in fit.choice.couplings)
    models = sorted({short(each.name) for each in fit.choice.friction})
    words = f"{models}, links up to {fit.choice.prior_scale:g} times as far off as said" + (
        f", shared motor {shared}" if shared else ""
    )
    return words + (", all links possible" if possible else ", NOT ALL LINKS POSSIBLE")


def percent(share: float) -> str:
    """A share in percent."""
    return f"{100.0 * share:.2f} %"


if __name__ == "__main__":
    main(*sys.argv[1:])
