"""Recordings of simulated arms as the makers' own drivers and programs publish and write them.

Each entry of ``DRIVER_LOGS`` writes a motion of a public model in the format of one driver: names
and order of the joints, extra joints, rates, units, and the zeros that a driver writes where it
measures nothing.

SO-101's data sets follow huggingface/lerobot: src/lerobot/robots/so_follower (names, degrees, a
gripper from 0 to 100) and src/lerobot/datasets (files of versions 2 and 3). Arms whose model is not
public here are a serial arm with the joint names of the maker's model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from rigs.arms import small_arms
from rigs.arms.wrong_arms import truth_of
from rigs.files.places import MODELS
from rigs.logs import recorded
from rigs.logs.recorded import (
    START_NS,
    STATE,
    joint_state,
    later_of_types,
    write_bag,
    write_data_set,
)
from robot_sysid.logs.ros_messages import KORTEX, LBR
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Recording, RobotModel

SIX_JOINTS = small_arms.serial_arm(
    small_arms.SEVEN_AXES[:6], joint='range="-2.5 2.5" frictionloss=".2" damping=".1"'
)
"""An arm of six joints, which ``six_joint_model`` gives a maker's joint names."""
OPENARM = MODELS / "openarm_v2" / "openarm_bimanual.xml"
SO101 = MODELS / "so101" / "so101_new_calib.xml"


def six_joint_model(folder: Path) -> Path:
    """Write the arm of six joints as a model with joints joint1 .. joint6."""
    text = SIX_JOINTS
    for number in range(6, 0, -1):
        text = text.replace(f'"joint{number - 1}"', f'"joint{number}"')
    path = folder / "arm.xml"
    path.write_text(text)
    return path


@cache
def model_of(path: str) -> RobotModel:
    """Return a public model, of OpenArm the left arm, or for "" the arm of six joints.

    ``path``: below the folder of models.
    """
    joint = "openarm_left_joint7" if path == str(OPENARM) else None
    if path:
        return load_robot_model(MODELS / path, joint=joint)
    return small_arms.robot_of(SIX_JOINTS)


@cache
def motion_of(path: str, rate: float, load: float = 0.0) -> Recording:
    """Return 12 s of a motion of a model whose links are a little off, with sensor noise.

    ``load`` is the mass of a weight on the terminal link [kg]; the motion is the same with it.
    """
    return truth_of(model_of(path), 3, rate=rate, load=load).log


@later_of_types
def states(
    types: Any,
    data: Recording,
    names: Sequence[str],
    order: Any = ...,
    n_speeds: Any = None,
):
    """Yield JointState messages of an arm's joints, in the order of these indices.

    ``n_speeds`` is the number of velocities that are listed; None for all.
    """
    listed = np.array(names)[order]
    for time, q, qd, tau in zip(data.time, data.q, data.qd, data.tau):
        yield (
            time,
            joint_state(
                types, time, listed, q[order], qd[order][:n_speeds], tau[order]
            ),
        )


def with_extra_joints(data: Recording, count: int, position: float) -> Recording:
    """Return a motion with further joints that stand still, whose velocity and effort are zero."""
    zero = np.zeros((len(data), count))
    q = np.column_stack((data.q, zero + position))
    qd = np.column_stack((data.qd, zero))
    tau = np.column_stack((data.tau, zero))
    return Recording(data.time, q, qd, tau)


def _numbered_names(name: str, count: int = 7) -> list[str]:
    """Return a name with the numbers from 1 on."""
    return [f"{name}{k}" for k in range(1, count + 1)]


def franka(
    folder: Path, data: Recording, arm: str, storage: str, topic_names: Sequence[str]
) -> Path:
    """A bag of topics of franka_bringup's launch file, with the hand.

    joint_state_broadcaster has the arm at the rate of the controller manager; franka_gripper has
    the fingers; joint_state_publisher puts both together in /joint_states, at 30 Hz, or at a rate
    that is set where it is the only one.
    """
    joints = _numbered_names(f"{arm}_joint")
    fingers = _numbered_names(f"{arm}_finger_joint", 2)
    both = with_extra_joints(data[::33] if len(topic_names) > 1 else data, 2, 0.035)
    contents = {
        "/franka/joint_states": states(data, joints),
        "/franka_gripper/joint_states": states(both, joints + fingers, [7, 8]),
        "/joint_states": states(both, joints + fingers),
    }
    topics = [(name, STATE, contents[name]) for name in topic_names]
    return write_bag(folder / "franka", topics, storage)


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


