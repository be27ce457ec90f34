"""What owners of arms meet: how far an arm leaves its path, how the run ends, and what is said.

The arms are others than those of ``test_faults.py``, and are not as their models say;
``benchmarks/motor_incidents.py`` prints the tables.
"""

from __future__ import annotations

import pytest

from rigs.fault_bench import outcomes_of
from rigs.incidents import CASES, SETUPS, cases_on, departure_of
from rigs.process_incidents import INCIDENTS, results_of
from rigs.realtime_arm import NEEDS_TERMINALS

pytestmark = pytest.mark.slow


ARMS = {
    "small": ("small", True),
    "small without a model": ("small", False),
    "ur5e": ("ur5e", True),
    "ur5e without a model, in_depth": ("ur5e", False),
}
"""Arms, and whether the player has their model."""


@pytest.fixture(scope="module", params=ARMS.values(), ids=ARMS)
def outcomes(request):
    """What came of all cases on an arm: (case, outcome)."""
    arm, is_given = request.param
    setup = SETUPS[arm]
    if not setup.is_at_hand:
        pytest.skip(f"{setup.model} is not at hand")
    every = cases_on(setup, CASES)
    cases = [case for case in every if case.setup.model_is_given == is_given]
    return [*zip(cases, outcomes_of(cases))]


@pytest.mark.parametrize("name", [case.name for case in CASES])
def test_an_incident_ends_a_run_in_time_and_says_so(name, outcomes):
    found = [pair for pair in outcomes if pair[0].name == name]
    assert len(found) == 1
    for case, outcome in found:
        assert outcome.ending in case.endings, outcome
        assert departure_of(case, outcome) < case.bound, outcome
        assert case.words in outcome.words, outcome
        assert bool(outcome.words) == (outcome.ending != "completed")


@pytest.mark.realtime
@NEEDS_TERMINALS
def test_whatever_happens_to_the_program_the_motors_are_off_soon(tmp_path):
    results = [*results_of(tmp_path)]
    assert len(results) == len(INCIDENTS)
    for result in results:
        incident = result.incident
        assert result.code == incident.code, result
        assert result.departure < incident.bound, result
        assert result.off_after < incident.off_within, result
        assert result.end_speed < 0.03 or not incident.brakes, result
        assert incident.words in result.message, result
