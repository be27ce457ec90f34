"""How far an arm leaves its path when a motor, an encoder, the supply or a frame is at fault.

An arm's model plays on simulated motors; ``benchmarks/motor_faults.py`` prints the whole table.
"""

from __future__ import annotations

import pytest

from robot_sysid.damiao.protocol import Frame
from tests.support.arm_pair import play_openarms
from tests.support.damaged_links import Damage, frame_of_line, slcan_line
from tests.support.fault_bench import Case, SetUp, loaded_joint, outcomes_of
from tests.support.fault_lines import LINES, SHOULDER
from tests.support.motor_causes import joint_of
from tests.support.places import ROOT


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
    joint = joint_of(line.cause)
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


@pytest.mark.slow
@pytest.mark.parametrize("are_exchanged", [False, True])
def test_exchanged_cables_of_two_arms_are_named_soon_after_they_leave_a_symmetric_pose(
    tmp_path, are_exchanged
):
    duration = 2.5 if are_exchanged else 5.0
    record = play_openarms(tmp_path, are_exchanged, duration=duration)
    times = {phase.split(" (")[0]: begin for begin, phase in record.phases}
    assert ("cables of two arms exchanged" in record.words) == are_exchanged
    assert bool(record.words) == are_exchanged
    if are_exchanged:
        assert times["stopping"] - times["playing"] < 1.5


# --- the bench itself ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("field_name", "size", "byte"),
    [("status", 9, 0), ("id nibble", 3, 0), ("position", 0.2, 1), ("velocity", 11, 3)],
)
def test_a_damage_changes_the_field_it_is_about(field_name, size, byte):
    frame = Frame(0x15, bytes([0x15, 0x80, 0, 0x7F, 0xF7, 0xFF, 30, 30]), 1.5)
    line = slcan_line(frame)
    assert frame_of_line(line, frame) == frame
    damaged = frame_of_line(Damage(field_name, size, 0).apply(line, 12.5), frame)
    changed = [index for index in range(8) if damaged.data[index] != frame.data[index]]
    assert changed[0] == byte and damaged.time == frame.time
