"""The map from a log's columns to quantities of joints, by column titles or by a columns file.

A column belongs to a joint because its title carries the joint's name (``elbow_effort``), or else
by counting from 0 or 1 (``q1 .. q6``, ``j0_pos ..``). ``ColumnMap.describe`` states every choice in
one line; where two columns could be one quantity, an error lists both.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.declarations import JOINT_COLUMNS, ColumnChoices, split_factor
from robot_sysid.logs.matching import (
    Candidates,
    Confidence,
    Match,
    UnrecognisedError,
    ambiguity_error,
    fit_pattern,
    match_joints,
    surest_matches,
)
from robot_sysid.logs.table import LogTable
from robot_sysid.logs.titles import UNITS, Title, read_title
from robot_sysid.records import Array, Column, ColumnMap, RobotModel
from robot_sysid.records.messages import count_text
from robot_sysid.records.option_fields import joint_values, parse_numbers
from robot_sysid.wording import option_name

_Source = tuple[int, float]
"""A column (index) and the factor that was declared for it."""
_NO_COLUMN = Column(0, "none", 0.0)
"""What stands for the torque of a joint that has none."""
MOST_WITHOUT = 2
"""Joints without a torque up to which columns are looked through for them."""
NO_TORQUE = (
    "if {joints} has no motor or no sensor, or stood still, say that it has no torque: its "
    "equation is left out"
)
"""What is asked where a joint lacks a column of torque."""
# What people write in the place of "*": "motor_state[i].q", "avp[1..4]", "JOINT/position".
_JOINT_FORM = re.compile(
    r"(?<=\[)([ijkn]|\d+ *(\.\.|-|:) *\d+)(?=\])|\{(joint|name|i)\}|(?<![a-zA-Z])JOINT(?![a-zA-Z])",
    re.ASCII,
)
# Columns by their numbers: "#2..#7".
_RANGE = re.compile(r"#(\d{1,9}) *\.\. *#(\d{1,9})", re.ASCII)


@dataclass(frozen=True)
class ColumnFinder:
    """Finds the columns of each quantity of one log.

    Attributes:
        table: the log.
        robot: the arm, whose joints the columns are for.
        choices: declarations, which outrank the titles.
    """

    table: LogTable
    robot: RobotModel
    choices: ColumnChoices

    @cached_property
    def titles(self) -> Sequence[Title]:
        """The header cells, cut into tokens, numbers and unit."""
        names = self.robot.joint_names
        return [read_title(text, names) for text in self.table.titles]

    @cached_property
    def driven(self) -> str:
        """The quantity that is needed beside positions, "torque", "current" or "command"."""
        if self.choices.commanded:
            return "command"
        currents = [t for t in self.titles if t.likely_quantity == "current"]
        has_currents = len(currents) >= self.robot.n_joints
        return "current" if self.choices.currents and has_currents else "torque"

    @cached_property
    def has_servos(self) -> bool:
        """Whether titles name commands of as many joints as the arm has, and no torques; then the
        torque can be taken from the distance of positions to commands (``of_servos``).
        """
        named = [title.likely_quantity for title in self.titles]
        torques = ("torque", "current", "commanded", "computed")
        is_open = self.driven == "torque" and not self.choices.of("torque")
        n_joints = self.robot.n_joints
        return is_open and named.count("command") >= n_joints > sum(
            map(named.count, torques)
        )

    @property
    def of_servos(self) -> ColumnFinder:
        """The finder of the same columns that looks for commands in place of torques."""
        return replace(self, choices=replace(self.choices, commanded=True))

    def _texts_of(self, quantity: str) -> list[str]:
        """Return the titles that name a quantity beside other words."""
        return [t.text for t in self.titles if t.quantity_beside_name == quantity]

    def _declared_columns(
        self, quantity: str
    ) -> tuple[Mapping[str, _Source | None], str]:
        """Return joint name to the column that is declared for a quantity, None for one that has
        none; and a note on joints' names, "" for none.
        """
        joint_names = self.robot.joint_names
        # Currents are declared as torques.
        key = "torque" if quantity == "current" else quantity
        declared: dict[str, _Source | None] = {}
        note = ""
        for joint, value in self.choices.of(key).items():
            # Of single joints, only the torque may be missing.
            if value == "none" and (not joint or key in ("torque", self.driven)):
                declared.update(dict.fromkeys([joint] if joint else joint_names))
            elif key == "position" and joint in self._standing:
                declared[joint] = None
            elif joint:
                declared[joint] = self._look_up(value)
            else:
                names, sources, note = self._look_up_all(value)
                declared.update(
                    {k: v for k, v in zip(names, sources) if k not in declared}
                )
        return declared, note

    @property
    def _standing(self) -> Mapping[str, float]:
        """Joint to where it stands still, in the log's unit, of those that have no column."""
        texts = self.choices.of("position")
        places = self.choices.standing.items()
        return {j: place for j, place in places if texts[j] not in self.table.titles}

    @cached_property
    def _zeros(self) -> Array:
        """What the column of each joint's position reads at zero, (n,)."""
        zeros = np.zeros(self.robot.n_joints)
        for joint, value in self.choices.of("zero").items():
            at = [self.robot.joint_names.index(joint)] if joint else slice(None)
            zeros[at] = joint_values(parse_numbers(value), len(zeros[at]), "zero")
        return zeros

    @property
    def _quantities(self) -> Sequence[str]:
        """Those with a column per joint that are looked for.

        Beside the commands of servos, a torque is one more measurement.
        """
        beside = ("torque",) if self.choices.commanded else ()
        return "position", "velocity", "joint_time", self.driven, *beside

    @cached_property
    def _joint_matches(self) -> tuple[Candidates, str]:
        """The candidate columns of quantities, and a note on the joints' names."""
        declared = self.choices.of("position")
        has_names = "" not in declared and len(declared) < self.robot.n_joints
        return match_joints(
            self.titles,
            self.robot,
            self.table.first_row,
            self._quantities,
            has_names,
            self._absent,
        )

    @property
    def _absent(self) -> Mapping[str, Collection[str]]:
        """Quantity to the joints that need no column of it: they stand still, or have no torque."""
        torque = self.choices.of("torque")
        without = [joint for joint, value in torque.items() if value == "none"]
        standing = {*self._standing}
        absent: dict[str, Collection[str]] = {"position": standing}
        if any(without):
            absent["torque"] = absent["current"] = {*standing, *without}
        return absent

    def declaring(self, key: str, value: str) -> ColumnFinder:
        """Return a finder of the same columns with a declaration more."""
        entries = {**self.choices.entries, key: value}
        return replace(self, choices=replace(self.choices, entries=entries))

    @property
    def without_torque(self) -> tuple[ColumnFinder, tuple[str, ...]]:
        """A finder with a declaration more for each joint whose torque has no column, and these
        joints; () where columns do not tell which they are, or none is missing.
        """
        names = self.robot.joint_names
        if self.driven == "command" or self._is_complete(self.driven):
            return self, ()
        # With fewer columns than joints, those of the others are not tried one by one.
        least = max(1, len(names) - len(self.titles))
        for count in range(least, min(len(names) - 1, MOST_WITHOUT + 1)):
            found = []
            for joints in combinations(names, count):
                finder = self
                for joint in joints:
                    finder = finder.declaring(f"torque.{joint}", "none")
                if finder._is_complete(self.driven):
                    found.append((finder, joints))
            if found:
                return found[0] if len(found) == 1 else (self, ())
        return self, ()

    def recognise(self, quantity: str) -> tuple[Column, ...]:
        """Return the columns of a quantity, or of the time, as they are found; () for none."""
        try:
            if quantity == "time":
                return tuple(filter(None, [self.find_time()]))
            # Torques of a log that is read for its commands say nothing of its other columns.
            is_driven = quantity != "torque" or self.driven == "torque"
            is_sought = quantity in self._quantities and is_driven
            return self._find_joints(quantity) if is_sought else ()
        except InputError:
            return ()

    def matches(self, quantity: str, likely: Sequence[Match] = ()) -> list[Match]:
        """Return the columns that hold a quantity for certain, or else likely ones that could."""
        columns = self.recognise(quantity)
        indices = tuple(column.index for column in columns)
        certain = [Match(quantity, indices, "", Confidence.CERTAIN)] if indices else []
        return surest_matches([*certain, *likely], quantity, self.titles)

    def find_all(self) -> ColumnMap:
        """Return the map.

        Raises:
            UnrecognisedError: a quantity is missing, or has two candidates.
            InputError: it contradicts the declared units, or what is declared is not there.
        """
        # What is not needed has to be there, too.
        keys = [name.partition(".")[0] for name in self.choices.entries]
        pattern_notes = [
            self._declared_columns(k)[1] for k in keys if k in JOINT_COLUMNS
        ]
        _, joint_note = self._joint_matches
        notes = [joint_note, *dict.fromkeys(pattern_notes)]
        found: dict[str, tuple[Column, ...]] = {}
        for quantity in self._quantities:
            try:
                found[quantity] = self._find_joints(quantity)
            except InputError as error:
                if quantity in ("position", self.driven) or self.choices.of(quantity):
                    raise
                found[quantity] = ()
                notes.append(f"{quantity} is not used, and not needed: {error}")
        position = found["position"]
        torque = found[self.driven]
        if not position or not torque:
            raise InputError(f"position and {self.driven} cannot be left out")
        torque = _with_numbers(torque, position[0].index)
        motor_torque: tuple[Column, ...] = ()
        if self.choices.commanded:
            motor_torque = _with_numbers(found["torque"], position[0].index)
        has_unit = all(self.titles[column.index].unit for column in position)
        measured = (*torque, *motor_torque)
        kinds = {self.titles[column.index].torque_kind for column in measured}
        for kind in sorted({"commanded", "computed"} & kinds):
            notes.append(f"torques are {kind}, not measured, as they were declared")
        used = {column.index for column in (*position, *torque)}
        unused = self._unused_torques(used)
        if unused and self.driven == "torque":
            notes.append(f"torques that are not used: {', '.join(unused)}")
        return ColumnMap(
            time=self.find_time(),
            rate=self.choices.rate,
            position=position,
            torque=torque,
            velocity=found["velocity"],
            joint_time=found["joint_time"],
            titles=self.table.titles,
            angle_declared=bool(self.choices.angle_unit) or has_unit,
            length_declared=bool(self.choices.length_unit) or has_unit,
            commanded=self.choices.commanded,
            motor_torque=motor_torque,
            notes=tuple(filter(None, notes)),
        )

    def _with_standing(self, position: Sequence[Column]) -> tuple[Column, ...]:
        """Return the columns of positions (n,) with where joints without one stand still; () where
        there are none.

        What is declared is in the log's unit, that of the joints of the same kind.
        """
        sources = [column for column in position if column.factor]
        if not sources:
            return ()
        columns = []
        for joint, (name, column) in enumerate(zip(self.robot.joint_names, position)):
            if name in self._standing:
                is_slide = self.robot.is_slide
                units = {
                    other.factor / other.declared_factor
                    for kind, other in zip(is_slide, position)
                    if other.factor and kind == is_slide[joint]
                }
                if len(units) > 1:
                    raise InputError(
                        f"position.{name} is a number, and columns of positions are of several "
                        "units; give them one unit in their titles"
                    )
                place = self._standing[name] - self._zeros[joint]
                constant = float(place * (units.pop() if units else 1.0))
                text = self.choices.of("position")[name]
                column = Column(sources[0].index, text, 0.0, constant=constant)
            columns.append(column)
        return tuple(columns)

    def _find_joints(self, quantity: str) -> tuple[Column, ...]:
        """Return one column per joint, or () where an optional quantity lacks a joint's."""
        n_joints = self.robot.n_joints
        declared, _ = self._declared_columns(quantity)
        if [*declared.values()] == [None] * n_joints:
            return ()
        found = [self._find_joint(quantity, k, declared) for k in range(n_joints)]
        columns = tuple(column for column in found if column is not None)
        if len(columns) == n_joints:
            return self._with_standing(columns) if quantity == "position" else columns
        if declared and quantity == "torque" and self.choices.commanded:
            # Of servos, the torque of some joints may be recorded.
            return tuple(column or _NO_COLUMN for column in found)
        if declared or quantity in ("position", self.driven):
            raise self._missing_error(quantity)
        return ()

    def _is_complete(self, quantity: str) -> bool:
        """Return whether each joint has a column of a quantity, or is declared to have none."""
        try:
            declared, _ = self._declared_columns(quantity)
            joints = range(self.robot.n_joints)
            found = [self._find_joint(quantity, joint, declared) for joint in joints]
        except InputError:
            return False
        return None not in found and any(column.factor for column in found if column)

    def _find_joint(
        self, quantity: str, joint: int, declared: Mapping[str, _Source | None]
    ) -> Column | None:
        """Return the column of a joint (index), declared or certain; None where there is none."""
        name = self.robot.joint_names[joint]
        candidates, _ = self._joint_matches
        indices = candidates[quantity][joint]
        source = declared.get(name)
        if source:
            return self._column(quantity, joint, *source)
        if name in declared:
            return _NO_COLUMN
        if len(indices) > 1:
            raise ambiguity_error(quantity, name, self.titles, indices)
        return self._column(quantity, joint, indices[0]) if indices else None

    def find_time(self) -> Column | None:
        """Return the time column, or None where a rate stands in for it."""
        declared = self.choices.entries.get("time")
        if declared:
            return self._column("time", 0, *self._look_up(declared))
        if self.choices.rate is not None:
            return None
        joint_names = self.robot.joint_names
        rows = [
            index
            for index, title in enumerate(self.titles)
            if title.quantity == "time"
            and not (title.numbers or title.joint in joint_names)
        ]
        # ROS: the stamp in the message header is when it was sampled, the other one when received.
        stamped = [k for k in rows if "header" in self.titles[k].tokens]
        rows = stamped if len(stamped) == 1 else rows
        if len(rows) > 1:
            raise ambiguity_error("time", "", self.titles, rows)
        if not rows:
            raise UnrecognisedError(
                "the log has no time column (evenly spaced rows may have rate = HZ in its place)"
            )
        return self._column("time", joint=0, index=rows[0])

    def _missing_error(self, quantity: str) -> InputError:
        """Return the error for a quantity of which a joint has no column, with a hint."""
        n_joints = self.robot.n_joints
        candidates = [t.text for t in self.titles if t.joint_quantity == quantity]
        listed = ", ".join(candidates) or "none"
        fault = (
            f"the log needs one {quantity} column for each joint of the chain "
            f"({', '.join(self.robot.joint_names)}): found {listed}"
        )
        part = self._part_of_chain(quantity)
        if part:
            names = f"{part[0]} to {part[-1]}"
            fault += f"; if the arm is {names}, and the joints beside them stand still,"
            settings = []
            if part[0] != self.robot.joint_names[0]:
                settings.append(("first_joint", part[0]))
            if part[-1] != self.robot.joint_names[-1]:
                settings.append(("joint", part[-1]))
            listed = " and ".join(option_name(key, name) for key, name in settings)
            words = [(f"--{key.replace('_', '-')}", name) for key, name in settings]
            options = [sum(words, ())]
            fault += f" {listed} says so"
            finder, without = self.without_torque
            if quantity == self.driven and without:
                entries = finder.choices.entries.items()
                line = ", ".join(f"{key} = {value}" for key, value in entries)
                fault += f"; otherwise, {NO_TORQUE.format(joints=', '.join(without))}"
                # First what is right of joints that move, too.
                options.insert(0, ("--columns", line))
            return InputError(fault, options)
        if quantity == "command":
            fault += " (titles such as action, command, q_des or goal_position)"
        if quantity != "torque":
            return UnrecognisedError(fault)
        currents = self._texts_of("current")
        if len(currents) >= n_joints:
            # With constants, the columns are complete: no columns file is needed.
            fault += (
                f"; {currents[0]}, ... are motor currents: give "
                f"{option_name('torque_constants')}, N·m at the joint per ampere, gear included; "
                f"where they are not known, {option_name('torque_constants', '1')} leads to a "
                "weight of known mass, which shows them"
            )
            return InputError(fault)
        torques = self._unused_torques()
        commands = self.of_servos.recognise("command") if self.has_servos else ()
        if commands:
            fault += (
                f"; {commands[0].title}, ... are commanded positions, as of position servos: "
                "identify --torque-from position-error takes the torque from the distance of "
                "positions to them; torques that it has are named with "
                f"{option_name('columns', 'FILE')}"
            )
            option = ("--torque-from", "position-error")
            return InputError(fault, [option], command="identify")
        others = [text for text in torques if "(measured)" not in text]
        if others:
            fault += f"; not measured are {', '.join(others)}"
        return UnrecognisedError(fault)

    def _part_of_chain(self, quantity: str) -> tuple[str, ...]:
        """Return the joints in a row, two or more, of which titles name a quantity; () where some
        are missing between them.
        """
        names = self.robot.joint_names
        named = {t.joint for t in self.titles if t.joint_quantity == quantity}
        at = [k for k, name in enumerate(names) if name in named]
        if not 2 <= len(at) < len(names) or at[-1] - at[0] >= len(at):
            return ()
        declared = {key.partition(".")[2] for key in self.choices.entries}
        # A chain without a joint takes no declaration of it.
        is_declared = not declared.isdisjoint({*names} - {*named})
        return () if is_declared else names[at[0] : at[-1] + 1]

    def _unused_torques(self, used: Collection[int] = ()) -> list[str]:
        """Return the titles of torques of as many joints, with "*" for the joint, and their marks.

        ``used``: indices of the columns of torques that are used.
        """
        columns: dict[str, list[int]] = {}
        for index, title in enumerate(self.titles):
            pattern = re.sub(r"\d+", "*", title.text)
            if title.joint in self.robot.joint_names:
                pattern = title.text.replace(title.joint, "*")
            if title.torque_kind:
                columns.setdefault(pattern, []).append(index)
        return [
            f"{pattern} ({self.titles[indices[0]].torque_kind})"
            for pattern, indices in columns.items()
            if len(indices) >= self.robot.n_joints and not {*indices} & {*used}
        ]

    def _look_up(self, text: str) -> _Source:
        """Return (column index, factor) of "title", "-title" or "0.5 * title"."""
        texts = self.table.titles
        title, factor = split_factor(text, texts)
        if title not in texts:
            # The columns by their numbers, from 1.
            texts = tuple(f"#{number}" for number in range(1, len(texts) + 1))
        if texts.count(title) == 1:
            return texts.index(title), factor
        raise InputError(
            f"the log has no single column {title!r}; name one that there is once"
        )

    def _look_up_all(self, text: str) -> tuple[Sequence[str], Sequence[_Source], str]:
        """Return joints and (column index, factor) of each, by a pattern, a range or a list; and a
        note on joints' names, "" for none. Joints that stand still need no column.
        """
        joint_names = self.robot.joint_names
        moving = [name for name in joint_names if name not in self._standing]
        texts = self.table.titles
        title, factor = split_factor(text, texts)
        if title not in texts and "*" not in title:
            title = _JOINT_FORM.sub("*", title, count=1)
        try:
            fits, note = fit_pattern(title, texts, joint_names)
        except InputError:
            if not self._standing:
                raise
            fits, note = fit_pattern(title, texts, joint_names, self._standing)
        if fits:
            names = joint_names if len(fits) == len(joint_names) else moving
            return names, [(column, factor) for column in fits], note
        titles = [each.strip() for each in text.split(",")]
        ends = _RANGE.fullmatch(title)
        if ends:
            first, last = map(int, ends.groups())
            step = 1 if last >= first else -1
            numbers = range(first, last + step, step)
            if len(numbers) > len(texts):
                raise InputError(
                    f"{title!r} is more columns than the {len(texts)} that the log has"
                )
            titles = [f"{factor} * #{k}" for k in numbers]
        if "*" in title and len(titles) == 1:
            raise InputError(f"{text!r} fits no column")
        names = moving if len(titles) == len(moving) else joint_names
        if len(titles) != len(names):
            joints = count_text(len(joint_names), "joint")
            listed = count_text(len(titles), "column")
            raise InputError(
                f"{text!r} lists {listed}, the chain has {joints}: {', '.join(joint_names)}"
            )
        return names, [*map(self._look_up, titles)], ""

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
        unit = self.choices.angle_unit
        if quantity in ("time", "joint_time"):
            unit = self.choices.time_unit
        elif self.robot.is_slide[joint]:
            unit = self.choices.length_unit
        units = UNITS[quantity]
        # Of an encoder, counts are declared in front of the unit: 4096/rev.
        counts, _, unit = (unit or "").rpartition("/")
        declared = units.get(unit)
        if declared and counts:
            declared /= float(counts)
        to_si = units.get(title.unit, declared)
        if to_si is None and title.unit and abs(factor) == 1.0:
            raise InputError(
                f"unit {title.unit!r} of column {title.text!r} is unknown for a {quantity}; "
                f"rename the column, or scale it with {option_name('columns', 'FILE')}"
            )
        if declared is not None and to_si != declared:
            raise InputError(
                f"column {title.text!r} names a unit that contradicts the declared units; declare "
                "what the column holds, or rename it"
            )
        zero = self._zeros[joint] if quantity in ("position", "command") else 0.0
        return Column(index, title.text, factor * (to_si or 1.0), factor, float(zero))


def _with_numbers(columns: Sequence[Column], index: int) -> tuple[Column, ...]:
    """Return columns (n,) in which a joint without a torque has a column (index) of numbers, times
    zero.
    """
    return tuple(
        column if column.factor else replace(column, index=index) for column in columns
    )
