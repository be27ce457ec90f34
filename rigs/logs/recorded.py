"""The same motion in every form that recordings come in, each written by the form's own library."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from rigs.logs.log_files import JOINTS, write
from robot_sysid.logs.ros_messages import DEFINITIONS, DYNAMIC, FRANKA, KORTEX, STATE
from robot_sysid.records import Recording

START_NS = 1_700_000_000 * 10**9
"""Time at which recordings begin [ns since 1970]."""
LATENCY_NS = 400_000
"""Time from a message's stamp until it was recorded [ns]."""
INTERFACES = ("position", "velocity", "effort")
ORDERS = ([2, 0, 1], [1, 0, 2], [2, 0, 1])
"""Order of ``INTERFACES`` in a joint's message, for each joint."""
_DEFINITIONS = {
    # The fields of the real message that stand before and behind the one that is read.
    FRANKA: "std_msgs/Header header\nsensor_msgs/JointState measured_joint_state\n"
    "sensor_msgs/JointState desired_joint_state\nfloat64 time\n",
    "kortex_driver/msg/ActuatorFeedback": "uint32 command_id\nuint32 status_flags\n"
    "uint32 jitter_comm\nfloat32 position\nfloat32 velocity\nfloat32 torque\n"
    "float32 current_motor\nfloat32 voltage\nfloat32 temperature_motor\n"
    "float32 temperature_core\nuint32 fault_bank_a\nuint32 fault_bank_b\n"
    "uint32 warning_bank_a\nuint32 warning_bank_b\n",
    # The real message has the base's and the interconnect's feedback, too.
    KORTEX: "uint32 frame_id\nActuatorFeedback[] actuators\n",
}


def typestore(storage: str = ""):
    """The message types of a ROS release, of ROS 1 for "ROS1", and those that tests need."""
    typesys = pytest.importorskip("rosbags.typesys")
    release = "ROS1_NOETIC" if storage == "ROS1" else "ROS2_HUMBLE"
    store = typesys.get_typestore(typesys.Stores[release])
    for name, text in {**DEFINITIONS, **_DEFINITIONS}.items():
        store.register(typesys.get_types_from_msg(text, name))
    return store


def header(types, time: float, frame: str = "base"):
    """A time in 2023, with nanoseconds that a float of seconds does not hold."""
    seconds, nanoseconds = divmod(round(1e9 * time), 10**9)
    seconds += START_NS // 10**9
    stamp = types["builtin_interfaces/msg/Time"](seconds, nanoseconds)
    header_type = types["std_msgs/msg/Header"]
    sequence = (0,) if "seq" in header_type.__annotations__ else ()
    return header_type(*sequence, stamp, frame)


def joint_state(types, time, names, q, qd, tau, frame="base"):
    """A JointState; ``None`` leaves a list empty."""
    lists = [np.asarray([] if v is None else v, float) for v in (q, qd, tau)]
    return types[STATE](header(types, time, frame), list(names), *lists)


def later_of_types(messages):
    """Return a function of all arguments but the types, whose result yields messages of types."""
    return lambda *arguments: lambda types: messages(types, *arguments)


@later_of_types
def shuffled_states(types, data: Recording, names=JOINTS):
    """The arm's messages, in an order that changes, with a gripper's between them."""
    rng = np.random.default_rng(1)
    for time, q, qd, tau in zip(data.time, data.q, data.qd, data.tau):
        order = rng.permutation(len(names))
        listed = [names[k] for k in order]
        yield joint_state(types, time, listed, q[order], qd[order], tau[order])
        yield joint_state(types, time, ["finger"], [0.01], [0.0], [1.0])


def write_bag(path: Path, topics, storage="SQLITE3") -> Path:
    """A bag; ``topics`` are (name, type, function of the types that yields messages).

    ``storage``: "SQLITE3" or "MCAP" of ROS 2, or "ROS1".
    """
    store = typestore(storage)
    if storage == "ROS1":
        from rosbags.rosbag1 import Writer

        path = path.with_suffix(".bag")
        return _written(path, Writer(path), topics, store, store.serialize_ros1)
    import rosbags.rosbag2 as rosbag2

    plugins = getattr(rosbag2, "StoragePlugin", None)
    if plugins is None and storage != "SQLITE3":
        pytest.skip("the last rosbags for Python 3.9 writes .db3 only")
    options = {"version": 9, "storage_plugin": plugins[storage]} if plugins else {}
    writer = rosbag2.Writer(path, **options)
    return _written(path, writer, topics, store, store.serialize_cdr)


