"""The text of a written model: inertia, gravity or joints' numbers go in, all else stays as it was.

The joint that MuJoCo numbers k is the one that is changed, whatever the file's order.
"""

from __future__ import annotations

import difflib
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from rigs.arms import small_arms
from rigs.arms.small_arms import random_theta
from rigs.files import urdf
from rigs.files.model_files import (
    ARM,
    INERTIAL,
    TETRAHEDRON,
    document_of,
    write_and_verify,
    write_files,
)
from rigs.files.places import SHARED
from rigs.files.refusals import refused
from rigs.files.releases import IS_PRINCIPAL, since
from robot_sysid.errors import ExportError
from robot_sysid.mjcf.documents import read_document
from robot_sysid.mjcf.inertial import plan_write_back
from robot_sysid.mjcf.updated_model import (
    BodyChange,
    ElementChange,
    ModelChange,
    changed_model_text,
    write_element,
)
from robot_sysid.mjcf.urdf import inertia_increases
from robot_sysid.model.bodies import subtree_bodies
from robot_sysid.model.chain import find_terminal_joint
from robot_sysid.model.compilation import compile_model

THETA = random_theta(np.random.default_rng(1), 2.0)


def write_composite(source, label, composite, target):
    """Give a body what makes it and all below it this composite, in a verified file."""
    original = compile_model(source).mj_model
    body = int(label[1:]) if label.startswith("#") else original.body(label).id
    plan = plan_write_back(composite, subtree_bodies(original, original.qpos0, body))
    assert not plan.emptied
    write_and_verify(source, change_of(label, plan.theta, body), target)


def change_of(label, theta, body=0):
    bodies = (BodyChange(label, body, theta),)
    return ModelChange(bodies, 1.23e-4, principal=IS_PRINCIPAL)


def test_only_the_inertial_and_the_comment_change(tmp_path):
    document = document_of(tmp_path, ARM.replace("\n", "\r\n"))
    change = replace(change_of("link2", THETA), principal=False)
    text = changed_model_text(document.path, change, tmp_path / "out").decode()
    lines = document.text().decode().splitlines(keepends=True)
    difference = list(difflib.ndiff(lines, text.splitlines(keepends=True)))
    (removed,) = [line[2:].split() for line in difference if line.startswith("- ")]
    comment, inertial = [line[2:] for line in difference if line.startswith("+ ")]
    assert removed[0] == "<inertial"
    assert comment == (
        "        <!-- System ID: body 'link2' identified with RMSE 0.000123 Nm -->\r\n"
    )
    assert (
        inertial.startswith("          <inertial pos=") and "fullinertia=" in inertial
    )
    assert "quat" not in inertial and "diaginertia" not in inertial


def test_its_own_output_can_be_exported_again(tmp_path):
    source = write_files(tmp_path, {"m.xml": ARM})
    first = tmp_path / "a" / "m.xml"
    second = tmp_path / "b" / "c" / "m.xml"
    write_composite(source, "link2", 2.0 * THETA, first)
    write_composite(first, "link2", 2.0 * THETA, second)
    assert second.read_bytes() == first.read_bytes()
    assert second.read_bytes().count(b"System ID") == 1


INCLUDING = {
    "scene.xml": '<mujoco>\n<include file="parts/arm.xml"/>\n<include file="parts/size.xml"/>\n'
    "<worldbody/></mujoco>",
    "parts/arm.xml": '<mujoco><compiler assetdir="files"/><asset><mesh name="m" file="m.obj"/>'
    '</asset><worldbody><include file="link.xml"/></worldbody></mujoco>',
    "parts/link.xml": f"<all><body><joint/>{INERTIAL}<geom type='mesh' mesh='m'/></body></all>",
    "parts/size.xml": '<mujoco><option gravity="0 0 -5"/><!-- kept --></mujoco>',
    "files/m.obj": TETRAHEDRON,
}


@pytest.mark.parametrize("folder", ["out", "in/parts", "in"])
@since(3, 1, 6)
def test_a_nameless_body_in_an_include_is_changed_and_its_files_are_found(
    tmp_path, folder
):
    source = write_files(tmp_path / "in", INCLUDING)
    sources = (source, tmp_path / "in/parts/link.xml")
    contents = [path.read_bytes() for path in sources]
    target = tmp_path / folder / "updated.xml"
    write_composite(source, "#1", THETA, target)
    text = changed_model_text(source, CHANGE, target.parent).decode()
    assert "in place of 0 0 -5" in text and text.count("gravity=") == 1
    assert contents == [path.read_bytes() for path in sources]
    assert b"<include" not in target.read_bytes() and b"kept" in target.read_bytes()


