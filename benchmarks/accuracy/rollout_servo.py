"""Arms without torque sensors: how far are the found servos, friction and rotor inertia off?

    OMP_NUM_THREADS=1 python -m benchmarks.accuracy.rollout_servo [so101] [openarm]

An arm with other gains, damping, friction and rotor inertia than its model's plays 40 s of sines
and steps. Its servos have a torque limit beside their damping, friction at rest beyond Coulomb's
and friction that grows with load, a dead zone, and a lag. Commands and positions are logged at
50 Hz in steps of 0.1 degrees; commands act 20 ms late. The arm is stepped by ``ArmStepper`` at
0.5 ms, not by what fits it.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.accuracy import servo_arm
from rigs.files.places import MODELS
from rigs.logs.log_files import open_log
from robot_sysid.config import IdentifyConfig
from robot_sysid.parser import load_robot_model
from robot_sysid.records.messages import Progress
from robot_sysid.records.quantities import FILE
from robot_sysid.servo import run_servo
from robot_sysid.servo.held_out import hold_out
from robot_sysid.servo.loop import rms
from robot_sysid.servo.windows import ServoProblem
from robot_sysid.simulation.playback import servos_in_model

ARMS = {
    "so101": ("so101/so101_new_calib.xml", "wrist_roll"),
    "openarm": ("openarm_v2/openarm_bimanual.xml", "openarm_left_joint7"),
}
STEP = np.radians(0.1)
STRIBECK = 0.3
"""Friction at rest beyond Coulomb's, over it."""
LOAD_SHARE = 0.1
LOAD_STRIBECK = 0.1
DEAD_ZONE = np.radians(0.3)
LAG = 0.005


def true_arm(robot, rng):
    """Return an arm with all that a servo may have."""
    arm = servo_arm.other_than(robot, rng)
    return replace(
        arm,
        stribeck=STRIBECK * arm.coulomb,
        load_share=LOAD_SHARE,
        load_stribeck=LOAD_STRIBECK,
        dead_zone=DEAD_ZONE,
        lag=LAG,
    )


def true_numbers(arm) -> dict:
    """Return the true numbers (n,) of an arm's joints by the names of servo.json."""
    return {
        "gain": arm.stiffness,
        "torque_limit": arm.limit,
        "damping": arm.damping,
        "frictionloss": arm.coulomb,
        "armature": arm.armature,
        "stribeck": arm.stribeck,
        "load_share": np.full_like(arm.coulomb, arm.load_share),
        "load_stribeck": np.full_like(arm.coulomb, arm.load_stribeck),
        "dead_zone": np.full_like(arm.coulomb, arm.dead_zone),
        "loop_lag": np.full_like(arm.coulomb, arm.lag),
    }


def main(*names: str) -> None:
    """Print truth, estimate and held-out errors."""
    np.set_printoptions(precision=4, suppress=True, linewidth=120)
    for name in names or ARMS:
        path, joint = ARMS[name]
        robot = load_robot_model(MODELS / path, joint=joint)
        rng = np.random.default_rng(3)
        arm = true_arm(robot, rng)
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder) / "log.csv"
            servo_arm.write_log(log, arm, *servo_arm.commands(robot, rng), STEP)
            options = {"measurements": (log,), "output_dir": Path(folder) / "out"}
            config = IdentifyConfig.of(robot.path, **options)
            begun = time.process_time()
            outcome = run_servo(config, robot, Progress())
            spent = time.process_time() - begun
            piece = open_log(robot, log, replace(config.log, commanded=True))
            _, held = hold_out(piece)
        report(name, arm, robot, outcome, held, spent)


def report(name, arm, robot, outcome, held, spent) -> None:
    """Print one arm."""
    result = outcome.result
    fit = result.fit
    print(f"{name}: {spent:.0f} s; {outcome.failure or 'model written'}")
    delay_error = 1e3 * fit.delay_error
    print(
        f"  delay {1e3 * fit.delay:.2f} ± {delay_error:.2f} ms, true {1e3 * arm.delay:g}"
    )
    found = [row for row in result.quantities if row.source != FILE]
    for term, values in true_numbers(arm).items():
        rows = [row for row in found if row.name == term]
        estimates = np.array([row.value for row in rows])
        errors = np.array([row.error for row in rows])
        print(f"  {term} [{rows[0].unit}]: true {values}")
        print(f"    found {estimates}\n    error {errors}")
    problem = ServoProblem(robot, [held], result.setting, fit.delay)
    before = servos_in_model(robot)
    old = rms(problem.errors(before))
    late = rms(result.before)
    new = rms(result.after)
    print(
        f"  held out, {problem.length:.2g} s: model {old:.4g} rad, model with the delay found "
        f"{late:.4g}, found {new:.4g}: {old / new:.1f} and {late / new:.1f} times smaller"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
