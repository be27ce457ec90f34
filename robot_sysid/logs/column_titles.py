"""What one column title of a log says: which quantity, of which joint, in which unit.

A title is cut into words and numbers: ``j0_pos`` -> j 0 pos; ``jointVelocity[3] (deg/s)`` ->
joint velocity 3, unit deg/s; ``q1`` -> q 1. Every word has to be known: a title with a foreign word
(``joint1_position_std``, ``q1_filtered``) is not taken for the plain quantity.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass


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
    "plan ff feedforward d"
)
_NEUTRAL = _words(
    "j jnt joint joints axis ax a m motor motors dof arm robot field state states js jointstate "
    "jointstates header meas measured measurement act actual fb feedback msr present current "
    "sensor data values value"
)
_JOINED = {("q", "dot"): "qd", ("q", "ddot"): "qdd", ("dot", "q"): "qd", ("ddot", "q"): "qdd"}

_UNITS = {
    "time": {"s": 1.0, "sec": 1.0, "secs": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3}
    | {"msec": 1e-3, "millis": 1e-3, "us": 1e-6, "usec": 1e-6, "µs": 1e-6, "micros": 1e-6}
    | {"ns": 1e-9, "nsec": 1e-9, "nanos": 1e-9},
    "position": {"rad": 1.0, "deg": math.pi / 180, "degree": math.pi / 180, "mm": 1e-3}
    | {"degrees": math.pi / 180, "°": math.pi / 180, "rads": 1.0, "radians": 1.0, "m": 1.0},
    "velocity": {"rads": 1.0, "radsec": 1.0, "rad": 1.0, "degs": math.pi / 180, "ms": 1.0}
    | {"deg": math.pi / 180, "dps": math.pi / 180, "°s": math.pi / 180, "mms": 1e-3}
    | {"degsec": math.pi / 180, "rpm": math.pi / 30, "rads1": 1.0},
    "acceleration": {"rads2": 1.0, "degs2": math.pi / 180, "rads": 1.0, "degs": math.pi / 180}
    | {"deg": math.pi / 180, "rad": 1.0, "°s2": math.pi / 180, "ms2": 1.0},
    "torque": {"nm": 1.0, "mnm": 1e-3, "ncm": 1e-2, "knm": 1e3, "n": 1.0},
}
_UNIT_WORDS = _words(
    "s sec secs second seconds ms msec millis us usec µs micros ns nsec nanos rad rads radians deg "
    "degs degree degrees ° dps rpm mm nm mnm ncm knm s2"
)
_BRACKETS = re.compile(r"[\[(<{]([^\])>}]*)[\])>}]")


@dataclass(frozen=True)
class Title:
    """What a title says.

    Attributes:
        text: the title as written.
        words: lower-case words without units and numbers.
        numbers: the whole numbers in it.
        unit: the unit written in it, squeezed ("deg/s" -> "degs"), or "".
    """

    text: str
    words: tuple[str, ...]
    numbers: tuple[int, ...]
    unit: str

    @property
    def commanded(self) -> bool:
        """Whether it is a command or a reference, not a measurement."""
        return any(word in _COMMANDED for word in self.words)

    @property
    def kind(self) -> str | None:
        """The measured quantity, or None where it is none, or a word is foreign."""
        kinds = {KIND_OF_WORD[word] for word in self.words if word in KIND_OF_WORD}
        foreign = [w for w in self.words if w not in KIND_OF_WORD and w not in _NEUTRAL]
        return kinds.pop() if len(kinds) == 1 and not foreign else None


def read_title(text: str) -> Title:
    """Cut a title into words, numbers and unit."""
    unit, plain = _bracketed_unit(text.strip().lstrip("%#"))
    pieces = _pieces(plain)
    numbers = tuple(int(piece) for piece in pieces if piece.isdigit())
    words = [piece for piece in pieces if not piece.isdigit()]
    units = [word for word in words if word in _UNIT_WORDS]
    words = [word for word in words if word not in _UNIT_WORDS]
    return Title(text, tuple(_join(words)), numbers, unit or "".join(units))


def unit_factor(kind: str, unit: str) -> float | None:
    """Return what turns a value in this unit into SI, or None where the unit is unknown."""
    return _UNITS[kind].get(unit)


def name_pieces(name: str) -> tuple[str, ...]:
    """Return a joint's name cut like a title, to find it inside one."""
    return tuple(_pieces(name))


def without_written_name(title: Title, name: str) -> Title | None:
    """Return the rest of a title that begins or ends with a name exactly as written, or None.

    So ``#3`` and ``arm-1`` are found too, and ``arm_1`` is told from ``arm-1``.
    """
    text = title.text.strip()
    rest = text[len(name) :]
    if text.startswith(name) and rest and not rest[0].isalnum():
        return read_title(rest)
    rest = text[: -len(name)]
    if text.endswith(name) and rest and not rest[-1].isalnum():
        return read_title(rest)
    return None


def without_name(title: Title, name: str) -> Title | None:
    """Return the rest of a title that holds the pieces of a name, or None.

    So ``Joint_1.position`` belongs to ``joint1``.
    """
    unit, plain = _bracketed_unit(title.text.strip().lstrip("%#"))
    pieces, wanted = _pieces(plain), _pieces(name)
    for start in range(len(pieces) - len(wanted) + 1 if wanted else 0):
        if pieces[start : start + len(wanted)] == wanted:
            rest = read_title(" ".join(pieces[:start] + pieces[start + len(wanted) :]))
            return Title(title.text, rest.words, rest.numbers, unit or rest.unit)
    return None


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


def _join(words: Sequence[str]) -> list[str]:
    joined: list[str] = []
    for word in words:
        pair = (joined[-1], word) if joined else ("", word)
        joined[-1:] = [_JOINED[pair]] if pair in _JOINED else [*joined[-1:], word]
    return joined