WITHOUT_ONE_TERMINAL = (
    "left/gripper_link",
    "openarm_left_ee_base_link",
    "moving_jaw_so101_v1",
    "moving_jaw_so101_v1_link",
)


def terminal_label(mj_model) -> str:
    """The terminal body of a public model; one of them where the tool would ask."""
    names = [mj_model.body(i).name for i in range(mj_model.nbody)]
    for name in WITHOUT_ONE_TERMINAL:
        if name in names:
            return name
    return names[mj_model.jnt_bodyid[find_terminal_joint(mj_model)]]


MODELS = [
    path
    for path in (
        *sorted(SHARED.glob("models/**/*.xml")),
        *sorted(SHARED.glob("**/*.urdf")),
    )
    if not path.stem.endswith(
        ("actuators", "keyframe_ctrl", "no_act", "properties", "hand")
    )
    or path.stem.endswith("nohand")
]


@pytest.mark.slow
@pytest.mark.skipif(not MODELS, reason="no public models here")
@pytest.mark.parametrize("path", MODELS, ids=lambda p: f"{p.parent.name}/{p.name}")
def test_public_models_keep_everything_but_the_inertia(tmp_path, path):
    original = compile_model(path).mj_model
    label = terminal_label(original)
    theta = (
        small_arms.composite_theta(original, original.qpos0, original.body(label).id)
        + 0.2 * THETA
    )
    first = tmp_path / "a" / path.name
    second = tmp_path / "b" / "c" / path.name
    write_composite(path, label, theta, first)
    write_composite(first, label, theta, second)
    assert second.read_bytes().count(b"System ID") == 1


@pytest.mark.parametrize(
    "content", ["", urdf.inertial(inertia="-0.001 0.02 0.02", rpy="0.3 0 0")]
)
def test_a_link_that_mujoco_refuses_does_not_keep_the_written_urdf_from_loading(
    tmp_path, content
):
    links = {"l1": content, "l2": urdf.inertial(2.0) + urdf.mesh("visual", "a.dae")}
    text = urdf.robot(urdf.serial(links))
    source = write_files(tmp_path, {"m.urdf": text})
    target = tmp_path / "out" / "u.urdf"
    with pytest.raises(ValueError):
        mujoco.MjModel.from_xml_path(str(source))
    change = change_of("l2", random_theta(np.random.default_rng(1)))
    target.parent.mkdir()
    target.write_bytes(changed_model_text(source, change, target.parent))
    assert not inertia_increases(read_document(target))
    assert mujoco.MjModel.from_xml_path(str(target)).njnt == 2


TURNED = (0.1 + 0.2, -1.5, -9.6)
CHANGE = ModelChange((), 1.23e-4, gravity=TURNED)
WRITTEN = 'gravity="0.30000000000000004 -1.5 -9.6"'


def change_gravity(tmp_path, text):
    """The text that is written, after MuJoCo has read it with this gravity in another folder."""
    target = tmp_path / "out" / "m.xml"
    write_and_verify(write_files(tmp_path / "in", {"m.xml": text}), CHANGE, target)
    mj_model = mujoco.MjModel.from_xml_path(str(target))
    assert_array_equal(mj_model.opt.gravity, TURNED)
    assert_array_equal(compile_model(target).mj_model.opt.gravity, TURNED)
    return target.read_text()


def with_options(*options):
    return ARM.replace("  <worldbody>", "\n".join([*options, "  <worldbody>"]))


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (['  <option timestep="0.001"/>'], [f'  <option timestep="0.001" {WRITTEN}/>']),
        (
            ['  <option gravity="0 0 -9.8"/>', '  <option timestep="0.001"/>'],
            [f"  <option {WRITTEN}/>", '  <option timestep="0.001"/>'],
        ),
        (
            ['  <option gravity="0 0 -9.7"/>', '  <option gravity="0 0 -9.8"/>'],
            ['  <option gravity="0 0 -9.7"/>', f"  <option {WRITTEN}/>"],
        ),
    ],
)
def test_the_option_that_counts_is_changed(tmp_path, options, expected):
    text = change_gravity(tmp_path, with_options(*options))
    lines = [line for line in text.splitlines() if "option" in line]
    assert lines == expected
    gravity = "0 0 -9.8" if "9.8" in "".join(options) else "0 0 -9.81"
    assert f"in place of {gravity}, because" in text


