"""The table of benchmarks/speed/speed.md: processor time and memory beside other tools, in one run.

Run from the checkout, each part some minutes on one core; ``--write`` puts its rows into the page:

    pip install -e ".[dev,bench]"
    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python -m benchmarks.speed.speed_table [--write]
        [PART...]

Parts: start, logs, joints, servo, plan, sysid. Commands are whole processes as users start them,
with compiled modules, imports and files included, and their peak memory. Parts whose library,
public arm or log is missing are left out. New rows replace the page's rows of the same task.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import math
import os
import platform
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from importlib.metadata import version
from itertools import chain
from pathlib import Path

import numpy as np

from benchmarks.accuracy import against_mujoco_sysid, servo_arm
from rigs.arms import small_arms
from rigs.arms.walk import TrueArm
from rigs.files.page_tables import PageTable
from rigs.files.places import GUESS, MODELS, ROOT, TRUTH
from robot_sysid.parser import load_robot_model

TABLE = PageTable(
    ROOT / "benchmarks" / "speed" / "speed.md",
    "speed",
    "python -m benchmarks.speed.speed_table",
)
HEADING = (
    "| Task | With | Processor time | Times | Memory | Error |",
    "| --- | --- | --- | --- | --- | --- |",
)
ROUNDS = 5
"""Repetitions of a process; the least time and the largest memory count."""
LENGTHS = (15.0, 150.0, 1500.0)
"""Durations of logs [s]."""
RATE = 1000.0
"""Samples per second of logs [Hz]."""
JOINTS = (7, 14, 28, 56)
"""Joints of arms whose commands are measured."""
LIMIT = 540.0
"""Time after which a process is ended [s]."""
PLANNED = {
    "UR5e": ("universal_robots_ur5e/ur5e.xml", "wrist_3"),
    "OpenArm": ("openarm_v2/openarm_bimanual.xml", "openarm_left_joint7"),
    "Kinova Gen3": ("kinova_gen3/gen3.xml", "joint_7"),
    "Panda": ("franka_panda/panda.xml", "joint7"),
    "FR3": ("franka_fr3/FrankaFR3_7DoF.urdf", "fr3_joint7"),
    "iiwa 14": ("kuka_iiwa_14/iiwa14.xml", "joint7"),
    "xArm7": ("ufactory_xarm7/xarm7.xml", "joint7"),
    "WXAI": ("trossen/wxai/wxai_follower.xml", "joint_5"),
    "ALOHA": ("aloha/aloha.xml", "left/wrist_rotate"),
    "SO-101": ("so101/so101_new_calib.xml", "wrist_roll"),
}
"""Public arms that motions are planned for: model and terminal joint of each."""
# Waits for one child, so that its peak memory and its time are those of all children.
WATCHER = f"""
import resource, subprocess, sys
try:
    code = subprocess.run(sys.argv[1:], stdout=sys.stderr, timeout={LIMIT}).returncode
except subprocess.TimeoutExpired:
    code = -1
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(code, used.ru_utime + used.ru_stime, used.ru_maxrss)
"""


def watch_process(*command: str) -> tuple[float, float, str]:
    """Run a process with compiled modules, as users start it.

    Returns:
        Processor time [s], infinite if it was ended; peak memory [MB]; printed text.
    """
    environment = dict(os.environ)
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    watcher = subprocess.run(
        [sys.executable, "-c", WATCHER, *command],
        check=True,
        capture_output=True,
        text=True,
        env=environment,
    )
    code, seconds, memory = map(float, watcher.stdout.split())
    # Exit code 1: the result must not be used; its cost is the same.
    assert code in (0.0, 1.0, -1.0), (command, watcher.stderr)
    seconds = seconds if code >= 0.0 else math.inf
    unit = 1024.0 if sys.platform != "darwin" else 1024.0**2
    return seconds, memory / unit, watcher.stderr


def run_command(*arguments: str) -> tuple[float, float]:
    """Run robot-sysid; return its processor time [s] and peak memory [MB]."""
    command = (sys.executable, "-m", "robot_sysid", *arguments)
    return watch_process(*command)[:2]


def write_log(path: Path, duration: float) -> None:
    """Write a log of the example arm [s]; a long one repeats one of 150 s."""
    period = min(duration, LENGTHS[1])
    piece = path.with_suffix(".piece")
    motion = ("--duration", str(period), "--sample-rate", str(RATE), "--seed", "0")
    plant = ("--plant-model", str(TRUTH), "--noise-torque", "0.05")
    files = (
        "--save-measurements",
        str(piece),
        "--output-dir",
        str(path.parent / "out"),
    )
    run_command(str(GUESS), *motion, *plant, *files)
    lines = piece.read_text().splitlines(True)
    title, *rows = [line for line in lines if not line.startswith("#")]
    with path.open("w", encoding="utf-8") as file:
        file.write(title)
        for repetition in range(round(duration / period)):
            for row in rows if repetition == 0 else rows[1:]:
                instant, _, cells = row.partition(",")
                file.write(f"{float(instant) + repetition * period!r},{cells}")


def format_row(
    task: str, tool: str, seconds: float, base: float, memory: str = "", error: str = ""
) -> str:
    """Return one row of the table; ``base`` is the time of the task's first row [s]."""
    ratio = f"{float(f'{seconds / base:.2g}'):g}"
    times = "" if seconds in (base, math.inf) else ratio
    duration = f"{seconds:.2f} s" if seconds < math.inf else f"not within {LIMIT:.0f} s"
    return f"| {task} | {tool} | {duration} | {times} | {memory} | {error} |"


