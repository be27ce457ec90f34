"""Which column of a log is which quantity of which joint, by its title or by a columns file.

A column belongs to a joint because its title carries the joint's name (``elbow_effort``), or else
by counting from 0 or 1 (``q1 .. q6``, ``j0_pos ..``). Whatever is decided is said, in one line, by
``ColumnMap.describe``; whatever has two answers is an error that lists both.

The file behind ``--columns`` says what titles do not tell, in lines of ``key = value``::

    # lines starting with # are comments
    time = Zeit
    units = deg, ms
    position = A1, A2, A3          one title per chain joint, base to terminal
    torque.joint1 = M1
    torque.joint2 = -M2            a minus flips the sign
    torque.joint3 = 0.95 * I3      a number scales
    velocity = none                keep a quantity out

Keys: time, position, velocity, acceleration (which nothing is made of), torque, joint_time (a time
stamp of each joint's own), command (position a servo is asked for), units (rad, deg; s, ms, us, ns)
and rate (samples per second, for a log without a time column). ``#3`` is the third column, for a
log without titles, and ``#3-9`` are seven of them. Where columns cannot be recognised, a ``draft``
of such a file says what could.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

from robot_sysid.errors import ColumnsError, InputError
from robot_sysid.logs import titles as naming
from robot_sysid.records import Array

_KEYS = ("time", *naming.QUANTITIES, "acceleration", "units", "rate")
_SCALED = re.compile(
    r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,2})?)\s*\*\s*(.+)", re.ASCII
)
_ANGLES = ("rad", "deg")
_LONGEST = 1_000_000
"""Characters of a columns file that are read: 10 000 long lines."""
_TIMES = ("s", "ms", "us", "ns")
_OPEN = "?"
"""Stands in a draft for a column that is to be named."""


@dataclass(frozen=True)
class ColumnChoices:
    """What is declared of a log's columns, by the keys of a columns file; None leaves it open.

    The columns are quantity to joint name to title; "none" keeps a quantity out.
    """

    time: str | None = None
    columns: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    angle_unit: str | None = None
    time_unit: str | None = None
    rate: float | None = None

    def over(self, known: ColumnChoices) -> ColumnChoices:
        """Return these choices, and what is known otherwise where they say nothing."""
        return ColumnChoices(
            self.time or known.time,
            {**known.columns, **self.columns},
            self.angle_unit or known.angle_unit,
            self.time_unit or known.time_unit,
            self.rate or (None if self.time else known.rate),
        )


def parse_units(text: str) -> ColumnChoices:
    """Return the units of a list with commas or blanks such as "deg,ms", or raise InputError."""
    words = re.findall(r"[^,\s]+", text)
    angles, times = ([w for w in words if w in known] for known in (_ANGLES, _TIMES))
    if not words or len(words) > len(angles[:1] + times[:1]):
        known = f"one of {', '.join(_ANGLES)} and one of {', '.join(_TIMES)}"
        raise InputError(
            f"units {text!r} are not understood; give at most {known}, as in 'deg,ms'"
        )
    return ColumnChoices(
        angle_unit=next(iter(angles), None), time_unit=next(iter(times), None)
    )


def read_columns_file(path: Path, joint_names: Sequence[str]) -> ColumnChoices:
    """Read a columns file; InputError where a key, joint, unit or number in it is unknown."""
    try:
        with path.open(encoding="utf-8-sig") as stream:
            text = stream.read(_LONGEST)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the columns file {path}: {error}") from error
    entries: dict[str, str] = {}
    columns: dict[str, dict[str, str]] = {}
    for number, line in enumerate(
        text.split("\n"), start=1
    ):  # titles may hold other line ends
        # A blank before the mark makes a remark of the rest; without one it is column "#3".
        content = re.sub(r"(^|\s)#(?!\d).*", "", line).strip()
        if not content:
            continue
        key, equals, value = (part.strip() for part in content.partition("="))
        if not equals or not value or key in entries:
            raise InputError(
                f"{path} line {number}: expected one 'key = value' per key: {line!r}"
            )
        if _OPEN in re.split(r"[,\s]+", value):
            raise InputError(
                f"{path} line {number}: put the log's columns in the place of ?"
            )
        quantity, _, joint = key.partition(".")
        if quantity not in _KEYS:
            raise InputError(
                f"{path}: unknown key {key!r}; valid keys: {', '.join(_KEYS)}"
            )
        entries[key] = value
        if quantity in naming.QUANTITIES:
            chosen = _per_joint(path, quantity, joint, value, joint_names)
            columns.setdefault(quantity, {}).update(chosen)
    units = parse_units(entries["units"]) if "units" in entries else ColumnChoices()
    rate = _rate(path, entries["rate"]) if "rate" in entries else None
    return replace(units, time=entries.get("time"), columns=columns, rate=rate)


def _per_joint(
    path: Path, quantity: str, joint: str, value: str, joint_names: Sequence[str]
) -> dict[str, str]:
    """Return joint to title, of a line about one joint or with a list for all."""
    if joint and joint not in joint_names:
        known = f"the chain's joints are {', '.join(joint_names)}"
        raise InputError(
            f"{path}: {quantity}.{joint} names the unknown joint {joint!r}; {known}"
        )
    if joint or value == "none":
        return dict.fromkeys([joint] if joint else joint_names, value)
    titles = [each for title in value.split(",") for each in _counted(title.strip())]
    if len(titles) != len(joint_names):
        chain_has = f"the chain has {len(joint_names)} joints: {', '.join(joint_names)}"
        raise InputError(f"{path}: {quantity} lists {len(titles)} columns, {chain_has}")
    return dict(zip(joint_names, titles))


def _counted(title: str) -> list[str]:
    """Return the columns "#2", "#3", ... of a range "#2-8", or the one of a title."""
    found = re.fullmatch(r"#(\d{1,5})\s*-\s*#?(\d{1,5})", title)
    if not found:
        return [title]
    first = int(found[1])
    last = int(found[2])
    step = 1 if last >= first else -1
    return [f"#{number}" for number in range(first, last + step, step)]


def _rate(path: Path, value: str) -> float:
    with contextlib.suppress(ValueError):
        if 0.0 < float(value) < math.inf:
            return float(value)
    raise InputError(
        f"{path}: rate must be a positive number of samples per second: {value!r}"
    )


@dataclass(frozen=True)
class Source:
    """One column of the file and the factor that turns it into SI units."""

    index: int
    title: str
    factor: float


@dataclass(frozen=True)
class ColumnMap:
    """Where each quantity comes from; one Source per chain joint, base to terminal.

    Attributes:
        rate: samples per second of a log without time stamps.
        angle_declared: whether the unit of angles was declared (option or title), not assumed.
        commanded: whether ``torque`` holds commanded positions instead, of a log read for them.
    """

    time: Source | None
    rate: float | None
    position: tuple[Source, ...]
    torque: tuple[Source, ...]
    velocity: tuple[Source, ...] | None
    joint_time: tuple[Source, ...] | None
    unused: tuple[str, ...]
    angle_declared: bool
    commanded: bool = False

    def groups(self) -> tuple[tuple[Source, ...], ...]:
        """Return the columns of each quantity: position, torque, then what there may be."""
        return self.position, self.torque, self.velocity or (), self.joint_time or ()

    def sources(self) -> list[Source]:
        """Return all columns: time, where there is one, and the groups."""
        return [
            *([self.time] if self.time else ()),
            *chain.from_iterable(self.groups()),
        ]

    def with_torque_factor(self, factor: Array) -> ColumnMap:
        """Return the map with each joint's torque multiplied by a factor (n,)."""
        scaled = zip(self.torque, factor.tolist())
        return replace(
            self, torque=tuple(replace(s, factor=k * s.factor) for s, k in scaled)
        )

    def describe(self) -> tuple[str, ...]:
        """Return one sentence each about what was taken for what."""
        time = _quoted([self.time]) if self.time else f"row number at {self.rate:g} Hz"
        velocity = (
            _quoted(self.velocity) if self.velocity else "differentiated from position"
        )
        taken = f"log columns: time from {time}; position from {_quoted(self.position)}; velocity "
        taken += f"{'from ' if self.velocity else ''}{velocity}; "
        taken += (
            f"{'command' if self.commanded else 'torque'} from {_quoted(self.torque)}"
        )
        taken += (
            f"; own time from {_quoted(self.joint_time)}" if self.joint_time else ""
        )
        return (
            taken,
            *(
                [f"log columns not used: {', '.join(self.unused)}"]
                if self.unused
                else ()
            ),
        )


