"""Processor time per sample and peak memory of whole runs, from 15 s to an hour at 1 kHz.

Run from the checkout, about five minutes on one core:

    export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
    python -m benchmarks.linear_cost [simulated] [log]

"simulated" is the model's own simulation, "log" a CSV file of the example arm. Time per sample has
two parts: what every run takes (imports, the model, the solution), and what each sample adds; the
second column is between a length and the shortest one. The targets are 20 % and 1.5 times.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.support.places import GUESS, TRUTH

LENGTHS = (15.0, 150.0, 1500.0, 3600.0)
RATE = 1000.0
LIMIT = 540.0
"""Time after which a run is ended [s]."""
# Waits for one child, so that its peak memory and its time are those of all children.
MEASURED = f"""
import resource, subprocess, sys
try:
    code = subprocess.run(sys.argv[1:], stdout=sys.stderr, timeout={LIMIT}).returncode
except subprocess.TimeoutExpired:
    code = -1
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(code, used.ru_utime + used.ru_stime, used.ru_maxrss)
"""


def measured(*words: str) -> tuple[float, float]:
    """(processor time [s], peak memory [MB]) of a run of the command; infinite if unfinished."""
    return watched(sys.executable, "-m", "robot_sysid", *words, "--quiet")[:2]


def watched(*command: str) -> tuple[float, float, str]:
    """(processor time [s], peak memory [MB], what it printed) of a process, as users start it:
    with its modules compiled.
    """
    compiled = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    outer = [sys.executable, "-c", MEASURED, *command]
    done = subprocess.run(
        outer, check=True, capture_output=True, text=True, env=compiled
    )
    code, seconds, memory = map(float, done.stdout.split())
    # 1: ran, but the result is not to be used; its cost is the same.
    assert code in (0.0, 1.0, -1.0), (command, done.stderr)
    seconds = seconds if code >= 0.0 else math.inf
    return (
        seconds,
        memory / (1024.0 if sys.platform != "darwin" else 1024.0**2),
        done.stderr,
    )


def simulated(folder: Path, duration: float) -> tuple[float, float]:
    """The model's own simulation."""
    out = ("--output-dir", str(folder / "out"), "--seed", "0")
    return measured(
        str(GUESS), *out, "--duration", str(duration), "--sample-rate", str(RATE)
    )


def log(folder: Path, duration: float) -> tuple[float, float]:
    """A log that another model's simulation has written."""
    path = folder / f"{duration:g}.csv"
    if not path.exists():
        recorded(path, duration)
    out = ("--output-dir", str(folder / "out"))
    return measured("identify", str(GUESS), str(path), *out)


def recorded(path: Path, duration: float) -> None:
    """Write a log; a long one repeats one of 150 s, with noise of its own."""
    once = min(duration, LENGTHS[1])
    piece = path.with_suffix(".piece")
    plant = ("--plant-model", str(TRUTH), "--save-measurements", str(piece))
    noise = (
        "--noise-torque",
        "0.05",
        "--seed",
        "0",
        "--output-dir",
        str(path.parent / "out"),
    )
    measured(
        str(GUESS), "--duration", str(once), "--sample-rate", str(RATE), *plant, *noise
    )
    title, *lines = [
        x for x in piece.read_text().splitlines(True) if not x.startswith("#")
    ]
    with path.open("w", encoding="utf-8") as file:
        file.write(title)
        for start in range(round(duration / once)):
            for line in lines if start == 0 else lines[1:]:
                when, _, rest = line.partition(",")
                file.write(f"{float(when) + start * once!r},{rest}")


def main(*parts: str) -> None:
    """Print the table."""
    print(
        "| Run | Samples | Time | Per sample | Per sample added | Peak memory | Times |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as name:
        for part in parts or ("simulated", "log"):
            run = {"simulated": simulated, "log": log}[part]
            base, memory = run(Path(name), LENGTHS[0])
            for length in LENGTHS:
                seconds, peak = run(Path(name), length)
                samples = length * RATE
                more = (length - LENGTHS[0]) * RATE
                added = f"{1e6 * (seconds - base) / more:.1f} us" if more else ""
                cells = (part, f"{samples:.0f}", f"{seconds:.2f} s")
                each = (f"{1e6 * seconds / samples:.1f} us", added, f"{peak:.0f} MB")
                print(
                    f"| {' | '.join((*cells, *each))} | {peak / memory:.2f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main(*sys.argv[1:])
