"""The same motion in every form that recordings come in, each written by the form's own library."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from robot_sysid.records import Measurement
from tests.support.log_files import JOINTS, write

DYNAMIC = "control_msgs/msg/DynamicJointState"
FRANKA = "franka_msgs/msg/FrankaRobotState"
STATE = "sensor_msgs/msg/JointState"
_DEFINITIONS = {
    "control_msgs/msg/InterfaceValue": "string[] interface_names\nfloat64[] values\n",
    DYNAMIC: "std_msgs/Header header\nstring[] joint_names\n"
    "control_msgs/InterfaceValue[] interface_values\n",
    # The fields of the real message that stand before and behind the one that is read.
    FRANKA: "std_msgs/Header header\nsensor_msgs/JointState measured_joint_state\n"
    "sensor_msgs/JointState desired_joint_state\nfloat64 time\n",
}


def typestore(ros1: bool = False):
    """The message types of a ROS release and those that tests need."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    for name, text in _DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def header(types, time: float):
    """A time in 2023, with nanoseconds that a float of seconds does not hold."""
    seconds, nanoseconds = divmod(round(1e9 * time), 10**9)
    stamp = types["builtin_interfaces/msg/Time"](1_700_000_000 + seconds, nanoseconds)
    header_type = types["std_msgs/msg/Header"]
    return (
        header_type(0, stamp, "base")
        if "seq" in header_type.__annotations__
        else header_type(stamp, "base")
    )


def joint_state(types, time, names, q, qd, tau):
    """A JointState; ``None`` leaves a list empty."""
    lists = [np.asarray([] if v is None else v, float) for v in (q, qd, tau)]
    return types[STATE](header(types, time), list(names), *lists)


def shuffled_states(types, data: Measurement, names=JOINTS):
    """The arm's messages, in an order that changes, with a gripper's between them."""
    rng = np.random.default_rng(1)
    for time, q, qd, tau in zip(data.time, data.q, data.qd, data.tau):
        order = rng.permutation(len(names))
        listed = [names[k] for k in order]
        yield joint_state(types, time, listed, q[order], qd[order], tau[order])
        yield joint_state(types, time, ["finger"], [0.01], [0.0], [1.0])


def write_bag2(path: Path, topics, store, storage="SQLITE3", compression="") -> Path:
    """A ROS 2 bag; ``topics`` are (name, type, messages), ``compression`` is by zstd."""
    import rosbags.rosbag2 as rosbag2

    plugins = getattr(rosbag2, "StoragePlugin", None)
    if plugins is None and storage != "SQLITE3":
        pytest.skip("the last rosbags for Python 3.9 writes .db3 only")
    options = {"version": 9, "storage_plugin": plugins[storage]} if plugins else {}
    writer = rosbag2.Writer(path, **options)
    if compression:
        names = rosbag2 if plugins else writer
        mode = names.CompressionMode[compression]
        form = names.CompressionFormat.ZSTD
        writer.set_compression(mode, form)
    return _written(path, writer, topics, store, store.serialize_cdr)


def write_bag1(path: Path, topics, store, compression=None) -> Path:
    """A ROS 1 bag."""
    from rosbags.rosbag1 import Writer

    writer = Writer(path)
    if compression:
        writer.set_compression(Writer.CompressionFormat[compression])
    return _written(path, writer, topics, store, store.serialize_ros1)


def _written(path: Path, writer, topics, store, serialize) -> Path:
    with writer:
        for topic, message_type, messages in topics:
            connection = writer.add_connection(topic, message_type, typestore=store)
            for count, message in enumerate(messages):
                writer.write(
                    connection, 10**9 + count * 10**6, serialize(message, message_type)
                )
    return path


def rosbag2(folder: Path, data: Measurement, storage: str = "SQLITE3") -> Path:
    store = typestore()
    topics = [("/joint_states", STATE, shuffled_states(store.types, data))]
    return write_bag2(folder / "bag", topics, store, storage)


def single_mcap(folder: Path, data: Measurement) -> Path:
    """The .mcap file alone, without its folder's metadata."""
    (file,) = rosbag2(folder, data, "MCAP").glob("*.mcap")
    return file.rename(folder / "alone.mcap")


def rosbag1(folder: Path, data: Measurement) -> Path:
    store = typestore(ros1=True)
    topics = [("/joint_states", STATE, shuffled_states(store.types, data))]
    return write_bag1(folder / "log.bag", topics, store)


def dynamic_joint_state(folder: Path, data: Measurement) -> Path:
    """DynamicJointState with the interfaces in another order for every joint."""
    store = typestore()
    value = store.types["control_msgs/msg/InterfaceValue"]

    def messages():
        for time, q, qd, tau in zip(data.time, data.q, data.qd, data.tau):
            rows = [
                {"position": a, "velocity": b, "effort": c}
                for a, b, c in zip(q, qd, tau)
            ]
            orders = [
                sorted(rows[0]),
                sorted(rows[0], reverse=True),
                ["effort", *sorted(rows[0])],
            ]
            values = [
                value(
                    list(dict.fromkeys(order)),
                    np.array([row[k] for k in dict.fromkeys(order)]),
                )
                for row, order in zip(rows, orders)
            ]
            yield store.types[DYNAMIC](header(store.types, time), list(JOINTS), values)

    return write_bag2(
        folder / "bag", [("/dynamic_joint_states", DYNAMIC, messages())], store
    )


