"""Torque prediction by whole-arm fits on logs of real arms, ranks on public models, and time.

Run from the checkout, for all parts or some of them:

    OMP_NUM_THREADS=1 python -m tests.benchmarks.whole_arm [kuka] [tx40] [friction] [ranks] [time]

Relative error: norm(measured - predicted) / norm(measured), all joints stacked, rows in which a
joint hardly moves left out. "least squares" fits the same links and friction terms without anything
held. All settings but the cut-off come from the fitted data alone; nothing differs between arms.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.errors import SysidError
from robot_sysid.estimation.arm.base_parameters import base_combinations
from robot_sysid.estimation.arm.options import ArmOptions
from robot_sysid.estimation.information import combined, restricted
from robot_sysid.estimation.least_squares import least_squares
from robot_sysid.identify.arm.columns import ArmColumns
from robot_sysid.identify.arm.fit import fit_arm
from robot_sysid.identify.arm.friction_choice import CANDIDATES
from robot_sysid.identify.arm.result import parameter_scale, structural_base
from robot_sysid.identify.samples import joined
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Measurement
from robot_sysid.records.progress import Progress
from robot_sysid.signals.process import process
from robot_sysid.simulator import ArmTorque
from robot_sysid.trajectory import generate_excitation_trajectory, motion_chunks
from tests.support import whole_arm
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
    paths = {k: DATA / "kuka_lwr4" / f"lwr4_hw{k}_200Hz.csv" for k in (1, 2, 3)}
    signals = {
        k: process(read(robot, path), robot.joint_names, KUKA_CUTOFF) for k, path in paths.items()
    }
    print(f"KUKA LWR4+, low-pass {KUKA_CUTOFF} Hz: relative torque error on a run not fitted")
    for fitted, tested, anchor in KUKA_SPLITS:
        logs = [signals[k] for k in fitted]
        fit = fit_arm(robot, logs, ArmOptions(), Progress())
        test = fit.validate_on(robot, [signals[tested]], str(tested))
        plain = least_squares_error(fit, logs, [signals[tested]], robot)
        runs = "+".join(map(str, fitted))
        print(
            f"  {runs} -> {tested}: {percent(test.relative_error)} (anchor {anchor}); "
            f"least squares {percent(plain)}; {described(fit)}"
        )


def tx40() -> None:
    """Five blocked folds, and the last fifth of the moving rows."""
    robot = load_robot_model(DATA / "tx40" / "tx40.urdf")
    log = read(robot, DATA / "tx40" / "tx40_500Hz.csv")
    print("TX40: relative torque error on rows not fitted")
    for cutoff, anchor in TX40_FOLDS:
        fit = fit_arm(robot, [process(log, robot.joint_names, cutoff)], ArmOptions(), Progress())
        error = fit.validation("folds").relative_error
        plain = least_squares_folds(fit)
        print(
            f"  5 blocked folds, {cutoff:g} Hz: {percent(error)} (anchor {anchor}); least squares "
            f"{percent(plain)}; {described(fit)}"
        )
    cutoff, share, anchor = TX40_LAST
    signals = process(log, robot.joint_names, cutoff)
    usable = signals.usable()
    moving = np.flatnonzero(usable.any(axis=1))
    last = np.zeros(len(usable), dtype=bool)
    last[moving[int((1.0 - share) * len(moving)) :]] = True
    fit = fit_arm(robot, [signals], ArmOptions(), Progress(), [~last])
    test = fit.validate_on(robot, [signals], "last", last)
    print(
        f"  last {share:.0%} of the moving rows, {cutoff:g} Hz: {percent(test.relative_error)} "
        f"(anchor {anchor}); {described(fit)}"
    )


def friction() -> None:
    """Held-out torque error of each joint by friction model, and the model that is taken."""
    lwr4, tx40_arm = (load_robot_model(DATA / name) for name in FRICTION_ARMS)
    runs = [read(lwr4, DATA / "kuka_lwr4" / f"lwr4_hw{k}_200Hz.csv") for k in (1, 2, 3)]
    log = read(tx40_arm, DATA / "tx40" / "tx40_500Hz.csv")
    for name, robot, logs, cutoff in (
        ("KUKA LWR4+, three runs", lwr4, runs, KUKA_CUTOFF),
        ("TX40", tx40_arm, [log], TX40_FOLDS[0][0]),
    ):
        signals = [process(each, robot.joint_names, cutoff) for each in logs]
        fit = fit_arm(robot, signals, ArmOptions(), Progress())
        print(f"{name}, low-pass {cutoff:g} Hz: root mean square held-out torque error [N m]")
        models = [short(model) for model in CANDIDATES]
        print("| | " + " | ".join(fit.friction) + " |")
        for model, label in zip(CANDIDATES, models):
            cells = [
                f"{'**' if fit.friction[joint] == model else ''}{errors[model]:.3f}"
                f"{'**' if fit.friction[joint] == model else ''}"
                for joint, errors in fit.choices.items()
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
    columns = ArmColumns(robot, [process(log, robot.joint_names, 8.0, 0.0)])
    samples = joined(columns.samples(np.array([link.theta for link in robot.links])))
    matrix, _ = samples.information().stacked()
    order = np.concatenate([place for _, place in columns.links()])
    return base_combinations(matrix[:, order], parameter_scale(len(order) // 10)).rank


def durations() -> dict[str, float]:
    """Processor time of a whole-arm run and of pinocchio's regressor loop with lstsq [s]."""
    import pinocchio

    path = DATA / "kuka_lwr4" / "kuka_lwr4.urdf"
    robot, model = load_robot_model(path), pinocchio.buildModelFromUrdf(str(path))
    log, motion = whole_arm.measured(robot)
    runs = {
        "pinocchio's regressor loop and lstsq": lambda: whole_arm.pinocchio_fit(
            model, model.createData(), motion, log.tau
        ),
        "whole arm, friction and weight given": lambda: whole_arm.ours(robot, log),
        "whole arm, everything chosen": lambda: whole_arm.ours(robot, log, whole_arm.CHOSEN),
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
    names = [fit.columns.names[k] for k in fit.kept]
    return [name for name in names if not name.startswith(("zero", "tilt"))]


def least_squares_error(fit, fitted, tested, robot) -> float:
    """Relative error on other logs of least squares on the same columns."""
    names = plain_names(fit)
    parts = [samples.information() for samples in fit.columns.samples(fit.thetas)]
    values = solved(combined(parts), names)
    columns = ArmColumns(robot, tested, fit.couplings)
    test = joined(columns.samples(fit.thetas))
    wrong = restricted(test.information(), names).squared_residuals(values)
    return float(np.sqrt(np.sum(wrong) / np.sum(test.squared_torque())))


def least_squares_folds(fit) -> float:
    """The same for the blocks of the fitted log."""
    names, wrong = plain_names(fit), 0.0
    for block, part in enumerate(fit.fits.parts):
        rest = combined([other for k, other in enumerate(fit.fits.parts) if k != block])
        values = solved(rest, names)
        wrong += float(np.sum(restricted(part, names).squared_residuals(values)))
    return float(np.sqrt(wrong / sum(np.sum(log.squared_torque()) for log in fit.samples)))


def solved(information, names):
    """Least squares in some of the columns."""
    few = restricted(information, names)
    return least_squares(few, np.zeros(len(few.names)))


def described(fit) -> str:
    """What was chosen, and whether every link can exist."""
    possible = all(spatial.is_consistent(theta) for theta in fit.thetas if np.any(theta))
    shared = ", ".join(each.name for each in fit.couplings)
    words = f"{sorted(set(fit.friction.values()))}, weight {fit.gamma:g}" + (
        f", shared motor {shared}" if shared else ""
    )
    return words + (", all links possible" if possible else ", NOT ALL LINKS POSSIBLE")


def percent(share: float) -> str:
    """A share in percent."""
    return f"{100.0 * share:.2f} %"


if __name__ == "__main__":
    main(*sys.argv[1:])