def in_amperes(data: Recording) -> Recording:
    """Return a UR's motion with motor currents in the place of torques."""
    return replace(data, tau=data.tau / UR_CONSTANTS)


def universal_robots(folder: Path, data: Recording) -> Path:
    """A bag of the UR driver: joints by the alphabet, 500 Hz; effort is current before PolyScope
    5.23, and by default.

    joint_state_broadcaster publishes /dynamic_joint_states beside /joint_states.
    """
    dynamic = recorded.dynamic_states(data, UR_JOINTS, [[0, 1, 2]] * 6)
    topics = [
        ("/joint_states", STATE, states(data, UR_JOINTS, np.argsort(UR_JOINTS))),
        ("/dynamic_joint_states", recorded.DYNAMIC, dynamic),
    ]
    return write_bag(folder / "ur", topics, "MCAP")


def xarm(folder: Path, data: Recording) -> Path:
    """A bag of xarm_api with the gripper: 100 Hz ("dev" reports), and twice a second a message
    of the gripper's six joints with neither velocity nor effort.
    """
    topics = [("/xarm/joint_states", STATE, xarm_states(data))]
    return write_bag(folder / "xarm", topics)


@later_of_types
def xarm_states(types: Any, data: Recording):
    """Return JointState messages of the arm, and those of the gripper between them."""
    arm = states(data, _numbered_names("joint"))(types)
    names = ["drive_joint", "left_finger_joint", "left_inner_knuckle_joint"]
    names += ["right_outer_knuckle_joint", "right_finger_joint"]
    names += ["right_inner_knuckle_joint"]
    unknown = np.full(6, np.nan)
    gripper = []
    for time in data.time[::50] + 0.003:
        state = joint_state(types, time, names, np.zeros(6), unknown, unknown)
        gripper.append((time, state))
    return sorted([*arm, *gripper], key=itemgetter(0))


def lbr(
    folder: Path, data: Recording, storage: str, topic_names: Sequence[str]
) -> Path:
    """A bag of lbr_fri_ros2_stack: 100 Hz, joints lbr_A1 .. lbr_A7; LBRState has no names."""
    contents = {
        "/lbr/joint_states": (STATE, states(data, _numbered_names("lbr_A"))),
        "/lbr/state": (LBR, lbr_states(data)),
    }
    topics = [(name, *contents[name]) for name in topic_names]
    return write_bag(folder / "lbr", topics, storage)


@later_of_types
def lbr_states(types: Any, data: Recording):
    """Yield LBRState messages, whose time is that of the controller."""
    zeros = np.zeros(7)
    for time, q, tau in zip(data.time, data.q, data.tau):
        seconds, nanoseconds = divmod(START_NS + round(1e9 * time), 10**9)
        modes = (0.01, 4, 3, 0, 2, 2, 1, 0, 4)
        stamp = (seconds, nanoseconds)
        arrays = (q, tau, zeros, 0.1 * tau, q + 1e-3)
        yield time, types[LBR](*modes, *stamp, *arrays, 1.0)


def kortex(folder: Path, data: Recording, topic_names: Sequence[str]) -> Path:
    """A ROS 1 bag of Kinova's driver with a gripper; angles of joint_states are within half a turn.

    The driver publishes 100 Hz at most by default, joint_1 .. joint_7 and the finger, whose effort
    is zero; base_feedback has no header and degrees from 0 to 360.
    """
    wrapped = replace(data, q=(data.q + np.pi) % (2.0 * np.pi) - np.pi)
    both = with_extra_joints(wrapped, 1, 0.4)
    contents = {
        "joint_states": (
            STATE,
            states(both, [*_numbered_names("joint_"), "finger_joint"]),
        ),
        "base_feedback": (KORTEX, kortex_feedback(data)),
    }
    topics = [(f"/my_gen3/{name}", *contents[name]) for name in topic_names]
    return write_bag(folder / "kortex", topics, "ROS1")


