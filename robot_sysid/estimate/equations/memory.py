"""Memory that this process may still take, and the refusal of what needs more."""

from __future__ import annotations

import contextlib
import math
import os
from pathlib import Path

from robot_sysid.errors import InputError
from robot_sysid.wording import option_name

_KIB = 1024
_UNITS = ("B", "kB", "MB", "GB", "TB")
_LIMITS = ("memory.max", "memory/memory.limit_in_bytes")
_USES = ("memory.current", "memory/memory.usage_in_bytes")


def free_memory(root: Path = Path("/")) -> float:
    """Return the memory that this process may still take [bytes]; infinite where nothing says so.

    It is the least of what the system has to give, of what the container it runs in may take, and
    of what is left of the limit of this process (``ulimit -v``).

    Args:
        root: of the file system in which the system states it.
    """
    return min(_of_system(root), *_of_containers(root), _of_process(root))


def refuse_too_much(needed: float, free: float, n_joints: int) -> None:
    """Raise InputError where what is to be computed needs more memory than is free [bytes].

    It grows with the cube of the number of joints that are estimated.

    Args:
        n_joints: number of these joints.
    """
    if needed <= free:
        return
    possible = math.floor(n_joints * (free / needed) ** (1.0 / 3.0))
    raise InputError(
        f"{n_joints} joints move: to estimate all their links takes {_size(needed)} of memory, and "
        f"{_size(free)} are free, enough for {possible}; record with all joints but the last "
        f"{possible} standing still, and name the first that moves with "
        f"{option_name('first_joint')}"
    )


def _size(count: float) -> str:
    """Return a number of bytes as text."""
    power = min(int(math.log(max(count, 1.0), 1000.0)), len(_UNITS) - 1)
    return f"{float(f'{count / 1000.0**power:.2g}'):g} {_UNITS[power]}"


def _of_system(root: Path) -> float:
    """Return what the system has to give: on Linux what it could free, elsewhere all it has."""
    for line in _text(root / "proc/meminfo").splitlines():
        if line.startswith("MemAvailable:"):
            return float(line.split()[1]) * _KIB
    with contextlib.suppress(OSError, ValueError, AttributeError):
        return float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")
    return math.inf


def _of_containers(root: Path) -> list[float]:
    """Return what is left of each limit of the control groups that this process is in."""
    left = []
    places = [root / "sys/fs/cgroup"]
    for line in _text(root / "proc/self/cgroup").splitlines():
        own = places[0] / line.rpartition(":")[2].strip("/")
        places += [own, *[*own.parents][: len(own.parts) - len(places[0].parts)]]
    for place in dict.fromkeys(places):
        for limit, use in zip(_LIMITS, _USES):
            texts = _text(place / limit).strip(), _text(place / use).strip()
            if all(text.isdigit() for text in texts):
                left.append(float(texts[0]) - float(texts[1]))
    return left


def _of_process(root: Path) -> float:
    """Return what is left of the address space that this process may have."""
    try:
        import resource
    except ImportError:  # Windows
        return math.inf
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    pages = _text(root / "proc/self/statm").split()
    if limit == resource.RLIM_INFINITY or not pages:
        return math.inf
    return float(limit) - float(pages[0]) * resource.getpagesize()


def _text(path: Path) -> str:
    """Return the text of a small file of the system; "" where it has none."""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""
