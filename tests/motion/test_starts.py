"""Start poses keep all limits."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from rigs.arms.excitation_arms import TUBES, make_problem, tube_arm
from rigs.arms.small_arms import X, Y, Z, robot_of
from robot_sysid.errors import InputError
from robot_sysid.motion import LimitOptions, starts
from robot_sysid.motion.problem import build_problem

SHELF = '<body name="shelf" pos="0 0 {}"><geom type="box" size=".3 .3 .01"/></body>'
TOP = 4 * 0.25 + 0.23
"""Height of the upright tubes' tip where their shelf begins 10 mm inside it."""
WALL = '<body name="wall" pos=".55 0 .75"><geom type="box" size=".02 .6 .9"/></body>'
LEANING = (0.0, 0.9, 0.0, 0.0)


def arm(xml=TUBES, pose=LEANING):
    """Return the tubes with another rest pose (n,) [rad] than upright."""
    robot = robot_of(xml)
    qpos = robot.reference_qpos.copy()
    qpos[robot.qpos_index] = pose
    return replace(robot, reference_qpos=qpos)


def build(robot, **limits):
    """Return the problem of a robot with some limit options."""
    return build_problem(robot, LimitOptions(**limits))


def holding_share(problem, pose):
    """Return the share of the torque limits that holding a pose (n,) takes."""
    return np.max(np.abs(problem.torque_at(pose[None])) / problem.limits.torque)


def restarted(problem):
    """Return the problem with another start, and the note that says so."""
    startable = starts.with_free_start(problem)
    (note,) = set(startable.notes) - set(problem.notes)
    return startable, note


def test_a_motion_starts_where_nothing_collides():
    problem = make_problem(tube_arm((Z, Y, X, Y), SHELF.format(TOP)))
    startable, note = restarted(problem)
    assert "at rest the model is in a collision: link3 and shelf (10 mm deep)" in note
    assert problem.obstacles.closest_pair(problem.rest).slack < 0.0
    assert startable.obstacles.closest_pair(startable.rest).slack >= 0.0


def weaken_motors(problem, share):
    """Return the problem with torque limits of ``share`` times the torque that its start needs."""
    needed = np.max(np.abs(problem.torque_at(problem.rest[None])))
    torque = np.full(problem.n_joints, share * needed)
    return replace(problem, limits=replace(problem.limits, torque=torque))


@cache
def leaning(lean):
    """Return the problem of an arm that leans by ``lean`` rad."""
    return build(arm(pose=(0.0, lean, 0.0, 0.0)))


@pytest.mark.slow
@given(st.sampled_from((0.4, 0.8, 1.2, 1.6)), st.floats(0.02, 0.99))
def test_a_start_that_cannot_be_held_is_replaced(lean, share):
    """Upright, the tubes only need the reserve for errors of the links: where motors have more than
    that, such a pose exists."""
    problem = weaken_motors(leaning(lean), share)
    assume(holding_share(problem, np.zeros(4)) < 0.7)
    startable, note = restarted(problem)
    assert holding_share(startable, startable.rest) < 1.0
    assert startable.obstacles.closest_pair(startable.rest).slack >= 0.0
    limits = problem.limits
    assert np.all(startable.rest == np.clip(startable.rest, limits.lower, limits.upper))
    assert "dry friction at joint joint1 takes" in note


def test_dry_friction_counts_for_the_start():
    """An arm that can just hold a pose cannot leave it."""
    stiff = TUBES.replace('range="-2.5 2.5"', 'range="-2.5 2.5" frictionloss="0.3"')
    problem = weaken_motors(build(arm(stiff)), 1.01)
    startable, note = restarted(problem)
    assert "dry friction at joint" in note
    assert holding_share(startable, startable.rest) < 1.0 / 1.01


def test_where_no_pose_can_be_held_the_joint_is_named():
    """The second joint is level and the distal joints cannot fold far, so no pose is upright."""
    stiff = TUBES.replace('range="-2.5 2.5"', 'range="-.2 .2"')
    flat = stiff.replace('quat="1 0 0 0"', 'quat=".7 0 .7 0"', 1)
    message = "at joint joint1 takes .*, more than 95 % of its torque limit of"
    with pytest.raises(InputError, match=message):
        starts.with_free_start(build(robot_of(flat), max_torque=0.5))


def test_the_path_to_another_start_is_checked():
    """A wall stands between an arm that leans left and the pose where it leans right."""
    problem = build(arm(tube_arm((Z, Y, X, Y), WALL), (0.0, -0.9, 0.0, 0.0)))
    through = np.array([0.0, 0.9, 0.0, 0.0])
    assert starts.contact_on_the_way(problem, problem.rest) is None
    assert starts.contact_on_the_way(problem, np.array([0.5, -0.5, 0.2, 0.1])) is None
    assert "wall" in starts.contact_on_the_way(problem, through)
