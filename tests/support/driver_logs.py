"""Recordings of a simulated arm as the makers' own drivers publish and write them.

Each entry of ``DRIVER_LOGS`` writes a motion of a public model in the format of one driver: names
and order of the joints, extra joints, rates, units, and the zeros that a driver writes where it
measures nothing. ``source`` says where the driver's public code states them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.parser import load_robot_model
from robot_sysid.records import Measurement, RobotModel
from tests.support import recorded
from tests.support.log_files import write
from tests.support.places import MODELS
from tests.support.recorded import STATE, joint_state
from tests.support.wrong_logs import truth_of

START_NS = 1_700_000_000 * 10**9
"""Time at which the recordings begin [ns since 1970]."""
_LATENCY_NS = 400_000
"""Time from a message's stamp until it was recorded [ns]."""
LBR_STATE = "lbr_fri_idl/msg/LBRState"
KORTEX_FEEDBACK = "kortex_driver/msg/BaseCyclic_Feedback"
_DEFINITIONS = {
    LBR_STATE: "float64 sample_time\nint8 session_state\nint8 connection_quality\n"
    "int8 safety_state\nint8 operation_mode\nint8 drive_state\nint8 client_command_mode\n"
    "int8 overlay_type\nint8 control_mode\nuint32 time_stamp_sec\n"
    "uint32 time_stamp_nano_sec\nfloat64[7] measured_joint_position\n"
    "float64[7] measured_torque\nfloat64[7] commanded_torque\nfloat64[7] external_torque\n"
    "float64[7] ipo_joint_position\nfloat64 tracking_performance\n",
    "kortex_driver/msg/ActuatorFeedback": "uint32 command_id\nuint32 status_flags\n"
    "uint32 jitter_comm\nfloat32 position\nfloat32 velocity\nfloat32 torque\n"
    "float32 current_motor\nfloat32 voltage\nfloat32 temperature_motor\n"
    "float32 temperature_core\nuint32 fault_bank_a\nuint32 fault_bank_b\n"
    "uint32 warning_bank_a\nuint32 warning_bank_b\n",
    # The real message has the base's and the interconnect's feedback, too.
    KORTEX_FEEDBACK: "uint32 frame_id\nActuatorFeedback[] actuators\n",
}

StampedMessage = tuple[float, Any]
"""(time from the start [s], message)."""
Topic = tuple[str, str, Iterable[StampedMessage]]
"""(name, message type, messages)."""


@cache
def model_of(path: str) -> RobotModel:
    """Return a public model, by its path below the folder of models."""
    return load_robot_model(MODELS / path)


@cache
def motion_of(path: str, rate: float = 250.0, load: float = 0.0) -> Measurement:
    """Return 12 s of a motion of a public model whose links are a little off, with sensor noise.

    ``load`` is the mass of a weight on the terminal link [kg]; the motion is the same with it.
    """
    return truth_of(model_of(path), 3, rate=rate, load=load).log


def every(data: Measurement, step: int) -> Measurement:
    """Return every ``step``-th sample."""
    columns = (data.time, data.q, data.qd, data.tau)
    return Measurement(*(array[::step] for array in columns))


def states(types: Any, data: Measurement, names: Sequence[str], order: Any = None):
    """Yield JointState messages of an arm's joints, in the order of these indices."""
    order = list(range(len(names)) if order is None else order)
    listed = [names[k] for k in order]
    for time, q, qd, tau in zip(data.time, data.q, data.qd, data.tau):
        yield time, joint_state(types, time, listed, q[order], qd[order], tau[order])


def gripper_states(types: Any, time: Any, names: Sequence[str], width: float):
    """Yield JointState messages of fingers that stand still; velocity and effort are zero."""
    zero = np.zeros(len(names))
    for stamp in time:
        yield stamp, joint_state(types, stamp, names, zero + width, zero, zero)


def with_extra_joints(data: Measurement, count: int, position: float) -> Measurement:
    """Return a motion with further joints that stand still, whose velocity and effort are zero."""
    zero = np.zeros((len(data), count))
    q = np.column_stack((data.q, zero + position))
    qd = np.column_stack((data.qd, zero))
    tau = np.column_stack((data.tau, zero))
    return Measurement(data.time, q, qd, tau)


