"""Which column of a log is which quantity of which joint.

A column belongs to a joint because its title carries the joint's name (``elbow_effort``), or else
by counting from 0 or 1 (``q1 .. q6``, ``j0_pos ..``). Whatever is decided is said, in one line, by
``ColumnMap.describe``; whatever has two answers is an error that lists both.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from robot_sysid.errors import InputError
from robot_sysid.logs.column_file import ColumnChoices, Units, scaled_title
from robot_sysid.logs.columns import (
    QUANTITIES,
    REMEDY,
    Found,
    Title,
    joint_kind,
    match_joints,
    read_title,
    two_candidates,
    unit_factor,
)

_TIME_FACTOR = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


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
        time: the time column, or None where ``rate`` stands in for it.
        rate: samples per second declared for a log without time stamps.
        position, torque: always there.
        velocity, acceleration, joint_time: None where the log has none.
        unused: titles that were not taken for anything.
        angle_declared: whether the unit of angles was declared (option or title), not assumed.
    """

    time: Source | None
    rate: float | None
    position: tuple[Source, ...]
    torque: tuple[Source, ...]
    velocity: tuple[Source, ...] | None
    acceleration: tuple[Source, ...] | None
    joint_time: tuple[Source, ...] | None
    unused: tuple[str, ...]
    angle_declared: bool

    def describe(self) -> tuple[str, ...]:
        """Return one sentence each about what was taken for what."""
        time = _quoted([self.time]) if self.time else f"row number at {self.rate:g} Hz"
        velocity = _quoted(self.velocity) if self.velocity else "differentiated from position"
        taken = f"log columns: time from {time}; position from {_quoted(self.position)}; velocity "
        taken += f"{'from ' if self.velocity else ''}{velocity}; torque from {_quoted(self.torque)}"
        for name, extra in (("acceleration", self.acceleration), ("own time", self.joint_time)):
            taken += f"; {name} from {_quoted(extra)}" if extra else ""
        unused = f"log columns not used: {', '.join(self.unused)}" if self.unused else ""
        return (taken, unused) if unused else (taken,)


def recognise_columns(
    titles: Sequence[str],
    joint_names: Sequence[str],
    choices: ColumnChoices | None = None,
    units: Units | None = None,
    first_row: Sequence[str] = (),
    is_slide: Sequence[bool] = (),
) -> ColumnMap:
    """Find out what each column is.

    Args:
        titles: header cells; "#1", "#2", ... where the file has no header.
        joint_names: the n chain joints, base to terminal.
        choices: what a columns file says; it outranks the titles.
        units: declared units.
        first_row: the first row of data (it may hold joint names, as ROS logs do).
        is_slide: (n,) whether a joint is a slide, whose positions are never angles.

    Raises:
        InputError: a quantity is missing, has two candidates, or contradicts the declared units.
    """
    chosen = choices or ColumnChoices()
    declared = units or chosen.units
    parsed = [read_title(title) for title in titles]
    # What the file names in full need not be recognised, and cannot be ambiguous.
    settled = {k for k, c in chosen.columns.items() if len(c) == len(joint_names)}
    readable = [t if joint_kind(t) not in settled else read_title("") for t in parsed]
    found = match_joints(readable, joint_names, first_row)
    converter = _Converter(parsed, declared, list(is_slide) or [False] * len(joint_names))
    sources = {
        kind: _sources(kind, found, titles, joint_names, chosen, converter) for kind in QUANTITIES
    }
    time = _time_source(parsed, chosen, converter)
    used = {s.index for group in sources.values() if group for s in group}
    used |= {time.index} if time else set()
    unused = tuple(title for index, title in enumerate(titles) if index not in used)
    position, torque = sources["position"], sources["torque"]
    if position is None or torque is None:
        raise InputError(f"position and torque cannot be left out; {REMEDY}")
    angle_declared = declared.angle is not None or all(parsed[s.index].unit for s in position)
    return ColumnMap(
        time, chosen.rate, position, torque, sources["velocity"], sources["acceleration"],
        sources["joint_time"], unused, angle_declared,
    )  # fmt: skip


def _sources(
    kind: str,
    found: Found,
    titles: Sequence[str],
    joint_names: Sequence[str],
    chosen: ColumnChoices,
    converter: _Converter,
) -> tuple[Source, ...] | None:
    """Return one source per joint, or None where an optional quantity is not there for all."""
    explicit = chosen.columns.get(kind, {})
    if set(explicit.values()) == {"none"}:
        return None
    sources = []
    for joint, name in enumerate(joint_names):
        column = _column(kind, name, explicit.get(name), found.get((kind, joint), []), titles)
        if column:
            sources.append(converter.source(kind, joint, *column))
    if len(sources) == len(joint_names):
        return tuple(sources)
    if explicit or kind in ("position", "torque"):
        raise _incomplete(kind, [read_title(title) for title in titles], joint_names)
    return None