def franka_state(folder: Path, data: Measurement) -> Path:
    """FrankaRobotState in an MCAP, with its definition in the file."""
    store = typestore()
    types = store.types

    def messages():
        for time, q, qd, tau in zip(data.time, data.q, data.qd, data.tau):
            measured = joint_state(
                types, time, [f"fr3_{j}" for j in JOINTS], q, qd, tau
            )
            desired = joint_state(types, time, JOINTS, -q, -qd, -tau)
            yield types[FRANKA](header(types, time), measured, desired, time)

    topics = [("/franka_robot_state_broadcaster/robot_state", FRANKA, messages())]
    return write_bag2(folder / "bag", topics, store, "MCAP")


def lerobot(version: str, episodes: int = 1) -> Callable[[Path, Measurement], Path]:
    """A data set in degrees; several episodes repeat the motion."""

    def write(folder: Path, data: Measurement) -> Path:
        import pyarrow as pa
        import pyarrow.parquet as pq

        root = folder / "set"
        (root / "meta").mkdir(parents=True)
        (root / "data" / "chunk-000").mkdir(parents=True)
        names = [f"{j}.{end}" for j in JOINTS for end in ("pos", "vel", "torque")]
        angles = np.degrees(np.stack((data.q, data.qd), axis=2))
        state = np.concatenate((angles, data.tau[:, :, None]), axis=2).reshape(
            len(data), -1
        )
        feature = {"dtype": "float64", "shape": [len(names)], "names": names}
        info = {
            "codebase_version": version,
            "fps": 200,
            "features": {"observation.state": feature},
        }
        (root / "meta" / "info.json").write_text(json.dumps(info))

        def frames(episode: int):
            return pa.table(
                {
                    "observation.state": pa.array(
                        state.tolist(), pa.list_(pa.float64())
                    ),
                    "timestamp": data.time - data.time[0],
                    "episode_index": np.full(len(data), episode),
                    "frame_index": np.arange(len(data)),
                }
            )

        if version.startswith("v2"):
            for k in range(episodes):
                pq.write_table(
                    frames(k), root / f"data/chunk-000/episode_{k:06d}.parquet"
                )
        else:
            whole = pa.concat_tables([frames(k) for k in range(episodes)])
            pq.write_table(whole, root / "data/chunk-000/file-000.parquet")
        return root

    return write


def npz(folder: Path, data: Measurement) -> Path:
    path = folder / "log.npz"
    np.savez(
        path,
        time=data.time,
        q=data.q,
        qd=data.qd,
        tau=data.tau,
        note="text is no column",
    )
    return path


def arrow(data: Measurement):
    """A table of Arrow: time in dates, positions as lists, a column per torque, and text."""
    import pyarrow as pa

    stamps = np.datetime64("2024-05-01T12:00:00", "ns") + np.round(
        1e9 * data.time
    ).astype(int)
    columns = {
        "time": stamps,
        "q": data.q.tolist(),
        "qd": data.qd.tolist(),
        "note": ["text"] * len(data),
    }
    return pa.table({**columns, **{f"tau{k}": tau for k, tau in enumerate(data.tau.T)}})


def parquet(folder: Path, data: Measurement) -> Path:
    import pyarrow.parquet as pq

    pq.write_table(arrow(data), folder / "log.parquet", row_group_size=7)
    return folder / "log.parquet"


def feather(folder: Path, data: Measurement) -> Path:
    from pyarrow.feather import write_feather

    write_feather(arrow(data), folder / "log.feather", compression="zstd", chunksize=7)
    return folder / "log.feather"


def libfranka(folder: Path, data: Measurement) -> Path:
    """The columns of logToCSV."""
    zero = np.zeros_like(data.q)
    groups = {
        "state.q": data.q,
        "state.q_d": zero,
        "state.dq": data.qd,
        "state.dq_d": zero,
    }
    groups |= {
        "state.tau_J": data.tau,
        "state.tau_ext_hat_filtered": zero,
        "cmd.tau_J_d": zero,
    }
    titles = ["time", "success_rate", *(f"{g}[{k}]" for g in groups for k in range(3))]
    rows = np.column_stack((1e3 * data.time, np.ones(len(data)), *groups.values()))
    return write(folder / "franka.csv", rows, titles)


def rtde(
    folder: Path, data: Measurement, torque: str = "actual_current_as_torque"
) -> Path:
    """What record.py writes: blanks between cells."""
    groups = ("actual_q", "actual_qd", torque, "target_moment")
    titles = ["timestamp", *(f"{g}_{k}" for g in groups for k in range(3))]
    rows = np.column_stack((data.time, data.q, data.qd, data.tau, -data.tau))
    return write(folder / "rtde.csv", rows, titles, " ")


def plotjuggler(folder: Path, data: Measurement) -> Path:
    """One column per series; rows of another topic leave the arm's cells empty."""
    words = ("position", "velocity", "effort")
    titles = ["__time", "/battery/voltage"]
    titles += [f"/joint_states/{joint}/{word}" for word in words for joint in JOINTS]
    rows: list[list[object]] = []
    for time, *values in zip(data.time, data.q, data.qd, data.tau):
        rows.append([float(time), "", *np.concatenate(values).tolist()])
        rows.append([float(time) + 0.002, 24.1, *[""] * 9])
    return write(folder / "plot.csv", rows, titles)


FORMS: dict[str, Callable[[Path, Measurement], Path]] = {
    "ROS 2 db3": rosbag2,
    "ROS 2 single mcap": single_mcap,
    "ROS 1 bag": rosbag1,
    "ROS 2 DynamicJointState": dynamic_joint_state,
    "ROS 2 FrankaRobotState": franka_state,
    "LeRobot": lerobot("v2.1"),
    "Parquet": parquet,
    "Feather": feather,
    "npz": npz,
    "libfranka": libfranka,
    "RTDE": rtde,
    "PlotJuggler": plotjuggler,
}
