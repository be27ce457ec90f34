"""A set of three files that is written anew, with a look at the folder at every instant.

Stands alone, so that a process that is going to be killed starts fast.
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

from robot_sysid.records.atomic_files import whole_files

NAMES = ("a.json", "b.csv", "model.xml")
LAST = "model.xml"
OLD, NEW = (dict.fromkeys(NAMES, word) for word in ("old", "new"))
# Whatever a commit does to the folder, it does by one of these.
STEPS = ("replace", "unlink")


def write_old(folder):
    """Put the old set there."""
    for name, text in OLD.items():
        (folder / name).write_text(text)


def write_new(folder):
    """Write the new set, the last file drafted first."""
    with whole_files() as outputs:
        for name in reversed(NAMES):
            outputs.write(folder / name, NEW[name])


def watch(between, replace_attribute=setattr):
    """Call ``between(count)`` before and after every step of a commit; count begins with 1.

    Args:
        between: what to do.
        replace_attribute: as ``setattr``; a test's own sets back what was there.

    Returns:
        A list whose only entry is the present count.
    """
    seen = [0]

    def watched(step):
        def call(*arguments, **rest):
            seen[0] += 1
            between(seen[0])
            result = step(*arguments, **rest)
            seen[0] += 1
            between(seen[0])
            return result

        return call

    for name in STEPS:
        replace_attribute(os, name, watched(getattr(os, name)))
    return seen


def main(folder, instant):
    """Write the new set and be killed at an instant."""

    def kill(count):
        if count == instant:
            os.kill(os.getpid(), signal.SIGKILL)

    watch(kill)
    write_new(folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
