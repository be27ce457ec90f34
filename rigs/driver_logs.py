"""Recordings of a simulated arm as the makers' own drivers publish and write them.

Each entry of ``DRIVER_LOGS`` writes a motion of a public model in the format of one driver: names
and order of the joints, extra joints, rates, units, and the zeros that a driver writes where it
measures nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from rigs import recorded
from rigs.places import MODELS
from rigs.recorded import START_NS, STATE, joint_state, typestore, write_bag
from rigs.wrong_arms import truth_of
from robot_sysid.logs.ros_messages import KORTEX, LBR
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Recording, RobotModel


@cache
def model_of(path: str) -> RobotModel:
    """Return a public model, by its path below the folder of models."""
    return load_robot_model(MODELS / path)


@cache
def motion_of(path: str, rate: float = 250.0, load: float = 0.0) -> Recording:
    """Return 12 s of a motion of a public model whose links are a little off, with sensor noise.

    ``load`` is the mass of a weight on the terminal link [kg]; the motion is the same with it.
    """
    return truth_of(model_of(path), 3, rate=rate, load=load).log


def every(data: Recording, step: int) -> Recording:
    """Return every ``step``-th sample."""
    columns = (data.time, data.q, data.qd, data.tau)
    return Recording(*(array[::step] for array in columns))


def states(types: Any, data: Recording, names: Sequence[str], order: Any = None):
    """Yield JointState messages of an arm's joints, in the order of these indices."""
    order = list(range(len(names)) if order is None else order)
    listed = [names[k] for k in order]
    for time, q, qd, tau in zip(data.time, data.q, data.qd, data.tau):
        yield time, joint_state(types, time, listed, q[order], qd[order], tau[order])


def with_extra_joints(data: Recording, count: int, position: float) -> Recording:
    """Return a motion with further joints that stand still, whose velocity and effort are zero."""
    zero = np.zeros((len(data), count))
    q = np.column_stack((data.q, zero + position))
    qd = np.column_stack((data.qd, zero))
    tau = np.column_stack((data.tau, zero))
    return Recording(data.time, q, qd, tau)


def _numbered(name: str, count: int = 7) -> list[str]:
    """Return a name with the numbers from 1 on."""
    return [f"{name}{k}" for k in range(1, count + 1)]


def franka(
    folder: Path, arm: str, model: str, storage: str, topic_names: Sequence[str]
) -> Path:
    """A bag of topics of franka_bringup's launch file, with the hand.

    joint_state_broadcaster has the arm at the rate of the controller manager; franka_gripper has
    the fingers; joint_state_publisher puts both together in /joint_states, at 30 Hz, or at a rate
    that is set where it is the only one.
    """
    store = typestore(storage)
    types = store.types
    data = motion_of(model, rate=1000.0)
    joints = _numbered(f"{arm}_joint")
    fingers = _numbered(f"{arm}_finger_joint", 2)
    slow = every(data, 33) if len(topic_names) > 1 else motion_of(model)
    both = with_extra_joints(slow, 2, 0.035)
    contents = {
        "/franka/joint_states": states(types, data, joints),
        "/franka_gripper/joint_states": states(
            types, both, [*joints, *fingers], [7, 8]
        ),
        "/joint_states": states(types, both, [*joints, *fingers]),
    }
    topics = [(name, STATE, contents[name]) for name in topic_names]
    return write_bag(folder / "franka", topics, store, storage)


UR_JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
UR_CONSTANTS = np.array([11.5, 11.5, 10.8, 7.9, 7.9, 7.9])
"""Torque at a UR's joint per ampere of its motor in these recordings [N m/A]."""
UR5E = "universal_robots_ur5e/ur5e.xml"


def in_amperes(data: Recording) -> Recording:
    """Return a UR's motion with motor currents in the place of torques."""
    return replace(data, tau=data.tau / UR_CONSTANTS)


