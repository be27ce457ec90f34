"""Wrong logs that a grammar composes anew each time: are they named, doubted, or used?

    OMP_NUM_THREADS=1 python -m benchmarks.trust.drawn_wrong MODELS_FOLDER [--cases 300]
        [--seed N] [--right 0] [--real REAL_LOGS] [--arms ur5e drawn-3 ...] [--rows FILE] [--jobs 1]

A table of mistakes is learnt by heart by what is made with it. So changes are composed of parts
(``benchmarks.trust.drawn_changes``), from a seed that is printed, and the clock's by default.
Arms are drawn as in ``benchmarks.trust.real_arms``: links 10 to 20 % off, friction of their own.
With ``--real``, those changes that need no truth are made to the logs of ``rigs.logs.real_logs``.
``--right`` judges so many right logs in place of wrong ones, under conditions that
``benchmarks.trust.right_odd`` composes.

``log`` and, where it does not stop, ``identify`` look at each. Wrong logs are

rightly    named by one of the names that are right for what was done, and no wrong joint blamed
doubt      refused or doubted without a name, with several, or as a log that does not fit
misnamed   refused or doubted with wrong names or a wrong joint only
harmless   used, but neither of:
wrong      Usable (exit code 0), and a number is more than four stated errors off (and more than of
           the right log), or the file is: its torque error on another motion of the true arm, by
           MuJoCo, each joint's offset out, is more than 1.5 times that of the right log's file, and
           2 percentage points more. Of real logs, its error on the unspoiled log is more than 1.3
           times, and 1 point more than, that of the unspoiled log's file.
crashed    a command ended with a traceback

Each failure (misnamed, wrong, crashed) is printed in a line, then a table by kind of change. The
exit code is 1 where there is one, or where a right log is stopped. Each result becomes a line of
FILE; with the same ``--seed``, those that are in it are not made again, and ``--cases 0`` sums up
all that it has.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.trust.answers import (
    CRASH,
    bare_model_text,
    end_on_signals,
    model_text,
    run_command,
    write_log,
)
from benchmarks.trust.confusion import ALTERNATIVES, SURE_OF_ALL
from benchmarks.trust.confusion_causes import Scene, draw_scene
from benchmarks.trust.drawn_changes import Change, Subject, draw_changes
from benchmarks.trust.real_arms import errors_of
from benchmarks.trust.right_odd import draw_odd_log
from benchmarks.trust.row_files import Row, RowFile
from rigs.arms.drawn_models import DRAWN, model_path
from rigs.arms.wrong_arms import ARMS
from rigs.files.params import rows
from rigs.files.torque_error import (
    FileTorque,
    error_on_log,
    share_of_error,
    written_model,
)
from rigs.logs.real_logs import LOGS, RealLog, write_real_log
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Recording
from robot_sysid.records.fault_names import FaultName
from robot_sysid.trajectory import generate_excitation_trajectory

CLASSES = ("rightly", "doubt", "misnamed", "harmless", "wrong", "crashed")
FAILURES = ("misnamed", "wrong", "crashed")
UNNAMED = ("unexplained", "too-little", "rollout", "error")
"""Findings that stop a log and name no fault of it."""
CONTRADICTED = re.compile("probably wrong|contradict")
"""Words for a number of the model that the log contradicts."""
DURATIONS = {20.0: 0.8, 6.0: 0.2}
"""Duration of a log [s] to its share of all."""
SCENES_EACH = 3
"""Arms that are drawn of each model and duration: a right log of each is identified once."""
JUDGED_SECONDS = 10.0
JUDGED_STEP = 0.02
"""Length and step of the other motion on which files are judged [s]."""
TIMES_WORSE = 1.5
POINTS_WORSE = 0.02
"""By which the torque error of a file is worse than that of the right log's file."""
REAL_TIMES_WORSE = 1.3
REAL_POINTS_WORSE = 0.01
UNKNOWN_RIGHT = 0.05
"""Torque error that counts in the place of a right log's file, where that log is refused."""
_JUDGED_STREAM = 277
MOST_TEXT = 110
"""Characters of a finding that are printed."""


