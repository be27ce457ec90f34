"""The draft of a columns file for a log with several arms, to choose one of them."""

from __future__ import annotations

from collections.abc import Sequence

from robot_sysid.logs.joint_names import join_names
from robot_sysid.logs.titles import Title, columns_by_joint_name


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
