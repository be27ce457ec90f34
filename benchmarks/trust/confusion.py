"""Which faults the checks name for logs and models with one known fault, and what others cost.

    python -m benchmarks.trust.confusion MODELS_FOLDER [--arms ur5e drawn-3 ARM.urdf ...]
        [--causes ripple ...]
        [--deviations real] [--seeds 3] [--first-seed 0] [--duration 20] [--no-answers] [--jobs 1]

``--causes`` takes the names of causes, "usual" for those of ``benchmarks.trust.confusion_causes``
and "mistakes" for those of ``benchmarks.trust.confusion_mistakes``. Logs are judged in so many
processes at once as ``--jobs`` says.

``--arms`` takes names of public arms, files of models, and "drawn-1", "drawn-2", ... for models
that are drawn at random (``rigs.arms.drawn_models``).

Arms are drawn as in ``benchmarks.trust.real_arms``, one per model, deviation and seed, the same for
all causes and durations, so that rows can be compared. Causes without a fault ("right" has logs of
6, 8, 15 and 60 s) show what right logs are accused of. Log and model are files, and what is judged
are the answers of the commands ``log`` and ``identify``. The package of another checkout is judged
by these scripts, from an empty folder (commands leave proposed columns there) and with Python 3.11
or newer, whose ``-P`` keeps the folder itself off the path:

    mkdir judge && ln -s CHECKOUT/benchmarks CHECKOUT/rigs judge/
    PYTHONPATH=judge:OTHER_CHECKOUT python -P -m benchmarks.trust.confusion MODELS_FOLDER

CHECKOUT has these scripts. Only commands, documented formats and what draws arms (``spatial``,
``dynamics``, ``model``, ``records``, ``trajectory``) are used of the other one.

Per cause, logs are counted by what is said of them: by findings of ``log`` of any level, motors
over two joints that the estimate finds, and remarks of the estimate:

rightly     every fault has its right name (and that of the joint or body, where one is wrong, and
            of no other joint); of several, each in its turn, after following the advice of those
            before
            It may be the first of a pair that the log cannot tell apart, with what tells them apart
doubt       no right name, or not of every fault: a finding lists more causes that fit equally
            well, or says that a part of the torque is not explained, or the verdict is against it
misnamed    all findings have other names, the right one blames a second joint, or a command crashes
silent      nothing is said; at the end, too, how often that did no harm: the answer is no use, or
            every number (masses, centres, inertias, rotors, friction) is within four stated errors

Then they are counted by what they cost:

stopped     refused, or doubted: a user has no answer
no use      there is an answer, but its verdict is against it
harmful     a trusted mass that is 20 % off, and two stated errors (the last link's) or three (one
            of the other links'): of the answer, or of the one after following advice: options or
            columns that a finding states, or accepting its doubts
off         a trusted answer's last mass that is two stated errors off
sound       any other trusted mass

A command that ends with a traceback is found as "crash", and refused; one that a signal stops ends
the benchmark, with exit code 130 or 143, and is not counted. Then come the mean processor
time of both commands and each set of names. Where the payload changes within a log, the nearest of
the true masses counts. Below each cause are its failures: wrong logs that are not named rightly,
right logs that are named, harmful answers.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.trust.answers import (
    CRASH,
    bare_model_text,
    end_on_signals,
    identify_logs,
    model_text,
    number,
    run_command,
    write_log,
)
from benchmarks.trust.confusion_causes import CAUSES as USUAL_CAUSES
from benchmarks.trust.confusion_causes import RIGHT, Cause, Scene, draw_scene
from benchmarks.trust.confusion_mistakes import MISTAKES
from benchmarks.trust.real_arms import arms_parser, errors_of
from rigs.arms.drawn_models import model_path
from rigs.arms.wrong_arms import DEVIATIONS
from rigs.files.params import motors, rows
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Recording

GROUPS = {"usual": USUAL_CAUSES, "mistakes": MISTAKES}
CAUSES = {**USUAL_CAUSES, **MISTAKES}
"""Cause by its name."""
CRASHED = "crash"
"""Name of the finding that a command ended with a traceback."""
RIGHT_DURATIONS = (6.0, 8.0, 15.0, 60.0)
"""Durations of right logs [s]."""
NAMINGS = ("rightly", "doubt", "misnamed", "silent")
COSTS = ("stopped", "no use", "harmful", "off", "sound")
FAR = 0.2
SURE = 2.0
"""Part of the true mass, and stated errors, by which an answer is off."""
SURE_OF_MANY = 3.0
"""The same errors where one of several other links counts."""
SURE_OF_ALL = 4.0
"""The same errors where one of all numbers counts, about fifty: a chance of 0.3 % by noise."""
ZERO_TEXT = r"position of joint (\S+) reads ([\d.]+).* (rad|degrees) too (much|little)"
"""What is said of a zero, which the user corrects."""
MOST_TURNS = 3
"""Times that advice is followed to find what is wrong beside."""
SHOWN_TEXT = 110
"""Characters of a finding that are printed."""
ALTERNATIVES = "; or "
"""Text between causes that fit equally well."""
OTHER_ARM = "the model of another arm"
"""Text before a fault that only makes the log of another arm fit a little better."""


@dataclass(frozen=True)
class Finding:
    """A finding of the command ``log``, as its JSON has it."""

    about: str
    level: str
    text: str
    options: tuple[tuple[str, ...], ...] = ()
    correction: dict[str, Any] | None = None

    @classmethod
    def of_crash(cls, messages: str) -> Finding:
        """Return the finding that a command crashed, with the last line of its traceback."""
        return cls(CRASHED, "refuses", messages.strip().rpartition("\n")[2])

    @classmethod
    def of_entry(cls, entry: dict[str, Any]) -> Finding:
        """Return a finding of an entry of the JSON."""
        options = tuple(map(tuple, entry.get("options") or ()))
        correction = entry.get("correction")
        return cls(entry["about"], entry["level"], entry["text"], options, correction)

    @property
    def zero(self) -> tuple[str, float] | None:
        """(Joint, by how much its position reads too much [rad]), where that is what is wrong."""
        match = re.search(ZERO_TEXT, self.text)
        if match is None:
            return None
        name, size, unit, way = match.groups()
        radians = float(size) * (1.0 if unit == "rad" else np.radians(1.0))
        return name, radians if way == "much" else -radians

    def corrected(self, log: Recording) -> Recording:
        """Return a log with its columns put right, as the finding says."""
        if self.correction is None:
            return log
        columns = {"q": log.q, "qd": log.qd, "tau": log.tau}
        attributes = {"position": ("q", "qd"), "torque": ("tau",)}
        for quantity, names in attributes.items():
            for name in names:
                values = columns[name]
                if values is not None:
                    order, factors = zip(*self.correction[quantity])
                    columns[name] = values[:, list(order)] * factors
        return Recording(log.time, columns["q"], columns["qd"], columns["tau"])


@dataclass(frozen=True)
class Answer:
    """Result of ``identify``: the last link's mass [kg], and what is said of it.

    Attributes:
        mass, error, true_mass: NaN where the identification fails.
        other_masses: (mass, error, true mass) of each other link that is identified.
        is_trusted: whether the verdict is for it.
        motors: those over two joints that are found.
        remarks: what is said of the result.
        worst: quantity that is most of its stated errors off, and that number of them.
        crash: the last line of a traceback; "" for none.
    """

    mass: float
    error: float
    true_mass: float
    is_trusted: bool
    motors: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    other_masses: tuple[tuple[float, float, float], ...] = ()
    worst: tuple[str, float] = ("", 0.0)
    crash: str = ""

    @property
    def is_beyond_error(self) -> bool:
        """Return whether the mass is off by more than two stated errors."""
        return abs(self.mass - self.true_mass) > SURE * self.error

    @property
    def distance(self) -> float:
        """Return how far all masses are off together [kg]; the last link may weigh next to nothing.

        The wrong one of two ways is a factor on all of them.
        """
        masses = [(self.mass, self.error, self.true_mass), *self.other_masses]
        return sum(abs(mass - true) for mass, _, true in masses)

    @property
    def is_harmful(self) -> bool:
        """Return whether it is trusted and clearly wrong."""
        last = is_far(self.mass, self.error, self.true_mass, SURE)
        others = any(is_far(*each, SURE_OF_MANY) for each in self.other_masses)
        return self.is_trusted and (last or others)

    def describe(self) -> str:
        """Return it in words."""
        if self.crash:
            return f"CRASH: {self.crash}"
        if np.isnan(self.mass):
            return "the identification fails"
        verdict = "trusted" if self.is_trusted else "not trusted"
        others = [
            f", another link {mass:.3g} ± {error:.2g} kg ({true:.3g})"
            for mass, error, true in self.other_masses
            if is_far(mass, error, true, SURE_OF_MANY)
        ]
        return (
            f"mass {self.mass:.3g} ± {self.error:.2g} kg ({self.true_mass:.3g})"
            f"{''.join(others)}, {self.worst[0]} {self.worst[1]:.1f} errors off, {verdict}"
        )


def is_far(mass: float, error: float, true: float, errors: float) -> bool:
    """Return whether a mass is 20 % and so many stated errors off the true one."""
    return abs(mass - true) > max(FAR * true, errors * error)


@dataclass(frozen=True)
class Outcome:
    """What the commands say of one log.

    Attributes:
        findings: of the command ``log``, and motors over two joints.
        seconds: processor time of both commands.
        answer: None where the log is stopped or no answer is asked for.
        advised: answers after following the advice of findings that stop the log.
        culprit: name of the joint or body that is wrong; "" where none is alone.
        innocents: names of the other joints, where one joint is wrong.
        later: findings after following the advice of these.
    """

    findings: tuple[Finding, ...]
    seconds: float
    answer: Answer | None
    advised: tuple[Answer, ...] = ()
    culprit: str = ""
    innocents: tuple[str, ...] = ()
    later: tuple[Finding, ...] = ()

    @property
    def is_stopped(self) -> bool:
        """Return whether the log is refused or doubted."""
        return any(finding.level != "says" for finding in self.findings)

    @property
    def is_crash(self) -> bool:
        """Return whether a command ended with a traceback."""
        answers = self.advised if self.answer is None else (self.answer, *self.advised)
        return any(f.about == CRASHED for f in self.findings) or any(
            answer.crash for answer in answers
        )

    def blames_innocents(self, cause: Cause) -> bool:
        """Return whether a finding with a right name is about a second joint, too."""
        names = {name for fault in cause.faults for name in fault}
        texts = [f.text for f in self.findings if f.about in names]
        return any(name in text for name in self.innocents for text in texts)

    @property
    def names(self) -> str:
        """Return the names of the findings, with their levels."""
        named = dict.fromkeys(f"{f.about}:{f.level}" for f in self.findings)
        return "+".join(named) or "-"

    def classify_naming(self, cause: Cause) -> str:
        """Return how the cause is named, see the module."""
        texts = [f.text for f in self.findings]
        texts += () if self.answer is None else self.answer.remarks
        right = {name for fault in cause.faults for name in fault}
        ties = [
            f
            for f in self.findings
            if f.text.count(ALTERNATIVES) > (1 if f.about in right else 0)
        ]
        names = {f.about for f in (*self.findings, *self.later) if f not in ties}
        if any(OTHER_ARM in text for text in texts):
            names.add("other arm")
        named = [not names.isdisjoint(fault) for fault in cause.faults]
        if cause.words and any(re.search(cause.words, text) for text in texts):
            named = [True]
        is_culprit_said = any(self.culprit in text for text in ["", *texts])
        if self.is_crash or self.blames_innocents(cause):
            return "misnamed"
        if cause.faults and all(named) and is_culprit_said:
            return "rightly"
        is_untrusted = self.answer is not None and not self.answer.is_trusted
        if not self.findings:
            return "doubt" if is_untrusted and cause.faults else "silent"
        is_withheld = all(f.about == "unexplained" for f in self.findings)
        return "doubt" if any(named) or ties or is_withheld else "misnamed"

    @property
    def is_harmless(self) -> bool:
        """Return whether there is an answer in which no number is clearly off, or of no use."""
        if self.answer is None:
            return False
        return not self.answer.is_trusted or self.answer.worst[1] <= SURE_OF_ALL

    def classify_costs(self) -> Iterator[str]:
        """Yield what the log costs its user, see the module."""
        if self.is_crash:
            yield CRASHED
        if self.is_stopped:
            yield "stopped"
        answers = self.advised if self.answer is None else (self.answer, *self.advised)
        if any(answer.is_harmful for answer in answers):
            yield "harmful"
        if self.answer is None:
            return
        if not self.answer.is_trusted:
            yield "no use"
        elif self.answer.is_beyond_error:
            yield "off"
        else:
            yield "sound"


class Judge:
    """Runs the commands on the files of one scene in a folder."""

    def __init__(self, scene: Scene, folder: Path) -> None:
        self.scene = scene
        self.folder = folder
        own_name = "model.urdf" if scene.urdf else "model.xml"
        self.model = scene.other_path or folder / own_name
        self.joint_names = scene.robot.joint_names
        if scene.other_path is not None:
            self.joint_names = load_robot_model(scene.other_path).joint_names
        if scene.other_path is None:
            self.model.write_text(scene.urdf or self.edited_text())

    def edited_text(self) -> str:
        """Return the right model, or what the scene makes of it, as MJCF."""
        scene = self.scene
        if scene.edit is None:
            return bare_model_text(scene.path)
        return model_text(scene.path, scene.edit)

    @property
    def innocents(self) -> tuple[str, ...]:
        """Return the names of the other joints, where one joint is wrong; else ()."""
        names = self.joint_names
        if self.scene.culprit not in names:
            return ()
        return tuple(name for name in names if name != self.scene.culprit)

    def write_logs(self, logs: Sequence[Recording]) -> list[Path]:
        """Write logs and return their files."""
        paths = [self.folder / f"log{k}.csv" for k in range(len(logs))]
        for path, log in zip(paths, logs):
            write_log(path, self.joint_names, log)
        return paths

    def find(self, path: Path, *options: str) -> Iterator[Finding]:
        """Yield the findings of the command ``log`` on a log."""
        code, output, messages = run_command(
            "log", path, self.model, "--json", *options
        )
        content = json.loads(output) if output.startswith("{") else {}
        entries = content.get("findings", ())
        yield from map(Finding.of_entry, entries)
        if CRASH in messages:
            yield Finding.of_crash(messages)
        elif code and not entries:
            error = [line for line in messages.splitlines() if "error:" in line]
            yield Finding("error", "refuses", "".join(error[:1]) or messages)

    def find_in_turn(self, findings: Sequence[Finding]) -> Iterator[Finding]:
        """Yield what is found after following the advice of findings, one after the other."""
        logs = self.scene.logs
        options: tuple[str, ...] = ()
        for _ in range(MOST_TURNS):
            usable = (f for f in findings if f.options or f.correction or f.zero)
            first = next(usable, None)
            if first is None:
                return
            logs = [self.with_zero(first, first.corrected(log)) for log in logs]
            # Where there are several ways, the last one changes the log.
            options += first.options[-1] if first.options else ()
            paths = self.write_logs(logs)
            findings = [f for path in paths for f in self.find(path, *options)]
            yield from findings

    def with_zero(self, finding: Finding, log: Recording) -> Recording:
        """Return a log with a joint's zero put right, as the finding says."""
        if finding.zero is None:
            return log
        name, size = finding.zero
        is_joint = np.array([name == other for other in self.joint_names])
        return replace(log, q=log.q - size * is_joint)

    def identify(self, paths: Sequence[Path], *options: str) -> Answer:
        """Return the answer of ``identify``; one that fails is not trusted."""
        true_masses = self.scene.last_masses
        content, printed = identify_logs(self.folder, self.model, paths, *options)
        if content is None:
            crash = Finding.of_crash(printed).text if CRASH in printed else ""
            return Answer(np.nan, np.nan, true_masses[0], False, crash=crash)
        row = rows(content)[content["body_name"], "mass"]
        mass = float(row["value"])
        return Answer(
            mass,
            number(row["error"]),
            min(true_masses, key=lambda true: abs(true - mass)),
            content["valid"]["trustworthy"],
            tuple(motors(content)),
            tuple(remark["text"] for remark in content["remarks"]),
            tuple(self.other_masses(content)),
            self.worst_number(content),
        )

    def worst_number(self, content: dict[str, Any]) -> tuple[str, float]:
        """Return the quantity that is most of its stated errors off, and how many of them.

        A model with other names has none that can be compared.
        """
        if self.joint_names != self.scene.robot.joint_names:
            return "", 0.0
        ratios = [
            (quantity, abs(off) / stated)
            for quantity, off, stated, _ in errors_of(
                self.scene, rows(content), content["curves"]
            )
            if np.isfinite(stated) and stated > 0.0
        ]
        return max(ratios, key=lambda pair: pair[1], default=("", 0.0))

    def other_masses(
        self, content: dict[str, Any]
    ) -> Iterator[tuple[float, float, float]]:
        """Yield (mass, error, true mass) of each other link that is identified."""
        answer = rows(content)
        links = self.scene.robot.links[:-1]
        for link, theta in zip(links, self.scene.arm.thetas):
            row = answer.get((link.body_name, "mass"))
            if row is not None and row["error"] is not None:
                yield float(row["value"]), float(row["error"]), float(theta[0])

    def follow_advice(self, findings: Sequence[Finding]) -> Iterator[Answer]:
        """Yield the answers after following findings' advice, and after accepting doubts."""
        for finding in findings:
            if finding.options or finding.correction:
                logs = [finding.corrected(log) for log in self.scene.logs]
                paths = self.write_logs(logs)
                ways = finding.options or ((),)
                answers = [self.identify(paths, *way) for way in ways]
                # Of several ways the user knows which is right, as it is the log or the model.
                distances = [answer.distance for answer in answers]
                yield answers[int(np.argmin(np.nan_to_num(distances, nan=np.inf)))]
        paths = self.write_logs(self.scene.logs)
        doubted = dict.fromkeys(f.about for f in findings if f.level == "doubts")
        if doubted and all(f.level != "refuses" for f in findings):
            options = [word for name in doubted for word in ("--accept", name)]
            yield self.identify(paths, *options)


