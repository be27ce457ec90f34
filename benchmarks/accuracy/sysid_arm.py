"""mujoco.sysid's own arm: its test finds five rotor inertias again, and so does robot-sysid.

    pip install -e ".[dev,bench]"
    OMP_NUM_THREADS=1 python -m benchmarks.accuracy.sysid_arm

A few seconds. The arm, its motion of 2 s and the true numbers come with MuJoCo, in the tests of
``mujoco.sysid``; both tools begin with 0.01 kg m^2 at every joint. mujoco.sysid takes all other
numbers of the arm as exact and seeks five. robot-sysid seeks all, with its defaults and with priors
that call links and sensors exact. Noise is 0.1 mrad of positions, 1 % of each joint's torque, and
10 mrad/s of the velocities, which only mujoco.sysid uses.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import mujoco
import numpy as np
from mujoco import sysid
from mujoco.sysid.tests import test_integration as source

from robot_sysid.api.calls import identify

FREQUENCIES = np.array([0.5, 0.7, 0.4, 0.9, 0.6])
AMPLITUDES = np.array([5.0, 4.0, 3.0, 2.0, 1.0])
PHASES = np.array([0.0, 0.5, 1.0, 1.5, 2.0])
"""The torques of its test ``test_arm_recover_armature`` [Hz, N m, rad]."""
TRUTH = np.array(list(source.TRUE_ARMATURE.values()))
START = 0.01
CAUSES = ("link", "scale", "zero", "gravity", "delay", "friction")
EXACT = {"priors": dict.fromkeys(CAUSES, 0)}


def torques(times):
    """Return the torques (N, 5) of its test at times (N,)."""
    return AMPLITUDES * np.sin(2.0 * np.pi * np.outer(times, FREQUENCIES) + PHASES)


def with_noise(series, size):
    """Return one of its time series with normal noise of a size, for all columns or each."""
    random = np.random.default_rng(0)
    noise = size * random.standard_normal(series.data.shape)
    return sysid.TimeSeries(series.times, series.data + noise, series.signal_mapping)


def by_sysid(spec, start, control, sensors):
    """Return the rotor inertias (5,) that mujoco.sysid finds, as its test does it."""
    params = sysid.ParameterDict()
    for joint in source.JOINT_NAMES:
        params.add(
            sysid.Parameter(
                joint,
                nominal=START,
                min_value=0.001,
                max_value=1.0,
                modifier=lambda spec, param, joint=joint: setattr(
                    spec.joint(joint), "armature", param.value[0]
                ),
            )
        )
    sequences = sysid.ModelSequences("arm", spec, "test", start, control, sensors)
    residual = sysid.build_residual_fn(models_sequences=[sequences])
    optimum, _ = sysid.optimize(params, residual, optimizer="mujoco", verbose=False)
    return np.array([optimum[joint].value[0] for joint in source.JOINT_NAMES])


def by_torques(control, sensors, **options):
    """Return the rotor inertias (5,) that robot-sysid finds from a model that has the start's."""
    spec = mujoco.MjSpec.from_string(source.ARM_XML)
    for joint in spec.joints:
        joint.armature = START
    spec.compile()
    count = len(sensors.times)
    joints = len(source.JOINT_NAMES)
    log = {
        "time": sensors.times,
        "q": sensors.data[:, :joints],
        "tau": control.data[:count],
    }
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / "arm.xml"
        model.write_text(spec.to_xml())
        # Its torques have no dry friction, which is doubted: a measured arm has some.
        result = identify(model, log, accept=["computed"], **options)
    return np.array(
        [result.quantity("armature", joint).value for joint in source.JOINT_NAMES]
    )


def main() -> None:
    """Print the largest error of both sides, without noise and with it."""
    spec, start, control, sensors = source._generate_data(source.ARM_XML, torques, 2.0)
    torque_noise = 0.01 * np.sqrt(np.mean(control.data**2, axis=0))
    sensor_noise = np.repeat((1e-4, 1e-2), len(TRUTH))
    for level in (0.0, 1.0):
        control_read = with_noise(control, level * torque_noise)
        sensors_read = with_noise(sensors, level * sensor_noise)
        sides = {
            "robot-sysid": by_torques(control_read, sensors_read),
            "robot-sysid, all else exact": by_torques(
                control_read, sensors_read, **EXACT
            ),
            "mujoco.sysid": by_sysid(spec, start, control_read, sensors_read),
        }
        for name, values in sides.items():
            worst = 100.0 * np.max(np.abs(values / TRUTH - 1.0))
            print(f"noise {level:g}: {name} {worst:.2g} %")


if __name__ == "__main__":
    main()
