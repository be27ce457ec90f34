"""What the column titles of a log say: which quantity, of which joint, in which unit.

A title is cut into words and numbers: ``j0_pos`` -> j 0 pos; ``jointVelocity[3] (deg/s)`` ->
joint velocity 3, unit deg/s; ``q1`` -> q 1. Every word has to be known: a title with a foreign word
(``joint1_position_std``, ``q1_filtered``) is not taken for the plain quantity.

A column belongs to a joint by the joint's name, or else by counting. Both readings are made. A
quantity whose titles carry every joint's name goes by the names; else the numbers in the titles
have to be exactly 0..n-1 or 1..n. Two answers for one quantity are an error.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

from robot_sysid.errors import InputError


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


_KINDS = {
    "time": "time t timestamp timestamps stamp stamps clock",
    "position": "q pos position positions angle angles qpos jpos",
    "velocity": "qd dq qdot dqdt vel velocity velocities speed speeds qvel jvel",
    "acceleration": "qdd ddq qddot acc accel acceleration accelerations qacc jacc",
    "torque": "tau taus torque torques effort efforts eff trq tq force forces",
}
KIND_OF_WORD = {word: kind for kind, words in _KINDS.items() for word in words.split()}
"""Word to the quantity it stands for."""

_COMMANDED = _words(
    "cmd command commanded commands des desired ref reference target setpoint sp goal planned "
    "plan ff feedforward d action actions"
)
_NO_POSITION = _words("ff feedforward")
"""Of these, those that no position is called by."""
_NEUTRAL = _words(
    "j jnt joint joints axis ax a m motor motors dof arm robot field state states js jointstate "
    "jointstates header meas measured measurement act actual fb feedback msr present current "
    "sensor data values value currents as"
)
_CURRENT = frozenset({"current", "currents"})
_AMPERES = _words("a amp amps ampere amperes")
_JOINED = {
    " q dot ": " qd ",
    " q ddot ": " qdd ",
    " dot q ": " qd ",
    " ddot q ": " qdd ",
}

_DEGREE = math.pi / 180
_RPM = math.pi / 30
_IN_SI = {
    "time": {
        1.0: "s sec secs second seconds",
        1e-3: "ms msec millis",
        1e-6: "us usec µs micros",
    }
    | {1e-9: "ns nsec nanos"},
    "position": {
        1.0: "rad rads radians m",
        _DEGREE: "deg degree degrees °",
        1e-3: "mm",
    },
    "velocity": {1.0: "rads radsec rad rads1 ms", _DEGREE: "degs deg dps degsec °s"}
    | {_RPM: "rpm", 1e-3: "mms"},
    "torque": {1.0: "nm n", 1e-3: "mnm", 1e-2: "ncm", 1e3: "knm"},
}
_IN_SI["command"] = _IN_SI["position"]
UNITS = {
    kind: {unit: factor for factor, units in known.items() for unit in units.split()}
    for kind, known in _IN_SI.items()
}
"""Quantity to squeezed unit to what turns a value into SI."""
_UNIT_WORDS = _words(
    "s sec secs second seconds ms msec millis us usec µs micros ns nsec nanos rad rads radians deg "
    "degs degree degrees ° dps rpm mm nm mnm ncm knm s2"
)
_BRACKETS = re.compile(r"[\[({]([^\])}]*)[\])}]")


@dataclass(frozen=True)
class Title:
    """What a title says: lower-case words without units and numbers, the unit ("deg/s" -> "degs"),
    and the quantity it stands for in spite of its words: "" for none, None where these decide.
    """

    text: str
    words: tuple[str, ...]
    numbers: tuple[int, ...]
    unit: str
    stands_for: str | None = None

    @property
    def kinds(self) -> set[str]:
        """The quantities that its words speak of, measured or not."""
        return {KIND_OF_WORD[word] for word in self.words if word in KIND_OF_WORD}

    @property
    def foreign(self) -> bool:
        """Whether it holds a word that says neither a quantity nor that it is commanded."""
        return bool({*self.words} - {*KIND_OF_WORD} - _NEUTRAL - _COMMANDED)

    @property
    def commanded(self) -> bool:
        """Whether it is a command or a reference, not a measurement."""
        return bool(_COMMANDED & {*self.words})

    @property
    def kind(self) -> str | None:
        """The measured quantity, or None where it is none, or a word is foreign."""
        plain = len(self.kinds) == 1 and not self.foreign and not self.commanded
        return min(self.kinds) if plain else None

    @property
    def is_current(self) -> bool:
        """Whether it is a motor's current: the word, and none for another quantity."""
        return bool(_CURRENT & {*self.words}) and not self.kinds and not self.commanded

    @property
    def is_command(self) -> bool:
        """Whether it is a commanded position."""
        said = {*self.words} & _COMMANDED - _NO_POSITION
        # A bare d is too short to stand for a command without a position beside it.
        plain = bool(said) and (said != {"d"} or self.kinds == {"position"})
        other = self.foreign or _CURRENT & {*self.words} or self.kinds - {"position"}
        return plain and not other