def check_scene(scene: Scene, is_answered: bool, has_turns: bool = False) -> Outcome:
    """Return what the commands say of a scene's log, and where no finding stops it, its answer.

    Where it ``has_turns``, advice is followed to find what is wrong beside.
    """
    with tempfile.TemporaryDirectory() as folder:
        judge = Judge(scene, Path(folder))
        paths = judge.write_logs(scene.logs)
        start = time.process_time()
        findings = [finding for path in paths for finding in judge.find(path)]
        seconds = time.process_time() - start
        advised: tuple[Answer, ...] = ()
        answer = None
        if is_answered and any(finding.level != "says" for finding in findings):
            advised = tuple(judge.follow_advice(findings))
        elif is_answered:
            answer = judge.identify(paths)
            seconds = time.process_time() - start
        later = tuple(judge.find_in_turn(findings)) if has_turns else ()
    # The estimate names these itself, for it knows on which side of the gears sensors are.
    for name in () if answer is None else answer.motors:
        findings.append(Finding("coupling", "says", f"a motor turns with {name}"))
    found = tuple(findings)
    innocents = judge.innocents
    return Outcome(found, seconds, answer, advised, scene.culprit, innocents, later)


@dataclass(frozen=True)
class Case:
    """One log: its cause, arm, deviation, duration [s] and seed."""

    cause: str
    arm_name: str
    deviation: str
    duration: float
    seed: int

    @property
    def row(self) -> str:
        """Return the title of the table's row that the case belongs to."""
        is_right = self.cause == RIGHT
        return (
            f"{RIGHT} {self.deviation} {self.duration:g} s" if is_right else self.cause
        )

    def run(self, paths: Mapping[str, Path], is_answered: bool) -> Outcome:
        """Return the outcome of the case's log, of an arm that differs from its model file.

        Args:
            paths: model file by the arm's name.
            is_answered: whether the log is identified, too.
        """
        path = paths[self.arm_name]
        cause = CAUSES[self.cause]
        duration = cause.duration or self.duration
        scene = draw_scene(path, self.arm_name, self.deviation, duration, self.seed)
        return check_scene(cause.spoil(scene), is_answered, len(cause.faults) > 1)

    def is_failure(self, outcome: Outcome) -> bool:
        """Return whether the cause is not named as it should be, or the answer is harmful."""
        cause = CAUSES[self.cause]
        expected_naming = "rightly" if cause.faults else "silent"
        naming = outcome.classify_naming(cause)
        return naming != expected_naming or "harmful" in outcome.classify_costs()

    def describe_failure(self, outcome: Outcome) -> str:
        """Return one line on it."""
        about = f"{Path(self.arm_name).stem} {self.deviation} {self.duration:g} s seed {self.seed}"
        texts = []
        for finding in outcome.findings:
            texts.append(
                f"{finding.level}: {finding.about}: {finding.text[:SHOWN_TEXT]}"
            )
        texts = texts or ["nothing is said"]
        answers = [] if outcome.answer is None else [outcome.answer.describe()]
        answers += [f"after advice: {answer.describe()}" for answer in outcome.advised]
        return "  " + " | ".join([about, *texts, *answers])


