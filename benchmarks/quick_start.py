"""The whole Quick Start as a process beside one that only imports mujoco and numpy.

Run from the checkout, on a machine that does nothing else where wall time is to count:

    python -m benchmarks.quick_start

Both run in turns, with numpy's own threads off for both; the least of each is taken.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time

from tests.support.places import GUESS

ROUNDS = 9
IMPORTS = [sys.executable, "-c", "import mujoco, numpy"]
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def spent(command) -> tuple[float, float]:
    """(processor time, wall time) of a process [s]."""
    before, start = os.times(), time.perf_counter()
    environment = {**os.environ, **dict.fromkeys(THREADS, "1")}
    subprocess.run(command, check=True, capture_output=True, env=environment)
    wall, after = time.perf_counter() - start, os.times()
    used = after.children_user + after.children_system
    return used - before.children_user - before.children_system, wall


def main() -> None:
    """Print both times of both, and their ratios."""
    with tempfile.TemporaryDirectory() as folder:
        run = [sys.executable, "-m", "robot_sysid", str(GUESS), "--seed", "0"]
        run += ["--output-dir", folder]
        both = [(spent(IMPORTS), spent(run)) for _ in range(ROUNDS)]
    for kind, name in enumerate(("processor time", "wall time")):
        imports, whole = (min(each[who][kind] for each in both) for who in (0, 1))
        ratio = whole / imports
        print(f"{name}: imports {imports:.3f} s, Quick Start {whole:.3f} s, {ratio:.2f} times")


if __name__ == "__main__":
    main()
