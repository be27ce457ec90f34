"""Do results depend on the number of threads of linear algebra?

Run from the checkout:  python -m benchmarks.determinism

The example arm, by the commands and by the Python functions, which both take one thread, whatever
is set; a search for a trajectory that ends of itself. One line per file: how many different ones
were written.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

from rigs.command_line import files_in
from rigs.places import GUESS, ROOT, TRUTH
from robot_sysid.records.messages import Progress

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
THREADS = (1, 2)
"""Numbers of threads."""
RATE = {"duration": 6.0, "sample_rate": 250.0}
WORDS = "--duration 6 --sample-rate 250 --seed 1 --noise-torque 0.1"
WAYS = ("functions", "commands")


def functions(folder: Path) -> None:
    """Write the results of all functions."""
    import robot_sysid as rs

    logs = [folder / "1.csv", folder / "2.csv"]
    # The other links are guessed so badly that the encoders look wrong.
    rs.identify(GUESS, logs[0], accept=("zero",)).save("identify")
    rs.identify(GUESS, logs, accept=("zero",)).save("links")
    rs.payload(GUESS, logs[:1], logs[1:], accept=("zero",)).save("payload")
    rs.plan(GUESS, seed=1, excitation="sines", **RATE).save("plan/plan.json")
    _search(Path("plan/search.json"))


def _search(path: Path) -> None:
    """Write the trajectory that a search ends with."""
    import numpy as np

    from rigs.excitation_arms import TUBES_AND_POST, make_design
    from robot_sysid.api.results import one_thread
    from robot_sysid.motion.search import design_excitation
    from robot_sysid.motion.trajectories import save_trajectory

    few = {"draws": 30, "rounds": 3, "iterations": 20}
    problem = make_design(TUBES_AND_POST, **few)
    with one_thread():
        plan = design_excitation(problem, np.random.default_rng(1), Progress())
    save_trajectory(path, plan, problem.problem.joint_names)


def commands(folder: Path) -> None:
    """Write the results of all commands."""
    from robot_sysid.cli import main

    both = f"{folder}/1.csv {folder}/2.csv"
    lines = (
        f"{GUESS} {WORDS} --plant-model {TRUTH} --save-measurements itself/saved.csv "
        f"--export-damiao{7 * ' --motor-type DM10010L'} --output-dir itself",
        f"identify {GUESS} {folder}/1.csv --accept zero --report --output-dir identify",
        f"identify {GUESS} {both} --accept zero --links --output-dir links",
        f"payload {GUESS} --empty {folder}/1.csv --loaded {folder}/2.csv --accept zero "
        "--output-dir payload",
        f"plan {GUESS} {WORDS} --excitation sines --output-dir plan",
    )
    for line in lines:
        assert main(line.split()) in (0, 1), line


def child(command: str, folder: Path, threads: int) -> dict[str, str]:
    """Return the hash of each file that a process with so many threads writes."""
    settings = {
        **os.environ,
        **dict.fromkeys(VARIABLES, str(threads)),
        "PYTHONPATH": str(ROOT),
    }
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        call = [sys.executable, "-m", "benchmarks.determinism", "--way", command]
        call += ["--folder", str(folder)]
        subprocess.run(call, cwd=scratch, env=settings, check=True)
        digests = files_in(Path(scratch))
    return {
        k: hashlib.sha256(content).hexdigest()
        for k, content in digests.items()
        if content
    }


def compare(folder: Path) -> None:
    """Print how many different files there are among all settings."""
    if not (folder / "2.csv").exists():
        from robot_sysid.cli import main as run

        for k in (1, 2):
            line = f"{GUESS} {WORDS} --seed {k} --plant-model {TRUTH} --output-dir {folder}/made"
            run([*line.split(), "--save-measurements", f"{folder}/{k}.csv"])
    for command in WAYS:
        digests: dict[str, set[str]] = defaultdict(set)
        for threads in THREADS:
            for name, value in child(command, folder, threads).items():
                digests[name].add(value)
        for name, values in sorted(digests.items()):
            print(f"{command:10s} {name:36s} {len(values)}", flush=True)


def main() -> None:
    """Compare, or be one of the processes that are compared."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--folder", type=Path, help="kept and used again (default: a new one)"
    )
    parser.add_argument("--way", choices=WAYS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.way:
        way = {"functions": functions, "commands": commands}[options.way]
        return way(options.folder)
    with tempfile.TemporaryDirectory() as nowhere:
        folder = (options.folder or Path(nowhere)).absolute()
        folder.mkdir(parents=True, exist_ok=True)
        compare(folder)


if __name__ == "__main__":
    main()
