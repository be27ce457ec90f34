"""The meaning of a log's column titles: quantity, joint and unit.

A title is cut into tokens: ``j0_pos`` gives j, 0, pos; ``jointVelocity[3] (deg/s)`` gives joint,
velocity, 3 and the unit deg/s; ``q1`` gives q, 1. Every token has to be in the vocabulary: a title
with a foreign token (``joint1_position_std``, ``q1_filtered``) does not stand for the plain
quantity.

A column is matched with a joint by the joint's name, or else by its number. What remains of a title
beside its quantity is taken for the joint's name, and ``joint_names`` matches all of these with the
model's. Where a quantity has no such names for all joints, the numbers in its titles have to be
exactly 0..n-1 or 1..n, or those of the model's names; they count the joints in the order of the
log's own list of names, if it has one. Where names and numbers give different columns, the log is
refused.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import TypeVar

from robot_sysid.errors import InputError
from robot_sysid.logs.joint_names import (
    JointMatch,
    join_names,
    match_joint_names,
    name_numbers,
    split_camel_case,
)
from robot_sysid.records import RobotModel

T = TypeVar("T")


def token_set(text: str) -> frozenset[str]:
    """Return the tokens of a text, which are separated by blanks."""
    return frozenset(text.split())


def by_token(vocabulary: Mapping[T, str]) -> dict[str, T]:
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
        "torque": "tau taus torque torques effort efforts eff trq tq force forces",
    }
)
"""Token of a title to the quantity that it stands for."""

# Tokens that mark a command or a reference.
_COMMANDED = token_set(
    "cmd command commanded commands des desired ref reference target setpoint sp goal planned "
    "plan ff feedforward d action actions"
)
_FEED_FORWARD = token_set("ff feedforward")
"""Tokens of commands that do not stand for commanded positions."""
# Tokens that may be in a title without changing its quantity.
_NEUTRAL = token_set(
    "j jnt joint joints axis ax a m motor motors dof arm robot field state states js jointstate "
    "jointstates header meas measured measurement act actual fb feedback msr present current "
    "sensor data values value currents as"
)
# Tokens of a motor's current; "current" may mean "present" as well.
_CURRENT = frozenset({"current", "currents"})
# Units of a motor's current.
_AMPERES = token_set("a amp amps ampere amperes")
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
_POSITION_UNITS = {
    1.0: "rad rads radians m",
    DEGREE: "deg degree degrees °",
    1e-3: "mm",
}
UNITS = {
    "time": by_token(
        {
            1.0: "s sec secs second seconds",
            1e-3: "ms msec millis",
            1e-6: "us usec µs micros",
            1e-9: "ns nsec nanos",
        }
    ),
    "position": by_token(_POSITION_UNITS),
    "velocity": by_token(
        {
            1.0: "rads radsec rad rads1 ms",
            DEGREE: "degs deg dps degsec °s",
            math.pi / 30: "rpm",
            1e-3: "mms",
        }
    ),
    "torque": by_token({1.0: "nm n", 1e-3: "mnm", 1e-2: "ncm", 1e3: "knm"}),
    "command": by_token(_POSITION_UNITS),
}
"""Quantity to unit, in letters and digits alone ("degs" for deg/s), to its value in SI units."""
_UNIT_TOKENS = token_set(
    "s sec secs second seconds ms msec millis us usec µs micros ns nsec nanos rad rads radians deg "
    "degs degree degrees ° dps rpm mm nm mnm ncm knm s2"
)
"""Tokens of a title that are a unit, or a part of one."""
_BRACKETS = re.compile(r"[\[({]([^\])}]*)[\])}]")
"""Text in round, square or curly brackets."""


CURRENTS = "currents"
"""What a log is read for where motor currents stand for torques."""
COMMANDS = "commands"
"""What a log is read for where commanded positions stand for torques."""
# A title with any other token does not stand for a quantity.
_VOCABULARY = {*QUANTITY_OF_TOKEN, *_NEUTRAL, *_COMMANDED}


@dataclass(frozen=True)
class Title:
    """A column title, cut into tokens, numbers and unit.

    Attributes:
        text: the title as the file has it.
        tokens: the title's words in lower case, without units and numbers.
        numbers: the whole numbers in the title.
        unit: in lower case, letters and digits alone ("deg/s" is "degs"); "" for none.
        reads: what stands for the torque: CURRENTS, COMMANDS, or "" for torques.
    """

    text: str
    tokens: tuple[str, ...]
    numbers: tuple[int, ...]
    unit: str
    reads: str = ""

    @property
    def quantities(self) -> set[str]:
        """The quantities that its tokens name, measured or commanded."""
        return {QUANTITY_OF_TOKEN[t] for t in self.tokens if t in QUANTITY_OF_TOKEN}

    @property
    def quantity(self) -> str | None:
        """The one quantity that it names; None for none, for several, or with a foreign token."""
        return None if {*self.tokens} - _VOCABULARY else self.quantity_beside_name

    @property
    def is_commanded(self) -> bool:
        """Whether a token marks it as a command or a reference, not a measurement."""
        return bool(_COMMANDED & {*self.tokens})

    @property
    def quantity_beside_name(self) -> str | None:
        """The one quantity that it names beside any other words; None for none, or for several.

        It is "command" for a commanded position, such as ``q_des[0]``, ``action 1``, if those are
        read.
        """
        if self.is_commanded:
            marks = {*self.tokens} & (_COMMANDED - _FEED_FORWARD)
            # A bare d is too short to stand for a command without a position beside it.
            is_marked = marks and (marks != {"d"} or "position" in self.quantities)
            is_position = self.quantities <= {"position"} and not self._has_current
            return (
                "command"
                if self.reads == COMMANDS and is_marked and is_position
                else None
            )
        if self.reads == CURRENTS:
            if self.is_current:
                return "torque"
            if "torque" in self.quantities:
                return None
        return min(self.quantities) if len(self.quantities) == 1 else None

    @property
    def _has_current(self) -> bool:
        """Whether a token is that of a motor's current, which may mean "present" as well."""
        return bool(_CURRENT & {*self.tokens})

    @property
    def is_current(self) -> bool:
        """Whether it names a motor's current, and no other quantity."""
        return self._has_current and not self.quantities and not self.is_commanded