@pytest.mark.parametrize(
    "extension",
    [
        "",
        "<mujoco/>",
        '<mujoco><compiler angle="radian" balanceinertia="true"/></mujoco>',
        '<mujoco><compiler balanceinertia="true"/><option timestep="0.001"/></mujoco>',
        '<mujoco><option timestep="0.001" gravity="0 0 -9.7"/></mujoco>',
    ],
)
def test_a_urdf_states_it_in_the_part_that_mujoco_reads(tmp_path, extension):
    links = urdf.serial(
        {"l1": urdf.inertial() + urdf.mesh("visual", "meshes/none.stl")}
    )
    source = write_files(tmp_path / "in", {"m.urdf": urdf.robot(extension, links)})
    text = changed_model_text(source, CHANGE, tmp_path)
    written = tmp_path / "m.urdf"
    written.write_bytes(text)
    mj_model = compile_model(written).mj_model
    assert_array_equal(mj_model.opt.gravity, TURNED)
    assert mj_model.opt.timestep == (0.001 if "timestep" in extension else 0.002)
    assert (b'balanceinertia="true"' in text) == ("balanceinertia" in extension)
    for content in (text, changed_model_text(written, CHANGE, tmp_path)):
        for mark in (b"<mujoco", b"<option", b"System ID"):
            assert content.count(mark) == 1


def test_gravity_that_is_switched_off_is_refused(tmp_path):
    off = with_options('<option><flag gravity="disable"/></option>')
    with refused("switches gravity off", ExportError):
        change_gravity(tmp_path, off)


# A child body before the joint of its parent, frames, joints elsewhere in the file.
MIXED = f"""<mujoco>
  <default><joint damping="0.5" armature="0.01"/></default>
  <worldbody>
    <body><freejoint/>{INERTIAL}</body>
    <body>
      <body>
        <frame pos="0 0 1"><joint name="in" type="slide"/></frame>
        {INERTIAL}
      </body>
      <joint name="out" axis="1 0 0"
             frictionloss="0.3"/>
      {INERTIAL}
    </body>
  </worldbody>
  <equality><joint name="out" joint1="in"/></equality>
  <tendon><fixed><joint joint="out" coef="1"/></fixed></tendon>
</mujoco>
"""


def write_elements(document, *changes):
    for change in changes:
        write_element(document, change, 0.0)
    return document.text().decode()


@pytest.mark.parametrize("joint", ["in", "out"])
@since(3, 1)
def test_a_joint_is_found_by_its_name(tmp_path, joint):
    numbers = {"armature": 1.25, "damping": 2.5, "frictionloss": 3.75}
    text = write_elements(
        document_of(tmp_path, MIXED), ElementChange("joint", joint, numbers)
    )
    original = mujoco.MjModel.from_xml_string(MIXED)
    written = mujoco.MjModel.from_xml_string(text)
    dof = original.joint(joint).dofadr[0]
    for field, value in numbers.items():
        expected = getattr(original, f"dof_{field}").copy()
        expected[dof] = value
        assert_array_equal(getattr(written, f"dof_{field}"), expected)


@pytest.mark.parametrize("numbers", [{"armature": -1e-6}, {"damping": np.nan}])
def test_a_joint_that_would_drive_itself_is_refused(tmp_path, numbers):
    document = document_of(tmp_path, MIXED)
    with refused("joint 'out' cannot get .*drive itself", ExportError):
        write_elements(document, ElementChange("joint", "out", numbers))


SERVOS = f"""<mujoco>
  <default><position kp="7" kv="1"/><default class="weak"><position kp="3"/></default></default>
  <worldbody>
    <body><joint name="a"/>{INERTIAL}<body><joint name="b"/>{INERTIAL}</body></body>
  </worldbody>
  <actuator><motor joint="a"/><position class="weak" joint="a"/></actuator>
  <actuator><general joint="b" gainprm="5" biastype="affine" biasprm="0 -5 -2"/></actuator>
</mujoco>"""


def write_gains(document, actuator, **numbers):
    """Return the text with these gains."""
    return write_elements(document, ElementChange("actuator", actuator, numbers))


