"""Friction models of real arms by held-out torque, ranks of public models, and processor time.

Run from the checkout, for all parts or some of them:

    OMP_NUM_THREADS=1 python -m benchmarks.whole_arm [friction] [ranks] [time]

Torque errors on logs of real arms, of fits and of files, are in ``real_logs``.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
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
from tests.support.core_fits import BASIC, result_of_logs
from tests.support.log_files import read_measurements
from tests.support.places import DATA, MODELS

KUKA_MODEL = DATA / "kuka_lwr4" / "kuka_lwr4.urdf"
KUKA_LOGS = [DATA / "kuka_lwr4" / f"lwr4_hw{run}_200Hz.csv" for run in (1, 2, 3)]
KUKA_CUTOFF = 4.5
"""Cut-off frequency of the KUKA's logs [Hz]."""
TX40_MODEL = DATA / "tx40" / "tx40.urdf"
TX40_LOG = DATA / "tx40" / "tx40_500Hz.csv"
TX40_CUTOFF = 25.0
"""Cut-off frequency of the TX40's log [Hz]."""
TERMINAL_JOINTS = {
    "aloha/": ("left/wrist_rotate", "right/wrist_rotate"),
    "openarm_v2/": ("openarm_left_joint7", "openarm_right_joint7"),
    "so101/": ("wrist_roll",),
}
"""Terminal joints of models that hold two arms, or whose last joint is a gripper's."""
SAMPLES = 15_000
RATE = 1000.0
ROUNDS = 5
FRICTION_GIVEN = EstimationOptions(cutoff=10.0, friction_model=BASIC)
FRICTION_CHOSEN = EstimationOptions(cutoff=10.0)


def main(*names: str) -> None:
    """Print parts of the output, all by default."""
    printers = {"friction": print_friction, "ranks": print_ranks, "time": print_times}
    for name in names or printers:
        printers[name]()


def print_friction() -> None:
    """Print the held-out torque error of each joint by friction model; the chosen one is bold."""
    for title, model, paths, cutoff in (
        ("KUKA LWR4+, three runs", KUKA_MODEL, KUKA_LOGS, KUKA_CUTOFF),
        ("TX40", TX40_MODEL, [TX40_LOG], TX40_CUTOFF),
    ):
        robot = load_robot_model(model)
        answer = answer_of(robot, [read_log(robot, path) for path in paths], cutoff)
        friction_names = [friction.name for friction in answer.fit.choice.friction]
        chosen_models = dict(zip(robot.joint_names, friction_names))
        print(f"{title}, low-pass {cutoff:g} Hz: held-out torque error, rms [N m]")
        print("| | " + " | ".join(chosen_models) + " |")
        for candidate in CANDIDATES:
            cells = []
            for joint, errors in answer.candidates.items():
                mark = "**" if chosen_models[joint] == candidate else ""
                cells.append(f"{mark}{errors[candidate]:.3f}{mark}")
            label = candidate.replace("-offset-armature", "")
            print(f"| {label} | " + " | ".join(cells) + " |")


def answer_of(robot, logs, cutoff: float):
    """Return the answer about the terminal link from logs, low-passed at a cut-off [Hz]."""
    options = EstimationOptions(cutoff=cutoff)
    pieces = [Piece(str(number), log) for number, log in enumerate(logs)]
    datasets, _ = low_pass_recordings(robot, pieces, options)
    return answer_link(robot, datasets, options, Progress())


def read_log(robot, path: Path) -> Measurement:
    """Return all samples of a log."""
    is_slide = robot.is_slide.tolist()
    log = read_measurements(path, robot.joint_names, robot.limits, is_slide=is_slide)
    return log.samples


def print_ranks() -> None:
    """Print the rank of a short log's link columns and the structural rank of public models."""
    difference_count = 0
    for path in sorted([*MODELS.rglob("*.xml"), *MODELS.rglob("*.urdf")]):
        name = str(path.relative_to(MODELS))
        folder = name.partition("/")[0] + "/"
        for joint in TERMINAL_JOINTS.get(folder, (None,)):
            try:
                robot = load_robot_model(path, joint=joint)
            except SysidError as error:
                print(f"  {name}: no arm ({str(error)[:60]}...)")
                continue
            structural = structural_base(robot).rank
            rank = rank_of_log(robot)
            difference_count += structural != rank
            print(f"  {name} to {robot.terminal_joint}: {rank} of {structural}")
    print(
        f"whole-arm rank differs from the structural rank on {difference_count} models"
    )


