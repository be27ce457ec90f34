"""The map from a log's columns to quantities of joints, by column titles or by a columns file.

A column belongs to a joint because its title carries the joint's name (``elbow_effort``), or else
by counting from 0 or 1 (``q1 .. q6``, ``j0_pos ..``). ``ColumnMap.describe`` states every choice in
one line; where two columns could be one quantity, an error lists both.

The file of ``--columns`` declares columns that titles do not determine, as ``key = value``::

    # lines starting with # are comments
    time = Zeit
    units = deg, ms
    position = A1, A2, A3          one title per chain joint, base to terminal
    torque.joint1 = M1
    torque.joint2 = -M2            a minus flips the sign
    torque.joint3 = 0.95 * I3      a number scales
    torque.joint4 = none           the joint has no motor, or no sensor
    velocity = none                keep a quantity out

Keys: time, position, velocity, acceleration (accepted but not used), torque, joint_time (a time
stamp of each joint's own), command (commanded position of a servo), units (rad, deg; s, ms, us, ns)
and rate (samples per second, for a log without a time column). ``#3`` is the third column, for a
log without titles.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from robot_sysid.errors import InputError, error_text
from robot_sysid.logs.titles import (
    QUANTITIES,
    TIME_UNITS,
    UNITS,
    Title,
    ambiguity_error,
    match_joints,
    read_title,
)
from robot_sysid.records import Column, ColumnMap, RobotModel
from robot_sysid.records.messages import count_text
from robot_sysid.wording import option_name

# Keys of a columns file that may be followed by ".joint".
_JOINT_KEYS = (*QUANTITIES, "joint_time", "command")
# All keys of a columns file.
_KEYS = ("time", *_JOINT_KEYS, "acceleration", "units", "rate")
# A factor and a title: "0.95 * I3", or a title with a minus: "-M2".
_SCALED = re.compile(
    r"(?:([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,2})?)\s*\*|-)\s*(.+)", re.ASCII
)
# Units of angles that a user may declare.
_ANGLE_UNITS = ("rad", "deg")


@dataclass(frozen=True)
class ColumnChoices:
    """Declarations on a log's columns, by the user or by the form of a file; None for undeclared.

    Attributes:
        time: title of the time column.
        columns: quantity to joint name to title, "-title" or "0.5 * title"; "none" leaves a
            quantity out.
        angle_unit: "rad" or "deg".
        time_unit: "s", "ms", "us" or "ns".
        rate: samples per second of a log without a time column [Hz].
    """

    time: str | None = None
    columns: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    angle_unit: str | None = None
    time_unit: str | None = None
    rate: float | None = None

    def over(self, fallback: ColumnChoices) -> ColumnChoices:
        """Return these choices, with those of the fallback where these are undeclared."""
        stated = {name: value for name, value in vars(self).items() if value}
        stated["columns"] = {**fallback.columns, **self.columns}
        return replace(fallback, **stated)


def parse_units(text: str) -> ColumnChoices:
    """Return the units of a list with commas or blanks such as "deg,ms", or raise InputError."""
    units = re.findall(r"[^,\s]+", text)
    angle_unit = next((unit for unit in units if unit in _ANGLE_UNITS), None)
    time_unit = next((unit for unit in units if unit in TIME_UNITS), None)
    recognised = [unit for unit in (angle_unit, time_unit) if unit]
    if not units or len(units) > len(recognised):
        valid = f"one of {', '.join(_ANGLE_UNITS)} and one of {', '.join(TIME_UNITS)}"
        raise InputError(
            f"units {text!r} are not understood; give at most {valid}, as in 'deg,ms'"
        )
    return ColumnChoices(angle_unit=angle_unit, time_unit=time_unit)


def read_columns_file(path: Path, joint_names: Sequence[str]) -> ColumnChoices:
    """Return the declarations in a columns file, for a chain with these joints (n,).

    InputError where it cannot be read, or a key, joint, unit or number in it is unknown.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        fault = error_text(error)
        raise InputError(f"cannot read the columns file {path}: {fault}") from error
    values = {}
    columns: dict[str, dict[str, str]] = {}
    # Not splitlines: titles may hold other line ends.
    for number, line in enumerate(text.split("\n"), start=1):
        # "#" begins a comment at the start of a line or behind a blank, unless it is column "#3".
        content = re.sub(r"(^|\s)#(?!\d).*", "", line).strip()
        if not content:
            continue
        key, equals, value = map(str.strip, content.partition("="))
        if not equals or not value or key in values:
            raise InputError(
                f"{path} line {number}: expected one 'key = value' per key: {line!r}"
            )
        quantity, _, joint = key.partition(".")
        if quantity not in _KEYS:
            raise InputError(
                f"{path}: unknown key {key!r}; valid keys: {', '.join(_KEYS)}"
            )
        values[key] = value
        if quantity in _JOINT_KEYS:
            titles = _titles_by_joint(path, quantity, joint, value, joint_names)
            columns.setdefault(quantity, {}).update(titles)
    units = parse_units(values["units"]) if "units" in values else ColumnChoices()
    rate = None
    if "rate" in values:
        rate = 0.0
        with contextlib.suppress(ValueError):
            rate = float(values["rate"])
        if not 0.0 < rate < math.inf:
            raise InputError(
                f"{path}: rate must be a positive number of samples per second"
            )
    return replace(units, time=values.get("time"), columns=columns, rate=rate)


