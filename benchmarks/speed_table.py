"""The table of docs/comparison.md: processor time and memory beside others', in one run.

Run from the checkout, each part some minutes on one core; ``--write`` puts its rows into the page:

    pip install -e ".[dev,bench]"
    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python -m benchmarks.speed_table [--write] [PART...]

Parts: start, logs, arm, many, servo, plan, long, sixty, sysid. Commands are whole processes as
users start them, compiled modules, imports and files included, with the most memory they held; what
several rows compare ran in turns. What is not installed, or lacks its public arm or log, is left
out. A row of the page that is measured again is replaced, with the others of its part.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import platform
import re
import sys
import tempfile
import time
from collections.abc import Iterator
from importlib.metadata import version
from itertools import chain
from pathlib import Path

import numpy as np

import robot_sysid as rs
from benchmarks import against_mujoco_sysid, linear_cost, servo_arm, whole_arm
from robot_sysid.parser import load_robot_model
from tests.support import arms
from tests.support.places import DATA, GUESS, MODELS, ROOT, TRUTH

PAGE = ROOT / "docs" / "comparison.md"
BEGIN = "<!-- speed: python -m benchmarks.speed_table -->"
END = "<!-- end of speed -->"
HEADING = (
    "| Task | With | Processor time | Times | Memory | Error |",
    "| --- | --- | --- | --- | --- | --- |",
)
ROUNDS = 5
MANY = (1, 4, 12)


def row(task: str, who: str, seconds: float, base: float, more: str = " | |") -> str:
    """One line; ``base`` is the time of the first row that it is compared with."""
    times = "" if seconds in (base, math.inf) else f"{float(f'{seconds / base:.2g}'):g}"
    took = (
        f"{seconds:.2f} s"
        if seconds < math.inf
        else f"not within {linear_cost.LIMIT:.0f} s"
    )
    return f"| {task} | {who} | {took} | {times} | {more}"


def process(*words: str) -> tuple[float, float]:
    """(processor time [s], peak memory [MB]) of Python with some words, the least of a few."""
    each = [linear_cost.watched(sys.executable, *words)[:2] for _ in range(ROUNDS)]
    return min(s for s, _ in each), max(m for _, m in each)


def start_rows() -> Iterator[str]:
    """What a command costs before it does anything, and the Quick Start."""
    with tempfile.TemporaryDirectory() as out:
        command = ("-m", "robot_sysid")
        task = "a process"
        quick = (*command, str(GUESS), "--output-dir", out, "--seed", "0", "--quiet")
        runs = {
            "importing mujoco and numpy": ("-c", "import mujoco, numpy"),
            "Python alone": ("-c", "pass"),
            "robot-sysid --version": (*command, "--version"),
            "robot-sysid --help": (*command, "--help"),
            "robot-sysid, the README's Quick Start": quick,
        }
        for words in runs.values():  # which compiles
            linear_cost.watched(sys.executable, *words)
        found = {name: process(*words) for name, words in runs.items()}
    base = next(iter(found.values()))[0]
    for name, (seconds, memory) in found.items():
        yield row(task, name, seconds, base, f"{memory:.0f} MB | |")


def log_rows() -> Iterator[str]:
    """``identify`` of logs of 15, 150 and 1500 s at 1 kHz."""
    with tempfile.TemporaryDirectory() as name:
        base = None
        for length in linear_cost.LENGTHS[:3]:
            linear_cost.log(Path(name), length)
            seconds, memory = linear_cost.log(Path(name), length)
            base = base or (seconds, memory)
            task = f"`identify`, 7 joints, {length:g} s at 1 kHz"
            more = f"{memory:.0f} MB"
            yield row(
                task,
                "robot-sysid",
                seconds,
                base[0],
                f"{more}, {memory / base[1]:.1f} | |",
            )


def arm_rows() -> Iterator[str]:
    """Every link of seven joints from 15 000 samples."""
    if (
        importlib.util.find_spec("pinocchio") is None
        or not (DATA / "kuka_lwr4").exists()
    ):
        return
    spent = whole_arm.durations()
    for name, seconds in spent.items():
        who = name if "pinocchio" in name else f"robot-sysid, {name}"
        task = "every link, 7 joints, 15 000 samples in memory"
        yield row(task, who, seconds, next(iter(spent.values())))


def many_rows() -> Iterator[str]:
    """``rs.identify`` of several logs at once, in one process."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "log.csv"
        linear_cost.recorded(path, 15.0)
        rs.identify(GUESS, rs.read_log(path, GUESS))
        for count in MANY:
            # A log remembers what its cut-off is chosen from.
            logs = [rs.read_log(path, GUESS) for _ in range(count)]
            before = time.process_time()
            rs.identify(GUESS, logs)
            seconds = time.process_time() - before
            each = seconds / count
            task = f"`rs.identify`, each of {count} logs of 15 s in memory"
            yield row(task, "robot-sysid", each, each)


