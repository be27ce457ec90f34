"""Tables of the rows of params.json, and what they say in words: for console, report and Python.

A row is an entry of ``quantities``. Numbers have as many digits as make two of their error.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import compress
from typing import NamedTuple

from robot_sysid.dynamics.friction import TERMS
from robot_sysid.records.levels import INTERVAL
from robot_sysid.records.messages import (
    Detail,
    aligned_lines,
    number_text,
    percent,
    with_error,
)
from robot_sysid.records.parameters import DELAY, SCALE, TILTS, ZERO
from robot_sysid.records.quantities import (
    BEYOND,
    BEYOND_INERTIA,
    BODY,
    BOUND,
    CENTRAL,
    CURVED,
    DATA,
    DIFFERENCE,
    FILE,
    LEAST_SEEN,
    MODEL,
    MOMENT,
    WRITTEN,
)
from robot_sysid.results.content import Content
from robot_sysid.results.record import PAYLOAD

# Name of a quantity to its label in a table.
_LABELS = {
    each.name: each.label or f"friction {each.name}"
    for each in (*BODY, *TERMS.values(), SCALE, ZERO, DELAY, *TILTS)
}
_LABELS["frictionloss"] = "dry friction"
ORIGIN = (BODY[0].name, *(each.name for each in BODY[10:]))
"""Names of mass, first moments and inertia about the origin of the body's frame."""
HEADINGS = ("", "model", "identified", "±", "unit", "change")
"""Headings of a table, in the order of ``cells``."""
# Cell of a change within ``INTERVAL`` standard errors, which may be none.
_WITHIN = "within 2 ±"
_ASSUMED = "assumed"
_UNKNOWN = "not identifiable"
# Words in a table to what they mean.
_LEGEND = {
    "±": "standard error; the true value is within two of them in 95 of 100 cases",
    _ASSUMED: "the model says more of it than the log",
    "at its bound": "the torques ask for less than can be",
}
# The axis, or two, of a component.
_AXES = re.compile(r"\b[xyz]{1,2}\b")
CURVE_PARTS = ("coulomb", "viscous", "bend")
"""Numbers that together make the friction of a joint that bends with speed."""
MOST_PERCENT = 10.0
"""Largest ratio of a change to the model's value that is stated in percent, 1000 %."""
MOST_CHANGES = 4
"""Number of the largest changes that are named."""
KNOWN = 0.2
"""Relative standard error up to which a mass is known."""


def label(row: Content) -> str:
    """Return what a row is, in words."""
    name = row["name"]
    return _LABELS.get(name, name.replace("_", " "))


def rows_of(content: Content, of: str) -> list[Content]:
    """Return the identified rows of a body or joint."""
    rows = content["quantities"]
    return [
        row for row in rows if row["of"] == of and row["source"] not in (FILE, CURVED)
    ]


def body_rows(content: Content, of: str) -> list[Content]:
    """Return the ten rows of a body: about its centre of mass, or else about its origin.

    What the recordings do not determine is left out but for the mass.
    """
    rows = {row["name"]: row for row in rows_of(content, of)}
    if "Ixx" not in rows:
        return []
    names = CENTRAL if is_shown(rows["com_x"]) else ORIGIN
    mass, *others = (rows[name] for name in names)
    if content["question"] == PAYLOAD or names is CENTRAL:
        others = [row for row in others if is_shown(row)]
    return [mass, *others]


def friction_rows(content: Content, owner: str) -> list[Content]:
    """Return the identified friction and rotor inertia of a joint, or of a motor of several.

    Where it bends with speed, dry and viscous friction and the bend say little apart: the whole
    friction at three speeds takes their place.
    """
    rows = [row for row in rows_of(content, owner) if row["name"] in TERMS]
    curves = [curve for curve in content["curves"] if curve["of"] == owner]
    if not curves:
        return rows
    others = [row for row in rows if row["name"] not in CURVE_PARTS]
    return [*curve_rows(curves[0]), *others]


def curve_rows(curve: Content) -> Iterator[Content]:
    """Yield the friction of a joint at each of its speeds, as rows."""
    columns = ("speeds", "model", "torque", "errors")
    for speed, model, torque, error in zip(*(curve[name] for name in columns)):
        yield {
            "name": f"friction at {speed:.2g} {curve['speed_unit']}",
            "of": curve["of"],
            "unit": curve["unit"],
            "model": model,
            "value": torque,
            "error": error,
            "source": DATA,
            "reason": "",
        }


