"""The printed result block: every figure with its error, nothing that is not known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.output.summary import detail_lines, folder_text, result_lines
from tests.support.results import (
    NAMES,
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


def test_the_block_of_measured_data_line_by_line():
    lines = result_lines(found(validation=(validation_of(0.05),)))
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
        "Standard errors, all causes together (and of noise alone):",
        "  m: 2 ± 0.002 (0.1 %; noise 0.002)",
        "  hx: 0 ± 1e-05 (noise 1e-05)",
        "  hy: 0.02 ± 2e-05 (0.1 %; noise 2e-05)",
        "  hz: 0.2 ± 0.0002 (0.1 %; noise 0.0002)",
        "  Ixx: 0.0302 ± 3e-05 (0.1 %; noise 3e-05)",
        "  Ixy: 0 ± 1e-05 (noise 1e-05)",
        "  Ixz: 0 ± 1e-05 (noise 1e-05)",
        "  Iyy: 0.032 ± 3.2e-05 (0.1 %; noise 3.2e-05)",
        "  Iyz: -0.002 ± 1e-05 (0.5 %; noise 1e-05)",
        "  Izz: 0.0052 ± 1e-05 (0.19 %; noise 1e-05)",
        "Friction (coulomb-viscous):",
        "  j5: coulomb 0.5 ± 0.0005, viscous 0.2 ± 0.0002",
        "  j6: coulomb 0.4 ± 0.0004, viscous 0.1 ± 0.0001",
        "Torque noise per joint after filtering, N·m: j5 0.03, j6 0.031",
        "Validation on other.csv: 0.0500 N·m (2.00 %)",
        "  Limit: torques of other.csv are predicted 1.7 times worse than the fitted ones: "
        "the model misses something that motion shows",
    ]


def test_the_models_own_simulation_ends_after_the_base_parameters():
    data = {"data": own_simulation(), "friction_model": None}
    lines = result_lines(found(validation=(validation_of(0.05),), **data))
    assert lines[-1] == "  Base parameters: 12"


def test_what_the_data_does_not_see_has_no_error_but_a_reason():
    result = without_mass()
    lines = result_lines(found(result))
    assert line(lines, "  m:") == "  m: 2, at least partly from the model (data 0 %)"
    assert not any("inf" in text for text in lines)
    own = result_lines(found(result, data=own_simulation(), friction_model=None))
    assert own[-1] == "  Not visible in these torques, kept from the model: mass"


def test_friction_of_a_joint_that_stood_still_is_not_visible():
    lines = result_lines(found(with_value("coulomb[j5]", 0.0, np.inf)))
    assert line(lines, "  j5:") == "  j5: coulomb not visible, viscous 0.2 ± 0.0002"


@pytest.mark.parametrize(("error", "said"), [(0.5, "25 %"), (20.0, "1000 %"), (1.995, "100 %")])
def test_large_errors_stay_readable(error, said):
    lines = result_lines(found(with_value("m", 2.0, error)))
    assert f"({said}; noise" in line(lines, "  m:")


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
