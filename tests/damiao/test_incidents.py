"""The table of incidents (``rigs.motors.incidents``), each row played at every fidelity that it
has.

Samples show in no time what the watch says, whole runs on simulated motors how far an arm leaves
its path, how the run ends and what is said, and the program in real time when its motors are off.
``benchmarks/motors/motor_faults.py`` and ``benchmarks/motors/motor_incidents.py`` print the tables.
"""

from __future__ import annotations

from functools import cache

import pytest

from rigs.files.places import ROOT
from rigs.motors.fault_bench import Case, outcomes_of
from rigs.motors.incident_arms import SETUPS
from rigs.motors.incidents import (
    CASES,
    INCIDENTS,
    PENDULUMS,
    PROCESSES,
    SAMPLES,
    WORN_CASES,
    NotPlayed,
    cases_on,
    departure_of,
)
from rigs.motors.pendulum_runs import check_stop
from rigs.motors.process_incidents import results_of
from rigs.motors.realtime_arm import NEEDS_TERMINALS
from rigs.motors.watched_samples import words_of


def name_of(case):
    """Return the name of a row, or of how it is played."""
    return case.name


def test_each_incident_has_a_name_of_its_own_and_is_played_somewhere():
    names = [incident.name for incident in INCIDENTS]
    assert len(set(names)) == len(names)
    for incident in INCIDENTS:
        plays = incident.samples, incident.simulated, incident.process
        assert not all(isinstance(play, NotPlayed) for play in plays), incident.name


# --- samples --------------------------------------------------------------------------------------


@pytest.mark.fast_cases(6)
@pytest.mark.parametrize("case", SAMPLES, ids=name_of)
def test_what_samples_show_of_an_incident_is_said_with_the_joint(case):
    for play in case.plays:
        message = words_of(play(), case.phase, **case.settings)
        if case.words is None:
            assert message is None
        else:
            assert message is not None and message.startswith("motor 2 "), message
            assert case.words in message


# --- simulated motors -----------------------------------------------------------------------------


@pytest.mark.fast_cases(6)
@pytest.mark.parametrize("case", PENDULUMS, ids=name_of)
def test_an_incident_stops_a_run_and_its_motors(rig, case, heard):
    check_stop(rig(**case.options), case)


ARMS = {
    "kinova": CASES,
    "small": cases_on(SETUPS["small"], WORN_CASES)[: len(WORN_CASES)],
    "small without a model": cases_on(SETUPS["small"], WORN_CASES)[len(WORN_CASES) :],
    "ur5e": cases_on(SETUPS["ur5e"], WORN_CASES)[: len(WORN_CASES)],
    "ur5e without a model, in_depth": cases_on(SETUPS["ur5e"], WORN_CASES)[
        len(WORN_CASES) :
    ],
}
"""What is played on each arm; ``small`` and ``ur5e`` are not as their models say."""
RUNS = [
    pytest.param(arm, case, id=f"{arm}-{case.name}")
    for arm, cases in ARMS.items()
    for case in cases
]
UNDISTURBED = Case("nothing", lambda run: None, after=4.0, endings=("completed",))


@cache
def outcomes_on(arm):
    """What came of all cases on an arm, by name: their runs branch off one undisturbed run."""
    cases = [*ARMS[arm], UNDISTURBED] if arm == "kinova" else ARMS[arm]
    return {outcome.name: outcome for outcome in outcomes_of(cases)}


@pytest.mark.slow
@pytest.mark.parametrize(("arm", "case"), RUNS)
def test_an_incident_ends_a_run_in_time_and_says_so(arm, case):
    if not getattr(case.setup, "is_at_hand", True):
        pytest.skip(f"{case.setup.model} is not at hand")
    outcome = outcomes_on(arm)[case.name]
    assert outcome.ending in case.endings, outcome
    assert departure_of(case, outcome) < case.bound, outcome
    assert case.words in outcome.words, outcome
    assert bool(outcome.words) == (outcome.ending != "completed")
    if case in CASES and case.words and case.joint is not None:
        assert f"motor {case.joint + 1} " in outcome.words, outcome


@pytest.mark.slow
def test_an_undisturbed_run_completes_and_departs_from_nothing():
    outcome = outcomes_on("kinova")["nothing"]
    assert outcome.ending == "completed" and outcome.figures["departure"] == 0.0


@pytest.mark.slow
def test_the_page_says_how_far_joints_get_and_what_is_said():
    page = (ROOT / "benchmarks" / "motors" / "motor_faults.md").read_text(
        encoding="utf-8"
    )
    rows = [row.split(" | ") for row in page.splitlines()]
    stated = {row[0].strip("| "): row[1:] for row in rows if len(row) == 3}
    for case in CASES:
        departure, words = stated[case.name]
        outcome = outcomes_on("kinova")[case.name]
        measured = outcome.figures[case.quantity]
        assert abs(float(departure.strip("*")) - measured) < 0.03, case.name
        plays_on = words.startswith("nothing: it plays to the end")
        assert plays_on == (outcome.ending == "completed"), case.name
        assert case.words.replace("(joint joint1) ", "") in words, words


# --- the program in real time ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def process_results(tmp_path_factory):
    """What came of all incidents of the program, by name."""
    folder = tmp_path_factory.mktemp("processes")
    return {result.incident.name: result for result in results_of(folder, PROCESSES)}


@pytest.mark.slow
@pytest.mark.realtime
@NEEDS_TERMINALS
@pytest.mark.parametrize("case", PROCESSES, ids=name_of)
def test_whatever_happens_to_the_program_the_motors_are_off_soon(case, process_results):
    result = process_results[case.name]
    assert result.code == case.code, result
    assert result.departure < case.bound, result
    assert result.off_after < case.off_within, result
    assert result.end_speed < 0.03 or not case.brakes, result
    assert case.words in result.message, result