@dataclass(frozen=True)
class Reference:
    """What the right log of an arm makes.

    Attributes:
        error: torque error of its file.
        worst: number of stated errors that a number is off at most.
    """

    error: float
    worst: float


# ---- the commands


@dataclass(frozen=True)
class Said:
    """What the commands say of a log.

    Attributes:
        findings: of the command ``log``; each has level, about, and text.
        code: exit code of ``identify``; that of ``log`` where it stops.
        content: of params.json, where ``identify`` ends with 0.
        model: the written file.
        crash: the last line of a traceback; "" for none.
    """

    findings: tuple[dict[str, Any], ...]
    code: int
    content: dict[str, Any] | None = None
    model: Path | None = None
    crash: str = ""

    @property
    def stops(self) -> list[dict[str, Any]]:
        """Return the findings that stop the log."""
        return [each for each in self.findings if each["level"] != "says"]


def error_finding(messages: str) -> dict[str, Any]:
    """Return an error that is no finding as one."""
    lines = [line for line in messages.splitlines() if "error:" in line]
    return {"level": "refuses", "about": "error", "text": "".join(lines[-1:])}


def ask(folder: Path, model: Path, log: Path, options: Sequence[str]) -> Said:
    """Return what ``log`` says of a log and, where it does not stop, ``identify``."""
    code, output, messages = run_command("log", log, model, "--json", *options)
    if CRASH in messages:
        return Said((), code, crash=messages.strip().rpartition("\n")[2])
    content = json.loads(output) if output.startswith("{") else {}
    found = list(content.get("findings", ()))
    if code and not found:
        found.append(error_finding(messages))
    if code:
        return Said(tuple(found), code)
    return identify(folder, model, log, options, found)


def identify(
    folder: Path,
    model: Path,
    log: Path,
    options: Sequence[str],
    found: Sequence[dict[str, Any]],
) -> Said:
    """Return what ``identify`` says of a log, beside what was found."""
    results = folder / "results"
    words = ("identify", model, log, "--output-dir", results, *options)
    code, _, messages = run_command(*words)
    if CRASH in messages:
        return Said(tuple(found), code, crash=messages.strip().rpartition("\n")[2])
    if code:
        return Said((*found, error_finding(messages)), code)
    content = json.loads((results / "params.json").read_text())
    return Said(tuple(found), code, content, written_model(results))


def accept_all(found: Sequence[dict[str, Any]]) -> list[str]:
    """Return the options that accept all doubts."""
    names = dict.fromkeys(each["about"] for each in found if each["level"] == "doubts")
    return [word for name in names for word in ("--accept", name)]


def ask_right(folder: Path, model: Path, log: Path, options: Sequence[str]) -> Said:
    """Return what the commands say of a right log, whose doubts are accepted."""
    said = ask(folder, model, log, options)
    if said.content is None and not said.crash:
        accepting = [*options, *accept_all(said.findings)]
        said = identify(folder, model, log, accepting, said.findings)
    return said


# ---- simulated arms


def bare_models(names: Sequence[str], models: Path, folder: Path) -> dict[str, Path]:
    """Return model files of arms without shapes, written in a folder.

    Meshes would take gigabytes with all scenes that are kept.
    """
    paths = {}
    for name in names:
        text = bare_model_text(model_path(name, models, folder))
        paths[name] = folder / f"{Path(name).stem}_bare.xml"
        paths[name].write_text(text)
    return paths


@lru_cache(maxsize=48)
def scene_of(path: Path, arm_name: str, duration: float, seed: int) -> Scene:
    """Return an arm that differs from a model file, with a right log of it."""
    return draw_scene(path, arm_name, "real", duration, seed)