def universal_robots(
    folder: Path, storage: str, is_current: bool, load: float = 0.0
) -> Path:
    """A bag of the UR driver: joints by the alphabet, 500 Hz; effort is current before PolyScope
    5.23, and by default.

    joint_state_broadcaster publishes /dynamic_joint_states beside /joint_states.
    """
    store = typestore(storage)
    types = store.types
    data = motion_of(UR5E, 500.0, load)
    data = in_amperes(data) if is_current else data
    order = np.argsort(UR_JOINTS)
    topics = [("/joint_states", STATE, states(types, data, UR_JOINTS, order))]
    if storage != "ROS1":
        dynamic = recorded.dynamic_states(types, data, UR_JOINTS, [[0, 1, 2]] * 6)
        topics.append(("/dynamic_joint_states", recorded.DYNAMIC, dynamic))
    return write_bag(folder / "ur", topics, store, storage)


def rtde(folder: Path, torque: str, load: float = 0.0) -> Path:
    """What record.py of the RTDE client writes of a UR."""
    data = motion_of(UR5E, 500.0, load)
    measured = in_amperes(data) if torque == "actual_current" else data
    return recorded.rtde(folder, measured, torque)


def xarm(folder: Path, storage: str) -> Path:
    """A bag of xarm_api with the gripper: 100 Hz ("dev" reports), and twice a second a message
    of the gripper's six joints with neither velocity nor effort.
    """
    store = typestore(storage)
    types = store.types
    data = motion_of("ufactory_xarm7/xarm7.xml", rate=100.0)
    arm = list(states(types, data, _numbered("joint")))
    names = ["drive_joint", "left_finger_joint", "left_inner_knuckle_joint"]
    names += ["right_outer_knuckle_joint", "right_finger_joint"]
    names += ["right_inner_knuckle_joint"]
    unknown = np.full(6, np.nan)
    gripper = []
    for time in data.time[::50] + 0.003:
        state = joint_state(types, time, names, np.zeros(6), unknown, unknown)
        gripper.append((time, state))
    messages = sorted([*arm, *gripper], key=lambda stamped: stamped[0])
    topics = [("/xarm/joint_states", STATE, messages)]
    return write_bag(folder / "xarm", topics, store, storage)


IIWA = "kuka_iiwa_14/iiwa14.xml"


def lbr(folder: Path, storage: str, topic_names: Sequence[str]) -> Path:
    """A bag of lbr_fri_ros2_stack: 100 Hz, joints lbr_A1 .. lbr_A7; LBRState has no names."""
    store = typestore(storage)
    types = store.types
    data = motion_of(IIWA, rate=100.0)
    contents = {
        "/lbr/joint_states": (STATE, states(types, data, _numbered("lbr_A"))),
        "/lbr/state": (LBR, lbr_states(types, data)),
    }
    topics = [(name, *contents[name]) for name in topic_names]
    return write_bag(folder / "lbr", topics, store, storage)


def lbr_states(types: Any, data: Recording):
    """Yield LBRState messages, whose time is that of the controller."""
    zeros = np.zeros(7)
    for time, q, tau in zip(data.time, data.q, data.tau):
        seconds, nanoseconds = divmod(START_NS + round(1e9 * time), 10**9)
        modes = (0.01, 4, 3, 0, 2, 2, 1, 0, 4)
        stamp = (seconds, nanoseconds)
        arrays = (q, tau, zeros, 0.1 * tau, q + 1e-3)
        yield time, types[LBR](*modes, *stamp, *arrays, 1.0)


GEN3 = "kinova_gen3/gen3.xml"


def kortex(folder: Path, topic_names: Sequence[str]) -> Path:
    """A ROS 1 bag of Kinova's driver with a gripper; angles of joint_states are within half a turn.

    The driver publishes 100 Hz at most by default, joint_1 .. joint_7 and the finger, whose effort
    is zero; base_feedback has no header and degrees from 0 to 360.
    """
    store = typestore("ROS1")
    types = store.types
    data = motion_of(GEN3, rate=100.0)
    wrapped = replace(data, q=(data.q + np.pi) % (2.0 * np.pi) - np.pi)
    both = with_extra_joints(wrapped, 1, 0.4)
    contents = {
        "joint_states": (
            STATE,
            states(types, both, [*_numbered("joint_"), "finger_joint"]),
        ),
        "base_feedback": (KORTEX, kortex_feedback(types, data)),
    }
    topics = [(f"/my_gen3/{name}", *contents[name]) for name in topic_names]
    return write_bag(folder / "kortex", topics, store, "ROS1")


