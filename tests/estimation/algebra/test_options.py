"""What a user may choose about the estimate is checked by the option's name."""

from __future__ import annotations

import pytest

from robot_sysid.dynamics.friction import DEFAULT_TERMINAL, FrictionModel, friction_model
from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.options import CHOSEN, EstimationOptions


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"torques": "all"}, "--torques 'all': choose one of chain, terminal"),
        ({"delay": "yes"}, "--delay 'yes': choose one of off, auto"),
        ({"friction_model": "coulomb-glue"}, "unknown friction term 'glue'"),
        ({"friction_model": "none", "no_friction": True}, "exclude each other"),
    ],
)
def test_unknown_words_list_the_valid_ones(options, words):
    with pytest.raises(InputError, match=words):
        EstimationOptions(**options)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"cutoff": 0.0}, "--cutoff must be positive"),
        ({"velocity_deadband": -0.1}, "--velocity-deadband must be a number that is not negative"),
        ({"velocity_deadband": (0.1, -0.1)}, "--velocity-deadband must be a number"),
    ],
)
def test_signal_options_out_of_range_are_refused(options, words):
    with pytest.raises(InputError, match=words):
        EstimationOptions(**options)


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


def test_options_of_measured_torques_are_refused_without_torques():
    with pytest.raises(InputError, match="--cutoff is about measured torques; leave it off"):
        EstimationOptions(torque_from="position-error", cutoff=5.0)
