"""The meaning of a log's column titles: quantity, joint and unit.

A title is cut into tokens: ``j0_pos`` gives j, 0, pos; ``jointVelocity[3] (deg/s)`` gives joint,
velocity, 3 and the unit deg/s; ``q1`` gives q, 1. Every token has to be in the vocabulary: a title
with a foreign token (``joint1_position_std``, ``q1_filtered``) does not stand for the plain
quantity.

A column is matched with a joint by the joint's name, or else by its number. What remains of a title
beside its quantity is taken for the joint's name, and ``joint_names`` matches all of these with the
model's. Where a quantity has no such names for all joints, the numbers in its titles have to be
exactly 0..n-1 or 1..n, or those of the model's names. In a log that lists its joints, numbers stand
for the names of the list. Where names and numbers give different columns, the quantity cannot be
told, and a log that needs it is refused.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

from robot_sysid.errors import InputError
from robot_sysid.logs.joint_names import (
    joint_note,
    match_joint_names,
    name_numbers,
    split_camel_case,
)
from robot_sysid.records import RobotModel


def token_set(text: str) -> frozenset[str]:
    """Return the tokens of a text, which are separated by blanks."""
    return frozenset(text.split())


def by_token(vocabulary: Mapping[Any, str]) -> dict[str, Any]:
    """Return token to meaning, from a table of meaning to tokens that are separated by blanks."""
    meanings = {}
    for meaning, tokens in vocabulary.items():
        meanings.update(dict.fromkeys(tokens.split(), meaning))
    return meanings


QUANTITY_OF_TOKEN = by_token(
    {
        "time": "time t timestamp timestamps stamp stamps clock",
        "position": "q pos position positions angle angles qpos jpos",
        "velocity": "qd dq qdot dqdt vel velocity velocities speed speeds qvel jvel",
        "acceleration": "qdd ddq qddot acc accel acceleration accelerations qacc jacc",
        "torque": "tau taus torque torques effort efforts eff trq tq force forces moment moments",
    }
)
"""Token of a title to the quantity that it stands for."""

# Tokens that mark a command or a reference.
_COMMANDED = token_set(
    "cmd command commanded commands des desired ref reference target setpoint sp goal planned "
    "plan ff feedforward d action actions soll"
)
# Tokens of commands that do not stand for commanded positions.
_FEED_FORWARD = token_set("ff feedforward")
# Tokens that mark a torque as computed by a model.
_COMPUTED = token_set(
    "model computed calculated calc predicted rigid gravity grav friction ext external simulated "
    "sim"
)
# Tokens that mark a measurement; those of the first kind outrank those of the second.
_MEASURED = (token_set("meas measured measurement msr"), token_set("actual act ist"))
# Tokens that may be in a title without changing its quantity.
_NEUTRAL = token_set(
    "j jnt joint joints axis ax a m motor motors dof arm robot field state states js jointstate "
    "jointstates header meas measured measurement act actual fb feedback msr present current "
    "sensor data values value currents as"
)
# Tokens of a motor's current; "current" may mean "present" as well.
_CURRENT = token_set("current currents")
# Sequences of tokens to the single token that they stand for; Unitree calls its torque tauEst.
_JOINED = {
    " tau est ": " tau ",
    " q dot ": " qd ",
    " q ddot ": " qdd ",
    " dot q ": " qd ",
    " ddot q ": " qdd ",
}

DEGREE = math.pi / 180
TIME_UNITS = ("s", "ms", "us", "ns")
"""Units of time that a user may declare, the longest first."""
_TIMES = by_token(
    {
        1.0: "s sec secs second seconds",
        1e-3: "ms msec millis",
        1e-6: "us usec µs micros",
        1e-9: "ns nsec nanos",
    }
)
_POSITIONS = by_token(
    {
        1.0: "rad rads radians m",
        DEGREE: "deg degree degrees °",
        DEGREE / 100: "cdeg centideg centidegrees",
        2 * math.pi: "rev revs turn turns",
        1e-3: "mm mrad",
    }
)
UNITS = {
    "time": _TIMES,
    "joint_time": _TIMES,
    "position": _POSITIONS,
    "command": _POSITIONS,
    "velocity": by_token(
        {
            1.0: "rads radsec rad rads1 ms m",
            DEGREE: "degs deg dps degsec °s",
            DEGREE / 100: "cdegs cdeg",
            2 * math.pi: "revs rev",
            math.pi / 30: "rpm",
            1e-3: "mms mm mrads mrad",
        }
    ),
    "torque": by_token({1.0: "nm n", 1e-3: "mnm", 1e-2: "ncm", 1e3: "knm"}),
    "current": by_token({1.0: "a amp amps ampere amperes"}),
}
"""Quantity to unit, in letters and digits alone ("degs" for deg/s), to its value in SI units."""
# Tokens of a title that are a unit, or a part of one.
_UNIT_TOKENS = token_set(
    "s sec secs second seconds ms msec millis us usec µs micros ns nsec nanos rad rads radians deg "
    "degs degree degrees ° cdeg centideg centidegrees mrad dps rpm mm nm mnm ncm knm s2"
)
# Text in round, square or curly brackets.
_BRACKETS = re.compile(r"[\[({]([^\])}]*)[\])}]")

# A joint in brackets: its number, such as 3, A3 or axis_3.
_INDEX = re.compile(r"[a-zA-Z]*[ _]?\d+")
# A title with any other token does not stand for a quantity.
_VOCABULARY = {*QUANTITY_OF_TOKEN, *_NEUTRAL, *_COMMANDED}


@dataclass(frozen=True)
class Title:
    """A column title, cut into tokens, numbers and unit.

    Attributes:
        text: the title as the file has it.
        tokens: the title's words in lower case, without units and numbers, and without the joint's
            name where that is one of the model's.
        numbers: the whole numbers in the title, without those of such a name.
        unit: in lower case, letters and digits alone ("deg/s" is "degs"); "" for none.
        joint: name of the joint: the model's where the title has that as it is written, else the
            words beside the quantity; "" for none.
    """

    text: str
    tokens: tuple[str, ...]
    numbers: tuple[int, ...]
    unit: str
    joint: str

    @property
    def quantity(self) -> str | None:
        """The one quantity that it names; None for none, for several, or with a foreign token."""
        return None if {*self.tokens} - _VOCABULARY else self.quantity_beside_name

    @property
    def joint_quantity(self) -> str | None:
        """Which quantity of one joint it stands for, or None.

        It is "joint_time" for a joint's own time stamp.
        """
        if self.quantity != "time":
            return self.quantity
        # A bare "t" beside a joint could as well be its torque or temperature.
        is_stamp = {*self.tokens} & {"time", "stamp", "timestamp"}
        return "joint_time" if is_stamp else None

    @property
    def is_commanded(self) -> bool:
        """Whether a token marks it as a command or a reference, not a measurement."""
        return bool(_COMMANDED & {*self.tokens})

    @property
    def torque_kind(self) -> str | None:
        """Whether a torque is "commanded", "computed" or "measured", by its tokens; None for no
        torque.
        """
        tokens = {*self.tokens}
        if "torque" not in map(QUANTITY_OF_TOKEN.get, tokens):
            return None
        if self.is_commanded:
            return "commanded"
        return "computed" if tokens & _COMPUTED else "measured"

    @property
    def quantity_beside_name(self) -> str | None:
        """The one quantity that it names beside any other words; None for none, or for several.

        It is "command" for a commanded position, such as ``q_des[0]``, ``action 1``, and "current"
        for a motor's current.
        """
        tokens = {*self.tokens}
        named = {QUANTITY_OF_TOKEN[t] for t in tokens if t in QUANTITY_OF_TOKEN}
        # This may mean "present" as well.
        has_current = _CURRENT & tokens
        if self.is_commanded:
            marks = tokens & (_COMMANDED - _FEED_FORWARD)
            # A bare d is too short to stand for a command without a position beside it.
            is_marked = marks and (marks != {"d"} or named)
            is_position = named <= {"position"} and not has_current
            return "command" if is_marked and is_position else None
        if has_current and not named:
            return "current"
        return min(named) if len(named) == 1 else None


def read_title(text: str, joint_names: Sequence[str] = ()) -> Title:
    """Return a title cut into tokens, numbers and unit.

    A title begins or ends with a joint's name exactly as written, so that ``#3`` and ``arm-1`` are
    matched and ``arm_1`` is told from ``arm-1``. The longest name whose remainder is a quantity is
    left out.
    """
    stripped = text.strip()
    for name in sorted(joint_names, key=len, reverse=True):
        form = re.escape(name)
        match = re.fullmatch(rf"(?s){form}([\W_].*)|(.*[\W_]){form}", stripped)
        if match:
            title = replace(read_title(match[1] or match[2]), text=text, joint=name)
            if title.joint_quantity and not title.numbers:
                return title
    unit = ""
    unitless = stripped.lstrip("%#")
    for content in _BRACKETS.findall(unitless):
        # What ends in a number is a joint's.
        index = _INDEX.fullmatch(content.strip())
        if not index:
            unit = re.sub(r"[^a-z0-9°µ]", "", content.lower().replace("μ", "µ"))
        unitless = _BRACKETS.sub(f" {index[0]} " if index else " ", unitless, count=1)
    numbers = []
    phrase = " "
    trailing_unit = ""
    for piece in _pieces(unitless):
        if piece.isdigit():
            numbers.append(int(piece))
        elif piece in _UNIT_TOKENS:
            trailing_unit += piece
        else:
            phrase += f"{piece} "
    for separate, joined in _JOINED.items():
        phrase = phrase.replace(separate, joined)
    joint = _words_beside_quantity(unitless)
    tokens = tuple(phrase.split())
    return Title(text, tokens, tuple(numbers), unit or trailing_unit, joint)


def _pieces(text: str) -> list[str]:
    """Return the runs of letters, in lower case, and of digits; camelCase is two runs, Nm one."""
    with_units = re.sub(r"(?<![a-zA-Z])[mk]?Nm(?![a-z])", lambda m: m[0].lower(), text)
    return re.findall(r"[a-zA-Z°µ]+|\d+", split_camel_case(with_units).lower())


class UnrecognisedError(InputError):
    """Titles do not say which column is what: there is none for a quantity, or several."""


def measured_columns(titles: Sequence[Title], columns: Sequence[int]) -> Sequence[int]:
    """Return those of some columns (indices) that a word marks as measured; all where none does."""
    for marks in _MEASURED:
        marked = [column for column in columns if marks & {*titles[column].tokens}]
        if marked:
            return marked
    return columns


def fit_pattern(
    pattern: str, titles: Sequence[str], joint_names: Sequence[str]
) -> tuple[Sequence[int], str]:
    """Return the columns (n,) whose titles fit a pattern, base to terminal, and a note on names.

    "*" stands for the joint's number or name; of several, one does. Nothing is returned where no
    title fits.

    Raises:
        InputError: as many titles fit as the arm has no joints, or another arm's.
    """
    for star in re.finditer(r"\*", pattern):
        front = re.escape(pattern[: star.start()])
        back = re.escape(pattern[star.end() :])
        matches = map(re.compile(f"{front}(.+){back}").fullmatch, titles)
        fits = [(m[1], column) for column, m in enumerate(matches) if m]
        counted = [fit for fit in fits if fit[0].isdecimal()]
        fits = counted or fits
        if not fits:
            continue
        names = dict(fits)
        if counted:
            numbers = {int(text): column for text, column in fits}
            order = _order_of_numbers([*map(int, names)], joint_names, is_declared=True)
            columns = [numbers[number] for number in order]
            note = ""
        else:
            matched = match_joint_names([*names], joint_names)
            columns = [names[text] for text in matched]
            note = joint_note(matched, [*names])
        # Of two equal titles, one is lost.
        if columns and len(fits) == len(names):
            return columns, note
        listed = ", ".join(titles[column] for _, column in fits)
        raise InputError(
            f"{pattern!r} fits {len(fits)} columns ({listed}), and not one for each of the "
            f"{len(joint_names)} joints ({', '.join(joint_names)}): list the columns instead, "
            "base to last joint"
        )
    return (), ""


Candidates = Mapping[str, Sequence[Sequence[int]]]
"""Quantity to the indices of the columns that could be it: a list per joint, base to terminal."""


def match_joints(
    titles: Sequence[Title],
    robot: RobotModel,
    first_row: Sequence[str],
    quantities: Sequence[str],
    has_names: bool,
) -> tuple[Candidates, str]:
    """Return the candidate columns of quantities, and a note on how joint names were matched.

    Joints have several candidates where titles name and count them, or occur twice; none where one
    of them would have none.

    Args:
        titles: of all columns, from left to right.
        robot: the arm.
        first_row: the cells of the first row as text, which may list joint names.
        quantities: of ``Title.joint_quantity``.
        has_names: whether positions are not declared, and their titles may name joints in other
            words than the model.

    Raises:
        InputError: the joints' names are those of two arms, or of another arm.
    """
    joint_names = robot.joint_names
    listed_names = _listed_names(titles, first_row, robot.n_joints)
    # Quantity, and name or number of a joint, to indices of columns.
    named: Mapping[Any, list[int]] = defaultdict(list)
    counted: Mapping[Any, list[int]] = defaultdict(list)
    for column, title in enumerate(titles):
        name = title.joint
        numbers = title.numbers
        quantity = title.joint_quantity
        if quantity and len(numbers) == 1:
            name = listed_names.get(numbers[0], name)
        if name:
            named[quantity or title.quantity_beside_name, name].append(column)
        # A time without a number is the row's, not the single joint's own.
        if robot.n_joints == 1 and quantity != "joint_time":
            numbers = numbers or (0,)
        if len(numbers) == 1:
            counted[quantity, numbers[0]].append(column)
    names = [name for quantity, name in named if has_names and quantity == "position"]
    matched = match_joint_names(names, joint_names)
    candidates = {}
    for quantity in quantities:
        by_name = [named[quantity, name] for name in matched or joint_names]
        # Names decide for all joints of a quantity or for none.
        if not all(by_name):
            by_name = [[]] * robot.n_joints
        taken = {*chain(*by_name)}
        by_number = {}
        for (its_quantity, number), columns in counted.items():
            others = [column for column in columns if column not in taken]
            if its_quantity == quantity and others:
                by_number[number] = others
        order = () if listed_names else _order_of_numbers([*by_number], joint_names)
        numbered = [by_number[k] for k in order] or [[]] * robot.n_joints
        candidates[quantity] = [
            [*measured_columns(titles, columns), *measured_columns(titles, others)]
            for columns, others in zip(by_name, numbered)
        ]
    return candidates, joint_note(matched, names)


def _order_of_numbers(
    numbers: Sequence[int], joint_names: Sequence[str], is_declared: bool = False
) -> Sequence[int]:
    """Return which of the numbers in titles is each joint's, base to terminal; () for no answer.

    They are those of the joints' names, or count from 0 or 1; from any number where a user has
    declared the titles.
    """
    order = sorted(numbers)
    own_numbers = name_numbers(joint_names)
    if order == sorted(own_numbers):
        return own_numbers
    starts = order[:1] if is_declared else (0, 1)
    is_counted = any(order == [*range(k, k + len(joint_names))] for k in starts)
    # Where the model's names are numbered in another order, counting contradicts them.
    return order if is_counted and own_numbers == sorted(own_numbers) else ()


def _words_beside_quantity(unitless: str) -> str:
    """Return a title without its quantity and unit; "" for a bare number, which is counted.

    ``unitless``: the title without a unit in brackets.
    """
    not_names = {*QUANTITY_OF_TOKEN, *_UNIT_TOKENS, *_CURRENT, *_COMMANDED}
    pieces = re.split(r"([^\W\d_]+)", split_camel_case(unitless))
    kept = [piece for piece in pieces if piece.lower() not in not_names]
    name = "".join(kept).strip(" ._/:-")
    return name if re.search(r"[^\W\d_]", name) else ""


def ambiguity_error(
    quantity: str, joint: str, titles: Sequence[Title], columns: Sequence[int]
) -> UnrecognisedError:
    """Return the error for a quantity that each of several columns (indices) could be.

    ``joint`` is "" for a quantity of no joint.
    """
    listed = " and ".join(repr(titles[column].text) for column in columns)
    of_joint = f" of joint {joint}" if joint else ""
    return UnrecognisedError(f"{listed} could both be the {quantity}{of_joint}")


def _listed_names(
    titles: Sequence[Title], first_row: Sequence[str], n_joints: int
) -> Mapping[int, str]:
    """Return the number of each joint in a log's own list of names; empty where it has none.

    ROS lists names in any order, such as that of the alphabet: in a column "name" with all names in
    its first row, or in columns "name[0]", "name[1]", ... with one each.
    """
    numbers = [t.numbers[0] for t in titles if t.quantity == "position" and t.numbers]
    first_number = min(numbers, default=0)
    names: dict[int, str] = {}
    for title, cell in zip(titles, first_row):
        if title.tokens and title.tokens[-1] in ("name", "names"):
            start = title.numbers[0] if title.numbers else first_number
            cell_names = re.findall(r"[^\s,'\"\[\]()]+", cell)
            names.update(enumerate(cell_names, start))
    # A shorter one is the name of something else, such as the robot.
    return names if len(names) >= max(2, n_joints) else {}
