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