def interpret_titles(
    titles: Sequence[Title], joint_names: Sequence[str], currents: bool, commanded: bool
) -> list[Title]:
    """Return titles with what they read and their unit; joint names are not searched for units.

    Args:
        titles: of ``read_title``.
        joint_names: (n,) of the arm.
        currents: whether columns of motor currents are read in place of torques. Where there are
            fewer such columns than joints, the torque columns are taken to hold the currents.
        commanded: whether commanded positions are read, such as ``q_des[0]``, ``action 1``.
    """
    reads = COMMANDS if commanded else ""
    if currents and sum(title.is_current for title in titles) >= len(joint_names):
        reads = CURRENTS
    interpreted = []
    for title in titles:
        # Of several joints' names in a title, the one that takes most of it is left out.
        stripped_titles = [t for _, t in _strip_joint_names(title, joint_names)]
        nameless = min(stripped_titles, key=lambda t: len(t.tokens), default=title)
        unit = nameless.unit
        if reads == CURRENTS and title.is_current and unit in _AMPERES:
            unit = ""
        # A word of a joint's name makes no command.
        is_plain = reads == COMMANDS and not nameless.is_commanded
        interpreted.append(replace(title, unit=unit, reads="" if is_plain else reads))
    return interpreted


def read_title(text: str) -> Title:
    """Return a title cut into tokens, numbers and unit, of a log of torques."""
    unit, unitless = _split_bracketed_unit(text.strip().lstrip("%#"))
    numbers = []
    tokens = []
    trailing_unit = ""
    for piece in _pieces(unitless):
        if piece.isdigit():
            numbers.append(int(piece))
        elif piece in _UNIT_TOKENS:
            trailing_unit += piece
        else:
            tokens.append(piece)
    phrase = f" {' '.join(tokens)} "
    for separate, joined in _JOINED.items():
        phrase = phrase.replace(separate, joined)
    return Title(text, tuple(phrase.split()), tuple(numbers), unit or trailing_unit)


def _split_bracketed_unit(text: str) -> tuple[str, str]:
    """Return (unit in brackets, title without it); a number in brackets is an index and stays."""
    unit = ""
    for content in _BRACKETS.findall(text):
        if content.strip().isdigit():
            text = _BRACKETS.sub(rf" {content.strip()} ", text, count=1)
        else:
            unit = re.sub(r"[^a-z0-9°µ]", "", content.lower().replace("μ", "µ"))
            text = _BRACKETS.sub(" ", text, count=1)
    return unit, text


def _pieces(text: str) -> list[str]:
    """Return the runs of letters, in lower case, and of digits; camelCase is two runs, Nm one."""
    with_units = re.sub(r"(?<![a-zA-Z])[mk]?Nm(?![a-z])", lambda m: m[0].lower(), text)
    return re.findall(r"[a-zA-Z°µ]+|\d+", split_camel_case(with_units).lower())


