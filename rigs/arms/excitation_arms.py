"""Arms with geometry, and excitation problems that are small enough to search in a moment."""

from dataclasses import replace
from functools import cache

import numpy as np

from rigs.arms import small_arms
from rigs.arms.small_arms import X, Y, Z, world
from robot_sysid.estimate.options import (
    DEFAULT_FRICTION,
    DEFAULT_TERMINAL,
    friction_terms,
)
from robot_sysid.expected.criterion import PriorKnowledge
from robot_sysid.motion import Effort, ExcitationOptions, LimitOptions
from robot_sysid.motion.problem import DEFAULT_NOISE_TORQUE, build_problem
from robot_sysid.motion.search import Design
from robot_sysid.trajectory import TrajectoryOptions

_TUBE = '<geom type="capsule" size=".03" fromto="0 0 .04 0 0 .2"/>'


def tube_arm(axes, scene="", pos="0 0 .25", joint='range="-2.5 2.5"', extra=""):
    """A serial arm of capsules beside some scene."""
    bodies = small_arms.serial_bodies(axes, joint=joint, inside=_TUBE, pos=pos)
    return world(bodies + scene, extra=extra)


FLOOR = '<geom name="floor" type="plane" size="2 2 .1"/>'
POST = '<body name="post" pos=".35 0 .7"><geom type="capsule" size=".05 .35"/></body>'
TUBES = tube_arm((Z, Y, X, Y))
TUBES_AND_POST = tube_arm((Z, Y, X, Y), POST)
TUBES_ON_FLOOR = tube_arm((Z, Y, X, Y), FLOOR)
# The last link lies in the second one at rest, as neighbouring links of public models do.
TOUCHING_AT_REST = TUBES_AND_POST.replace(
    _TUBE, '<geom type="capsule" size=".03" fromto="0 0 -.1 0 0 .3"/>'
)

DURATION = 6.0
SMALL = Effort(draws=6, rounds=1, iterations=8)


@cache
def robot(xml):
    """RobotModel of an XML string."""
    return small_arms.robot_of(xml)


def options(kind="optimal", time_budget=None, **changes):
    """Options of a search that takes a fraction of a second; ``changes`` are of its effort."""
    return ExcitationOptions(
        kind=kind, time_budget=time_budget, effort=replace(SMALL, **changes)
    )


@cache
def make_problem(xml, torques="chain", noise_torque=DEFAULT_NOISE_TORQUE, **limits):
    """ExcitationProblem of an XML string; further arguments are those of ``LimitOptions``."""
    return build_problem(robot(xml), LimitOptions(**limits), torques, noise_torque)


def known_arm(problem):
    """Priors of an arm of which only the last link, friction and rotors are unknown."""
    count = len(problem.rows)
    # From one torque alone rotor inertias are not estimated: they look like the link's.
    default = DEFAULT_FRICTION if count > 1 else DEFAULT_TERMINAL
    deviations = dict.fromkeys(friction_terms(default), np.full(count, np.inf))
    known = np.zeros((10 * len(problem.links[1:]), 0))
    return PriorKnowledge(known, deviations)


@cache
def make_design(xml, torques="chain", duration=DURATION, **changes):
    """Design of an XML string."""
    search_options = options(**changes)
    motion = TrajectoryOptions(duration=duration)
    problem = make_problem(xml, torques)
    return Design(problem, search_options, motion, known_arm(problem))


def random_x(design, seed, size=0.3):
    """Random free coefficients (n, M) of a design."""
    shape = (design.problem.n_joints, design.size)
    return size * np.random.default_rng(seed).normal(size=shape)


def slope(function, x, direction, step=1e-6):
    """Central difference of a function along a direction."""
    difference = function(x + step * direction) - function(x - step * direction)
    return difference / (2.0 * step)


def link_covariance(criterion, motion):
    """Covariance (10, 10) of the terminal link's parameters that a motion (q, qd, qdd) and the
    priors leave; zero along directions that no motion shows.
    """
    count = criterion.visible.shape[1]
    inverse = np.linalg.inv(criterion.information(motion))
    return criterion.visible @ inverse[:count, :count] @ criterion.visible.T