def start_rows() -> Iterator[str]:
    """Yield the cost of importing libraries, and of the Quick Start."""
    with tempfile.TemporaryDirectory() as out:
        options = ("--output-dir", out, "--seed", "0")
        processes = {
            "importing mujoco and numpy": ("-c", "import mujoco, numpy"),
            "robot-sysid, the README's Quick Start": (
                "-m",
                "robot_sysid",
                str(GUESS),
                *options,
            ),
        }
        base = None
        for tool, arguments in processes.items():
            watch_process(sys.executable, *arguments)  # compiles the modules
            runs = [watch_process(sys.executable, *arguments) for _ in range(ROUNDS)]
            seconds = min(run[0] for run in runs)
            memory = max(run[1] for run in runs)
            base = base or seconds
            yield format_row("a process", tool, seconds, base, f"{memory:.0f} MB")


def log_rows() -> Iterator[str]:
    """Yield the cost of ``identify`` on logs of 15, 150 and 1500 s at 1 kHz."""
    with tempfile.TemporaryDirectory() as name:
        out = ("--output-dir", f"{name}/out")
        base = None
        for length in LENGTHS:
            path = Path(name) / f"{length:g}.csv"
            write_log(path, length)
            for _ in range(2):  # the first run compiles the modules
                seconds, memory = run_command("identify", str(GUESS), str(path), *out)
            base = base or (seconds, memory)
            task = f"`identify`, 7 joints, {length:g} s at 1 kHz"
            cell = f"{memory:.0f} MB, {memory / base[1]:.1f}"
            yield format_row(task, "robot-sysid", seconds, base[0], cell)


def long_arm(n_joints: int) -> str:
    """Return the XML of a chain of joints 2.5 m long, whose links weigh differently."""
    axes = (small_arms.Z, small_arms.Y, small_arms.X)
    text = small_arms.serial_arm(tuple(axes[k % 3] for k in range(n_joints)))
    rng = np.random.default_rng(n_joints)
    step = min(0.25, 2.5 / n_joints)
    text = text.replace("0 .02 .25", f"0 .02 {step:.3g}")
    text = text.replace(".01 -.02 .1", f".01 -.02 {0.4 * step:.3g}")
    return re.sub('mass="[^"]+"', lambda _: f'mass="{rng.uniform(0.6, 1.8):.4g}"', text)


def joint_rows() -> Iterator[str]:
    """Yield the cost of each command for arms of more and more joints, from logs of 10 s."""
    for n_joints in JOINTS:
        with tempfile.TemporaryDirectory() as name:
            model, empty, loaded = (
                f"{name}/{file}" for file in ("arm.xml", "empty.csv", "loaded.csv")
            )
            Path(model).write_text(long_arm(n_joints))
            arm = TrueArm(load_robot_model(Path(model)))
            arm.record(Path(empty), arm.first_plan, 0.0)
            arm.record(Path(loaded), arm.first_plan, 1.0)
            out = ("--output-dir", f"{name}/out")
            commands = {
                "self-test": (model, "--seed", "0", *out),
                "plan": ("plan", model, "--seed", "0", *out),
                "log": ("log", empty, model),
                "identify": ("identify", model, empty, *out),
                "payload": (
                    *("payload", model, "--empty", empty, "--loaded", loaded),
                    *out,
                ),
                "check": ("check", model, loaded, "--since", empty),
            }
            for command, arguments in commands.items():
                seconds, memory = run_command(*arguments)
                task = f"`{command}`, {n_joints} joints in a row, 10 s"
                yield format_row(
                    task, "robot-sysid", seconds, seconds, f"{memory:.0f} MB"
                )