@later_of_types
def kortex_feedback(types: Any, data: Recording):
    """Yield BaseCyclic_Feedback messages, in degrees, N m and amperes."""
    actuator = types["kortex_driver/msg/ActuatorFeedback"]
    for time, q, qd, tau in zip(data.time, np.degrees(data.q), data.qd, data.tau):
        actuators = []
        for angle, speed, torque in zip(q % 360.0, np.degrees(qd), tau):
            measured = (angle, speed, torque, 0.1 * torque, 24.0, 30.0, 30.0)
            actuators.append(actuator(0, 0, 0, *measured, 0, 0, 0, 0))
        yield time, types[KORTEX](0, actuators)


def piper(folder: Path, data: Recording) -> Path:
    """A bag of Piper_ros: 200 Hz, the arm and its gripper twice, and what was commanded.

    Velocity has six entries, position and effort seven. Angles are thousandths of a degree times
    0.017444, efforts are N m. The node publishes commands as a JointState with zeros for effort.
    """
    degrees = np.round(np.degrees(data.q), 3)
    both = with_extra_joints(replace(data, q=0.017444 * degrees), 1, 0.05)
    zero = np.zeros_like(both.q)
    names = [*_numbered_names("joint", 6), "gripper"]
    measured = states(both, names, ..., 6)
    topics = [
        ("/joint_states_single", STATE, measured),
        ("/joint_states_feedback", STATE, measured),
        ("/joint_ctrl", STATE, states(replace(both, qd=zero, tau=zero), names)),
    ]
    return write_bag(folder / "piper", topics, "MCAP")


def openarm_bag(folder: Path, data: Recording) -> Path:
    """A bag of openarm_ros2: 100 Hz, both arms and fingers in one topic, the right arm at rest."""
    data = with_extra_joints(data, 9, 0.02)
    names = []
    for side in ("left", "right"):
        names += _numbered_names(f"openarm_{side}_joint")
        names.append(f"openarm_{side}_finger_joint1")
    topics = [("/joint_states", STATE, states(data, names))]
    return write_bag(folder / "openarm", topics, "MCAP")


def so101_data_set(folder: Path, version: str) -> Path:
    """LeRobot's SO-101 follower: positions and goals in degrees, gripper in per cent, at 30 Hz."""
    robot = load_robot_model(SO101)
    time = np.arange(900) / 30.0
    phase = np.outer(time, 0.6 + 0.2 * np.arange(robot.n_joints))
    titles = [f"{name}.pos" for name in (*robot.joint_names, "gripper")]
    middle = 0.5 * (robot.limits.lower + robot.limits.upper)
    goals = np.degrees(middle + 0.4 * np.sin(phase))
    measured = np.degrees(middle + 0.4 * np.sin(phase - 0.05))
    per_cent = np.full((len(time), 1), 50.0)
    features = {
        "action": (titles, np.hstack((goals, per_cent))),
        "observation.state": (titles, np.hstack((measured, per_cent))),
    }
    return write_data_set(folder / "so101_set", version, 30, features)


def i2rt_arrays(folder: Path, data: Recording) -> Path:
    """Observations of i2rt's MotorChainRobot, stacked in an .npz file beside their time."""
    gripper = np.full((len(data), 1), 0.7)
    path = folder / "yam.npz"
    np.savez(
        path,
        timestamp=1.7e9 + data.time,
        joint_pos=data.q,
        joint_vel=data.qd,
        joint_eff=data.tau,
        gripper_pos=gripper,
        gripper_vel=0.0 * gripper,
        gripper_eff=0.0 * gripper,
    )
    return path


@dataclass(frozen=True)
class DriverLog:
    """A recording of a driver, beside its arm.

    Attributes:
        name: of the recording, for tests.
        model: path of the arm's public model; "" is the arm of six joints.
        rate: at which identification takes the recording [Hz].
        writer: writes a motion into a folder and returns the recording's path.
        accuracy: of the recorded positions [rad].
    """

    name: str
    model: str
    rate: float
    writer: Callable[..., Path]
    accuracy: float = 1e-6

    def robot(self, folder: Path) -> RobotModel:
        """Return the arm, of a folder that its model may be written to."""
        if self.model:
            return model_of(self.model)
        return load_robot_model(six_joint_model(folder))

    def motion(self, load: float = 0.0) -> Recording:
        """Return what the recording holds, with a weight on the terminal link [kg]."""
        return motion_of(self.model, self.rate, load)

    def write(self, folder: Path, load: float = 0.0) -> Path:
        """Write the recording into a folder and return its path."""
        return self.writer(folder, self.motion(load))


