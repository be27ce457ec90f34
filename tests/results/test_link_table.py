"""Tables of all links and joints: each number with its ±, no line wider than a terminal."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from robot_sysid.results.link_table import FILE_REASON, joint_lines, link_lines
from robot_sysid.results.record import JointEstimate, Quantity, Verdict
from tests.support import results as made

LONG_NAME = "left_arm_shoulder_pitch"


def numbers_after(lines, name):
    """All "value ± error" of the rows of a name, in order."""
    rows = [line for line in lines if line.split()[0] == name]
    return re.findall(r"(-?[\d.]+) ± ([\d.]+)", " ".join(rows))


def test_every_link_has_its_ten_numbers_with_errors_in_100_columns():
    body = replace(made.terminal(made.estimate()), name=LONG_NAME)
    result = made.whole(links=made.by_name(body, *made.whole().links.values()))
    lines = list(link_lines(result))
    assert max(map(len, lines)) <= 100
    for name in (LONG_NAME, "link5", "link6"):
        assert len(numbers_after(lines, name)) == 3 + 6
    mass_row = lines[1].split()
    numbers = [LONG_NAME, "1.0000", "2.0000", "0.0020", "kg", "+100", "%"]
    assert mass_row[:7] == numbers
    assert not any("(" in line for line in lines if "±" in line and "[" not in line)


def test_masses_of_the_file_stand_beside_those_of_the_table_where_they_differ():
    """The file's links weigh 3 and 1.8 kg, those of the table 2 kg with an error of 2 g."""
    file = made.model_file()
    lines = list(link_lines(made.whole(file=file)))
    assert lines[0].endswith("change  in the file")
    assert [line.split()[-1] for line in lines[1:3]] == ["3.0000", "1.8000"]
    assert lines[3] == f"  in the file: {FILE_REASON.format('updated_model.xml')}"

    # What the printed digits hide is no difference.
    for mass, text in {2.00004: "%", 2.0001: "2.0001"}.items():
        thetas = file.thetas.copy()
        thetas[:, 0] = [mass, 1.8]
        lines = list(link_lines(made.whole(file=replace(file, thetas=thetas))))
        assert [line.split()[-1] for line in lines[1:3]] == [text, "1.8000"]
    thetas[:, 0] = 2.0
    for changes in (
        {"file": replace(file, thetas=thetas, joints={})},
        {"file": None},
        {"verdict": Verdict.UNEXPLAINED},
    ):
        assert "in the file" not in " ".join(link_lines(made.whole(**changes)))


def test_what_the_prior_determines_stands_in_parentheses_and_is_explained_once():
    body = made.terminal(made.estimate())
    prior = replace(body, name="link5", data_share=np.full(10, 0.3))
    lines = list(link_lines(made.whole(links=made.by_name(prior, body))))
    cells = [line for line in lines if line.startswith("  link5") and "(" in line]
    assert len(cells) >= 2 and all(line.count("±") == line.count("(") for line in cells)
    assert len([line for line in lines if "comes from the prior" in line]) == 1
    unknown = replace(body, name="link4", is_determined=np.arange(10) < 1)
    lines = list(link_lines(made.whole(links=made.by_name(unknown, body))))
    rows = " ".join(line for line in lines if line.startswith("  link4"))
    assert rows.count("unidentifiable") == 9 and "inf" not in rows


def test_every_joint_and_shared_motor_has_its_terms_and_units():
    lines = list(joint_lines(made.whole()))
    assert "Coulomb [N or N·m]" in lines[0]
    assert ("0.50000", "0.00050") in numbers_after(lines, "j5")
    assert "0.3 -> 0.50000 ± 0.00050" in lines[1]
    assert lines[2].split() == ["in", "the", "file", "0.45000", "0.25000"]
    assert "0.0500 ± 0.0020" in lines[-1] and "turns with j5+j6" in lines[-1]


def test_many_friction_terms_go_on_in_a_table_below():
    terms = {
        term: Quantity(0.1234, 0.0012) for term in ("coulomb", "viscous", "offset")
    }
    further = {term: Quantity(-0.5, 0.012) for term in ("stribeck", "load", "armature")}
    unknown = {"sqrt": Quantity(0.0, np.inf), "fading_slow": Quantity(0.0, np.nan)}
    joints = {
        LONG_NAME: JointEstimate("many", {**terms, **further, **unknown}),
        "j6": JointEstimate("few", terms),
    }
    lines = list(joint_lines(made.found(joints=joints)))
    assert max(map(len, lines)) <= 100
    assert len([line for line in lines if line.startswith("  Friction")]) == 3
    assert len(numbers_after(lines, LONG_NAME)) == 6
    # A table in which a joint has no entry leaves it out.
    assert len([line for line in lines if line.startswith("  j6")]) == 1
    rows = "".join(line for line in lines if LONG_NAME in line)
    assert "unidentifiable" in rows and "0 (held)" in rows
    assert lines[-1].startswith("  held: kept at its bound")
