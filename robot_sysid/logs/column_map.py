"""Which column of a log is which quantity of which joint.

A column belongs to a joint because its title carries the joint's name (``elbow_effort``), or else
by counting from 0 or 1 (``q1 .. q6``, ``j0_pos ..``). Whatever is decided is said, in one line, by
``ColumnMap.describe``; whatever has two answers is an error that lists both.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from robot_sysid.errors import InputError
from robot_sysid.logs.column_file import ColumnChoices, scaled_title
from robot_sysid.logs.columns import (
    QUANTITIES,
    REMEDY,
    UNITS,
    Found,
    Title,
    commands_as_quantity,
    currents_as_torque,
    joint_kind,
    match_joints,
    read_title,
    two_candidates,
    units_beside_names,
)
from robot_sysid.records import Array


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
        commanded: whether ``torque`` holds commanded positions instead, of a log read for them.
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
    commanded: bool = False

    def groups(self) -> tuple[tuple[Source, ...] | None, ...]:
        """Return the columns of each quantity: position, torque, then what there may be."""
        return (*(self.position, self.torque, self.velocity, self.acceleration, self.joint_time),)

    def sources(self) -> list[Source]:
        """Return all columns: time, where there is one, and the groups."""
        time = [self.time] if self.time else []
        return time + [source for group in self.groups() for source in group or ()]

    def with_torque_factor(self, factor: Array) -> ColumnMap:
        """Return the map with each joint's torque multiplied by a factor (n,)."""
        scaled = zip(self.torque, factor.tolist())
        return replace(self, torque=tuple(replace(s, factor=k * s.factor) for s, k in scaled))

    def describe(self) -> tuple[str, ...]:
        """Return one sentence each about what was taken for what."""
        time = _quoted([self.time]) if self.time else f"row number at {self.rate:g} Hz"
        velocity = _quoted(self.velocity) if self.velocity else "differentiated from position"
        taken = f"log columns: time from {time}; position from {_quoted(self.position)}; velocity "
        taken += f"{'from ' if self.velocity else ''}{velocity}; "
        taken += f"{'command' if self.commanded else 'torque'} from {_quoted(self.torque)}"
        for name, extra in (("acceleration", self.acceleration), ("own time", self.joint_time)):
            taken += f"; {name} from {_quoted(extra)}" if extra else ""
        unused = f"log columns not used: {', '.join(self.unused)}" if self.unused else ""
        return (taken, unused) if unused else (taken,)


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
        joint_names: the n chain joints, base to terminal.
        chosen: what was declared; it outranks the titles.
        first_row: the first row of data (it may hold joint names, as ROS logs do).
        is_slide: (n,) whether a joint is a slide, whose positions are never angles.
        currents: whether columns of motor current stand in for torque, where there are any.
        commanded: whether commanded positions are wanted, and no torque.

    Raises:
        InputError: a quantity is missing, has two candidates, or contradicts the declared units.
    """
    parsed = [read_title(title) for title in titles]
    if currents:
        parsed = currents_as_torque(parsed, len(joint_names))
    if commanded:
        parsed = commands_as_quantity(parsed, joint_names)
    parsed = units_beside_names(parsed, joint_names)
    # What the file names in full need not be recognised, and cannot be ambiguous.
    settled = {k for k, c in chosen.columns.items() if len(c) == len(joint_names)}
    readable = [t if joint_kind(t) not in settled else read_title("") for t in parsed]
    found = match_joints(readable, joint_names, first_row)
    asked, other = ("command", "torque") if commanded else ("torque", "command")
    columns = _Columns(titles, parsed, joint_names, chosen, is_slide, ("position", asked))
    sources = {kind: columns.of_joints(kind, found) for kind in QUANTITIES if kind != other}
    time = columns.time()
    used = {s.index for group in sources.values() if group for s in group}
    used |= {time.index} if time else set()
    unused = tuple(title for index, title in enumerate(titles) if index not in used)
    position, torque = sources["position"], sources[asked]
    if position is None or torque is None:
        raise InputError(f"position and {asked} cannot be left out; {REMEDY}")
    declared = chosen.units.angle is not None or all(parsed[s.index].unit for s in position)
    return ColumnMap(
        time, chosen.rate, position, torque, sources["velocity"], sources["acceleration"],
        sources["joint_time"], unused, declared, commanded,
    )  # fmt: skip


class _Columns:
    """The columns of one log and what was declared of them; finds those of a quantity."""

    def __init__(
        self,
        texts: Sequence[str],
        titles: Sequence[Title],
        joint_names: Sequence[str],
        chosen: ColumnChoices,
        is_slide: Sequence[bool],
        needed: tuple[str, str],
    ) -> None:
        self._titles, self._joints, self._chosen = titles, joint_names, chosen
        self._is_slide, self._needed = is_slide, needed
        self._texts = list(texts)

    def of_joints(self, kind: str, found: Found) -> tuple[Source, ...] | None:
        """Return one source per joint, or None where an optional quantity is not there for all."""
        explicit = self._chosen.columns.get(kind, {})
        if set(explicit.values()) == {"none"}:
            return None
        columns = [
            self._column(kind, name, found.get((kind, joint), []))
            for joint, name in enumerate(self._joints)
        ]
        sources = [self._source(kind, joint, *c) for joint, c in enumerate(columns) if c]
        if len(sources) == len(self._joints):
            return tuple(sources)
        if explicit or kind in self._needed:
            raise self._incomplete(kind)
        return None

    def _column(self, kind: str, joint: str, candidates: Sequence[int]) -> tuple[int, float] | None:
        """Return (column, factor) of one quantity of one joint, or None where there is none."""
        stated = self._chosen.columns.get(kind, {}).get(joint)
        if stated is not None:
            return self._lookup(stated)
        if len(candidates) > 1:
            raise two_candidates(kind, joint, [self._texts[index] for index in candidates])
        return (candidates[0], 1.0) if candidates else None

    def time(self) -> Source | None:
        """Return the time column, or None where a rate stands in for it."""
        if self._chosen.time is not None:
            return self._source("time", 0, *self._lookup(self._chosen.time))
        if self._chosen.rate is not None:
            return None
        found = [i for i, t in enumerate(self._titles) if t.kind == "time" and not t.numbers]
        # ROS: the stamp in the message header is when it was sampled, the other one when received.
        stamped = [i for i in found if "header" in self._titles[i].words]
        found = stamped if len(stamped) == 1 else found
        if len(found) > 1:
            raise two_candidates("time", "", [self._texts[i] for i in found])
        if not found:
            raise InputError(
                f"the log has no time column; {REMEDY} ('time = TITLE', or 'rate = HZ' for evenly "
                f"spaced rows). Columns: {', '.join(self._texts)}"
            )
        return self._source("time", 0, found[0], 1.0)

    def _incomplete(self, kind: str) -> InputError:
        candidates = [title.text for title in self._titles if joint_kind(title) == kind]
        found = f"{len(candidates)} ({', '.join(candidates)})" if candidates else "none"
        commanded = [title.text for title in self._titles if title.commanded]
        hint = f"; commanded columns are not measurements: {commanded[0]}, ..." if commanded else ""
        if kind == "command":
            hint = " (titles such as action, command, q_des or goal_position)"
        currents = [title.text for title in self._titles if title.is_current]
        if kind == "torque" and currents:
            hint += f"; {currents[0]}, ... are motor currents: give --torque-constants to use them"
        elif kind == "torque" and not candidates:
            hint += "; with commanded positions, arm --torque-from position-error needs none"
        return InputError(
            f"the log needs one {kind} column for each of the {len(self._joints)} chain joints "
            f"({', '.join(self._joints)}), found {found}{hint}; {REMEDY}. Columns: "
            f"{', '.join(self._texts)}"
        )

    def _lookup(self, text: str) -> tuple[int, float]:
        """Return (column, factor) of a title in a columns file."""
        title, factor = scaled_title(text, self._texts)
        if re.fullmatch(r"#\d+", title) and title not in self._texts:
            number = int(title[1:])
            if 1 <= number <= len(self._texts):
                return number - 1, factor
        elif self._texts.count(title) == 1:
            return self._texts.index(title), factor
        raise InputError(
            f"the log has no single column {title!r}; its columns are: {', '.join(self._texts)}"
        )

    def _source(self, kind: str, joint: int, index: int, factor: float) -> Source:
        """Return a column with its factor to SI, by its title or else the declared units."""
        title = self._titles[index]
        written = self._written(kind, title)
        declared = self._declared(kind, joint)
        if written is not None and declared is not None and written != declared:
            raise InputError(
                f"column {title.text!r} names a unit that contradicts the declared units; "
                "declare what the column holds, or drop --units"
            )
        unit = written if written is not None else declared if declared is not None else 1.0
        return Source(index, self._texts[index], factor * unit)

    def _written(self, kind: str, title: Title) -> float | None:
        if not title.unit:
            return None
        factor = UNITS["time" if kind == "joint_time" else kind].get(title.unit)
        if factor is None:
            raise InputError(
                f"unit {title.unit!r} of column {title.text!r} is unknown for a {kind}; rename the "
                "column, or scale it with --columns FILE"
            )
        return factor

    def _declared(self, kind: str, joint: int) -> float | None:
        units = self._chosen.units
        if kind in ("time", "joint_time"):
            return None if units.time is None else UNITS["time"][units.time]
        if kind == "torque" or units.angle is None or self._is_slide[joint]:
            return None
        return UNITS["position"][units.angle]


def _quoted(sources: Sequence[Source]) -> str:
    factors = {s.factor for s in sources}
    each = "" if len(factors) > 1 or factors == {1.0} else f" x {factors.pop():.6g}"
    titles = [
        f"'{s.title}'" + (f" x {s.factor:.6g}" if not each and s.factor != 1.0 else "")
        for s in sources
    ]
    return ", ".join(titles) + (f" (each{each})" if each and len(sources) > 1 else each)
