"""A factor on all torques: named where weights agree with it, and refused where it is large."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from rigs.arms.small_arms import robot_of, serial_arm
from robot_sysid.faults.reading_search import Evidence
from robot_sysid.faults.scales import ScaleCorrections, TorqueScales, common_finding
from robot_sysid.records import KINDS
from robot_sysid.records.messages import Level
from robot_sysid.records.option_fields import parse_factors
from tests.faults.conftest import FOUR_AXES, JOINT, findings_of, fit_of, found_in

EVIDENCE = Evidence(np.ones(4), None, lambda: None)


def scales_of(factor, weights):
    """Return scales of four joints that are all a factor to 15 %, and what weights say."""
    every = np.ones(4, dtype=bool)
    covariance = 0.15**2 * np.ones((4, 4))
    values = np.full(4, factor)
    return TorqueScales(values, covariance, every, every, 0.0, np.array(weights))


@pytest.mark.parametrize("factor", [1.4, 1.5, 100.0])
def test_a_factor_and_its_inverse_are_named_alike(factor):
    up = scales_of(factor, [factor, 1.05 * factor])
    down = scales_of(1.0 / factor, [1.0 / factor, 1.0 / (1.05 * factor)])
    assert up.agreed == pytest.approx(np.log(factor))
    assert down.agreed == pytest.approx(up.agreed)
    assert up.is_odd and down.is_odd


@pytest.mark.parametrize(
    ("factor", "weights"),
    [
        (1.0, [1.6, 1.5]),
        (1.6, [1.6, 1.0]),
        (1.6, [0.7, 0.8]),
        (0.6, [1.2, 1.3]),
        (1.2, [1.4]),
        (1.6, []),
    ],
    ids=["tool", "one link", "opposite", "other way", "usual links", "no weight"],
)
def test_a_factor_is_none_where_not_all_agree(factor, weights):
    assert not scales_of(factor, weights).is_odd


def test_a_tool_hides_a_factor_below_one_from_weights_alone():
    assert scales_of(0.65, [1.0, 0.95]).is_odd
    assert not scales_of(1.0 / 0.65, [1.0, 1.0 / 0.95]).is_odd


@pytest.mark.parametrize(("errors", "is_named"), [(3.3, False), (3.7, True)])
def test_one_joint_of_many_is_blamed_beyond_the_largest_of_their_errors(
    errors, is_named
):
    """Of an AR5's seven joints, a wrist was 3.4 errors from the others in one log of many."""
    values = np.ones(7)
    values[4] = 0.5
    every = np.ones(7, dtype=bool)
    covariance = 1e-6 * np.eye(7)
    covariance[4, 4] = (np.log(2.0) / errors) ** 2
    scales = TorqueScales(values, covariance, every, every, 0.0, np.array([]))
    assert (scales.alone is not None) == is_named


def test_no_scale_is_searched_in_a_right_log(right):
    scales = ScaleCorrections(right, EVIDENCE)
    assert not scales.may_be_alone and not scales.may_be_odd


@pytest.mark.parametrize("factor", [0.7, 1.4])
@pytest.mark.parametrize("joint", [1, 2])
def test_the_scale_of_one_joint_is_searched_where_there_is_one(
    four_joints, joint, factor
):
    """What the fit offers opens the search, which finds the joint."""
    factors = np.where(np.arange(4) == joint, factor, 1.0)
    fitted = fit_of(four_joints, tau=factors * four_joints.log.tau)
    scales = ScaleCorrections(fitted, EVIDENCE)
    alone = scales.scales.alone
    assert scales.may_be_alone and alone is not None
    assert alone[0] == joint and abs(alone[1] / factor - 1.0) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize(("others", "named"), [(0.85, 1), (0.45, 0)])
def test_one_joint_is_blamed_unless_all_are_in_another_unit(four_joints, others, named):
    """The arm may weigh less than its model, or the others have a factor as well."""
    factors = others * np.array([1.0, 0.5, 1.0, 1.0])
    found = found_in(four_joints, tau=factors * four_joints.log.tau)
    alone = "torque of joint joint1 reads"
    assert sum(each.text.startswith(alone) for each in found) == named


@pytest.mark.slow
@pytest.mark.parametrize(
    ("factor", "level"), [(1.0, None), (0.78, Level.SAYS), (0.6, Level.REFUSES)]
)
def test_a_factor_is_noted_with_both_ways_and_refused_from_a_larger_one_on(
    four_joints, factor, level
):
    found = found_in(four_joints, tau=factor * four_joints.log.tau)
    named = [each for each in found if each.is_common_factor]
    assert [each.level for each in named] == [level] * (level is not None)
    for each in named:
        assert [way[0] for way in each.options] == ["--mass-scale", "--torque-scale"]
        assert all(" ".join(way) in each.remedy for way in each.options)
        right = replace(
            four_joints.log,
            tau=factor * four_joints.log.tau / parse_factors(each.options[1][1]).values,
        )
        assert found_in(four_joints, tau=right.tau) == ()


def test_no_factor_on_masses_that_a_model_does_not_state(four_joints):
    """One number in all links stands for none: nothing is to be divided, and no torque either."""
    inertial = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    text = re.sub("<inertial [^>]*>", inertial, serial_arm(FOUR_AXES, joint=JOINT))
    robot = robot_of(text)
    log = replace(four_joints.log, tau=2.5 * four_joints.log.tau)
    found = findings_of(robot, log)
    assert all(each.level is Level.SAYS and each.options == () for each in found)


@pytest.mark.parametrize(
    ("kinds", "level"),
    [
        ((), Level.REFUSES),
        (("inertia",), Level.REFUSES),
        (("centre of mass",), Level.SAYS),
        (KINDS, Level.SAYS),
    ],
    ids=["all stated", "inertias", "centres", "masses"],
)
def test_a_factor_on_weight_that_is_not_stated_refuses_nothing(
    four_joints, kinds, level
):
    """Twice as far from the joint is what a body of the geometry may be."""
    robot = four_joints.robot
    # The last link states it all, as one without a way to a next joint does.
    links = [replace(link, placeholders=kinds) for link in robot.links[:-1]]
    robot = replace(robot, links=(*links, robot.links[-1]))
    found = common_finding(robot, 1.99, 0.1, EVIDENCE)
    assert found.level is level
    assert bool(found.options) == (level is Level.REFUSES)
    assert found.is_common_factor


@pytest.mark.parametrize(
    ("factor", "error", "named"),
    [
        (1000.0, 0.2, "(as in mN·m)"),
        (149.8, 0.02, "(as in ozf·in)"),
        # Counts of a driver, which are no unit.
        (149.8, 0.18, "N·cm .* or ozf·in .*, which the ± does not tell apart"),
        (9.4, 0.02, "kgf·cm .* or lbf·in"),
        (30.0, 0.05, "they may be motor currents or counts;"),
        # Hardly known, it is no number to divide by, whatever masses an arm may have.
        (
            1000.0,
            1.4,
            "they may be motor currents or counts, or .*; give the torque per",
        ),
    ],
)
def test_a_unit_is_named_where_the_error_leaves_no_other(
    four_joints, factor, error, named
):
    found = common_finding(four_joints.robot, factor, error, EVIDENCE)
    pattern = re.escape(named) if named.startswith("(") else named
    assert re.search(pattern, f"{found.text}; {found.remedy}")
    assert ("(as in" in found.remedy) == named.startswith("(as in")