def draft(
    titles: Sequence[str],
    joint_names: Sequence[str],
    asked: str = "torque",
    known: Mapping[str, Sequence[Source] | None] | None = None,
) -> str:
    """Return a columns file to complete: what is known, quantity to its columns, and ? for what was
    not recognised of positions and of what is asked for beside, "torque" or "command".
    """
    listed = ", ".join(
        f"#{k} {' '.join(title.split())}" for k, title in enumerate(titles, 1)
    )
    lines = [
        "# Which column is what. Complete the lines with ?, then give this file with --columns.",
        f"# The log's columns: {listed}",
        f"# One column for each of the joints {', '.join(joint_names)}; #2-{1 + len(joint_names)} "
        "are columns one after the other.",
    ]
    for kind in ("time", "position", "velocity", asked):
        found = (known or {}).get(kind)
        joints = 1 if kind == "time" else len(joint_names)
        columns = [f"#{each.index + 1}" for each in found or ()]
        if found or kind != "velocity":
            lines.append(f"{kind} = {', '.join(columns or [_OPEN] * joints)}")
    hints = [
        "# rate = 200: samples per second, in place of time, of evenly spaced rows"
    ]
    return "\n".join(
        [*lines, *hints, "# units = deg, ms: where they are not rad and s", ""]
    )


