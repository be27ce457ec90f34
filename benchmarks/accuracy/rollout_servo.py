"""Arms without torque sensors: how far are the found servos, friction and rotor inertia off?

    OMP_NUM_THREADS=1 python -m benchmarks.accuracy.rollout_servo [so101] [openarm]

An arm with other gains, damping, friction and rotor inertia than its model's plays 40 s of sines
and steps. Commands and positions are logged at 50 Hz in steps of 0.1 degrees; commands act 20 ms
late. It is stepped by ``ArmStepper`` at 0.5 ms with Coulomb friction, not by what fits it.
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
from robot_sysid.servo import HELD_OUT_SHARE, run_servo
from robot_sysid.servo.loop import rms
from robot_sysid.servo.result import UNITS
from robot_sysid.servo.windows import WINDOW, ServoProblem
from robot_sysid.simulation.playback import ServoRollouts, servos_in_model

ARMS = {
    "so101": ("so101/so101_new_calib.xml", "wrist_roll"),
    "openarm": ("openarm_v2/openarm_bimanual.xml", "openarm_left_joint7"),
}
STEP = np.radians(0.1)


def main(*names: str) -> None:
    """Print truth, estimate and held-out errors."""
    np.set_printoptions(precision=4, suppress=True, linewidth=120)
    for name in names or ARMS:
        path, joint = ARMS[name]
        robot = load_robot_model(MODELS / path, joint=joint)
        rng = np.random.default_rng(3)
        arm = servo_arm.other_than(robot, rng)
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder) / "log.csv"
            servo_arm.write_log(log, arm, *servo_arm.commands(robot, rng), STEP)
            options = {"measurements": (log,), "output_dir": Path(folder) / "out"}
            config = IdentifyConfig.of(robot.path, **options)
            begun = time.monotonic()
            outcome = run_servo(config, robot, Progress())
            spent = time.monotonic() - begun
            piece = open_log(robot, log, replace(config.log, commanded=True))
            first = round((1.0 - HELD_OUT_SHARE) * len(piece))
            held = piece[first:]
        report(name, arm, robot, outcome, held, spent)


def report(name, arm, robot, outcome, held, spent) -> None:
    """Print one arm."""
    result = outcome.result
    servos = result.fit
    delay_error = result.fit.delay_error
    print(f"{name}: {spent:.0f} s; {outcome.failure or 'model written'}")
    print(f"  delay {1e3 * servos.delay:.2f} ± {1e3 * delay_error:.2f} ms, true 20")
    truth = (arm.stiffness, arm.damping, arm.coulomb, arm.armature)
    for (term, unit), values in zip(UNITS.items(), truth):
        rows = [row for row in result.quantities if row.name == term]
        model_values, estimates, errors = (
            np.array([getattr(row, key) for row in rows])
            for key in ("model", "value", "error")
        )
        print(f"  {term} [{unit}]: model {model_values}\n    true {values}")
        print(f"    found {estimates}\n    error {errors}")
    problem = ServoProblem(ServoRollouts(robot), [held])
    old = rms(problem.test(servos_in_model(robot), servos)[0])
    late = rms(result.before)
    new = rms(result.after)
    print(
        f"  held out, {WINDOW:g} s: model {old:.4g} rad, model with the delay found {late:.4g}, "
        f"found {new:.4g}: {old / new:.1f} and {late / new:.1f} times smaller"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
