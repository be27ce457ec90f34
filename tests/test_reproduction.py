"""A link that was written and loaded again moves as the identification predicts (law 5)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings

from robot_sysid.compiled.compilation import compile_model
from robot_sysid.compiled.composite import subtree_bodies
from robot_sysid.compiled.reproduction import (
    TORQUE_TOLERANCE,
    predicted_torque,
    require_reproduction,
    torque_deviation,
)
from robot_sysid.compiled.verification import reads_fullinertia_exactly, verify_written_model
from robot_sysid.errors import ExportError
from robot_sysid.export import updated_model_text
from robot_sysid.modelfile.write_back import plan_write_back
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Motion
from robot_sysid.simulator import inverse_torque
from tests import arms


def some_motion(seed: int, joints: int) -> Motion:
    q, qd, qdd = arms.random_motion(np.random.default_rng(seed), joints, 20)
    return Motion(np.arange(20.0), q, qd, qdd)


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """A three-joint arm as a file."""
    path = tmp_path_factory.mktemp("law5") / "arm.xml"
    path.write_text(arms.THREE)
    return load_robot_model(path)


@given(theta=arms.rigid_bodies(), seed=arms.SEEDS)
@settings(max_examples=100, deadline=None)
def test_any_possible_link_moves_as_predicted_once_written_and_loaded(arm, theta, seed):
    bodies = subtree_bodies(arm.mj_model, arm.reference_qpos, arm.body_id)
    plan = plan_write_back(theta, bodies)
    principal = not reads_fullinertia_exactly(plan.theta)
    text = updated_model_text(
        arm.path, arm.body_name, plan, 0.0, arm.path.parent, principal=principal
    )
    written = arm.path.with_name("written.xml")
    written.write_bytes(text)
    model = verify_written_model(arm.mj_model, written, arm.body_id, plan).mj_model
    deviation, _ = torque_deviation(arm, plan.theta, model, some_motion(seed, 3))
    assert deviation <= TORQUE_TOLERANCE


@given(seed=arms.SEEDS)
@settings(max_examples=100, deadline=None)
def test_the_prediction_for_the_models_own_link_is_its_inverse_dynamics(seed):
    robot = arms.robot_of(arms.SEVEN)
    motion = some_motion(seed, 7)
    rigid = inverse_torque(robot)(motion) - robot.friction.torque(motion.qd)
    predicted = predicted_torque(robot, robot.prior.theta, motion)
    assert np.max(np.abs(predicted - rigid)) < 1e-11 * np.max(np.abs(rigid))


@pytest.mark.parametrize("parameter", range(10))
def test_a_model_that_is_off_in_any_parameter_is_refused(arm, parameter):
    """One part in a million of the link's own size is enough."""
    theta = arm.prior.theta.copy()
    theta[parameter] += 1e-6 * (1.0 if parameter < 4 else 0.1)
    other = compile_model(arm.path).mj_model
    with pytest.raises(ExportError, match="no model was written"):
        require_reproduction(arm, theta, other, some_motion(1, 3), Path("updated_model.xml"))


def test_an_exact_model_passes(arm):
    motion = some_motion(2, 3)
    own = compile_model(arm.path).mj_model
    assert require_reproduction(arm, arm.prior.theta, own, motion, Path("m.xml")) < 1e-13
