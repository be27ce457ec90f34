"""Titles of columns that a recording keeps by the names of joints."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence


def model_names(names: Sequence[str], joint_names: Sequence[str]) -> Mapping[str, str]:
    """Return the recording's name to the model's, for joints that only differ in a prefix.

    ``fr3_joint1`` is ``joint1`` where no other name ends in it; upper case and underscores make no
    difference. A name that two joints could have stays as it is.
    """
    found = {}
    for name in names:
        if name in joint_names:
            continue
        owners = [joint for joint in joint_names if _alike(name, joint)]
        if len(owners) == 1:
            rivals = [n for n in names if n == owners[0] or _alike(n, owners[0])]
            if len(rivals) == 1:
                found[name] = owners[0]
    return found


def renamed(names: Sequence[str], joint_names: Sequence[str]) -> Iterator[str]:
    """Yield the names with those of ``model_names`` in the model's spelling."""
    known = model_names(names, joint_names)
    yield from (known.get(name, name) for name in names)


def _alike(first: str, second: str) -> bool:
    """Return whether one name is the end of the other."""
    a, b = _pieces(first), _pieces(second)
    short, long = sorted((a, b), key=len)
    return bool(short) and long[-len(short) :] == short and not short[0].isdigit()


def _pieces(name: str) -> list[str]:
    return re.findall(r"[a-z]+|\d+", name.lower())
