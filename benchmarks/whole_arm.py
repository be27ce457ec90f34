"""Friction models of real arms by held-out torque, ranks, and time.

Run from the checkout, for all parts or some of them:

    OMP_NUM_THREADS=1 python -m benchmarks.whole_arm [friction] [ranks] [time]

Torque errors on logs of real arms, of fits and of files, are ``real_logs``.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks import whole_arm_runs as runs_of
from robot_sysid.errors import SysidError
from robot_sysid.estimation.algebra.identifiability import base_combinations
from robot_sysid.estimation.answer import parameter_scale, structural_base
from robot_sysid.estimation.choices import CANDIDATES
from robot_sysid.estimation.columns import Columns
from robot_sysid.estimation.dataset import Dataset
from robot_sysid.estimation.identify import Piece, answer_link, low_pass_recordings
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Measurement
from robot_sysid.records.messages import Progress
from robot_sysid.signals.process import process
from robot_sysid.simulator import ArmTorque
from robot_sysid.trajectory import generate_excitation_trajectory, motion_chunks
from tests.support.log_files import read_measurements
from tests.support.places import DATA, MODELS

KUKA_CUTOFF = 4.5
LAST = {
    "aloha/": ("left/wrist_rotate", "right/wrist_rotate"),
    "openarm_v2/": ("openarm_left_joint7", "openarm_right_joint7"),
    "so101/": ("wrist_roll",),
}
"""Terminal joints of models that hold two arms, or whose last joint is a gripper's."""
FRICTION_ARMS = ("kuka_lwr4/kuka_lwr4.urdf", "tx40/tx40.urdf")
TX40_CUTOFF = 25.0


def main(*parts: str) -> None:
    """Print the parts of the table."""
    for name in parts or ("friction", "ranks", "time"):
        {"friction": friction, "ranks": ranks, "time": duration}[name]()


def answer_of(robot, logs, cutoff: float):
    """The answer from some logs."""
    options = EstimationOptions(cutoff=cutoff)
    datasets, _ = low_pass_recordings(
        robot, [Piece(str(k), log) for k, log in enumerate(logs)], options
    )
    return answer_link(robot, datasets, options, Progress())


def friction() -> None:
    """Held-out torque error of each joint by friction model, and the model that is taken."""
    lwr4, tx40_arm = (load_robot_model(DATA / name) for name in FRICTION_ARMS)
    runs = [read(lwr4, DATA / "kuka_lwr4" / f"lwr4_hw{k}_200Hz.csv") for k in (1, 2, 3)]
    log = read(tx40_arm, DATA / "tx40" / "tx40_500Hz.csv")
    for name, robot, logs, cutoff in (
        ("KUKA LWR4+, three runs", lwr4, runs, KUKA_CUTOFF),
        ("TX40", tx40_arm, [log], TX40_CUTOFF),
    ):
        answer = answer_of(robot, logs, cutoff)
        taken = dict(
            zip(robot.joint_names, (each.name for each in answer.fit.choice.friction))
        )
        print(
            f"{name}, low-pass {cutoff:g} Hz: root mean square held-out torque error [N m]"
        )
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
            structural = structural_base(robot).rank
            seen = rank_of_log(robot)
            wrong += structural != seen
            print(f"  {name} to {robot.terminal_joint}: {seen} of {structural}")
    print(f"whole-arm rank differs from the structural rank on {wrong} models")


def rank_of_log(robot, seconds: float = 15.0, rate: float = 200.0) -> int:
    """Rank of the columns of all links after filtering and decimation."""
    rng = np.random.default_rng(0)
    plan = generate_excitation_trajectory(robot, rng, seconds, ArmTorque(robot))[0]
    q = np.vstack([motion.q for motion in motion_chunks(plan, rate)])
    log = Measurement(np.arange(len(q)) / rate, q, None, rng.normal(size=q.shape))
    signals = process(log, robot.joint_names, 8.0)
    signals = replace(signals, deadband=np.zeros_like(signals.deadband))
    columns = Columns(robot, [Dataset("log", signals)])
    (samples,) = columns.samples(columns.start())
    matrix, _ = samples.information().equations()
    places = [at for name, at in columns.bodies().items() if name != "payload"]
    order = np.concatenate(places)
    return base_combinations(matrix[:, order], parameter_scale(len(places))).rank


def durations() -> dict[str, float]:
    """Processor time of a whole-arm run and of pinocchio's regressor loop with lstsq [s]."""
    import pinocchio

    path = DATA / "kuka_lwr4" / "kuka_lwr4.urdf"
    robot = load_robot_model(path)
    model = pinocchio.buildModelFromUrdf(str(path))
    log, motion = runs_of.measured(robot)
    runs = {
        "pinocchio's regressor loop and lstsq": lambda: runs_of.pinocchio_fit(
            model, model.createData(), motion, log.tau
        ),
        "whole arm, friction given": lambda: runs_of.ours(robot, log),
        "whole arm, everything chosen": lambda: runs_of.ours(
            robot, log, runs_of.CHOSEN
        ),
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
    return read_measurements(
        path, robot.joint_names, robot.limits, is_slide=slides
    ).samples


if __name__ == "__main__":
    main(*sys.argv[1:])
