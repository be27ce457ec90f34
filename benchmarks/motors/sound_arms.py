"""Sound arms, none of whose runs may be stopped: links 15 % off, friction that no file knows.

Run from the checkout:
    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python -m benchmarks.motors.sound_arms
    ... --runs 2 --arms kinova fr3 --speeds 0.2 1 --jobs 2
    ... --runs 40 --first 10               # other draws
    ... --loss 0.5                         # percent of commands, and of answers, that never arrive
    ... --arms my_arm.xml two_arms.xml:left_wrist    # any file, with its terminal joint
    ... --each                             # a line per run, too

A planned motion is exported once per arm, and played as ``motors play`` does, in simulated time,
on a plant, motors and a bus that share no code with those of the package. Each draw is another arm,
with another stiffness (20 to 100 N m/rad, or what carries it) and another rate (50 to 500 Hz, with
CAN-FD above 250); it is played with a model and without. Public models that are not at hand are
left out.

The exit code is 1 where a run was stopped or refused, or played and then called not usable.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from benchmarks.motors.motor_faults import shorten_message
from benchmarks.motors.run_arguments import MODELS, add_model_argument
from rigs.motors.sound_runs import (
    COMPLETED,
    SOUND_ARMS,
    Run,
    RunOptions,
    arm_named,
    draw_options,
    planned_motion,
    run_arm,
)

SPEEDS = (0.2, 0.3, 0.5, 1.0)
RUNS = 10
DURATION = 4.0
"""Length of the motions at full speed [s]."""


def options_of(
    arm: str,
    folder: Path,
    speed: float,
    seeds: range,
    models: tuple[bool, ...],
    lost: float,
) -> Iterator[RunOptions]:
    """Yield how an arm is played at a speed, with a share of frames that are lost."""
    for seed, has_model in itertools.product(seeds, models):
        yield draw_options(arm, folder, seed, speed, has_model, DURATION, lost)


ACCUSED = "accused"
"""How a run ended that played to its end, and whose recording was then called not usable."""


def result_of(options: RunOptions, folder: Path) -> tuple[RunOptions, str, str]:
    """Play once; return how, how it ended, and the message."""
    run: Run = run_arm(options, folder)
    if run.exit == COMPLETED and run.code != 0:
        # The last line is the verdict; before it stands what the recording says.
        return options, ACCUSED, run.lines[-2]
    return options, run.exit, run.message


def print_line(arm: str, speed: float, results: list, seconds: float) -> Counter:
    """Print what came of an arm at a speed; return how many runs ended how."""
    endings = Counter(ending for _, ending, _ in results)
    wrong = [message for _, ending, message in results if ending != COMPLETED]
    words = Counter(map(shorten_message, wrong)).most_common(3)
    text = "; ".join(f"{count}x {message}" for message, count in words)
    cost = seconds / len(results)
    print(
        f"{Path(arm).stem:14s} {speed:4g}  stopped {n_stopped(endings):2d}, "
        f"accused {endings[ACCUSED]:2d} of {len(results):2d}  [{cost:.1f} s per run]  {text}",
        flush=True,
    )
    return endings


def n_stopped(endings: Counter) -> int:
    """Return how many runs were stopped or refused."""
    return sum(endings.values()) - endings[COMPLETED] - endings[ACCUSED]


def main() -> int:
    """Play all that is asked for; return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument(
        "--arms", nargs="+", default=[*SOUND_ARMS], help="names, or FILE or FILE:JOINT"
    )
    parser.add_argument("--loss", type=float, default=0.0, help="percent of frames")
    parser.add_argument("--speeds", nargs="+", type=float, default=SPEEDS)
    parser.add_argument("--runs", type=int, default=RUNS, help="draws per line")
    parser.add_argument("--first", type=int, default=0, help="seed of the first draw")
    add_model_argument(parser, "both")
    parser.add_argument("--each", action="store_true", help="a line per run, too")
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.runs)
    arms = [arm for arm in arguments.arms if arm_named(arm).is_at_hand]
    endings: Counter = Counter()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for arm in arms:
            planned_motion(arm, folder, DURATION)
        with multiprocessing.Pool(arguments.jobs) as pool:
            for arm, speed in itertools.product(arms, arguments.speeds):
                begun = time.monotonic()
                models = MODELS[arguments.model]
                lost = arguments.loss / 100.0
                cases = options_of(arm, folder, speed, seeds, models, lost)
                results = []
                for result in pool.imap(partial(result_of, folder=folder), cases):
                    results.append(result)
                    options, ending, message = result
                    if arguments.each:
                        print(
                            f"  seed {options.seed} kp {options.kp} {options.rate} Hz model "
                            f"{options.has_model}: {ending}, {message}",
                            flush=True,
                        )
                seconds = time.monotonic() - begun
                endings += print_line(arm, speed, results, seconds)
    print(
        f"\nof {sum(endings.values())} runs of sound arms {n_stopped(endings)} were stopped, and "
        f"{endings[ACCUSED]} played, but called not usable"
    )
    return int(endings[COMPLETED] < sum(endings.values()))


if __name__ == "__main__":
    raise SystemExit(main())