@dataclass(frozen=True)
class Tally:
    """Counts of logs by naming, cost and names of findings, times of the checks [s], and counts of
    logs without harm by naming."""

    namings: Counter[str]
    costs: Counter[str]
    names: Counter[str]
    seconds: list[float]
    harmless: Counter[str]

    @staticmethod
    def empty() -> Tally:
        """Return the counts of no logs."""
        return Tally(Counter(), Counter(), Counter(), [], Counter())

    def add(self, case: Case, outcome: Outcome) -> None:
        """Count one log: how it is named, what its answer costs, names and time."""
        naming = outcome.classify_naming(CAUSES[case.cause])
        self.namings[naming] += 1
        self.harmless[naming] += outcome.is_harmless
        self.costs.update(outcome.classify_costs())
        self.names[outcome.names] += 1
        self.seconds.append(outcome.seconds)

    def join(self, other: Tally) -> None:
        """Add another tally's counts."""
        self.namings.update(other.namings)
        self.costs.update(other.costs)
        self.names.update(other.names)
        self.seconds.extend(other.seconds)
        self.harmless.update(other.harmless)

    def line(self, row: str) -> str:
        """Return the row of the table."""
        counts = [len(self.seconds), *(self.namings[naming] for naming in NAMINGS)]
        counts += [self.costs[cost] for cost in COSTS]
        numbers = "".join(f"{count:>9}" for count in counts)
        names = ", ".join(
            f"{names} {count}" for names, count in self.names.most_common()
        )
        return f"{row:<31}{numbers}{np.mean(self.seconds):>7.2f} s  {names}"


