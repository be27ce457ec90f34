"""Public models of real arms: each gets a trajectory that breaks no limit and touches nothing.

Skipped where the models are not beside the checkout. Checked at 1 kHz by code the search does not
use: the model's own limits, and contacts as MuJoCo reports them.
"""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.model.contacts import find_new_contacts
from robot_sysid.motion.design.optimise import Design
from robot_sysid.motion.design.search import design_excitation
from robot_sysid.motion.options import ExcitationOptions, LimitOptions
from robot_sysid.motion.problem import build_problem
from robot_sysid.parser import load_robot_model
from robot_sysid.simulator import ArmTorque
from robot_sysid.trajectory import TrajectoryOptions, motion_chunks
from tests.support.places import GUESS, MODELS

# One model per arm, some with a floor or a table; ``excitation_table`` in benchmarks has all.
ARMS = [
    ("kinova_gen3/gen3.xml", None),
    ("franka_panda/panda.xml", None),
    ("franka_panda/scene.xml", None),
    ("franka_fr3/FrankaFR3_7DoF.urdf", None),
    ("kuka_iiwa_14/iiwa14.xml", None),
    ("universal_robots_ur5e/scene.xml", None),
    ("ufactory_xarm7/xarm7.xml", None),
    ("trossen/wxai/wxai_follower.xml", None),
    ("openarm_v2/openarm_bimanual.xml", "openarm_left_joint7"),
    ("aloha/aloha.xml", "left/wrist_rotate"),
    ("aloha/scene.xml", "right/wrist_rotate"),
    ("so101/so101_new_calib.xml", "wrist_roll"),
    ("so101/so101_new_calib.urdf", "gripper"),
]
QUICK = {"draws": 60, "starts": 1, "rounds": 6, "iterations": 30}


def violations(robot, plan):
    """Sentences on limits of the model that a trajectory breaks at 1 kHz."""
    limits, torque = robot.limits, ArmTorque(robot)
    for motion in motion_chunks(plan, 1000.0):
        for name, value, limit in (
            ("upper", motion.q, limits.upper),
            ("lower", -motion.q, -limits.lower),
            ("velocity", np.abs(motion.qd), limits.velocity),
            ("torque", np.abs(torque(motion)), limits.torque),
        ):
            for k, j in np.argwhere(value > limit * (1.0 + 1e-9) + 1e-12):
                yield f"{name} of {robot.joint_names[j]} at {motion.time[k]:.3f} s"


def search(path, joint=None, **limits):
    robot, options = load_robot_model(path, joint=joint), ExcitationOptions(**QUICK)
    motion = TrajectoryOptions()
    top = options.basis(motion.duration).top_frequency_hz
    problem = build_problem(robot, LimitOptions(**limits), top_frequency_hz=top)
    result = design_excitation(Design(problem, options, motion), np.random.default_rng(1))
    return robot, problem, result


@pytest.mark.slow
@pytest.mark.skipif(not MODELS.is_dir(), reason="the public models are not here")
@pytest.mark.parametrize(("model", "joint"), ARMS)
def test_every_arm_gets_a_trajectory_it_can_run(model, joint):
    robot, _, result = search(MODELS / model, joint)
    assert result.limit_check.holds
    assert list(violations(robot, result.trajectory)) == []
    assert find_new_contacts(robot, motion_chunks(result.trajectory, 1000.0)) == ()
    assert result.objective < 0.8 * result.start_objective


@pytest.mark.slow
def test_a_floor_and_a_second_plane_are_kept(tmp_path):
    planes = ((0.0, 0.0, 1.0, 0.0), (1.0, 0.0, 0.0, -0.4))
    robot, problem, result = search(GUESS, keep_out=planes)
    _, _, free = search(GUESS)
    assert list(violations(robot, result.trajectory)) == []
    for motion in motion_chunks(result.trajectory, 100.0):
        assert np.min(problem.obstacles.slack(motion.q).value) >= 0.0
    crossed = [
        np.min(problem.obstacles.slack(motion.q).value)
        for motion in motion_chunks(free.trajectory, 100.0)
    ]
    assert min(crossed) < 0.0, "without planes this arm goes there, so the test can fail"
