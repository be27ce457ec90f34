"""What right logs of real arms are accused of, as they are and under other conditions.

    OMP_NUM_THREADS=1 python -m benchmarks.trust.real_right REAL_LOGS [--only kuka]
        [--conditions whole parts half_rate seldom links cutoff] [--rows FILE]

REAL_LOGS has the files that ``rigs.logs.real_logs`` names. Conditions:

whole      each log as it is
parts      its halves and thirds
half_rate  every second sample
seldom     some ten samples a second
links      with a model whose links are all 15 % off, in masses, centres of mass and inertias, five
           times
cutoff     behind a low-pass whose cut-off is 0.7 and 1.4 times the chosen one

Printed are the exit code of ``identify``, what its error says, the names of all findings of
``log``, the torque error of the written file on the log itself (MuJoCo alone, offsets out), and the
processor time of ``identify`` over that of importing mujoco and numpy. The table at the end counts
the logs that are refused or doubted under each condition. Those that are too short, or at rest, are
counted apart. The exit code is 1 where any other is refused or doubted. What is said of a log
becomes a line of FILE; logs that are in it are not made again.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from benchmarks.trust.row_files import Row, RowFile
from rigs.files.torque_error import error_on_log, written_model
from rigs.files.urdf_links import write_urdf_off
from rigs.logs.real_logs import LOGS, RealLog, part_of, write_real_log
from robot_sysid.records import Recording
from robot_sysid.signals.resampling import sampling_period

PARTS = {
    "first half": (0.0, 0.5),
    "second half": (0.5, 1.0),
    "first third": (0.0, 1.0 / 3.0),
    "second third": (1.0 / 3.0, 2.0 / 3.0),
    "last third": (2.0 / 3.0, 1.0),
}
"""Part of a log to its first and last share of the rows."""
LINKS_OFF = 0.15
LINK_SEEDS = 5
CUTOFFS = (0.7, 1.4)
"""Factors on the cut-off that is chosen."""
CONDITIONS = ("whole", "parts", "half_rate", "seldom", "links", "cutoff")
SELDOM = 10.0
"""Samples a second, about."""
EXCUSE = re.compile(r"at rest|record longer|independent samples|stands? still")
"""Words of a refusal that is right: the log is too short, or the arm rests."""
PROGRAM = (sys.executable, "-m", "robot_sysid")
OTHER_CUTOFF = """
import sys
from robot_sysid.cli import main
from robot_sysid.signals import process

choose = process.choose_cutoff

def choose_another(*arguments):
    choice = choose(*arguments)
    return choice._replace(cutoff={factor} * choice.cutoff)

process.choose_cutoff = choose_another
sys.exit(main(sys.argv[1:]))
"""
"""The program with another cut-off, for which it has no option."""
IMPORTS = (sys.executable, "-c", "import mujoco, numpy")
MOST_TEXT = 150
"""Characters of an error that are printed."""


@dataclass(frozen=True)
class Case:
    """A log under a condition.

    Attributes:
        log: the real log.
        condition: the kind of what is unusual.
        detail: which part, seed, or factor.
    """

    log: RealLog
    condition: str
    detail: str = ""

    @property
    def key(self) -> str:
        """Return the case in words."""
        return " ".join(filter(None, (self.log.name, self.condition, self.detail)))


def cases_of(log: RealLog, conditions: Sequence[str]) -> Iterator[Case]:
    """Yield the cases of a log."""
    details = {
        "whole": [""],
        "parts": [*PARTS],
        "half_rate": [""],
        "seldom": [""],
        "links": [str(seed) for seed in range(LINK_SEEDS)],
        "cutoff": [f"{factor:g}" for factor in CUTOFFS],
    }
    for condition in conditions:
        for detail in details[condition]:
            yield Case(log, condition, detail)


def run_timed(words: Sequence[str]) -> tuple[int, str, str, float]:
    """Return (exit code, output, messages, processor time [s]) of a process."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as folder:
        # Commands leave proposed columns where they run.
        run = subprocess.run(
            words, capture_output=True, text=True, cwd=folder, env=environment
        )
    after = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    return run.returncode, run.stdout, run.stderr, after - before


