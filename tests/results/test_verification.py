"""A written model differs from the original in nothing but what it was to change."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from rigs.arms import small_arms
from rigs.arms.small_arms import random_theta
from rigs.files.model_files import ARM, write_files
from robot_sysid import spatial
from robot_sysid.errors import ExportError
from robot_sysid.mjcf.inertial import mjcf_inertial
from robot_sysid.mjcf.updated_model import BodyChange, ElementChange, ModelChange
from robot_sysid.model.bodies import body_theta
from robot_sysid.model.compilation import compile_model
from robot_sysid.parser import load_robot_model
from robot_sysid.results.verification import (
    compiled_file,
    require_change,
    require_reproduction,
    require_theta,
)

# Damping ratios came with MuJoCo 3.1.
RATIO = "" if mujoco.__version__.startswith("3.0.") else 'dampratio="1"'
EXTRAS = f"""<option gravity="0 0 -9.7"/><visual><global azimuth="30"/></visual>
<tendon><fixed name="t"><joint joint="j2" coef="1"/></fixed></tendon>
<actuator><position joint="j2" kp="10" {RATIO}/><motor tendon="t"/>
<general joint="j2" biastype="affine" gainprm="20" biasprm="0 -20 0"/></actuator>
<keyframe><key qpos="0.1 0.2 0"/></keyframe></mujoco>"""
FULL = ARM.replace("</mujoco>", EXTRAS).replace(
    '<joint name="j2"',
    '<camera mode="trackcom"/><light mode="trackcom"/><joint name="j2"',
)


def model(text=FULL):
    """The compiled model of an MJCF text."""
    return mujoco.MjModel.from_xml_string(text)


def require_same_after_edit(original_text, replacement):
    """Require that the model with one text replaced differs in the inertia of link2 alone."""
    original = model()
    other = model(FULL.replace(original_text, replacement))
    body = original.body("link2").id
    written = BodyChange("link2", body, body_theta(other, body))
    require_change(original, other, ModelChange((written,), 0.0))


@pytest.mark.parametrize(
    ("original_text", "replacement"),
    [
        ('pos="0 0 0.1" quat="0.9 0.1 0.2 0.3"', 'pos="0.3 0 0.1"'),
        ('mass="1.5"', 'mass="2.5"'),
        (
            'diaginertia="2e-3 3e-3 4e-3"/>\n          <geom',
            'diaginertia="9 9 9"/>\n<geom',
        ),
        ('quat="0.9 0.1 0.2 0.3" mass="1.5"', 'mass="1.5"'),
    ],
)
def test_the_inertia_of_the_terminal_body_may_differ_with_all_that_follows(
    original_text, replacement
):
    require_same_after_edit(original_text, replacement)


@pytest.mark.parametrize(
    ("original_text", "replacement", "field"),
    [
        ('mass="0.2"', 'mass="0.21"', "body_mass"),
        ('pos="0 0 0.3"', 'pos="0 0 0.31"', "body_pos"),
        ('name="j2" axis="1 0 0"', 'name="j2" axis="0 1 0"', "jnt_axis"),
        ('<joint name="j2"', '<joint damping="3" name="j2"', "dof_damping"),
        ('name="tool"', 'name="tuul"', "names"),
        ('size="0.02 0.1"', 'size="0.02 0.11"', "geom_"),
        ('kp="10"', 'kp="11"', "actuator_"),
        ('"0 -20 0"', '"1 -20 0"', "actuator_biasprm"),
        ('"0 -20 0"', '"0 -21 0"', "actuator_biasprm"),
        ("-9.7", "-9.8", "opt.gravity"),
        ('azimuth="30"', 'azimuth="31"', "vis.global_.azimuth"),
        ('qpos="0.1', 'qpos="0.2', "key_"),
        ('<geom size="0.1"/>', '<geom size="0.1"/><site/>', "n"),
    ],
)
def test_any_other_difference_is_refused_by_name(original_text, replacement, field):
    assert original_text in FULL
    with pytest.raises(ExportError, match=f"has another {field}") as caught:
        require_same_after_edit(original_text, replacement)
    assert "\n" not in str(caught.value)


THETA = random_theta(np.random.default_rng(3), 1.5)


def compile_body(theta):
    """A model of one body with these parameters (10,)."""
    inertial = mjcf_inertial(theta, principal=True)
    return model(
        f"<mujoco><worldbody><body name='b'>{inertial}</body></worldbody></mujoco>"
    )


@pytest.mark.parametrize("k", range(10))
def test_a_parameter_that_is_off_by_more_than_a_billionth_is_found(k):
    require_theta(compile_body(THETA), 1, THETA, THETA)
    size = spatial.parameter_scale(THETA[0], spatial.characteristic_length(THETA))
    wrong_theta = THETA + 3e-9 * size * (np.arange(10) == k)
    with pytest.raises(ExportError, match=r"body 'b' has an inertia that is off by"):
        require_theta(compile_body(THETA), 1, wrong_theta, THETA)


def test_an_error_of_a_small_inertia_far_from_the_origin_is_relative_to_it():
    small, other = (
        spatial.theta_from_com(1.0, np.array([1.0, 0.0, 0.0]), size * np.eye(3))
        for size in (1e-6, 1.001e-6)
    )
    with pytest.raises(ExportError, match="off by 1.0e-03"):
        require_theta(compile_body(other), 1, small, small)


def test_a_frame_without_mass_is_compared_in_si_units():
    """Exporters give such a frame an inertia that the written model leaves out."""
    frame = np.append(np.zeros(4), 1e-6 * np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0]))
    empty = model("<mujoco><worldbody><body/></worldbody></mujoco>")
    require_theta(empty, 1, np.zeros(10), frame)
    with pytest.raises(ExportError, match="off by 2.0e-09"):
        require_theta(empty, 1, np.append(2e-9, np.zeros(9)), frame)


def test_a_file_that_does_not_load_or_was_tampered_with_is_refused(tmp_path):
    source = write_files(tmp_path, {"m.xml": FULL})
    original = mujoco.MjModel.from_xml_path(str(source))
    body = original.body("link2").id
    change = ModelChange((BodyChange("link2", body, THETA),), 0.0)
    with pytest.raises(ExportError, match="'link2' has an inertia that is off"):
        require_change(original, compiled_file(source), change)
    source.write_text(FULL.replace('axis="1 0 0"', 'axis="0 0 0"'))
    with pytest.raises(
        ExportError, match="the written model cannot be loaded: MuJoCo cannot"
    ):
        require_change(original, compiled_file(source), change)


def test_gravity_may_differ_only_where_it_was_written_and_only_as_written():
    models = model(), model(FULL.replace("-9.7", "-9.8"))
    for gravity in (None, (0.0, 0.0, -9.8 + 1e-8), (1e-8, 0.0, -9.8)):
        with pytest.raises(ExportError, match="has another opt.gravity"):
            require_change(*models, ModelChange((), 0.0, gravity=gravity))
    require_change(*models, ModelChange((), 0.0, gravity=(0.0, 0.0, -9.8)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            ElementChange("joint", "j{1}", {"armature": 0.7}),
            "has another dof_armature than",
        ),
        (
            ElementChange("joint", "j{1}", {"damping": 0.7}),
            "has another dof_damping than it should have; a joint's springdamper",
        ),
        (
            ElementChange("actuator", 0, {"kp": 5.0, "kv": 1.0}),
            "another actuator_biasprm than it should have; give the actuator",
        ),
        (
            ElementChange("actuator", 0, {"kp": 10.0, "kv": 1.0}),
            "has another actuator_biasprm than",
        ),
    ],
)
def test_a_joint_or_actuator_without_its_new_number_is_refused_by_name(change, message):
    """The joint's name has braces, which mean something in formats."""
    text = FULL.replace('"j1"', '"j{1}"').replace(RATIO, "")
    with pytest.raises(ExportError, match=re.escape(message)):
        require_change(model(text), model(text), ModelChange((), 0.0, (change,)))