def write_bag(path: Path, topics: Sequence[Topic], storage: str, store: Any) -> Path:
    """Write a bag, its messages in the order of time, and return its path.

    ``storage``: "SQLITE3" or "MCAP" of ROS 2, or "ROS1".
    """
    import rosbags.rosbag1 as rosbag1
    import rosbags.rosbag2 as rosbag2

    if storage == "ROS1":
        path = path.with_suffix(".bag")
        writer = rosbag1.Writer(path)
        serialize = store.serialize_ros1
    else:
        plugins = getattr(rosbag2, "StoragePlugin", None)
        options = {"version": 9, "storage_plugin": plugins[storage]} if plugins else {}
        writer = rosbag2.Writer(path, **options)
        serialize = store.serialize_cdr
    queue = []
    with writer:
        for name, message_type, messages in topics:
            connection = writer.add_connection(name, message_type, typestore=store)
            for time, message in messages:
                received = START_NS + round(1e9 * time) + _LATENCY_NS
                queue.append((received, connection, serialize(message, message_type)))
        for received, connection, raw in sorted(queue, key=lambda entry: entry[0]):
            writer.write(connection, received, raw)
    return path


def typestore(storage: str = "") -> Any:
    """Return the message types of a ROS release, those of KUKA's and Kinova's drivers included."""
    from rosbags.typesys import get_types_from_msg

    store = recorded.typestore(ros1=storage == "ROS1")
    for name, text in _DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def _numbered(name: str, count: int = 7) -> list[str]:
    """Return a name with the numbers from 1 on."""
    return [f"{name}{k}" for k in range(1, count + 1)]


def franka(folder: Path, arm: str, model: str, storage: str) -> Path:
    """A bag of the topics of franka_bringup's launch file, with the hand.

    joint_state_broadcaster has the arm at the rate of the controller manager; franka_gripper has
    the fingers; joint_state_publisher puts both together in /joint_states, at 30 Hz.
    """
    store = typestore(storage)
    types = store.types
    data = motion_of(model, rate=1000.0)
    joints = _numbered(f"{arm}_joint")
    fingers = _numbered(f"{arm}_finger_joint", 2)
    slow = every(data, 33)
    both = with_extra_joints(slow, 2, 0.035)
    topics = [
        ("/franka/joint_states", STATE, states(types, data, joints)),
        (
            "/franka_gripper/joint_states",
            STATE,
            gripper_states(types, slow.time, fingers, 0.035),
        ),
        ("/joint_states", STATE, states(types, both, [*joints, *fingers])),
    ]
    return write_bag(folder / "franka", topics, storage, store)


def franka_joint_states(
    folder: Path, arm: str, model: str, storage: str, rate: float = 250.0
) -> Path:
    """A bag of /joint_states alone, arm and fingers in one message.

    The launch file's rate is 30 Hz; it may be set.
    """
    store = typestore(storage)
    joints = [*_numbered(f"{arm}_joint"), *_numbered(f"{arm}_finger_joint", 2)]
    data = with_extra_joints(motion_of(model, rate), 2, 0.035)
    topics = [("/joint_states", STATE, states(store.types, data, joints))]
    return write_bag(folder / "panda", topics, storage, store)


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


def in_amperes(data: Measurement) -> Measurement:
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
        dynamic = dynamic_states(types, data, UR_JOINTS)
        topics.append(("/dynamic_joint_states", recorded.DYNAMIC, dynamic))
    return write_bag(folder / "ur", topics, storage, store)


def dynamic_states(types: Any, data: Measurement, names: Sequence[str]):
    """Yield DynamicJointState messages with the interfaces of ros2_control."""
    interface_values = types["control_msgs/msg/InterfaceValue"]
    interfaces = list(recorded.INTERFACES)
    rows = np.stack((data.q, data.qd, data.tau), axis=2)
    for time, joints in zip(data.time, rows):
        values = [interface_values(interfaces, numbers) for numbers in joints]
        header = recorded.header(types, time)
        yield time, types[recorded.DYNAMIC](header, list(names), values)


def rtde(folder: Path, torque: str, load: float = 0.0) -> Path:
    """What record.py of the RTDE client writes: blanks between cells, a column per element."""
    data = motion_of(UR5E, 500.0, load)
    is_current = torque == "actual_current"
    measured = in_amperes(data).tau if is_current else data.tau
    groups = ("actual_q", "actual_qd", torque, "target_moment")
    titles = ["timestamp", *(f"{group}_{k}" for group in groups for k in range(6))]
    # Time since the controller was switched on; the controller's model has no friction.
    stamp = 1234.5 + data.time
    rows = np.column_stack((stamp, data.q, data.qd, measured, 0.9 * data.tau))
    return write(folder / "robot_data.csv", rows, titles, " ")


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
    return write_bag(folder / "xarm", topics, storage, store)


IIWA = "kuka_iiwa_14/iiwa14.xml"


def lbr(folder: Path, storage: str, topic_names: Sequence[str]) -> Path:
    """A bag of lbr_fri_ros2_stack: 100 Hz, joints lbr_A1 .. lbr_A7; LBRState has no names."""
    store = typestore(storage)
    types = store.types
    data = motion_of(IIWA, rate=100.0)
    contents = {
        "/lbr/joint_states": (STATE, states(types, data, _numbered("lbr_A"))),
        "/lbr/state": (LBR_STATE, lbr_states(types, data)),
    }
    topics = [(name, *contents[name]) for name in topic_names]
    return write_bag(folder / "lbr", topics, storage, store)


