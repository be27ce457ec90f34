"""How far a simulated arm leaves its path when a motor fails, and the message of the player.

Run from the checkout:
    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python -m benchmarks.motors.motor_faults faults
    ... damage --runs 400 --seed 1
    ... stop
    ... clean
    ... clean --seeds 20                   # arms that are not as their models say
    ... clean --seeds 20 --model arm.xml --joint wrist
    ... all --json motor_faults.json
    ... page          # the table of motor_faults.md

The Kinova arm is played on simulated Damiao motors, in simulated time. ``damage`` spoils
one feedback frame, as text on a serial line; ``faults`` disturbs a motor or the arm while it plays;
``stop`` measures how far joints fall after the stop of an arm that is held still; ``clean`` plays
undisturbed, with ``--seeds`` arms that are not as their models say, with that many motions. A
fault's run branches off the undisturbed one in a process of its own.

The exit code is 1 where a damaged frame moved a joint farther than it may, or an undisturbed run
was stopped.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import re
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from rigs.files.page_tables import PageTable
from rigs.files.places import ROOT
from rigs.motors.fault_bench import (
    DAMAGE_BOUND,
    SHOULDER,
    BenchRun,
    Case,
    Outcome,
    SetUp,
    damage_cases,
    held_torque,
    hold_cases,
    load_of,
    outcomes_of,
)
from rigs.motors.incidents import CASES, UNSEEN
from rigs.motors.motor_causes import SecondMaster
from rigs.motors.worn_arms import WORN_ARMS, WornSetUp

PAGE = ROOT / "benchmarks" / "motors" / "motor_faults.md"
TABLE = PageTable(PAGE, "faults", "python -m benchmarks.motors.motor_faults page")
PAGE_HEAD = "| Fault | Departure [rad] | The message contains |\n| --- | --- | --- |"
_UNSEEN_MASTER = SecondMaster(SHOULDER, is_seen=False)
FAULTS = (*CASES, Case("second master, shoulder, not seen", _UNSEEN_MASTER, UNSEEN))
"""Faults of ``faults``: those of the page, and one more."""
RATES = (50.0, 100.0, 250.0, 500.0)
UNNOTICED = "nothing: it plays to the end"
"""What the page says of a run that nothing stopped."""


def setup_text(setup: SetUp) -> str:
    """Return the text of a set-up for tables."""
    model = setup.belief if setup.model_is_given else f"none ({setup.belief} fed)"
    park = f", park {setup.park}" if setup.park else ""
    stiffness = f", kp {setup.kp:g}" if setup.kp else ""
    pose = f", pose {setup.pose}" if setup.pose else ""
    return f"model {model}, {setup.rate:g} Hz{park}{stiffness}{pose}"


def outcome_text(outcome: Outcome) -> str:
    """Return a line about an outcome."""
    delay = "   -  " if outcome.stop_delay is None else f"{outcome.stop_delay:6.3f}"
    return (
        f"{outcome.name:34.34s} {outcome.phase[:10]:10s} "
        f"{outcome.figures['departure']:6.3f} rad {delay} s {outcome.ending:9s} "
        f"{outcome.words[:90]}  [{setup_text(outcome.setup)}]"
    )


def departure_of(outcome: Outcome) -> float:
    """Return how far a joint got from its path [rad]."""
    return outcome.figures["departure"]


def fault_cases(belief: str = "guess") -> list[Case]:
    """Return a case for each fault, with the model given and without."""
    cases = []
    for is_given in (True, False):
        setup = SetUp(belief, is_given)
        cases += [replace(case, setup=setup) for case in FAULTS]
    return cases


def clean_setups(rates: Sequence[float]) -> list[SetUp]:
    """Return what has to be played through undisturbed."""
    both = itertools.product(rates, (True, False))
    return [SetUp("guess", is_given, rate=rate) for rate, is_given in both]


def worn_setups(
    arms: dict[str, WornSetUp], rates: Sequence[float], seeds: int
) -> Iterator[tuple[str, SetUp]]:
    """Yield, with their row of the table, the runs of arms that are not as their models say."""
    grid = itertools.product(arms.items(), (True, False), rates, range(seeds))
    for (name, arm), is_given, rate, seed in grid:
        model = "given" if is_given else "none"
        setup = replace(arm, model_is_given=is_given, rate=rate, seed=seed)
        yield f"{name} | {model} | {rate:g}", setup


def clean_result(case: tuple[str, SetUp]) -> dict:
    """Play a set-up undisturbed and return what came of it, beside its name."""
    name, setup = case
    record = BenchRun(setup).play()
    return {"setup": name, "completed": not record.error, "words": record.error}


def shorten_message(message: str, length: int = 78) -> str:
    """Return an error's first words, with numbers of motors and values left out."""
    first = re.sub(r" \(joint [^)]*\)", "", message)
    return re.sub(r"motor \d+", "motor", first)[:length]