PANDA = "franka_panda/panda.xml"
FR3 = "franka_fr3/FrankaFR3_7DoF.urdf"
UR5E = "universal_robots_ur5e/ur5e.xml"
XARM = "ufactory_xarm7/xarm7.xml"
IIWA = "kuka_iiwa_14/iiwa14.xml"
GEN3 = "kinova_gen3/gen3.xml"
_ALL_FRANKA = ("/franka/joint_states", "/franka_gripper/joint_states", "/joint_states")
_ALL_LBR = ("/lbr/joint_states", "/lbr/state")
_FR3_BAG = partial(franka, arm="fr3", storage="MCAP", topic_names=_ALL_FRANKA)
_PANDA_BAG = partial(franka, arm="panda", topic_names=_ALL_FRANKA[2:])
_ALL_KORTEX = ("joint_states", "base_feedback")
# enactic/openarm_ros2: openarm_bringup/config/v10_controllers
OPENARM_LOG = DriverLog("OpenArm bag", str(OPENARM), 100.0, openarm_bag)

DRIVER_LOGS = (
    # frankarobotics/franka_ros2: franka_bringup/launch/franka.launch.py
    DriverLog("panda bag", PANDA, 250.0, partial(_PANDA_BAG, storage="MCAP")),
    DriverLog("panda ROS 1 bag", PANDA, 250.0, partial(_PANDA_BAG, storage="ROS1")),
    DriverLog("fr3 all topics", FR3, 1000.0, _FR3_BAG),
    # UniversalRobots/Universal_Robots_ROS2_Driver:
    # ur_robot_driver/doc/usage/utility_controllers.rst and pull request 1551, whose author says of
    # these torques that gravity is compensated. This one has it, so that reading shows in numbers.
    DriverLog("UR torque as effort", UR5E, 500.0, universal_robots),
    # UniversalRobots/RTDE_Python_Client_Library: rtde/csv_writer.py
    DriverLog("UR RTDE torque", UR5E, 500.0, recorded.rtde),
    # xArm-Developer/xarm_ros2: xarm_api/src/xarm_driver.cpp
    DriverLog("xArm with gripper", XARM, 100.0, xarm),
    # lbr-stack/lbr_fri_ros2_stack: lbr_description/ros2_control/lbr_controllers.yaml;
    # lbr-stack/lbr_fri_idl: msg/LBRState.msg
    DriverLog(
        "LBR all topics",
        IIWA,
        100.0,
        partial(lbr, storage="MCAP", topic_names=_ALL_LBR),
    ),
    DriverLog(
        "LBR state alone",
        IIWA,
        100.0,
        partial(lbr, storage="SQLITE3", topic_names=_ALL_LBR[1:]),
    ),
    # Kinovarobotics/ros_kortex:
    # kortex_driver/src/non-generated/driver/kortex_arm_driver.cpp
    DriverLog("kortex ROS 1", GEN3, 100.0, partial(kortex, topic_names=_ALL_KORTEX)),
    # Kinova's own message has single precision.
    DriverLog(
        "kortex base_feedback alone",
        GEN3,
        100.0,
        partial(kortex, topic_names=_ALL_KORTEX[1:]),
        6e-6,
    ),
    # agilexrobotics/Piper_ros: src/piper/piper/piper_ctrl_single_node.py;
    # 0.017444 is 0.05 % less than a degree.
    DriverLog("Piper bag", "", 200.0, piper, 3e-3),
    OPENARM_LOG,
    # i2rt-robotics/i2rt: i2rt/robots/motor_chain_robot.py
    DriverLog("i2rt arrays", "", 100.0, i2rt_arrays),
)
"""Recordings whose efforts are torques: they need no option. The public code that is named states
names, order, rates and units."""
UNWEIGHED_LOGS = (
    DriverLog(
        "UR current as effort",
        UR5E,
        500.0,
        lambda folder, data: universal_robots(folder, in_amperes(data)),
    ),
    DriverLog(
        "UR RTDE current",
        UR5E,
        500.0,
        lambda folder, data: recorded.rtde(folder, in_amperes(data), "actual_current"),
    ),
)
"""Recordings whose efforts are no torques."""