def servo_rows() -> Iterator[str]:
    """Yield the cost of an arm without torque sensors, from 40 s."""
    path = MODELS / "so101" / "so101_new_calib.xml"
    if not path.exists():
        return
    robot = load_robot_model(path, joint="wrist_roll")
    rng = np.random.default_rng(1)
    with tempfile.TemporaryDirectory() as name:
        log = Path(name) / "log.csv"
        arm = servo_arm.other_than(robot, rng)
        servo_arm.write_log(log, arm, *servo_arm.commands(robot, rng), 0.0015)
        options = ("--joint", "wrist_roll", "--torque-from", "position-error")
        seconds, memory = run_command(
            "identify", str(path), str(log), *options, "--output-dir", name
        )
    task = "servos, friction and rotors of 5 joints, 40 s"
    yield format_row(task, "robot-sysid", seconds, seconds, f"{memory:.0f} MB")


def plan_rows() -> Iterator[str]:
    """Yield the cost of ``plan`` for public arms, and the errors to expect of files, by two seeds.

    The larger time and memory count.
    """
    for arm, (model, joint) in PLANNED.items():
        if not (MODELS / model).exists():
            continue
        runs = []
        for seed in ("1", "2"):
            with tempfile.TemporaryDirectory() as name:
                options = ("--joint", joint, "--seed", seed, "--json")
                command = ("plan", str(MODELS / model), *options, "--output-dir", name)
                *cost, text = watch_process(
                    sys.executable, "-m", "robot_sysid", *command
                )
            # Progress is printed before and after the result.
            result, _ = json.JSONDecoder().raw_decode(text[text.index("{") :])
            runs.append((*cost, 100.0 * result["elsewhere"]["after"]))
        seconds, memory, _ = map(max, zip(*runs))
        errors = ", ".join(f"{run[-1]:.2f}" for run in runs)
        cells = (f"{memory:.0f} MB", f"{errors} % expected elsewhere")
        yield format_row(f"`plan`, {arm}", "robot-sysid", seconds, seconds, *cells)


def sysid_rows() -> Iterator[str]:
    """Yield the cost of friction, damping and rotor inertia of seven joints from 15 s."""
    # Without its own dependencies, the module exists and is empty.
    if importlib.util.find_spec("mujoco.sysid") is None:
        return
    if not hasattr(importlib.import_module("mujoco.sysid"), "ModelSequences"):
        return
    sides = against_mujoco_sysid.compare_sides()
    base = next(iter(sides.values())).seconds
    task = "friction, damping and rotor inertia of 7 joints, 7500 samples in memory"
    for tool, side in sides.items():
        error = f"{side.error:.2f} mrad held out"
        yield format_row(task, tool, side.seconds, base, "", error)


PARTS = {
    "start": start_rows,
    "logs": log_rows,
    "joints": joint_rows,
    "servo": servo_rows,
    "plan": plan_rows,
    "sysid": sysid_rows,
}


def main(*arguments: str) -> None:
    """Print the table; put it into the page with ``--write``."""
    names = [name for name in arguments if name != "--write"] or list(PARTS)
    print("\n".join(HEADING), flush=True)
    rows: list[str] = []
    for name in names:
        for row in PARTS[name]():
            print(row, flush=True)
            rows.append(row)
    versions = ", ".join(f"{name} {version(name)}" for name in ("numpy", "mujoco"))
    note = f"Python {platform.python_version()}, {versions}, one thread."
    print(f"\n{note}")
    if "--write" in arguments:
        TABLE.write([*HEADING, *merge_rows(rows), "", note])


def merge_rows(rows: list[str]) -> list[str]:
    """Return the page's rows with those of measured tasks replaced, new tasks last."""
    page_rows = [line for line in TABLE.read().splitlines() if line.startswith("|")]
    old_tasks = rows_by_task(page_rows[len(HEADING) :])
    tasks = {**old_tasks, **rows_by_task(rows)}
    return [*chain.from_iterable(tasks.values())]


def rows_by_task(rows: list[str]) -> dict[str, list[str]]:
    """Return rows by their first cell, in order."""
    tasks: dict[str, list[str]] = {}
    for row in rows:
        tasks.setdefault(row.split("|")[1], []).append(row)
    return tasks


if __name__ == "__main__":
    main(*sys.argv[1:])