def cases_of(cause: str, options: argparse.Namespace) -> Iterator[Case]:
    """Yield the logs of a cause, row after row."""
    for deviation in options.deviations:
        for duration in RIGHT_DURATIONS if cause == RIGHT else (options.duration,):
            for arm_name in options.arms:
                for seed in range(
                    options.first_seed, options.first_seed + options.seeds
                ):
                    yield Case(cause, arm_name, deviation, duration, seed)


def print_cause(cases: Sequence[Case], outcomes: Iterator[Outcome]) -> Tally:
    """Print the rows of a cause and its failures; return the counts of all its logs.

    Args:
        cases: of the cause.
        outcomes: yields those of these cases and of later ones.
    """
    total = Tally.empty()
    rows: dict[str, Tally] = {}
    failures: list[str] = []
    for case in cases:
        outcome = next(outcomes)
        for tally in (total, rows.setdefault(case.row, Tally.empty())):
            tally.add(case, outcome)
        if case.is_failure(outcome):
            failures.append(case.describe_failure(outcome))
    for row, tally in rows.items():
        print(tally.line(row))
    print(*failures, sep="\n", end="\n" * bool(failures), flush=True)
    return total


def causes_by_name(names: Sequence[str]) -> list[str]:
    """Return the names of causes, those of a group in place of the group's."""
    return [cause for name in names for cause in GROUPS.get(name, (name,))]


