"""Short logs of a small arm behind servos, for tests."""

import numpy as np

from rigs.arms.small_arms import Y, Z, serial_arm
from robot_sysid.simulation.playback import ServoParameters, ServoRollouts, ServoWindow

RATE = 50.0
JOINT = 'range="-2.5 2.5" armature=".05" damping="1" frictionloss=".3"'
SERVOS = (
    '<actuator><general name="a" joint="joint0" gainprm="100" biastype="affine" biasprm="0 -100 -2"'
    ' forcerange="-60 60"/>'
    '<general name="b" joint="joint1" gainprm="80" biastype="affine" biasprm="0 -80 -1"/>'
    "</actuator>"
)
XML = serial_arm((Z, Y), joint=JOINT, extra=SERVOS)


TRUTH = ServoParameters(
    np.array([[60.0, 110.0], [4.0, 5.0], [0.9, 0.6], [0.2, 0.1]]), 0.03, np.zeros(2)
)
"""The true parameters of the arm behind the logs."""


def sines_and_steps(seconds=14.0, seed=0):
    """Return time (N,) and commands (N, 2) on steps of 1 mrad."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(seconds * RATE)) / RATE
    phase = 2.0 * np.pi * np.outer(time, [0.31, 0.43]) + rng.uniform(0.0, 6.0, 2)
    levels = rng.uniform(-0.3, 0.3, (len(time) // 40 + 1, 2))
    steps = np.repeat(levels, 40, axis=0)[: len(time)]
    return time, np.round(0.4 * np.sin(phase) + steps, 3)


def positions(robot, time, command, servos=TRUTH, steps=10):
    """Readings (N, n) of an encoder with 1 mrad, of an arm played in ``steps`` steps a sample."""
    window = ServoWindow(float(time[0]), command[0], 0.0 * command[0], time, command)
    edges = np.linspace(0.0, time[-1] - time[0], steps * (len(time) - 1) + 1)
    q = ServoRollouts(robot).positions(servos, [window], edges)[0]
    return np.round(q[::steps], 3)


def write(path, time, q, command, names=("joint0", "joint1")):
    """Write a log with commands of joints with some names."""
    titles = ["time", *(f"{n}.pos" for n in names), *(f"action_{n}" for n in names)]
    rows = np.column_stack((time, q, command))
    np.savetxt(path, rows, "%.9g", ",", header=",".join(titles), comments="")
    return path
