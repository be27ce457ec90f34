"""Compiling quietly: notes and one-line errors instead of MuJoCo's own output, or its end."""

from __future__ import annotations

import locale
import os
import re

import mujoco
import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from rigs.arms.small_arms import SEEDS, random_theta
from rigs.files import urdf
from rigs.files.model_files import INERTIAL, TETRAHEDRON, write_files
from rigs.files.refusals import refused
from robot_sysid import spatial
from robot_sysid.errors import ModelError
from robot_sysid.mjcf.inertial import mjcf_inertial, urdf_inertial_about_com
from robot_sysid.model.bodies import body_theta, inertia_about_com
from robot_sysid.model.compilation import compile_model, mjcf_of, restore_exact_inertias
from robot_sysid.parser import load_robot_model

BODY = "<body name='b'><joint/>{}</body>"
MESH_MODEL = """<mujoco><compiler meshdir="d"/><asset><mesh name="m" file="m.obj"/></asset>
<worldbody><body><joint/><geom type="mesh" mesh="m"/></body></worldbody></mujoco>"""
URDF = urdf.robot(urdf.serial({"l1": urdf.inertial()}))


def world(content: str) -> str:
    return f"<mujoco><worldbody>{content}</worldbody></mujoco>"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (world(BODY.format("")), "inertia of moving bodies .*name .*b.*line .*1"),
        (world("\n<body foo='1'/>"), "unrecognized attribute: 'foo' .*'body', line 2"),
        (
            world(f"<body name='nan'/>\n<body pos='0 nan 0'>{INERTIAL}</body>"),
            ", line 2: pos='0 nan 0' of <body> is no number; state what it is",
        ),
        (
            world(BODY.format(INERTIAL.replace("0.01", "nan"))),
            "line 1: pos='nan 0.02 0.03' of <inertial> is no number",
        ),
        (
            world(
                BODY.format(
                    "<inertial pos='0 0 0' mass='1' fullinertia='NaN 1 1 0 0 0'/>"
                )
            ),
            "fullinertia='NaN 1 1 0 0 0' of <inertial> is no number",
        ),
        (
            URDF.replace('ixx="0.01"', 'ixx="-nan"'),
            "line .*: ixx='-nan' of <inertia> is no number",
        ),
        (
            "<mujoco><option gravity='0 0 -1e300'/><worldbody/></mujoco>",
            r"a value no arm has \(gravity 1e\+300\)",
        ),
        (MESH_MODEL, "mesh file m.obj not found; check the path, or pass --mesh-dir"),
        (
            urdf.robot(urdf.link("a"), urdf.joint("a", "gone")),
            "joint parent or child missing",
        ),
        (
            world(BODY.format("<inertial pos='0 0 0' mass='1' diaginertia='1 1 3'/>")),
            r"A \+ B >= C.*name .*b",
        ),
        (
            world(
                BODY.format(
                    "<inertial pos='0 0 0' mass='1' fullinertia='-1 1 3 0 0 0'/>"
                )
            ),
            r"positive eigenvalues.*name .*b",
        ),
        (URDF.replace('ixx="0.01"', 'ixx="much"'), "a number cannot be read: .*much"),
        (
            URDF.replace('rpy="0 0 0"', 'rpy="0 0 inf"'),
            "a number cannot be read: the inertial of link l1 is none that an arm has",
        ),
    ],
)
def test_what_mujoco_refuses_is_one_line_with_the_file(tmp_path, text, message):
    with refused(rf"m\.xml\b.*{message}", ModelError):
        compile_model(write_files(tmp_path, {"m.xml": text}))


def test_a_mesh_that_is_broken_may_be_removed_if_its_link_has_an_inertial(tmp_path):
    link = urdf.mesh("collision", "package://arm/meshes/odd.stl") + urdf.inertial()
    files = {"m.urdf": URDF.replace(urdf.inertial(), link), "odd.stl": "solid odd"}
    path = write_files(tmp_path, files)
    with refused(r"m\.urdf: .*odd.*; save the mesh as binary STL or OBJ, or remove"):
        compile_model(path)
    (tmp_path / "odd.stl").unlink()
    (note,) = compile_model(path).notes
    assert "left out: odd.stl. Masses" in note and "contacts with them are" in note