QUANTITIES = ("position", "velocity", "torque", "joint_time", "command")
"""Quantities with a column per joint; ``joint_time`` is a joint's own time stamp."""
Candidates = dict[str, list[list[int]]]
"""Quantity to the indices of the columns that could be it: a list per joint, base to terminal."""


def match_joints(
    titles: Sequence[Title], robot: RobotModel, first_row: Sequence[str]
) -> tuple[Candidates, JointMatch | None]:
    """Return the candidate columns of each of QUANTITIES, and how joint names were matched if so.

    The candidates of a quantity are none where a joint has none.

    Args:
        titles: of all columns, from left to right.
        robot: the arm.
        first_row: the cells of the first row as text, which may list joint names.

    Raises:
        InputError: two columns could be one quantity, or name and number of a title disagree; or
            the joints' names are those of two arms, or of an arm with another number of joints.
    """
    joint_names = robot.joint_names
    listed_joints, joint_match = _match_listed_names(titles, robot, first_row)
    by_name = columns_by_joint_name(titles, joint_names)
    if joint_match is None:
        names = [*by_name["position"]]
        # Of equal names, further ones may be those of a gripper that counts on.
        is_equal = {*joint_names} <= {*names}
        others = None if is_equal else robot.other_joint_names
        joint_match = match_joint_names(names, joint_names, others)
    log_names = joint_match.model_names if joint_match else joint_names
    # Names decide for all joints of a quantity or for none.
    named: Candidates = {}
    for quantity in QUANTITIES:
        columns = [by_name[quantity].get(name, []) for name in log_names]
        if all(columns):
            named[quantity] = columns
    named_columns = {*chain(*chain(*named.values()))}
    by_number = _match_numbers(titles, joint_names, listed_joints, named_columns)
    candidates: Candidates = {q: [[] for _ in joint_names] for q in QUANTITIES}
    for quantity, numbered in by_number.items():
        if not all(numbered):
            continue
        if quantity in named:
            rivals = [named[quantity][0][0], numbered[0][0]]
            raise ambiguity_error(quantity, joint_names[0], titles, rivals)
        candidates[quantity] = numbered
        for joint_name, counted in zip(joint_names, numbered):
            disputed = {*by_name[quantity].get(joint_name, [])} - {*counted}
            if disputed:
                raise InputError(
                    f"column {titles[min(disputed)].text!r} carries the name of joint "
                    f"{joint_name}, but by counting it belongs to another joint"
                )
    return {**candidates, **named}, joint_match


def columns_by_joint_name(
    titles: Sequence[Title], joint_names: Sequence[str]
) -> Mapping[str, dict[str, list[int]]]:
    """Return quantity to joint name to indices of columns, of titles with one quantity.

    The name is the model's where the title has that as it is written, and else what the title has
    beside the quantity: ``panda_joint1_position [rad]`` is the position of ``panda_joint1``.
    """
    columns: dict[str, dict[str, list[int]]] = defaultdict(lambda: defaultdict(list))
    for column, title in enumerate(titles):
        name = ""
        quantity = None
        for joint, stripped in _strip_joint_names(title, joint_names):
            quantity = joint_quantity(stripped)
            if quantity and not stripped.numbers:
                name = joint_names[joint]
                break
        if not name:
            quantity = title.quantity_beside_name
            name = _words_beside_quantity(title)
        if quantity in QUANTITIES and name:
            columns[quantity][name].append(column)
    return columns


def _words_beside_quantity(title: Title) -> str:
    """Return a title without its quantity and unit; "" for a bare number, which is counted."""
    not_names = {*QUANTITY_OF_TOKEN, *_UNIT_TOKENS, *_CURRENT, *_COMMANDED}
    _, unitless = _split_bracketed_unit(title.text)
    pieces = re.split(r"([^\W\d_]+)", split_camel_case(unitless))
    kept = [piece for piece in pieces if piece.lower() not in not_names]
    name = "".join(kept).strip(" ._/:-")
    return name if re.search(r"[^\W\d_]", name) else ""


def joint_quantity(title: Title) -> str | None:
    """Return which of QUANTITIES, of one joint, a title stands for, or None."""
    if title.quantity != "time":
        return title.quantity
    # A bare "t" beside a joint could as well be its torque or temperature.
    is_stamp = bool({*title.tokens} & {"time", "stamp", "timestamp"})
    return "joint_time" if is_stamp else None


