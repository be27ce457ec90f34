"""The printed lines: a self-test's specified block, or a table; then errors, limits and details."""

from __future__ import annotations

import re

import pytest

from rigs import results as made
from robot_sysid.records.messages import Detail, Level
from robot_sysid.results import lines as module
from robot_sysid.results.content import content_of
from robot_sysid.results.record import Verdict


def block_lines(result, links=False):
    """The identified numbers of a result as they are printed."""
    return module.block_lines(content_of(result), links)


def more_lines(result):
    """The lines below them."""
    return module.more_lines(content_of(result))


def line_starting(lines, start):
    """The only line that starts so."""
    (match,) = [text for text in lines if text.startswith(start)]
    return match


def test_the_readmes_block_line_by_line():
    assert block_lines(made.itself()) == [
        "Identified parameters:",
        "  Mass: 2.000 kg",
        "  CoM moment: [0.000, 0.020, 0.200] kg·m",
        "  Inertia: [0.030, 0.000, 0.000, 0.032, -0.002, 0.005] kg·m²",
        "  Coulomb friction: 0.40 N·m",
        "  Viscous friction: 0.10 N·m·s/rad",
        "  RMSE: 0.0300 N·m",
        "  Condition number: 50.0",
        "  Base parameters: 12",
    ]


def brief_lines(lines):
    """The lines that are printed without --verbose."""
    return [line for line in lines if not isinstance(line, Detail)]


def test_measured_data_gets_a_table_changes_and_validation():
    result = made.found(validation=(made.validation_of(0.05),))
    table = block_lines(result)
    heading = "link6 with all on it model identified ± unit change"
    assert " ".join(table[0].split()) == heading
    assert table[1].split()[:5] == ["mass", "1.0000", "2.0000", "0.0020", "kg"]
    assert len(table) == 14 and table[-1].startswith("  ±: standard error ")
    lines = more_lines(result)
    changes, validation = brief_lines(lines)
    assert changes.startswith("Changed most, compared with the errors: ")
    assert "mass of link6 +100 %" in changes
    assert validation == "Validation on other.csv: 0.0500 N·m (2 %)"
    quality = [
        "  RMSE: 0.0300 N·m",
        "  Condition number: 50.0",
        "  Base parameters: 12",
    ]
    assert [line for line in lines if line in quality] == quality


def test_there_is_one_mass_of_a_link():
    """Every quantity has one row, also where the file holds another number."""
    lines = [*block_lines(made.whole()), *more_lines(made.whole())]
    assert len([line for line in lines if line.startswith("  mass ")]) == 1


def test_the_written_file_is_judged_by_its_torque_error_on_other_logs():
    """The torque error on held-out data is one of the verdict's."""
    lines = more_lines(made.whole())
    torque_line = line_starting(brief_lines(lines), "Torque error")
    assert torque_line == "Torque error of the model on other.csv: 30 % -> 1.2 %"
    assert "As in the model: rotor inertia" in lines
    assert not any(line.startswith("Validation") for line in lines)


def test_a_result_takes_no_more_than_a_screen():
    """A screen has 25 lines, of which stages take four."""
    complete_result = made.whole(validation=())
    for result in (complete_result, made.payload(), made.itself()):
        assert len(module.result_lines(content_of(result), False)) <= 21


def test_a_parameter_that_the_data_does_not_show_has_a_reason_instead_of_an_error():
    result = made.found(made.without_mass())
    lines = [*block_lines(result), *more_lines(result)]
    assert line_starting(lines, "  mass").endswith("  not identifiable")
    assert "inf" not in "".join(lines)


def test_a_payloads_block():
    result = made.payload()
    lines = [*block_lines(result), *more_lines(result)]
    assert lines[0] == "Identified payload, in the frame of site 'flange':"
    assert len(brief_lines(lines)) == 13
    assert re.split(r"  +", lines[2].strip()) == ["mass", "1.200", "0.010", "kg"]
    assert line_starting(lines, "Terminal link with it: 2.000 ± 0.010 kg")


def verdict_line(result, failure=None):
    """The verdict of a result in one line."""
    return module.verdict_line(content_of(result, failure=failure))


BETTER = "Usable: torque error on held-out data, torque offsets aside, 27 % -> 0.25 %; "


@pytest.mark.parametrize(
    ("result", "verdict"),
    [
        (
            made.whole(),
            f"{BETTER}link6 weighs 2.0000 ± 0.0020 kg, ± mostly from the other links' parameters",
        ),
        (
            made.found(
                made.with_value("m", 2.0, 1.2),
                file=made.model_file(other_validations=()),
            ),
            f"{BETTER}the mass of link6 alone is not known: 2.0 ± 1.2 kg, ± mostly from the other "
            "links' parameters",
        ),
        (
            made.found(
                verdict=Verdict.AS_GOOD, file=made.model_file(other_validations=())
            ),
            "Usable, but the model was about as good before: torque error on held-out data, "
            "torque offsets aside, 27 % -> 0.25 %; link6 weighs 2.0000 ± 0.0020 kg, ± mostly "
            "from the other links' parameters",
        ),
        (
            made.found(made.without_mass(), verdict=Verdict.PARTLY_FROM_MODEL),
            "Usable (not identifiable, model's values kept: mass): the mass of link6 alone is not "
            "identifiable",
        ),
        (
            made.payload(),
            "Usable: payload weighs 1.200 ± 0.010 kg, ± mostly from the torque scales",
        ),
        (
            made.payload(known_mass=1.2),
            "Usable: torque scales follow from the known mass",
        ),
        (
            made.itself(),
            "Self-test passed: the model's own numbers came back from its own simulation, which "
            "says nothing of the real arm",
        ),
    ],
)
def test_the_verdict_states_use_and_limit(result, verdict):
    assert verdict_line(result) == verdict


def test_a_file_that_only_predicts_torques_says_for_what_it_may_be_used():
    result = made.found(verdict=Verdict.TORQUES_ONLY)
    assert verdict_line(result).startswith(
        "Only for torques of motions like the log's, not for the numbers: "
    )
    assert result.failure is None


@pytest.mark.parametrize("verdict", [v for v in Verdict if v.level is Level.REFUSES])
def test_a_result_that_is_not_usable_has_one_sentence_with_the_reason(verdict):
    for result in (made.found(verdict=verdict), made.payload(verdict=verdict)):
        sentence = verdict_line(result)
        assert sentence.startswith("Not usable: no model ")
        assert verdict.remark().text in sentence
    refused = verdict_line(made.found(), "the disk is gone")
    assert refused == "Not usable: the disk is gone"