def recognise_columns(
    titles: Sequence[str],
    joint_names: Sequence[str],
    chosen: ColumnChoices,
    first_row: Sequence[str],
    is_slide: Sequence[bool],
    currents: bool = False,
    commanded: bool = False,
) -> ColumnMap:
    """Find out what each column is.

    Args:
        titles: header cells; "#1", "#2", ... where the file has no header.
        chosen: what was declared; it outranks the titles.
        first_row: the first row of data (it may hold joint names, as ROS logs do).
        is_slide: (n,) whether a joint is a slide, whose positions are never angles.
        currents, commanded: as in ``columns.with_meaning``.

    Raises:
        ColumnsError: a quantity is missing, has two candidates, or contradicts the declared units.
    """
    plain = [naming.read_title(title) for title in titles]
    parsed = naming.with_meaning(plain, joint_names, currents, commanded)
    columns = _Columns(list(titles), parsed, joint_names, chosen, is_slide, commanded)
    known: dict[str, Sequence[Source] | None] = {}
    try:
        return columns.recognised(first_row, known)
    except InputError as error:
        is_declared = chosen.columns or chosen.time or chosen.rate
        text = "" if is_declared else draft(titles, joint_names, columns.asked, known)
        raise ColumnsError(str(error), text) from None


@dataclass(frozen=True)
class _Columns:
    """The columns of one log and what was declared of them; finds those of a quantity."""

    _texts: list[str]
    _titles: Sequence[naming.Title]
    _joints: Sequence[str]
    _chosen: ColumnChoices
    _is_slide: Sequence[bool]
    _commanded: bool

    @property
    def asked(self) -> str:
        """What is needed beside positions."""
        return "command" if self._commanded else "torque"

    def recognised(
        self, first_row: Sequence[str], known: dict[str, Sequence[Source] | None]
    ) -> ColumnMap:
        """Return the map, or raise InputError; what is recognised is noted as known."""
        declared = self._chosen.columns
        count = len(self._joints)
        # What the file names in full need not be recognised, and cannot be ambiguous.
        settled = {kind for kind, columns in declared.items() if len(columns) == count}
        nothing = naming.read_title("")
        kinds = [naming.joint_kind(t) for t in self._titles]
        readable = [
            nothing if kind in settled else t for t, kind in zip(self._titles, kinds)
        ]
        found = naming.match_joints(readable, self._joints, first_row)
        faults = list[str]()
        time = None
        sources: dict[str, tuple[Source, ...] | None] = {}
        other = "torque" if self._commanded else "command"
        for kind in (kind for kind in naming.QUANTITIES if kind != other):
            with naming.collected(faults):
                sources[kind] = self.of_joints(kind, found)
        with naming.collected(faults):
            time = self.time(found)
        known.update(sources, time=[time] if time else None)
        if faults:
            raise InputError(f"{'; '.join(faults)}. Columns: {', '.join(self._texts)}")
        used = {
            s.index for group in (*sources.values(), [time]) for s in group or () if s
        }
        unused = tuple(
            text for index, text in enumerate(self._texts) if index not in used
        )
        position = sources["position"]
        torque = sources[self.asked]
        if position is None or torque is None:
            raise InputError(
                f"position and {self.asked} cannot be left out; {naming.REMEDY}"
            )
        has_unit = self._chosen.angle_unit or all(
            self._titles[s.index].unit for s in position
        )
        return ColumnMap(
            time, self._chosen.rate, position, torque, sources["velocity"], sources["joint_time"],
            unused, bool(has_unit), self._commanded,
        )  # fmt: skip

    def of_joints(self, kind: str, found: naming.Found) -> tuple[Source, ...] | None:
        """Return one source per joint, or None where an optional quantity is not there for all."""
        explicit = self._chosen.columns.get(kind, {})
        if set(explicit.values()) == {"none"}:
            return None
        sources = []
        for joint, name in enumerate(self._joints):
            places = [(index, 1.0) for index in found.get((kind, joint), ())]
            places = [self._lookup(explicit[name])] if name in explicit else places
            if len(places) > 1:
                raise naming.two_candidates(
                    kind, name, [self._texts[i] for i, _ in places]
                )
            sources += [self._source(kind, joint, *place) for place in places]
        if len(sources) == len(self._joints):
            return tuple(sources)
        if explicit or kind in ("position", self.asked):
            raise self._incomplete(kind)
        return None

    def time(self, of_joints: naming.Found) -> Source | None:
        """Return the time column, or None where a rate stands in for it."""
        if self._chosen.time is not None:
            return self._source("time", 0, *self._lookup(self._chosen.time))
        if self._chosen.rate is not None:
            return None
        own = {
            i
            for key, found in of_joints.items()
            if key[0] == "joint_time"
            for i in found
        }
        times = [
            i for i, t in enumerate(self._titles) if t.kind == "time" and not t.numbers
        ]
        found = [i for i in times if i not in own]
        # ROS: the stamp in the message header is when it was sampled, the other one when received.
        stamped = [i for i in found if "header" in self._titles[i].words]
        found = stamped if len(stamped) == 1 else found
        if len(found) > 1:
            raise naming.two_candidates("time", "", [self._texts[i] for i in found])
        if not found:
            raise InputError(
                f"the log has no time column; {naming.REMEDY} ('time = TITLE', or 'rate = HZ' for "
                "evenly spaced rows)"
            )
        return self._source("time", 0, found[0], 1.0)

    def _incomplete(self, kind: str) -> InputError:
        candidates = [
            title.text for title in self._titles if naming.joint_kind(title) == kind
        ]
        found = f"{len(candidates)} ({', '.join(candidates)})" if candidates else "none"
        commanded = [
            t.text for t in self._titles if t.commanded and t.stands_for != "command"
        ]
        hint = (
            f"; commanded columns are not measurements: {commanded[0]}, ..."
            if commanded
            else ""
        )
        currents = [
            t.text for t in self._titles if t.is_current and t.stands_for is None
        ]
        if kind == "command":
            hint = " (titles such as action, command, q_des or goal_position)"
        elif kind == "torque" and currents:
            hint += f"; {currents[0]}, ... are motor currents: give --torque-constants to use them"
        elif kind == "torque" and not candidates:
            hint += "; with commanded positions, identify --torque-from position-error needs none"
        return InputError(
            f"the log needs one {kind} column for each of the {len(self._joints)} chain joints "
            f"({', '.join(self._joints)}), found {found}{hint}; {naming.REMEDY}"
        )

    def _lookup(self, text: str) -> tuple[int, float]:
        """Return (column, factor) of "title", "-title" or "0.5 * title" in a columns file."""
        title = text
        factor = 1.0
        scaled = _SCALED.fullmatch(text)
        if text not in self._texts and scaled:
            title = scaled.group(2).strip()
            factor = float(scaled.group(1))
        elif text not in self._texts and text.startswith("-"):
            title = text[1:].strip()
            factor = -1.0
        texts = self._texts
        if re.fullmatch(r"#\d+", title) and title not in texts:
            texts = [f"#{k + 1}" for k in range(len(texts))]
        if texts.count(title) == 1:
            return texts.index(title), factor
        raise InputError(
            f"the log has no single column {title!r}; name one that there is once"
        )

    def _source(self, kind: str, joint: int, index: int, factor: float) -> Source:
        """Return a column with its factor to SI, by its title or else the declared units."""
        title = self._titles[index]
        chosen = self._chosen
        is_time = kind in ("time", "joint_time")
        known = naming.UNITS["time" if is_time else kind]
        is_angle = kind != "torque" and not self._is_slide[joint]
        unit = chosen.time_unit if is_time else chosen.angle_unit if is_angle else None
        declared = (
            None
            if unit is None
            else naming.UNITS["time" if is_time else "position"][unit]
        )
        written = known.get(title.unit) if title.unit else declared
        if written is None and title.unit:
            fault = (
                f"unit {title.unit!r} of column {title.text!r} is unknown for a {kind}"
            )
            raise InputError(
                f"{fault}; rename the column, or scale it with --columns FILE"
            )
        if declared is not None and written != declared:
            fault = f"column {title.text!r} names a unit that contradicts the declared units"
            raise InputError(f"{fault}; declare what the column holds, or rename it")
        return Source(
            index, self._texts[index], factor * (1.0 if written is None else written)
        )


def _quoted(sources: Sequence[Source]) -> str:
    scaled = ["" if s.factor == 1.0 else f" x {s.factor:.6g}" for s in sources]
    if len({s.factor for s in sources}) > 1 or len(sources) == 1:
        return ", ".join(f"'{s.title}'{by}" for s, by in zip(sources, scaled))
    return ", ".join(f"'{s.title}'" for s in sources) + (
        scaled[0] and f" (each{scaled[0]})"
    )
