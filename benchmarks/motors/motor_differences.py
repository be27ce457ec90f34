"""What a run does, and says, when an arm is not what its model and its motors say.

Run from the checkout:
    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python -m benchmarks.motors.motor_differences
    ... --arms kinova --only "kd is ignored" "motor starts again" --lines 6
    ... --list                             # names of all faults

Each fault happens to a sound arm that plays and records a planned motion, by default with a model
(see ``rigs.motors.sound_arms``; nothing of the package's own simulation is in it). Printed are the
largest departure of a true joint position from the undisturbed run of the same arm until no motor
makes torque any more, that since the stop began, how long after the fault that is, how the run
ended, and the last lines that were printed.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import tempfile
from functools import partial
from pathlib import Path

from benchmarks.motors.run_arguments import MODELS, add_run_arguments, run_options
from rigs.motors.arm_faults import table_faults
from rigs.motors.sound_runs import (
    COMPLETED,
    SOUND_ARMS,
    ArmFault,
    RunOptions,
    disturbed_run,
    planned_motion,
)

ARMS = ("kinova", "fr3")
DURATION = 6.0
"""Length of the motion at full speed [s]: torque that fades to half needs five."""
LINES = 4


def faults_of(arm: str, folder: Path) -> list[ArmFault]:
    """Return a fault of each kind for an arm."""
    loaded, _, wrist = planned_motion(arm, folder, DURATION).telling_joints()
    return table_faults(loaded, wrist)


def result_of(case: tuple[RunOptions, int], folder: Path) -> tuple:
    """Play a fault, by its number; return it, what it did, ending, exit code and lines."""
    options, number = case
    fault = faults_of(options.arm, folder)[number]
    run, effect = disturbed_run(options, folder, fault)
    lines = run.lines if run.exit == COMPLETED else [*run.lines, run.message]
    return options, fault.name, fault.joint, effect, run.exit, run.code, lines


def print_result(result: tuple, n_lines: int) -> None:
    """Print what came of a fault."""
    options, name, joint, effect, ending, code, lines = result
    owner = "" if joint is None else f", joint {joint}"
    seconds = "-" if ending == COMPLETED else f"{effect.seconds:.3f}"
    print(
        f"{options.arm:10s} {name + owner:46s} {effect.departure:6.3f} "
        f"{effect.departure_in_stop:6.3f} rad  {seconds:>6s} s  {ending}, exit code {code}",
        flush=True,
    )
    for line in lines[len(lines) - n_lines :]:
        print(f"    {line}", flush=True)


def main() -> int:
    """Play all that is asked for; return the exit code 0."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--arms", nargs="+", choices=SOUND_ARMS, default=ARMS)
    parser.add_argument(
        "--only", nargs="+", help="names of faults, or their beginnings"
    )
    parser.add_argument("--list", action="store_true", help="print the names of all")
    add_run_arguments(parser, "with")
    parser.add_argument("--lines", type=int, default=LINES, help="how many to print")
    arguments = parser.parse_args()
    if arguments.list:
        print("\n".join(fault.name for fault in table_faults(1, 5)))
        return 0
    wanted = tuple(arguments.only or ("",))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cases = []
        for arm, has_model in itertools.product(
            arguments.arms, MODELS[arguments.model]
        ):
            options = run_options(
                arguments, arm, has_model, duration=DURATION, records=True
            )
            names = [fault.name for fault in faults_of(arm, folder)]
            cases += [
                (options, number)
                for number, fault_name in enumerate(names)
                if fault_name.startswith(wanted)
            ]
        with multiprocessing.Pool(arguments.jobs) as pool:
            for result in pool.imap(partial(result_of, folder=folder), cases):
                print_result(result, arguments.lines)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
