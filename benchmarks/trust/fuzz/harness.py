"""Runs a target on many inputs in processes that may crash, hang or take too much memory.

A process works through a batch of inputs. The number of its current input is in memory that it
shares with the watching process. Where the process ends early, that input is the finding, and a new
process continues with the next one.
"""

from __future__ import annotations

import faulthandler
import functools
import json
import mmap
import os
import resource
import signal
import struct
import sys
import tempfile
import traceback
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any, Protocol

LONGEST = 10
"""Seconds that an input may take."""
MOST_MEMORY = 10**9
"""Bytes that an input may take beyond what the process has already."""
BATCH = 2000
_ACTS = (
    "os.remove",
    "os.rename",
    "os.mkdir",
    "os.rmdir",
    "os.link",
    "os.symlink",
    "os.truncate",
)
_NEVER = (
    "socket.connect",
    "subprocess.Popen",
    "os.system",
    "os.exec",
    "pickle.find_class",
)
_STATE = struct.Struct("3q")

Case = Mapping[str, bytes]
"""Name to content of the files of an input."""


class Target(Protocol):
    """A fuzzed subject: a module of this package."""

    def case(self, random: Random) -> Case:
        """Make an input."""

    def use(self, case: Case, folder: Path) -> None:
        """Read it; may write to ``folder / "out"``."""


def write_case(case: Case, folder: Path) -> Path:
    """Write the files of an input to a folder, which is emptied first."""
    input_folder = folder / "in"
    for old in sorted(input_folder.rglob("*"), reverse=True):
        old.unlink() if old.is_symlink() or not old.is_dir() else old.rmdir()
    for name, content in case.items():
        path = input_folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    input_folder.mkdir(exist_ok=True)
    return input_folder


@dataclass(frozen=True)
class Finding:
    """An input that went wrong.

    Attributes:
        number: number of the input.
        verdict: the fault in short; equal verdicts are one fault.
        text: the details.
    """

    number: int
    verdict: str
    text: str


def case_of(target: Target, seed: int, number: int) -> Case:
    """Return an input; the same for the same seed and number."""
    return target.case(Random(f"{seed} {number}"))


def outcome(target: Target, case: Case, folder: Path) -> tuple[str, str]:
    """Use an input: ("result", ""), ("refused", message), or what went wrong and where."""
    from robot_sysid.errors import SysidError

    try:
        target.use(case, folder)
    except SysidError as error:
        return _judge_message(str(error))
    except BaseException as error:
        return (
            f"{type(error).__name__} at {_raise_location(error)}",
            traceback.format_exc(),
        )
    return "result", ""


def _judge_message(message: str) -> tuple[str, str]:
    """Return the verdict on an error's message: refused, empty, or out of memory."""
    if not message.strip():
        return "empty message", ""
    is_memory = any(word in message for word in ("allocate", "out of memory"))
    return "memory" if is_memory else "refused", message


def _raise_location(error: BaseException) -> str:
    """Return where in the package an error was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if "robot_sysid" in f.filename] or list(frames)
    return f"{Path(ours[-1].filename).name}:{ours[-1].lineno}"


def run(
    target: Target, inputs: int, seed: int, first: int = 0
) -> Iterator[Finding | str]:
    """Use many inputs; yield the findings and, now and then, how far it is."""
    state = mmap.mmap(-1, _STATE.size)
    case_of(target, seed, first)  # what all inputs are made from is made once
    with tempfile.TemporaryDirectory(dir=_memory_folder()) as name:
        folder = Path(name)
        number = first
        while number < first + inputs:
            end = min(number + BATCH, first + inputs)
            log = folder / "findings"
            log.write_bytes(b"")
            work = functools.partial(
                _batch, target, range(number, end), seed, folder, state
            )
            status = _in_child(work)
            yield from _read_findings(log)
            at, results, refused = _STATE.unpack_from(state)
            if status:
                yield Finding(
                    at, _ending(status), (folder / "stack").read_text(errors="replace")
                )
            number = at + 1 if status else end
            yield f"{number - first} inputs: {results} results, {refused} refused"


def _memory_folder() -> str | None:
    """Return a folder that is held in memory, or None where there is none."""
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


def _in_child(work: Any) -> int:
    """Return the status of a process that does some work."""
    sys.stdout.flush()
    pid = os.fork()
    if pid:
        return os.waitpid(pid, 0)[1]
    try:
        work()
        os._exit(0)
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(99)


def _ending(status: int) -> str:
    """Return how a process ended, by its status."""
    number = os.WTERMSIG(status)
    if number == signal.SIGALRM:
        return f"longer than {LONGEST} s"
    return (
        f"ended by {signal.Signals(number).name}" if number else f"exit {status >> 8}"
    )


def _batch(
    target: Target, numbers: range, seed: int, folder: Path, state: mmap.mmap
) -> None:
    """Use inputs one after the other and note what went wrong; the child's side."""
    watch = Watch(folder)
    _, results, refused = _STATE.unpack_from(state)
    for number in numbers:
        _STATE.pack_into(state, 0, number, results, refused)
        case = case_of(target, seed, number)
        verdict, text = watch.outcome(target, case)
        results = results + (verdict == "result")
        refused = refused + (verdict == "refused")
        if verdict not in ("result", "refused"):
            watch.note(number, verdict, text)
    _STATE.pack_into(state, 0, numbers[-1], results, refused)


