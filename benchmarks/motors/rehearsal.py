"""Identification of rehearsals: each number with its standard error beside the simulated one.

Run from the checkout, for all arms or some of them, at some rates or at 100, 250 and 500 Hz:

    OMP_NUM_THREADS=1 python -m benchmarks.motors.rehearsal [openarm kinova wxai] [--rate 250]

Each arm's trajectory for the whole arm is planned once, played by simulated motors that round as
real ones do, and identified with the model that was simulated. 500 Hz need CAN-FD.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from rigs.motors.rehearsals import ARMS, Estimate, plan, rehearse

RATES = (100.0, 250.0, 500.0)


def main() -> None:
    """Print a table per arm and rate."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("arms", nargs="*", default=[*ARMS])
    parser.add_argument("--rate", type=float, action="append")
    parser.add_argument("--duration", type=float, default=20.0)
    arguments = parser.parse_args()
    for name in arguments.arms:
        arm = ARMS[name]
        with tempfile.TemporaryDirectory() as folder:
            trajectory = plan(arm, Path(folder), arguments.duration)
            for rate in arguments.rate or RATES:
                estimates = rehearse(arm, trajectory, rate, Path(folder))
                print_table(f"{name} at {rate:g} Hz", estimates)


def print_table(title: str, rows: list[Estimate]) -> None:
    """Print each number, its truth, its ± and its error in units of that."""
    worst = max(abs(row.stated_errors) for row in rows)
    within = sum(abs(row.stated_errors) <= 1.0 for row in rows)
    print(
        f"\n{title}: {within} of {len(rows)} within their ±, the worst off by {worst:.1f}"
    )
    print("| | truth | identified | ± | error/± |\n|---|---|---|---|---|")
    for row in rows:
        numbers = f"{row.truth:.5f} | {row.value:.5f} | {row.standard_error:.5f}"
        print(f"| {row.name} | {numbers} | {row.stated_errors:+.1f} |", flush=True)


if __name__ == "__main__":
    main()
