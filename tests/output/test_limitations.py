"""What limits a result is said in words where its figures say it, and only there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.dynamics.spatial import PARAMETER_NAMES, characteristic_length, parameter_scale
from robot_sysid.output.limitations import COLOURED, SURE, WORSE, limitations
from robot_sysid.records import NuisanceMisfit
from robot_sysid.records.figures import percent
from tests.support.results import (
    NAMES,
    estimate,
    found,
    own_simulation,
    validation_of,
    with_value,
    without_mass,
)


def only(identification):
    (sentence,) = limitations(identification)
    return sentence


def test_a_result_without_fault_has_no_limits():
    assert limitations(found(validation=(validation_of(0.03),))) == ()


def test_what_is_not_visible_is_told_once():
    assert only(found(without_mass())) == (
        "not visible in these torques, kept from the model: mass"
    )


@given(st.sampled_from(PARAMETER_NAMES), st.floats(0.01, 10.0))
def test_a_weak_parameter_is_named_with_its_error(name, share):
    """Errors of 0.01 to 10 times what a body of 2 kg and this size has; 10 % is the limit."""
    values = estimate().values
    scale = parameter_scale(2.0, characteristic_length(values[:10]))
    k = PARAMETER_NAMES.index(name)
    said = limitations(found(with_value(name, values[k], share * scale[k])))
    assert bool(said) == (share > 0.1)
    assert not said or f"{name} (± {percent(share)})" in said[0]


def test_a_prior_that_outweighs_the_data_is_told():
    share = np.ones(len(NAMES))
    share[[4, 9]] = 0.3, 0.49
    assert "more model than data in Ixx, Izz" in only(found(estimate(data_share=share)))


def test_links_that_do_not_fit_are_named():
    asked = NuisanceMisfit("links", ("elbow", "wrist"), 2.5, 1.0)
    said = only(found(misfits=(asked,)))
    assert "other links do not fit this arm (most: elbow, wrist)" in said and "allow for" in said
    said = only(found(misfits=(replace(asked, widened=2.5),)))
    assert "2.5 times as far off as was allowed" in said


@given(st.sampled_from(["coulomb", "viscous"]), st.floats(-1.0, 1.0), st.floats(0.01, 1.0))
def test_friction_that_drives_is_told_where_it_is_sure(term, value, error):
    said = limitations(found(with_value(f"{term}[j5]", value, error)))
    assert bool(said) == (value < -SURE * error)
    assert not said or f"{term} {value:.2g} of j5" in said[0]


def test_a_square_root_term_may_bend_either_way():
    result = with_value("viscous[j5]", -1.0, 0.01)
    assert limitations(found(result, friction_model="coulomb-viscous-sqrt")) == ()
    assert limitations(found(result, data=own_simulation())) == ()


@given(st.floats(0.01, 1.0))
def test_slow_residuals_are_told(share):
    result = estimate(effective_samples={"j5": 200.0 * share, "j6": 200.0})
    said = limitations(found(result))
    assert bool(said) == (result.independent_share["j5"] < COLOURED)
    assert not said or "residuals of j5 are correlated in time" in said[0]


@given(st.floats(0.5, 5.0))
def test_a_prediction_worse_than_the_fit_is_told(factor):
    said = limitations(found(validation=(validation_of(0.03), validation_of(0.03 * factor))))
    assert bool(said) == (0.03 * factor > WORSE * 0.03)
    assert not said or f"torques of other.csv are predicted {factor:.1f} times worse" in said[0]


def test_a_result_moved_to_a_possible_body_is_told():
    assert "was no possible rigid body" in only(found(estimate(constrained=True)))


@pytest.mark.parametrize("kind", ["own simulation", "no errors"])
def test_results_without_errors_are_no_problem(kind):
    result = estimate(standard_errors=None, data_share=None, effective_samples={})
    more = {"data": own_simulation()} if kind == "own simulation" else {}
    assert limitations(found(result, **more)) == ()
