"""Logs whose rows are nested states, of which ``states`` makes a table: text, JSON, Excel, what
``ros2 topic echo`` prints, and MCAP files of JSON or protobuf.

A cell of text may hold a list, as pandas and SAGE write it; a row may be a message, as ``ros2 topic
echo`` prints it in CSV; and a row may hold one signal or one joint of an instant (long form). Text
with a number in each cell is read as it is (``text``), and an object of arrays by ``arrays``.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.errors import InputError, prefix_input_errors
from robot_sysid.logs import LogOptions
from robot_sysid.logs.arrays import arrays_table, fields
from robot_sysid.logs.declarations import ColumnChoices
from robot_sysid.logs.halves import Half, join_pair
from robot_sysid.logs.ros_bag import bag_table
from robot_sysid.logs.ros_messages import READERS
from robot_sysid.logs.states import named_rows, states_table
from robot_sysid.logs.table import LogTable, import_optional
from robot_sysid.logs.text import (
    Dialect,
    is_names,
    is_number,
    is_row,
    list_in_cell,
    parse_cell,
    plain_table,
    read_dialect,
)
from robot_sysid.logs.titles import UNITS, read_title
from robot_sysid.records import Array, Column
from robot_sysid.records.file_access import number_of_digits
from robot_sysid.records.servo_setting import ServoSetting
from robot_sysid.wording import option_name


def json_table(path: Path, *_: Any) -> LogTable:
    """Return JSON as a table: a state per line, a list of states, or an object of arrays."""
    text = path.read_text(encoding="utf-8-sig")
    try:
        content = json.loads(text, object_hook=_as_rows, parse_int=number_of_digits)
    except json.JSONDecodeError:
        second = next(islice(_json_values(text), 1, None), None)
        if not isinstance(second, (dict, list)):
            raise
        lines = _json_values(text)
        return states_table(path, "JSON, a state per line", lines, "state")
    lists = {n: v for n, v in fields(content) if isinstance(v, list)}
    if not any(lists.values()):
        raise InputError(f"{path} holds no list of states, and no arrays")
    states = max(lists.values(), key=_count_states)
    if isinstance(content, dict) and not _count_states(states):
        named = {name: _as_array(values) for name, values in lists.items()}
        return arrays_table(path, "JSON, an object of arrays", named)
    if isinstance(content, dict):
        names = {key: value for key, value in content.items() if is_names(value)}
        states = [{**names, **state} for state in states]
        for form in _SERVO_FORMS:
            if form.setting.keys() <= content.keys():
                return form.table(path, content, states)
    return states_table(path, "JSON, a list of states", states, "state")


@dataclass(frozen=True)
class _ServoForm:
    """A form of JSON with the states of a servo, beside what they were recorded with.

    Attributes:
        layout: see ``LogTable``.
        setting: key of the document to the field of ``ServoSetting`` that it states; a document
            that has all of them is of this form.
        further: further fields that hold for all such documents.
        switch: key of a state that says whether the servo was switched on.
        choices: units of the numbers.
    """

    layout: str
    setting: Mapping[str, str]
    further: Mapping[str, Any]
    switch: str
    choices: ColumnChoices

    def table(
        self, path: Path, content: Mapping[str, Any], states: Sequence[Any]
    ) -> LogTable:
        """Return the states in which the servo was on as a table; they show nothing of it else."""
        stated: dict[str, Any] = {}
        for key, field in self.setting.items():
            stated[field] = float(content[key])
        with prefix_input_errors(str(path)):
            setting = ServoSetting(**stated, **self.further)
        kept = [state for state in states if state.get(self.switch, True)]
        count = len(states) - len(kept)
        notes = [f"recorded with {setting}"]
        if count:
            notes.append(f"left out rows with {self.switch} false: {count}")
        for state in kept:
            state.pop(self.switch, None)
        table = states_table(path, self.layout, kept, "state", tuple(notes))
        return replace(table, choices=self.choices, setting=setting)


_SERVO_FORMS = (
    # Of Rhoban's BAM, which identifies servos with a pendulum: https://github.com/Rhoban/bam
    _ServoForm(
        "JSON of BAM, a list of states",
        {
            "kp": "register",
            "vin": "voltage",
            "mass": "load_mass",
            "length": "load_distance",
        },
        {"is_whole_link": True},
        "torque_enable",
        ColumnChoices(angle_unit="rad", time_unit="s"),
    ),
)


def _as_rows(content: dict[str, Any]) -> Any:
    """Return an object of rows by their numbers, as pandas writes a column, as a list."""
    return [*content.values()] if all(map(str.isdigit, content)) else content


def _json_values(text: str) -> Iterator[Any]:
    """Yield the values of JSON that follow each other in a text; None for a line that is none."""
    decoder = json.JSONDecoder(parse_int=number_of_digits)
    visible = re.compile(r"\S")
    position = 0
    while match := visible.search(text, position):
        try:
            value, position = decoder.raw_decode(text, match.start())
        except json.JSONDecodeError:
            value = None
            position = text.find("\n", match.start()) + 1 or len(text)
        yield value


def _count_states(values: Sequence[Any]) -> int:
    """Return the number of states in a list; 0 where it holds something else."""
    return len(values) if values and isinstance(values[0], dict) else 0


def _as_array(values: Sequence[Any]) -> Array | None:
    """Return a list of numbers, dates, texts or of such lists as an array; None for another one."""
    numbers_of = np.vectorize(lambda cell: parse_cell(str(cell)), otypes=[float])
    try:
        return numbers_of(np.array(values, object))
    except ValueError:
        return np.array(values) if is_names(values) else None


def echo_table(path: Path, *_: Any) -> LogTable:
    """Return the text that ``ros2 topic echo`` or ``rostopic echo`` prints of a JointState."""
    text = path.read_text(encoding="utf-8", errors="replace")
    messages = map(_echo_message, re.split(r"^---", text, flags=re.MULTILINE))
    return states_table(path, "ros2 topic echo", messages, "message")


def _echo_message(text: str) -> dict[str, Any]:
    """Return the lists and the time stamp in the text of a message."""
    message: dict[str, Any] = {}
    for key, block in re.findall(r"^(\w+):((?:\n- .*)+|\s*\[[^\]]*\])", text, re.M):
        items = re.findall(r"(?:^- *|[\[,]\s*)([^,\]\n]+)", block, re.M)
        message[key] = [item.strip("'\" ") for item in items]
    frame = re.search(r"\bframe_id: *['\"]?([^'\"\s]+)", text)
    if frame:
        message["frame_id"] = frame[1]
    stamp = re.search(r"\bsecs?: *(\d+)\s+n(?:ano)?secs?: *(\d+)", text)
    if stamp:
        seconds, nanoseconds = stamp.groups()
        message["header"] = {"stamp": {"sec": seconds, "nanosec": nanoseconds}}
    return message


def excel_table(path: Path, *_: Any) -> LogTable:
    """Return the sheet with most rows of an Excel file as a table."""
    openpyxl = import_optional("openpyxl", "xlsx")
    sheets = {}
    with path.open("rb") as stream:
        for sheet in openpyxl.load_workbook(stream, read_only=True, data_only=True):
            rows = sheet.iter_rows(values_only=True)
            sheets[sheet.title] = [row for row in rows if row.count(None) < len(row)]
    name = max(sheets, key=lambda title: len(sheets[title]))
    rows = sheets.pop(name)
    filled = ([cell for cell in row if cell is not None] for row in rows)
    first = next((k for k, cells in enumerate(filled) if is_row(cells)), 0)
    if not first:
        raise InputError(
            f"{path}: sheet {name!r} has no row of numbers below a row of titles; save the log's "
            "sheet as CSV"
        )
    titles = [title or f"#{k}" for k, title in enumerate(rows[first - 1], start=1)]
    states = named_rows(path, titles, rows[first:])
    others = ", ".join(title for title, rows in sheets.items() if rows)
    notes = (f"sheet {name!r} is read, not {others}",) if others else ()
    return states_table(path, f"Excel, sheet {name}", states, notes=notes)


# Title of when a message was recorded [ns].
_RECEIVED = "received"
# Encodings of an MCAP file's messages, as its channels and schemas state them, that are not ROS's.
_ENCODING = re.compile(rb"\x08\0\0\0protobuf|\x04\0\0\0json")


def mcap_table(path: Path, joint_names: Sequence[str], options: LogOptions) -> LogTable:
    """Return an MCAP file as a table: a ROS bag, or the topic with positions and torques in
    messages of JSON or protobuf.

    InputError where no topic or several topics have positions and torques.
    """
    if not _ENCODING.search(_summary(path)):
        return bag_table(path, joint_names, options)
    states: dict[str, list[Any]] = defaultdict(list)
    for topic, state in _mcap_states(path):
        states[topic].append(state)
    tables = {}
    for topic, its_states in states.items():
        # A topic of texts holds no numbers.
        with contextlib.suppress(InputError):
            table = states_table(path, f"MCAP, topic {topic}", its_states, "message")
            tables[topic] = _with_time(table)
    quantities = {
        topic: {read_title(t).quantity_beside_name for t in table.titles}
        for topic, table in tables.items()
    }
    both = {"position", "torque"}
    fitting = [topic for topic, named in quantities.items() if named >= both]
    halves = {
        key: [topic for topic, named in quantities.items() if named & both == {key}]
        for key in both
    }
    chosen = options.topic
    measured = [t for t in halves["torque"] if not read_title(t).is_commanded]
    halves["torque"] = measured if chosen is None else halves["torque"]
    if chosen is not None:
        fitting = [topic for topic in fitting if topic == chosen]
        halves = {k: [chosen] if chosen in each else each for k, each in halves.items()}
        is_half = any(chosen in each for each in halves.values())
        halves = halves if is_half else {key: [] for key in both}
    if not fitting and all(len(each) == 1 for each in halves.values()):
        position, torque = (tables[halves[key][0]] for key in ("position", "torque"))
        return _joined_topics(position, torque)
    joint_topics = ", ".join(_ros_topics(path))
    if not fitting and joint_topics:
        raise InputError(
            f"{path} has joint states of ROS ({joint_topics}) beside messages of JSON or protobuf, "
            "and its reader takes one kind; write the topic into a bag of its own"
        )
    if len(fitting) != 1:
        listed = ", ".join(fitting or tables) or "none"
        fault = "several topics have" if fitting else "no topic has"
        offered = fitting
        if not fitting and all(halves.values()):
            # One of several topics of torques, or of positions, belongs to the other half.
            offered = max(halves.values(), key=len)
        raise InputError(
            f"{path}: {fault} positions and torques: {listed}; choose with {option_name('topic')}",
            options=[("--topic", topic) for topic in offered],
        )
    return tables[fitting[0]]


def _with_time(table: LogTable) -> LogTable:
    """Return messages with the time at which they were received where they have no stamp."""
    if any(read_title(title).quantity == "time" for title in table.titles):
        return table
    titles = ["time [ns]" if t == _RECEIVED else t for t in table.titles]
    return replace(table, titles=tuple(titles))


def _joined_topics(position: LogTable, torque: LogTable) -> LogTable:
    """Return the messages of a topic of positions with the torques of another, joined by time."""
    halves = []
    for table, named in ((position, {"position", "velocity"}), (torque, {"torque"})):
        titles = [read_title(title) for title in table.titles]
        times = [k for k, title in enumerate(titles) if title.quantity == "time"]
        indices = [k for k, t in enumerate(titles) if t.quantity_beside_name in named]
        factor = UNITS["time"].get(titles[times[0]].unit, 1.0)
        half = replace(table, path=table.path / table.layout.rpartition("/")[2])
        time = [Column(times[0], table.titles[times[0]], factor)]
        halves.append((half, time, indices))
    (q_table, q_time, q), (tau_table, tau_time, tau) = halves
    joined = join_pair(Half(q_table, q_time, q, []), Half(tau_table, tau_time, [], tau))
    return replace(joined, path=position.path)


def _summary(path: Path) -> bytes:
    """Return the end of an MCAP file, which lists its channels; b"" where it was cut off."""
    # Length of the footer, from which the place of the summary is 9 bytes on.
    length = 37
    with path.open("rb") as stream:
        size = stream.seek(0, os.SEEK_END)
        stream.seek(max(0, size - length))
        footer = stream.read()
        start = int.from_bytes(footer[9:17], "little")
        if not footer.endswith(b"\x89MCAP0\r\n") or start > size:
            return b""
        stream.seek(start)
        return stream.read()


def _ros_topics(path: Path) -> list[str]:
    """Return the topics of an MCAP file with joints in messages of ROS."""
    reader = import_optional("mcap.reader", "mcap")
    with path.open("rb") as stream:
        summary = reader.make_reader(stream).get_summary()
    if summary is None:
        return []
    schemas = {key: schema.name for key, schema in summary.schemas.items()}
    channels = summary.channels.values()
    return [c.topic for c in channels if schemas.get(c.schema_id) in READERS]


def _mcap_states(path: Path) -> Iterator[tuple[str, Any]]:
    """Yield (topic, state with _RECEIVED) of the messages of JSON and protobuf in an MCAP file."""
    reader = import_optional("mcap.reader", "mcap")
    protobuf = import_optional("mcap_protobuf.decoder", "mcap").DecoderFactory()
    # Encoding to the function of schema and bytes that returns the state in a message.
    decoders: Mapping[str, Callable[[Any, bytes], Any]] = {
        "json": lambda schema, data: json.loads(data, parse_int=number_of_digits),
        "protobuf": lambda s, data: _plain(protobuf.decoder_for("protobuf", s)(data)),
    }
    with path.open("rb") as stream:
        for schema, channel, message in reader.make_reader(stream).iter_messages():
            decode = decoders.get(channel.message_encoding)
            if decode:
                state = decode(schema, message.data)
                yield channel.topic, {_RECEIVED: message.log_time, **state}


def _plain(value: Any) -> Any:
    """Return a message of protobuf as mappings, lists, texts and numbers."""
    if hasattr(value, "DESCRIPTOR"):
        names = [field.name for field in value.DESCRIPTOR.fields]
        return {name: _plain(getattr(value, name)) for name in names}
    if isinstance(value, (str, int, float)):
        return value
    # Bytes are no numbers.
    return [] if isinstance(value, bytes) else [*map(_plain, value)]


IN_TURN = 0.9
"""Share of times of rows of signals that are there once, above which signals were read in turn."""
MOST_REPEATED = 0.05
"""Share of rows that may repeat the time and name of another one: a writer may stutter."""


def text_table(path: Path, joint_names: Sequence[str], *_: Any) -> LogTable:
    """Return a text file as a table, for an arm with these joints (n,)."""
    return dialect_table(read_dialect(path), joint_names)


def dialect_table(dialect: Dialect, joint_names: Sequence[str]) -> LogTable:
    """Return text as a table; lists in cells become columns, rows of signals are pivoted.

    ``joint_names``: (n,) of the arm.
    """
    path = dialect.path
    titles = dialect.titles
    cells = map(list_in_cell, dialect.first_row)
    # A list of names alone is read with the numbers of the titles.
    if any(isinstance(cell, list) and not is_names(cell) for cell in cells):
        states = named_rows(path, titles, dialect.rows())
        return states_table(path, "lists of numbers in cells", states)
    if titles[0] == "#1" and _echo_state(dialect.first_row):
        messages = map(_echo_state, dialect.rows())
        return states_table(path, "ros2 topic echo in CSV", messages, "message")
    if titles[0] == "#1" and read_title(dialect.first_row[0]).quantity == "time":
        return _table_of_series(dialect)
    quantities = [read_title(title).quantity_beside_name for title in titles]
    if quantities.count("position") < len(joint_names):
        return _long_table(dialect) or plain_table(dialect)
    return plain_table(dialect)


def _echo_state(cells: Sequence[str]) -> Mapping[str, Any]:
    """Return the JointState in a line of ``ros2 topic echo`` in CSV; {} for another line.

    The line has seconds, nanoseconds, frame, the joints' names, and three numbers for each.
    """
    is_stamped = re.fullmatch(r"\d+,\d+", ",".join(cells[:2]))
    if not is_stamped or len(cells) < 7 or len(cells) % 4 != 3:
        return {}
    lists = np.reshape(cells[3:], (4, -1)).tolist()
    stamp = {"sec": cells[0], "nanosec": cells[1]}
    message = dict(zip(("name", "position", "velocity", "effort"), lists))
    header = {"stamp": stamp, "frame_id": cells[2]} if cells[2] else {"stamp": stamp}
    return {"header": header, **message}


def _table_of_series(dialect: Dialect) -> LogTable:
    """Return a text file with a row per signal, its name in front, as a table.

    InputError where a row is no name with numbers, or two have one name.
    """
    series: dict[str, Array] = {}
    for name, *cells in dialect.rows():
        cells = cells[:-1] if cells and not cells[-1] else cells
        if name in series or not all(map(is_number, cells)):
            raise InputError(
                f"{dialect.path} has a row per signal, of which {name!r} is there twice or holds "
                "something else than numbers; write a column per signal, titles above them"
            )
        series[name] = np.array([*map(parse_cell, cells)])
    layout = f"a row per signal, {len(series)} signals"
    return arrays_table(dialect.path, layout, series)


# Title of a column that names the signal or the joint of its row.
_NAMING = re.compile(
    r"(joint|motor|axis|actuator|dof|signal|topic|series|channel|variable|quantity|field|key|name|"
    r"label|metric|measurement)s?[ _-]*(name|id|index|number|no)?",
    re.IGNORECASE,
)
# Title of a column of numbers that the row's name says all about.
_VALUE = re.compile(r"values?|data|number", re.IGNORECASE)


def _long_table(dialect: Dialect) -> LogTable | None:
    """Return a table that has a row per signal, or per joint, and instant with a row per instant.

    Rows of one instant have one time; or each has its own, and signals follow each other in turn.

    Returns:
        The table, or None where the file has another form.

    Raises:
        InputError: signals have several values at one time.
    """
    titles = dialect.titles
    columns = range(len(titles))
    naming = [k for k in columns if _NAMING.fullmatch(titles[k])]
    times = [k for k in columns if read_title(titles[k]).quantity == "time"]
    measured = [k for k in columns if k not in (*naming, *times)]
    if not naming or len(times) != 1 or not measured:
        return None
    (time_column,) = times
    time_title = titles[time_column]
    # Name and cells of each row, once; a dictionary keeps their order.
    read_rows = [
        ("/".join(cells[k] for k in naming), tuple(cells))
        for cells in dialect.rows()
        if len(cells) == len(titles) and is_number(cells[time_column])
    ]
    rows = [*dict.fromkeys(read_rows)]
    copies = len(read_rows) - len(rows)
    counts = Counter(name for name, _ in rows)
    instants = {cells[time_column] for _, cells in rows}
    in_turn = len(instants) > IN_TURN * len(rows)
    if in_turn and (len(counts) < 2 or max(counts.values()) > min(counts.values()) + 1):
        return None
    is_value = len(measured) == 1 and _VALUE.fullmatch(titles[measured[0]])
    states: dict[Any, dict[str, str]] = {}
    read: Counter[str] = Counter()
    repeated = 0
    for name, cells in rows:
        time = cells[time_column]
        state = states.setdefault(read[name] if in_turn else time, {time_title: time})
        read[name] += 1
        row = {name if is_value else f"{name}/{titles[k]}": cells[k] for k in measured}
        repeated += row.keys() <= state.keys()
        state.update(row)
        if in_turn:
            state[f"{name}/time"] = time
    if repeated > MOST_REPEATED * len(rows):
        raise InputError(
            f"{dialect.path} has a row per signal, and {repeated} rows repeat the time and name of "
            "another one; give each recording a file of its own"
        )
    layout = f"a row per signal and instant, {len(counts)} signals"
    ordered = sorted(states.values(), key=lambda state: parse_cell(state[time_title]))
    notes = (f"left out rows that are written twice: {copies}",) if copies else ()
    return states_table(dialect.path, layout, ordered, notes=notes)