def rank_of_log(robot, seconds: float = 15.0, rate: float = 200.0) -> int:
    """Return the rank of the columns of all links after filtering and decimation."""
    rng = np.random.default_rng(0)
    plan = generate_excitation_trajectory(robot, rng, seconds, ArmTorque(robot))[0]
    q = np.vstack([motion.q for motion in motion_chunks(plan, rate)])
    log = Measurement(np.arange(len(q)) / rate, q, None, rng.normal(size=q.shape))
    signals = process(log, robot.joint_names, 8.0)
    signals = replace(signals, deadband=np.zeros_like(signals.deadband))
    columns = Columns(robot, [Dataset("log", signals)])
    (samples,) = columns.samples(columns.start())
    matrix, _ = samples.information().equations()
    bodies = columns.bodies()
    indices = [bodies[name] for name in bodies if name != "payload"]
    order = np.concatenate(indices)
    return base_combinations(matrix[:, order], parameter_scale(len(indices))).rank


def print_times() -> None:
    """Print the processor times."""
    print(f"7 joints, 15 000 samples, best of {ROUNDS}, processor time")
    seconds_by_name = durations()
    base = next(iter(seconds_by_name.values()))
    for name, seconds in seconds_by_name.items():
        print(f"  {name}: {seconds:.2f} s, {seconds / base:.1f} times")


def durations() -> dict[str, float]:
    """Return processor times of whole-arm runs and of pinocchio's loop with lstsq [s]."""
    import pinocchio

    robot = load_robot_model(KUKA_MODEL)
    model = pinocchio.buildModelFromUrdf(str(KUKA_MODEL))
    log, motion = simulate_log(robot)
    runs = {
        "pinocchio's regressor loop and lstsq": lambda: fit_with_pinocchio(
            model, motion, log.tau
        ),
        "whole arm, friction given": lambda: result_of_logs(
            robot, [log], FRICTION_GIVEN, ()
        ),
        "whole arm, everything chosen": lambda: result_of_logs(
            robot, [log], FRICTION_CHOSEN, ()
        ),
    }
    for run in runs.values():
        run()
    # In turns, so that other work of the machine slows all of them.
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(ROUNDS):
        for name, run in runs.items():
            begin = time.process_time()
            run()
            seconds[name].append(time.process_time() - begin)
    return {name: min(times) for name, times in seconds.items()}


def simulate_log(robot):
    """Return a log of an arm with friction, six harmonics per joint, and (q, qd, qdd) (N, n)."""
    rng = np.random.default_rng(0)
    clock = np.arange(SAMPLES) / RATE
    rates = 2.0 * np.pi * 0.1 * np.arange(1, 7)
    size = rng.normal(size=(6, robot.n_joints)) * 0.4
    phase = rng.uniform(0.0, 6.0, (6, robot.n_joints))
    angle = rates[:, None, None] * clock[:, None] + phase[:, None]
    q = np.sum(size[:, None] * np.sin(angle), axis=0)
    qd = np.sum((rates[:, None] * size)[:, None] * np.cos(angle), axis=0)
    qdd = -np.sum((rates[:, None] ** 2 * size)[:, None] * np.sin(angle), axis=0)
    thetas = np.array([1.1 * link.theta for link in robot.links])
    tau = LinkDynamics(robot).motion(q, qd, qdd).torque(thetas)
    tau += 0.5 * np.sign(qd) + 0.3 * qd + 0.2 * rng.normal(size=q.shape)
    return Measurement(clock, q, None, tau), (q, qd, qdd)


def fit_with_pinocchio(model, motion, tau):
    """Return least squares of all links with Coulomb and viscous friction and offset (p,)."""
    import pinocchio

    data = model.createData()
    blocks = []
    for row in zip(*motion):
        blocks.append(pinocchio.computeJointTorqueRegressor(model, data, *row))
    qd = motion[1]
    samples, joints = qd.shape
    friction = [np.sign(qd), qd, np.ones_like(qd)]
    joint_columns = [column[:, :, None] * np.eye(joints) for column in friction]
    rows = np.concatenate((np.array(blocks), *joint_columns), axis=-1)
    matrix = rows.reshape(samples * joints, -1)
    return np.linalg.lstsq(matrix, tau.ravel(), rcond=None)[0]


if __name__ == "__main__":
    main(*sys.argv[1:])