@since(3, 1)
def test_gains_are_written_into_the_actuator_that_mujoco_numbers(tmp_path):
    document = document_of(tmp_path, SERVOS)
    write_gains(document, 1, kp=40.0, kv=4.0)
    model = mujoco.MjModel.from_xml_string(write_gains(document, 2, kp=50.0))
    original = mujoco.MjModel.from_xml_string(SERVOS)
    assert model.actuator_gainprm[:, 0].tolist() == [1.0, 40.0, 50.0]
    assert model.actuator_biasprm[1:, :3].tolist() == [
        [0.0, -40.0, -4.0],
        [0.0, -50.0, 0.0],
    ]
    assert_array_equal(model.dof_damping, original.dof_damping)
    # MuJoCo 3.0 does not know the damping of a <position>, which only a model with damping gets.
    document = document_of(tmp_path, SERVOS)
    assert write_gains(document, 1, kp=40.0).count("kv=") == 1
    for number in (0, 3):
        with refused(f"actuator number {number} is not written out", ExportError):
            write_gains(document, number, kp=1.0, kv=1.0)


@since(3, 1)
@pytest.mark.parametrize("actuator", [1, 2])
@pytest.mark.parametrize("limit", ["", 'forcerange="-3 7"', 'forcelimited="false"'])
def test_a_largest_force_is_written_to_both_sides(tmp_path, actuator, limit):
    """Whatever the file or a class of it says of the actuator's force."""
    text = SERVOS.replace('kp="7" kv="1"', f'kp="7" kv="1" {limit}')
    text = text.replace('gainprm="5"', f'gainprm="5" {limit}')
    document = document_of(tmp_path, text)
    written = write_gains(document, actuator, kp=40.0, kv=4.0, forcerange=2.5)
    model = mujoco.MjModel.from_xml_string(written)
    original = mujoco.MjModel.from_xml_string(text)
    expected = original.actuator_forcerange.copy()
    expected[actuator] = (-2.5, 2.5)
    assert_array_equal(model.actuator_forcerange, expected)
    assert model.actuator_forcelimited[actuator] == 1
    others = np.delete(np.arange(3), actuator)
    assert_array_equal(
        model.actuator_forcelimited[others], original.actuator_forcelimited[others]
    )


@since(3, 1)
def test_damping_by_a_ratio_gives_way_to_a_number(tmp_path):
    text = SERVOS.replace('class="weak" joint="a"', 'joint="a" dampratio="1"')
    text = text.replace('kp="7" kv="1"', 'kp="7"')
    document = document_of(tmp_path, text)
    model = mujoco.MjModel.from_xml_string(write_gains(document, 1, kp=40.0, kv=0.0))
    assert model.actuator_biasprm[1, :3].tolist() == [0.0, -40.0, 0.0]


@pytest.mark.parametrize("old", ["", ".8", ".8 .9", ".8 .9 .002 .4 3"])
@pytest.mark.parametrize("of_class", ["", '<joint solimpfriction=".7 .85 .003"/>'])
def test_friction_is_as_firm_as_is_said_and_otherwise_as_in_the_file(
    tmp_path, old, of_class
):
    stated = f'solimpfriction="{old}"' if old else ""
    text = SERVOS.replace('<position kp="7" kv="1"/>', of_class)
    text = text.replace('<joint name="b"/>', f'<joint name="b" {stated}/>')
    text = text.replace('class="weak" ', "")
    change = ElementChange("joint", "b", {"frictionloss": 0.2, "solimpfriction": 0.99})
    written = write_elements(document_of(tmp_path, text), change)
    model = mujoco.MjModel.from_xml_string(written)
    expected = mujoco.MjModel.from_xml_string(text).dof_solimp.copy()
    expected[1, :2] = 0.99
    assert_array_equal(model.dof_solimp, expected)


@since(4, 0)
def test_a_pid_controller_gets_gains_and_any_actuator_loses_its_rotor(tmp_path):
    text = SERVOS.replace('<motor joint="a"/>', '<pid joint="a" damping="1 2 3"/>')
    document = document_of(tmp_path, text)
    emptied = {"armature": 0.0, "damping": 0.0}
    write_gains(document, 0, kp=40.0, kv=4.0, **emptied)
    model = mujoco.MjModel.from_xml_string(write_gains(document, 2, **emptied))
    assert model.actuator_biasprm[:, :3].tolist()[::2] == [[0, -40, -4], [0, -5, -2]]
    for name in ("armature", "damping", "dampingpoly"):
        assert not np.any(getattr(model, f"actuator_{name}"))
