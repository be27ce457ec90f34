"""Which faults the checks name for logs and models with one known fault, and what others cost.

    python -m benchmarks.confusion MODELS_FOLDER [--arms ur5e iiwa14 ...] [--causes ripple ...]
        [--deviations real] [--seeds 3] [--first-seed 0] [--duration 20] [--no-answers]

Arms are drawn as in ``benchmarks.real_arms``, one per model, deviation and seed, the same for all
causes and durations, so that rows can be compared. The cause "right" leaves a log as it is, and has
logs of 6, 8, 15 and 60 s. Per cause, logs are counted by the findings of the checks before an
identification, of any level, and by motors over two joints that the estimate finds:

rightly     a finding has the right name
tie         none has, but one lists several causes that fit equally well
withheld    the only finding is that a part of the torque is not explained
wrongly     all findings have other names
silent      no finding

A log that no finding refuses or warns of is identified with default options, and its last link's
mass is compared with the true one:

stopped     refused, or warned of: a user has no answer
no use      there is an answer, but its verdict is against it
harmful     a trusted mass that is 10 % and two stated errors off
off         a trusted mass that is 10 % or two stated errors off (harmful ones included)
sound       any other trusted mass

Then come the mean time of the checks and each set of names. Where the payload changes within a log,
the nearest of the true masses counts. Below each cause are its failures: wrong logs that are not
named rightly, right logs that are named, harmful answers.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.confusion_causes import CAUSES, RIGHT, Scene, draw_scene
from benchmarks.real_arms import ARMS, DEVIATIONS, USUAL_ARMS
from robot_sysid.diagnosis import Finding, Level
from robot_sysid.diagnosis.log_checks import check_against_model
from robot_sysid.errors import SysidError
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.parser import load_robot_model
from robot_sysid.records import RobotModel
from robot_sysid.signals.resampling import split_at_gaps
from tests.support.core_fits import result_of_logs

RIGHT_DURATIONS = (6.0, 8.0, 15.0, 60.0)
"""Durations of right logs [s]."""
NAMINGS = ("rightly", "tie", "withheld", "wrongly", "silent")
COSTS = ("stopped", "no use", "harmful", "off", "sound")
FAR = 0.1
SURE = 2.0
"""Part of the true mass, and stated errors, by which an answer is off."""
SHOWN_TEXT = 110
"""Characters of a finding that are printed."""
ALTERNATIVES = "; or "
"""Text between causes that fit equally well."""
OTHER_ARM = "the model of another arm"
"""Text before a fault that only makes the log of another arm fit a little better."""


@dataclass(frozen=True)
class Answer:
    """Result of ``identify``: the last link's mass [kg], and the motors over two joints."""

    mass: float
    error: float
    true_mass: float
    is_trusted: bool
    motors: tuple[str, ...] = ()

    @property
    def is_far(self) -> bool:
        """Return whether the mass is off by more than 10 %."""
        return abs(self.mass - self.true_mass) > FAR * self.true_mass

    @property
    def is_beyond_error(self) -> bool:
        """Return whether the mass is off by more than two stated errors."""
        return abs(self.mass - self.true_mass) > SURE * self.error

    def describe(self) -> str:
        """Return it in words."""
        if np.isnan(self.mass):
            return "the identification fails"
        verdict = "trusted" if self.is_trusted else "not trusted"
        return f"mass {self.mass:.3g} ± {self.error:.2g} kg ({self.true_mass:.3g}), {verdict}"


@dataclass(frozen=True)
class Outcome:
    """Findings of the checks of one log, their time [s], and the answer.

    Attributes:
        answer: None where the log is stopped or no answer is asked for.
    """

    findings: tuple[Finding, ...]
    seconds: float
    answer: Answer | None

    @property
    def is_stopped(self) -> bool:
        """Return whether the log is refused or warned of."""
        return any(finding.level is not Level.NOTE for finding in self.findings)

    @property
    def names(self) -> str:
        """Return the names of the findings, with their levels."""
        named = dict.fromkeys(f"{f.name}:{f.level.value}" for f in self.findings)
        return "+".join(named) or "-"

    def classify_naming(self, right_names: Sequence[str]) -> str:
        """Return how the cause is named, see the module."""
        if not self.findings:
            return "silent"
        ties = [f for f in self.findings if ALTERNATIVES in f.text]
        names = {f.name for f in self.findings if f not in ties}
        if any(OTHER_ARM in f.text for f in self.findings):
            names.add("model")
        if not names.isdisjoint(right_names):
            return "rightly"
        if ties:
            return "tie"
        is_withheld = all(f.name == "unexplained" for f in self.findings)
        return "withheld" if is_withheld else "wrongly"

    def classify_costs(self) -> Iterator[str]:
        """Yield what the log costs its user, see the module."""
        if self.is_stopped:
            yield "stopped"
        if self.answer is None:
            return
        if not self.answer.is_trusted:
            yield "no use"
            return
        if self.answer.is_far and self.answer.is_beyond_error:
            yield "harmful"
        yield "off" if self.answer.is_far or self.answer.is_beyond_error else "sound"


def check_scene(scene: Scene, is_answered: bool) -> Outcome:
    """Return the findings on a scene's log, and the answer where no finding stops it."""
    start = time.process_time()
    try:
        findings = check_against_model(scene.robot, split_at_gaps(scene.log))
    except SysidError as error:
        findings = (Finding("error", Level.REFUSE, str(error)),)
    outcome = Outcome(findings, time.process_time() - start, None)
    if outcome.is_stopped or not is_answered:
        return outcome
    answer = identify_scene(scene)
    # The estimate names these itself, for it knows on which side of the gears sensors are.
    motors = [
        Finding("coupling", Level.NOTE, f"a motor turns with {name}")
        for name in answer.motors
    ]
    return replace(outcome, findings=(*findings, *motors), answer=answer)


