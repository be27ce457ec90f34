"""The better model is found, and what cannot be played is said."""

import json

import numpy as np
import pytest

from robot_sysid.errors import ExportError, InputError
from robot_sysid.identify.judgement.rollout.candidate import played_or_reason, refusal
from robot_sysid.identify.judgement.rollout.compare import compare
from robot_sysid.output.printed.rollout import rollout_entry, rollout_lines
from robot_sysid.records.results import OPEN, RolloutError, RolloutTest
from tests.simulation.rollout.test_playback import SECONDS, arm, recording


def test_the_model_that_is_the_arm_wins_whichever_comes_first():
    truth, wrong = arm(), arm(0.5)
    pieces = [recording(truth)]
    good, bad = (compare(*pair, pieces, "a piece") for pair in ((wrong, truth), (truth, wrong)))
    assert good.is_better and good.refusal is None
    assert not bad.is_better and "not better" in bad.refusal
    assert good.score == pytest.approx(1.0 / bad.score)
    # The piece is too short for the longest horizon.
    assert SECONDS < 3.0 and good.notes == ("no held-out piece is as long as 3 s",)
    assert {error.horizon for error in good.errors} == {0.1, 0.3, 1.0}


def test_numbers_stand_in_json_and_in_the_lines():
    found = compare(arm(0.5), arm(), [recording(arm())], "a piece")
    entry = json.loads(json.dumps(rollout_entry(found), allow_nan=False))
    first = entry["errors"][0]
    figures = first["joints"]["joint0"]
    assert figures["ratio"] == pytest.approx(figures["after"] / figures["before"])
    assert entry["is_better"] is True and first["diverged"] == {"before": 0, "after": 0}
    lines = list(rollout_lines(found, verbose=True))
    assert "a piece" in lines[0] and any("joint2" in line for line in lines)


def test_a_joint_that_follows_less_well_is_named():
    error = RolloutError(OPEN, 1.0, 3, np.array([1.0, 0.1]), np.array([0.1, 0.2]))
    test = RolloutTest(("base", "wrist"), "a piece", "", (error,))
    assert test.is_better
    assert "wrist (open loop, 2 times)" in list(rollout_lines(test))[-1]


@pytest.mark.parametrize("error", [InputError, ExportError])
def test_nothing_played_is_no_proof(error):
    def fails():
        raise error("the log is too short")

    test = played_or_reason(arm(), fails)
    assert test.score is None and not test.is_better
    assert "the log is too short" in refusal(test, ())
    assert refusal(test, ("rollout",)) is None
    assert refusal(None, ()) is None