def file_error(scene: Scene, model: Path, seed: int) -> float:
    """Return the torque error of a file on another motion of the true arm, friction included."""
    rng = np.random.default_rng([seed, _JUDGED_STREAM])
    plan = generate_excitation_trajectory(scene.robot, rng, JUDGED_SECONDS)
    motion = plan.evaluate(np.arange(0.0, JUDGED_SECONDS, JUDGED_STEP))
    rigid, friction = scene.arm.torques(motion)
    torque = FileTorque(model, scene.robot.joint_names)
    predicted = torque(motion.q, motion.qd, motion.qdd)
    return share_of_error(rigid + friction, predicted)


def worst_number(scene: Scene, content: dict[str, Any]) -> tuple[str, float]:
    """Return the quantity that is most of its stated errors off, and how many of them."""
    ratios = [
        (quantity, abs(off) / stated)
        for quantity, off, stated, _ in errors_of(
            scene, rows(content), content["curves"]
        )
        if np.isfinite(stated) and stated > 0.0
    ]
    return max(ratios, key=lambda pair: pair[1], default=("", 0.0))


@cache
def reference_of(path: Path, arm_name: str, duration: float, seed: int) -> Reference:
    """Return what the right log of an arm makes."""
    scene = scene_of(path, arm_name, duration, seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        model = folder / "model.xml"
        model.write_text(bare_model_text(path))
        write_log(folder / "log.csv", scene.robot.joint_names, scene.log)
        said = ask_right(folder, model, folder / "log.csv", ())
        if said.content is None or said.model is None:
            return Reference(UNKNOWN_RIGHT, 0.0)
        worst = worst_number(scene, said.content)[1]
        return Reference(file_error(scene, said.model, seed), worst)


# ---- what is said, beside what is right


def mentioned(names: Sequence[str], text: str) -> set[str]:
    """Return the names that a text has as whole words."""
    return {n for n in names if re.search(rf"(?<!\w){re.escape(n)}(?!\w)", text)}


def is_right(finding: dict[str, Any], change: Change, joints: Sequence[str]) -> bool:
    """Return whether a finding names a change rightly, and blames a culprit where it is of one."""
    if finding["about"] not in {name.value for name in change.names}:
        return False
    blamed = mentioned([*joints, *change.culprits], finding["text"])
    is_of_links = change.names == {FaultName.MODEL}
    if not blamed or not change.culprits or is_of_links:
        return not change.culprits or not finding["text"].startswith("torque of all")
    return bool(blamed & {*change.culprits})


def is_named(said: Said, changes: Sequence[Change], joints: Sequence[str]) -> bool:
    """Return whether any finding, or remark of the result, names one of the changes rightly."""
    for change in changes:
        if any(is_right(each, change, joints) for each in said.findings):
            return True
        remarks = () if said.content is None else said.content["remarks"]
        for text in (remark["text"] for remark in remarks):
            has_culprit = bool(mentioned(change.culprits, text))
            is_of_links = FaultName.MODEL in change.names and has_culprit
            if is_of_links and CONTRADICTED.search(text):
                return True
    return False


def classify(
    said: Said, changes: Sequence[Change], joints: Sequence[str], is_wrong: bool
) -> str:
    """Return the class of what is said of a wrong log, see the module."""
    if said.crash:
        return "crashed"
    if is_wrong:
        return "wrong"
    if said.code == 0:
        return "rightly" if is_named(said, changes, joints) else "harmless"
    stops = said.stops
    if any(is_right(each, change, joints) for each in stops for change in changes):
        return "rightly"
    if is_named(said, changes, joints):
        return "doubt"
    named = [
        each
        for each in stops
        if each["about"] not in UNNAMED and ALTERNATIVES not in each["text"]
    ]
    return "misnamed" if named else "doubt"


# ---- cases


@dataclass(frozen=True)
class Task:
    """What all cases of a run have in common.

    Attributes:
        seed: of the run.
        arms: name of each simulated arm to its model file.
        real: folder of logs of real arms; None for simulated ones.
        is_right: whether logs are right ones under odd conditions.
    """

    seed: int
    arms: dict[str, Path]
    real: Path | None = None
    is_right: bool = False

    @property
    def mode(self) -> str:
        """Return the kind of its logs."""
        if self.is_right:
            return "right"
        return "wrong" if self.real is None else "real"

    def key(self, number: int) -> str:
        """Return the key of a case."""
        return f"{self.mode} {self.seed} {number}"

    def run(self, number: int) -> Row:
        """Return the result of a case, made in an empty folder, where commands leave columns."""
        rng = np.random.default_rng([self.seed, number])
        start = time.process_time()
        before = Path.cwd()
        with tempfile.TemporaryDirectory() as name:
            os.chdir(name)
            try:
                judge = {"right": judge_right, "wrong": judge_wrong, "real": judge_real}
                row = judge[self.mode](self, number, rng, Path(name))
            except Exception:
                # A case that cannot be made is no answer, and ends no run of hours.
                text = traceback.format_exc().strip()
                row = {
                    "arm": "?",
                    "kind": "not made",
                    "class": "not made",
                    "words": text,
                }
            finally:
                os.chdir(before)
        seconds = time.process_time() - start
        return {"key": self.key(number), "mode": self.mode, "seconds": seconds, **row}


def describe(said: Said) -> Row:
    """Return what is said, as a row has it."""
    findings = [
        f"{each['level']}:{each['about']}: {each['text'][:MOST_TEXT]}"
        for each in said.findings
    ]
    return {"code": said.code, "findings": findings, "crash": said.crash}


def judge_right(task: Task, number: int, rng: Any, folder: Path) -> Row:
    """Return what is said of a right log under odd conditions."""
    arm_name = [*task.arms][number % len(task.arms)]
    path = task.arms[arm_name]
    odd = draw_odd_log(rng, path, arm_name)
    scene = odd.scene
    model = folder / "model.xml"
    model.write_text(bare_model_text(path))
    write_log(folder / "log.csv", scene.robot.joint_names, scene.log)
    said = ask(folder, model, folder / "log.csv", odd.options)
    row: Row = {"arm": arm_name, "kind": odd.kind, "words": odd.words}
    row["class"] = "crashed" if said.crash else stopped_level(said)
    if said.content is not None and said.model is not None:
        row["error"] = file_error(scene, said.model, number)
        row["worst"] = [*worst_number(scene, said.content)]
    return {**row, **describe(said)}


def stopped_level(said: Said) -> str:
    """Return whether a right log is used, doubted, too short, or refused."""
    if said.code == 0:
        return "used"
    names = {each["about"] for each in said.stops}
    if names == {"too-little"}:
        return "too short"
    levels = {each["level"] for each in said.stops}
    return "refused" if "refuses" in levels else "doubted"


def judge_wrong(task: Task, number: int, rng: Any, folder: Path) -> Row:
    """Return what is said of a simulated log that is wrong."""
    arm_name = [*task.arms][number % len(task.arms)]
    path = task.arms[arm_name]
    duration = float(rng.choice([*DURATIONS], p=[*DURATIONS.values()]))
    scene_seed = 100 * (task.seed % 10**6) + int(rng.integers(SCENES_EACH))
    right = scene_of(path, arm_name, duration, scene_seed)
    names = tuple(right.robot.joint_names)
    subject = Subject(names, right.log, right.usual_torque, right)
    changes = draw_changes(rng, subject)
    for change in changes:
        subject = change.spoil(subject)
    scene = subject.scene or right
    model = folder / "model.xml"
    if subject.edits:
        model.write_text(model_text(path, lambda spec: edit_all(subject, spec)))
    else:
        model.write_text(bare_model_text(path))
    write_log(folder / "log.csv", names, subject.log)
    said = ask(folder, model, folder / "log.csv", ())
    row = row_of_changes(arm_name, duration, changes)
    is_wrong = False
    if said.content is not None and said.model is not None:
        reference = reference_of(path, arm_name, duration, scene_seed)
        error = file_error(scene, said.model, scene_seed)
        quantity, worst = worst_number(scene, said.content)
        most = max(TIMES_WORSE * reference.error, reference.error + POINTS_WORSE)
        is_file_wrong = bool(error > most)
        is_number_wrong = bool(worst > max(SURE_OF_ALL, reference.worst))
        is_wrong = is_file_wrong or is_number_wrong
        row |= {
            "error": error,
            "right_error": reference.error,
            "worst": [quantity, worst],
            "is_file_wrong": is_file_wrong,
            "is_number_wrong": is_number_wrong,
        }
    return {**row, **describe(said), "class": classify(said, changes, names, is_wrong)}


def edit_all(subject: Subject, spec: Any) -> None:
    """Make all edits of a model."""
    for edit in subject.edits:
        edit(spec)


def row_of_changes(arm: str, duration: float, changes: Sequence[Change]) -> Row:
    """Return what was done, as a row has it."""
    kinds = [change.kind for change in changes]
    names = [sorted(name.value for name in change.names) for change in changes]
    return {
        "arm": arm,
        "duration": duration,
        "kind": kinds[0] if len(kinds) == 1 else "two at once",
        "kinds": kinds,
        "words": "; and ".join(change.words for change in changes),
        "names": names,
        "culprits": [list(change.culprits) for change in changes],
    }


@cache
def real_recording(root: Path, real: RealLog) -> Recording:
    """Return a log of a real arm."""
    return real.read(root / real.path)


@cache
def real_reference(root: Path, real: RealLog) -> float | None:
    """Return the error of the file of an unspoiled real log on itself; None where it is refused."""
    log = real_recording(root, real)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = write_real_log(folder / "log.csv", log)
        said = ask_right(folder, root / real.model, path, real.options)
        if said.model is None:
            return None
        return error_on_log(said.model, log.time, log.q, log.tau, real.cut)


def judge_real(task: Task, number: int, rng: Any, folder: Path) -> Row:
    """Return what is said of a real log that is changed."""
    assert task.real is not None
    real = LOGS[number % len(LOGS)]
    right = real_recording(task.real, real)
    model = task.real / real.model
    names = tuple(load_robot_model(model).joint_names)
    loads = np.sqrt(np.mean(right.tau**2, axis=0))
    loads = np.maximum(loads, 0.02 * np.max(loads))
    subject = Subject(names, right, loads)
    changes = draw_changes(rng, subject)
    if rng.random() < DURATIONS[6.0]:
        rate = len(right) / (right.time[-1] - right.time[0])
        start = int(rng.uniform(0.0, 0.5) * max(len(right) - 6.0 * rate, 0.0))
        subject = replace(subject, log=right[start : start + int(6.0 * rate)])
    for change in changes:
        subject = change.spoil(subject)
    path = write_real_log(folder / "log.csv", subject.log)
    said = ask(folder, model, path, real.options)
    duration = float(subject.log.time[-1] - subject.log.time[0])
    row = row_of_changes(real.name, duration, changes)
    is_wrong = False
    if said.model is not None:
        reference = real_reference(task.real, real)
        error = error_on_log(said.model, right.time, right.q, right.tau, real.cut)
        row |= {"error": error, "right_error": reference}
        if reference is not None and error is not None:
            is_wrong = error > REAL_TIMES_WORSE * reference + REAL_POINTS_WORSE
    return {**row, **describe(said), "class": classify(said, changes, names, is_wrong)}


# ---- what is printed


def line_of(row: Row) -> str:
    """Return a result as a line of text."""
    parts = [f"{row['class']}: {row['arm']} ({row['key']}): {row['words']}"]
    if row.get("names"):
        names = " and ".join("/".join(names) for names in row["names"])
        parts.append(f"right: {names or 'none'}")
    if row.get("error") is not None:
        text = f"file {100.0 * row['error']:.1f} %"
        if row.get("right_error") is not None:
            text += f", of the right log {100.0 * row['right_error']:.1f} %"
        parts.append(text)
    if row.get("worst") and row["worst"][1] > SURE_OF_ALL:
        parts.append(f"{row['worst'][0]} {row['worst'][1]:.1f} errors off")
    parts += row.get("findings", ()) or ["nothing is said"]
    if row.get("crash"):
        parts.append(row["crash"])
    return " | ".join(parts)


def table_lines(found: Sequence[Row], classes: Sequence[str]) -> Iterator[str]:
    """Yield a table of classes by kind, and the shares of all."""
    titles = "".join(f"{name:>10}" for name in classes)
    yield f"{'kind':<34}{'logs':>6}{titles}"
    kinds = sorted({row["kind"] for row in found})
    for kind in kinds:
        counts = Counter(row["class"] for row in found if row["kind"] == kind)
        numbers = "".join(f"{counts[name]:>10}" for name in classes)
        yield f"{kind:<34}{sum(counts.values()):>6}{numbers}"
    counts = Counter(row["class"] for row in found)
    numbers = "".join(f"{counts[name]:>10}" for name in classes)
    yield f"{'all':<34}{len(found):>6}{numbers}"
    for name in classes:
        yield f"{name}: {counts[name]} of {len(found)}, {counts[name] / len(found):.1%}"


def run_cases(task: Task, count: int, kept: RowFile, jobs: int) -> Iterator[Row]:
    """Yield the results of cases, of which the file may have some, and print failures."""
    missing = [n for n in range(count) if task.key(n) not in kept]
    with ExitStack() as stack:
        made: Iterator[Row] = map(task.run, missing)
        if jobs > 1:
            made = stack.enter_context(ProcessPoolExecutor(jobs)).map(task.run, missing)
        for number in range(count):
            key = task.key(number)
            if key not in kept:
                kept.add(next(made))
            row = kept[key]
            if row["class"] not in ("rightly", "doubt", "harmless", "used"):
                print(line_of(row), flush=True)
            yield row


def main() -> int:
    """Print failures and the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("models", type=Path, metavar="MODELS_FOLDER")
    parser.add_argument("--cases", type=int)
    parser.add_argument("--seed", type=int)
    parser.add_argument("--right", type=int, help="so many right logs instead")
    parser.add_argument("--real", type=Path, metavar="REAL_LOGS")
    parser.add_argument("--arms", nargs="+")
    parser.add_argument("--rows", type=Path)
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    seed = int(time.time()) % 10**6 if options.seed is None else options.seed
    drawn = [f"{DRAWN}{seed % 1000 + k}" for k in range(2)]
    names = options.arms or [*ARMS, *drawn]
    print(f"--seed {seed} repeats or resumes this run", flush=True)
    kept = RowFile(options.rows)
    count = options.cases
    if count is None:
        count = options.right or (300 if options.real is None else 60)
    classes: Sequence[str] = CLASSES
    if options.right is not None:
        classes = ("used", "too short", "doubted", "refused", "crashed")
    with tempfile.TemporaryDirectory() as name:
        paths = bare_models(names, options.models.resolve(), Path(name))
        real = None if options.real is None else options.real.resolve()
        task = Task(seed, paths, real, options.right is not None)
        found = list(run_cases(task, count, kept, options.jobs))
    if count == 0:
        found = [row for row in kept.rows() if row["mode"] == task.mode]
    if not found:
        return 0
    print()
    print(*table_lines(found, (*classes, "not made")), sep="\n")
    bad = {*FAILURES, "doubted", "refused"}
    return int(any(row["class"] in bad for row in found))


if __name__ == "__main__":
    with end_on_signals():
        sys.exit(main())
