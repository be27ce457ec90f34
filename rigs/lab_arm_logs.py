"""Recordings of arms of the laboratory as their own software writes them: LeRobot's data sets, the
ROS node of AgileX's Piper, OpenArm's ROS 2 driver, and arrays of i2rt's observations.

SO-101's data sets follow huggingface/lerobot: src/lerobot/robots/so_follower (names, degrees, a
gripper from 0 to 100) and src/lerobot/datasets (files of versions 2 and 3).

Arms whose model is not public here are a serial arm with the joint names of the maker's model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from rigs import arms
from rigs.driver_logs import states, with_extra_joints
from rigs.places import MODELS
from rigs.recorded import STATE, joint_state, typestore, write_bag, write_data_set
from rigs.wrong_arms import truth_of
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Recording, RobotModel

SIX_JOINTS = arms.serial_arm(
    arms.SEVEN_AXES[:6], joint='range="-2.5 2.5" frictionloss=".2" damping=".1"'
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
def six_joint_motion(rate: float) -> Recording:
    """Return 12 s of a motion of the arm of six joints."""
    return truth_of(arms.robot_of(SIX_JOINTS), 3, rate=rate).log


@cache
def openarm() -> RobotModel:
    """Return the left arm of OpenArm's model of two."""
    return load_robot_model(OPENARM, joint="openarm_left_joint7")


@cache
def openarm_motion() -> Recording:
    """Return 12 s of a motion of OpenArm's left arm."""
    return truth_of(openarm(), 3, rate=100.0).log


def piper(folder: Path) -> Path:
    """A bag of Piper_ros: 200 Hz, the arm and its gripper twice, and what was commanded.

    Velocity has six entries, position and effort seven. Angles are thousandths of a degree times
    0.017444, efforts are N m. The node publishes commands as a JointState with zeros for effort.
    """
    store = typestore("MCAP")
    data = six_joint_motion(200.0)
    degrees = np.round(np.degrees(data.q), 3)
    both = with_extra_joints(replace(data, q=0.017444 * degrees), 1, 0.05)
    names = [*(f"joint{k}" for k in range(1, 7)), "gripper"]
    columns = (both.time, both.q, data.qd, both.tau)
    measured = []
    commanded = []
    for time, q, qd, tau in zip(*columns):
        measured.append((time, joint_state(store.types, time, names, q, qd, tau)))
        zero = np.zeros(7)
        commanded.append((time, joint_state(store.types, time, names, q, zero, zero)))
    topics = [
        ("/joint_states_single", STATE, measured),
        ("/joint_states_feedback", STATE, measured),
        ("/joint_ctrl", STATE, commanded),
    ]
    return write_bag(folder / "piper", topics, store, "MCAP")


def openarm_bag(folder: Path) -> Path:
    """A bag of openarm_ros2: 100 Hz, both arms and fingers in one topic, the right arm at rest."""
    store = typestore("MCAP")
    left = openarm_motion()
    data = with_extra_joints(left, 9, 0.02)
    names = [f"openarm_left_joint{k}" for k in range(1, 8)]
    names += ["openarm_left_finger_joint1"]
    names += [f"openarm_right_joint{k}" for k in range(1, 8)]
    names += ["openarm_right_finger_joint1"]
    topics = [("/joint_states", STATE, states(store.types, data, names))]
    return write_bag(folder / "openarm", topics, store, "MCAP")


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


def i2rt_arrays(folder: Path) -> Path:
    """Observations of i2rt's MotorChainRobot, stacked in an .npz file beside their time."""
    data = six_joint_motion(100.0)
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
class LabArmLog:
    """A recording with torques, beside its arm.

    Attributes:
        name: of the recording, for tests.
        robot: returns the arm, of a folder that its model may be written to.
        motion: returns what the recording holds.
        write: writes the recording into a folder and returns its path.
        accuracy: of the recorded positions [rad].
    """

    name: str
    robot: Callable[[Path], RobotModel]
    motion: Callable[[], Recording]
    write: Callable[[Path], Path]
    accuracy: float = 1e-6


def _six_joint_robot(folder: Path) -> RobotModel:
    """Return the arm of six joints."""
    return load_robot_model(six_joint_model(folder))


LAB_ARM_LOGS = (
    # agilexrobotics/Piper_ros: src/piper/piper/piper_ctrl_single_node.py;
    # 0.017444 is 0.05 % less than a degree.
    LabArmLog(
        "Piper bag",
        _six_joint_robot,
        partial(six_joint_motion, 200.0),
        piper,
        accuracy=3e-3,
    ),
    # enactic/openarm_ros2: openarm_bringup/config/v10_controllers
    LabArmLog("OpenArm bag", lambda folder: openarm(), openarm_motion, openarm_bag),
    # i2rt-robotics/i2rt: i2rt/robots/motor_chain_robot.py
    LabArmLog(
        "i2rt arrays", _six_joint_robot, partial(six_joint_motion, 100.0), i2rt_arrays
    ),
)
"""Recordings with torques, which need no option beside the model. The public code that is named
states names, order and units."""
