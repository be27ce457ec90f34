"""Which column titles speak of which joint: by the joint's name, or else by counting.

Both readings are made. A quantity whose titles carry every joint's name goes by the names; else the
numbers in the titles have to be exactly 0..n-1 or 1..n. Two answers for one quantity are an error.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from robot_sysid.errors import InputError
from robot_sysid.logs.column_titles import Title, name_pieces, without_name, without_written_name

Found = dict[tuple[str, int], list[int]]
"""(quantity, joint number) to the columns that could be it."""

QUANTITIES = ("position", "velocity", "acceleration", "torque", "joint_time")
REMEDY = "name the columns with --columns FILE"


def match_joints(
    titles: Sequence[Title], joint_names: Sequence[str], first_row: Sequence[str] = ()
) -> Found:
    """Return the candidate columns of each quantity of each joint; nothing where it is incomplete.

    Args:
        titles: the log's titles.
        joint_names: the n chain joints.
        first_row: the first row of data, which may list joint names.

    Raises:
        InputError: names and numbers contradict each other, or both offer a column.
    """
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
                raise two_candidates(kind, joint_names[0], [titles[i].text for i in pair])
            found.update({key: named[key] for key in keys})
        elif all(key in counted for key in keys):
            _check_counted(kind, counted, named, titles, joint_names)
            found.update({key: counted[key] for key in keys})
    return found


def joint_kind(title: Title) -> str | None:
    """Return the quantity of a title that belongs to one joint, or None."""
    if title.kind != "time":
        return title.kind
    # A bare "t" beside a joint could as well be its torque or temperature.
    return "joint_time" if set(title.words) & {"time", "stamp", "timestamp"} else None


def two_candidates(kind: str, joint: str, titles: Sequence[str]) -> InputError:
    """Return the error for a quantity that several columns could be."""
    listed = " and ".join(repr(title) for title in titles)
    of_joint = f" of joint {joint}" if joint else ""
    return InputError(f"{listed} could both be the {kind}{of_joint}; {REMEDY} to choose one")


def _by_name(titles: Sequence[Title], joint_names: Sequence[str]) -> Found:
    found: Found = {}
    written = sorted(enumerate(joint_names), key=lambda pair: -len(pair[1]))
    aliases = _aliases(joint_names)
    for index, title in enumerate(titles):
        readings = [(joint, without_written_name(title, name)) for joint, name in written]
        readings += [(joint, without_name(title, alias)) for joint, alias in aliases]
        for joint, rest in readings:
            kind = joint_kind(rest) if rest and not rest.numbers else None
            if kind:
                found.setdefault((kind, joint), []).append(index)
                break
    return found


def _aliases(joint_names: Sequence[str]) -> list[tuple[int, str]]:
    """Return (joint, spelling), longest first; a part all joints share may be left out."""
    full = list(enumerate(joint_names))
    pieces = [name_pieces(name) for name in joint_names]
    shared_start = _shared(pieces)
    shared_end = _shared([p[::-1] for p in pieces])
    short = [" ".join(p[shared_start : len(p) - shared_end]) for p in pieces]
    # A bare number is left to counting, where the base (0 or 1) is checked.
    if len(set(short)) == len(short) > 1 and not any(s.isdigit() or not s for s in short):
        full += list(enumerate(short))
    return sorted(full, key=lambda pair: -len(name_pieces(pair[1])))


def _shared(pieces: Sequence[Sequence[str]]) -> int:
    count = 0
    while all(len(p) > count and p[count] == pieces[0][count] for p in pieces):
        count += 1
    return count


def _by_number(
    titles: Sequence[Title], joint_names: Sequence[str], first_row: Sequence[str], skip: set[int]
) -> Found:
    """Return the reading by counting, leaving out the columns to ``skip``."""
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
        places = order or _counting_order(columns, len(joint_names))
        for number, joint in places.items():
            if number in columns:
                found[kind, joint] = columns[number]
    return found


def _counting_order(columns: Mapping[int, list[int]], n_joints: int) -> dict[int, int]:
    """Return number to joint where the numbers are exactly 0..n-1 or 1..n, else nothing."""
    first = min(columns)
    expected = list(range(first, first + n_joints))
    fits = first in (0, 1) and sorted(columns) == expected
    return {number: joint for joint, number in enumerate(expected)} if fits else {}


def _order_from_names(
    titles: Sequence[Title], joint_names: Sequence[str], first_row: Sequence[str]
) -> dict[int, int]:
    """Return number to joint from a log's own list of names (ROS joint_states: name0, name1, ...).

    ROS publishers may order joints by the alphabet, so counting would be wrong.
    """
    listed: dict[int, str] = {}
    for title, cell in zip(titles, first_row):
        if title.words and title.words[-1] in ("name", "names"):
            cells = re.findall(r"[^\s,'\"\[\]()]+", cell)
            start = title.numbers[0] if title.numbers else 0
            listed.update({start + k: name for k, name in enumerate(cells)})
    return {number: joint_names.index(n) for number, n in listed.items() if n in joint_names}


def _check_counted(
    kind: str,
    counted: Found,
    named: Found,
    titles: Sequence[Title],
    joint_names: Sequence[str],
) -> None:
    """Refuse a count that gives a column to another joint than the one it names."""
    for joint, name in enumerate(joint_names):
        for index in named.get((kind, joint), []):
            if index not in counted[kind, joint]:
                raise InputError(
                    f"column {titles[index].text!r} carries the name of joint {name}, but by "
                    f"counting it belongs to another joint; {REMEDY}"
                )
