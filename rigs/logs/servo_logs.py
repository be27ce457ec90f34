"""Short logs of a small arm behind servos, for tests."""

import numpy as np

from rigs.arms.small_arms import Y, Z, serial_arm
from robot_sysid.records.servo_setting import ServoSetting
from robot_sysid.servo.setting import loaded
from robot_sysid.simulation.playback import ServoParameters, ServoRollouts, ServoWindow
from robot_sysid.spatial import com_from_theta

RATE = 50.0
JOINT = 'range="-2.5 2.5" armature=".05" damping="1" frictionloss=".3"'
SERVOS = (
    '<actuator><general name="a" joint="joint0" gainprm="100" biastype="affine" biasprm="0 -100 -2"'
    ' forcerange="-60 60"/>'
    '<general name="b" joint="joint1" gainprm="80" biastype="affine" biasprm="0 -80 -1"/>'
    "</actuator>"
)
XML = serial_arm((Z, Y), joint=JOINT, extra=SERVOS)


def servos(numbers, delay=0.0, limit=np.inf):
    """Return parameters of servos whose damping stands beside one limit, in a usual file."""
    table = np.array(numbers, dtype=float)
    n = table.shape[1]
    return ServoParameters(
        table, delay, np.full(n, limit), np.zeros(n), np.full(n, 0.9)
    )


TRUTH = servos([[60.0, 110.0], [4.0, 5.0], [0.9, 0.6], [0.2, 0.1]], 0.03)
"""The true parameters of the arm behind the logs."""


def sines_and_steps(seconds=14.0, seed=0):
    """Return time (N,) and commands (N, 2) on steps of 1 mrad."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(seconds * RATE)) / RATE
    phase = 2.0 * np.pi * np.outer(time, [0.31, 0.43]) + rng.uniform(0.0, 6.0, 2)
    levels = rng.uniform(-0.3, 0.3, (len(time) // 40 + 1, 2))
    steps = np.repeat(levels, 40, axis=0)[: len(time)]
    return time, np.round(0.4 * np.sin(phase) + steps, 3)


def exact_positions(robot, time, command, servos=TRUTH, steps=10):
    """Return positions (N, n) of an arm from rest, played in ``steps`` steps a sample."""
    window = ServoWindow(float(time[0]), command[0], 0.0 * command[0], time, command)
    edges = np.linspace(0.0, time[-1] - time[0], steps * (len(time) - 1) + 1)
    return ServoRollouts(robot).positions(servos, [window], edges)[0, ::steps]


def positions(robot, time, command, servos=TRUTH, steps=10):
    """Return the readings (N, n) of an encoder with 1 mrad of an arm that is played."""
    return np.round(exact_positions(robot, time, command, servos, steps), 3)


def motor_torques(robot, time, command, servos=TRUTH, steps=10):
    """Return the torques (N, n) of the motors of that arm, before all friction [N m].

    Of the damping that stands beside the limit, none is in them.
    """
    times = np.linspace(time[0], time[-1], steps * (len(time) - 1) + 1)
    at = np.searchsorted(time, times - servos.delay + 1e-9, side="right") - 1
    fine = command[np.maximum(at, 0)]
    window = ServoWindow(float(time[0]), command[0], 0.0 * command[0], time, command)
    q = ServoRollouts(robot).positions(servos, [window], times - time[0])[0]
    torque = servos.numbers[0] * (fine - q)
    return np.clip(torque, -servos.limits, servos.limits)[::steps]


def write(path, time, q, command, names=("joint0", "joint1")):
    """Write a log with commands of joints with some names."""
    titles = ["time", *(f"{n}.pos" for n in names), *(f"action_{n}" for n in names)]
    rows = np.column_stack((time, q, command))
    np.savetxt(path, rows, "%.9g", ",", header=",".join(titles), comments="")
    return path


_JOINT = 'axis="0 1 0" range="-2 2" armature=".03" damping=".5" frictionloss=".05"'
LIGHT = f"""<mujoco><compiler angle="radian"/><worldbody>
<body name="upper"><joint name="joint0" {_JOINT}/>
<inertial pos="0 0 .1" mass=".015" diaginertia="4e-5 4e-5 1e-5"/>
<body name="fore" pos="0 0 .2"><joint name="joint1" {_JOINT}/>
<inertial pos="0 0 .08" mass=".01" diaginertia="1e-5 1e-5 5e-6"/></body></body></worldbody>
<actuator><position name="a" joint="joint0" kp="18" forcerange="-3 3"/>
<position name="b" joint="joint1" kp="18" forcerange="-3 3"/></actuator></mujoco>"""
"""An arm whose links hardly pull at its servos: their sizes show only with a weight."""
LIGHT_TRUTH = ServoParameters(
    np.array([[14.0, 14.0], [0.5, 0.45], [0.06, 0.08], [0.025, 0.03]]),
    0.02,
    np.full(2, 3.0),
    np.zeros(2),
    np.full(2, 0.99),
)
"""The true parameters of its servos."""


class WeighedServos:
    """That arm, which is recorded with a weight at its last link's centre of mass.

    Args:
        robot: what the model says.
    """

    first_plan = None
    tool_mass = 0.0

    def __init__(self, robot):
        self._robot = robot

    def record(self, path, plan, load):
        """Write the log of the same motion, whatever the plan, with a load [kg]."""
        _, com, _ = com_from_theta(self._robot.thetas[-1])
        place = tuple(com.tolist()) if load else None
        setting = ServoSetting(load_mass=load, load_position=place)
        robot = loaded(self._robot, setting)
        time, command = sines_and_steps(10.0)
        q = positions(robot, time, command, LIGHT_TRUTH, steps=20)
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path, time, q, command)
