"""Peak memory of the Quick Start on 15 s and on an hour of data."""

from __future__ import annotations

import sys

from benchmarks.speed.speed_table import watch_process
from rigs.files.places import GUESS


def test_an_hour_of_data_against_fifteen_seconds_in_peak_memory(benchmark, tmp_path):
    options = ("--output-dir", str(tmp_path), "--seed", "0", "--duration")
    short = watch_quick_start(*options, "15")
    peak = benchmark.pedantic(watch_quick_start, (*options, "3600"), rounds=1)
    benchmark.extra_info["15 s [MB]"] = round(short)
    benchmark.extra_info["3600 s [MB]"] = round(peak)
    benchmark.extra_info["ratio"] = round(peak / short, 2)


def watch_quick_start(*options: str) -> float:
    """Run the Quick Start with options; return its peak memory [MB]."""
    command = (sys.executable, "-m", "robot_sysid", str(GUESS), *options)
    return watch_process(*command)[1]
