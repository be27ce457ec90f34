"""A difference that matters is found and named; what follows from the inertia is not one."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.kinematics import ChainKinematics
from robot_sysid.errors import ExportError
from robot_sysid.mjcf.inertial import mjcf_inertial
from robot_sysid.mjcf.updated_model import updated_model_text
from robot_sysid.mjcf.write_back import WriteBack, plan_write_back
from robot_sysid.model.compilation import compile_model
from robot_sysid.model.inertia import subtree_bodies
from robot_sysid.output.verification import (
    TORQUE_TOLERANCE,
    reads_fullinertia_exactly,
    require_reproduction,
    require_same_model,
    require_theta,
    torque_deviation,
    verify_written_model,
)
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Motion
from robot_sysid.regressor import joint_torque
from robot_sysid.simulator import ArmTorque
from tests.support import arms
from tests.support.model_files import ARM, random_theta, write_files

# Damping ratios came with MuJoCo 3.1.
RATIO = "" if mujoco.__version__.startswith("3.0.") else 'dampratio="1"'
EXTRAS = f"""<option gravity="0 0 -9.7"/><visual><global azimuth="30"/></visual>
<tendon><fixed name="t"><joint joint="j2" coef="1"/></fixed></tendon>
<actuator><position joint="j2" kp="10" {RATIO}/><motor tendon="t"/></actuator>
<keyframe><key qpos="0.1 0.2 0"/></keyframe></mujoco>"""
FULL = ARM.replace("</mujoco>", EXTRAS).replace(
    '<joint name="j2"', '<camera mode="trackcom"/><light mode="trackcom"/><joint name="j2"'
)


def model(text=FULL):
    return mujoco.MjModel.from_xml_string(text)


def compare(before: str, after: str):
    original = model()
    require_same_model(original, model(FULL.replace(before, after)), {original.body("link2").id})


def with_servo(bias):
    """The model with an actuator whose force is affine in length and speed."""
    servo = f'<general joint="j2" biastype="affine" gainprm="10" biasprm="{bias}"/></actuator>'
    return model(FULL.replace("</actuator>", servo))


@pytest.mark.parametrize("bias", ["1 -10 0", "0 -11 0"])
def test_an_actuators_own_force_and_stiffness_may_not_change(bias):
    require_same_model(with_servo("0 -10 0"), with_servo("0 -10 0"), set())
    with pytest.raises(ExportError, match="differs from the original in actuator_biasprm"):
        require_same_model(with_servo("0 -10 0"), with_servo(bias), set())


@pytest.mark.skipif(not RATIO, reason="this MuJoCo knows no damping ratios")
def test_a_damping_that_follows_from_the_inertia_may_change():
    heavier = model(FULL.replace('mass="1.5"', 'mass="9.5"'))
    damping = [m.actuator_biasprm[0, 2] for m in (model(), heavier)]
    assert damping[1] < damping[0] < 0.0
    require_same_model(model(), heavier, {heavier.body("link2").id})


def test_a_model_is_the_same_as_itself():
    require_same_model(model(), model(), set())


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ('pos="0 0 0.1" quat="0.9 0.1 0.2 0.3"', 'pos="0.3 0 0.1"'),
        ('mass="1.5"', 'mass="2.5"'),
        ('diaginertia="2e-3 3e-3 4e-3"/>\n          <geom', 'diaginertia="9 9 9"/>\n<geom'),
        ('quat="0.9 0.1 0.2 0.3" mass="1.5"', 'mass="1.5"'),
    ],
)
def test_the_inertia_of_the_terminal_body_may_differ_with_all_that_follows(before, after):
    compare(before, after)


@pytest.mark.parametrize(
    ("before", "after", "field"),
    [
        ('mass="0.2"', 'mass="0.21"', "body_mass"),
        ('mass="0.1"', 'mass="0.11"', "body_mass"),
        ('pos="0 0 0.3"', 'pos="0 0 0.31"', "body_pos"),
        ('name="j2" axis="1 0 0"', 'name="j2" axis="0 1 0"', "jnt_axis"),
        ('name="j2" axis', 'name="j2" damping="1" axis', "dof_damping"),
        ('name="tool"', 'name="tuul"', "names"),
        ('size="0.02 0.1"', 'size="0.02 0.11"', "geom_"),
        ('kp="10"', 'kp="11"', "actuator_"),
        ("-9.7", "-9.8", "opt.gravity"),
        ('azimuth="30"', 'azimuth="31"', "vis.global_.azimuth"),
        ('qpos="0.1', 'qpos="0.2', "key_"),
        ('<geom size="0.1"/>', '<geom size="0.1"/><site/>', "n"),
    ],
)
def test_every_other_difference_is_named(before, after, field):
    assert before in FULL
    with pytest.raises(ExportError, match=f"differs from the original in {field}") as caught:
        compare(before, after)
    assert "\n" not in str(caught.value)


THETA = random_theta(np.random.default_rng(3), 1.5)


def compiled(theta):
    inertial = mjcf_inertial(theta, principal=True)
    return model(f"<mujoco><worldbody><body name='b'>{inertial}</body></worldbody></mujoco>")


@pytest.mark.parametrize("k", range(10))
def test_a_parameter_that_is_off_by_more_than_a_billionth_is_found(k):
    require_theta(compiled(THETA), 1, THETA, THETA)
    off = THETA.copy()
    off[k] += 3e-9 * spatial.parameter_scale(THETA[0], spatial.characteristic_length(THETA))[k]
    with pytest.raises(ExportError, match=r"body 'b' has an inertia that is off by"):
        require_theta(compiled(THETA), 1, off, THETA)


def test_a_small_inertia_far_from_the_origin_is_held_to_its_own_size():
    small = spatial.theta_from_com(1.0, np.array([1.0, 0.0, 0.0]), 1e-6 * np.eye(3))
    other = spatial.theta_from_com(1.0, np.array([1.0, 0.0, 0.0]), 1.001e-6 * np.eye(3))
    with pytest.raises(ExportError, match="off by 1.0e-03"):
        require_theta(compiled(other), 1, small, small)


def test_a_file_that_does_not_load_or_was_tampered_with_is_refused(tmp_path):
    source = write_files(tmp_path, {"m.xml": FULL})
    original = mujoco.MjModel.from_xml_path(str(source))
    body = original.body("link2").id
    with pytest.raises(ExportError, match="'link2' has an inertia that is off"):
        verify_written_model(original, source, {body: WriteBack(THETA)})
    source.write_text(FULL.replace('axis="1 0 0"', 'axis="0 0 0"'))
    with pytest.raises(ExportError, match="the written model cannot be loaded: MuJoCo cannot"):
        verify_written_model(original, source, {body: WriteBack(THETA)})


def test_whether_mujoco_finds_axes_accurately_is_measured():
    diagonal = spatial.theta_from_com(1.0, np.zeros(3), np.diag([1.0, 2.0, 2.5]))
    assert reads_fullinertia_exactly(diagonal)
    text = f"<mujoco><worldbody><body>{mjcf_inertial(THETA)}</body></worldbody></mujoco>"
    try:
        require_theta(model(text), 1, THETA, THETA, 1e-12)
        accurate = True
    except ExportError:
        accurate = False
    assert reads_fullinertia_exactly(THETA) == accurate


def test_a_difference_that_a_springdamper_makes_says_so():
    with pytest.raises(ExportError, match="springdamper computes it from the inertia"):
        compare('<joint name="j2"', '<joint damping="3" name="j2"')


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
def test_any_possible_link_moves_as_predicted_once_written_and_loaded(arm, theta, seed):
    bodies = subtree_bodies(arm.mj_model, arm.reference_qpos, arm.body_id)
    plan = plan_write_back(theta, bodies)
    principal = not reads_fullinertia_exactly(plan.theta)
    text = updated_model_text(
        arm.path, arm.body_name, plan, 0.0, arm.path.parent, principal=principal
    )
    written = arm.path.with_name("written.xml")
    written.write_bytes(text)
    model = verify_written_model(arm.mj_model, written, {arm.body_id: plan}).mj_model
    deviation, _ = torque_deviation(arm, plan.theta, model, some_motion(seed, 3))
    assert deviation <= TORQUE_TOLERANCE


@given(seed=arms.SEEDS)
def test_the_prediction_for_the_models_own_link_is_its_inverse_dynamics(seed):
    robot = arms.robot_of(arms.SEVEN)
    motion = some_motion(seed, 7)
    rigid = ArmTorque(robot)(motion) - robot.friction.torque(motion.qd)
    body = ChainKinematics(robot).evaluate(motion.q, motion.qd, motion.qdd)
    predicted = joint_torque(body, robot.prior.theta)
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
    require_reproduction(arm, arm.prior.theta, own, motion, Path("m.xml"))
    assert torque_deviation(arm, arm.prior.theta, own, motion)[0] < 1e-13
