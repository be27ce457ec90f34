"""What is printed and written of results: as recorded, no longer than a screen, with one reason.

``python -m rigs.files.recorded_results`` records it anew; read the difference before it is
committed.
"""

import pytest

from rigs.files import results as made
from rigs.files.recorded_results import FOLDER, RECORDED, RESULTS
from robot_sysid.records.messages import Level
from robot_sysid.results.content import content_of
from robot_sysid.results.lines import result_lines, verdict_lines
from robot_sysid.results.verdicts import Verdict


@pytest.mark.parametrize("name", RECORDED)
def test_results_are_printed_and_written_as_recorded(name):
    recorded = (FOLDER / name).read_text(encoding="utf-8")
    assert RECORDED[name]().splitlines() == recorded.splitlines()


@pytest.mark.parametrize("name", RESULTS)
def test_a_result_takes_twenty_lines(name):
    """The step after it takes two of them, of a further motion four."""
    assert len(result_lines(content_of(RESULTS[name]), False)) <= 18


@pytest.mark.parametrize("verdict", [v for v in Verdict if v.level is Level.REFUSES])
def test_a_result_that_is_not_usable_has_one_sentence_with_the_reason(verdict):
    for result in (made.found(verdict=verdict), made.payload(verdict=verdict)):
        (sentence,) = verdict_lines(content_of(result))
        assert sentence.startswith("Not usable: no model ")
        assert verdict.remark().text in sentence
    refused = verdict_lines(content_of(made.found(), failure="the disk is gone"))
    assert [*refused] == ["Not usable: the disk is gone"]


def errors_of(*shares):
    """Errors of a model and a file, then those with offsets, as shares of the torque."""
    tests = [made.validation_of(share, relative=share) for share in shares]
    return made.errors_from(*tests)


def test_errors_on_other_logs_are_those_of_the_file_as_it_is_used():
    """No file holds offsets: with them aside, a model without the arm's weight looks right."""
    errors = errors_of(0.01, 0.003, 0.17, 0.004)
    file = made.model_file(errors=[errors, errors])
    lines = result_lines(content_of(made.found(file=file)), False)
    shares = "17 % -> 0.4 % (1 % -> 0.3 % torque offsets aside)"
    assert any(
        line.startswith("Torque error of the model on ") and line.endswith(shares)
        for line in lines
    )


def test_as_good_as_before_shows_the_errors_that_say_so():
    errors = errors_of(0.116, 0.112, 0.21, 0.112)
    file = made.model_file(errors=[errors])
    for verdict in (Verdict.AS_GOOD, Verdict.BETTER):
        content = content_of(made.found(file=file, verdict=verdict))
        use = next(iter(verdict_lines(content)))
        assert "21 % -> 11 % here" in use
        assert ("(12 % -> 11 % torque" in use) == (verdict is Verdict.AS_GOOD)