def is_shown(row: Content) -> bool:
    """Return whether the recordings determine a number at all."""
    return row["source"] != MODEL or row["error"] is not None


class Difference(NamedTuple):
    """How a value differs from the model's.

    Attributes:
        text: in words.
        is_clear: whether it is larger than ``INTERVAL`` standard errors.
        unit: of a number in the text; "" of a percentage.
    """

    text: str
    is_clear: bool
    unit: str = ""


def change(row: Content) -> Difference:
    """Return how a value has changed, with "assumed" where most of it comes from the model."""
    if not is_shown(row):
        return Difference(_UNKNOWN, False)
    if row["source"] == BOUND:
        return Difference("at its bound", False)
    difference = _difference(row)
    if row["source"] != MODEL:
        return difference
    text = f"{difference.text}, {_ASSUMED}" if difference.is_clear else _ASSUMED
    return difference._replace(text=text)


def _difference(row: Content) -> Difference:
    """Return a change as a percentage where that is below 1000 %, else as a number."""
    before, after, error = row["model"], row["value"], row["error"]
    if before is None:
        return Difference("", False)
    difference = after - before
    if abs(difference) <= WRITTEN * abs(before):
        return Difference("none", False)
    if error is not None and abs(difference) <= INTERVAL * error:
        return Difference(_WITHIN, False)
    sign = "+" if difference > 0.0 else ""
    if before * after > 0.0 and abs(difference / before) <= MOST_PERCENT:
        ratio = difference / before
        return Difference(f"{'+' if ratio > 0.0 else ''}{percent(ratio)}", True)
    return Difference(f"{sign}{number_text(difference, error)}", True, row["unit"])


def number_with_error(row: Content) -> str:
    """Return a row's value with its standard error and unit."""
    return with_error(row["value"], row["error"], row["unit"])


def centre_text(rows: Iterable[Content]) -> str:
    """Return a phrase with a centre of mass from its three rows."""
    listed = ", ".join(with_error(row["value"], row["error"]) for row in rows)
    return f"centre of mass [{listed}] m"


def cells(row: Content, title: str = "") -> tuple[str, ...]:
    """Return a row as text, one cell per heading; the first has its label, or another title."""
    error = row["error"]
    before = "" if row["model"] is None else number_text(row["model"], error)
    after = number_text(row["value"], error)
    plus_minus = "" if error is None else number_text(error, error)
    unit = row["unit"]
    return (title or label(row), before, after, plus_minus, unit, change(row).text)


def shown_columns(rows: Iterable[Sequence[str]], title: str) -> list[tuple[str, ...]]:
    """Return headings and rows of cells without empty columns; ``title`` is above the first."""
    columns = zip((title, *HEADINGS[1:]), *rows)
    return list(zip(*(column for column in columns if any(column[1:]))))


def table_lines(rows: Iterable[Sequence[str]], title: str = "") -> list[str]:
    """Return rows of cells as aligned lines under their headings, see ``shown_columns``."""
    lines = aligned_lines(shown_columns(rows, title), HEADINGS[1:4])
    return [f"  {line}" for line in lines]


def legend_lines(lines: Iterable[str]) -> Iterator[str]:
    """Yield one line on what the words in a table's lines mean."""
    text = "\n".join(lines)
    meanings = [f"{word}: {_LEGEND[word]}" for word in _LEGEND if word in text]
    if meanings:
        yield f"  {'; '.join(meanings)}"


def quantity_lines(rows: Sequence[Content], title: str = "") -> Iterator[str]:
    """Yield the table of rows, in which one line names those that say nothing.

    Their own lines are ``Detail``.
    """
    if not rows:
        return
    heading, *lines = table_lines(map(cells, rows), title)
    silent = [*map(says_nothing, rows)]
    yield heading
    for is_silent, line in zip(silent, lines):
        yield Detail(line) if is_silent else line
    small = [row for row in compress(rows, silent) if row["error"]]
    labels = _labels_text(map(label, small))
    if labels:
        yield f"  zero and unchanged within 2 ±: {labels}"
    unknown = _labels_text(label(row) for row in rows if is_unknown(row))
    if unknown:
        yield f"  {_UNKNOWN}: {unknown}"
    shown = [line for is_silent, line in zip(silent, lines) if not is_silent]
    yield from legend_lines((heading, *shown))


def is_unknown(row: Content) -> bool:
    """Return whether the recordings determine nothing of a row, and it is not the mass."""
    return not is_shown(row) and row["name"] != BODY[0].name


