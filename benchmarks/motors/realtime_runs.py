"""Undisturbed runs in real time, also on a busy computer: are they played to their ends?

Run from the checkout, nothing else running; it exits with 1 when a run was stopped:

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python -m benchmarks.motors.realtime_runs
    ... --arm kinova --rate 250 --load busy --repeats 5
    ... --setups 5           # motors setup, on a busy computer

``rigs.motors.realtime_arm`` is the arm, behind a pseudo-terminal; ``robot-sysid motors play`` is
another process. On a busy computer a program of ordinary priority keeps each processor busy. The
user needs the right to real-time priority, see docs/motors.md.

A motor never pauses, but the simulated arm does when the computer does. Three delays are printed:
how long the arm kept commands waiting; how long each processor stood still (a virtual machine loses
its processors now and then); and how long a byte took through another pseudo-terminal, which the
kernel serves with ordinary priority. Threads of the highest priority measure the last two. Where
one of them had to wait right before a run was stopped, the run is called spoilt and repeated.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
import re
import subprocess
import sys
import tempfile
import time
import tty
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rigs.files.places import MODELS
from rigs.motors.realtime_arm import arm_process
from rigs.motors.rehearsals import ARMS as REHEARSED_ARMS
from rigs.motors.rehearsals import FAST, Arm, plan

STRONG = ("DM10010L",) * 4 + ("DM4340",) * 3
ARMS = {
    "kinova": REHEARSED_ARMS["kinova"],
    "openarm": REHEARSED_ARMS["openarm"],
    # No test of motors names these two.
    "iiwa": Arm(MODELS / "kuka_iiwa_14" / "iiwa14.xml", "", STRONG),
    "fr3": Arm(MODELS / "franka_fr3" / "FrankaFR3_7DoF.urdf", "", STRONG),
}
RATES = (50.0, 100.0, 250.0, 500.0)
DURATION = 4.0
LOADS = ("idle", "busy")
LONGEST_RUN = 120.0
LEAST_PAUSE = 2e-3
"""From which length on a pause of a processor is noted [s]."""
SPOILING_CYCLES = 1.5
LONGEST_PAUSE = 0.015
"""Pauses in cycles, and at most [s], from which on answers are missed or cycles are too late."""
BEFORE_STOP = 0.3
"""Time before a stop in which a pause counts as its cause [s]."""
TRIES = 3
WITNESS_PRIORITY = 60
PROGRAM = (sys.executable, "-m", "robot_sysid", "motors")


@dataclass(frozen=True)
class Result:
    """The result of a run.

    Attributes:
        ending: "completed", "STOPPED", or "spoilt" where a witness had to wait before the stop.
        message: the last line of the player, or its error.
        arm_delay: longest time that commands waited for the simulated arm, if it says so [ms].
        pauses: longest pause of each processor, and of the line, meanwhile [ms].
    """

    label: str
    ending: str
    message: str
    arm_delay: str
    pauses: tuple[float, ...]

    def __str__(self) -> str:
        *processors, line = (f"{pause:.0f}" for pause in self.pauses)
        waits = f"arm {self.arm_delay} ms, processors {'/'.join(processors)} ms, line {line} ms"
        return f"{self.label:28s} {self.ending:9s} [{waits}] {self.message}"


def spin() -> None:
    """Keep a processor busy for ever."""
    while True:
        pass


@contextlib.contextmanager
def load(is_busy: bool) -> Iterator[None]:
    """Keep each processor busy with a program of ordinary priority."""
    count = os.cpu_count() if is_busy else 0
    programs = [
        multiprocessing.Process(target=spin, daemon=True) for _ in range(count or 0)
    ]
    for program in programs:
        program.start()
    try:
        yield
    finally:
        for program in programs:
            program.kill()


def watch(wait, pauses, leave) -> None:
    """Write down when a wait was over and how long it was [s], until ``leave`` is set."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(WITNESS_PRIORITY))
    while not leave.is_set():
        begun = time.monotonic()
        wait()
        ended = time.monotonic()
        if ended - begun > LEAST_PAUSE:
            pauses.append((ended, ended - begun))


def watch_processor(number: int, pauses, leave) -> None:
    """Append (moment, duration) of each pause of a processor [s]."""
    os.sched_setaffinity(0, {number})
    watch(lambda: time.sleep(1e-3), pauses, leave)


def watch_line(pauses, leave) -> None:
    """Append (moment, duration) of each byte's way through a pseudo-terminal [s]."""
    reader, writer = os.openpty()
    tty.setraw(writer)

    def pass_byte() -> None:
        """Pass one byte through the line, then wait for a millisecond."""
        os.write(writer, b"x")
        os.read(reader, 1)
        time.sleep(1e-3)

    watch(pass_byte, pauses, leave)


@contextlib.contextmanager
def witnesses() -> Iterator[list]:
    """Watch the processors and a line; yield the pauses of each, complete after the block."""
    with multiprocessing.Manager() as manager:
        *processors, line = [manager.list() for _ in range((os.cpu_count() or 1) + 1)]
        leave = multiprocessing.Event()
        programs = [multiprocessing.Process(target=watch_line, args=(line, leave))]
        for number, pauses in enumerate(processors):
            arguments = number, pauses, leave
            programs.append(
                multiprocessing.Process(target=watch_processor, args=arguments)
            )
        for program in programs:
            program.start()
        pauses_seen: list = []
        try:
            yield pauses_seen
        finally:
            leave.set()
            for program in programs:
                program.join()
            pauses_seen += [list(pauses) for pauses in (*processors, line)]