def _titles_by_joint(
    path: Path, quantity: str, joint: str, value: str, joint_names: Sequence[str]
) -> dict[str, str]:
    """Return joint name to title, from the value of one line of a columns file.

    Args:
        path: of the file, for messages.
        quantity: the line's key before the dot.
        joint: the key behind the dot, a joint name; "" where the line is about all joints.
        value: the text behind "=".
        joint_names: (n,) of the chain, base to terminal.

    Raises:
        InputError: the joint is unknown, or there is not one title per joint.
    """
    if joint and joint not in joint_names:
        valid = f"the chain's joints are {', '.join(joint_names)}"
        raise InputError(
            f"{path}: {quantity}.{joint} names the unknown joint {joint!r}; {valid}"
        )
    if joint or value == "none":
        return dict.fromkeys([joint] if joint else joint_names, value)
    titles = [title.strip() for title in value.split(",")]
    if len(titles) != len(joint_names):
        joints = count_text(len(joint_names), "joint")
        listed = count_text(len(titles), "column")
        raise InputError(
            f"{path}: {quantity} lists {listed}, the chain has {joints}: {', '.join(joint_names)}"
        )
    return dict(zip(joint_names, titles))


def recognise_columns(
    titles: Sequence[str],
    robot: RobotModel,
    choices: ColumnChoices,
    first_row: Sequence[str],
    currents: bool,
    commanded: bool,
) -> ColumnMap:
    """Return the column of each quantity of each joint.

    Args:
        titles: header cells; "#1", "#2", ... where the file has no header.
        robot: the arm, whose joints the columns are for.
        choices: declarations, which outrank the titles.
        first_row: the first row of data (it may hold joint names, as ROS logs do).
        currents: whether columns of motor currents are read in place of torques.
        commanded: whether columns of commanded positions are read in place of torques.

    Raises:
        InputError: a quantity is missing, has two candidates, or contradicts the declared units.
    """
    read_titles = [read_title(text, robot.joint_names) for text in titles]
    driven = "command" if commanded else "torque"
    quantities = [title.quantity_beside_name for title in read_titles]
    if currents and quantities.count("current") >= robot.n_joints:
        driven = "current"
    return _ColumnFinder(read_titles, robot, choices, driven).find_all(first_row)


