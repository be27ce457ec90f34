"""How long a search takes that may take one second, and its memory: `design_excitation` alone.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.excitation_budget [seconds ...]

Each line is a process of its own. From five seconds on there are workers, and its time is that of
the clock on the wall; below it is processor time, which other programs do not change. Longer
motions than memory allows are refused beforehand.
"""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.motion import design as design_module
from robot_sysid.motion.design import Design
from robot_sysid.motion.design_search import design_excitation
from robot_sysid.motion.plan_options import ExcitationOptions, LimitOptions
from robot_sysid.motion.problem import build_problem
from robot_sysid.parser import load_robot_model
from robot_sysid.trajectory import TrajectoryOptions
from tests.support.places import GUESS

CASES = (15.0, 120.0, 130.0, 300.0, 20_000.0)


def search(budget: float, duration: float) -> str:
    """Time taken and peak memory of one search, in words."""
    import resource

    excitation = ExcitationOptions(kind="optimal", time_budget=budget)
    problem = build_problem(load_robot_model(GUESS), LimitOptions())
    clock = design_module.clock = (
        time.monotonic if excitation.n_workers > 1 else time.process_time
    )
    start = clock()
    try:
        design = Design(problem, excitation, TrajectoryOptions(duration=duration))
    except InputError as error:
        return f"refused after {clock() - start:.2f} s: {error}"
    found = design_excitation(design, np.random.default_rng(1))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    taken = clock() - start
    gain = found.start_objective / found.objective
    words = (
        f"{found.n_feasible} of {found.n_drawn} draws feasible, {gain:.2f} times better"
    )
    return f"{taken:.2f} s, {peak:.0f} MB; {words}"


def main(*words: str) -> None:
    """Print a line for each case; of one case in its own process."""
    if len(words) == 2:
        print(search(*map(float, words)))
        return
    for budget in map(float, words or ("1",)):
        for duration in CASES:
            print(f"{budget:g} s for {duration:g} s: ", end="", flush=True)
            case = (str(budget), str(duration))
            subprocess.run([sys.executable, "-m", __spec__.name, *case], check=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
