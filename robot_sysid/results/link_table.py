"""Tables with one row per link or joint: every identified number of the arm with its ±."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from robot_sysid.records.messages import (
    aligned_lines,
    number_text,
    term_unit,
    with_error,
)
from robot_sysid.results.parameter_table import BeforeAfter, central_rows, table_lines
from robot_sysid.results.record import HELD_NOTE, JointEstimate, Quantity, Result
from robot_sysid.results.verdict import PRIOR_SHARE

_LINE_WIDTH = 98
"""Largest number of characters in a line of a table, without its indentation."""
_UNKNOWN = "unidentifiable"
"""Cell of a number that the data does not determine."""
FILE_REASON = "{} has the numbers that predict held-out torques best"
"""Why masses in the written file differ from the table, with the name of that file."""
_TERM_HEADINGS = {
    "coulomb": "Coulomb",
    "armature": "rotor inertia",
    "stribeck": "Stribeck",
}
"""Friction term to its name in a heading, where that is not the term's own."""


def file_masses(result: Result) -> dict[str, str]:
    """Return link to its mass in the written file as text [kg], where it is not the table's.

    Both are compared as they are printed. Empty where no file is fitted or written.
    """
    file = result.written_file
    if file is None:
        return {}
    masses = {}
    written = dict(zip(result.robot.joint_names, file.thetas[:, 0].tolist()))
    for body in result.links.values():
        identified = Quantity(body.mass, float(body.errors[0]))
        text = _file_text(written[str(body.joint)], identified)
        if text:
            masses[body.name] = text
    return masses


def _file_text(value: float, identified: Quantity) -> str:
    """Return a number of the written file as text, "" where it prints as the identified one."""
    text = number_text(value, identified.error)
    return "" if text == number_text(*identified) else text


def link_lines(result: Result) -> Iterator[str]:
    """Yield mass, centre of mass and inertia of each link, and friction of each joint, with ±."""
    mass_rows = []
    coms = []
    inertias = []
    for body in result.links.values():
        mass_row, *rows = central_rows(body)
        mass_rows.append(replace(mass_row, name=body.name))
        coms.append([body.name, *_value_cells(rows[:3], count=3)])
        inertias.append([body.name, *_value_cells(rows[3:], count=6)])
    mass_lines = table_lines(mass_rows, "Mass")
    masses = file_masses(result)
    if masses:
        cells = ["in the file", *(masses.get(row.name, "") for row in mass_rows)]
        mass_lines = aligned_lines(zip(mass_lines, cells), cells[:1])
        mass_lines.append(f"  in the file: {FILE_REASON.format(result.model_name)}")
    yield from mass_lines
    yield from _wide_lines(["Centre of mass [m]", "x", "y", "z"], coms)
    headings = ["Inertia about CoM [kg·m²]", "xx", "xy", "xz", "yy", "yz", "zz"]
    yield from _wide_lines(headings, inertias)
    has_prior = any("(" in cell for row in (*coms, *inertias) for cell in row[1:])
    if has_prior:
        yield "  (...): more than half of the value comes from the prior, not from the data"
    yield from joint_lines(result)


def joint_lines(result: Result) -> Iterator[str]:
    """Yield friction and rotor inertia of each joint and of each motor that turns several joints.

    Terms that the model has are stated as model -> identified.
    """
    owners = dict(result.joints)
    for name, motor in result.couplings.items():
        owners[f"motor that turns with {name}"] = motor
    written = {} if result.written_file is None else result.written_file.joints
    terms_of_owners = [list(joint.terms) for joint in owners.values()]
    for file_terms in written.values():
        terms_of_owners.append(
            [name for name, term in file_terms.items() if term.value]
        )
    terms = list(dict.fromkeys(itertools.chain(*terms_of_owners)))
    if not terms:
        return
    slides = result.robot.slides
    headings = ["Friction"]
    for term in terms:
        units = {term_unit(term, name in slides) for name in owners}
        name = _TERM_HEADINGS.get(term, term)
        unit = " or ".join(sorted(units))
        headings.append(f"{name} [{unit}]" if unit else name)
    rows = []
    for name, joint in owners.items():
        rows.append([name, *(_term_cell(term, joint) for term in terms)])
        if name in written:
            cells = [_file_cell(term, joint, written[name]) for term in terms]
            rows.append(["  in the file", *cells])
    yield from _wide_lines(headings, rows)
    if any("(held)" in cell for row in rows for cell in row):
        yield f"  {HELD_NOTE}"


def _value_cells(rows: Sequence[BeforeAfter], count: int) -> list[str]:
    """Return "value ± error" of each row, in parentheses where the prior outweighs the data.

    Args:
        rows: of a centre of mass or an inertia; none where it is not identifiable.
        count: number of cells where there are no rows.
    """
    if not rows:
        return [_UNKNOWN] * count
    cells = []
    for row in rows:
        text = with_error(row.after, row.error)
        cells.append(f"({text})" if row.share < PRIOR_SHARE else text)
    return cells


def _term_cell(term: str, joint: JointEstimate) -> str:
    """Return a friction term of a joint, such as "0.4 -> 0.133 ± 0.004"; "" without the term."""
    if term not in joint.terms:
        return ""
    quantity = joint.terms[term]
    if math.isinf(quantity.error):
        return _UNKNOWN
    prior = joint.model_terms.get(term)
    start = "" if prior is None else f"{number_text(prior)} -> "
    return f"{start}{quantity.text}"


def _file_cell(term: str, joint: JointEstimate, written: Mapping[str, Quantity]) -> str:
    """Return a friction term of the written file, "" where it is as in the table or missing."""
    if term not in written:
        return ""
    value = written[term].value
    if term not in joint.terms:
        return number_text(value)
    return _file_text(value, joint.terms[term])


def _wide_lines(
    headings: Sequence[str], rows: Sequence[Sequence[str]]
) -> Iterator[str]:
    """Yield a table as lines; columns that do not fit into a line follow in a table below it.

    Args:
        headings: of the columns; the first column, of names, is in every table.
        rows: cells, as many per row as headings; a row without entries is left out of a table.
    """
    names, *columns = zip(headings, *rows)
    table_columns = [names]
    for column in columns:
        lines = aligned_lines(zip(*table_columns, column))
        if len(table_columns) > 1 and max(map(len, lines)) > _LINE_WIDTH:
            yield from _filled_lines(table_columns)
            table_columns = [names]
        table_columns.append(column)
    yield from _filled_lines(table_columns)


def _filled_lines(columns: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield a table of columns, headings first, as lines, without rows that have no entries."""
    rows = [row for row in zip(*columns) if any(row[1:])]
    yield from map("  {}".format, aligned_lines(rows))
