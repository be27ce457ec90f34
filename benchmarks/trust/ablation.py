"""Which logs are judged otherwise without each condition, constant, level and row of the judging.

    OMP_NUM_THREADS=1 python -m benchmarks.trust.ablation MODELS_FOLDER [--real REAL_LOGS]
        [--real-parts 66] [--wrong 40] [--right 40] [--seed 1] [--package robot_sysid.faults]
        [--only TEXT] [--kinds operand test ...] [--most 0] [--rows FILE] [--jobs 1] [--limit 40]
        [--notice] [--write]

Each is taken out alone: an operand of ``and`` and ``or``, a test (always and never), the filter of
a comprehension, a level that stops a log, a constant (zero, a tenth, ten times, infinite), a row of
the table of faults. Logs are parts of real ones (all of them right), wrong ones of
``benchmarks.trust.drawn_changes``, and right ones under the conditions of
``benchmarks.trust.right_odd``. Each is read once and judged once: where something would first make
a difference to a condition (``benchmarks.trust.ablated_code``), the process forks, and a child
judges on without it, ``--jobs`` at once. What makes no difference anywhere costs nothing. All of
it in one log takes ten to forty minutes of a core: ``--most 3`` tries each in three logs of each
table only in which it makes a difference to a condition. ``--notice`` takes nothing out, and takes
some seconds for a log: it says what makes a difference to no condition in any log, and so changes
no line for sure.

Counted are logs whose class changes: right ones used or accused; wrong ones stopped and named
rightly, doubted, or misnamed, and used with a note that names what is wrong, or silently.
``--write`` writes the table to ablation.md beside this script after each log: what changes no line,
and how much changes some in each module; all of it is printed at the end. FILE keeps the logs that
are done; a run that was stopped goes on with the others.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import pickle
import re
import signal
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence, Set
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.trust.ablated_code import (
    Ablation,
    Notes,
    Source,
    ablations_of,
    read_folder,
    rewrite,
)
from benchmarks.trust.answers import (
    bare_model_text,
    end_on_signals,
    model_text,
    write_log,
)
from benchmarks.trust.drawn_changes import Change, Subject, draw_changes
from benchmarks.trust.drawn_wrong import (
    DURATIONS,
    SCENES_EACH,
    Said,
    bare_models,
    classify,
    edit_all,
    scene_of,
)
from benchmarks.trust.real_right import PARTS
from benchmarks.trust.right_odd import draw_odd_log
from benchmarks.trust.row_files import Row, RowFile
from rigs.arms.drawn_models import DRAWN
from rigs.arms.wrong_arms import ARMS
from rigs.logs.real_logs import LOGS, RealLog, part_of, write_real_log
from robot_sysid.api.calls import read_log
from robot_sysid.errors import SysidError
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.questions import Question
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Recording, RobotModel
from robot_sysid.records.messages import Progress

PAGE = Path(__file__).with_suffix(".md")
KINDS = ("operand", "test", "filter", "level", "constant", "row")
TABLES = ("real", "wrong", "odd")
RANKS = {
    "used": 1,
    "accused": 0,
    "rightly": 2,
    "doubt": 1,
    "noted": 1,
    "silent": 0,
    "misnamed": 0,
}
"""Class to how good it is."""
FAILED = ("crashed", "too slow")
NUMBER = re.compile(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?")
OTHER_WORDS = "other words"
"""What changes where the class of a log does not."""


class TooSlow(BaseException):
    """Judging a log takes too long, as without the end of a loop."""


@dataclass(frozen=True)
class Outcome:
    """What is said of a log.

    Attributes:
        name: its class.
        lines: level, name, and text without numbers of each finding.
    """

    name: str
    lines: tuple[tuple[str, str, str], ...] = ()


@dataclass(frozen=True)
class Line:
    """A log that is judged again and again.

    Attributes:
        table: "real", "wrong" or "odd".
        words: what it is.
        robot: the arm.
        log: as it was read.
        changes: what is wrong with it; () of a right one.
    """

    table: str
    words: str
    robot: RobotModel
    log: Recording
    changes: tuple[Change, ...] = ()


class Bench:
    """The judging of logs by a package folder.

    Args:
        package: name of the folder.
        limit: most time that judging a log takes [s].
    """

    def __init__(self, package: str, limit: float) -> None:
        self.sources: list[Source] = read_folder(package)
        judges = [
            vars(source.module)["judge"]
            for source in self.sources
            if any(each.name == "judge" for each in source.definitions())
        ]
        self._judge = judges[0]
        self._limit = limit

    def start_clock(self) -> None:
        """Stop what this process judges after the most time that it takes."""
        signal.signal(signal.SIGALRM, raise_too_slow)
        signal.setitimer(signal.ITIMER_REAL, self._limit)

    def outcome(self, line: Line) -> Outcome:
        """Return what is said of a log."""
        try:
            question = Question(EstimationOptions())
            judged = self._judge(line.robot, [line.log], question, Progress())
            found = [
                {"level": f.level.value, "about": str(f.about), "text": f.text}
                for f in judged.findings
            ]
        except SysidError as error:
            found = [{"level": "refuses", "about": "error", "text": str(error)}]
        except TooSlow:
            return Outcome("too slow")
        except Exception as error:
            return Outcome("crashed", (("", type(error).__name__, ""),))
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        lines = [(f["level"], f["about"], NUMBER.sub("", f["text"])) for f in found]
        return Outcome(class_of(line, found), tuple(lines))


class Run:
    """One log that is judged, and once more without each thing that would make a difference.

    Whenever something is noticed first, a child goes on without it. All is done in this process and
    its children, whose code stays rewritten.

    Args:
        bench: that judges.
        line: the log.
        keys: of what is taken out.
        jobs: children at once; 0 takes nothing out.
    """

    def __init__(self, bench: Bench, line: Line, keys: Set[str], jobs: int) -> None:
        self._bench = bench
        self._line = line
        self._keys = keys
        self._jobs = jobs
        self._notes = Notes(self._notice)
        self._running: dict[int, tuple[str, int]] = {}
        self._outcomes: dict[str, Outcome] = {}
        self._pipe = -1
        self._parent = -1

    def judge(self) -> Row:
        """Return the outcome of the log, what was noticed, and the outcomes that are others."""
        self._parent = os.getppid()
        plain = self._bench.outcome(self._line)
        rewrite(self._bench.sources, self._notes)
        outcome = self._bench.outcome(self._line)
        if self._notes.active:
            with os.fdopen(self._pipe, "wb") as pipe:
                pickle.dump(outcome, pipe)
            os._exit(0)
        while self._running:
            self._reap()
        changed = {
            key: [other.name, other.lines]
            for key, other in self._outcomes.items()
            if other != outcome
        }
        return {
            "table": self._line.table,
            "words": self._line.words,
            "outcome": [outcome.name, outcome.lines],
            "is_same": plain == outcome,
            "noticed": sorted(self._notes.noticed & self._keys),
            "changed": changed,
        }

    def _notice(self, key: str) -> None:
        """Fork a child that goes on without something."""
        if key not in self._keys or not self._jobs:
            return
        if os.getppid() != self._parent:
            # Whoever started this was killed.
            os._exit(1)
        while len(self._running) >= self._jobs:
            self._reap()
        read_end, write_end = os.pipe()
        process = os.fork()
        if process:
            os.close(write_end)
            self._running[process] = (key, read_end)
            return
        os.close(read_end)
        self._running.clear()
        self._pipe = write_end
        self._notes.active = key
        self._bench.start_clock()

    def _reap(self) -> None:
        """Wait for a child, and keep its outcome."""
        process, _ = os.wait()
        key, read_end = self._running.pop(process)
        with os.fdopen(read_end, "rb") as pipe:
            content = pipe.read()
        # A child that dies without a word has crashed.
        outcome = pickle.loads(content) if content else Outcome("crashed")
        self._outcomes[key] = outcome


def raise_too_slow(number: int, frame: Any) -> None:
    """Stop judging a log."""
    raise TooSlow


def class_of(line: Line, found: Sequence[dict[str, Any]]) -> str:
    """Return the class of a log by its findings."""
    stops = [each for each in found if each["level"] != "says"]
    if line.table != "wrong":
        names = {each["about"] for each in stops}
        return "accused" if names - {"too-little"} else "used"
    said = Said(tuple(found), 2 if stops else 0)
    name = classify(said, line.changes, line.robot.joint_names, False)
    if name == "crashed" or stops:
        return name
    return "noted" if name == "rightly" else "silent"


# ---- processes


def in_child(work: Callable[[], Row]) -> Row | None:
    """Return what a child of this process makes; None where it fails."""
    read_end, write_end = os.pipe()
    process = os.fork()
    if not process:
        os.close(read_end)
        # A signal ends it at once, and its children with it.
        os.setpgid(0, 0)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)
        try:
            content = pickle.dumps(work())
            with os.fdopen(write_end, "wb") as pipe:
                pipe.write(content)
        finally:
            # Nothing of the parent is to be done twice.
            os._exit(0)
    os.close(write_end)
    try:
        with os.fdopen(read_end, "rb") as pipe:
            content = pipe.read()
    except BaseException:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process, signal.SIGTERM)
        raise
    finally:
        os.waitpid(process, 0)
    return pickle.loads(content) if content else None


def makers_of(
    options: argparse.Namespace, folder: Path
) -> Iterator[tuple[str, Callable[[], Iterator[Line]]]]:
    """Yield a key and a function that makes it of each log, of all tables in turn."""
    seed = options.seed
    drawn = [f"{DRAWN}{seed % 1000 + k}" for k in range(2)]
    arms = bare_models([*ARMS, *drawn], options.models.resolve(), folder)
    spans = {"whole": (0.0, 1.0), **PARTS}
    parts = [(real, name) for name in spans for real in LOGS]
    # A few of them are of several arms.
    parts = [
        parts[place] for place in np.random.default_rng(seed).permutation(len(parts))
    ]
    real_count = 0 if options.real is None else min(options.real_parts, len(parts))
    kinds = "".join(kind[0] for kind in options.kinds)
    start = f"{options.package} {kinds} {options.only}"
    for number in range(max(real_count, options.wrong, options.right)):
        if number < real_count:
            real, part = parts[number]
            root = options.real.resolve()
            make = partial(real_line, root, real, part, spans[part], folder)
            yield f"{start} real {real.name} {part}", make
        if number < options.wrong:
            make = partial(wrong_line, seed, number, arms, folder)
            yield f"{start} wrong {seed} {number}", make
        if number < options.right:
            make = partial(odd_line, seed, number, arms, folder)
            yield f"{start} odd {seed} {number}", make


def read_line(
    table: str,
    words: str,
    model: Path,
    path: Path,
    gravity: Sequence[float] | None,
    changes: Sequence[Change] = (),
) -> Iterator[Line]:
    """Yield the line of a log; none where it cannot be read, so that nothing judges it."""
    try:
        robot = load_robot_model(model, gravity=gravity)
        log = read_log(path, robot)
    except SysidError:
        return
    yield Line(table, words, robot, log, tuple(changes))


def real_line(
    root: Path, real: RealLog, part: str, span: tuple[float, float], folder: Path
) -> Iterator[Line]:
    """Yield the line of a part of a real log."""
    log = part_of(real.read(root / real.path), *span)
    path = write_real_log(folder / f"{real.name}.csv", log)
    gravity = [float(word) for word in real.options[1:]] or None
    words = f"{real.name} {part}"
    yield from read_line("real", words, root / real.model, path, gravity)


def wrong_line(
    seed: int, number: int, arms: dict[str, Path], folder: Path
) -> Iterator[Line]:
    """Yield the line of a wrong log."""
    rng = np.random.default_rng([seed, number])
    arm = [*arms][number % len(arms)]
    duration = float(rng.choice([*DURATIONS], p=[*DURATIONS.values()]))
    right = scene_of(
        arms[arm], arm, duration, 100 * seed + int(rng.integers(SCENES_EACH))
    )
    subject = Subject(
        tuple(right.robot.joint_names), right.log, right.usual_torque, right
    )
    changes = draw_changes(rng, subject)
    for change in changes:
        subject = change.spoil(subject)
    model = folder / f"wrong_{number}.xml"
    text = bare_model_text(arms[arm])
    if subject.edits:
        text = model_text(arms[arm], lambda spec: edit_all(subject, spec))
    model.write_text(text)
    path = folder / f"wrong_{number}.csv"
    write_log(path, subject.joint_names, subject.log)
    words = f"{arm}: {'; and '.join(change.words for change in changes)}"
    yield from read_line("wrong", words, model, path, None, changes)


def odd_line(
    seed: int, number: int, arms: dict[str, Path], folder: Path
) -> Iterator[Line]:
    """Yield the line of a right log under odd conditions."""
    rng = np.random.default_rng([seed, number, 1])
    arm = [*arms][number % len(arms)]
    odd = draw_odd_log(rng, arms[arm], arm)
    model = folder / f"odd_{number}.xml"
    model.write_text(bare_model_text(arms[arm]))
    path = folder / f"odd_{number}.csv"
    write_log(path, odd.scene.robot.joint_names, odd.scene.log)
    gravity = [float(word) for word in odd.options[1:]] or None
    yield from read_line("odd", f"{arm}: {odd.words}", model, path, gravity)


def tried_enough(judged: Sequence[Row], table: str, most: int) -> set[str]:
    """Return the keys that were tried in the most logs of a table already."""
    counts: Counter[str] = Counter()
    for row in judged:
        if row["table"] == table:
            counts.update(row["noticed"])
    return {key for key, count in counts.items() if most and count >= most}


def rows_of_ablations(
    chosen: Sequence[Ablation], judged: Sequence[Row]
) -> Iterator[Row]:
    """Yield what changes without each thing, in the logs that were judged."""
    for ablation in chosen:
        counts: dict[str, Counter[str]] = {table: Counter() for table in TABLES}
        tried = dict.fromkeys(TABLES, 0)
        for row in judged:
            tried[row["table"]] += ablation.key in row["noticed"]
            other = row["changed"].get(ablation.key)
            if other is not None:
                before = row["outcome"][0]
                is_same = other[0] == before
                way = OTHER_WORDS if is_same else f"{before} -> {other[0]}"
                counts[row["table"]][way] += 1
        yield {
            "place": place_of(ablation),
            "ablation": vars(ablation),
            "tried": tried,
            "noticed": sum(tried.values()),
            "counts": counts,
        }


# ---- what is printed


def place_of(ablation: Ablation) -> str:
    """Return where something is that is taken out."""
    module = ablation.module.rpartition(".")[2]
    return f"{module}.py:{ablation.line}" if ablation.line else f"{module}.py"


def gain_of(row: Row) -> tuple[int, int]:
    """Return how many logs get worse, and how many better."""
    worse = better = 0
    for counts in row["counts"].values():
        for way, count in counts.items():
            if way == OTHER_WORDS:
                continue
            before, _, after = way.partition(" -> ")
            step = RANKS.get(after, -1) - RANKS.get(before, -1)
            worse += count * (step < 0)
            better += count * (step > 0)
    return worse, better


def change_text(row: Row) -> str:
    """Return what changes in words."""
    parts = []
    for table, counts in row["counts"].items():
        ways = ", ".join(f"{way} {count}" for way, count in counts.items())
        parts += [f"{table}: {ways}"] if ways else []
    return "; ".join(parts) or "no line"


def log_line(row: Row) -> str:
    """Return what is said of a log, and how much would make a difference, as a line of text."""
    name, lines = row["outcome"]
    said = ", ".join(f"{level}:{about}" for level, about, _ in lines) or "-"
    ways = Counter(other[0] for other in row["changed"].values() if other[0] != name)
    changes = ", ".join(f"{other} {count}" for other, count in ways.items())
    odd = "" if row["is_same"] else " (NOTES CHANGE IT)"
    return (
        f"  {row['table']}: {name}{odd}: {row['words']}: {said}: "
        f"noticed {len(row['noticed'])}; {changes or 'none changes it'}"
    )


def line_of(row: Row) -> str:
    """Return a row as a line of text."""
    ablation = row["ablation"]
    worse, better = gain_of(row)
    return (
        f"{row['place']} {ablation['what']} [{ablation['way']}]: worse {worse}, "
        f"better {better}; {change_text(row)}"
    )


def escaped(text: str) -> str:
    """Return a text as a cell of a table has it."""
    return text.replace("|", "\\|").replace("`", "'")


def page_lines(
    found: Sequence[Row], judged: Sequence[Row], command: str, is_notice: bool
) -> Iterator[str]:
    """Yield the lines of the page; ``is_notice`` is whether nothing was taken out."""
    busy = [
        row
        for row in found
        if (row["noticed"] if is_notice else change_text(row) != "no line")
    ]
    yield "# What each condition of the judging of logs changes"
    yield ""
    yield f"Written by `{command}`, see its head."
    if is_notice:
        yield "Nothing is taken out: what makes a difference to a condition may change a line, and"
        yield "what makes none changes no line."
    else:
        yield "Each is taken out alone, in the logs in which it makes a difference to a condition."
    yield ""
    yield "| logs | number | as they are judged |"
    yield "| --- | --- | --- |"
    for table in TABLES:
        counts = Counter(r["outcome"][0] for r in judged if r["table"] == table)
        words = ", ".join(f"{name} {count}" for name, count in counts.most_common())
        yield f"| {table} | {sum(counts.values())} | {words} |"
    yield ""
    title = "Makes a difference to no condition" if is_notice else "Changes no line"
    yield f"## {title}: {len(found) - len(busy)} of {len(found)}"
    yield ""
    yield "Tried is in how many logs it makes a difference to a condition. Tests of faults hold"
    yield "some of these, and others look whether there is anything at all."
    yield ""
    yield "| where | what | taken out | tried |"
    yield "| --- | --- | --- | --- |"
    idle: dict[tuple[str, str], list[Row]] = {}
    for row in found:
        if row not in busy:
            what = f"`{escaped(row['ablation']['what'])}`"
            idle.setdefault((row["place"], what), []).append(row)
    for (place, what), rows in idle.items():
        ways = ", ".join(row["ablation"]["way"] for row in rows)
        yield f"| {place} | {what} | {ways} | {max(row['noticed'] for row in rows)} |"
    yield from lines_of_others(busy, is_notice)


def lines_of_others(busy: Sequence[Row], is_notice: bool) -> Iterator[str]:
    """Yield the lines of what makes a difference, of each module and one by one."""
    yield ""
    yield "## The others"
    yield ""
    yield "| module | things | in one log only | logs that get worse | better |"
    yield "| --- | --- | --- | --- | --- |"
    modules = dict.fromkeys(row["ablation"]["module"] for row in busy)
    for module in modules:
        own = [row for row in busy if row["ablation"]["module"] == module]
        once = sum(row["noticed"] == 1 for row in own)
        worse, better = map(sum, zip(*map(gain_of, own)))
        name = module.rpartition(".")[2]
        yield f"| {name}.py | {len(own)} | {once} | {worse} | {better} |"
    yield ""
    yield "In how many logs each makes a difference to a condition, and what changes then:"
    yield ""
    yield f"| where | what | taken out | {' | '.join(TABLES)} | changes |"
    yield "| --- | --- | --- | --- | --- | --- | --- |"
    for row in busy:
        what = f"`{escaped(row['ablation']['what'])}`"
        numbers = " | ".join(str(row["tried"][table]) for table in TABLES)
        changes = "not tried" if is_notice else change_text(row)
        way = row["ablation"]["way"]
        yield f"| {row['place']} | {what} | {way} | {numbers} | {changes} |"


def main() -> int:
    """Print what changes, and write the page where that is asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("models", type=Path, metavar="MODELS_FOLDER")
    parser.add_argument("--real", type=Path, metavar="REAL_LOGS")
    parser.add_argument("--real-parts", type=int, default=66)
    parser.add_argument("--wrong", type=int, default=40)
    parser.add_argument("--right", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--package", default="robot_sysid.faults")
    parser.add_argument("--only", default="", help="part of place and source")
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS)
    parser.add_argument(
        "--most", type=int, default=0, help="logs of a table in which each is tried"
    )
    parser.add_argument("--limit", type=float, default=40.0, help="for one log [s]")
    parser.add_argument("--rows", type=Path)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--notice", action="store_true")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    bench = Bench(options.package, options.limit)
    chosen = [
        ablation
        for ablation in ablations_of(bench.sources)
        if ablation.kind in options.kinds
        and options.only in f"{place_of(ablation)} {ablation.what}"
    ]
    keys = {ablation.key for ablation in chosen}
    print(f"{len(chosen)} things to take out", flush=True)
    kept = RowFile(options.rows)
    judged: list[Row] = []
    with tempfile.TemporaryDirectory() as name:
        for key, make in makers_of(options, Path(name)):
            if key not in kept:
                for line in make():
                    open_keys = keys - tried_enough(judged, line.table, options.most)
                    jobs = 0 if options.notice else options.jobs
                    run = Run(bench, line, open_keys, jobs)
                    row = in_child(run.judge)
                    if row is not None:
                        kept.add({"key": key, **row})
            if key in kept:
                judged.append(kept[key])
                print(log_line(kept[key]), flush=True)
                if options.write:
                    write_page(chosen, judged, options)
    found = list(rows_of_ablations(chosen, judged))
    for row in found:
        if change_text(row) != "no line":
            print(line_of(row))
    if options.notice:
        idle = sum(not row["noticed"] for row in found)
        print(f"{idle} of {len(found)} make a difference to no condition")
    else:
        idle = sum(change_text(row) == "no line" for row in found)
        print(f"{idle} of {len(found)} change no line")
    return 0


def write_page(
    chosen: Sequence[Ablation], judged: Sequence[Row], options: argparse.Namespace
) -> None:
    """Write the page of the logs that were judged so far."""
    found = list(rows_of_ablations(chosen, judged))
    given = f"--kinds {' '.join(options.kinds)} --seed {options.seed} --real-parts "
    given += f"{options.real_parts} --wrong {options.wrong} --right {options.right} "
    given += "--notice" if options.notice else f"--most {options.most}"
    command = f"python -m benchmarks.trust.ablation {given}"
    text = "\n".join(page_lines(found, judged, command, options.notice))
    PAGE.write_text(f"{text}\n", encoding="utf-8")


if __name__ == "__main__":
    with end_on_signals():
        sys.exit(main())
