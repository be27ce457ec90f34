"""What is printed of a slide: its force in N and its way in m, in every command."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rigs.arms import small_arms
from rigs.arms.core_fits import filter_logs, fit_recordings
from rigs.files.command_line import OUT
from rigs.logs.measured_logs import log_of, plan_of
from robot_sysid.faults.columns import fault_columns
from robot_sysid.faults.gate import slow_findings
from robot_sysid.faults.table import explanations
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.parser import load_robot_model
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.quantities import Quantity
from robot_sysid.results.reasons import impossible_joints

FRICTION = 'frictionloss=".3" damping=".2" armature=".05"'
ARM = small_arms.world(
    small_arms.link(
        f'<joint name="lift" type="slide" axis="0 .3 1" range="-.5 .5" {FRICTION}/>',
        small_arms.link(
            small_arms.hinge("bend", small_arms.Y, f'range="-2 2" {FRICTION}'),
            small_arms.link(
                small_arms.hinge("roll", small_arms.X, f'range="-2 2" {FRICTION}'),
                "",
                "tip",
                inertial=small_arms.TIP,
            ),
            "forearm",
        ),
        "carriage",
    )
)
OF_HINGES = re.compile(r"N·m|rad|kg·m²")


@pytest.fixture
def robot(arm_file, tmp_path):
    """The arm, and its logs off.csv and at_rest.csv."""
    robot = load_robot_model(arm_file(ARM))
    log = log_of(robot, plan_of(robot), noise_torque=0.02)
    slide = np.array([1.0, 0.0, 0.0])
    logs = {
        "off": replace(log, tau=log.tau + 30.0 * slide),
        "at_rest": replace(log, q=1e-5 * log.q * slide),
    }
    for name, samples in logs.items():
        path = tmp_path / f"{name}.csv"
        write_measurement_csv(path, robot.joint_names, [samples])
    return robot


def lines_of_the_slide(text):
    """The lines on the slide and no other joint."""
    lines = text.splitlines()
    return [s for s in lines if "lift" in s and not re.search("bend|roll", s)]


@pytest.mark.slow
def test_no_command_gives_a_slide_the_units_of_a_hinge(command, robot, tmp_path):
    identified = command.run("identify arm.xml off.csv --verbose --report")
    # A part of it, of 60 N that the joint carries, is within what links and base may be off.
    found = re.search(r"an offset of a torque sensor \(lift (\d+) N\b", identified.err)
    assert found and 28 <= int(found.group(1)) <= 30
    planned = command.run("plan arm.xml --excitation sines --duration 5 --verbose")
    page = (OUT / "report.html").read_text()
    cells = re.sub("<[^>]*>", " ", page.replace("</tr>", "\0").replace("\n", " "))
    texts = (identified.out, identified.err, planned.out, cells.replace("\0", "\n"))
    for text in texts:
        for line in lines_of_the_slide(text):
            assert not OF_HINGES.search(line), line
    assert re.search(r"    lift: \S+, noise", identified.out)
    at_rest = command.refused("log at_rest.csv arm.xml")
    assert re.search(r"no joint moves by more than \S+ m;", at_rest)


def test_explanations_of_a_slide_are_in_its_units(robot):
    log = log_of(robot, plan_of(robot), noise_torque=0.02)
    fitted = fit_recordings(robot, filter_logs(robot, log), beside=fault_columns)
    for explanation in explanations(fitted):
        has_unit_of_hinge = OF_HINGES.search(explanation.unit)
        joint = explanation.words.get("joint")
        assert not (has_unit_of_hinge and joint == "lift")
        if joint in ("bend", "roll") and explanation.fault.name is FaultName.ZERO:
            assert has_unit_of_hinge


def test_findings_and_doubts_about_a_slide_have_its_units(robot):
    still = SimpleNamespace(motion=SimpleNamespace(qd=np.array([[0.02, -0.01, 0.0]])))
    (finding,) = slow_findings(robot, [still])
    assert finding.text == "no joint moves faster than 0.02 m/s"
    rows = [Quantity("coulomb", "lift", "N", None, 900.0, 0.1)]
    torque = dict.fromkeys(robot.joint_names, 1.0)
    (reason,) = impossible_joints(with_limit(robot), rows, torque)
    assert "lift would have 900 N of dry friction" in reason


def with_limit(robot):
    """The arm with a limit of 100 to the torque of all joints."""
    return replace(robot, limits=replace(robot.limits, torque=np.full(3, 100.0)))
