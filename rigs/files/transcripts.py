"""What commands print, whole: a table of command lines, the files that they need, and how they end.

``python -m rigs.files.recorded_results`` records each in tests/commands/transcripts. Times, paths
and releases are masked. The arm has three joints and 2 kg at its flange that its model lacks.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import shutil
import signal
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from rigs.arms import small_arms
from rigs.files import pages
from rigs.files.places import ROOT
from robot_sysid.cli import main

FOLDER = ROOT / "tests" / "commands" / "transcripts"
AXES = (small_arms.Z, small_arms.Y, small_arms.X)
MOTORS = "--export-damiao --motor-type DM8009 --motor-type DM8009 --motor-type DM4340"
_ELAPSED = re.compile(r"^.*: \d+ %, \d+ s\n", re.MULTILINE)
"""Lines of long work on a slow computer: what share is done, and since when it runs."""
_SCRATCH = re.compile(r"\S*/\.robot-sysid-\w+")
"""Folder in which a command works until its result is whole."""
_RELEASE = re.compile(r"\bMuJoCo \d[\w.]*")


@dataclass(frozen=True)
class Transcript:
    """A command line beside what it needs.

    Attributes:
        line: the words after ``robot-sysid``.
        files: names in ``FILES`` that have to be in the working folder.
        code: the exit code.
        interrupted_at: Ctrl-C is pressed when this is printed; "" for never.
    """

    line: str
    files: tuple[str, ...]
    code: int = 0
    interrupted_at: str = ""


TRANSCRIPTS = {
    "self_test": Transcript("my_arm.xml --seed 1 --duration 5", ("my_arm.xml",)),
    "plan": Transcript(
        "plan my_arm.xml --excitation sines --seed 1 --duration 5 --output-dir planned",
        ("my_arm.xml",),
    ),
    "log": Transcript("log log.csv my_arm.xml", ("my_arm.xml", "log.csv")),
    "log_with_a_wrong_sign": Transcript(
        "log wrong.csv my_arm.xml", ("my_arm.xml", "wrong.csv"), 2
    ),
    "identify": Transcript(
        "identify my_arm.xml log.csv --output-dir found", ("my_arm.xml", "log.csv")
    ),
    "check": Transcript("check my_arm.xml log.csv", ("my_arm.xml", "log.csv")),
    "check_of_a_changed_arm": Transcript(
        "check my_arm.xml changed.csv", ("my_arm.xml", "changed.csv"), 1
    ),
    "payload": Transcript(
        "payload my_arm.xml --empty empty.csv --loaded log.csv --output-dir weighed",
        ("my_arm.xml", "empty.csv", "log.csv"),
    ),
    "report": Transcript("report found", ("my_arm.xml", "log.csv", "found")),
    "motors_simulate": Transcript(
        "motors simulate made/damiao_trajectory.csv --model my_arm.xml --rate 50 --fd",
        ("my_arm.xml", "made"),
    ),
    "motors_simulate_stopped": Transcript(
        "motors simulate made/damiao_trajectory.csv --model my_arm.xml --rate 50 --fd "
        "--plant-model heavy.xml",
        ("my_arm.xml", "heavy.xml", "made"),
        3,
    ),
    "missing_file": Transcript("identify my_arm.xml lgo.csv", ("my_arm.xml",), 2),
    "unknown_option": Transcript(
        "identify my_arm.xml log.csv --outptu-dir found", ("my_arm.xml", "log.csv"), 2
    ),
    "interrupted": Transcript(
        "my_arm.xml", ("my_arm.xml",), 130, "Running MuJoCo simulation"
    ),
}
"""Name of a recorded file, without its ending, to the command whose console it has."""


def _write_arm(name: str, tip: str = "", **others: str) -> None:
    Path(name).write_text(
        small_arms.serial_arm(AXES, tip=tip, **others), encoding="utf-8"
    )


def _write_log(name: str, plant: str, seed: int) -> None:
    make_file(plant)
    make_file("my_arm.xml")
    pages.record(Path(), plant, name, seed, 8.0)


def _write_changed_log(name: str, factor: float) -> None:
    """Write the log with the torque of its second joint times a factor."""
    make_file("log.csv")
    title, *rows = Path("log.csv").read_text(encoding="utf-8").splitlines()
    column = title.split(",").index("joint1_torque")
    lines = [title]
    for row in rows:
        cells = row.split(",")
        cells[column] = repr(factor * float(cells[column]))
        lines.append(",".join(cells))
    Path(name).write_text("\n".join([*lines, ""]), encoding="utf-8")


def _load(mass: float) -> str:
    """Return a steel block at the flange as XML."""
    inertia = " ".join([f"{2e-3 * mass:g}"] * 3)
    inertial = f'<inertial pos="0 .02 .03" mass="{mass:g}" diaginertia="{inertia}"/>'
    return f'<body pos="0 0 .1">{inertial}</body>'


def _run(line: str) -> None:
    with _console(""):
        main(line.split())


FILES: Mapping[str, Callable[[], None]] = {
    "my_arm.xml": lambda: _write_arm("my_arm.xml", **pages.MODEL),
    "empty.xml": lambda: _write_arm("empty.xml", **pages.ARM),
    "loaded.xml": lambda: _write_arm("loaded.xml", _load(2.0), **pages.ARM),
    "heavy.xml": lambda: _write_arm("heavy.xml", _load(30.0), **pages.ARM),
    "log.csv": lambda: _write_log("log.csv", "loaded.xml", 0),
    "empty.csv": lambda: _write_log("empty.csv", "empty.xml", 1),
    "changed.csv": lambda: _write_log("changed.csv", "heavy.xml", 2),
    "wrong.csv": lambda: _write_changed_log("wrong.csv", -1.0),
    "found": lambda: _run("identify my_arm.xml log.csv --output-dir found"),
    "made": lambda: _run(
        f"my_arm.xml --seed 1 --duration 1 --sample-rate 100 --output-dir made {MOTORS}"
    ),
}
"""Name of a file or folder to what makes it in the working folder."""


def make_file(name: str) -> None:
    """Make a file or folder in the working folder, where it is not there yet."""
    if not Path(name).exists():
        FILES[name]()


class _Console(io.StringIO):
    """A console that presses Ctrl-C when a text is printed."""

    def __init__(self, interrupted_at: str) -> None:
        super().__init__()
        self._interrupted_at = interrupted_at

    def write(self, text: str) -> int:
        count = super().write(text)
        if self._interrupted_at and self._interrupted_at in text:
            signal.raise_signal(signal.SIGINT)
        return count


@contextlib.contextmanager
def _console(interrupted_at: str) -> Iterator[_Console]:
    console = _Console(interrupted_at)
    with contextlib.redirect_stdout(console), contextlib.redirect_stderr(console):
        yield console


def console_of(transcript: Transcript, workshop: Path) -> str:
    """Return what a command line prints in a folder of its own, and its exit code.

    Args:
        transcript: the command.
        workshop: folder in which files are made, once for all commands.
    """
    words = shlex.split(transcript.line)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        with _working_folder(workshop):
            for file in transcript.files:
                make_file(file)
                copy = shutil.copytree if Path(file).is_dir() else shutil.copy
                copy(file, folder / file)
        with _working_folder(folder), _console(transcript.interrupted_at) as console:
            code = main(words)
    printed = mask(console.getvalue(), folder)
    return f"$ robot-sysid {transcript.line}\n{printed}[exit code {code}]\n"


def mask(text: str, folder: Path) -> str:
    """Return a console without what differs from run to run: paths, times and releases."""
    text = text.replace(str(folder), "FOLDER")
    text = _SCRATCH.sub("SCRATCH", _ELAPSED.sub("", text))
    return _RELEASE.sub("MuJoCo #", text)


@contextlib.contextmanager
def _working_folder(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def recorded_text(name: str) -> str:
    """Return the recorded console of a transcript."""
    return (FOLDER / f"{name}.txt").read_text(encoding="utf-8")


def record() -> None:
    """Record all transcripts."""
    FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as workshop:
        for name, transcript in TRANSCRIPTS.items():
            text = console_of(transcript, Path(workshop))
            (FOLDER / f"{name}.txt").write_text(text, encoding="utf-8")
