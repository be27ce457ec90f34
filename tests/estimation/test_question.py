"""Options of the estimate: those that exclude each other, and the friction model they ask for."""

from __future__ import annotations

import pytest

from robot_sysid.errors import InputError
from robot_sysid.estimation.question import EstimationOptions


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"no_friction": True, "friction_model": "coulomb"}, "exclude each other"),
        ({"friction_model": "sticky"}, "sticky"),
        ({"torque_from": "position-error", "tilt": "auto"}, "--tilt is about measured"),
    ],
)
def test_options_that_contradict_each_other_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        EstimationOptions(**options)


@pytest.mark.parametrize(
    ("options", "terms"),
    [
        ({}, None),
        ({"friction_model": "auto"}, None),
        ({"no_friction": True}, ()),
        ({"friction_model": "coulomb-offset"}, ("coulomb", "offset")),
        ({"torques": "terminal"}, ("coulomb", "viscous", "offset")),
    ],
)
def test_friction_is_chosen_by_the_data_unless_it_is_given(options, terms):
    friction = EstimationOptions(**options).friction
    assert (None if friction is None else friction.terms) == terms
