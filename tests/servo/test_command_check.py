"""Commands of servos that are soft, stick, sag and are limited pass; those of no servo do not.

The servo is a pendulum behind a gain that follows its register, a line from stall torque to no-load
speed, and dry friction, in implicit steps of 1 ms.
"""

import json
from dataclasses import dataclass

import numpy as np
import pytest

from rigs.files.places import SHARED
from robot_sysid.errors import InputError
from robot_sysid.logs import LogOptions
from robot_sysid.logs.reader import open_logs
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, Recording
from robot_sysid.servo.command_check import LEAST_MOTION, check_commands

STEP = 1e-3
ENCODER = 2.0 * np.pi / 4096
TIME = np.arange(0.0, 6.0, STEP)
REGISTERS = 25.0, 800.0
BAM = SHARED / "data" / "bam_xl330"


@dataclass(frozen=True)
class Runs:
    """Commands and positions (N, m) of m drawn servos at times (N,)."""

    time: Array
    q: Array
    command: Array

    def log(self, k, reverse=False, change=lambda command: command):
        """One of them as a recording; reversed, its columns are exchanged."""
        q, command = self.q[:, k, None], change(self.command[:, k, None])
        if reverse:
            q, command = command, q
        return Recording(self.time, q, None, command - q, command=command, name="log")

    @property
    def moving(self):
        """Those that move."""
        return np.flatnonzero(np.ptp(self.q, axis=0) >= LEAST_MOTION).tolist()


def sines(rng, count):
    """Three sines around another place."""
    sizes, rates, phases = (
        rng.uniform(*ends, (3, count)) for ends in ((0.1, 0.9), (0.3, 6), (0, 6.28))
    )
    waves = sizes * np.sin(TIME[:, None, None] * rates + phases)
    return rng.uniform(-1.0, 1.0, count) + np.sum(waves, axis=1)


def steps(rng, count):
    """Another place each 0.7 s."""
    return rng.uniform(-1.5, 1.5, (12, count))[np.int64(TIME / 0.7)]


def lift(rng, count):
    """Up once, which no friction or sag is told by."""
    way = 0.5 * (1.0 - np.cos(np.pi * np.minimum(TIME / 1.8, 1.0)))
    return np.outer(way, rng.uniform(-1.6, -1.0, count))


def draw(motion, seed, count):
    """Play drawn servos, recorded at 200 Hz on the steps of an encoder."""
    rng = np.random.default_rng(seed)
    command = motion(rng, count)
    gain = np.exp(rng.uniform(*np.log(REGISTERS), count)) / 400.0
    gain *= 0.83 * rng.uniform(0.7, 1.4, count)
    moment = rng.choice([0.02, 0.049, 0.08], count)
    inertia = 0.1 * moment + rng.uniform(2e-4, 2e-3, count)
    stall, speed = rng.uniform(0.35, 1.2, count), rng.uniform(6.0, 14.0, count)
    dry, of_load = rng.uniform(0.01, 0.09, count), rng.uniform(0.0, 0.1, count)
    delay = rng.integers(0, 60, count)
    q, qd = command[0].copy(), np.zeros(count)
    positions = np.empty_like(command)
    for k in range(len(TIME)):
        positions[k] = q
        error = command[np.maximum(k - delay, 0), range(count)] - q
        torque = np.clip(gain * error, -stall, stall) - stall / speed * qd
        torque -= 9.81 * moment * np.sin(q)
        free = qd + STEP / inertia * torque
        lost = STEP / inertia * (dry + of_load * np.abs(torque))
        qd = np.sign(free) * np.maximum(np.abs(free) - lost, 0.0)
        q = q + STEP * qd
    read = np.round(positions[::5] / ENCODER) * ENCODER
    return Runs(TIME[::5], read, command[::5])


def is_refused(log):
    try:
        check_commands([log], ["servo", "other"])
    except InputError:
        return True
    return False


@pytest.mark.parametrize(("motion", "least"), [(sines, 0.9), (steps, 0.9), (lift, 0.0)])
@pytest.mark.parametrize("count", [6, pytest.param(60, marks=pytest.mark.slow)])
def test_no_servo_is_refused_however_weak(motion, least, count):
    """Exchanged, a motion that turns round is."""
    runs = draw(motion, 3, count)
    assert len(runs.moving) > 0.8 * count
    assert [k for k in runs.moving if is_refused(runs.log(k))] == []
    exchanged = [is_refused(runs.log(k, reverse=True)) for k in runs.moving]
    assert np.mean(exchanged) >= least


def test_a_joint_that_is_held_may_sag_as_others_load_it():
    time = np.arange(300) / 30.0
    command = np.column_stack((np.sin(time), 0.0 * time + 0.4))
    q = np.column_stack((0.95 * np.sin(time - 0.05), 0.38 - 0.04 * np.cos(time)))
    log = Recording(time, q, None, command - q, command=command)
    assert not is_refused(log)
    # One that moves far has commands of its own somewhere.
    far = np.column_stack((q[:, 0], 0.6 * np.cos(time)))
    assert is_refused(Recording(time, far, None, command - far, command=command))


def test_degrees_are_refused_of_weak_servos_too():
    runs = draw(sines, 4, 6)
    for k in runs.moving:
        with pytest.raises(InputError, match="check their units"):
            check_commands([runs.log(k, change=np.degrees)], ["servo"])


def test_commands_that_follow_those_of_another_joint_are_refused():
    """Both joints move alike, so that each follows the other's commands well."""
    time = np.arange(1000) / 100.0
    common = 0.6 * np.sin(2.0 * time)
    command = np.column_stack((common, common + 0.1 * np.sin(5.0 * time)))
    q = np.vstack((command[:1].repeat(3, axis=0), command[:-3])) + 1e-3
    names = ["lift", "elbow"]
    check_commands([Recording(time, q, None, q, command=command)], names)
    log = Recording(time, q, None, q, command=command[:, ::-1])
    with pytest.raises(InputError, match="those of joint elbow fit them far better"):
        check_commands([log], names)


@pytest.mark.skipif(not BAM.is_dir(), reason="no public logs beside the checkout")
@pytest.mark.parametrize("path", sorted(BAM.glob("*.json")), ids=lambda path: path.stem)
def test_real_servos_pass_and_exchanged_ones_do_not(path):
    robot = load_robot_model(BAM / "pendulum.xml")
    (log,) = open_logs(robot, [path], LogOptions(commanded=True))
    check_commands([log], robot.joint_names)
    assert log.setting.register == json.loads(path.read_text())["kp"]
    exchanged = Recording(log.time, log.command, None, log.q, command=log.q)
    assert is_refused(exchanged)
