"""The whole Quick Start as a process: its time, and its memory on long runs."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import time

import pytest

from tests.support.places import GUESS

IMPORTS_ONLY = [sys.executable, "-c", "import mujoco, numpy"]
# Waits for one child, whose peak memory is then that of all children.
PEAK_MEMORY = """
import resource, subprocess, sys
subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("robot_sysid.cli") is None or not GUESS.exists(),
    reason="needs the command line and the Kinova example",
)


def command(output, *options):
    """Return the command line of the Quick Start with an output folder and options."""
    program = "import sys; from robot_sysid.cli import main; sys.exit(main())"
    where = ["--output-dir", str(output), "--seed", "0"]
    return [sys.executable, "-c", program, str(GUESS), *where, *options]


def run(arguments):
    """Run a process to its end."""
    subprocess.run(arguments, check=True, capture_output=True)


def best_of(arguments, rounds):
    """Return the shortest time of several runs [s]."""
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        run(arguments)
        times.append(time.perf_counter() - start)
    return min(times)


def peak_memory_mb(arguments):
    """Return the largest resident memory of a process [MB]."""
    watched = [sys.executable, "-c", PEAK_MEMORY, *arguments]
    printed = subprocess.run(watched, check=True, capture_output=True, text=True).stdout
    kilobytes = int(printed) if sys.platform != "darwin" else int(printed) / 1024.0
    return kilobytes / 1024.0


def test_quick_start_against_importing_mujoco_and_numpy(benchmark, tmp_path):
    imports = best_of(IMPORTS_ONLY, rounds=7)
    benchmark.pedantic(run, (command(tmp_path),), rounds=7, warmup_rounds=1)
    benchmark.extra_info["imports only [s]"] = round(imports, 3)
    benchmark.extra_info["ratio"] = round(benchmark.stats.stats.min / imports, 2)


def test_an_hour_of_data_against_fifteen_seconds_in_peak_memory(benchmark, tmp_path):
    short = peak_memory_mb(command(tmp_path, "--duration", "15"))
    hour = command(tmp_path, "--duration", "3600")
    peak = benchmark.pedantic(peak_memory_mb, (hour,), rounds=1)
    benchmark.extra_info["15 s [MB]"] = round(short)
    benchmark.extra_info["3600 s [MB]"] = round(peak)
    benchmark.extra_info["ratio"] = round(peak / short, 2)
