"""The joint that MuJoCo numbers k is the one that is changed, whatever the file's order."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from robot_sysid.errors import ExportError
from robot_sysid.mjcf.documents import read_document
from robot_sysid.mjcf.edits import Edits
from robot_sysid.mjcf.updated_model import find_joint, write_actuator, write_joint
from robot_sysid.mjcf.write_back import ActuatorChange, JointChange
from tests.support.model_files import (
    INERTIAL,
    urdf_inertial,
    urdf_joint,
    urdf_link,
    urdf_robot,
    write_files,
)
from tests.support.releases import since

# A child body before the joint of its parent, frames, a free joint, joints elsewhere in the file.
MIXED = f"""<mujoco>
  <default><joint damping="0.5" armature="0.01"/></default>
  <worldbody>
    <body><freejoint/>{INERTIAL}</body>
    <body>
      <body>
        <frame pos="0 0 1"><joint type="slide"/><frame><joint axis="0 1 0"/></frame></frame>
        {INERTIAL}
      </body>
      <joint axis="1 0 0"
             frictionloss="0.3"/>
      {INERTIAL}
      <body><joint name="last" axis="0 1 1"/>{INERTIAL}</body>
    </body>
  </worldbody>
  <equality><joint joint1="last"/></equality>
  <tendon><fixed><joint joint="last" coef="1"/></fixed></tendon>
</mujoco>
"""


def changed(document, *changes):
    edits = Edits(document)
    for change in changes:
        write_joint(edits, change)
    return edits.text().decode()


@pytest.mark.parametrize("joint", [1, 2, 3, 4])
@since(3, 1)
def test_a_joint_is_found_by_its_number(tmp_path, joint):
    document = read_document(write_files(tmp_path, {"m.xml": MIXED}))
    label = "last" if joint == 4 else f"#{joint}"
    text = changed(document, JointChange(label, 1.25, 2.5, 3.75))
    before, after = (mujoco.MjModel.from_xml_string(xml) for xml in (MIXED, text))
    dof = before.jnt_dofadr[joint]
    for field, value in (("armature", 1.25), ("damping", 2.5), ("frictionloss", 3.75)):
        expected = getattr(before, f"dof_{field}").copy()
        expected[dof] = value
        np.testing.assert_array_equal(getattr(after, f"dof_{field}"), expected)


def test_every_digit_is_written(tmp_path):
    document = read_document(write_files(tmp_path, {"m.xml": MIXED}))
    text = changed(document, JointChange("last", damping=np.float64(0.1) + 0.2))
    assert 'damping="0.30000000000000004"' in text


def test_nonlinear_damping_behind_the_linear_one_stays(tmp_path):
    text = MIXED.replace('name="last"', 'name="last" damping=".5 .3  .2"')
    document = read_document(write_files(tmp_path, {"m.xml": text}))
    assert 'damping="2.5 .3 .2"' in changed(document, JointChange("last", damping=2.5))


@pytest.mark.parametrize("value", [-1e-6, np.nan, np.inf])
def test_a_joint_that_would_drive_itself_is_refused(tmp_path, value):
    document = read_document(write_files(tmp_path, {"m.xml": MIXED}))
    with pytest.raises(ExportError, match="joint 'last' cannot get armature"):
        changed(document, JointChange("last", armature=value))


def test_nothing_is_written_where_nothing_is_new(tmp_path):
    document = read_document(write_files(tmp_path, {"m.xml": MIXED}))
    assert changed(document, JointChange("last")) == MIXED


@pytest.mark.parametrize("label", ["first", "#9", "#x", ""])
def test_a_joint_that_is_not_there_is_refused(tmp_path, label):
    document = read_document(write_files(tmp_path, {"m.xml": MIXED}))
    with pytest.raises(ExportError, match="is not written out in the file"):
        find_joint(document, label)


@pytest.mark.parametrize("label", ["last", "#1"])
def test_a_joint_that_is_repeated_or_past_a_repetition_is_refused(tmp_path, label):
    text = MIXED.replace("<body>\n      <body>", '<replicate count="2"><body>\n      <body>')
    text = text.replace("</body>\n  </worldbody>", "</body></replicate>\n  </worldbody>")
    document = read_document(write_files(tmp_path, {"m.xml": text}))
    with pytest.raises(ExportError, match="attached, repeated or generated part"):
        find_joint(document, label)


def test_a_name_that_stands_twice_is_refused(tmp_path):
    text = MIXED.replace('<joint type="slide"', '<joint name="last" type="slide"')
    document = read_document(write_files(tmp_path, {"m.xml": text}))
    with pytest.raises(ExportError, match="stands in the file 2 times"):
        find_joint(document, "last")


URDF = urdf_robot(
    urdf_link("base"),
    urdf_link("l1", urdf_inertial()),
    urdf_link("l2", urdf_inertial()),
    urdf_joint("base", "l1"),
    urdf_joint("l1", "l2").replace("</joint>", '<dynamics damping="0.7" friction="0.2"/></joint>'),
)


def test_a_urdf_gets_its_dynamics_element(tmp_path):
    document = read_document(write_files(tmp_path, {"m.urdf": URDF}))
    changes = [JointChange("base_l1", damping=1.5, frictionloss=0.5), JointChange("l1_l2", None, 3)]
    model = mujoco.MjModel.from_xml_string(changed(document, *changes))
    np.testing.assert_array_equal(model.dof_damping, [1.5, 3.0])
    np.testing.assert_array_equal(model.dof_frictionloss, [0.5, 0.2])
    assert changed(document, JointChange("base_l1")) == URDF


def test_a_urdf_cannot_hold_rotor_inertia(tmp_path):
    document = read_document(write_files(tmp_path, {"m.urdf": URDF}))
    with pytest.raises(ExportError, match="cannot hold the rotor inertia of joint 'l1_l2'"):
        write_joint(Edits(document), JointChange("l1_l2", armature=0.1))


@pytest.mark.skipif(not hasattr(mujoco.MjModel, "dof_dampingpoly"), reason="MuJoCo before 3.7")
def test_nonlinear_damping_is_written_where_it_was_found(tmp_path):
    document = read_document(write_files(tmp_path, {"m.xml": MIXED}))
    text = changed(document, JointChange("last", damping=1.0, polynomial=(2.0, 3.0)))
    model = mujoco.MjModel.from_xml_string(text)
    dof = model.joint("last").dofadr[0]
    assert model.dof_damping[dof] == 1.0
    np.testing.assert_array_equal(model.dof_dampingpoly[dof], (2.0, 3.0))
    # The joint brakes by 1 v + 2 v |v| + 3 v^3.
    data = mujoco.MjData(model)
    data.qvel[dof] = -2.0
    mujoco.mj_forward(model, data)
    assert data.qfrc_passive[dof] == pytest.approx(2.0 + 8.0 + 24.0)


def test_nonlinear_damping_that_drives_is_refused(tmp_path):
    document = read_document(write_files(tmp_path, {"m.xml": MIXED}))
    with pytest.raises(ExportError, match="cannot get nonlinear damping"):
        changed(document, JointChange("last", damping=1.0, polynomial=(2.0, -3.0)))


SERVOS = f"""<mujoco>
  <default><position kp="7" kv="1"/><default class="weak"><position kp="3"/></default></default>
  <worldbody>
    <body><joint name="a"/>{INERTIAL}<body><joint name="b"/>{INERTIAL}</body></body>
  </worldbody>
  <actuator><motor joint="a"/><position class="weak" joint="a"/></actuator>
  <actuator><general joint="b" gainprm="5" biastype="affine" biasprm="0 -5 -2"/></actuator>
