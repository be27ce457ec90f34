"""Which friction an estimate has by its options; what is refused is in tests/test_config.py."""

from __future__ import annotations

import pytest

from robot_sysid.dynamics.friction import DEFAULT_TERMINAL, FrictionModel, friction_model
from robot_sysid.estimation.algebra.options import CHOSEN, EstimationOptions


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, None),
        ({"friction_model": CHOSEN}, None),
        ({"no_friction": True}, FrictionModel(())),
        ({"friction_model": "coulomb-load"}, friction_model("coulomb-load")),
        # One row tells too little to choose by.
        ({"torques": "terminal"}, friction_model(DEFAULT_TERMINAL)),
    ],
)
def test_friction_is_chosen_by_the_data_unless_it_is_said(options, expected):
    assert EstimationOptions(**options).friction == expected