def _rough(message: str) -> str:
    """Return an error's beginning with # for its numbers."""
    return re.sub(r"-?\d+(\.\d+)?", "#", shorten_message(message, 48)) or "-"


def print_outcomes(cases: list[Case], jobs: int) -> list:
    """Run cases, print a line for each, and return the outcomes."""
    begun = time.monotonic()
    outcomes = []
    for outcome in outcomes_of(cases, jobs):
        print(outcome_text(outcome), flush=True)
        outcomes.append(outcome)
    seconds = (time.monotonic() - begun) / max(len(outcomes), 1)
    print(f"{len(outcomes)} runs, {seconds:.1f} s per run\n", flush=True)
    return outcomes


def _by_name(outcomes: list) -> Iterator[tuple[str, list]]:
    """Yield (name, its outcomes) in the order of first appearance."""
    for name in dict.fromkeys(outcome.name for outcome in outcomes):
        yield name, [outcome for outcome in outcomes if outcome.name == name]


def print_damage_table(outcomes: list) -> None:
    """Print, by field and size, the worst departure, how many runs were stopped, and the words."""
    print("| field, size | runs | stopped | worst departure [rad] | in phase | words |")
    print("|---|---|---|---|---|---|")
    for name, group in _by_name(outcomes):
        worst = max(group, key=departure_of)
        stopped = [o for o in group if o.ending in ("stopped", "refused")]
        endings = Counter(_rough(outcome.words) for outcome in stopped)
        texts = [f"{count}x {text}" for text, count in endings.most_common(3)]
        summary = "; ".join(texts)
        print(
            f"| {name} | {len(group)} | {len(stopped)} | {departure_of(worst):.3f} "
            f"| {worst.phase[:12]} | {summary} |"
        )
    worst = max(map(departure_of, outcomes))
    beyond = sum(departure_of(outcome) > DAMAGE_BOUND for outcome in outcomes)
    print(
        f"\nworst departure {worst:.3f} rad; {beyond} of {len(outcomes)} beyond {DAMAGE_BOUND}\n"
    )


_DELAY = (
    "stop after [s]",
    lambda o: "-" if o.stop_delay is None else f"{o.stop_delay:.3f}",
)
_WORDS = ("words", lambda o: shorten_message(o.words) or o.ending)
FAULT_COLUMNS = (
    ("fault", lambda o: o.name),
    ("model", lambda o: o.setup.belief if o.setup.model_is_given else "none"),
    ("departure [rad]", lambda o: f"{o.figures['departure']:.3f}"),
    ("others' departure [rad]", lambda o: f"{o.figures['others departure']:.3f}"),
    _DELAY,
    _WORDS,
)
HOLD_COLUMNS = (
    ("fault", lambda o: o.name),
    ("shoulder", lambda o: o.setup.shoulder),
    ("kp", lambda o: f"{o.setup.kp:g}"),
    ("pose", lambda o: str(o.setup.pose)),
    ("can hold [N m]", lambda o: f"{held_torque(o):.1f}"),
    ("load [N m]", lambda o: f"{load_of(o.setup):.1f}"),
    _DELAY,
    ("off before and after [rad]", lambda o: f"{o.figures['departure']:.3f}"),
    ("fall after the stop [rad]", lambda o: f"{o.figures['own fall']:.3f}"),
    ("least possible", lambda o: f"{o.figures.get('least fall', 0.0):.3f}"),
    ("disabled at once", lambda o: f"{o.figures.get('disabled fall', 0.0):.3f}"),
    ("its speed [rad/s]", lambda o: f"{o.figures['own speed']:.2f}"),
    ("disabled", lambda o: f"{o.figures.get('disabled speed', 0.0):.2f}"),
    ("others' fall [rad]", lambda o: f"{o.figures['others fall']:.3f}"),
    ("others' speed [rad/s]", lambda o: f"{o.figures['others speed']:.2f}"),
    ("0.1 s later [rad/s]", lambda o: f"{o.figures['others later speed']:.2f}"),
    ("energy gained [J]", lambda o: f"{o.energy_gain:.2f}"),
    _WORDS,
)
"""Columns of the tables of outcomes: their titles, and what they show of an outcome."""


