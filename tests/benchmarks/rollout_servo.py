"""Arms without torque sensors: how far are the found servos, friction and rotor inertia off?

    OMP_NUM_THREADS=1 python -m tests.benchmarks.rollout_servo [so101] [openarm]

An arm with other gains, damping, friction and rotor inertia than its model's plays 40 s of sines
and steps. Commands and positions are logged at 50 Hz in steps of 0.1 degrees; commands act 20 ms
late. It is stepped by ``simulation.stepper`` at 0.5 ms with Coulomb friction, not by what fits it.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from robot_sysid.identify.arm.servo.commands import commanded_pieces
from robot_sysid.identify.arm.servo.played import parted, play_servos
from robot_sysid.identify.arm.servo.run import run_servo
from robot_sysid.logs.options import LogOptions
from robot_sysid.logs.reader import open_log
from robot_sysid.parser import load_robot_model
from robot_sysid.records.progress import Progress
from robot_sysid.simulation.rollout.servo import Servos, actuators_of
from tests.support import servo_arm
from tests.support.places import MODELS

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
        robot, rng = load_robot_model(MODELS / path, joint=joint), np.random.default_rng(3)
        arm = servo_arm.other_than(robot, rng)
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder) / "log.csv"
            servo_arm.write_log(log, arm, *servo_arm.commands(robot, rng), STEP)
            options = LogOptions(measurements=(log,))
            begun = time.monotonic()
            outcome = run_servo(robot, options, Path(folder) / "out", None, Progress())
            spent = time.monotonic() - begun
            piece = open_log(robot, log, replace(options, commanded=True))
            held = parted(commanded_pieces([piece], robot.joint_names))[1]
        report(name, arm, robot, outcome, held, spent)


def report(name, arm, robot, outcome, held, spent) -> None:
    """Print one arm."""
    found = outcome.identification
    print(f"{name}: {spent:.0f} s; {outcome.failure or 'model written'}")
    print(f"  delay {1e3 * found.delay:.2f} ± {1e3 * found.delay_error:.2f} ms, true 20")
    truth = {"gain": arm.stiffness, "damping": arm.damping, "frictionloss": arm.coulomb}
    for term, values in {**truth, "armature": arm.armature}.items():
        after, errors = (
            np.array([getattr(j, which)[term] for j in found.joints])
            for which in ("after", "errors")
        )
        before = np.array([j.before[term] for j in found.joints])
        print(f"  {term}: model {before}\n    true {values}\n    found {after}\n    error {errors}")
    default = default_servos(robot)
    final = Servos(
        *(np.array([j.after[t] for j in found.joints]) for t in (*truth, "armature")), found.delay
    )
    without = play_servos(robot, actuators_of(robot), held, (default, final), "").errors
    for error, bare in zip(found.rollout.errors, without):
        (late, new), (old, _) = error.overall, bare.overall
        print(
            f"  held out, {error.horizon:g} s: model {old:.4g} rad, model with the delay found "
            f"{late:.4g}, found {new:.4g}: {old / new:.1f} and {late / new:.1f} times smaller"
        )


def default_servos(robot) -> Servos:
    """The model as it is."""
    own, model, dofs = actuators_of(robot), robot.mj_model, robot.dof_index
    damping = model.dof_damping[dofs] + own.damping
    friction, armature = model.dof_frictionloss[dofs], model.dof_armature[dofs]
    return Servos(own.stiffness, damping, friction, armature, 0.0)


if __name__ == "__main__":
    main(*sys.argv[1:])