def _written(path: Path, writer, topics, store, serialize) -> Path:
    """Messages are 1 ms apart, or recorded a while behind the time [s] that comes with each."""
    with writer:
        for topic, message_type, messages in topics:
            connection = writer.add_connection(topic, message_type, typestore=store)
            for count, message in enumerate(messages(store.types)):
                received = 10**9 + count * 10**6
                if isinstance(message, tuple):
                    time, message = message
                    received = START_NS + round(1e9 * time) + LATENCY_NS
                writer.write(connection, received, serialize(message, message_type))
    return path


def rosbag(folder: Path, data: Recording, storage: str = "SQLITE3") -> Path:
    topics = [("/joint_states", STATE, shuffled_states(data))]
    return write_bag(folder / "bag", topics, storage)


def single_mcap(folder: Path, data: Recording) -> Path:
    """The .mcap file alone, without its folder's metadata."""
    (file,) = rosbag(folder, data, "MCAP").glob("*.mcap")
    return file.rename(folder / "alone.mcap")


@later_of_types
def dynamic_states(types, data: Recording, names, orders):
    """Yield (time, DynamicJointState), with an order of ``INTERFACES`` for each joint."""
    value = types["control_msgs/msg/InterfaceValue"]
    rows = np.stack((data.q, data.qd, data.tau), axis=2)
    for time, joints in zip(data.time, rows):
        values = []
        for order, numbers in zip(orders, joints):
            values.append(value([INTERFACES[k] for k in order], numbers[order]))
        yield time, types[DYNAMIC](header(types, time), list(names), values)


def dynamic_joint_state(folder: Path, data: Recording) -> Path:
    """DynamicJointState with the interfaces in another order for every joint."""
    messages = dynamic_states(data, JOINTS, ORDERS)
    return write_bag(folder / "bag", [("/states", DYNAMIC, messages)])


@later_of_types
def franka_states(types, data: Recording):
    """Yield FrankaRobotState messages, in which joints have the opposite of what is measured."""
    names = [f"fr3_{joint}" for joint in JOINTS]
    for time, q, qd, tau in zip(data.time, data.q, data.qd, data.tau):
        measured = joint_state(types, time, names, q, qd, tau)
        desired = joint_state(types, time, JOINTS, -q, -qd, -tau)
        yield types[FRANKA](header(types, time), measured, desired, time)


def franka_state(folder: Path, data: Recording) -> Path:
    """FrankaRobotState in an MCAP, with its definition in the file."""
    name = "/franka_robot_state_broadcaster/robot_state"
    return write_bag(folder / "bag", [(name, FRANKA, franka_states(data))], "MCAP")


def write_data_set(
    root: Path,
    version: str,
    fps: int,
    features: dict[str, tuple[Sequence[str], Any]],
    episodes: int = 2,
    dtype: Any = np.float32,
) -> Path:
    """Write a LeRobot data set, in single precision as LeRobot does.

    Args:
        version: "v2.1", a file per episode, or "v3.0", one file.
        features: name of a feature to the names of its numbers and their array (N, k), of which
            each episode has an equal part.
    """
    pa = pytest.importorskip("pyarrow")
    pq = pytest.importorskip("pyarrow.parquet")
    chunk = root / "data" / "chunk-000"
    chunk.mkdir(parents=True)
    (root / "meta").mkdir()
    described = {}
    for name, (titles, _) in features.items():
        shape = [len(titles)]
        described[name] = {"dtype": "float32", "shape": shape, "names": list(titles)}
    info = {"codebase_version": version, "fps": fps, "features": described}
    (root / "meta" / "info.json").write_text(json.dumps(info))
    length = len(next(iter(features.values()))[1]) // episodes
    frame = np.arange(episodes * length)
    cell_type = pa.list_(pa.from_numpy_dtype(dtype))
    columns = {}
    for name, (_, array) in features.items():
        values = np.asarray(array[: len(frame)], dtype)
        columns[name] = pa.array(values.tolist(), cell_type)
    columns["timestamp"] = (frame % length / fps).astype(dtype)
    columns["frame_index"] = frame % length
    columns["episode_index"] = frame // length
    table = pa.table(columns)
    if version.startswith("v2"):
        for episode in range(episodes):
            rows = table.slice(episode * length, length)
            pq.write_table(rows, chunk / f"episode_{episode:06d}.parquet")
    else:
        pq.write_table(table, chunk / "file-000.parquet")
    return root