def with_meaning(
    titles: Sequence[Title], joint_names: Sequence[str], currents: bool, commanded: bool
) -> list[Title]:
    """Return the titles with what they stand for, and with units that no joint's name holds.

    Args:
        currents: whether motor currents stand for torque and torques for nothing; not where there
            are fewer currents than joints: then the torque columns hold them.
        commanded: whether commanded positions are looked for, such as ``q_des[0]``, ``action 1``.
    """
    currents = currents and sum(title.is_current for title in titles) >= len(
        joint_names
    )
    found = []
    for title in titles:
        rests = (rest for _, rest in _rests(title, joint_names))
        rest = min(rests, key=lambda rest: len(rest.words), default=title)
        unit = rest.unit
        stands_for = title.stands_for
        if currents and title.is_current:
            unit = "" if unit in _AMPERES else unit
            stands_for = "torque"
        elif currents and "torque" in title.kinds:
            stands_for = ""
        elif commanded and rest.is_command:
            stands_for = "command"
        found.append(replace(title, unit=unit, stands_for=stands_for))
    return found


def read_title(text: str) -> Title:
    """Cut a title into words, numbers and unit."""
    unit, plain = _bracketed_unit(text.strip().lstrip("%#"))
    pieces = _pieces(plain)
    numbers = tuple(int(piece) for piece in pieces if piece.isdigit())
    words = [piece for piece in pieces if not piece.isdigit()]
    units = [word for word in words if word in _UNIT_WORDS]
    said = f" {' '.join(word for word in words if word not in _UNIT_WORDS)} "
    for apart, joined in _JOINED.items():
        said = said.replace(apart, joined)
    return Title(text, tuple(said.split()), numbers, unit or "".join(units))


def _bracketed_unit(text: str) -> tuple[str, str]:
    """Return (unit, title without it); a number in brackets is an index and stays."""
    unit = ""
    for content in _BRACKETS.findall(text):
        if content.strip().isdigit():
            text = _BRACKETS.sub(rf" {content.strip()} ", text, count=1)
        else:
            unit = re.sub(r"[^a-z0-9°µ]", "", content.lower().replace("μ", "µ"))
            text = _BRACKETS.sub(" ", text, count=1)
    return unit, text


def _pieces(text: str) -> list[str]:
    whole_units = re.sub(r"(?<![a-zA-Z])[mk]?Nm(?![a-z])", lambda m: m[0].lower(), text)
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", whole_units)
    return re.findall(r"[a-zA-Z°µ]+|\d+", apart.lower())


@contextlib.contextmanager
def collected(faults: list[str]) -> Iterator[None]:
    """Add what is wrong to a list, so that all that is wrong can be said at once."""
    try:
        yield
    except InputError as error:
        faults.append(str(error))


Found = dict[tuple[str, int], list[int]]
"""(quantity, joint number) to the columns that could be it."""

QUANTITIES = ("position", "velocity", "torque", "joint_time", "command")
REMEDY = "name the columns with --columns FILE"


def match_joints(
    titles: Sequence[Title], joint_names: Sequence[str], first_row: Sequence[str] = ()
) -> Found:
    """Return the candidate columns of each quantity of each joint; nothing where one is missing."""
    named = _by_name(titles, joint_names)
    owned = {index for columns in named.values() for index in columns}
    counted = _by_number(titles, joint_names, first_row, set())
    unnamed = _by_number(titles, joint_names, first_row, owned)
    found: Found = {}
    for kind in QUANTITIES:
        keys = [(kind, joint) for joint in range(len(joint_names))]
        if all(key in named for key in keys):
            if keys[0] in unnamed:
                pair = (named[keys[0]][0], unnamed[keys[0]][0])
                raise two_candidates(
                    kind, joint_names[0], [titles[i].text for i in pair]
                )
            found.update({key: named[key] for key in keys})
        elif all(key in counted for key in keys):
            off = [
                (i, key[1])
                for key in keys
                for i in named.get(key, ())
                if i not in counted[key]
            ]
            for index, joint in off:
                raise InputError(
                    f"column {titles[index].text!r} carries the name of joint "
                    f"{joint_names[joint]}, but by counting it belongs to another joint; {REMEDY}"
                )
            found.update({key: counted[key] for key in keys})
    return found


def joint_kind(title: Title) -> str | None:
    """Return the quantity of a title that belongs to one joint, or None."""
    if title.stands_for is not None:
        return None if title.foreign else title.stands_for or None
    if title.kind != "time":
        return title.kind
    # A bare "t" beside a joint could as well be its torque or temperature.
    return "joint_time" if set(title.words) & {"time", "stamp", "timestamp"} else None