def bus_arguments(name: str, rate: float, trajectory: Path) -> list[str]:
    """Return the arguments that play and simulate have in common."""
    fd = ["--fd"] if rate > FAST else []
    arm = [str(ARMS[name].model), *ARMS[name].joint.split()]
    return [str(trajectory), "--model", *arm, *fd, "--rate", f"{rate:g}"]


def arm_delay(output: list[str]) -> str:
    """Return how long commands waited for the simulated arm [ms], by its last words."""
    delay = re.search(r"waiting for up to (\d+)", "\n".join(output))
    return delay[1] if delay else "< 3"


def longest_pauses(pauses: list, begin: float, end: float) -> tuple[float, ...]:
    """Return the longest pause that each witness saw between two moments [ms]."""
    longest = []
    for witness in pauses:
        meanwhile = [pause for moment, pause in witness if begin < moment < end]
        longest.append(1e3 * max(meanwhile, default=0.0))
    return tuple(longest)


def play(name: str, rate: float, load_name: str, trajectory: Path) -> Result:
    """Play an arm's trajectory once."""
    arguments = bus_arguments(name, rate, trajectory)
    record = trajectory.with_name("measured.csv")
    # Ten cycles at least, as play asks for.
    watchdog = ["--watchdog", f"{max(0.1, 10.5 / rate):g}"]
    enabled_at = None
    stopped_at = None
    lines = []
    with (
        load(load_name == "busy"),
        witnesses() as pauses,
        arm_process([*arguments, *watchdog]) as arm,
    ):
        device, output = arm
        address = ["--interface", "slcan", "--channel", device, "--accept-directions"]
        recording = ["--record", str(record), "--overwrite", "--yes"]
        player = subprocess.Popen(
            [*PROGRAM, "play", *arguments, *address, *recording],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        for line in player.stdout:
            lines.append(line.strip())
            if line.startswith("enabling"):
                enabled_at = time.monotonic()
            if line.startswith("stopping"):
                stopped_at = time.monotonic()
        code = player.wait(LONGEST_RUN)
        ended_at = time.monotonic()
    messages = [
        line for line in lines if line.startswith(("played", "robot-sysid: error"))
    ]
    before_stop = (stopped_at or ended_at) - BEFORE_STOP, stopped_at or ended_at
    is_spoilt = max(longest_pauses(pauses, *before_stop)) > 1e3 * min(
        SPOILING_CYCLES / rate, LONGEST_PAUSE
    )
    return Result(
        f"{name}, {rate:g} Hz, {load_name}",
        "completed" if code == 0 else "spoilt" if is_spoilt else "STOPPED",
        (messages or ["said nothing"])[-1],
        arm_delay(output),
        longest_pauses(pauses, enabled_at or 0.0, ended_at),
    )


def play_until_valid(*run) -> Iterator[Result]:
    """Play until a run is not spoilt, a few times at most; yields all results."""
    for _ in range(TRIES):
        result = play(*run)
        yield result
        if result.ending != "spoilt":
            return


def set_up(name: str, trajectory: Path) -> Result:
    """Return the result of listing and changing a simulated arm's motors on a busy computer."""
    arguments = bus_arguments(name, RATES[1], trajectory)
    n_motors = len(ARMS[name].motors)
    with load(True), witnesses() as pauses, arm_process(arguments) as (device, output):
        change = ["--motor", "1", "--watchdog", "0.2"]
        setup = subprocess.run(
            [*PROGRAM, "setup", "--interface", "slcan", "--channel", device, *change],
            capture_output=True, text=True, timeout=LONGEST_RUN,
        )  # fmt: skip
    listed = len(re.findall(r"^ *\d+ +0x1\d", setup.stdout, re.MULTILINE))
    is_changed = "Done: motor 1 is changed" in setup.stdout
    lines = (setup.stderr or setup.stdout).strip().splitlines()
    return Result(
        f"setup of {name}, busy",
        "completed" if is_changed and listed == n_motors else "STOPPED",
        f"{listed} of {n_motors} motors; {'motor 1 is changed' if is_changed else lines[-1:]}",
        arm_delay(output),
        longest_pauses(pauses, 0.0, float("inf")),
    )


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    options = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    options.add_argument("--arm", choices=list(ARMS), action="append")
    options.add_argument("--rate", type=float, action="append", help="[Hz]")
    options.add_argument("--load", choices=LOADS, action="append")
    options.add_argument("--repeats", type=int, default=1, help="of each combination")
    options.add_argument(
        "--setups", type=int, default=0, help="motors setup instead, per arm"
    )
    return options


def results_of(options: argparse.Namespace, folder: Path) -> Iterator[Result]:
    """Yield what comes of all runs that were asked for."""
    for name in options.arm or ARMS:
        case_folder = folder / name
        case_folder.mkdir()
        trajectory = plan(ARMS[name], case_folder, DURATION)
        for _ in range(options.setups):
            yield set_up(name, trajectory)
        for rate in [] if options.setups else options.rate or RATES:
            for load_name in options.load or LOADS:
                for _ in range(options.repeats):
                    yield from play_until_valid(name, rate, load_name, trajectory)


def main() -> int:
    """Print a line for each run, and how many were stopped; return 1 if any was."""
    options = parser().parse_args()
    endings: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for result in results_of(options, Path(folder)):
            print(result, flush=True)
            endings[result.ending] += 1
    print(", ".join(f"{count} {ending}" for ending, count in endings.items()))
    return 1 if endings["STOPPED"] else 0


if __name__ == "__main__":
    sys.exit(main())
