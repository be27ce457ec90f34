"""What is printed: the specified block first, no number without its error; and every limit."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.dynamics.spatial import PARAMETER_NAMES, characteristic_length, parameter_scale
from robot_sysid.records import SubtreeBody
from robot_sysid.records.figures import percent
from robot_sysid.results.console import (
    COLOURED,
    SURE,
    WORSE,
    block_lines,
    limitations,
    more_lines,
    result_lines,
)
from robot_sysid.results.record import Figure, Verdict
from tests.support.results import (
    NAMES,
    THETA,
    body,
    estimate,
    found,
    itself,
    payload,
    validation_of,
    whole,
    with_value,
    without_mass,
)


def line(lines, start):
    (match,) = [text for text in lines if text.startswith(start)]
    return match


def test_the_readmes_block_line_by_line():
    assert block_lines(found()) == [
        "Identified parameters:",
        "  Mass: 2.000 kg",
        "  CoM moment: [0.000, 0.020, 0.200] kg·m",
        "  Inertia: [0.030, 0.000, 0.000, 0.032, -0.002, 0.005] kg·m²",
        "  Coulomb friction: 0.40 N·m",
        "  Viscous friction: 0.10 N·m·s/rad",
        "  RMSE: 0.0300 N·m",
        "  Condition number: 50.0",
        "  Base parameters: 12",
    ]


def test_what_stands_under_it_of_measured_data():
    lines = more_lines(found(validation=(validation_of(0.05),)))
    assert lines[0] == "Before -> after, ± one standard error of all causes (noise, links):"
    assert lines[1].split() == ["model", "identified", "±", "unit", "change"]
    assert line(lines, "  mass").split()[1:5] == ["1.0000", "2.0000", "0.0020", "kg"]
    assert line(lines, "  CoM moment x").split()[3:] == ["0", "0", "0.000010", "kg·m", "none"]
    end = lines[lines.index("Error of the mass by cause, kg: links 0.0016, noise 0.0012") + 1 :]
    assert end == [
        "Friction of the joints (coulomb-viscous), model -> identified ± error:",
        "  j5: coulomb 0.3 -> 0.50000 ± 0.00050 N·m, viscous 0.1 -> 0.20000 ± 0.00020 N·m·s/rad",
        "  j6: coulomb 0.2 -> 0.40000 ± 0.00040 N·m, viscous 0 -> 0.10000 ± 0.00010 N·m·s/rad",
        "Validation on other.csv: 0.0500 N·m (2 %)",
        f"Result: {Verdict.BETTER.value}",
        "The mass is known to 0.1 %",
        "  Limit: torques of other.csv are predicted 1.7 times worse than the fitted ones: "
        "the model misses something that motion shows",
    ]


def test_the_models_own_simulation_has_no_errors():
    lines = more_lines(itself())
    assert lines[0] == "Before -> after:"
    assert lines[-2].split()[:2] == ["viscous", "friction"]
    assert lines[-1] == f"Result: {Verdict.OK.value}"
    unseen = more_lines(itself(without_mass()), verbose=True)
    assert "  Not visible in these torques, kept from the model: mass" in unseen
    assert not any("inf" in text or "±" in text for text in unseen)


def test_the_file_is_told_by_its_errors_before_and_after():
    lines = more_lines(whole())
    told = [text for text in lines if text.startswith("Torque error")]
    assert told == [
        "Torque error of the model on held-out data: 27 % -> 0.25 %; the fit itself reaches 0.22 %",
        "Torque error of the model on other.csv: 30 % -> 1.2 %",
    ]
    assert "Left in the file as it was: rotor inertia" in lines
    assert not any(text.startswith("Validation") for text in lines)


@pytest.mark.parametrize(
    ("result", "sentence"),
    [
        (found(with_value("m", 2.0, 0.12)), "The mass is known to 6 %"),
        (found(without_mass()), "The mass is not known: these torques do not show it"),
        (
            payload(body(-1.0)),
            "The mass is not known: -1.000 ± 0.010 kg does not tell it from zero",
        ),
    ],
)
def test_the_number_has_a_verdict_of_its_own(result, sentence):
    assert sentence in more_lines(result)


def test_what_the_data_does_not_see_has_no_error_but_a_reason():
    lines = more_lines(found(without_mass()))
    assert line(lines, "  mass").endswith("  not seen")
    assert not any("inf" in text for text in lines)
    lines = more_lines(found(with_value("coulomb[j5]", 0.0, np.inf)))
    assert line(lines, "  j5:").startswith("  j5: coulomb not visible, viscous 0.1 -> 0.2")


def part(name, mass, welded=True):
    return SubtreeBody(0, name, mass / 2.0 * THETA, welded)


def test_a_link_of_several_bodies_says_what_its_mass_is_the_mass_of():
    parts = (part("link7", 0.7), part("hand", 0.3), part("finger", 0.2, False), part("eye", 0.0))
    told = line(more_lines(found(bodies=parts)), "The mass is that")
    assert told == (
        "The mass is that of link7 + hand + finger = 2 kg; link7 alone, as written in the file: "
        "1.5 kg"
    )
    # The file's own terminal link weighs 1.8 kg.
    told = line(more_lines(whole(bodies=parts)), "The mass is that")
    assert told.endswith("= 2 kg; link7 alone, as written in the file: 1.3 kg")
    assert not any("The mass is that" in text for text in more_lines(found(bodies=parts[:1])))
    many = (*parts, *(part(f"pad{k}", 0.01) for k in range(6)))
    told = line(more_lines(found(bodies=many)), "The mass is that")
    assert "link7 + hand + finger + 6 more = 2 kg; link7 alone" in told


def test_a_payloads_block():
    lines = result_lines(payload())
    assert lines[0] == "Identified payload, in the frame of site 'flange':"
    table = [re.split(r"  +", text.strip()) for text in lines[1:11]]
    assert table[0] == ["identified", "±", "unit"]
    assert table[1] == ["mass", "1.200", "0.010", "kg"]
    assert table[2][:2] == ["centre of mass x", "0.03000"] and table[2][3] == "m"
    assert table[5][:2] == ["inertia xx about it", "0.00600"] and table[5][3] == "kg·m²"
    assert lines[12] == "Error of the mass by cause, kg: torque scale 0.008, noise 0.006"
    without = line(lines, "Terminal link without it: 0.800 ± 0.010 kg, centre of mass [")
    assert without.endswith("[0.0300 ± 0.0013, -0.0200 ± 0.0013, 0.0800 ± 0.0016] m")
    assert line(lines, "Terminal link with it: 2.000 ± 0.010 kg")
    assert "  b.csv (loaded): 1.190 ± 0.010 kg" in lines
    assert "The mass is known to 0.83 %" in lines


def only(result):
    (sentence,) = limitations(result)
    return sentence


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


def test_a_torque_before_its_motion_is_told_where_it_is_sure():
    sensors = {"delay": Figure(-0.003, 0.001)}
    assert "come 3 ms before the motion" in only(found(delay=-0.003, sensors=sensors))
    assert limitations(found(delay=-0.0019, sensors=sensors)) == ()
    assert limitations(found(delay=0.003, sensors=sensors)) == ()


@given(st.sampled_from(["coulomb", "viscous"]), st.floats(-1.0, 1.0), st.floats(0.01, 1.0))
def test_friction_that_drives_is_told_where_it_is_sure(term, value, error):
    said = limitations(found(with_value(f"{term}[j5]", value, error)))
    assert bool(said) == (value < -SURE * error)
    assert not said or f"{term} {value:.2g} of j5" in said[0]


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