def servo_rows() -> Iterator[str]:
    """An arm without torque sensors, from 40 s."""
    path = MODELS / "so101" / "so101_new_calib.xml"
    if not path.exists():
        return
    robot = load_robot_model(path, joint="wrist_roll")
    rng = np.random.default_rng(1)
    with tempfile.TemporaryDirectory() as name:
        log = Path(name) / "log.csv"
        arm = servo_arm.other_than(robot, rng)
        servo_arm.write_log(log, arm, *servo_arm.commands(robot, rng), 0.0015)
        words = (
            "--joint",
            "wrist_roll",
            "--torque-from",
            "position-error",
            "--output-dir",
            name,
        )
        seconds, memory = linear_cost.measured("identify", str(path), str(log), *words)
    yield row("servos, friction and rotors of 5 joints, 40 s", "robot-sysid", seconds, seconds,
              f"{memory:.0f} MB | |")  # fmt: skip


def plan_rows() -> Iterator[str]:
    """``plan`` as it stops by itself, and for a time that is asked for."""
    command = (
        sys.executable,
        "-m",
        "robot_sysid",
        "plan",
        str(GUESS),
        "--seed",
        "0",
        "--verbose",
    )
    base = None
    with tempfile.TemporaryDirectory() as name:
        for who, words in (
            ("", ()),
            (", 24 s asked for", ("--excitation-time-budget", "24")),
        ):
            run = linear_cost.watched(*command, "--output-dir", name, *words)
            base = base or run
            gain = re.search(r"([\d.]+) times better", run[2])
            found = f"{run[1]:.0f} MB | {gain[1] if gain else '?'} times the best random one |"
            yield row(
                "`plan`, 7 joints, 15 s", f"robot-sysid{who}", run[0], base[0], found
            )


def long_rows() -> Iterator[str]:
    """A simulated run of almost half an hour."""
    with tempfile.TemporaryDirectory() as name:
        words = ("--plant-model", str(TRUTH), "--duration", "1600", "--seed", "0")
        seconds, memory = linear_cost.measured(str(GUESS), *words, "--output-dir", name)
        task = "7 joints, a simulated arm, 1600 s at 1 kHz"
        yield row(task, "robot-sysid", seconds, seconds, f"{memory:.0f} MB | |")


def sixty_rows() -> Iterator[str]:
    """Sixty joints in a row: the self-test, a simulated arm, a plan."""
    with tempfile.TemporaryDirectory() as name:
        joint = 'range="-2.5 2.5" frictionloss=".4" damping=".1"'
        sixty = Path(name) / "sixty.xml"
        out = ("--seed", "0", "--output-dir", f"{name}/out")
        sixty.write_text(arms.serial_arm((arms.Z, arms.Y, arms.X) * 20, joint=joint))
        for task, words in (
            ("the model itself", (str(sixty),)),
            ("a simulated arm", (str(sixty), "--plant-model", str(sixty))),
            ("`plan`", ("plan", str(sixty))),
        ):
            seconds, memory = linear_cost.measured(*words, *out)
            yield row(
                f"60 joints, {task}",
                "robot-sysid",
                seconds,
                seconds,
                f"{memory:.0f} MB | |",
            )


def sysid_rows() -> Iterator[str]:
    """Friction, damping and rotor inertia of seven joints from 15 s."""
    # Without its own dependencies, the module is there and empty.
    found = importlib.util.find_spec("mujoco.sysid") is not None
    if not (
        found and hasattr(importlib.import_module("mujoco.sysid"), "ModelSequences")
    ):
        return
    sides = against_mujoco_sysid.compared()
    base = next(iter(sides.values())).seconds
    task = "friction, damping and rotor inertia of 7 joints, 7500 samples in memory"
    for name, side in sides.items():
        yield row(
            task, name, side.seconds, base, f" | {side.error:.2f} mrad held out |"
        )


PARTS = {
    **{"start": start_rows, "logs": log_rows, "arm": arm_rows, "many": many_rows},
    **{"servo": servo_rows, "plan": plan_rows, "long": long_rows, "sixty": sixty_rows},
    **{"sysid": sysid_rows},
}


def main(*words: str) -> None:
    """Print the table; put its rows into the page where that is asked for."""
    asked = [w for w in words if w != "--write"]
    rows = list[str]()
    print("\n".join(HEADING), flush=True)
    for part in asked or PARTS:
        for line in PARTS[part]():
            print(line, flush=True)
            rows.append(line)
    versions = ", ".join(f"{name} {version(name)}" for name in ("numpy", "mujoco"))
    note = f"Python {platform.python_version()}, {versions}, one thread."
    print(f"\n{note}")
    if "--write" in words:
        rewrite(PAGE, BEGIN, END, [*HEADING, *replaced(rows), "", note])


def replaced(rows: list[str]) -> list[str]:
    """The page's rows, those of a task that was measured again replaced, new tasks behind."""
    table = PAGE.read_text(encoding="utf-8").partition(BEGIN)[2].partition(END)[0]
    old = dict[str, list[str]]()
    new = dict[str, list[str]]()
    there = [line for line in table.splitlines() if line.startswith("|")][
        len(HEADING) :
    ]
    for tasks, lines in ((old, there), (new, rows)):
        for line in lines:
            tasks.setdefault(line.split("|")[1], []).append(line)
    return [*chain.from_iterable({**old, **new}.values())]


def rewrite(page: Path, begin: str, end: str, lines: list[str]) -> None:
    """Put lines between two marks of a page."""
    text = page.read_text(encoding="utf-8")
    before, _, rest = text.partition(begin)
    after = rest.partition(end)[2]
    page.write_text(
        "\n".join([before + begin, "", *lines, "", end]) + after, encoding="utf-8"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