def lerobot_state(data: Recording, episodes: int = 1) -> tuple[Sequence[str], Any]:
    """Return names and numbers of the state of a motion, in degrees; episodes repeat it."""
    names = [f"{joint}.{end}" for joint in JOINTS for end in ("pos", "vel", "torque")]
    values = (np.degrees(data.q), np.degrees(data.qd), data.tau)
    state = np.stack(values, axis=2).reshape(len(data), -1)
    return names, np.tile(state, (episodes, 1))


def lerobot(
    folder: Path,
    data: Recording,
    version: str = "v2.1",
    episodes: int = 1,
    **features: tuple[Sequence[str], Any],
) -> Path:
    """A data set of a motion, which has 200 Hz, with other features beside its state."""
    features = {"observation.state": lerobot_state(data, episodes), **features}
    return write_data_set(folder / "set", version, 200, features, episodes, np.float64)


def arrays_of(data: Recording) -> dict[str, Any]:
    """Return the arrays of a motion by their titles."""
    return {name: getattr(data, name) for name in ("time", "q", "qd", "tau")}


def npz(folder: Path, data: Recording) -> Path:
    np.savez(folder / "log.npz", **arrays_of(data), note="text is no column")
    return folder / "log.npz"


def hdf5(folder: Path, data: Recording) -> Path:
    with pytest.importorskip("h5py").File(folder / "log.hdf5", "w") as file:
        file.update(arrays_of(data))
    return folder / "log.hdf5"


def matlab(folder: Path, data: Recording) -> Path:
    savemat(folder / "log.mat", arrays_of(data))
    return folder / "log.mat"


def arrow(data: Recording):
    """A table of Arrow: time in dates, positions as lists, a column per torque, and text."""
    pa = pytest.importorskip("pyarrow")
    nanoseconds = np.round(1e9 * data.time).astype(int)
    columns = {
        "time": np.datetime64("2024-05-01T12:00:00", "ns") + nanoseconds,
        "q": data.q.tolist(),
        "qd": data.qd.tolist(),
        "note": ["text"] * len(data),
    }
    for k, tau in enumerate(data.tau.T):
        columns[f"tau{k}"] = tau
    return pa.table(columns)


def parquet(folder: Path, data: Recording) -> Path:
    table = arrow(data)
    path = folder / "log.parquet"
    pytest.importorskip("pyarrow.parquet").write_table(table, path, row_group_size=7)
    return path


def libfranka(folder: Path, data: Recording) -> Path:
    """The columns of logToCSV."""
    groups = "state.q state.q_d state.dq state.dq_d state.tau_J "
    groups += "state.tau_ext_hat_filtered cmd.tau_J_d"
    titles = [f"{group}[{k}]" for group in groups.split() for k in range(3)]
    zero = np.zeros_like(data.q)
    values = (data.q, zero, data.qd, zero, data.tau, zero, zero)
    rows = np.column_stack((1e3 * data.time, np.ones(len(data)), *values))
    return write(folder / "franka.csv", rows, ["time", "success_rate", *titles])


def rtde(
    folder: Path, data: Recording, torque: str = "actual_current_as_torque"
) -> Path:
    """What record.py of the RTDE client writes: blanks between cells, a column per element."""
    groups = ("actual_q", "actual_qd", torque, "target_moment")
    joints = range(data.q.shape[1])
    titles = ["timestamp", *(f"{g}_{k}" for g in groups for k in joints)]
    rows = np.column_stack((data.time, data.q, data.qd, data.tau, -data.tau))
    return write(folder / "rtde.csv", rows, titles, " ")


def plotjuggler(folder: Path, data: Recording) -> Path:
    """One column per series; rows of another topic leave the arm's cells empty."""
    titles = ["__time", "/battery/voltage"]
    titles += [f"/joint_states/{j}/{word}" for word in INTERFACES for j in JOINTS]
    rows: list[list[object]] = []
    for time, *values in zip(data.time, data.q, data.qd, data.tau):
        rows.append([float(time), "", *np.concatenate(values).tolist()])
        rows.append([float(time) + 0.002, 24.1, *[""] * 9])
    return write(folder / "plot.csv", rows, titles)


def _write_lines(path: Path, lines: Iterable[str]) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def lists_in_cells(folder: Path, data: Recording) -> Path:
    """A list in quotes in each cell, beside a word, as SAGE and pandas write it."""
    rows = zip(data.time.tolist(), data.q.tolist(), data.qd.tolist(), data.tau.tolist())
    lines = ["type,timestamp,positions,velocities,torques"]
    lines += [f'STATE_MOTOR,{time},"{q}","{qd}","{tau}"' for time, q, qd, tau in rows]
    return _write_lines(folder / "state_motor.csv", lines)


