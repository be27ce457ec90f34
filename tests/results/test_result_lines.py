"""The printed lines: a self-test's specified block, or a table; then errors, limits and details."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from robot_sysid.records import SubtreeBody
from robot_sysid.records.messages import Detail
from robot_sysid.results import result_lines
from robot_sysid.results.record import Verdict
from robot_sysid.results.result_lines import block_lines, more_lines
from tests.support import results as made


def line_starting(lines, start):
    """The only line that starts so."""
    (match,) = [text for text in lines if text.startswith(start)]
    return match


def test_the_readmes_block_line_by_line():
    assert block_lines(made.itself()) == [
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
    result = made.found(validation=(made.validation_of(0.05),))
    table = block_lines(result)
    heading = "Before -> after model identified ± unit change"
    assert " ".join(table[0].split()) == heading
    assert table[1].split()[:5] == ["mass", "1.0000", "2.0000", "0.0020", "kg"]
    assert len(table) == 13
    lines = more_lines(result)
    assert brief_lines(lines) == [
        "Validation on other.csv: 0.0500 N·m (2 %)",
        "  Limit: torques of other.csv are predicted 1.7 times worse than the fitted ones: the "
        "model misses something that motion shows",
    ]
    quality = [
        "  RMSE: 0.0300 N·m",
        "  Condition number: 50.0",
        "  Base parameters: 12",
    ]
    assert [line for line in lines if line in quality] == quality
    assert (
        "Error of the mass by cause, kg: the other links' parameters 0.0016, noise 0.0012"
        in lines
    )
    (row,) = (line for line in lines if line.startswith("  j6  "))
    assert "0.2 -> 0.40000 ± 0.00040" in row and "0 -> 0.10000 ± 0.00010" in row


def test_a_printed_number_stands_once():
    """Links, joints and the table of the last link are not printed beside each other."""
    result = made.whole()
    lines = result_lines.result_lines(result, links=True)
    assert not any("Before -> after" in line for line in lines)
    for detail_lines in (
        [*block_lines(result, links=True), *more_lines(result, links=True)],
        [*block_lines(result), *more_lines(result)],
    ):
        headings = [line for line in detail_lines if line.startswith("  Friction ")]
        assert len(headings) == 1


def test_the_written_file_is_judged_by_its_torque_error_on_other_logs():
    """The torque error on held-out data is one of the verdict's."""
    lines = more_lines(made.whole())
    torque_line = line_starting(brief_lines(lines), "Torque error")
    assert torque_line == "Torque error of the model on other.csv: 30 % -> 1.2 %"
    assert "Left in the file as it was: rotor inertia" in lines
    assert not any(line.startswith("Validation") for line in lines)


def test_a_result_takes_no_more_than_a_screen():
    """A screen has 25 lines, of which stages take four."""
    complete_result = made.whole(validation=())
    for result in (complete_result, made.payload(), made.itself()):
        assert len(result_lines.result_lines(result)) <= 21


def test_a_parameter_that_the_data_does_not_show_has_a_reason_instead_of_an_error():
    result = made.found(made.without_mass())
    lines = [*block_lines(result), *more_lines(result)]
    assert line_starting(lines, "  mass").endswith("  not identifiable")
    assert "inf" not in "".join(lines)
    lines = more_lines(made.found(made.with_value("coulomb[j5]", 0.0, np.inf)))
    assert line_starting(lines, "  j5").split()[1] == "unidentifiable"


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
    mass_line = line_starting(block_lines(made.found(robot=robot)), start)
    assert mass_line == f"{start} of link7 + hand + finger together"
    lines = block_lines(made.found(robot=robot_with(link)))
    assert not any(start in line for line in lines)


def test_a_mass_that_the_file_has_otherwise_stands_below_the_table():
    start = "  updated_model.xml has the numbers that predict held-out torques best"
    lines = block_lines(made.whole())
    assert lines[-1] == f"{start}; its mass of link6 is 1.8000 kg"
    for result in (made.found(), made.whole(verdict=Verdict.UNEXPLAINED)):
        assert not any(line.startswith(start) for line in block_lines(result))


def test_a_payloads_block():
    result = made.payload()
    lines = [*block_lines(result), *more_lines(result)]
    assert lines[0] == "Identified payload, in the frame of site 'flange':"
    assert len(brief_lines(lines)) == 12
    assert re.split(r"  +", lines[2].strip()) == ["mass", "1.200", "0.010", "kg"]
    assert line_starting(lines, "Terminal link with it: 2.000 ± 0.010 kg")
    assert "  b.csv (loaded): 1.190 ± 0.010 kg" in lines