def says_nothing(row: Content) -> bool:
    """Return whether a row tells nothing new: zero and no change are within ``INTERVAL`` standard
    errors, or the number is not identified, or bound to what the model says.

    The mass is asked for, so that it says how little is known; so are all numbers of a payload,
    which no model has.
    """
    name, before, error = row["name"], row["model"], row["error"]
    if row["source"] == BOUND:
        return bool(row["value"] == before)
    if is_unknown(row):
        return True
    is_asked = name == BODY[0].name or (before is None and name not in TERMS)
    if is_asked or not error:
        return False
    size = max(abs(row["value"]), abs(row["value"] - (before or 0.0)))
    return bool(size <= INTERVAL * error)


def _labels_text(labels: Iterable[str]) -> str:
    """Return labels in a row; those that differ in their axes only are named once."""
    axes: dict[str, list[str]] = {}
    for each in labels:
        axis = _AXES.search(each)
        form = _AXES.sub("{}", each) if axis else each
        axes.setdefault(form, []).append(axis[0] if axis else "")
    return "; ".join(form.format(", ".join(found)) for form, found in axes.items())


def all_rows(content: Content) -> Iterator[tuple[str, Content]]:
    """Yield every row of links, joints and motors, with its label in a table of them all."""
    for owner in dict.fromkeys(row["of"] for row in content["quantities"]):
        rows = [] if owner == BEYOND else body_rows(content, owner)
        for row in (*rows, *friction_rows(content, owner)):
            yield f"{owner} {label(row)}", row


def beyond_lines(content: Content) -> Iterator[str]:
    """Yield what is on the flange and not in the model; nothing where that is not asked.

    The mass comes with what one log shows far better: mass times distance, and moments of inertia.
    """
    rows = {row["name"]: row for row in rows_of(content, BEYOND)}
    if not rows:
        return
    mass, moment = rows["mass"], rows[MOMENT]
    link = content["body_name"]
    start = "On the flange, not in the model"
    if not is_shown(mass) or moment["error"] is None:
        yield f"{start}: not shown by these torques"
    elif not is_seen(content):
        unseen = number_text(rows[LEAST_SEEN]["value"], mass["error"])
        yield f"{start}: nothing seen (a load under {unseen} kg may not show)"
    elif is_certain(mass) and mass["value"] < 0.0:
        lighter = with_error(-mass["value"], mass["error"], "kg")
        yield f"{start}: nothing; {link} weighs {lighter} less than in the model"
    else:
        about_mass = number_with_error(mass)
        details = [f"mass x distance {number_with_error(moment)}"]
        if not is_certain(mass):
            details.insert(0, about_mass)
            about_mass = "something whose mass is not known"
        moments = [rows[name] for name in BEYOND_INERTIA.values()]
        for text, sign in (("more", 1.0), ("less", -1.0)):
            if any(is_certain(row) and sign * row["value"] > 0.0 for row in moments):
                details.append(f"inertia {text} than the model's")
        yield f"{start}: {about_mass} ({'; '.join(details)})"
        com = [row for name, row in rows.items() if name.startswith("com")]
        yield Detail(f"  {centre_text(com)} in the frame of {link}")


def is_seen(content: Content) -> bool:
    """Return whether all numbers of the last link together say that something is on the flange."""
    return any(
        row["name"] == DIFFERENCE and row["value"] >= 1.0
        for row in rows_of(content, BEYOND)
    )


def is_certain(row: Content) -> bool:
    """Return whether a number that the recordings show is clear of zero by its ±."""
    error = row["error"]
    return error is not None and abs(row["value"]) >= INTERVAL * error


def largest_changes(content: Content) -> Iterator[str]:
    """Yield a line on the masses, friction and rotors that changed most beside their errors."""
    changes = []
    bent = {curve["of"] for curve in content["curves"]}
    for row in content["quantities"]:
        # Parts of friction that bends say little apart.
        is_part = row["of"] in bent and row["name"] in CURVE_PARTS
        names = ("mass", *TERMS)
        is_wanted = row["name"] in names and row["source"] == DATA and row["error"]
        is_wanted = is_wanted and not is_part
        if is_wanted and row["model"] is not None:
            size = abs(row["value"] - row["model"]) / row["error"]
            if size >= INTERVAL:
                difference = change(row)
                text = f"{label(row)} of {row['of']} {difference.text}"
                unit = f" {difference.unit}" if difference.unit else ""
                changes.append((size, f"{text}{unit}"))
    largest = [text for _, text in sorted(changes, reverse=True)[:MOST_CHANGES]]
    if largest:
        yield Detail(f"Changed most, compared with the errors: {', '.join(largest)}")