FORCE = 'forcerange="-2 2"'
FIRM = 'solimpfriction=".99 .99"'


@pytest.mark.parametrize(
    ("change", "right", "wrong_numbers"),
    [
        (
            ElementChange("actuator", 0, {"kp": 10.0, "forcerange": 2.0}),
            ('kp="10"', f'kp="10" {FORCE}'),
            ("", 'forcerange="-2 2.1"', 'forcerange="-1 2"'),
        ),
        (
            ElementChange("actuator", 0, {"kp": 10.0, "forcerange": 2.0}),
            ('kp="10"', f'kp="10" {FORCE}'),
            ('forcerange="-2 2" forcelimited="false"',),
        ),
        (
            ElementChange("joint", "j2", {"solimpfriction": 0.99}),
            ('name="j2"', f'name="j2" {FIRM}'),
            ("", 'solimpfriction=".99 .98"', 'solimpfriction=".99 .99 .002"'),
        ),
    ],
)
def test_a_largest_force_and_firm_friction_are_refused_where_others_compile(
    change, right, wrong_numbers
):
    text = FULL.replace(RATIO, "")
    old, new = right
    original = model(text)
    wanted = ModelChange((), 0.0, (change,))
    require_change(original, model(text.replace(old, new)), wanted)
    stated = new.removeprefix(f"{old} ")
    for wrong in wrong_numbers:
        other = model(text.replace(old, new.replace(stated, wrong)))
        with pytest.raises(
            ExportError, match="has another (actuator_force|dof_solimp)"
        ):
            require_change(original, other, wanted)
    # A model that got the numbers without being asked is refused as well.
    with pytest.raises(ExportError, match="has another (actuator_force|dof_solimp)"):
        require_change(original, model(text.replace(old, new)), ModelChange((), 0.0))


