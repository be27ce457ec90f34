"""The draft of a columns file, for the user to accept or complete."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

BLANK = "?"
"""Placeholder in a draft for a column that the user has to name."""


@dataclass(frozen=True)
class DraftLine:
    """A line of a columns file for the user to accept or complete.

    Attributes:
        key: "time", "rate", "units" or a quantity.
        values: columns such as "#3" or "-#3", or other values; "?" for what is not known.
        reason: why, or what the columns could be, for the comment behind the values.
    """

    key: str
    values: tuple[str, ...]
    reason: str

    def __str__(self) -> str:
        return f"{self.key} = {', '.join(join_ranges(self.values))}  # {self.reason}"


def join_ranges(columns: Sequence[str]) -> list[str]:
    """Return columns with "#2-4" in the place of "#2", "#3", "#4"."""
    joined: list[str] = []
    first = 0
    for k, column in enumerate(columns, 1):
        following = columns[k] if k < len(columns) else ""
        number = column[1:]
        if number.isdigit() and following == f"#{int(number) + 1}":
            continue
        is_range = k - first > 2
        joined += [f"{columns[first]}-{number}"] if is_range else columns[first:k]
        first = k
    return joined


def draft(
    titles: Sequence[str], joint_names: Sequence[str], lines: Sequence[DraftLine]
) -> str:
    """Return a columns file for the user to accept or complete.

    Args:
        titles: of all columns of the log.
        joint_names: (n,) of the chain, base to terminal.
        lines: what is known of the columns.
    """
    # Titles on one line, by their numbers; numbers stand in the place of missing titles.
    numbered = ", ".join(
        f"#{k} {' '.join(title.split())}" for k, title in enumerate(titles, 1)
    )
    if titles[:1] == ("#1",):
        numbered = f"#1 to #{len(titles)}, without titles"
    text = [
        "# Which column is what, guessed. Read it, then give this file with --columns."
    ]
    if any(BLANK in line.values for line in lines):
        text[0] = (
            "# Which column is what. Complete the lines with ?, then give this file with "
        )
        text[0] += "--columns."
    text += [
        f"# The log's columns: {numbered}",
        f"# One column for each of the joints {', '.join(joint_names)}; #2-{1 + len(joint_names)} "
        "are columns one after the other.",
        *map(str, lines),
    ]
    if any(BLANK in line.values for line in lines):
        text.append(
            "# rate = 200: samples per second, in place of time, of evenly spaced rows"
        )
        text.append("# units = deg, ms: where they are not rad and s")
    return "\n".join([*text, ""])
