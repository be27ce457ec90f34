"""What the reader of a plan is told, line by line."""

from __future__ import annotations

import re

import numpy as np
import pytest

from robot_sysid.motion.limit_check import check_limits
from robot_sysid.motion.prediction import motion_lines
from robot_sysid.trajectory import generate_excitation_trajectory
from tests.support import witness
from tests.support.arms import X, Y, Z
from tests.support.excitation_arms import TUBES, problem, robot, tube_arm
from tests.support.releases import since

STRONG = TUBES.replace('range="-2.5 2.5"', 'range="-2.5 2.5" actuatorfrcrange="-60 60"')


def report(some, plan):
    return list(motion_lines(some, plan, check_limits(some, plan)))


def sines(xml, seed=0):
    return generate_excitation_trajectory(robot(xml), np.random.default_rng(seed), 2.0)[0]


def the(lines, start):
    (line,) = [line for line in lines if line.startswith(start)]
    return line


def test_the_speed_of_the_tools_fastest_point_is_that_of_its_last_tube():
    some, plan = problem(TUBES, max_tool_speed=9.0), sines(TUBES)
    line = the(report(some, plan), "Fastest point of the tool: ")
    found, share = re.match(r".*: (.*) m/s \( *(\d+) %\)", line).groups()
    fastest = witness.fastest_point(robot(TUBES), plan, "link3")
    # A ball stands for the tube's round end: a little too fast, never too slow.
    assert fastest - 0.005 <= float(found) <= 1.03 * fastest + 0.005
    assert float(share) == pytest.approx(100.0 * fastest / 9.0, abs=1.5)


@since(3, 1, 6)
def test_the_stated_clearance_is_the_smallest_distance_not_the_tightest_slack():
    """At rest the last tube is 4 mm from a stud, so it may come as near as 2 mm."""
    stud = '<body name="stud" pos="0 .064 1.1"><geom size=".03"/></body>'
    near = tube_arm((Z, Y, X, Y), stud + '<body name="post" pos=".8 0 .7"><geom size=".4"/></body>')
    some, plan = problem(near), sines(near)
    lines = report(some, plan)
    real = witness.nearest(robot(near), plan)
    stated = float(re.match(r"Clearance: (-?[\d.]+) mm", the(lines, "Clearance: ")).group(1))
    assert 1e3 * real - 0.25 <= stated <= 1e3 * real


def test_the_torque_that_is_left_is_said_as_a_load():
    some, plan = problem(STRONG), sines(STRONG)
    line = the(report(some, plan), "Torque left: ")
    left = float(re.match(r"Torque left: a load of ([\d.]+) kg", line).group(1))
    kept = check_limits(problem(STRONG, payload_reserve=left), plan)
    broken = check_limits(problem(STRONG, payload_reserve=left + 0.05), plan)
    assert not any("torque" in excess.limit for excess in kept.excesses)
    assert any("torque" in excess.limit for excess in broken.excesses)
