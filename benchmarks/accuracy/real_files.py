"""How far files of real arms are off on another log, judged by MuJoCo and no code of this project.

Run from the checkout, four minutes on one core; ``--write`` puts the table into docs/evidence.md:

    OMP_NUM_THREADS=1 python -m benchmarks.accuracy.real_files [--write]

``real_gate.py`` lies with the public logs in ../shared beside the checkout. Of each pair of logs,
or of parts of one, it has the command ``identify`` write a file of the first, and compares torques
by MuJoCo's inverse dynamics with those of the second: both low-passed at 5 Hz, away from reversals,
each joint's mean error left in or taken out. The exit code is 1 where a file is worse than the best
one that any version has written, as the gate says.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator

from rigs.files.page_tables import PageTable
from rigs.files.places import ROOT, SHARED

GATE = SHARED / "tools" / "real_gate.py"
TABLE = PageTable(
    ROOT / "docs" / "evidence.md",
    "real_files",
    "python -m benchmarks.accuracy.real_files",
)
LINE = re.compile(
    r"(?P<made>\w+) (?P<of>[\d.-]+) on (?P<judge>\w+) (?P<on>[\d.-]+): "
    r"(?P<left_in>[\d.]+) \((?P<out>[\d.]+)\) %"
)
"""What the gate prints of a file: its log and part, those that judge it, and both errors."""
REFUSED = re.compile(
    r"(?P<made>\w+) (?P<of>[\d.-]+) on (?P<judge>\w+) (?P<on>[\d.-]+): REFUSED"
)


def table(output: Iterable[str]) -> Iterator[str]:
    """Yield the lines of the table, from what the gate prints."""
    yield "| Log that makes the file | log that judges it | torque error | offsets taken out |"
    yield "| --- | --- | --- | --- |"
    for line in output:
        match = LINE.match(line)
        if match:
            errors = f"{match['left_in']} % | {match['out']} %"
        else:
            match = REFUSED.match(line)
            errors = "refused | "
        if match:
            made = part_of(match["made"], match["of"])
            judge = part_of(match["judge"], match["on"])
            yield f"| {made} | {judge} | {errors} |"


def part_of(log: str, part: str) -> str:
    """Return the name of a part of a log, such as "tx40, 0 to 0.7"."""
    return f"`{log}`" if part == "0-1" else f"`{log}`, {part.replace('-', ' to ')}"


def main(*options: str) -> int:
    """Print the table; write it where that is asked for."""
    command = [sys.executable, str(GATE), "--no-cost"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    run = subprocess.run(command, capture_output=True, text=True, env=environment)
    print(run.stdout, run.stderr, file=sys.stderr)
    TABLE.show([*table(run.stdout.splitlines())], "--write" in options)
    return run.returncode


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