def nested_states(data: Recording) -> list[dict[str, Any]]:
    """Return the samples of a motion as nested objects."""
    states = []
    for time, q, qd, tau in zip(data.time, data.q, data.qd, data.tau):
        state = {"q": q.tolist(), "dq": qd.tolist(), "tau": tau.tolist(), "mode": "run"}
        states.append({"t": float(time), "state": state})
    return states


def json_lines(folder: Path, data: Recording) -> Path:
    return _write_lines(folder / "log.jsonl", map(json.dumps, nested_states(data)))


def json_states(folder: Path, data: Recording) -> Path:
    """An object with a list of states."""
    content = {"robot": "arm", "states": nested_states(data)}
    return _write_lines(folder / "states.json", [json.dumps(content, indent=1)])


def _other_order() -> list[int]:
    """Return the joints from the end of the alphabet on."""
    return np.argsort(JOINTS)[::-1].tolist()


def json_arrays(folder: Path, data: Recording) -> Path:
    """An object of arrays, joints in the order of their names' list."""
    order = _other_order()
    joints = {"joint_names": [JOINTS[k] for k in order]}
    time, *quantities = arrays_of(data).items()
    joints.update((name, values[:, order].tolist()) for name, values in quantities)
    content = {time[0]: time[1].tolist(), "data": joints}
    return _write_lines(folder / "arrays.json", [json.dumps(content)])


def signal_rows(folder: Path, data: Recording) -> Path:
    """A row per signal and instant, one signal after the other."""
    rows: list[list[object]] = []
    for name, values in zip(INTERFACES, (data.q, data.qd, data.tau)):
        for joint, column in zip(JOINTS, values.T.tolist()):
            signal = f"/joint_states/{joint}/{name}"
            rows += [[t, signal, v] for t, v in zip(data.time.tolist(), column)]
    return write(folder / "signals.csv", rows, ["timestamp", "signal", "value"])


def joint_rows(folder: Path, data: Recording) -> Path:
    """A row per joint and instant, joints in an order of their own."""
    rows: list[list[object]] = []
    for time, *values in zip(data.time.tolist(), data.q, data.qd, data.tau):
        for k in _other_order():
            rows.append([time, JOINTS[k], *(float(v[k]) for v in values)])
    titles = ["time", "joint", "position", "velocity", "torque"]
    return write(folder / "joints.csv", rows, titles)


def echo(folder: Path, data: Recording, csv: bool = False) -> Path:
    """What ros2 topic echo prints of a JointState, behind a warning."""
    order = _other_order()
    names = [JOINTS[k] for k in order]
    documents = ["WARNING: topic [/joint_states] does not appear to be published yet"]
    lines = []
    for time, *values in zip(data.time, data.q, data.qd, data.tau):
        seconds, nanoseconds = divmod(START_NS + round(1e9 * time), 10**9)
        lists = [v[order].tolist() for v in values]
        cells = [seconds, nanoseconds, "base", *names, *chain(*lists)]
        lines.append(",".join(map(str, cells)))
        text = f"header:\n  stamp:\n    sec: {seconds}\n    nanosec: {nanoseconds}\n"
        text += "  frame_id: base\n"
        for key, items in zip(("name", *INTERFACES), (names, *lists)):
            text += f"{key}:\n" + "".join(f"- {item}\n" for item in items)
        documents.append(f"{text}---")
    if csv:
        return _write_lines(folder / "echo.csv", lines)
    return _write_lines(folder / "echo.txt", documents)


def excel(folder: Path, data: Recording) -> Path:
    """A workbook whose first sheet is a remark."""
    book = pytest.importorskip("openpyxl").Workbook()
    book.active.append(["made by", "hand"])
    sheet = book.create_sheet("run 1")
    joints = range(1, 4)
    sheet.append(
        ["time", *(f"{name}{k}" for name in ("q", "qd", "tau") for k in joints)]
    )
    for row in np.column_stack((data.time, data.q, data.qd, data.tau)).tolist():
        sheet.append(row)
    book.save(folder / "log.xlsx")
    return folder / "log.xlsx"


def write_json_mcap(path: Path, messages: Iterable[tuple[str, int, Any]]) -> Path:
    """An MCAP file of messages of JSON: their topic, time [ns] and object."""
    writer_class = pytest.importorskip("mcap.writer").Writer
    channels: dict[str, int] = {}
    with path.open("wb") as stream:
        writer = writer_class(stream)
        writer.start()
        schema = writer.register_schema("foxglove.JointStates", "jsonschema", b"{}")
        for topic, stamp, content in messages:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "json", schema)
            text = json.dumps(content).encode()
            writer.add_message(channels[topic], stamp, text, stamp)
        writer.finish()
    return path


