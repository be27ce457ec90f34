"""The verdict in one line."""

from __future__ import annotations

import pytest

from robot_sysid.records.messages import Level
from robot_sysid.results.content import content_of
from robot_sysid.results.record import Verdict
from robot_sysid.results.verdict import plan_conditions, plan_verdict
from robot_sysid.results.verdict import verdict_line as line_of
from tests.support import results as made


def verdict_line(result, failure=None):
    """The verdict of a result in one line."""
    return line_of(content_of(result, failure=failure))


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
        assert (
            sentence.startswith("Not usable: no model ") and verdict.value in sentence
        )
    refused = verdict_line(made.found(), "the disk is gone")
    assert refused == "Not usable: the disk is gone"


@pytest.mark.parametrize(
    ("contact", "n_unguarded", "lacks_meshes", "phrases"),
    [
        (None, 0, True, []),
        ("link0 and link5", 0, False, ["free, by the clearance of link0 and link5"]),
        (None, 2, False, ["2 of 6 moving links", "watch it in a viewer"]),
        (None, 6, True, ["6 of 6 moving links", "--mesh-dir FOLDER"]),
        ("link0 and link5", 6, True, ["brought to the start", "--mesh-dir FOLDER"]),
    ],
)
def test_a_plan_is_usable_once_what_was_not_checked_is(
    contact, n_unguarded, lacks_meshes, phrases
):
    conditions = plan_conditions(contact, n_unguarded, 6, lacks_meshes)
    verdict = plan_verdict(None, "", conditions)
    assert all(phrase in verdict for phrase in phrases)
    assert verdict.startswith("Usable once ") is bool(phrases)