def identify_scene(scene: Scene) -> Answer:
    """Return the answer of ``identify`` with default options; one that fails is not trusted."""
    try:
        result = result_of_logs(scene.robot, [scene.log], EstimationOptions(), ())
    except SysidError:
        return Answer(np.nan, np.nan, scene.last_masses[0], False)
    link = result.links[-1]
    mass = link.inertial.mass
    true_mass = min(scene.last_masses, key=lambda true: abs(true - mass))
    is_trusted = result.verdict.is_trustworthy
    return Answer(
        mass, float(link.errors[0]), true_mass, is_trusted, tuple(result.couplings)
    )


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

    def run(self, robot: RobotModel, is_answered: bool) -> Outcome:
        """Return the outcome of the case's log."""
        scene = draw_scene(
            robot, self.arm_name, self.deviation, self.duration, self.seed
        )
        make_cause, _ = CAUSES[self.cause]
        return check_scene(make_cause(scene), is_answered)

    def is_failure(self, outcome: Outcome) -> bool:
        """Return whether the cause is not named as it should be, or the answer is harmful."""
        expected_naming = "silent" if self.cause == RIGHT else "rightly"
        naming = outcome.classify_naming(CAUSES[self.cause][1])
        return naming != expected_naming or "harmful" in outcome.classify_costs()

    def describe_failure(self, outcome: Outcome) -> str:
        """Return one line on it."""
        about = f"{self.arm_name} {self.deviation} {self.duration:g} s seed {self.seed}"
        texts = [finding.line()[:SHOWN_TEXT] for finding in outcome.findings]
        texts = texts or ["nothing is said"]
        answers = [] if outcome.answer is None else [outcome.answer.describe()]
        return "  " + " | ".join([about, *texts, *answers])


@dataclass(frozen=True)
class Tally:
    """Counts of logs by naming, cost and names of findings, and times of the checks [s]."""

    namings: Counter[str]
    costs: Counter[str]
    names: Counter[str]
    seconds: list[float]

    @staticmethod
    def empty() -> Tally:
        """Return the counts of no logs."""
        return Tally(Counter(), Counter(), Counter(), [])

    def add(self, case: Case, outcome: Outcome) -> None:
        """Count one log: how it is named, what its answer costs, names and time."""
        self.namings[outcome.classify_naming(CAUSES[case.cause][1])] += 1
        self.costs.update(outcome.classify_costs())
        self.names[outcome.names] += 1
        self.seconds.append(outcome.seconds)

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


def print_cause(
    cause: str, robots: dict[str, RobotModel], options: argparse.Namespace
) -> Tally:
    """Print the rows of a cause and its failures; return the counts of all its logs."""
    total = Tally.empty()
    rows: dict[str, Tally] = {}
    failures: list[str] = []
    for case in cases_of(cause, options):
        outcome = case.run(robots[case.arm_name], not options.no_answers)
        for tally in (total, rows.setdefault(case.row, Tally.empty())):
            tally.add(case, outcome)
        if case.is_failure(outcome):
            failures.append(case.describe_failure(outcome))
    for row, tally in rows.items():
        print(tally.line(row))
    print(*failures, sep="\n", end="\n" * bool(failures), flush=True)
    return total


def print_share(title: str, numerator: int, denominator: int) -> None:
    """Print a fraction as counts and in percent; nothing where there is no case."""
    if denominator:
        print(
            f"{title}: {numerator} of {denominator}, {100.0 * numerator / denominator:.1f} %"
        )


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("models", type=Path)
    parser.add_argument(
        "--arms", nargs="+", default=list(USUAL_ARMS), choices=list(ARMS)
    )
    parser.add_argument(
        "--causes", nargs="+", default=list(CAUSES), choices=list(CAUSES)
    )
    parser.add_argument("--deviations", nargs="+", default=["real"], choices=DEVIATIONS)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument(
        "--duration", type=float, default=20.0, help="of wrong logs [s]"
    )
    parser.add_argument(
        "--no-answers", action="store_true", help="only look at the logs"
    )
    options = parser.parse_args()
    robots = {
        arm_name: load_robot_model(options.models / ARMS[arm_name])
        for arm_name in options.arms
    }
    titles = "".join(f"{title:>9}" for title in ("logs", *NAMINGS, *COSTS))
    print(f"{'cause':<31}{titles}{'time':>9}  names", flush=True)
    tallies = {cause: print_cause(cause, robots, options) for cause in options.causes}
    right_tally = tallies.pop(RIGHT, Tally.empty())
    namings = sum((tally.namings for tally in tallies.values()), Counter[str]())
    costs = sum((tally.costs for tally in tallies.values()), right_tally.costs)
    wrong_count = sum(namings.values())
    right_count = len(right_tally.seconds)
    print()
    print_share("wrong logs named rightly", namings["rightly"], wrong_count)
    named_count = namings["rightly"] + namings["tie"]
    print_share("wrong logs named rightly or as a tie", named_count, wrong_count)
    print_share(
        "right logs named", right_count - right_tally.namings["silent"], right_count
    )
    print_share("right logs stopped", right_tally.costs["stopped"], right_count)
    print_share(
        "harmful answers of all logs", costs["harmful"], wrong_count + right_count
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