@cache
def seconds_of_imports() -> float:
    """Return the processor time of importing mujoco and numpy [s]."""
    return min(run_timed(IMPORTS)[3] for _ in range(3))


def look(case: Case, root: Path, log: Recording) -> Row:
    """Return what the commands say of a case of a log."""
    model = root / case.log.model
    program = PROGRAM
    if case.condition == "parts":
        log = part_of(log, *PARTS[case.detail])
    elif case.condition == "half_rate":
        log = log[::2]
    elif case.condition == "seldom":
        log = log[:: round(1.0 / (SELDOM * sampling_period(log.time)))]
    elif case.condition == "cutoff":
        code = OTHER_CUTOFF.format(factor=case.detail)
        program = (sys.executable, "-c", code)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if case.condition == "links":
            rng = np.random.default_rng(int(case.detail))
            off = folder / model.name
            write_urdf_off(model, off, LINKS_OFF, rng)
            model = off
        path = str(write_real_log(folder / "log.csv", log))
        reading = (str(model), *case.log.options)
        _, output, _, _ = run_timed([*program, "log", path, *reading, "--json"])
        found = json.loads(output)["findings"] if output.startswith("{") else []
        results = folder / "results"
        words = ("identify", reading[0], path, *reading[1:])
        end, _, messages, seconds = run_timed(
            [*program, *words, "--output-dir", str(results)]
        )
        written = written_model(results)
        error = None
        if end == 0 and written is not None:
            error = error_on_log(written, log.time, log.q, log.tau, case.log.cut)
    texts = [line for line in messages.splitlines() if "error:" in line]
    return {
        "key": case.key,
        "condition": case.condition,
        "code": end,
        "text": "".join(texts[-1:]).replace(f"{path}: ", ""),
        "findings": [f"{each['about']}:{each['level']}" for each in found],
        "error": error,
        "imports": seconds / seconds_of_imports(),
    }


def outcome(row: Row) -> str:
    """Return "used", "too short", or "refused" (or doubted)."""
    if row["code"] == 0:
        return "used"
    return "too short" if EXCUSE.search(row["text"]) else "refused"


def line_of(row: Row) -> str:
    """Return a row as a line of text."""
    error = "" if row["error"] is None else f"{100.0 * row['error']:.2f} %"
    names = ", ".join(row["findings"]) or "-"
    text = row["text"].replace("robot-sysid: error: ", "")[:MOST_TEXT]
    return (
        f"{row['key']:<28} exit {row['code']} {outcome(row):<10}{error:>9}"
        f"{row['imports']:6.1f} imports  {names}  {text}"
    )


def print_table(found: Sequence[Row]) -> int:
    """Print how many logs are refused under each condition; return the number of all."""
    print(f"\n{'condition':<12}{'logs':>6}{'refused':>9}{'too short':>11}  findings")
    refused = 0
    for condition in dict.fromkeys(row["condition"] for row in found):
        own = [row for row in found if row["condition"] == condition]
        counts = Counter(map(outcome, own))
        names = Counter(name for row in own for name in dict.fromkeys(row["findings"]))
        words = ", ".join(f"{name} {count}" for name, count in names.most_common())
        numbers = f"{len(own):>6}{counts['refused']:>9}{counts['too short']:>11}"
        print(f"{condition:<12}{numbers}  {words}")
        refused += counts["refused"]
    print(f"{refused} of {len(found)} right logs are refused or doubted")
    return refused


def main() -> int:
    """Print what is said of each log, and the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("logs", type=Path, metavar="REAL_LOGS")
    parser.add_argument(
        "--conditions", nargs="+", default=CONDITIONS, choices=CONDITIONS
    )
    parser.add_argument("--only", default="", help="part of the names of logs")
    parser.add_argument("--rows", type=Path)
    options = parser.parse_args()
    root = options.logs.resolve()
    kept = RowFile(options.rows)
    found = []
    for real in LOGS:
        if options.only not in real.name:
            continue
        log = real.read(root / real.path)
        for case in cases_of(real, options.conditions):
            if case.key not in kept:
                kept.add(look(case, root, log))
            row = kept[case.key]
            found.append(row)
            print(line_of(row), flush=True)
    return int(print_table(found) > 0)


if __name__ == "__main__":
    sys.exit(main())
