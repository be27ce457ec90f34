"""What happens to the program that plays, or around it, while it moves an arm in real time.

The program is ``robot-sysid motors play``; the arm is another process, behind a pseudo-terminal.
"""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rigs.motors.damiao_rig import trajectory_file
from rigs.motors.fault_bench import RunRecord, departures
from rigs.motors.incident_arms import SMALL, SMALL_ARM
from rigs.motors.realtime_arm import arm_process

PLAY = (sys.executable, "-m", "robot_sysid", "motors", "play")
RATE = 100.0
WATCHDOG = 0.15
BEGINS = 1.2
"""When it happens, after the trajectory has begun [s]."""
PATIENCE = 30.0
TRIES = 4
LATE = "late for a control cycle"
SINKS = 0.5
"""How long the arm is watched after the program has ended [s]."""


def send_signals(*names, apart=0.0):
    """Return what sends signals, a time apart [s]."""

    def act(player):
        for name in names:
            player.send_signal(getattr(signal, name))
            time.sleep(apart)

    return act


def close_console(player):
    """End the program that reads what is printed, as ``head`` does."""
    player.reader.kill()


def small_files_only():
    """Let no file grow beyond 20 kB, as on a disk that is full."""
    # Unix only.
    import resource

    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))


STOPPED_CODE = 3
"""Exit code of a run that was stopped."""


@dataclass(frozen=True)
class ProcessCase:
    """Something that happens to the program, and what has to come of it.

    Attributes:
        name: of the incident.
        act: what happens; is called with the program's process.
        code: exit code; minus the number of the signal that killed it.
        words: of the message.
        prepare: called in the program's process before it begins.
        bound: on the departure until the motors are off [rad].
        off_within: how long after it happened the motors are off [s].
        brakes: whether the arm has come to rest when they are switched off.
    """

    name: str
    act: Callable
    code: int
    words: str = ""
    prepare: Callable | None = None
    bound: float = 0.05
    off_within: float = 2.5
    brakes: bool = True


UNDISTURBED = ProcessCase("nothing", send_signals(), 0)


@dataclass(frozen=True)
class Result:
    """What came of an incident.

    Attributes:
        departure: how far a joint got from its path until the motors were off [rad].
        off_after: how long after it happened they were off [s].
        end_speed: mean speed of the fastest joint in the last 50 ms before [rad/s].
        code: exit code of the program.
        words: all that it said.
    """

    incident: ProcessCase
    departure: float
    off_after: float
    end_speed: float
    code: int
    words: str

    @property
    def message(self) -> str:
        """The error, or what else it said last."""
        lines = self.words.strip().splitlines()
        errors = [line for line in lines if "error: " in line]
        return [*lines, *errors][-1].replace("robot-sysid: error: ", "")


def play(folder: Path, incident: ProcessCase) -> tuple[RunRecord, int, str]:
    """Play while something happens; return the record, exit code and what was said.

    SystemExit where it is not played: a computer with other things to do answers too late.
    """
    folder.mkdir()
    model = folder / "arm.xml"
    model.write_text(SMALL_ARM)
    planned = SMALL.plan().trajectory
    motion = planned.time, planned.q, planned.qd, planned.tau
    types = [joint.motor_type for joint in planned.joints]
    trajectory = trajectory_file(folder, motion, *types).path
    truth = folder / "truth.txt"
    arguments = [str(trajectory), "--model", str(model)]
    watched = [*arguments, "--watchdog", str(WATCHDOG), "--truth", str(truth)]
    moments = {}
    said = []

    def act():
        moments["onset"] = time.monotonic()
        incident.act(player)

    def hear(line):
        said.append(line)
        if line.startswith("stopping"):
            moments["stop"] = time.monotonic()
        if line.startswith("playing"):
            threading.Timer(BEGINS, act).start()

    with arm_process(watched) as (device, _):
        record = ["--record", str(folder / "measured.csv")]
        options = ["--rate", f"{RATE:g}", "--yes", "--accept-directions", *record]
        bus = ["--interface", "slcan", "--channel", device]
        player = subprocess.Popen(
            [*PLAY, *arguments, *bus, *options],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True, preexec_fn=incident.prepare,
        )  # fmt: skip
        player.reader = subprocess.Popen(
            ["cat"], stdin=player.stdout, stdout=subprocess.PIPE, text=True
        )
        # A pipe lives as long as anybody may read it.
        player.stdout.close()
        for line in player.reader.stdout:
            hear(line)
        said.append(player.stderr.read())
        code = player.wait(PATIENCE)
        player.reader.wait()
        player.reader.stdout.close()
        player.stderr.close()
        time.sleep(SINKS)

    now, enabled, *positions = np.loadtxt(truth).T
    since = now[np.argmax(enabled == len(positions))]
    is_off = (enabled == 0) & (now > since)
    end = now[np.argmax(is_off)] if np.any(is_off) else np.inf
    if not moments:
        raise SystemExit("".join(said))
    onset = min(moments.values())
    # A stop that nobody heard of began at once.
    stop_at = moments.get("stop", onset if code == STOPPED_CODE else None)
    q = np.transpose(positions)
    phases = [(since, "enabled")]
    nobody = np.zeros((0, 2))
    errors = "".join(said)
    run = RunRecord(onset, now, q, 0.0 * q, nobody, phases, stop_at, end, errors, False)
    return run, code, errors


def results_of(folder: Path, incidents: Iterable[ProcessCase]) -> Iterator[Result]:
    """Yield what comes of incidents, beside an undisturbed run; files go into a new folder."""
    clean, _, _ = _play_in_time(folder, UNDISTURBED)
    for incident in incidents:
        run, code, words = _play_in_time(folder, incident)
        until = min(run.disabled_at, run.time[-1])
        departure = float(np.max(departures(run, clean, until)))
        off_after = run.disabled_at - run.onset
        is_last = (run.time > until - 0.05) & (run.time <= until)
        end_speed = float(np.max(np.ptp(run.q[is_last], axis=0))) / 0.05
        yield Result(incident, departure, off_after, end_speed, code, words)


def _play_in_time(folder: Path, incident: ProcessCase) -> tuple[RunRecord, int, str]:
    """Play until a run was not spoilt by a busy computer, a few times at most."""
    for attempt in range(TRIES):
        with contextlib.suppress(SystemExit):
            run, code, words = play(folder / f"{incident.name} {attempt}", incident)
            if LATE not in words or LATE in incident.words:
                return run, code, words
    raise SystemExit("this computer is too busy to play in real time")