def lbr_states(types: Any, data: Measurement):
    """Yield LBRState messages, whose time is that of the controller."""
    zeros = np.zeros(7)
    for time, q, tau in zip(data.time, data.q, data.tau):
        seconds, nanoseconds = divmod(START_NS + round(1e9 * time), 10**9)
        modes = (0.01, 4, 3, 0, 2, 2, 1, 0, 4)
        stamp = (seconds, nanoseconds)
        arrays = (q, tau, zeros, 0.1 * tau, q + 1e-3)
        yield time, types[LBR_STATE](*modes, *stamp, *arrays, 1.0)


def iiwa_ros(folder: Path) -> Path:
    """A ROS 1 bag of iiwa_ros: 200 Hz, joints iiwa_joint_1 .. iiwa_joint_7."""
    store = typestore("ROS1")
    data = motion_of(IIWA, rate=200.0)
    messages = states(store.types, data, _numbered("iiwa_joint_"))
    topics = [("/iiwa/joint_states", STATE, messages)]
    return write_bag(folder / "iiwa", topics, "ROS1", store)


GEN3 = "kinova_gen3/gen3.xml"


def kortex(folder: Path, storage: str, topic_names: Sequence[str]) -> Path:
    """A bag of Kinova's drivers with a gripper; angles of joint_states are within half a turn.

    The ROS 1 driver publishes 100 Hz at most by default, joint_1 .. joint_7 and the finger, whose
    effort is zero; base_feedback has no header and degrees from 0 to 360. The ROS 2 driver's
    controller manager runs at 1 kHz.
    """
    store = typestore(storage)
    types = store.types
    is_ros1 = storage == "ROS1"
    data = motion_of(GEN3, rate=100.0 if is_ros1 else 1000.0)
    finger = "finger_joint" if is_ros1 else "robotiq_85_left_knuckle_joint"
    wrapped = replace(data, q=(data.q + np.pi) % (2.0 * np.pi) - np.pi)
    both = with_extra_joints(wrapped, 1, 0.4)
    names = [*_numbered("joint_"), finger]
    space = "/my_gen3" if is_ros1 else ""
    contents = {
        "joint_states": (STATE, states(types, both, names)),
        "base_feedback": (KORTEX_FEEDBACK, kortex_feedback(types, data)),
    }
    topics = [(f"{space}/{name}", *contents[name]) for name in topic_names]
    return write_bag(folder / "kortex", topics, storage, store)


def kortex_feedback(types: Any, data: Measurement):
    """Yield BaseCyclic_Feedback messages, in degrees, N m and amperes."""
    actuator = types["kortex_driver/msg/ActuatorFeedback"]
    for time, q, qd, tau in zip(data.time, np.degrees(data.q), data.qd, data.tau):
        actuators = []
        for angle, speed, torque in zip(q % 360.0, np.degrees(qd), tau):
            measured = (angle, speed, torque, 0.1 * torque, 24.0, 30.0, 30.0)
            actuators.append(actuator(0, 0, 0, *measured, 0, 0, 0, 0))
        yield time, types[KORTEX_FEEDBACK](0, actuators)


@dataclass(frozen=True)
class DriverLog:
    """A recording of a driver, beside the model of its arm.

    Attributes:
        name: of the recording, for tests.
        model: path of the model, below the folder of public models.
        write: writes the recording into a folder and returns its path.
        source: repository and file that state names, order, rates and units.
        rate: of the samples that identification takes [Hz].
    """

    name: str
    model: str
    write: Callable[..., Path]
    source: str
    rate: float


PANDA = "franka_panda/panda.xml"
PANDA_NOHAND = "franka_panda/panda_nohand.xml"
FR3 = "franka_fr3/FrankaFR3_7DoF.urdf"
_FRANKA_SOURCE = "frankarobotics/franka_ros2: franka_bringup/launch/franka.launch.py"
_UR_SOURCE = (
    "UniversalRobots/Universal_Robots_ROS2_Driver: "
    "ur_robot_driver/doc/usage/utility_controllers.rst and pull request 1551"
)
_RTDE_SOURCE = "UniversalRobots/RTDE_Python_Client_Library: rtde/csv_writer.py"
_XARM_SOURCE = "xArm-Developer/xarm_ros2: xarm_api/src/xarm_driver.cpp"
_LBR_SOURCE = (
    "lbr-stack/lbr_fri_ros2_stack: lbr_description/ros2_control/lbr_controllers.yaml; "
    "lbr-stack/lbr_fri_idl: msg/LBRState.msg"
)
_IIWA_SOURCE = "epfl-lasa/iiwa_ros: iiwa_driver/config/iiwa.yaml"
_KORTEX1_SOURCE = (
    "Kinovarobotics/ros_kortex: "
    "kortex_driver/src/non-generated/driver/kortex_arm_driver.cpp"
)
_KORTEX2_SOURCE = "Kinovarobotics/ros2_kortex: kortex_driver/src/hardware_interface.cpp"
_JOINT_STATES = ("/lbr/joint_states",)
_ALL_LBR = ("/lbr/joint_states", "/lbr/state")

