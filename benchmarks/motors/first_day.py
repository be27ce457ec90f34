"""How long each step of the day of docs/motors.md takes, on simulated motors.

Run from the checkout:

    OMP_NUM_THREADS=1 python -m benchmarks.motors.first_day [--write]

The commands are those of the page, as printed, for each arm of ``rigs.motors.first_day`` whose
model is at hand. The time of the bus is the simulated one: a real arm takes as long, and then the
recording is judged. What a person needs is estimated, and nobody's time was taken.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import tempfile
import time
from pathlib import Path

from rigs.files.page_tables import PageTable
from rigs.files.places import ROOT
from rigs.motors.first_day import ARMS, PAGE, Day, DayArm, page_commands

TABLE = PageTable(
    ROOT / "docs" / "evidence.md", "first_day", "python -m benchmarks.motors.first_day"
)
PERSON = {
    "1": "an hour or two",
    "2": "15 min",
    "3": "2 min per motor",
    "4": "10 min",
    "5": "5 min",
    "6": "1 min per joint",
    "7": "15 min",
    "8": "10 min",
}
"""Number of a step to what somebody needs who does it for the first time, as estimated."""
LEAST_TIME = 0.05
"""Time of the computer below which nothing is said of it [s]."""
LEAST_BUS_TIME = 0.5
"""Time of the bus below which nothing is said of it [s]: what is left on it is read in less."""
USABLE = (0, 1)
"""Exit codes of commands that have done their work."""


def step_times(arm: DayArm, folder: Path) -> dict[str, list[float]]:
    """Return wall time, processor time and time of the bus [s] by the title of a step."""
    day = Day(arm, folder)
    times: dict[str, list[float]] = {}
    for title, line, _ in page_commands(arm):
        if title[0] not in PERSON:
            continue
        clocks = time.perf_counter, time.process_time, day.bus.clock.now
        before = [clock() for clock in clocks]
        step = day.run(line)
        if step.code not in USABLE:
            raise SystemExit(f"{line}: exit code {step.code}\n{step.output}")
        spent = [clock() - start for clock, start in zip(clocks, before)]
        total = times.get(title, [0.0] * len(clocks))
        times[title] = [sum(pair) for pair in zip(total, spent)]
    return times


def table_lines(times_by_arm: dict[str, dict[str, list[float]]]) -> list[str]:
    """Return the lines of the table."""
    arms = [f"computer, {name} [s]" for name in times_by_arm]
    rows = [["step", "a person", "the bus [s]", *arms], ["---"] * (3 + len(arms))]
    text = PAGE.read_text(encoding="utf-8")
    for title in re.findall(r"^### (\d\. .*)$", text, re.MULTILINE):
        of_arms = [times.get(title, [0.0] * 3) for times in times_by_arm.values()]
        bus = max(times[-1] for times in of_arms)
        row = [title, PERSON[title[0]], f"{bus:.0f}" if bus > LEAST_BUS_TIME else ""]
        for wall, processor, _ in of_arms:
            spent = f"{wall:.1f} ({processor:.1f})"
            row.append(spent if wall > LEAST_TIME else "")
        rows.append(row)
    return [f"| {' | '.join(row)} |" for row in rows]


def main() -> None:
    """Run the day of each arm, and print or write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="write docs/evidence.md")
    is_written = parser.parse_args().write
    times = {}
    for name, arm in ARMS.items():
        if not arm.is_there:
            print(f"{arm.model} is not here", file=sys.stderr)
            continue
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            times[name] = step_times(arm, Path(folder))
            os.chdir(PAGE.parent)
    TABLE.show(table_lines(times), is_written)


if __name__ == "__main__":
    main()
