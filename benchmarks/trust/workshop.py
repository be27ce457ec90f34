"""A small arm with two logs, and each command on them, run in forks of this process.

Everything is imported before, so that a run takes only the time of its work. Every command has two
variants with different results, so that old and new files can be distinguished.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import matplotlib.figure  # noqa: F401
import PIL.Image  # noqa: F401
import scipy.ndimage
import scipy.optimize
import scipy.signal
import scipy.stats  # noqa: F401

from rigs.arms.small_arms import X, Y, Z, serial_arm
from rigs.files.command_line import files_in
from robot_sysid import api, cli  # noqa: F401
from robot_sysid.report import page  # noqa: F401

JOINT = 'range="-2.5 2.5" frictionloss=".4" damping=".2" actuatorfrcrange="-60 60"'
HEAVY = '<inertial pos=".02 .03 .08" mass="1.3" fullinertia=".008 .009 .004 .0004 -.0003 .0005"/>'
LOGGED = "--duration 8 --sample-rate 150"
NOISE = "--noise-torque 0.05 --encoder-resolution 1e-4"
SHORT = "--duration 4 --sample-rate 100"
MOTORS = "--export-damiao" + 3 * " --motor-type DM4340"
OUT = "out"
INTO = f"--output-dir {OUT}"
PLAN = f"plan arm.xml --seed {{k}} {SHORT} --save-trajectory {OUT}/plan.json {INTO}"
SEARCH = "plan search"
EXAMPLE = "example"
COMMANDS = {
    "identify itself": f"arm.xml --seed {{k}} {SHORT} {MOTORS} {INTO}",
    "identify log": f"identify arm.xml log{{k}}.csv {INTO}",
    "plan": f"{PLAN} --excitation sines",
    # Ends when time is up, so that its results are other ones each time.
    SEARCH: f"{PLAN} --excitation-time-budget 2",
    "payload": f"payload arm.xml --empty empty{{k}}.csv --loaded log{{k}}.csv {INTO}",
    "report": f"report {OUT}",
    "log": "log log{k}.csv arm.xml",
    EXAMPLE: f"example kinova {INTO}/kinova",
}
"""Name to command line; {k} is 1 or 2, the variant."""


@dataclass(frozen=True)
class Run:
    """A running command in a fork.

    Attributes:
        process: the fork, leader of a session of its own.
        out, err: files of what it prints.
    """

    process: multiprocessing.Process
    out: Path
    err: Path

    @property
    def code(self) -> int:
        """Return the exit code, or minus the signal's number, once the process has ended."""
        self.process.join()
        return int(self.process.exitcode or 0)

    @property
    def errors(self) -> list[str]:
        """Return the lines on standard error that are no notes."""
        lines = self.err.read_text(encoding="utf-8").splitlines()
        return [line for line in lines if not line.startswith("note: ")]

    def wait_for(self, reached: Callable[[], bool]) -> bool:
        """Wait until something is so; return whether it was before the run ended."""
        while self.process.is_alive():
            if reached():
                return True
            time.sleep(0.001)
        return False


class Workshop:
    """A folder with the files that the commands read.

    Args:
        folder: path of the folder; filled where it is empty.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder.absolute()
        self.out = folder.absolute() / OUT
        self._context = multiprocessing.get_context("fork")
        if (self.folder / "log2.csv").exists():
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        axes = (Z, Y, X)
        (self.folder / "arm.xml").write_text(serial_arm(axes, joint=JOINT))
        (self.folder / "plant.xml").write_text(
            serial_arm(axes, joint=JOINT, tip_inertial=HEAVY)
        )
        plants = {"empty": "arm.xml", "log": "plant.xml"}
        for k, (name, plant) in itertools.product((1, 2), plants.items()):
            log = f"--save-measurements {name}{k}.csv"
            arguments = (
                f"arm.xml --plant-model {plant} {LOGGED} {NOISE} --seed {k} {log}"
            )
            # A short motion may leave a result that is not trusted; its log serves all the same.
            assert self.start([*arguments.split(), "--output-dir", OUT]).code in (0, 1)

    def command_arguments(self, name: str, variant: int) -> list[str]:
        """Return the command's words, its output folder among them."""
        return COMMANDS[name].format(k=variant).split()

    def start(self, arguments: list[str], label: str = "run") -> Run:
        """Start a command in the folder."""
        out = self.folder / f"{label}.stdout"
        err = self.folder / f"{label}.stderr"
        process = self._context.Process(
            target=_command, args=(arguments, self.folder, out, err)
        )
        out.write_text("")
        err.write_text("")
        process.start()
        return Run(process, out, err)

    def results(self, name: str, variant: int) -> dict[str, bytes]:
        """Run a command in a new output folder and return all it wrote."""
        self.fill({})
        for command in ("identify log", name) if name == "report" else (name,):
            run = self.start(self.command_arguments(command, variant))
            assert run.code == 0, (command, run.errors)
        return files_in(self.out) if self.out.is_dir() else {}

    def fill(self, files: dict[str, bytes]) -> None:
        """Make the output folder hold these files and nothing else."""
        if self.out.is_symlink() or self.out.is_file():
            self.out.unlink()
        shutil.rmtree(self.out, ignore_errors=True)
        self.put(files)

    def put(self, files: dict[str, bytes]) -> None:
        """Write files into the output folder; those without content are folders."""
        for name, content in files.items():
            path = self.out / name
            (path.parent if content else path).mkdir(parents=True, exist_ok=True)
            if content:
                path.write_bytes(content)


def _command(arguments: list[str], folder: Path, out: Path, err: Path) -> None:
    """Be the command: in its folder and session, with files for its output."""
    os.setsid()
    # Ignored where this process was started in the background of a script.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.chdir(folder)
    for number, path in ((1, out), (2, err)):
        os.dup2(os.open(path, os.O_WRONLY | os.O_APPEND), number)
        stream = open(number, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
        setattr(sys, "stdout" if number == 1 else "stderr", stream)
    sys.argv = ["robot-sysid", *arguments]
    sys.exit(cli.main())