def test_warnings_become_notes_and_leave_no_trace(tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = world(BODY.format(INERTIAL)).replace(
        "<worldbody>", "<worldbody><light diffuse='nan 0 0'/>"
    )
    compiled = compile_model(write_files(tmp_path, {"m.xml": text}))
    assert len(compiled.notes) == 1 and "NaN" in compiled.notes[0]
    assert capfd.readouterr() == ("", "")
    assert os.listdir(tmp_path) == ["m.xml"]


def test_the_mesh_folder_can_be_given(tmp_path):
    path = write_files(tmp_path, {"m.xml": MESH_MODEL, "mine/m.obj": TETRAHEDRON})
    assert compile_model(path, tmp_path / "mine").mj_model.nmesh == 1
    with refused("mesh folder .*gone is no folder; check --mesh-dir", ModelError):
        compile_model(path, tmp_path / "gone")


def test_a_urdf_inertia_is_exact_whatever_its_axes(tmp_path):
    inertial = urdf.inertial(1.0, "0.3 -0.7 1.1", "2e-6 3e-6 4.5e-6")
    mj_model = compile_model(urdf.write_arm(tmp_path, {"l1": inertial})).mj_model
    turn = Rotation.from_euler("ZYX", [1.1, -0.7, 0.3]).as_matrix()
    expected = turn @ np.diag([2e-6, 3e-6, 4.5e-6]) @ turn.T
    inertia = inertia_about_com(mj_model, mj_model.body("l1").id)
    assert_allclose(inertia, expected, rtol=0.0, atol=1e-17)


def test_a_urdf_states_its_speed_limits(tmp_path):
    """Stated speeds are kept; zero, missing and malformed ones mean that there is none."""
    limits = ('velocity="1.5"', 'velocity="0"', "", 'velocity="fast"')
    names = [f"l{k}" for k in range(len(limits))]
    path = urdf.write_arm(tmp_path, dict.fromkeys(names, urdf.inertial()))
    text = path.read_text()
    for limit in limits:
        text = text.replace('velocity="1"', limit, 1)
    path.write_text(text)
    assert compile_model(path).velocity_limits == {"base_l0": 1.5}


def compile_body(theta):
    body = BODY.format(mjcf_inertial(theta, principal=True))
    return mujoco.MjModel.from_xml_string(world(body))


@given(seed=SEEDS)
def test_a_turned_inertia_is_restored_with_all_that_follows(seed):
    rng = np.random.default_rng(seed)
    theta = random_theta(rng)
    exact = compile_body(theta)
    turned_model = compile_body(theta)
    turn = np.append(1.0, 1e-4 * rng.normal(size=3))
    turned = np.empty(4)
    mujoco.mju_mulQuat(turned, turn / np.linalg.norm(turn), turned_model.body_iquat[1])
    turned_model.body_iquat[1] = turned
    restore_exact_inertias(turned_model, {"b": spatial.com_from_theta(theta)})
    # A value of 4 has rounding steps of 9e-16, so the tolerance goes with the largest.
    largest = np.max(np.abs(theta))
    assert_allclose(
        body_theta(turned_model, 1) / largest, theta / largest, rtol=0, atol=1e-15
    )
    assert_allclose(turned_model.dof_M0, exact.dof_M0, rtol=1e-11)


def test_a_decimal_comma_is_refused_before_meshes_are_read_wrongly(
    tmp_path, monkeypatch
):
    """Where a locale writes 1,5, MuJoCo ends the numbers of an OBJ mesh at their points."""
    monkeypatch.setattr(locale, "localeconv", lambda: {"decimal_point": ","})
    path = write_files(tmp_path, {"m.xml": MESH_MODEL, "d/m.obj": TETRAHEDRON})
    with refused(r"has ',' for a decimal point.*LC_NUMERIC, 'C'", ModelError):
        compile_model(path)


SECOND_MOMENTS = {
    "plate": (1.0, 0.4, 0.0),
    "disc": (1.0, 1.0, 0.0),
    "rod": (1.0, 1e-7, 0.0),
    "line": (1.0, 0.0, 0.0),
    "block": (1.0, 0.5, 0.2),
}


def thin_link(rng):
    """The <inertial> of a random link that is flat or thin, in random axes, in 6 or 17 digits."""
    shape = rng.choice(list(SECOND_MOMENTS))
    second_moments = 10 ** rng.uniform(-7, 1) * np.array(SECOND_MOMENTS[shape])
    moments = np.diag(np.sum(second_moments) - rng.permutation(second_moments))
    turn = np.eye(3)
    if rng.random() < 0.7:
        turn = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    digits = rng.choice([6, 17])
    rounded = [float(f"{x:.{digits}g}") for x in (turn @ moments @ turn.T).ravel()]
    inertia = np.reshape(rounded, (3, 3))
    return urdf_inertial_about_com(1.0, 0.1 * rng.normal(size=3), inertia)


@given(seed=SEEDS)
def test_an_mjcf_of_a_urdf_has_its_links_however_flat(tmp_path_factory, seed):
    rng = np.random.default_rng(seed)
    links = {name: thin_link(rng) for name in ("l1", "l2", "l3")}
    path = urdf.write_arm(tmp_path_factory.mktemp("flat"), links)
    original = compile_model(path).mj_model
    copied = compile_model(mjcf_of(path)).mj_model
    for name in links:
        body = original.body(name).id
        theta = body_theta(original, body)
        largest = np.max(np.abs(theta))
        assert_allclose(
            body_theta(copied, body) / largest, theta / largest, rtol=0, atol=1e-14
        )


def torques(model, states):
    """The torques (S, nv) that MuJoCo finds for states (S, 3) of uniform numbers (nv,) each."""
    data = mujoco.MjData(model)
    found = []
    for q, qd, qdd in states:
        data.qpos[:], data.qvel[:], data.qacc[:] = q, qd, qdd
        mujoco.mj_inverse(model, data)
        found.append(data.qfrc_inverse.copy())
    return np.array(found)


@given(seed=SEEDS)
def test_an_mjcf_of_a_urdf_takes_its_torques(tmp_path_factory, seed):
    """With turned, fixed and mimicking joints, whichever of them an identification holds."""
    rng = np.random.default_rng(seed)
    path = tmp_path_factory.mktemp("tree") / "arm.urdf"
    path.write_text(urdf.drawn_tree(rng))
    original = compile_model(path).mj_model
    copied = compile_model(mjcf_of(path)).mj_model
    assert copied.neq == original.neq
    states = rng.uniform(-1.0, 1.0, (5, 3, original.nv))
    expected = torques(original, states)
    largest = np.max(np.abs(expected), initial=0.0)
    assert_allclose(torques(copied, states), expected, rtol=0, atol=1e-11 * largest)
    assert_allclose(copied.jnt_range, original.jnt_range, rtol=1e-15)
    assert_allclose(copied.eq_data, original.eq_data, rtol=1e-15)


def test_numbers_of_a_written_mjcf_are_no_longer_than_they_need_be(tmp_path):
    path = urdf.write_arm(tmp_path, {"l1": urdf.inertial()})
    text = mjcf_of(path).read_text()
    assert 'pos="0 0 0.2"' in text and 'mass="1.0"' in text
    stated = list(map(float, re.search('quat="([^"]*)"', text)[1].split()))
    assert_allclose(np.linalg.norm(stated), 1.0, rtol=1e-15)


TURNS = ((0.0, 0.0, 0.0), (0.5, -0.3, 0.8))


@pytest.mark.parametrize("of_joint", TURNS)
@pytest.mark.parametrize("of_inertial", TURNS)
def test_turned_inertials_and_links_on_fixed_joints_are_read_in_any_mujoco(
    tmp_path, of_inertial, of_joint
):
    """MuJoCo 3.1.3 to 3.13 leave the rotation of an inertial out, 3.3.3 to 3.10 that of a joint."""
    arm = np.array([[0.02, 0.003, -0.002], [0.003, 0.03, 0.004], [-0.002, 0.004, 0.04]])
    hand = np.diag([0.004, 0.006, 0.003])
    centre = np.array([0.1, 0.02, -0.03])
    centre_of_hand = np.array([0.02, 0.03, 0.05])
    place = np.array([0.05, 0.0, 0.2])

    def link(name, mass, at, inertia):
        xx, xy, xz, yy, yz, zz = inertia[np.triu_indices(3)]
        return (
            f'<link name="{name}"><inertial><mass value="{mass}"/>'
            f'<origin xyz="{" ".join(map(str, at))}" '
            f'rpy="{" ".join(map(str, of_inertial))}"/><inertia ixx="{xx}" ixy="{xy}" '
            f'ixz="{xz}" iyy="{yy}" iyz="{yz}" izz="{zz}"/></inertial></link>'
        )

    path = tmp_path / "arm.urdf"
    path.write_text(
        f'<robot name="r"><link name="base"/>{link("arm", 2.0, centre, arm)}'
        f"{link('hand', 0.7, centre_of_hand, hand)}"
        '<joint name="j" type="revolute"><parent link="base"/><child link="arm"/>'
        '<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="9" velocity="2"/></joint>'
        '<joint name="f" type="fixed"><parent link="arm"/><child link="hand"/>'
        f'<origin xyz="{" ".join(map(str, place))}" '
        f'rpy="{" ".join(map(str, of_joint))}"/></joint></robot>'
    )

    def turn(roll, pitch, yaw):
        return Rotation.from_euler("xyz", (roll, pitch, yaw)).as_matrix()

    def theta(mass, at, inertia, rotation):
        return spatial.theta_from_com(mass, at, rotation @ inertia @ rotation.T)

    turned = turn(*of_joint)
    expected = theta(2.0, centre, arm, turn(*of_inertial)) + theta(
        0.7, place + turned @ centre_of_hand, hand, turned @ turn(*of_inertial)
    )
    (found,) = load_robot_model(path).thetas
    assert np.allclose(found, expected, rtol=1e-9, atol=1e-12)
