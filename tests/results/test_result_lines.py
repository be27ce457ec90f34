"""The printed lines: the specified block first, then every number with its error and its unit."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from pytest import approx

from robot_sysid.records import InertialParameters, SubtreeBody
from robot_sysid.records.messages import Detail
from robot_sysid.results import result_lines
from robot_sysid.results.cards import load_errors
from robot_sysid.results.result_lines import block_lines, more_lines, parameter_rows
from tests.support import results as made


def line_starting(lines, start):
    """The only line that starts so."""
    (match,) = [text for text in lines if text.startswith(start)]
    return match


def test_the_readmes_block_line_by_line():
    assert block_lines(made.found()) == [
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


def brief_lines(lines):
    """The lines that are printed without --verbose."""
    return [line for line in lines if not isinstance(line, Detail)]


def test_measured_data_gets_a_table_validation_and_limits():
    lines = more_lines(made.found(validation=(made.validation_of(0.05),)))
    table = brief_lines(lines)
    heading = "Before -> after model identified ± unit change"
    assert " ".join(table[0].split()) == heading
    names = ["mass", *(f"centre of mass {axis}" for axis in "xyz")]
    names += ["Coulomb fri", "viscous fri"]
    for row, name in zip(table[1:7], names):
        assert row.startswith(f"  {name}")
    assert table[7:] == [
        "Validation on other.csv: 0.0500 N·m (2 %)",
        "  Limit: torques of other.csv are predicted 1.7 times worse than the fitted ones: the "
        "model misses something that motion shows",
    ]
    mass_cells = line_starting(lines, "  mass").split()
    assert mass_cells[1:5] == ["1.0000", "2.0000", "0.0020", "kg"]
    moment_cells = line_starting(lines, "  CoM moment x").split()
    assert moment_cells[3:] == ["0", "0", "0.000010", "kg·m", "none"]
    budget = "Error of the mass by cause, kg: links 0.0016, noise 0.0012"
    friction_index = lines.index(budget) + 1
    assert lines[friction_index : friction_index + 3] == [
        "Friction of the joints (coulomb-viscous), model -> identified ± error:",
        "  j5: coulomb 0.3 -> 0.50000 ± 0.00050 N·m, viscous 0.1 -> 0.20000 ± 0.00020 N·m·s/rad",
        "  j6: coulomb 0.2 -> 0.40000 ± 0.00040 N·m, viscous 0 -> 0.10000 ± 0.00010 N·m·s/rad",
    ]


def test_the_models_own_simulation_has_a_block_alone():
    assert brief_lines(more_lines(made.itself())) == []
    text = "".join(more_lines(made.itself(made.without_mass())))
    assert "inf" not in text and "±" not in text


def test_the_written_file_is_judged_by_its_torque_error_on_other_logs():
    """The torque error on held-out data is one of the verdict's."""
    lines = more_lines(made.whole())
    torque_line = line_starting(brief_lines(lines), "Torque error")
    assert torque_line == "Torque error of the model on other.csv: 30 % -> 1.2 %"
    assert "The fit itself reaches a torque error of 0.22 % on held-out data" in lines
    assert "Left in the file as it was: rotor inertia" in lines
    assert not any(line.startswith("Validation") for line in lines)


def test_a_result_takes_no_more_than_a_screen():
    """A screen has 25 lines, of which stages take four."""
    complete_result = made.whole(validation=(), rollout=None, delay=None, tilt=None)
    for result in (complete_result, made.payload(), made.itself()):
        assert len(result_lines.result_lines(result)) <= 21


def test_a_parameter_that_the_data_does_not_show_has_a_reason_instead_of_an_error():
    lines = more_lines(made.found(made.without_mass()))
    assert line_starting(lines, "  mass").endswith("  not seen")
    assert "inf" not in "".join(lines)
    lines = more_lines(made.found(made.with_value("coulomb[j5]", 0.0, np.inf)))
    assert line_starting(lines, "  j5: coulomb not visible, viscous 0.1 -> 0.2")


def subtree_body(name, mass, is_welded=True):
    """A body of the terminal link with this mass [kg]; welded, or on a joint of its own."""
    return SubtreeBody(0, name, mass / 2.0 * made.THETA, is_welded)


def robot_with(*bodies):
    """The two-joint arm whose terminal link consists of these bodies."""
    return replace(made.ARM, bodies=bodies)


def test_the_mass_of_a_link_of_several_bodies_is_explained():
    start = "The mass is that"
    link = subtree_body("link7", 0.7)
    finger = subtree_body("finger", 0.2, False)
    bodies = (link, subtree_body("hand", 0.3), finger, subtree_body("eye", 0.0))
    robot = robot_with(*bodies)
    assert line_starting(more_lines(made.found(robot=robot)), start) == (
        f"{start} of link7 + hand + finger; link7 alone, as written in the file: 1.5 kg"
    )
    # The file's own terminal link weighs 1.8 kg.
    mass_line = line_starting(more_lines(made.whole(robot=robot)), start)
    assert mass_line.endswith("in the file: 1.3 kg")
    lines = more_lines(made.found(robot=robot_with(link)))
    assert not any(start in line for line in lines)
    pads = [subtree_body(f"pad{k}", 0.01) for k in range(6)]
    mass_line = line_starting(
        more_lines(made.found(robot=robot_with(*bodies, *pads))), start
    )
    assert "link7 + hand + finger + 6 more; link7" in mass_line


