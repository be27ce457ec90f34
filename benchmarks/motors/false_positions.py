"""How far an arm leaves its path when a motor reports a position that is not true.

Run from the checkout:
    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python -m benchmarks.motors.false_positions
    ... --arm fr3 --sizes 0.3 3.14 --instants 1.5 --speed 0.3
    ... --each                             # a line per run, too

A joint reports a position that is too large while its motor's own loop works ("report"), or its
encoder jumps and the loop follows it ("encoder"). That happens at three joints, the two that carry
most and one of the wrist, at three moments of a planned motion, with a model and without. The arm
is none of the package's: see ``rigs.motors.sound_arms``. The departure is that from the undisturbed
run of the same arm, until no motor makes torque any more.

The exit code is 1 where a false report moved a joint farther than it may.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import tempfile
from collections import Counter
from functools import partial
from pathlib import Path

from benchmarks.motors.motor_faults import shorten_message
from benchmarks.motors.run_arguments import MODELS, add_run_arguments, run_options
from rigs.motors.arm_faults import shift_encoder, shift_report
from rigs.motors.sound_runs import SOUND_ARMS, disturbed_run, planned_motion

SIZES = (0.3, 0.7, 1.57, 3.14, 6.28)
INSTANTS = (0.8, 1.5, 2.6)
DURATION = 4.0
"""Length of the motion at full speed [s]."""
BOUND = 0.10
"""Most that a false report may move a joint whose motor works [rad]."""
VARIANTS = {"report": shift_report, "encoder": shift_encoder}


def result_of(case: tuple, folder: Path) -> tuple:
    """Play a case; return it with departure, that in the stop, seconds, ending and message."""
    options, variant, size, joint, instant = case
    fault = VARIANTS[variant](joint, size, instant)
    run, effect = disturbed_run(options, folder, fault)
    figures = effect.departure, effect.departure_in_stop, effect.seconds
    return case, figures, run.exit, run.message


def print_row(variant: str, size: float, has_model: bool, results: list) -> float:
    """Print the worst of a group of runs; return its departure [rad]."""
    worst_case, figures, _, _ = max(results, key=lambda result: result[1][0])
    departure, in_stop, seconds = figures
    endings = Counter(ending for _, _, ending, _ in results)
    words = Counter(shorten_message(message, 60) for _, _, _, message in results)
    text = ", ".join(f"{count} {ending}" for ending, count in endings.most_common())
    joint, instant = worst_case[3:]
    print(
        f"{variant:8s} {size:5.2f}  {'model' if has_model else 'none ':5s}  "
        f"{departure:6.3f}  {in_stop:6.3f}  {seconds:6.3f}   joint {joint} at {instant:g} s  "
        f"{text}; {words.most_common(1)[0][0]}",
        flush=True,
    )
    return departure


def main() -> int:
    """Play all that is asked for; return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--arm", choices=SOUND_ARMS, default="kinova")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=[*VARIANTS])
    parser.add_argument("--sizes", nargs="+", type=float, default=SIZES)
    parser.add_argument("--instants", nargs="+", type=float, default=INSTANTS)
    parser.add_argument("--joints", nargs="+", type=int, help="numbers, base is 0")
    add_run_arguments(parser, "both")
    parser.add_argument("--each", action="store_true", help="a line per run, too")
    arguments = parser.parse_args()
    worst = dict.fromkeys(arguments.variants, 0.0)
    print("variant   size  given  departure, in stop [rad], seconds until torque-free")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        planned = planned_motion(arguments.arm, folder, DURATION)
        joints = arguments.joints or planned.telling_joints()
        with multiprocessing.Pool(arguments.jobs) as pool:
            for variant, has_model, size in itertools.product(
                arguments.variants, MODELS[arguments.model], arguments.sizes
            ):
                options = run_options(
                    arguments, arguments.arm, has_model, duration=DURATION
                )
                grid = itertools.product(joints, arguments.instants)
                cases = [(options, variant, size, *place) for place in grid]
                results = []
                for result in pool.imap(partial(result_of, folder=folder), cases):
                    results.append(result)
                    if arguments.each:
                        (*_, joint, instant), figures, ending, message = result
                        departure, in_stop, seconds = figures
                        print(
                            f"  joint {joint} at {instant:g} s: {departure:.3f} rad, in stop "
                            f"{in_stop:.3f} rad, {seconds:.3f} s, {ending}: {message}",
                            flush=True,
                        )
                departure = print_row(variant, size, has_model, results)
                worst[variant] = max(worst[variant], departure)
    for variant, departure in worst.items():
        print(f"worst departure, {variant}: {departure:.3f} rad")
    return int(worst.get("report", 0.0) > BOUND)


if __name__ == "__main__":
    raise SystemExit(main())