@pytest.fixture(scope="module")
def three_joints(tmp_path_factory):
    """A three-joint arm as a file."""
    path = tmp_path_factory.mktemp("law5") / "arm.xml"
    path.write_text(small_arms.THREE)
    return load_robot_model(path)


def is_refused_for_torque(robot, mj_model, thetas=None, change=None):
    """Whether a compiled model is refused for its torque."""
    thetas = robot.thetas if thetas is None else thetas
    change = change or ModelChange((), 0.0)
    motion = small_arms.seeded_motion(1, robot.n_joints)
    try:
        require_reproduction(
            robot, thetas, change, mj_model, motion, Path("updated_model.xml")
        )
    except ExportError as error:
        assert "does not reproduce the identified torques" in str(error)
        return True
    return False


@pytest.mark.parametrize("link", range(3))
def test_a_model_that_is_off_in_any_parameter_is_refused(three_joints, link):
    """One part in a million of the link's own size is enough, where its joint can tell."""
    mj_model = compile_model(three_joints.path).mj_model
    for parameter in range(10):
        thetas = three_joints.thetas
        thetas[link, parameter] += 1e-6 * (1.0 if parameter < 4 else 0.1)
        # A link that turns about the vertical shows its moment about it alone.
        assert is_refused_for_torque(three_joints, mj_model, thetas) == (
            link > 0 or parameter == 9
        )


SMALL = 1e-7


@pytest.mark.parametrize(
    "change",
    [
        ModelChange((), 0.0, gravity=(SMALL, 0.0, -9.81)),
        ModelChange((), 0.0, gravity=(0.0, 0.0, -9.81 + SMALL)),
        ModelChange((), 0.0, (ElementChange("joint", "joint2", {"armature": SMALL}),)),
    ],
)
def test_a_change_that_the_file_lacks_is_found_by_its_torque(three_joints, change):
    assert is_refused_for_torque(
        three_joints, compile_model(three_joints.path).mj_model, change=change
    )