def ambiguity_error(
    quantity: str, joint: str, titles: Sequence[Title], columns: Sequence[int]
) -> InputError:
    """Return the error for a quantity that each of several columns (indices) could be.

    ``joint`` is "" for a quantity of no joint.
    """
    listed = " and ".join(repr(titles[column].text) for column in columns)
    of_joint = f" of joint {joint}" if joint else ""
    return InputError(f"{listed} could both be the {quantity}{of_joint}")


def _strip_joint_names(
    title: Title, joint_names: Sequence[str]
) -> Iterator[tuple[int, Title]]:
    """Yield (joint index, title without that joint's name), by the longest spellings first.

    A title begins or ends with a name exactly as written, so that ``#3`` and ``arm-1`` are matched
    and ``arm_1`` is told from ``arm-1``.
    """
    text = title.text.strip()
    by_length = sorted(enumerate(joint_names), key=lambda pair: -len(pair[1]))
    for joint, name in by_length:
        suffix = text[len(name) :]
        prefix = text[: -len(name)]
        if text.startswith(name) and suffix and not suffix[0].isalnum():
            yield joint, replace(read_title(suffix), reads=title.reads)
        elif text.endswith(name) and prefix and not prefix[-1].isalnum():
            yield joint, replace(read_title(prefix), reads=title.reads)


def _match_numbers(
    titles: Sequence[Title],
    joint_names: Sequence[str],
    listed_joints: Sequence[int],
    excluded: set[int],
) -> Candidates:
    """Return the candidates among titles with one number; none for other quantities.

    Args:
        titles: of all columns, from left to right.
        joint_names: (n,) of the arm; of a single joint, titles without a number count too.
        listed_joints: of ``_match_listed_names``; the numbers of a quantity have to count them from
            0 or 1. Where there are none, the joints of the model in its order, or the numbers have
            to be those of the model's names.
        excluded: indices of columns that are left out.
    """
    joint_numbers = name_numbers(joint_names)
    # Where the model's names are numbered in another order, counting contradicts them.
    is_ordered = joint_numbers == sorted(joint_numbers)
    counted = listed_joints or (range(len(joint_names)) if is_ordered else ())
    # Quantity to number in the title to indices of columns.
    numbered: dict[str, dict[int, list[int]]] = defaultdict(lambda: defaultdict(list))
    for column, title in enumerate(titles):
        quantity = None if column in excluded else joint_quantity(title)
        numbers = title.numbers
        # A time without a number is the row's, not the single joint's own.
        if len(joint_names) == 1 and quantity != "joint_time":
            numbers = numbers or (0,)
        if quantity and len(numbers) == 1:
            numbered[quantity][numbers[0]].append(column)
    candidates: Candidates = defaultdict(lambda: [[] for _ in joint_names])
    for quantity, columns in numbered.items():
        order = sorted(columns)
        joints: dict[int, int] = {}
        if order in ([*range(len(counted))], [*range(1, len(counted) + 1)]):
            joints = dict(zip(order, counted))
        elif not listed_joints and order == sorted(joint_numbers):
            joints = {number: k for k, number in enumerate(joint_numbers)}
        for number, joint in joints.items():
            if joint >= 0:
                candidates[quantity][joint] = columns[number]
    return candidates


def _match_listed_names(
    titles: Sequence[Title], robot: RobotModel, first_row: Sequence[str]
) -> tuple[Sequence[int], JointMatch | None]:
    """Return the joints in the order of a log's own list of names, and how that was matched.

    ROS lists names in any order, such as that of the alphabet: in a column "name" with all names in
    its first row, or in columns "name[0]", "name[1]", ... with one each.

    Returns:
        Indices of joints, -1 for one that is not the arm's. The match. Without a list, () and None.

    Raises:
        InputError: the listed names are not those of the arm.
    """
    name_of_number: dict[int, str] = {}
    for title, cell in zip(titles, first_row):
        if title.tokens and title.tokens[-1] in ("name", "names"):
            start = title.numbers[0] if title.numbers else 0
            cell_names = re.findall(r"[^\s,'\"\[\]()]+", cell)
            name_of_number.update(enumerate(cell_names, start))
    names = [name_of_number[number] for number in sorted(name_of_number)]
    if len(names) < max(2, robot.n_joints):
        # No list, or the name of something else, such as the robot.
        return (), None
    joint_match = match_joint_names(names, robot.joint_names, robot.other_joint_names)
    if joint_match is None:
        raise InputError(
            f"the log lists the joints {join_names(names)}, which are not the model's "
            f"{join_names(robot.joint_names)}: give the model of the arm that was recorded"
        )
    arm_joints = [*joint_match.model_names]
    joints = [arm_joints.index(n) if n in arm_joints else -1 for n in names]
    return joints, joint_match
