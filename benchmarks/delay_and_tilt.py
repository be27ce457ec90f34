"""Errors of an unknown torque delay and an unknown tilt of the base.

Run from the checkout:  python -m benchmarks.delay_and_tilt

Kinova example, other links known, both unknown at once, five pairs of injected values, 15 s at
1 kHz: largest errors of the five, and the standard errors that the tool states. A random trajectory
moves all joints but the last within a tenth of their range; the designed one shows more.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.example_study import NoiseStudy, designed_plan, random_plan
from robot_sysid.dynamics.inverse_dynamics import (
    TILT_NAMES,
    gravity_vector,
    with_gravity,
)
from robot_sysid.estimation.identify import Piece, answer_link, low_pass_recordings
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.records import DELAY_NAME
from robot_sysid.records.messages import Progress
from robot_sysid.signals.resampling import join_measurements
from robot_sysid.simulation import SimulatedArmOptions
from robot_sysid.simulation.plant import PlantSimulation
from tests.support.core_fits import BASIC

PAIRS = ((0.0, 0.0), (1e-3, 0.25), (3.7e-3, 0.5), (5e-3, 0.75), (10e-3, 1.0))
SENSORS = ((0.0, 0.0), (0.0, 1e-4), (0.1, 1e-4), (0.3, 1e-4))
RATE = 1000.0
OPTIONS = EstimationOptions(delay="auto", tilt="auto", friction_model=BASIC)


def main() -> None:
    """Print one line per trajectory and sensor."""
    study = NoiseStudy()
    plans = {
        "random": random_plan(study.robot, 5),
        "designed": designed_plan(study.robot),
    }
    print("                                        delay [ms]        tilt [degrees]")
    print("trajectory, torque noise, encoder    error   stated       error   stated")
    for name, plan in plans.items():
        for noise, step in SENSORS:
            rows = [
                errors_of_run(study, plan, pair, noise, step, k)
                for k, pair in enumerate(PAIRS)
            ]
            worst = np.max(np.abs(rows), axis=0)
            sensor = f"{noise:.1f} N m, {step:g} rad"
            print(
                f"{name:<10}{sensor:<22}{worst[0]:10.4f}{worst[1]:9.4f}{worst[2]:12.4f}{worst[3]:9.4f}",
                flush=True,
            )


def errors_of_run(study, plan, pair, noise, step, seed):
    """Return errors of the delay [ms] and of gravity's direction [degrees], with standard errors.

    Returns:
        (error of the delay, its standard error, error of the direction, its standard error)
    """
    delay, tilt = pair
    turn = np.radians(tilt) * np.array([np.cos(seed), np.sin(seed), 0.0])
    down = Rotation.from_rotvec(turn).apply(gravity_vector(study.plant))
    sensors = SimulatedArmOptions(
        noise_torque=noise, encoder_resolution=step, torque_delay=delay
    )
    plant = with_gravity(study.plant, down)
    rng = np.random.default_rng(seed)
    log = join_measurements(PlantSimulation(plant, plan, sensors, RATE, rng))
    datasets, _ = low_pass_recordings(study.robot, [Piece("", log)], OPTIONS)
    answer = answer_link(study.robot, datasets, OPTIONS, Progress(), None)
    late, *both = (answer.quantity(name) for name in (DELAY_NAME, *TILT_NAMES))
    found_down = answer.fit.point.gravity
    off = np.arctan2(np.linalg.norm(np.cross(found_down, down)), found_down @ down)
    stated = np.linalg.norm([angle.error for angle in both])
    return (
        1e3 * (late.value - delay),
        1e3 * late.error,
        np.degrees(off),
        np.degrees(stated),
    )


if __name__ == "__main__":
    main()
