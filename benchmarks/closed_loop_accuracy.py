"""How well a closed-loop simulation with MuJoCo's friction and armature gives its truth back.

Run from the checkout:  python -m benchmarks.closed_loop_accuracy

The engineer's model is the Kinova example without friction and armature. The plant has friction
0.4 N m and 0.1 N m s/rad and armature in every joint, and a terminal link 1.4 times as heavy. All
joints' Coulomb, viscous, offset and armature coefficients are estimated beside the ten inertial
parameters; the friction columns show the worst joint.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from robot_sysid.dynamics.equations import Equations
from robot_sysid.dynamics.friction import FrictionModel
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.estimation.algebra.least_squares import InformationAccumulator
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Measurement
from robot_sysid.signals.process import process
from robot_sysid.simulation.plant import round_to_multiples
from robot_sysid.solver import identify_parameters
from tests.support.closed_loop import ClosedLoop
from tests.support.closed_loop_proof import (
    TERMS,
    differentiate_log,
    errors_of,
    excitation,
    identify_log,
    plant_from,
    proof_run,
    record_run,
)
from tests.support.places import GUESS

RATE = 1000.0
SEEDS = (1, 2, 3)


def identified_from_log(robot, log, deadband, terms=TERMS):
    """The same from positions and torques by way of low-pass, derivatives and decimation."""
    signals = process(log, robot.joint_names)
    signals = replace(signals, deadband=np.full_like(signals.deadband, deadband))
    equations = Equations(robot, "chain", (FrictionModel(terms),) * robot.n_joints)
    rows_of_joint = InformationAccumulator(
        equations.names, equations.joints, equations.columns
    )
    motion = Measurement(signals.time, signals.q, signals.qd, signals.tau, signals.qdd)
    usable = signals.usable()
    for index, (rows, tau) in enumerate(equations.rows(motion)):
        decimated = signals.low_pass.decimate(np.column_stack((rows, tau)))[
            usable[:, index]
        ]
        rows_of_joint.add(index, decimated[:, :-1], decimated[:, -1])
    return identify_parameters(rows_of_joint.result(), equations.prior)


def main() -> None:
    """Print the three tables."""
    robot = load_robot_model(GUESS)
    integration_table(robot)
    proof_table(robot)
    sensor_table(robot)


def integration_table(robot) -> None:
    """Reported torque against inverse dynamics of the differentiated positions."""
    print("Error of the reported torque, no dry friction, damping 1 N m s/rad [N m]")
    plan = excitation(robot)
    for rate in (250.0, 500.0, 1000.0, 2000.0):
        plant = plant_from(robot, coulomb=0.0, viscous=1.0, time_step=1.0 / rate)
        log = differentiate_log(record_run(ClosedLoop(plant, plan, rate)), rate)
        tau = (
            ArmDynamics(plant).torque(log.q, log.qd, log.qdd)
            + plant.friction.viscous * log.qd
        )
        armature = np.sum((log.tau - tau) * log.qdd, axis=0) / np.sum(
            log.qdd**2, axis=0
        )
        rms = np.sqrt(np.mean((log.tau - tau) ** 2))
        apparent = np.max(np.abs(armature))
        print(
            f"  period {1e3 / rate:4.1f} ms: rms {rms:.1e}, apparent armature {apparent:.1e} kg m2"
        )


def proof_table(robot) -> None:
    """Ideal sensors: positions and torques only, rows on MuJoCo's ramp left out."""
    print(
        "Ideal sensors, derivatives from positions, rows on the friction ramp left out"
    )
    for seed in SEEDS:
        plan = excitation(robot, seed)
        for armature in (0.1, 0.02):
            errors, log, loop = proof_run(robot, plan, RATE, armature=armature)
            print(f"  seed {seed}, armature {armature:4.2f}: {words(errors)}")
            kept = errors_of(identify_log(robot, log, 0.0), plant_from(robot, armature))
            print(f"    same, ramp kept in:       {words(kept)}")
            print(f"    ramp ends below {np.round(loop.ramp_use.ramp_speed, 3)} rad/s")


def sensor_table(robot) -> None:
    """The whole signal path, with encoder steps and torque noise."""
    print("Low-pass, derivatives and decimation; rows slower than 0.1 rad/s left out")
    for seed in SEEDS:
        plant = plant_from(robot)
        exact = record_run(ClosedLoop(plant, excitation(robot, seed), RATE))
        for steps, noise in ((0.0, 0.0), (1e-4, 0.0), (1e-4, 0.1)):
            q = round_to_multiples(exact.q, steps) if steps else exact.q
            draws = np.random.default_rng(seed).standard_normal(exact.tau.shape)
            log = Measurement(exact.time, q, None, exact.tau + noise * draws)
            estimate = identified_from_log(robot, log, deadband=0.1)
            print(f"  seed {seed}, encoder {steps:g} rad, torque noise {noise:g} N m:")
            print(f"    {words(errors_of(estimate, plant))}")


def words(errors) -> str:
    """One line."""
    percent = {
        n: 100.0 * getattr(errors, n)
        for n in ("mass", "coulomb", "viscous", "armature")
    }
    listed = ", ".join(f"{name} {value:.4f} %" for name, value in percent.items())
    return f"{listed}, centre of mass {1e3 * errors.com:.3f} mm"


if __name__ == "__main__":
    main()
