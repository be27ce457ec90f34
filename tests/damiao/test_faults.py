"""How far an arm leaves its path when a motor, an encoder, the supply or a frame is at fault.

An arm's model plays on simulated motors; ``benchmarks/motor_faults.py`` prints the whole table.
"""

from __future__ import annotations

import pytest

from rigs.fault_bench import Case, SetUp, loaded_joint, outcomes_of
from rigs.fault_lines import LINES, SHOULDER
from rigs.places import ROOT


@pytest.fixture(scope="module")
def outcomes():
    """What came of all lines, by name: their runs branch off one undisturbed run."""
    assert loaded_joint(SetUp()) == SHOULDER
    cases = [line.case for line in LINES]
    cases.append(Case("nothing", SetUp(), lambda run: None, after=4.0))
    return {outcome.name: outcome for outcome in outcomes_of(cases)}


@pytest.mark.slow
@pytest.mark.parametrize("line", LINES, ids=lambda line: line.name)
def test_a_fault_moves_no_joint_far_from_its_path(line, outcomes):
    outcome = outcomes[line.name]
    assert getattr(outcome, line.quantity) < line.bound, outcome.line()
    assert line.words in outcome.words, outcome.line()
    joint = line.case.joint
    if line.words and joint is not None:
        assert f"motor {joint + 1} " in outcome.words, outcome.line()


@pytest.mark.slow
def test_an_undisturbed_run_completes_and_departs_from_nothing(outcomes):
    outcome = outcomes["nothing"]
    assert outcome.ending == "completed" and outcome.departure == 0.0, outcome.line()


@pytest.mark.slow
def test_the_page_says_how_far_joints_get_and_what_is_said(outcomes):
    page = (ROOT / "benchmarks" / "motor_faults.md").read_text(encoding="utf-8")
    for line in LINES:
        rows = [row for row in page.splitlines() if row.startswith(f"| {line.name} |")]
        stated = [float(row.split("|")[2].strip(" *")) for row in rows]
        measured = getattr(outcomes[line.name], line.quantity)
        assert len(stated) == 1 and abs(stated[0] - measured) < 0.03, line.name
        assert line.words.replace(" (joint joint1)", "") in rows[0], rows[0]


# --- the bench itself ---------------------------------------------------------------------------
