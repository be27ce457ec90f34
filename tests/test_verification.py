"""A difference that matters is found and named; what follows from the inertia is not one."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from robot_sysid import spatial
from robot_sysid.compiled.verification import (
    reads_fullinertia_exactly,
    require_same_model,
    require_theta,
    verify_written_model,
)
from robot_sysid.errors import ExportError
from robot_sysid.modelfile.inertial_text import mjcf_inertial
from robot_sysid.modelfile.write_back import WriteBack
from tests.model_files import ARM, random_theta, write_files

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
        verify_written_model(original, source, body, WriteBack(THETA))
    source.write_text(FULL.replace('axis="1 0 0"', 'axis="0 0 0"'))
    with pytest.raises(ExportError, match="the written model cannot be loaded: MuJoCo cannot"):
        verify_written_model(original, source, body, WriteBack(THETA))


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