DRIVER_LOGS = (
    DriverLog(
        "panda bag",
        PANDA,
        lambda folder: franka_joint_states(folder, "panda", PANDA, "MCAP"),
        _FRANKA_SOURCE,
        250.0,
    ),
    DriverLog(
        "panda bag at 30 Hz",
        PANDA,
        lambda folder: franka_joint_states(folder, "panda", PANDA, "MCAP", rate=30.0),
        _FRANKA_SOURCE,
        30.0,
    ),
    DriverLog(
        "panda_nohand bag",
        PANDA_NOHAND,
        lambda folder: franka_joint_states(folder, "panda", PANDA_NOHAND, "SQLITE3"),
        _FRANKA_SOURCE,
        250.0,
    ),
    DriverLog(
        "panda ROS 1 bag",
        PANDA,
        lambda folder: franka_joint_states(folder, "panda", PANDA, "ROS1"),
        _FRANKA_SOURCE,
        250.0,
    ),
    DriverLog(
        "fr3 all topics",
        FR3,
        lambda folder: franka(folder, "fr3", FR3, "MCAP"),
        _FRANKA_SOURCE,
        1000.0,
    ),
    DriverLog(
        "fr3 on a panda's names",
        PANDA,
        lambda folder: franka(folder, "fr3", PANDA, "SQLITE3"),
        _FRANKA_SOURCE,
        1000.0,
    ),
    DriverLog(
        "UR torque as effort",
        UR5E,
        lambda folder: universal_robots(folder, "MCAP", is_current=False),
        _UR_SOURCE,
        500.0,
    ),
    DriverLog(
        "UR ROS 1 torque as effort",
        UR5E,
        lambda folder: universal_robots(folder, "ROS1", is_current=False),
        _UR_SOURCE,
        500.0,
    ),
    DriverLog(
        "UR RTDE torque",
        UR5E,
        lambda folder: rtde(folder, "actual_current_as_torque"),
        _RTDE_SOURCE,
        500.0,
    ),
    DriverLog(
        "xArm with gripper",
        "ufactory_xarm7/xarm7.xml",
        lambda folder: xarm(folder, "SQLITE3"),
        _XARM_SOURCE,
        100.0,
    ),
    DriverLog(
        "LBR joint_states",
        IIWA,
        lambda folder: lbr(folder, "SQLITE3", _JOINT_STATES),
        _LBR_SOURCE,
        100.0,
    ),
    DriverLog(
        "LBR all topics",
        IIWA,
        lambda folder: lbr(folder, "MCAP", _ALL_LBR),
        _LBR_SOURCE,
        100.0,
    ),
    DriverLog(
        "LBR state alone",
        IIWA,
        lambda folder: lbr(folder, "SQLITE3", _ALL_LBR[1:]),
        _LBR_SOURCE,
        100.0,
    ),
    DriverLog("iiwa_ros", IIWA, iiwa_ros, _IIWA_SOURCE, 200.0),
    DriverLog(
        "kortex ROS 1",
        GEN3,
        lambda folder: kortex(folder, "ROS1", ("joint_states", "base_feedback")),
        _KORTEX1_SOURCE,
        100.0,
    ),
    DriverLog(
        "kortex base_feedback alone",
        GEN3,
        lambda folder: kortex(folder, "ROS1", ("base_feedback",)),
        _KORTEX1_SOURCE,
        100.0,
    ),
    DriverLog(
        "kortex ROS 2",
        GEN3,
        lambda folder: kortex(folder, "MCAP", ("joint_states",)),
        _KORTEX2_SOURCE,
        1000.0,
    ),
)
"""Recordings whose efforts are torques: they need no option."""
UNWEIGHED_LOGS = (
    DriverLog(
        "UR current as effort",
        UR5E,
        partial(universal_robots, storage="MCAP", is_current=True),
        _UR_SOURCE,
        500.0,
    ),
    DriverLog(
        "UR RTDE current",
        UR5E,
        partial(rtde, torque="actual_current"),
        _RTDE_SOURCE,
        500.0,
    ),
)
"""Recordings whose efforts are no torques. Their ``write`` takes ``load``, the mass of a weight on
the terminal link [kg]."""