def kortex_feedback(types: Any, data: Recording):
    """Yield BaseCyclic_Feedback messages, in degrees, N m and amperes."""
    actuator = types["kortex_driver/msg/ActuatorFeedback"]
    for time, q, qd, tau in zip(data.time, np.degrees(data.q), data.qd, data.tau):
        actuators = []
        for angle, speed, torque in zip(q % 360.0, np.degrees(qd), tau):
            measured = (angle, speed, torque, 0.1 * torque, 24.0, 30.0, 30.0)
            actuators.append(actuator(0, 0, 0, *measured, 0, 0, 0, 0))
        yield time, types[KORTEX](0, actuators)


@dataclass(frozen=True)
class DriverLog:
    """A recording of a driver, beside the model of its arm.

    Attributes:
        name: of the recording, for tests.
        model: path of the model, below the folder of public models.
        write: writes the recording into a folder and returns its path.
        rate: of the samples that identification takes [Hz].
    """

    name: str
    model: str
    write: Callable[..., Path]
    rate: float


PANDA = "franka_panda/panda.xml"
FR3 = "franka_fr3/FrankaFR3_7DoF.urdf"
_JOINT_STATES = ("/joint_states",)
_ALL_FRANKA = ("/franka/joint_states", "/franka_gripper/joint_states", "/joint_states")
_ALL_LBR = ("/lbr/joint_states", "/lbr/state")

DRIVER_LOGS = (
    # frankarobotics/franka_ros2: franka_bringup/launch/franka.launch.py
    DriverLog(
        "panda bag",
        PANDA,
        lambda folder: franka(folder, "panda", PANDA, "MCAP", _JOINT_STATES),
        250.0,
    ),
    DriverLog(
        "panda ROS 1 bag",
        PANDA,
        lambda folder: franka(folder, "panda", PANDA, "ROS1", _JOINT_STATES),
        250.0,
    ),
    DriverLog(
        "fr3 all topics",
        FR3,
        lambda folder: franka(folder, "fr3", FR3, "MCAP", _ALL_FRANKA),
        1000.0,
    ),
    # UniversalRobots/Universal_Robots_ROS2_Driver:
    # ur_robot_driver/doc/usage/utility_controllers.rst and pull request 1551
    DriverLog(
        "UR torque as effort",
        UR5E,
        lambda folder: universal_robots(folder, "MCAP", is_current=False),
        500.0,
    ),
    # UniversalRobots/RTDE_Python_Client_Library: rtde/csv_writer.py
    DriverLog(
        "UR RTDE torque",
        UR5E,
        lambda folder: rtde(folder, "actual_current_as_torque"),
        500.0,
    ),
    # xArm-Developer/xarm_ros2: xarm_api/src/xarm_driver.cpp
    DriverLog(
        "xArm with gripper",
        "ufactory_xarm7/xarm7.xml",
        lambda folder: xarm(folder, "SQLITE3"),
        100.0,
    ),
    # lbr-stack/lbr_fri_ros2_stack: lbr_description/ros2_control/lbr_controllers.yaml;
    # lbr-stack/lbr_fri_idl: msg/LBRState.msg
    DriverLog(
        "LBR all topics", IIWA, lambda folder: lbr(folder, "MCAP", _ALL_LBR), 100.0
    ),
    DriverLog(
        "LBR state alone",
        IIWA,
        lambda folder: lbr(folder, "SQLITE3", _ALL_LBR[1:]),
        100.0,
    ),
    # Kinovarobotics/ros_kortex:
    # kortex_driver/src/non-generated/driver/kortex_arm_driver.cpp
    DriverLog(
        "kortex ROS 1",
        GEN3,
        lambda folder: kortex(folder, ("joint_states", "base_feedback")),
        100.0,
    ),
    DriverLog(
        "kortex base_feedback alone",
        GEN3,
        lambda folder: kortex(folder, ("base_feedback",)),
        100.0,
    ),
)
"""Recordings whose efforts are torques: they need no option. The public code that is named states
names, order, rates and units."""
UNWEIGHED_LOGS = (
    DriverLog(
        "UR current as effort",
        UR5E,
        partial(universal_robots, storage="MCAP", is_current=True),
        500.0,
    ),
    DriverLog("UR RTDE current", UR5E, partial(rtde, torque="actual_current"), 500.0),
)
"""Recordings whose efforts are no torques. Their ``write`` takes ``load``, the mass of a weight on
the terminal link [kg]."""
