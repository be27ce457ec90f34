"""Options of the payload command: what does not go together is refused before any work."""

from __future__ import annotations

from pathlib import Path

import pytest

from robot_sysid.errors import InputError
from robot_sysid.identify.payload.options import PayloadOptions

A, B = Path("a.csv"), Path("b.csv")
LOGS = {"empty": (A, A), "loaded": (B, B)}


def test_logs_or_models_are_enough():
    assert PayloadOptions(**LOGS).order is None
    assert PayloadOptions(empty_model=A, loaded_model=B).empty == ()
    assert PayloadOptions(**LOGS, order="ABBA").order == "ABBA"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "--empty LOG"),
        ({"empty": (A,)}, "--loaded is missing"),
        ({"loaded": (B,)}, "--empty is missing"),
        ({"empty_model": A}, "--empty-model and --loaded-model"),
        ({**LOGS, "empty_model": A}, "exclude each other"),
        ({**LOGS, "order": "ABB"}, "2 times A"),
        ({**LOGS, "order": "ABCA"}, "2 times A"),
        ({**LOGS, "scale_prior": 3.0}, "add --known-mass"),
        ({**LOGS, "save_torque_scale": A}, "add --known-mass"),
        ({**LOGS, "known_mass": -1.0}, "--known-mass must be positive"),
        ({**LOGS, "known_mass": 1.0, "as_body": "tool"}, "--as-body"),
    ],
)
def test_what_does_not_go_together_is_refused(options, words):
    with pytest.raises(InputError, match=words):
        PayloadOptions(**options)
