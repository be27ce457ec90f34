"""Messages of ROS that hold the state of an arm's joints, and what is read from each.

Read are sensor_msgs/JointState, control_msgs/DynamicJointState, and the messages of three makers'
drivers: Franka's FrankaRobotState, which holds a JointState, LBRState of a KUKA with the Fast Robot
Interface, and BaseCyclic_Feedback of Kinova's kortex. The last two list joints without names, base
first; they are called A1, A2, ... and actuator_1, actuator_2, ....
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np

from robot_sysid.records import Array

TORQUE = ("effort", "current")
"""Names, in messages of a bag, of quantities that stand for torque."""
QUANTITIES = ("position", "velocity", *TORQUE)
"""Names of all quantities that are read from messages of a bag."""
STATE = "sensor_msgs/msg/JointState"
DYNAMIC = "control_msgs/msg/DynamicJointState"
FRANKA = "franka_msgs/msg/FrankaRobotState"
LBR = "lbr_fri_idl/msg/LBRState"
KORTEX = "kortex_driver/msg/BaseCyclic_Feedback"
DEFINITIONS = {
    "control_msgs/msg/InterfaceValue": "string[] interface_names\nfloat64[] values\n",
    DYNAMIC: "std_msgs/Header header\nstring[] joint_names\n"
    "control_msgs/InterfaceValue[] interface_values\n",
    LBR: "float64 sample_time\nint8 session_state\nint8 connection_quality\nint8 safety_state\n"
    "int8 operation_mode\nint8 drive_state\nint8 client_command_mode\nint8 overlay_type\n"
    "int8 control_mode\nuint32 time_stamp_sec\nuint32 time_stamp_nano_sec\n"
    "float64[7] measured_joint_position\nfloat64[7] measured_torque\n"
    "float64[7] commanded_torque\nfloat64[7] external_torque\n"
    "float64[7] ipo_joint_position\nfloat64 tracking_performance\n",
}
"""Message types that rosbags does not define, for bags without definitions (.db3)."""

TURN_DEG = 360.0
"""A full turn [deg]."""

Key = tuple[str, str]
"""Names of a joint and of a quantity."""
Sample = Mapping[Key, float]
"""The numbers of a message: rad or m, rad/s or m/s, and effort in the driver's unit."""


def _header(message: Any) -> Any:
    """Return the header of a message, or None."""
    # FrankaRobotState holds a JointState, whose header has the time.
    return getattr(getattr(message, "measured_joint_state", message), "header", None)


def read_frame(message: Any) -> str:
    """Return the frame in the header of a message; "" for none."""
    return str(getattr(_header(message), "frame_id", ""))


def read_stamp(message: Any) -> int:
    """Return when a message was sampled [ns since 1970]; 0 where it does not say."""
    if hasattr(message, "time_stamp_sec"):
        return int(message.time_stamp_sec) * 10**9 + int(message.time_stamp_nano_sec)
    header = _header(message)
    if header is None:
        return 0
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def _joint_sample(names: Sequence[str], **quantities: Array) -> Sample:
    """Return the numbers (n,) of each quantity by joint; those not of every joint are left out."""
    sample: dict[Key, float] = {}
    for quantity, numbers in quantities.items():
        if len(numbers) == len(names):
            sample.update(zip(product(names, [quantity]), numbers.tolist()))
    return sample


def _read_joint_state(message: Any) -> Sample:
    """Return the numbers of a sensor_msgs/JointState; empty lists were not measured."""
    return _joint_sample(
        message.name,
        position=message.position,
        velocity=message.velocity,
        effort=message.effort,
    )


def _read_dynamic_joint_state(message: Any) -> Sample:
    """Return the numbers of a control_msgs/DynamicJointState."""
    sample = {}
    for joint, values in zip(message.joint_names, message.interface_values):
        for quantity, value in zip(values.interface_names, values.values):
            if quantity in QUANTITIES:
                sample[joint, quantity] = float(value)
    return sample


def _read_lbr_state(message: Any) -> Sample:
    """Return the measured positions [rad] and torques [N m] of an LBRState."""
    position = message.measured_joint_position
    names = [f"A{number}" for number in range(1, len(position) + 1)]
    return _joint_sample(names, position=position, effort=message.measured_torque)


def _read_kortex_feedback(message: Any) -> Sample:
    """Return the numbers of a BaseCyclic_Feedback, whose angles are degrees from 0 to 360.

    As in the joint_states of the same driver, angles are returned within half a turn.
    """
    rows = [(a.position, a.velocity, a.torque) for a in message.actuators]
    angle, speed, torque = np.array(rows, float).reshape(-1, 3).T
    half_turn = 0.5 * TURN_DEG
    return _joint_sample(
        [f"actuator_{number}" for number in range(1, len(rows) + 1)],
        position=np.radians((angle + half_turn) % TURN_DEG - half_turn),
        velocity=np.radians(speed),
        effort=torque,
    )


def read_array(field: str, joint_names: Sequence[str], message: Any) -> Sample:
    """Return the numbers of an array of torques, one per joint, base first."""
    return _joint_sample(joint_names, effort=np.asarray(getattr(message, field), float))


Readers = Mapping[str, Callable[[Any], Sample]]
"""Message type to the function that returns the numbers of a message."""
READERS: Readers = {
    STATE: _read_joint_state,
    FRANKA: lambda message: _read_joint_state(message.measured_joint_state),
    LBR: _read_lbr_state,
    KORTEX: _read_kortex_feedback,
    DYNAMIC: _read_dynamic_joint_state,
}
"""Message type to the function that returns the numbers of a message; of several that hold the same
samples, the first is read."""