def _read_findings(log: Path) -> Iterator[Finding]:
    """Yield the findings of a log file."""
    for line in log.read_text().splitlines():
        yield Finding(*json.loads(line))


class Watch:
    """Limits memory and time of this process and watches its writing, until the process ends."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._acts = []
        self._watching = False
        for name in ("in", "out", "here"):
            (folder / name).mkdir(exist_ok=True)
        os.chdir(folder / "here")
        warnings.simplefilter("ignore")
        tempfile.tempdir = str(folder / "out")
        sys.dont_write_bytecode = True
        self._log = (folder / "findings").open("a")
        self._stack = (folder / "stack").open("w")
        faulthandler.register(
            signal.SIGALRM, file=self._stack, all_threads=False, chain=True
        )
        faulthandler.enable(file=self._stack, all_threads=False)
        used = int(Path("/proc/self/statm").read_text().split()[0]) * mmap.PAGESIZE
        resource.setrlimit(resource.RLIMIT_AS, (used + MOST_MEMORY,) * 2)
        sys.addaudithook(self._audit)

    def outcome(self, target: Target, case: Case) -> tuple[str, str]:
        """Return what ``outcome`` returns, within limits of time, memory and writing."""
        self._acts.clear()
        self._watching = True
        signal.setitimer(signal.ITIMER_REAL, LONGEST)
        try:
            verdict, text = outcome(target, case, self._folder)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            self._watching = False
        left = os.listdir(self._folder / "here")
        if left or self._acts:
            return "written outside, or worse", f"{left} {self._acts} {text}"
        return verdict, text

    def note(self, number: int, verdict: str, text: str) -> None:
        """Write a finding down."""
        self._log.write(json.dumps([number, verdict, text]) + "\n")
        self._log.flush()

    def _audit(self, event: str, values: tuple[Any, ...]) -> None:
        """Note events that write outside, open a network, unpickle or run code."""
        if not self._watching:
            return
        writes = event == "open" and _is_writing(values) or event in _ACTS
        # What stands in a folder that is already open was judged when that was.
        inside = event in ("os.remove", "os.rmdir") and values[1] != -1
        # A link is written where it is made, whatever it points at.
        paths = values[1:2] if event in ("os.link", "os.symlink") else values[:1]
        paths = values[:2] if event == "os.rename" else paths
        if event in _NEVER or (
            writes and not inside and not all(map(self._may_write, paths))
        ):
            self._acts.append(f"{event} {values[:2]}")

    def _may_write(self, path: Any) -> bool:
        """Return whether a path lies in the output folder, or is a file that is open already."""
        if isinstance(path, int):
            return True
        target = Path(os.fsdecode(path)).absolute()
        return self._folder in target.parents and target.parent != self._folder / "here"


def _is_writing(values: tuple[Any, ...]) -> bool:
    """Return whether the arguments of an "open" event ask to write."""
    flags = values[2] if len(values) > 2 else 0
    return isinstance(flags, int) and bool(
        flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
    )
