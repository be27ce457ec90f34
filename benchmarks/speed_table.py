"""The table of docs/comparison.md: processor time beside pinocchio's and mujoco.sysid's.

Run from the checkout, a few minutes on one core; ``--write`` puts it into the page:

    pip install -e ".[dev,bench]"
    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python -m benchmarks.speed_table [--write]

What is not installed, or lacks its public log, is left out of what is printed; nothing is written
then.
"""

from __future__ import annotations

import importlib
import importlib.util
import platform
import sys
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

from benchmarks import against_mujoco_sysid, whole_arm
from tests.support.places import DATA, ROOT

PAGE = ROOT / "docs" / "comparison.md"
BEGIN, END = "<!-- speed: python -m benchmarks.speed_table -->", "<!-- end of speed -->"
HEADING = ("| Task | With | Processor time | Times | Error |", "| --- | --- | --- | --- | --- |")


def arm_rows() -> Iterator[str]:
    """Every link of seven joints from 15 000 samples."""
    spent = whole_arm.durations()
    base, task = next(iter(spent.values())), "every link, 7 joints, 15 000 samples"
    for name, seconds in spent.items():
        who = name if "pinocchio" in name else f"robot-sysid, {name}"
        yield f"| {task} | {who} | {seconds:.2f} s | {seconds / base:.1f} | |"


def sysid_rows() -> Iterator[str]:
    """Friction, damping and rotor inertia of seven joints from 15 s."""
    found = against_mujoco_sysid.compared()
    base = next(iter(found.values())).seconds
    task = "friction, damping and rotor inertia of 7 joints, 7500 samples"
    for name, side in found.items():
        error = f"{side.error:.2f} mrad held out"
        yield f"| {task} | {name} | {side.seconds:.2f} s | {side.seconds / base:.0f} | {error} |"


def table() -> tuple[list[str], bool]:
    """Return (lines, whether nothing is left out)."""
    has_pinocchio = importlib.util.find_spec("pinocchio") is not None
    # Without its own dependencies, the module is there and empty.
    found = importlib.util.find_spec("mujoco.sysid") is not None
    has_sysid = found and hasattr(importlib.import_module("mujoco.sysid"), "ModelSequences")
    arm = has_pinocchio and (DATA / "kuka_lwr4").exists()
    rows = [*(arm_rows() if arm else ()), *(sysid_rows() if has_sysid else ())]
    versions = ", ".join(f"{name} {version(name)}" for name in ("numpy", "mujoco"))
    made = f"Python {platform.python_version()}, {versions}, one thread, best of five or one run."
    return [*HEADING, *rows, "", made], arm and has_sysid


def main(*options: str) -> None:
    """Print the table; write it where that is asked for and it is whole."""
    lines, whole = table()
    print("\n".join(lines))
    if "--write" in options and whole:
        rewrite(PAGE, BEGIN, END, lines)


def rewrite(page: Path, begin: str, end: str, lines: list[str]) -> None:
    """Put lines between two marks of a page."""
    text = page.read_text(encoding="utf-8")
    before, _, rest = text.partition(begin)
    after = rest.partition(end)[2]
    page.write_text("\n".join([before + begin, "", *lines, "", end]) + after, encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
