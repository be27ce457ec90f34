"""The printed result block: every figure with its error, nothing that is not known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimation.uncertainty import OTHER_LINKS, TORQUE_SCALE
from robot_sysid.output.summary import (
    COLOURED,
    SURE,
    WORSE,
    detail_lines,
    folder_text,
    limitations,
    result_lines,
)
from tests.support.results import (
    NAMES,
    VALUES,
    blind_to_mass,
    estimate,
    found,
    validation_of,
    with_value,
)


def line(lines, start):
    (match,) = [text for text in lines if text.startswith(start)]
    return match


def test_the_block_of_measured_data_line_by_line():
    lines = result_lines(found(validation=(validation_of(0.04),), limitations=("one thing",)))
    assert lines == [
        "Identified parameters:",
        "  Mass: 2.000 kg",
        "  CoM moment: [0.000, 0.020, 0.200] kg·m",
        "  Inertia: [0.030, 0.000, 0.000, 0.032, -0.002, 0.005] kg·m²",
        "  Coulomb friction: 0.40 N·m",
        "  Viscous friction: 0.10 N·m·s/rad",
        "  RMSE: 0.0300 N·m",
        "  Condition number: 50.0",
        "  Base parameters: 12",
        "Standard errors (and share of the data in each value):",
        "  m: 2 ± 0.002 (0.1 %; data 100 %)",
        "  hx: 0 ± 1e-05 (data 100 %)",
        "  hy: 0.02 ± 2e-05 (0.1 %; data 100 %)",
        "  hz: 0.2 ± 0.0002 (0.1 %; data 100 %)",
        "  Ixx: 0.0302 ± 3e-05 (0.1 %; data 100 %)",
        "  Ixy: 0 ± 1e-05 (data 100 %)",
        "  Ixz: 0 ± 1e-05 (data 100 %)",
        "  Iyy: 0.032 ± 3.2e-05 (0.1 %; data 100 %)",
        "  Iyz: -0.002 ± 1e-05 (0.5 %; data 100 %)",
        "  Izz: 0.0052 ± 1e-05 (0.19 %; data 100 %)",
        "Friction (coulomb-viscous):",
        "  j5: coulomb 0.5 ± 0.0005, viscous 0.2 ± 0.0002",
        "  j6: coulomb 0.4 ± 0.0004, viscous 0.1 ± 0.0001",
        "Torque noise per joint after filtering, N·m: j5 0.03, j6 0.031",
        "Validation on other.csv: 0.0400 N·m (2.00 %)",
        "  Limit: one thing",
    ]


def test_the_models_own_simulation_ends_after_the_base_parameters():
    lines = result_lines(found(friction_model=None, limitations=("one thing",)))
    assert lines[-1] == "  Base parameters: 12"


def test_what_the_data_does_not_see_has_no_error_but_a_reason():
    result = blind_to_mass()
    lines = result_lines(found(result))
    assert line(lines, "  m:") == "  m: 2, at least partly from the model (data 0 %)"
    assert not any("inf" in text for text in lines)
    own = result_lines(found(result, friction_model=None))
    assert own[-1] == "  Not visible in these torques, kept from the model: mass"


def test_friction_of_a_joint_that_stood_still_is_not_visible():
    lines = result_lines(found(with_value("coulomb[j5]", 0.0, np.inf)))
    assert line(lines, "  j5:") == "  j5: coulomb not visible, viscous 0.2 ± 0.0002"


@pytest.mark.parametrize(("error", "said"), [(0.5, "25 %"), (20.0, "1000 %"), (1.995, "100 %")])
def test_large_errors_stay_readable(error, said):
    lines = result_lines(found(with_value("m", 2.0, error)))
    assert f"({said}; data" in line(lines, "  m:")


def test_delay_and_tilt_have_errors():
    names = (*NAMES, "delay", "tilt_1", "tilt_2")
    result = estimate(
        names=names,
        values=np.append(VALUES, [0.0, 0.0, 0.0]),
        standard_errors=np.append(np.full(14, 0.1), [2e-5, np.radians(0.03), np.radians(0.04)]),
        data_share=np.ones(17),
    )
    lines = result_lines(found(result, delay=0.0032, tilt=np.radians(0.5)))
    assert "Delay of torque behind position: 3.200 ± 0.02 ms" in lines
    assert "Tilt of the base: 0.500 ± 0.05 degrees" in lines
    assert not any("Delay" in text or "Tilt" in text for text in result_lines(found()))


def test_a_validation_without_torque_has_no_percentage():
    from dataclasses import replace

    silent = replace(validation_of(0.04), relative_error=None)
    assert "Validation on other.csv: 0.0400 N·m" in result_lines(found(validation=(silent,)))


def test_no_friction_leaves_the_friction_lines_out():
    result = estimate(
        names=PARAMETER_NAMES,
        values=VALUES[:10],
        standard_errors=np.full(10, 0.1),
        data_share=np.ones(10),
    )
    assert not any("riction" in text for text in result_lines(found(result)))


def test_details_name_every_joint():
    lines = detail_lines(found())
    assert "    j5: 3.00e-02 N·m" in lines and "    j6: 3.00e-02 N·m" in lines
    assert "  Centre of mass: [0.0000, 0.0100, 0.1000] m" in lines


@pytest.mark.parametrize(
    ("folder", "text"),
    [("out", "./out/"), ("./out", "./out/"), ("../out", "../out/"), ("/a/b", "/a/b/"), (".", "./")],
)
def test_a_folder_reads_like_a_folder(folder, text):
    assert folder_text(Path(folder)) == text


def only(identification):
    (sentence,) = limitations(identification)
    return sentence


def test_a_result_without_fault_has_no_limits():
    assert limitations(found(validation=(validation_of(0.03),))) == ()


def test_what_is_not_visible_is_told_once():
    assert only(found(blind_to_mass())) == (
        "not visible in these torques, kept from the model: mass"
    )


@given(st.sampled_from(PARAMETER_NAMES), st.floats(0.01, 10.0))
def test_a_weak_parameter_is_named_with_its_error(name, share):
    """Errors of 0.01 to 10 times what a body of 2 kg and this size has; 10 % is the limit."""
    from robot_sysid.dynamics.spatial import characteristic_length, parameter_scale

    values = estimate().values
    scale = parameter_scale(2.0, characteristic_length(values[:10]))
    k = PARAMETER_NAMES.index(name)
    said = limitations(found(with_value(name, values[k], share * scale[k])))
    assert bool(said) == (share > 0.1)
    assert not said or f"{name} (±{100.0 * share:.0f} %)" in said[0]


def test_a_prior_that_outweighs_the_data_is_told():
    share = np.ones(len(NAMES))
    share[[4, 9]] = 0.3, 0.49
    assert "more model than data in Ixx, Izz" in only(found(estimate(data_share=share)))


def test_hidden_errors_are_told_in_kilograms_and_millimetres():
    move = dict.fromkeys(NAMES, 0.0) | {"m": 0.04, "hz": 0.04 * 0.1 + 2.0 * 0.003}
    said = only(found(sensitivity={OTHER_LINKS: move, TORQUE_SCALE: move}))
    assert said.count("the mass moves by 0.04 kg (2 %) and the centre of mass by 3") == 2
    assert "if the other links take 1 % more torque than the model says" in said
    assert "if each joint's torque scale is off by 1 %" in said


def test_a_hidden_error_beyond_the_mass_has_no_centre_of_mass():
    move = dict.fromkeys(NAMES, 0.0) | {"m": -3.0}
    said = only(found(sensitivity={OTHER_LINKS: move}))
    assert said.endswith("the mass moves by 3 kg")


def test_terminal_torques_do_not_care_for_the_other_links():
    assert limitations(found(sensitivity={OTHER_LINKS: dict.fromkeys(NAMES, 0.0)})) == ()


@given(st.sampled_from(["coulomb", "viscous"]), st.floats(-1.0, 1.0), st.floats(0.01, 1.0))
def test_friction_that_drives_is_told_where_it_is_sure(term, value, error):
    said = limitations(found(with_value(f"{term}[j5]", value, error)))
    assert bool(said) == (value < -SURE * error)
    assert not said or f"{term} {value:.2g} of j5" in said[0]


def test_a_square_root_term_may_bend_either_way():
    result = with_value("viscous[j5]", -1.0, 0.01)
    assert limitations(found(result, friction_model="coulomb-viscous-sqrt")) == ()
    assert limitations(found(result, friction_model=None)) == ()


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
    model = None if kind == "own simulation" else "coulomb-viscous"
    assert limitations(found(result, friction_model=model)) == ()
