"""Public models of real arms: the tool finds the arm and identifies its last link exactly, and each
gets a trajectory that breaks no limit and touches nothing.

Skipped where the models are not beside the checkout. A trajectory is checked at 1 kHz by code the
search does not use: the model's own limits, and contacts as MuJoCo reports them.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rigs.arms import small_arms, witness
from rigs.files.places import MODELS
from robot_sysid import spatial
from robot_sysid.errors import AmbiguousJointError, ModelError
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.expected.recording import prior_knowledge
from robot_sysid.model.bodies import body_theta
from robot_sysid.motion import Effort, ExcitationOptions, LimitOptions
from robot_sysid.motion.limit_check import keeps_limits
from robot_sysid.motion.problem import build_problem
from robot_sysid.motion.search import (
    INFORMATION_POINTS,
    Design,
    design_excitation,
    draw_trajectory,
)
from robot_sysid.parser import load_robot_model
from robot_sysid.records.messages import Progress
from robot_sysid.simulator import simulate_inverse
from robot_sysid.solver import LastLinkTerms, identify_parameters
from robot_sysid.trajectory import (
    TrajectoryOptions,
    generate_excitation_trajectory,
    motion_chunks,
)

pytestmark = pytest.mark.skipif(
    not MODELS.is_dir(), reason="the public models are not here"
)

# Model, terminal joint, number of joints that carry the link.
WHOLE_ARMS = [
    ("kinova_gen3/gen3_official.xml", "joint_7", 7),
    ("kinova_gen3/gen3_7dof_2023.xml", "joint_7", 7),
    ("franka_panda/panda.xml", "joint7", 7),
    ("franka_panda/panda_nohand.xml", "joint7", 7),
    ("franka_fr3/FrankaFR3_7DoF.urdf", "fr3_joint7", 7),
    ("kuka_iiwa_14/iiwa14.xml", "joint7", 7),
    ("universal_robots_ur5e/ur5e.xml", "wrist_3", 6),
    ("ufactory_xarm7/xarm7.xml", "joint7", 7),
    ("ufactory_xarm7/xarm7_nohand.xml", "joint7", 7),
    ("trossen/wxai/wxai_follower.xml", "joint_5", 6),
    ("trossen/wxai/scene_wxai_pick_place.xml", "joint_5", 6),
    ("so101/so101_new_calib.xml", "wrist_roll", 5),
    ("so101/so101_new_calib.urdf", "wrist_roll", 5),
]
DOUBTFUL = [
    (
        "openarm_v2/openarm_bimanual.xml",
        ["openarm_left_joint7", "openarm_right_joint7"],
    ),
    ("aloha/aloha.xml", ["left/wrist_rotate", "right/wrist_rotate"]),
    ("franka_panda/hand.xml", ["finger_joint1", "finger_joint2"]),
]
JAW = ("so101/so101_new_calib.urdf", "gripper")
"""The choice of the fast run whose last link is a jaw."""
CHOICES = [(model, None) for model, _, _ in WHOLE_ARMS]
CHOICES += [(model, joint) for model, joints in DOUBTFUL[:2] for joint in joints]
CHOICES += [("so101/so101_new_calib.xml", "gripper"), JAW]


QUICK = ("kuka_iiwa_14/iiwa14.xml", "franka_fr3/FrankaFR3_7DoF.urdf")
"""Models of the fast run: an MJCF and a URDF that compile in a moment."""


def slow_unless_quick(choices):
    """Return the choices as parameters of a test, all but ``QUICK`` and ``JAW`` marked slow."""
    parameters = []
    for choice in choices:
        is_quick = choice[0] in QUICK or choice == JAW
        marks = () if is_quick else pytest.mark.slow
        parameters.append(pytest.param(*choice, marks=marks))
    return parameters


@cache
def load(model, joint=None):
    """Models are read once; nothing here changes them."""
    path = MODELS / model
    if not path.exists():
        pytest.skip(f"{model} is not here")
    try:
        return load_robot_model(path, joint=joint)
    except ModelError as error:
        if "unrecognized attribute" in str(error):
            pytest.skip(f"{model} is written for a later MuJoCo")
        raise


def excitation(robot, duration=15.0):
    rng = np.random.default_rng(0)
    return generate_excitation_trajectory(robot, rng, duration)


def with_heavier_link(robot):
    """The same arm carrying 30 % more at its last link."""
    return small_arms.with_link(robot, 1.3 * body_theta(robot.mj_model, robot.body_id))


@pytest.mark.parametrize(("model", "terminal", "joints"), slow_unless_quick(WHOLE_ARMS))
def test_the_arm_is_found(model, terminal, joints):
    robot = load(model)
    assert (robot.terminal_joint, robot.n_joints) == (terminal, joints)


@pytest.mark.parametrize(("model", "joints"), slow_unless_quick(DOUBTFUL))
def test_doubt_lists_the_candidates(model, joints):
    with pytest.raises(AmbiguousJointError) as caught:
        load(model)
    assert [joint for joint, _ in caught.value.candidates] == joints
    assert caught.value.exit_code == 2


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize(("model", "joint"), slow_unless_quick(CHOICES))
def test_another_link_than_the_models_is_found(model, joint):
    """Not a run that can only return the model: the arm that is simulated carries more."""
    robot = load(model, joint)
    heavier, theta = with_heavier_link(robot)
    plant = small_arms.robot_of(heavier, robot.terminal_joint)
    motion = TrajectoryOptions()
    arm = LastLinkTerms(robot)
    motions = motion_chunks(excitation(robot, motion.duration), motion.sample_rate)
    sums = arm.exact_sums(simulate_inverse(plant, motions))
    estimate = identify_parameters(sums, arm.prior)
    scale = spatial.parameter_scale(theta[0], spatial.characteristic_length(theta))
    assert np.all(np.isfinite(estimate.standard_errors[:10]))
    assert np.max(np.abs(estimate.values[:10] - theta) / scale) < 1e-6
    friction = [robot.friction.coulomb[-1], robot.friction.viscous[-1]]
    assert_allclose(estimate.values[10:], friction, rtol=0.0, atol=1e-8)


# The most different ones: ``excitation_table`` in benchmarks has all.
TO_PLAN_FOR = [
    ("franka_panda/scene.xml", None),
    ("franka_fr3/FrankaFR3_7DoF.urdf", None),
    ("universal_robots_ur5e/scene.xml", None),
    ("openarm_v2/openarm_bimanual.xml", "openarm_left_joint7"),
    ("so101/so101_new_calib.xml", None),
]
EFFORT = Effort(draws=60, rounds=6, iterations=30)


@pytest.mark.slow
@pytest.mark.parametrize(("model", "joint"), TO_PLAN_FOR)
def test_every_arm_gets_a_trajectory_it_can_run(model, joint):
    robot = load_robot_model(MODELS / model, joint=joint)
    options = ExcitationOptions(effort=EFFORT)
    problem = build_problem(robot, LimitOptions())
    knowledge = prior_knowledge(problem, EstimationOptions(), "link")
    design = Design(problem, options, TrajectoryOptions(), knowledge)
    plan = design_excitation(design, np.random.default_rng(1), Progress())
    assert keeps_limits(problem, plan)
    peaks = witness.peaks(robot, plan, 1000.0)
    limits = robot.limits
    for value, limit in (
        (peaks.highest, limits.upper),
        (-peaks.lowest, -limits.lower),
        (peaks.velocity, limits.velocity),
        (peaks.torque, limits.torque),
    ):
        assert np.all(value <= limit * (1.0 + 1e-9) + 1e-12)
    assert witness.new_contacts(robot, plan, 1000.0) == set()
    motion = plan.evaluate(design.grid[INFORMATION_POINTS])
    score = design.criterion.evaluate((motion.q, motion.qd, motion.qdd))
    draws = [draw_trajectory(design, 1, k) for k in range(EFFORT.draws)]
    assert np.exp(score) < 0.8 * np.exp(min(draw.score for draw in draws))
