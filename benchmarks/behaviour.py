"""Compare what two checkouts print and write, byte for byte.

    python -m benchmarks.behaviour record FOLDER [--checkout PATH] [--shared PATH]
    python -m benchmarks.behaviour compare FOLDER FOLDER

``record`` runs the same commands with the sources of one checkout: the example, a plan, a rehearsal
on simulated motors, and logs of real arms where the folder of shared test inputs is there.
``compare`` lists the files that differ and exits with 1; what names the run (dates, times) is left
out. A change that only renames leaves nothing to list.
"""

from __future__ import annotations

import argparse
import difflib
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np

GUESS = "kinova/model/kinova_fullinertia_guess.xml"
ARM = f"identify {GUESS} kinova/true_arm.csv"
MOTORS = "--export-damiao" + 4 * " --motor-type DM10010" + 3 * " --motor-type DM4340"
COMMANDS = {
    "example": "example kinova",
    "self_test": f"{GUESS} --seed 1",
    "identify": f"{ARM} --links --verbose",
    "one_joint": f"{ARM} --torques terminal --no-friction",
    "log": f"log kinova/true_arm.csv {GUESS}",
    "payload": f"payload {GUESS} --empty kinova/empty_arm.csv --loaded kinova/true_arm.csv",
    "plan": f"plan {GUESS} --duration 8 --seed 1 --save-trajectory plan.json",
    "motion": f"plan {GUESS} --duration 8 --excitation sines --seed 1 {MOTORS}",
    "rehearsal": f"motors simulate motion/damiao_trajectory.csv --model {GUESS} "
    "--record measured.csv",
}
"""Commands without test inputs; each runs in the same folder, after those before it."""
_RUN_ONLY = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d\S*|^\(\d{10}\.\d+\)")
"""Dates, and the clock of a recorded bus."""


def real_logs(shared: Path) -> dict[str, str]:
    """Return commands on logs of real arms, by name."""
    data = shared / "data"
    kuka = data / "kuka_lwr4"
    tx40 = data / "tx40"
    ur10e = data / "ur10e_payload"
    runs = [kuka / f"lwr4_hw{number}_200Hz.csv" for number in (1, 2)]
    pair = f"--empty {ur10e}/empty_100Hz.csv --loaded {ur10e}/loaded_2p805kg_100Hz.csv"
    return {
        "kuka": f"identify {kuka}/kuka_lwr4.urdf {runs[0]}",
        "kuka_two": f"identify {kuka}/kuka_lwr4.urdf {runs[0]} {runs[1]}",
        "tx40": f"identify {tx40}/tx40.urdf {tx40}/tx40_500Hz.csv",
        "ur10e": f"identify {ur10e}/ur10e.urdf {ur10e}/empty_100Hz.csv",
        "ur10e_pair": f"payload {ur10e}/ur10e.urdf {pair}",
        "tiago": f"identify {data}/tiago/tiago.urdf {data}/tiago/tiago_100Hz.csv",
    }


def record(folder: Path, checkout: Path, shared: Path) -> None:
    """Run all commands with a checkout's sources and keep what they print and write in a folder."""
    folder.mkdir(parents=True)
    environment = {
        **os.environ,
        "PYTHONPATH": str(checkout.resolve()),
        "OMP_NUM_THREADS": "1",
    }
    commands = {**COMMANDS, **(real_logs(shared.resolve()) if shared.is_dir() else {})}
    for name, line in commands.items():
        arguments = line.split() + (
            ["--output-dir", name] if takes_output(line) else []
        )
        run = subprocess.run(
            [sys.executable, "-m", "robot_sysid", *arguments],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=1800,
        )
        printed = f"exit {run.returncode}\n{run.stdout}\n{run.stderr}"
        (folder / f"{name}.printed.txt").write_text(printed, encoding="utf-8")
        print(f"{name}: exit {run.returncode}", flush=True)


def takes_output(line: str) -> bool:
    """Return whether a command line writes results into a folder."""
    return not line.startswith(("example", "log", "motors"))


def compare(first: Path, second: Path) -> list[str]:
    """Return the differences of all files of two folders, a few lines of each."""
    first_contents, second_contents = (contents(folder) for folder in (first, second))
    differences = [
        f"only in one: {path}"
        for path in sorted(first_contents.keys() ^ second_contents.keys())
    ]
    for path in sorted(first_contents.keys() & second_contents.keys()):
        changed = list(
            difflib.unified_diff(
                first_contents[path], second_contents[path], n=0, lineterm=""
            )
        )[2:]
        if changed:
            differences.append("\n  ".join((path, *changed[:12])))
    return differences


def contents(folder: Path) -> dict[str, list[str]]:
    """Return the lines of each file of a folder, without what names the run.

    Arrays stand as text; ``result`` is the checksum of params.json, which names the folder.
    """
    lines = {}
    for path in folder.rglob("*"):
        if path.suffix == ".npz":
            with np.load(path) as arrays:
                text = "\n".join(
                    f"{key} {arrays[key].tobytes().hex()}"
                    for key in arrays.files
                    if key != "result"
                )
        elif path.is_file() and path.suffix != ".py":
            text = path.read_bytes().decode("utf-8", "replace")
        else:
            continue
        text = text.replace(str(folder.resolve()), "FOLDER")
        name = str(path.relative_to(folder))
        lines[name] = [_RUN_ONLY.sub("(run)", line) for line in text.splitlines()]
    return lines


def main() -> int:
    """Record or compare; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    modes = parser.add_subparsers(dest="mode", required=True)
    recording = modes.add_parser("record")
    recording.add_argument("folder", type=Path)
    recording.add_argument("--checkout", type=Path, default=Path())
    recording.add_argument("--shared", type=Path, default=Path("../shared"))
    comparing = modes.add_parser("compare")
    comparing.add_argument("folders", type=Path, nargs=2)
    options = parser.parse_args()
    if options.mode == "record":
        record(options.folder, options.checkout, options.shared)
        return 0
    differences = compare(*options.folders)
    print("\n".join(differences) or "nothing differs")
    return 1 if differences else 0


if __name__ == "__main__":
    sys.exit(main())