@dataclass(frozen=True)
class _ColumnFinder:
    """Finds the columns of each quantity of one log.

    Attributes:
        titles: of the columns, cut into tokens, numbers and unit.
        robot: the arm, whose joints the columns are for.
        choices: declarations, which outrank the titles.
        driven: the quantity that is needed beside positions, "torque", "current" or "command".
    """

    titles: Sequence[Title]
    robot: RobotModel
    choices: ColumnChoices
    driven: str

    @property
    def _texts(self) -> list[str]:
        """The titles as the file has them."""
        return [title.text for title in self.titles]

    def _declared(self, quantity: str) -> Mapping[str, str]:
        """Return joint name to title, as declared; currents are declared as torques."""
        key = "torque" if quantity == "current" else quantity
        return self.choices.columns.get(key, {})

    def find_all(self, first_row: Sequence[str]) -> ColumnMap:
        """Return the map, or raise InputError for the first fault.

        ``first_row``: the cells of the first row as text, which may list joint names.
        """
        quantities = ("position", "velocity", "joint_time", self.driven)
        # Those that are declared need not be recognised, and cannot be ambiguous.
        n_joints = self.robot.n_joints
        open_quantities = [q for q in quantities if len(self._declared(q)) < n_joints]
        candidates, joint_note = match_joints(
            self.titles, self.robot, first_row, open_quantities
        )
        found = {q: self._find_joints(q, candidates.get(q, ())) for q in quantities}
        position = found["position"]
        torque = found[self.driven]
        if not position or not torque:
            raise InputError(f"position and {self.driven} cannot be left out")
        # A joint without torque has a column of numbers times zero.
        torque = tuple(
            column if column.factor else replace(column, index=position[0].index)
            for column in torque
        )
        has_unit = all(self.titles[column.index].unit for column in position)
        return ColumnMap(
            time=self._find_time(),
            rate=self.choices.rate,
            position=position,
            torque=torque,
            velocity=found["velocity"],
            joint_time=found["joint_time"],
            titles=self._texts,
            angle_declared=bool(self.choices.angle_unit) or has_unit,
            commanded=self.driven == "command",
            joint_note=joint_note,
        )

    def _find_joints(
        self, quantity: str, candidates: Sequence[Sequence[int]]
    ) -> tuple[Column, ...]:
        """Return one column per joint, or () where an optional quantity lacks a joint's.

        ``candidates``: indices of the columns that could be it, for each joint; or none.
        """
        declared = self._declared(quantity)
        if [*declared.values()] == ["none"] * self.robot.n_joints:
            return ()
        columns = []
        for joint, name in enumerate(self.robot.joint_names):
            indices = candidates[joint] if candidates else ()
            if quantity == self.driven and declared.get(name) == "none":
                columns.append(Column(0, "none", 0.0))
            elif name in declared:
                found = self._look_up(declared[name])
                columns.append(self._column(quantity, joint, *found))
            elif len(indices) > 1:
                raise ambiguity_error(quantity, name, self.titles, indices)
            elif indices:
                columns.append(self._column(quantity, joint, indices[0]))
        if len(columns) == self.robot.n_joints:
            return tuple(columns)
        if declared or quantity in ("position", self.driven):
            raise self._missing_error(quantity)
        return ()

    def _find_time(self) -> Column | None:
        """Return the time column, or None where a rate stands in for it."""
        if self.choices.time is not None:
            return self._column("time", 0, *self._look_up(self.choices.time))
        if self.choices.rate is not None:
            return None
        rows = []
        for index, title in enumerate(self.titles):
            is_of_joint = title.numbers or title.joint in self.robot.joint_names
            if title.quantity == "time" and not is_of_joint:
                rows.append(index)
        # ROS: the stamp in the message header is when it was sampled, the other one when received.
        stamped = [k for k in rows if "header" in self.titles[k].tokens]
        rows = stamped if len(stamped) == 1 else rows
        if len(rows) > 1:
            raise ambiguity_error("time", "", self.titles, rows)
        if not rows:
            raise InputError(
                "the log has no time column (evenly spaced rows may have rate = HZ in its place)"
            )
        return self._column("time", joint=0, index=rows[0])

    def _missing_error(self, quantity: str) -> InputError:
        """Return the error for a quantity of which a joint has no column, with a hint."""
        candidates = [t.text for t in self.titles if t.joint_quantity == quantity]
        listed = ", ".join(candidates) or "none"
        fault = (
            f"the log needs one {quantity} column for each joint of the chain "
            f"({', '.join(self.robot.joint_names)}): found {listed}"
        )
        currents = [t for t in self.titles if t.quantity_beside_name == "current"]
        if quantity == "torque" and len(currents) >= self.robot.n_joints:
            # With constants, the columns are complete: no columns file is needed.
            fault += (
                f"; {currents[0].text}, ... are motor currents: give "
                f"{option_name('torque_constants')}; where they "
                "are not known, begin with 1 N·m/A, and a weight of known mass shows them"
            )
            return InputError(fault, [("--torque-constants", "1")])
        commands = [t for t in self.titles if t.quantity_beside_name == "command"]
        if quantity == "torque" and len(commands) >= self.robot.n_joints:
            fault += (
                f"; {commands[0].text}, ... are commanded positions, as of position servos: "
                "identify --torque-from position-error takes the torque from the distance of "
                "positions to them; torques that it has are named with "
                f"{option_name('columns', 'FILE')}"
            )
            option = ("--torque-from", "position-error")
            return InputError(fault, [option], command="identify")
        if quantity == "command":
            fault += " (titles such as action, command, q_des or goal_position)"
        return InputError(f"{fault}. Columns: {', '.join(self._texts)}")

    def _look_up(self, text: str) -> tuple[int, float]:
        """Return (column index, factor) of "title", "-title" or "0.5 * title"."""
        texts = self._texts
        title = text
        factor = 1.0
        scaled = _SCALED.fullmatch(text)
        if text not in texts and scaled:
            title = scaled[2]
            factor = float(scaled[1] or -1.0)
        if re.fullmatch(r"#\d+", title) and title not in texts:
            # The columns by their numbers, from 1.
            texts = list(map("#{}".format, range(1, len(texts) + 1)))
        if texts.count(title) == 1:
            return texts.index(title), factor
        raise InputError(
            f"the log has no single column {title!r}; name one that there is once"
        )

    def _column(
        self, quantity: str, joint: int, index: int, factor: float = 1.0
    ) -> Column:
        """Return a column with its factor to SI, by its title's unit or else the declared one.

        Args:
            quantity: of the column, such as "position", or "time" of the row.
            joint: index in the chain of the joint that it belongs to; without effect for times.
            index: of the column.
            factor: by which the column's numbers are to be multiplied beside the unit.
        """
        title = self.titles[index]
        declared_unit = self.choices.angle_unit
        if quantity in ("time", "joint_time"):
            declared_unit = self.choices.time_unit
        elif self.robot.is_slide[joint]:
            declared_unit = None
        units = UNITS[quantity]
        declared = units.get(declared_unit or "")
        to_si = units.get(title.unit) if title.unit else declared
        if to_si is None and title.unit and abs(factor) == 1.0:
            fault = f"unit {title.unit!r} of column {title.text!r} is unknown for a {quantity}"
            raise InputError(
                f"{fault}; rename the column, or scale it with "
                f"{option_name('columns', 'FILE')}"
            )
        if declared is not None and to_si != declared:
            fault = f"column {title.text!r} names a unit that contradicts the declared units"
            raise InputError(f"{fault}; declare what the column holds, or rename it")
        return Column(index, title.text, factor * (to_si or 1.0), factor)
