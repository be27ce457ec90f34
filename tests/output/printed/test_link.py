"""The printed result block: every figure with its error, nothing that is not known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.output.printed.link import detail_lines, folder_text, more_lines, result_lines
from robot_sysid.records import JointFriction, SubtreeBody
from tests.support.results import (
    NAMES,
    THETA,
    VALUES,
    estimate,
    found,
    own_simulation,
    validation_of,
    with_value,
    without_mass,
)


def line(lines, start):
    (match,) = [text for text in lines if text.startswith(start)]
    return match


def test_the_readmes_block_line_by_line():
    assert result_lines(found()) == [
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


def test_the_numbers_of_a_gripper_jaw_are_not_all_zero():
    jaw = estimate(values=VALUES * np.array([6e-3] * 10 + [1e-3] * 4))
    lines = result_lines(found(jaw))
    assert lines[1] == "  Mass: 0.012 kg"
    assert lines[2] == "  CoM moment: [0.0000, 0.0001, 0.0012] kg·m"
    assert lines[3] == "  Inertia: [0.00018, 0.00000, 0.00000, 0.00019, -0.00001, 0.00003] kg·m²"
    assert lines[4] == "  Coulomb friction: 0.0004 N·m"


def test_rounding_beside_the_bodys_size_is_zero():
    centred = VALUES.copy()
    centred[1:4] = [4e-17, -2e-17, 9e-18]
    lines = result_lines(found(estimate(values=centred)))
    assert lines[2] == "  CoM moment: [0.000, 0.000, 0.000] kg·m"


def test_what_stands_under_it_of_measured_data():
    budget = estimate(
        error_budget={"links": np.full(14, 0.04)}, noise_errors=np.full(14, 0.03), covariance=None
    )
    friction = JointFriction(np.array([0.3, 0.2]), np.array([0.1, 0.0]))
    lines = more_lines(found(budget, validation=(validation_of(0.05),), model_friction=friction))
    assert lines[0] == "Before -> after, ± one standard error of all causes (noise, links):"
    assert lines[1].split() == ["model", "identified", "±", "unit", "change"]
    assert line(lines, "  mass").split()[1:5] == ["1.0000", "2.0000", "0.0020", "kg"]
    assert line(lines, "  CoM moment x").split()[3:] == ["0", "0", "0.000010", "kg·m", "none"]
    end = lines[lines.index("The mass's error by cause, kg: noise 0.03, links 0.04") + 1 :]
    assert end == [
        "Friction of the joints (coulomb-viscous), model -> identified ± error:",
        "  j5: coulomb 0.3 -> 0.50000 ± 0.00050 N·m, viscous 0.1 -> 0.20000 ± 0.00020 N·m·s/rad",
        "  j6: coulomb 0.2 -> 0.40000 ± 0.00040 N·m, viscous 0 -> 0.10000 ± 0.00010 N·m·s/rad",
        "Torque noise per joint after filtering, N·m: j5 0.03, j6 0.031",
        "Validation on other.csv: 0.0500 N·m (2 %)",
        "  Limit: torques of other.csv are predicted 1.7 times worse than the fitted ones: "
        "the model misses something that motion shows",
    ]


def test_the_models_own_simulation_ends_after_the_table():
    data = {"data": own_simulation(), "friction_model": None}
    lines = more_lines(found(validation=(validation_of(0.05),), **data))
    assert lines[0] == "Before -> after:"
    assert lines[-1].split()[:2] == ["viscous", "friction"]


def test_what_the_data_does_not_see_has_no_error_but_a_reason():
    result = without_mass()
    lines = more_lines(found(result))
    assert line(lines, "  mass").endswith("  not seen")
    assert not any("inf" in text for text in lines)
    own = more_lines(found(result, data=own_simulation(), friction_model=None))
    assert own[-1] == "  Not visible in these torques, kept from the model: mass"


def test_friction_of_a_joint_that_stood_still_is_not_visible():
    lines = more_lines(found(with_value("coulomb[j5]", 0.0, np.inf)))
    assert line(lines, "  j5:").startswith("  j5: coulomb not visible, viscous 0.2")


def body(name, mass, welded=True):
    return SubtreeBody(0, name, mass / 2.0 * THETA, welded)


def test_a_link_of_several_bodies_says_what_its_mass_is_the_mass_of():
    parts = (body("link7", 0.7), body("hand", 0.3), body("finger", 0.2, False), body("eye", 0.0))
    told = line(more_lines(found(bodies=parts)), "The mass is")
    assert told == (
        "The mass is that of link7 + hand + finger = 2 kg; link7 alone, as written in the file: "
        "1.5 kg"
    )
    assert not any("The mass is" in text for text in more_lines(found(bodies=parts[:1])))
    many = (*parts, *(body(f"pad{k}", 0.01) for k in range(6)))
    told = line(more_lines(found(bodies=many)), "The mass is")
    assert "link7 + hand + finger + 6 more = 2 kg; link7 alone" in told


def test_a_group_that_is_written_as_one_body_is_said_to_be_one():
    """With half a kilogram in all, the hand's own kilogram cannot stand beside link7's rest."""
    heavy = (body("link7", 0.7), body("hand", 3.0), body("finger", 0.2, False))
    told = line(more_lines(found(bodies=heavy)), "The mass is")
    assert told.endswith("link7 + hand together, as written in the file: 1.8 kg")
    hanging = (body("link7", 0.7), body("finger", 3.0, False))
    told = line(more_lines(found(bodies=hanging)), "The mass is")
    assert told == "The mass is that of link7 + finger = 2 kg"


def test_delay_and_tilt_have_errors():
    names = (*NAMES, "delay", "tilt_1", "tilt_2")
    result = estimate(
        names=names,
        values=np.append(VALUES, [0.0, 0.0, 0.0]),
        standard_errors=np.append(np.full(14, 0.1), [2e-5, np.radians(0.03), np.radians(0.04)]),
        data_share=np.ones(17),
    )
    lines = more_lines(found(result, delay=0.0032, tilt=np.radians(0.5)))
    assert "Delay of torque behind position: 3.200 ± 0.02 ms" in lines
    assert "Tilt of the base: 0.500 ± 0.05 degrees" in lines
    assert not any("Delay" in text or "Tilt" in text for text in more_lines(found()))


def test_a_validation_without_torque_has_no_percentage():
    from dataclasses import replace

    silent = replace(validation_of(0.04), relative_error=None)
    assert "Validation on other.csv: 0.0400 N·m" in more_lines(found(validation=(silent,)))


def test_no_friction_leaves_the_friction_lines_out():
    result = estimate(
        names=PARAMETER_NAMES,
        values=VALUES[:10],
        standard_errors=np.full(10, 0.1),
        data_share=np.ones(10),
    )
    lines = result_lines(found(result)) + more_lines(found(result))
    assert not any("riction" in text for text in lines)


def test_details_name_every_joint():
    lines = detail_lines(found())
    assert "    j5: 3.00e-02 N·m" in lines and "    j6: 3.00e-02 N·m" in lines


@pytest.mark.parametrize(
    ("folder", "text"),
    [("out", "./out/"), ("./out", "./out/"), ("../out", "../out/"), ("/a/b", "/a/b/"), (".", "./")],
)
def test_a_folder_reads_like_a_folder(folder, text):
    assert folder_text(Path(folder)) == text