def write_mixed_mcap(path: Path, data: Recording) -> Path:
    """An MCAP file of a JointState of ROS and of a message of JSON."""
    writer_class = pytest.importorskip("mcap.writer").Writer
    store = typestore()
    definition, _ = store.generate_msgdef(STATE, ros_version=2)
    with path.open("wb") as stream:
        writer = writer_class(stream)
        writer.start(profile="ros2")
        ros_schema = writer.register_schema(STATE, "ros2msg", definition.encode())
        json_schema = writer.register_schema("battery", "jsonschema", b"{}")
        states = writer.register_channel("/joint_states", "cdr", ros_schema)
        battery = writer.register_channel("/battery", "json", json_schema)
        values = (data.q[0], data.qd[0], data.tau[0])
        message = joint_state(store.types, data.time[0], JOINTS, *values)
        content = bytes(store.serialize_cdr(message, STATE))
        writer.add_message(states, START_NS, content, START_NS)
        writer.add_message(battery, START_NS, b'{"volt": 24.0}', START_NS)
        writer.finish()
    return path


def mcap_of_json(folder: Path, data: Recording) -> Path:
    """An MCAP file of Foxglove's JointStates in JSON, and another topic."""
    messages = []
    for time, *values in zip(data.time, data.q, data.qd, data.tau):
        stamp = START_NS + round(1e9 * time)
        seconds, nanoseconds = divmod(stamp, 10**9)
        joints = []
        for name, *numbers in zip(JOINTS, *(v.tolist() for v in values)):
            joints.append({"name": name, **dict(zip(INTERFACES, numbers))})
        timed = {"timestamp": {"sec": seconds, "nsec": nanoseconds}}
        messages.append(("/joints", stamp, {**timed, "joints": joints}))
        messages.append(("/battery", stamp, {**timed, "volt": 24.0}))
    return write_json_mcap(folder / "json.mcap", messages)


def mcap_of_protobuf(folder: Path, data: Recording) -> Path:
    """An MCAP file of a message of protobuf with lists, and the time of recording alone."""
    writer_class = pytest.importorskip("mcap_protobuf.writer").Writer
    descriptor_pb2 = pytest.importorskip("google.protobuf.descriptor_pb2")
    from google.protobuf import descriptor_pool, message_factory

    file = descriptor_pb2.FileDescriptorProto(name="arm.proto", syntax="proto3")
    message_type = file.message_type.add(name="ArmState")
    kind = descriptor_pb2.FieldDescriptorProto
    for number, name in enumerate(("q", "dq", "tau"), start=1):
        message_type.field.add(
            name=name, number=number, label=kind.LABEL_REPEATED, type=kind.TYPE_DOUBLE
        )
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    state = message_factory.GetMessageClass(pool.FindMessageTypeByName("ArmState"))
    path = folder / "protobuf.mcap"
    with path.open("wb") as stream, writer_class(stream) as writer:
        for time, *values in zip(data.time, data.q, data.qd, data.tau):
            numbers = dict(zip(("q", "dq", "tau"), values))
            stamp = START_NS + round(1e9 * time)
            writer.write_message("/arm", state(**numbers), stamp, stamp)
    return path


FORMS: dict[str, Callable[[Path, Recording], Path]] = {
    "ROS 2 db3": rosbag,
    "ROS 2 single mcap": single_mcap,
    "ROS 1 bag": partial(rosbag, storage="ROS1"),
    "ROS 2 DynamicJointState": dynamic_joint_state,
    "ROS 2 FrankaRobotState": franka_state,
    "LeRobot": lerobot,
    "Parquet": parquet,
    "npz": npz,
    "HDF5": hdf5,
    "MATLAB": matlab,
    "libfranka": libfranka,
    "RTDE": rtde,
    "PlotJuggler": plotjuggler,
    "lists in cells": lists_in_cells,
    "JSON lines": json_lines,
    "JSON states": json_states,
    "JSON arrays": json_arrays,
    "rows of signals": signal_rows,
    "rows of joints": joint_rows,
    "echo": echo,
    "echo CSV": partial(echo, csv=True),
    "Excel": excel,
    "MCAP of JSON": mcap_of_json,
    "MCAP of protobuf": mcap_of_protobuf,
}