def two_candidates(kind: str, joint: str, titles: Sequence[str]) -> InputError:
    """Return the error for a quantity that several columns could be."""
    listed = " and ".join(repr(title) for title in titles)
    of_joint = f" of joint {joint}" if joint else ""
    return InputError(
        f"{listed} could both be the {kind}{of_joint}; {REMEDY} to choose one"
    )


def _by_name(titles: Sequence[Title], joint_names: Sequence[str]) -> Found:
    found: Found = {}
    for index, title in enumerate(titles):
        for joint, rest in _rests(title, joint_names):
            kind = joint_kind(replace(rest, stands_for=title.stands_for))
            if kind and not rest.numbers:
                found.setdefault((kind, joint), []).append(index)
                break
    return found


def _rests(title: Title, joint_names: Sequence[str]) -> Iterator[tuple[int, Title]]:
    """Yield (joint, rest of a title that carries its name), by the longest spellings first.

    A title may begin or end with a name exactly as written, so that ``#3`` and ``arm-1`` are found
    and ``arm_1`` is told from ``arm-1``; or hold the pieces of it, as ``Joint_1.position`` does.
    """
    text = title.text.strip()
    for joint, name in sorted(enumerate(joint_names), key=lambda pair: -len(pair[1])):
        behind = text[len(name) :]
        before = text[: -len(name)]
        if text.startswith(name) and behind and not behind[0].isalnum():
            yield joint, read_title(behind)
        elif text.endswith(name) and before and not before[-1].isalnum():
            yield joint, read_title(before)
    unit, plain = _bracketed_unit(text.lstrip("%#"))
    pieces = _pieces(plain)
    for joint, name in _aliases(tuple(joint_names)):
        wanted = _pieces(name)
        ends = [k + len(wanted) for k in range(len(pieces)) if wanted]
        end = next((k for k in ends if pieces[k - len(wanted) : k] == wanted), 0)
        if end:
            rest = read_title(" ".join(pieces[: end - len(wanted)] + pieces[end:]))
            yield joint, replace(rest, text=title.text, unit=unit or rest.unit)


@lru_cache
def _aliases(joint_names: tuple[str, ...]) -> list[tuple[int, str]]:
    """Return (joint, spelling), longest first; a part all joints share may be left out."""
    full = list(enumerate(joint_names))
    pieces = [_pieces(name) for name in joint_names]
    shared_start = len(os.path.commonprefix(pieces))
    shared_end = len(os.path.commonprefix([p[::-1] for p in pieces]))
    short = [" ".join(p[shared_start : len(p) - shared_end]) for p in pieces]
    # A bare number is left to counting, where the base (0 or 1) is checked.
    if len(set(short)) == len(short) > 1 and not any(
        s.isdigit() or not s for s in short
    ):
        full += list(enumerate(short))
    return sorted(full, key=lambda pair: -len(_pieces(pair[1])))


def _by_number(
    titles: Sequence[Title],
    joint_names: Sequence[str],
    first_row: Sequence[str],
    skip: set[int],
) -> Found:
    numbered: dict[str, dict[int, list[int]]] = {}
    for index, title in enumerate(titles):
        kind = None if index in skip else joint_kind(title)
        lone = len(joint_names) == 1 and not title.numbers and kind != "joint_time"
        if kind and (len(title.numbers) == 1 or lone):
            number = title.numbers[0] if title.numbers else 0
            numbered.setdefault(kind, {}).setdefault(number, []).append(index)
    order = _order_from_names(titles, joint_names, first_row)
    found: Found = {}
    for kind, columns in numbered.items():
        # Without a list of names the numbers have to be exactly 0..n-1 or 1..n.
        fits = sorted(columns) == list(
            range(min(columns), min(columns) + len(joint_names))
        )
        counted = {
            number: k for k, number in enumerate(sorted(columns)) if min(columns) < 2
        }
        places = order or (counted if fits else {})
        found.update(
            {
                (kind, j): columns[number]
                for number, j in places.items()
                if number in columns
            }
        )
    return found


def _order_from_names(
    titles: Sequence[Title], joint_names: Sequence[str], first_row: Sequence[str]
) -> dict[int, int]:
    """Return number to joint by a log's own list of names; ROS may order by the alphabet."""
    listed: dict[int, str] = {}
    for title, cell in zip(titles, first_row):
        if title.words and title.words[-1] in ("name", "names"):
            cells = re.findall(r"[^\s,'\"\[\]()]+", cell)
            start = title.numbers[0] if title.numbers else 0
            listed.update({start + k: name for k, name in enumerate(cells)})
    return {
        number: joint_names.index(n) for number, n in listed.items() if n in joint_names
    }