</mujoco>"""


@since(3, 1)
def test_gains_are_written_into_the_actuator_that_mujoco_numbers(tmp_path):
    path = write_files(tmp_path, {"arm.xml": SERVOS})
    edits = Edits(read_document(path))
    for change in (ActuatorChange(1, 40.0, 4.0), ActuatorChange(2, 50.0, 0.0)):
        write_actuator(edits, change)
    model = mujoco.MjModel.from_xml_string(edits.text().decode())
    before = mujoco.MjModel.from_xml_string(SERVOS)
    assert model.actuator_gainprm[:, 0].tolist() == [1.0, 40.0, 50.0]
    assert model.actuator_biasprm[1:, :3].tolist() == [[0.0, -40.0, -4.0], [0.0, -50.0, 0.0]]
    np.testing.assert_array_equal(model.dof_damping, before.dof_damping)
    for number in (0, 3):
        with pytest.raises(ExportError, match=f"actuator number {number} is not written out"):
            write_actuator(edits, ActuatorChange(number, 1.0, 1.0))


@pytest.mark.parametrize("angle", ["radian", "degree"])
@pytest.mark.parametrize("kind", ["hinge", "slide"])
@pytest.mark.parametrize("offset", [0.3, -0.02])
def test_an_offset_is_a_spring_so_far_away_that_it_hardly_changes(tmp_path, angle, kind, offset):
    text = (
        f'<mujoco><compiler angle="{angle}"/><worldbody><body>'
        f'<joint name="j" type="{kind}" frictionloss="1"/>{INERTIAL}</body></worldbody></mujoco>'
    )
    document = read_document(write_files(tmp_path, {"m.xml": text}))
    model = mujoco.MjModel.from_xml_string(changed(document, JointChange("j", offset=offset)))
    data = mujoco.MjData(model)
    for q in (-3.0, 0.0, 3.0):
        data.qpos[0] = q
        mujoco.mj_forward(model, data)
        assert -data.qfrc_passive[0] == pytest.approx(offset, rel=3.1e-3)
    assert JointChange("j").spring is None
