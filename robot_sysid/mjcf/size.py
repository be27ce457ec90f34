"""How large a model is, counted before it is compiled.

MuJoCo takes time by the square of the number of bodies, joints and copies: 2 s for 3000 bodies, a
minute for as many copies, days for a million, which a line of a file may ask for. An arm with hands
and a furnished room has some hundreds.
"""

from __future__ import annotations

import math
import os
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from robot_sysid.errors import ModelError

Node = Any
"""An element of lxml's tree."""
MOST_BYTES = 50_000_000
"""Bytes of a model file and of all that it includes."""
# How many of each element a model may have, with all copies: 1 or 2 s of MuJoCo's.
_MOST = {
    "body": 2000,
    "link": 2000,
    "joint": 2000,
    "freejoint": 2000,
    "replicate": 500,
    "geom": 20_000,
    "site": 20_000,
}
# Elements of MuJoCo that make as many bodies as the product of the numbers in their count.
_GRIDS = ("composite", "flexcomp")


def refuse_bytes(path: Path, count: int) -> None:
    """Raise ModelError where a model file, with what it includes so far, has too many bytes."""
    if count > MOST_BYTES:
        raise ModelError(
            f"{path} has {count:.2g} bytes with what it includes, and a model may have "
            f"{MOST_BYTES:.0e}; leave out what is not the arm"
        )


def refuse_large(path: Path, root: Node, read: Callable[[Path], Node]) -> None:
    """Raise ModelError where a model, with all copies that it asks for, is larger than any arm's.

    Args:
        path: of its file.
        root: of its tree, includes in their places.
        read: returns the root of the tree of another file, which the model attaches.
    """
    counts: dict[str, float] = defaultdict(float)
    # Elements to count, how many times each, and the files that they are in.
    waiting: list[tuple[Node, float, tuple[Path, ...]]] = [(root, 1.0, (path,))]
    while waiting:
        node, times, files = waiting.pop()
        tag = node.tag
        if tag == "replicate":
            times *= _product(node.get("count"))
        elif tag in _GRIDS:
            counts["body"] += times * _product(node.get("count"))
        elif tag == "attach":
            counts["body"] += times
            for attached in _attached(node, files):
                waiting.append((read(attached), times, (*files, attached)))
        counts[tag] += times
        for name in ("body", tag):
            if counts[name] > _MOST.get(name, math.inf):
                raise ModelError(
                    f"{path} has more than {_MOST[name]} times a <{name}>, copies counted, which "
                    "no arm has and which takes MuJoCo minutes; leave out what is not the arm"
                )
        waiting += [(child, times, files) for child in node.iterchildren("*")]


def _product(text: str | None) -> float:
    """Return the product of the numbers in a text, at least one; of what is none, one."""
    try:
        return max(1.0, math.prod(map(float, (text or "1").split())))
    except ValueError:
        return 1.0


def _attached(node: Node, files: tuple[Path, ...]) -> Iterator[Path]:
    """Yield the file of the model that an <attach> names, if MuJoCo will find one.

    ModelError where that is one of the files that it stands in, the last of ``files``.
    """
    name = node.get("model")
    for model in node.getroottree().iter("model"):
        file = model.get("file")
        path = files[-1].parent / (file or "")
        if not file or name not in (model.get("name"), path.stem) or not path.is_file():
            continue
        if any(os.path.samefile(path, other) for other in files):
            raise ModelError(f"{path} attaches itself; leave that out")
        yield path
