"""What owners of arms meet while one moves: how far joints get from their paths, how the run ends.

Run from the checkout:
    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python -m benchmarks.motors.motor_incidents
    ... --arm small --only late
    ... --processes          # the program is stopped, killed, or has no disk or console
    ... --page               # the table of motor_faults.md

Two arms that are not as their models say, one that is written here and a public one, are played on
simulated motors, in simulated time; ``--processes`` plays in real time, in a process of its own.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.motors.motor_faults import PAGE, shorten_message
from rigs.files.page_tables import PageTable
from rigs.motors.fault_bench import outcomes_of
from rigs.motors.incident_arms import SETUPS
from rigs.motors.incidents import PROCESSES, cases_on, departure_of
from rigs.motors.process_incidents import results_of

TABLE = PageTable(
    PAGE, "incidents", "python -m benchmarks.motors.motor_incidents --page"
)
HEAD = (
    "| Incident | Arm | Departure [rad] | Ending | The message begins |\n"
    "| --- | --- | --- | --- | --- |"
)
LENGTH = 100
NO_MODEL = ", no model"


def motor_rows(arms: Sequence[str], only: str, jobs: int) -> Iterator[str]:
    """Yield a row of the table for each incident of a motor, its bus or its set-up."""
    for arm in arms:
        cases = [case for case in cases_on(SETUPS[arm]) if only in case.name]
        for case, outcome in zip(cases, outcomes_of(cases, jobs)):
            model = "" if case.setup.model_is_given else NO_MODEL
            departure = departure_of(case, outcome)
            message = shorten_message(outcome.words, LENGTH)
            yield (
                f"| {case.name} | {arm}{model} | {departure:.2f} | {outcome.ending} | {message} |"
            )


def process_rows(only: str) -> Iterator[str]:
    """Yield a row of the table for each incident of the program or around it."""
    with tempfile.TemporaryDirectory() as folder:
        cases = [case for case in PROCESSES if only in case.name]
        for result in results_of(Path(folder), cases):
            incident = result.incident
            ending = f"exit code {result.code}, off after {result.off_after:.2f} s"
            message = shorten_message(result.message, LENGTH) * (result.code == 3)
            yield (
                f"| {incident.name} | small, in real time | {result.departure:.2f} | {ending} "
                f"| {message} |"
            )


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    options = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    options.add_argument("--arm", choices=list(SETUPS), action="append")
    options.add_argument("--processes", action="store_true", help="only in real time")
    options.add_argument("--only", default="", help="rows whose name contains this")
    options.add_argument("--jobs", type=int, default=2, help="processes at a time")
    options.add_argument("--page", action="store_true", help="write motor_faults.md")
    return options


def main() -> None:
    """Print the rows that were asked for, or write all into the page."""
    options = parser().parse_args()
    rows = [HEAD]
    print(HEAD)
    if not options.processes:
        for row in motor_rows(options.arm or [*SETUPS], options.only, options.jobs):
            print(row, flush=True)
            rows.append(row)
    if options.processes or options.page:
        for row in process_rows(options.only):
            print(row, flush=True)
            rows.append(row)
    if options.page:
        given = [row for row in rows if NO_MODEL not in row]
        TABLE.write(given)


if __name__ == "__main__":
    main()
