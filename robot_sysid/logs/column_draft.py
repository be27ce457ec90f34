"""Drafts of a columns file, for the user to accept, to complete, or to choose an arm with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from robot_sysid.logs.joint_names import join_names
from robot_sysid.logs.titles import Title, columns_by_joint_name

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

    @property
    def is_open(self) -> bool:
        """Whether the user has to name a column."""
        return BLANK in self.values

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
    task = "Which column is what, guessed. Read it,"
    hints = []
    if any(line.is_open for line in lines):
        task = "Which column is what. Complete the lines with ?,"
        hints = [
            "# rate = 200: samples per second, in place of time, of evenly spaced rows",
            "# units = deg, ms: where they are not rad and s",
        ]
    text = [
        f"# {task} then give this file with --columns.",
        f"# The log's columns: {numbered}",
        f"# One column for each of the joints {', '.join(joint_names)}; #2-{1 + len(joint_names)} "
        "are columns one after the other.",
        *map(str, lines),
        *hints,
    ]
    return "\n".join([*text, ""])


def draft_sets(titles: Sequence[Title], sets: Sequence[Sequence[str]]) -> str:
    """Return a columns file with the columns of the first set of joints, and others in comments.

    Args:
        titles: of all columns of the log.
        sets: for each set the log's names of the arm's joints, base to terminal.
    """
    columns_of = columns_by_joint_name(titles)
    arms = " and ".join(map(join_names, sets))
    lines = [
        f"# The log holds {arms}; this file takes {join_names(sets[0])}.",
        "# To take others, put the # in front of these lines and remove it from theirs.",
    ]
    comment = ""
    for names in sets:
        lines.append(f"# {join_names(names)}:")
        for quantity, columns in columns_of.items():
            numbers = [f"#{columns[name][0] + 1}" for name in names if name in columns]
            if len(numbers) == len(names):
                lines.append(f"{comment}{quantity} = {', '.join(numbers)}")
        comment = "# "
    return "\n".join([*lines, ""])