def print_share(title: str, numerator: int, denominator: int) -> None:
    """Print a fraction as counts and in percent; nothing where there is no case."""
    if denominator:
        print(
            f"{title}: {numerator} of {denominator}, {100.0 * numerator / denominator:.1f} %"
        )


def main() -> int:
    """Print the table."""
    parser = arms_parser(__doc__, arms=None)
    parser.add_argument(
        "--causes", nargs="+", default=list(GROUPS), choices=[*GROUPS, *CAUSES]
    )
    parser.add_argument("--deviations", nargs="+", default=["real"], choices=DEVIATIONS)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument(
        "--duration", type=float, default=20.0, help="of wrong logs [s]"
    )
    parser.add_argument(
        "--no-answers", action="store_true", help="only look at the logs"
    )
    parser.add_argument("--jobs", type=int, default=1, help="processes at once")
    options = parser.parse_args()
    titles = "".join(f"{title:>9}" for title in ("logs", *NAMINGS, *COSTS))
    print(f"{'cause':<31}{titles}{'time':>9}  names", flush=True)
    causes = causes_by_name(options.causes)
    cases = {cause: list(cases_of(cause, options)) for cause in causes}
    every_case = [case for cause in causes for case in cases[cause]]
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        paths = {
            name: model_path(name, options.models, folder) for name in options.arms
        }
        judge_case = partial(Case.run, paths=paths, is_answered=not options.no_answers)
        apply: Callable[..., Iterator[Outcome]] = map
        if options.jobs > 1:
            apply = stack.enter_context(ProcessPoolExecutor(options.jobs)).map
        outcomes = apply(judge_case, every_case)
        tallies = {cause: print_cause(cases[cause], outcomes) for cause in causes}
    right_total = Tally.empty()
    wrong_total = Tally.empty()
    for cause, tally in tallies.items():
        (wrong_total if CAUSES[cause].faults else right_total).join(tally)
    wrong_count = len(wrong_total.seconds)
    right_count = len(right_total.seconds)
    print()
    for naming in NAMINGS:
        print_share(f"wrong logs, {naming}", wrong_total.namings[naming], wrong_count)
    harmless = wrong_total.harmless["silent"]
    print_share("wrong logs, silent and harmless", harmless, wrong_count)
    right_named = right_count - right_total.namings["silent"]
    print_share("right logs named", right_named, right_count)
    print_share("right logs stopped", right_total.costs["stopped"], right_count)
    print_share("right logs of no use", right_total.costs["no use"], right_count)
    print_share("harmful of wrong logs", wrong_total.costs["harmful"], wrong_count)
    print_share("harmful of right logs", right_total.costs["harmful"], right_count)
    crash_count = wrong_total.costs[CRASHED] + right_total.costs[CRASHED]
    print_share("crashed", crash_count, wrong_count + right_count)
    return 0


if __name__ == "__main__":
    with end_on_signals():
        sys.exit(main())