def _column(
    kind: str, joint: str, explicit: str | None, candidates: Sequence[int], titles: Sequence[str]
) -> tuple[int, float] | None:
    """Return (column, factor) of one quantity of one joint."""
    if explicit is not None:
        return _lookup(explicit, titles)
    if len(candidates) > 1:
        raise two_candidates(kind, joint, [titles[index] for index in candidates])
    return (candidates[0], 1.0) if candidates else None


def _incomplete(kind: str, titles: Sequence[Title], joint_names: Sequence[str]) -> InputError:
    candidates = [title.text for title in titles if joint_kind(title) == kind]
    found = f"{len(candidates)} ({', '.join(candidates)})" if candidates else "none"
    commanded = [title.text for title in titles if title.commanded]
    hint = f"; commanded columns are not measurements: {commanded[0]}, ..." if commanded else ""
    listed = ", ".join(title.text for title in titles)
    return InputError(
        f"the log needs one {kind} column for each of the {len(joint_names)} chain joints "
        f"({', '.join(joint_names)}), found {found}{hint}; {REMEDY}. Columns: {listed}"
    )


def _lookup(text: str, titles: Sequence[str]) -> tuple[int, float]:
    title, factor = scaled_title(text, titles)
    if re.fullmatch(r"#\d+", title) and title not in titles:
        number = int(title[1:])
        if 1 <= number <= len(titles):
            return number - 1, factor
    elif list(titles).count(title) == 1:
        return list(titles).index(title), factor
    raise InputError(
        f"the log has no single column {title!r}; its columns are: {', '.join(titles)}"
    )


def _time_source(
    titles: Sequence[Title], chosen: ColumnChoices, converter: _Converter
) -> Source | None:
    if chosen.time is not None:
        return converter.source("time", 0, *_lookup(chosen.time, [t.text for t in titles]))
    if chosen.rate is not None:
        return None
    found = [i for i, t in enumerate(titles) if t.kind == "time" and not t.numbers]
    # ROS: the stamp in the message header is when it was sampled, the other one when received.
    stamped = [i for i in found if "header" in titles[i].words]
    found = stamped if len(stamped) == 1 else found
    if len(found) > 1:
        raise two_candidates("time", "", [titles[i].text for i in found])
    if not found:
        listed = ", ".join(title.text for title in titles)
        raise InputError(
            f"the log has no time column; {REMEDY} ('time = TITLE', or 'rate = HZ' for evenly "
            f"spaced rows). Columns: {listed}"
        )
    return converter.source("time", 0, found[0], 1.0)


class _Converter:
    """Knows the factor to SI of each column, from its title and the declared units."""

    def __init__(self, titles: Sequence[Title], units: Units, is_slide: Sequence[bool]) -> None:
        self._titles = titles
        self._units = units
        self._is_slide = is_slide

    def source(self, kind: str, joint: int, index: int, factor: float) -> Source:
        title = self._titles[index]
        written = self._written(kind, title)
        declared = self._declared(kind, joint)
        if written is not None and declared is not None and written != declared:
            raise InputError(
                f"column {title.text!r} names a unit that contradicts the declared units; "
                "declare what the column holds, or drop --units"
            )
        unit = written if written is not None else declared if declared is not None else 1.0
        return Source(index, title.text, factor * unit)

    def _written(self, kind: str, title: Title) -> float | None:
        if not title.unit:
            return None
        factor = unit_factor("time" if kind == "joint_time" else kind, title.unit)
        if factor is None:
            raise InputError(
                f"unit {title.unit!r} of column {title.text!r} is unknown for a {kind}; rename the "
                "column, or scale it with --columns FILE"
            )
        return factor

    def _declared(self, kind: str, joint: int) -> float | None:
        if kind in ("time", "joint_time"):
            return None if self._units.time is None else _TIME_FACTOR[self._units.time]
        if kind == "torque" or self._units.angle is None or self._is_slide[joint]:
            return None
        return math.pi / 180 if self._units.angle == "deg" else 1.0


def _quoted(sources: Sequence[Source]) -> str:
    factors = {s.factor for s in sources}
    each = "" if len(factors) > 1 or factors == {1.0} else f" x {factors.pop():.6g}"
    titles = [
        f"'{s.title}'" + (f" x {s.factor:.6g}" if not each and s.factor != 1.0 else "")
        for s in sources
    ]
    return ", ".join(titles) + (f" (each{each})" if each and len(sources) > 1 else each)