def test_a_payloads_block():
    result = made.payload()
    lines = [*block_lines(result), *more_lines(result)]
    assert lines[0] == "Identified payload, in the frame of site 'flange':"
    assert len(brief_lines(lines)) == 12
    table = [re.split(r"  +", line.strip()) for line in lines[1:11]]
    assert table[0] == ["identified", "±", "unit"]
    assert table[1] == ["mass", "1.200", "0.010", "kg"]
    assert table[2][:2] == ["centre of mass x", "0.03000"] and table[2][3] == "m"
    assert table[5][:2] == ["inertia xx about it", "0.00600"] and table[5][3] == "kg·m²"
    assert "Error of the mass by cause, kg: torque scale 0.008, noise 0.006" in lines
    assert line_starting(lines, "Terminal link without it") == (
        "Terminal link without it: 0.800 ± 0.010 kg, centre of mass "
        "[0.0300 ± 0.0013, -0.0200 ± 0.0013, 0.0800 ± 0.0016] m"
    )
    assert line_starting(lines, "Terminal link with it: 2.000 ± 0.010 kg")
    assert "  b.csv (loaded): 1.190 ± 0.010 kg" in lines


NUMBERS = st.floats(1e-9, 1e3) | st.floats(-1e3, -1e-9)


@given(
    st.lists(st.tuples(NUMBERS, NUMBERS, st.floats(1e-9, 1e3)), min_size=1, max_size=5)
)
def test_no_number_that_is_not_zero_prints_as_zero(rows):
    lines = result_lines.table_lines(
        [result_lines.BeforeAfter("it", *row, "kg", 1.0) for row in rows]
    )
    for line in lines[1:]:
        for number in re.findall(r"(?<![\w.])-?\d[\d.e+-]*", line):
            assert float(number) != 0.0


def test_a_terminal_link_has_its_ten_parameters_centre_of_mass_and_friction():
    rows = {row.name: row for row in parameter_rows(made.found())}
    assert len(rows) == 15
    mass = rows["mass"]
    assert (mass.before, mass.after, mass.unit) == (1.0, 2.0, "kg")
    center = rows["centre of mass z"]
    assert (center.after, center.unit) == (approx(0.1), "m")
    assert center.error == load_errors(made.terminal(made.estimate()))[3]
    friction = rows["Coulomb friction"]
    assert (friction.before, friction.after) == (0.2, 0.4)
    assert friction.error == approx(4e-4)


def test_viscous_friction_of_a_slide_has_the_unit_of_a_force():
    slider = replace(made.ARM, is_slide=np.array([False, True]))
    rows = parameter_rows(made.found(robot=slider, joints={}))
    (viscous,) = (row for row in rows if row.name == "viscous friction")
    assert viscous.unit == "N·s/m"


def test_a_simulation_of_the_model_itself_states_no_errors():
    assert [row.error for row in parameter_rows(made.itself())] == [None] * 15


def test_a_payload_has_mass_centre_of_mass_and_inertia_about_it():
    rows = parameter_rows(made.payload())
    assert [row.before for row in rows] == [None] * 10
    assert (rows[0].after, rows[0].error) == (1.2, approx(0.01))
    assert (rows[1].name, rows[1].after) == ("centre of mass x", approx(0.03))
    assert (rows[4].name, rows[4].after) == ("inertia xx about it", approx(0.006))
    assert [row.error for row in rows[4:]] == load_errors(made.body())[4:].tolist()
    assert len(parameter_rows(made.payload(made.body(shown=False)))) == 4
    assert len(parameter_rows(made.payload(made.body(-1.0)))) == 1


def test_rounding_is_no_number():
    """A product of inertia of a symmetric body comes back as 1e-18."""
    noisy = made.THETA + np.array([0, 1e-16, 0, 0, 0, 1e-18, 0, 0, 0, 0])
    terminal = made.terminal(made.estimate())
    rows = result_lines.theta_rows(
        replace(terminal, inertial=InertialParameters(noisy))
    )
    assert (rows[1].after, rows[5].after) == (0.0, 0.0)
    # A gripper jaw's numbers are small, not rounding.
    jaw = 1e-3 * made.THETA
    rows = result_lines.theta_rows(replace(terminal, inertial=InertialParameters(jaw)))
    assert all(
        (row.after != 0.0) == (parameter != 0.0) for row, parameter in zip(rows, jaw)
    )