def print_table(outcomes: list, columns: Sequence[tuple]) -> None:
    """Print a line per outcome, those of one fault together."""
    print(f"| {' | '.join(title for title, _ in columns)} |")
    print(f"|{'---|' * len(columns)}")
    for _, group in _by_name(outcomes):
        for outcome in group:
            print(f"| {' | '.join(text(outcome) for _, text in columns)} |")
    print()


def print_clean_runs(cases: Sequence[tuple[str, SetUp]], jobs: int) -> list[dict]:
    """Play undisturbed, print a line for each set-up, and return the results of all runs."""
    results: list[dict] = []
    print("| set-up | stopped | words |\n|---|---|---|")
    with multiprocessing.get_context("fork").Pool(jobs) as pool:
        played = pool.imap(clean_result, cases)
        for name, group in itertools.groupby(played, lambda result: result["setup"]):
            runs = list(group)
            stopped = [run["words"] for run in runs if not run["completed"]]
            words = Counter(shorten_message(text, 90) for text in stopped)
            summary = "; ".join(f"{count}x {text}" for text, count in words.items())
            print(f"| {name} | {len(stopped)} of {len(runs)} | {summary} |", flush=True)
            results += runs
    count = sum(not result["completed"] for result in results)
    print(f"{count} of {len(results)} undisturbed runs were stopped\n", flush=True)
    return results


def write_page(jobs: int) -> None:
    """Write the table of faults into benchmarks/motors/motor_faults.md."""
    rows = [PAGE_HEAD]
    for case, outcome in zip(CASES, outcomes_of(CASES, jobs)):
        message = re.sub(r"\(joint [^)]*\) ", "", case.words)
        mark = "*" if case.quantity != "departure" else ""
        measured = f"{outcome.figures[case.quantity]:.2f}{mark}"
        if outcome.ending == "completed":
            message = UNNOTICED
        rows.append(f"| {case.name} | {measured} | {message} |")
    TABLE.write(rows)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    options = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    options.add_argument(
        "campaign", choices=("damage", "faults", "stop", "clean", "page", "all")
    )
    options.add_argument("--belief", choices=("guess", "truth"), default="guess")
    options.add_argument(
        "--runs", type=int, default=40, help="damaged frames; 400 for a deep run"
    )
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--only", default="", help="rows whose name contains this")
    options.add_argument(
        "--rate", type=float, action="append", help="of clean runs [Hz]"
    )
    options.add_argument(
        "--seeds", type=int, default=0, help="clean runs of each worn arm and rate"
    )
    options.add_argument("--model", type=Path, help="of one worn arm, in place of all")
    options.add_argument("--joint", help="terminal joint of this model")
    options.add_argument("--jobs", type=int, default=2, help="processes at a time")
    options.add_argument("--json", type=Path, help="write all outcomes to this file")
    return options


def main() -> int:
    """Run the campaigns that were asked for; return the exit code."""
    options = parser().parse_args()
    if options.campaign == "page":
        write_page(options.jobs)
        return 0
    is_all = options.campaign == "all"
    has_failed = False
    results: dict[str, list] = {}
    if is_all or options.campaign == "damage":
        cases = damage_cases(options.runs, options.seed)
        outcomes = print_outcomes(cases, options.jobs)
        print_damage_table(outcomes)
        has_failed |= any(departure_of(outcome) > DAMAGE_BOUND for outcome in outcomes)
        results["damage"] = [asdict(outcome) for outcome in outcomes]
    if is_all or options.campaign == "faults":
        cases = fault_cases(options.belief)
        cases = [case for case in cases if options.only in case.name]
        outcomes = print_outcomes(cases, options.jobs)
        print_table(outcomes, FAULT_COLUMNS)
        results["faults"] = [asdict(outcome) for outcome in outcomes]
    if is_all or options.campaign == "stop":
        outcomes = print_outcomes(hold_cases(), options.jobs)
        print_table(outcomes, HOLD_COLUMNS)
        results["stop"] = [asdict(outcome) for outcome in outcomes]
    if is_all or options.campaign == "clean":
        rates = options.rate or RATES
        arms = WORN_ARMS
        if options.model:
            one = WornSetUp(model=options.model, terminal=options.joint)
            arms = {options.model.stem: one}
        clean = [(setup_text(setup), setup) for setup in clean_setups(rates)]
        if options.seeds:
            worn = worn_setups(arms, rates, options.seeds)
            clean = [case for case in worn if options.only in case[0]]
        results["clean"] = print_clean_runs(clean, options.jobs)
        has_failed |= not all(result["completed"] for result in results["clean"])
    if options.json:
        options.json.write_text(json.dumps(results, indent=1))
    return int(has_failed)


if __name__ == "__main__":
    raise SystemExit(main())
