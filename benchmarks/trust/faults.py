"""Which files a run leaves that was killed, interrupted, or lost its disk or folder.

Run from the checkout:
    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python -m benchmarks.trust.faults --kills 100

Each run begins with the results of an earlier one in its folder. Afterwards every file there has to
be the earlier one or the new one, whole, and the same command has to run through. Half of the kills
come at any time, half while the results are being written. An interrupt has to end in exit code 130
and one line; in the search for a trajectory it ends the search alone, and the best one so far is
written. Disks that fill up take root, who may mount them.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from benchmarks.trust.workshop import COMMANDS, EXAMPLE, SEARCH, Run, Workshop
from rigs.files.command_line import files_in

WRITING = 0.02
"""Within this time after the first draft a run is killed while it writes [s]."""
LONGEST = 300.0


class Study:
    """Runs commands over earlier results and looks at what they leave.

    Args:
        shop: the commands and what they read.
        names: which of them.
        seed: of the times.
    """

    def __init__(self, shop: Workshop, names: list[str], seed: int) -> None:
        self.shop = shop
        self.names = names
        self.random = random.Random(seed)
        self.old = {name: shop.results(name, 1) for name in names}
        self.new: dict[str, dict[str, bytes]] = {}
        self.time: dict[str, float] = {}
        for name in names:
            start = time.monotonic()
            self.new[name] = shop.results(name, 2)
            self.time[name] = time.monotonic() - start
            print(
                f"{name:16s} {self.time[name]:5.1f} s  {', '.join(sorted(self.new[name]))}"
            )
        if "report" in names:  # What it reads is new; only its page is old.
            page = self.old["report"]["report.html"]
            self.old["report"] = {**self.new["report"], "report.html": page}
        if EXAMPLE in names:  # It refuses to write over an earlier one.
            self.old[EXAMPLE] = {}

    def start(self, name: str) -> Run:
        """Start a command over the earlier results."""
        self.shop.fill(self.old[name])
        self.shop.out.mkdir(exist_ok=True)
        return self.rerun(name)

    def rerun(self, name: str) -> Run:
        """Start a command over the files that are in the output folder."""
        return self.shop.start(self.shop.command_arguments(name, 2))

    def output_files(self) -> dict[str, bytes]:
        """Return the files of the output folder, with their contents."""
        return files_in(self.shop.out) if self.shop.out.is_dir() else {}

    def faults(self, name: str, removed: bool = False) -> list[str]:
        """Return the faults of the files in the output folder, a sentence each."""
        if not self.shop.out.is_dir():
            return []
        files = {k: v for k, v in self.output_files().items() if not is_hidden(k)}
        gone = () if removed else set(self.old[name]) - set(files)
        faults = [f"{missing} is gone" for missing in gone]
        if name == EXAMPLE and files and files.keys() != self.new[name].keys():
            faults.append("only a part of the example is there")
        for path, content in files.items():
            if path.endswith("inside") or not content:  # put there instead of a file
                continue
            if content in (self.old[name].get(path), self.new[name].get(path)):
                continue
            if name != SEARCH or not is_whole(path, content, self.new[name]):
                faults.append(f"{path} is neither the old one nor the new one")
        return faults

    def next_run(self, name: str) -> list[str]:
        """Run the command again; return the faults, a sentence each."""
        if name == EXAMPLE:
            shutil.rmtree(self.shop.out / "kinova", ignore_errors=True)
        run = self.rerun(name)
        if run.code != 0:
            return [f"the next run ends with {run.code}: {run.errors}"]
        files = self.output_files()
        hidden = [path for path in files if is_hidden(path)] if self.new[name] else []
        left = [f"the next run leaves {path}" for path in hidden]
        visible_files = {k: v for k, v in files.items() if not is_hidden(k)}
        differs = name != SEARCH and visible_files != self.new[name]
        return left + ["the next run writes something else"] * differs


def is_hidden(path: str) -> bool:
    """Return whether a file is a draft or a lock, not a result."""
    return any(component.startswith(".") for component in Path(path).parts)


def is_whole(path: str, content: bytes, other: dict[str, bytes]) -> bool:
    """Return whether a plan's file is complete.

    Args:
        path: its name.
        content: its bytes.
        other: name to bytes of the files of another search with the same options.
    """
    if path.endswith(".json"):
        with contextlib.suppress(ValueError):
            return json.loads(content).keys() == json.loads(other[path]).keys()
        return False
    return content.endswith(b"\n") and content.count(b"\n") == other[path].count(b"\n")


def has_draft(folder: Path) -> bool:
    """Tell whether results are being written."""
    with contextlib.suppress(OSError):
        return any(name.startswith(".") for name in os.listdir(folder))
    return False


def session_of(number: int) -> list[int]:
    """Return the processes that run in a session."""
    process_ids = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = entry.read_text().rpartition(")")[2].split()
            if int(fields[3]) == number and fields[0] != "Z":
                process_ids.append(int(entry.parent.name))
    return process_ids


def left_over(run: Run, patience: float = 15.0) -> int:
    """Return how many processes outlive the one that started them; end them."""
    limit = time.monotonic() + patience
    while session_of(run.process.pid) and time.monotonic() < limit:
        time.sleep(0.05)
    orphans = session_of(run.process.pid)
    for number in orphans:
        with contextlib.suppress(ProcessLookupError):
            os.kill(number, signal.SIGKILL)
    return len(orphans)


def kills(study: Study, count: int) -> None:
    """Kill runs at random times, and print what they left."""
    tally: collections.Counter[str] = collections.Counter()
    for number in range(count):
        turn, index = divmod(number, len(study.names))
        name = study.names[index]
        writes = (turn + index) % 2 == 1 and bool(study.new[name])
        run = study.start(name)
        if writes:
            run.wait_for(lambda: has_draft(study.shop.out))
        time.sleep(
            study.random.uniform(0.0, WRITING if writes else 0.9 * study.time[name])
        )
        run.process.kill()
        tally["killed" if run.code == -signal.SIGKILL else "ended before"] += 1
        tally[f"killed: {name}"] += run.code == -signal.SIGKILL
        tally["killed while it wrote"] += has_draft(study.shop.out)
        tally["processes that outlived a killed run"] += left_over(run)
        files = study.output_files()
        hidden = sum(map(is_hidden, files))
        tally["files"] += len(files) - hidden
        tally["hidden files of killed runs"] += hidden
        faults = study.faults(name)
        tally["files neither old nor new, or gone"] += len(faults)
        # The next run takes the most time, so that of every third kill has to do.
        goes_on = hidden > 0 or number % 3 == 0
        problems = study.next_run(name) if goes_on else []
        tally["next runs"] += goes_on
        tally["next runs that failed or left hidden files"] += bool(problems)
        for fault in (*faults, *problems):
            print(f"  FAULT kill {number}, {name}: {fault}", flush=True)
        print(
            f"  {number + 1}: {dict(tally)}",
            end="\n" if number % 10 == 9 else "\r",
            flush=True,
        )
    print(f"\nkills: {count}")
    for ending, times in sorted(tally.items()):
        print(f"  {times:5d} {ending}")


def stages(study: Study, name: str) -> list[str]:
    """Return the lines that a command prints before its result."""
    study.shop.fill(study.old[name])
    run = study.rerun(name)
    lines = run.out.read_text(encoding="utf-8").splitlines() if run.code == 0 else []
    return [line for line in lines if line.endswith(("...", "100%"))]


def has_said(run: Run, line: str) -> Callable[[], bool]:
    """Return a function that tells whether a run has printed a line."""
    return lambda: f"{line}\n" in run.out.read_text(encoding="utf-8")


def interrupts(study: Study, count: int) -> None:
    """Interrupt each stage, any time, and the writing."""
    print(
        "\ninterrupts: command, stage, exit codes, lines on standard error that are no notes"
    )
    for name in study.names:
        for stage in stages(study, name):
            interrupt_runs(
                study, name, stage, count, lambda run, s=stage: has_said(run, s)
            )
        if study.new[name]:
            writes = lambda run: lambda: has_draft(study.shop.out)  # noqa: E731
            interrupt_runs(study, name, "(writing)", count, writes)
        for _ in range(count):
            moment = time.monotonic() + study.random.uniform(0.02, study.time[name])
            any_time = lambda run, m=moment: lambda: time.monotonic() > m  # noqa: E731
            interrupt_runs(study, name, "(any time)", 1, any_time)


def interrupt_runs(
    study: Study,
    name: str,
    stage: str,
    count: int,
    moment: Callable[[Run], Callable[[], bool]],
) -> None:
    """Interrupt runs of a command at a moment, as a terminal does: all its processes."""
    codes: collections.Counter[int] = collections.Counter()
    outputs: collections.Counter[str] = collections.Counter()
    faults: list[str] = []
    for _ in range(count):
        run = study.start(name)
        if run.wait_for(moment(run)):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(run.process.pid, signal.SIGINT)
        run.process.join(LONGEST)
        if run.process.is_alive():
            faults.append("goes on after it was interrupted")
            run.process.kill()
        codes[run.code] += 1
        outputs.update(run.errors)
        faults += study.faults(name)
        faults += [f"{n} processes are left" for n in (left_over(run),) if n]
        faults += [f"left: {n}" for n in study.output_files() if is_hidden(n)]
    listed = ", ".join(f"{code} x {n}" for code, n in codes.items())
    lines = "; ".join(f"{n} x {line[:90]}" for line, n in outputs.items())
    print(f"  {name:16s} {stage[:44]:44s} {listed:18s} {lines}", flush=True)
    for fault in faults:
        print(f"    FAULT {fault}")


@contextlib.contextmanager
def small_disk(study: Study, size: str) -> Iterator[bool]:
    """Mount a small disk as the output folder; yield whether that was possible."""
    study.shop.fill({})
    study.shop.out.mkdir(parents=True)
    call = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(study.shop.out)]
    mounted = subprocess.run(call, capture_output=True, check=False).returncode == 0
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(study.shop.out)], check=True)


def disks(study: Study, sizes: list[str]) -> None:
    """Fill the disk after several sizes of results, and make folders read-only."""
    print(
        "\nfull disk: command, size, exit code, lines on standard error that are no notes"
    )
    for name in study.names:
        for size in sizes:
            with small_disk(study, size) as mounted:
                if not mounted:
                    return print("  no disk can be mounted here")
                if name == "report" and not _has_room(study):
                    continue
                _tell(study, name, size, study.rerun(name))
        with small_disk(study, "16m"):
            study.shop.put(study.old[name])
            run = study.rerun(name)
            time.sleep(0.5 * study.time[name])
            call = ["mount", "-o", "remount,ro", str(study.shop.out)]
            was_open = (
                subprocess.run(call, capture_output=True, check=False).returncode != 0
            )
            _tell(
                study,
                name,
                "read-only on the way" + " (not: a file was open)" * was_open,
                run,
            )
            subprocess.run(call, capture_output=True, check=False)
            run = study.rerun(name)
            _tell(study, name, "read-only before", run)


def _has_room(study: Study) -> bool:
    """Tell whether the run fits on the disk of which a report is to be made."""
    run = {k: v for k, v in study.new["report"].items() if k != "report.html"}
    with contextlib.suppress(OSError):
        study.shop.put(run)
        return True
    return False


def _tell(study: Study, name: str, event: str, run: Run) -> None:
    """Print how a run ended, and each fault that it left."""
    print(
        f"  {name:16s} {event:28s} {run.code:4d}  {' | '.join(run.errors)[:150]}",
        flush=True,
    )
    faults = study.faults(name, removed=True)
    if not event.startswith("read-only"):
        faults += [f"left: {n}" for n in study.output_files() if is_hidden(n)]
    faults += ["more than one line"] * (len(run.errors) > 1)
    faults += ["a defect"] * ("defect" in " ".join(run.errors))
    for fault in faults:
        print(f"    FAULT {fault}")


def _file_instead(out: Path) -> None:
    """Replace the output folder by a file."""
    shutil.rmtree(out)
    out.write_text("mine")


def folders(study: Study) -> None:
    """Remove the output folder during runs, or replace it beforehand; print each fault."""
    print("\noutput folder: command, what it is, exit code, lines on standard error")
    during = {
        "removed during the run": shutil.rmtree,
        "a file in its place": _file_instead,
    }
    preparations = {
        "a dangling link": lambda out: out.symlink_to("nowhere/at all"),
        "a link to itself": lambda out: out.symlink_to(out.name),
        "a file": lambda out: out.write_text("mine"),
    }
    for name in study.names:
        for title, act in during.items():
            run = study.start(name)
            time.sleep(0.5 * study.time[name])
            act(study.shop.out)
            _tell(study, name, title, run)
            study.shop.fill(study.old[name])
            print(
                "".join(f"    FAULT {fault}\n" for fault in study.next_run(name)),
                end="",
            )
        for title, act in preparations.items():
            study.shop.fill({})
            act(study.shop.out)
            run = study.rerun(name)
            start = time.monotonic()
            run.process.join()
            _tell(study, name, f"{title} ({time.monotonic() - start:.1f} s)", run)
        for result, content in study.new[name].items():
            if (
                not content
                or name == EXAMPLE
                or (name == "report" and result != "report.html")
            ):
                continue
            study.shop.fill({k: v for k, v in study.old[name].items() if k != result})
            (study.shop.out / result / "inside").mkdir(parents=True)
            _tell(study, name, f"{result} is a folder", study.rerun(name))
        _two_at_once(study, name)
    study.shop.fill({})


def _two_at_once(study: Study, name: str) -> None:
    """Run a command twice at once in one output folder, and print each fault."""
    first = study.start(name)
    second = study.shop.start(
        study.shop.command_arguments(name, 1 if name != "report" else 2), "second"
    )
    codes = (first.code, second.code)
    errors = [*first.errors, *second.errors]
    print(f"  {name:16s} {'two at once':28s} {codes}  {' | '.join(errors)[:130]}")
    if name != SEARCH and files_in(study.shop.out) not in (
        study.new[name],
        study.old[name],
    ):
        print("    FAULT files of both")


def main() -> None:
    """Run the parts that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--interrupts", type=int, default=3, help="per stage")
    parser.add_argument(
        "--sizes", nargs="*", default=["4k", "12k", "24k", "48k", "96k", "600k"]
    )
    parser.add_argument(
        "--commands", nargs="*", default=list(COMMANDS), choices=list(COMMANDS)
    )
    parser.add_argument("--no-folders", action="store_true")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--folder", type=Path, help="kept and used again (default: a new one)"
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as nowhere:
        shop = Workshop(options.folder or Path(nowhere) / "shop")
        study = Study(shop, options.commands, options.seed)
        if options.kills:
            kills(study, options.kills)
        if options.interrupts:
            interrupts(study, options.interrupts)
        if options.sizes:
            disks(study, options.sizes)
        if not options.no_folders:
            folders(study)


if __name__ == "__main__":
    main()
