"""The text of an inertial means exactly theta; settings that would change it are dealt with."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ExportError
from robot_sysid.export import export_updated_xml
from robot_sysid.mjcf.documents import Edits, read_document
from robot_sysid.mjcf.inertial import (
    WriteBack,
    check_settings,
    format_numbers,
    mjcf_inertial,
)
from robot_sysid.mjcf.inertial import urdf_inertial_about_com as urdf_inertial
from robot_sysid.mjcf.updated_model import BodyChange, ModelChange, find_element
from robot_sysid.model.inertia import body_label, body_theta
from robot_sysid.results.verification import (
    reads_fullinertia_exactly,
    verify_written_model,
)
from tests.support.model_files import ARM, random_theta, write_files
from tests.support.releases import since


@pytest.mark.parametrize("principal", [True, False])
@given(seed=st.integers(0, 2**32 - 1))
def test_mujoco_reads_back_what_was_written(principal, seed):
    rng = np.random.default_rng(seed)
    theta = random_theta(rng, 10.0 ** rng.uniform(-3, 1), 10.0 ** rng.uniform(-2, 0))
    if not principal and not reads_fullinertia_exactly(theta):
        return
    inertial = mjcf_inertial(theta, principal)
    text = f"<mujoco><worldbody><body><joint/>{inertial}</body></worldbody></mujoco>"
    got = body_theta(mujoco.MjModel.from_xml_string(text), 1)
    scale = spatial.parameter_scale(theta[0], spatial.characteristic_length(theta))
    assert np.max(np.abs(got - theta) / scale) < 1e-12


def test_inertias_are_about_the_centre_of_mass_in_the_order_of_their_format():
    inertia = np.array([[4.0, 1.0, 2.0], [1.0, 5.0, 3.0], [2.0, 3.0, 6.0]])
    com = np.array([0.0, 0.0, 1.0])
    assert mjcf_inertial(spatial.theta_from_com(2.0, com, inertia)) == (
        '<inertial pos="0.0 0.0 1.0" mass="2.0" fullinertia="4.0 5.0 6.0 1.0 2.0 3.0"/>'
    )
    assert urdf_inertial(2.0, com, inertia) == (
        '<inertial><origin xyz="0.0 0.0 1.0" rpy="0 0 0"/><mass value="2.0"/>'
        '<inertia ixx="4.0" ixy="1.0" ixz="2.0" iyy="5.0" iyz="3.0" izz="6.0"/></inertial>'
    )


def test_numbers_that_mujoco_cannot_read_are_zero():
    assert (
        format_numbers(np.array([-0.0, 5e-324, -2e-310, 1e-300, 0.1]))
        == "0.0 0.0 0.0 1e-300 0.1"
    )


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("<body name='a'/>", "<body name='a'><NEW/></body>"),
        (
            "<body><inertial pos='0 0 0'\n mass='1'/><joint/></body>",
            "<body><NEW/><joint/></body>",
        ),
        (
            "\n  <body>\n    <joint/>\n  </body>",
            "\n  <body>\n    <NEW/>\n    <joint/>\n  </body>",
        ),
        (
            "<body><body><inertial/></body></body>",
            "<body>\n  <NEW/><body><inertial/></body></body>",
        ),
        ("<body><include file='i.xml'/></body>", "<body><NEW/></body>"),
    ],
)
def test_the_old_inertial_goes_and_a_missing_one_comes(tmp_path, before, after):
    text = f"<mujoco><worldbody>{before}</worldbody></mujoco>"
    included = "<x><inertial pos='0 0 0' mass='1'/></x>"
    edits = Edits(
        read_document(write_files(tmp_path, {"m.xml": text, "i.xml": included}))
    )
    edits.put_inertial(next(edits.document.walk("body")), "<NEW/>")
    assert edits.text().decode() == text.replace(before, after)


# Each body carries its MuJoCo id as mass of its only geom.
NAMELESS = """<mujoco><include file="a.xml"/><worldbody>
<body><geom size="1" mass="3"/><frame><body><geom size="1" mass="4"/></body></frame></body>
<frame pos="1 0 0"><body><geom size="1" mass="5"/></body></frame></worldbody></mujoco>"""
INCLUDED = """<mujoco><worldbody><body><geom size="1" mass="1"/>
<body name="b"><geom size="1" mass="2"/></body></body></worldbody></mujoco>"""


@since(3, 1)
def test_nameless_bodies_are_counted_as_mujoco_counts(tmp_path):
    path = write_files(tmp_path, {"m.xml": NAMELESS, "a.xml": INCLUDED})
    mj_model = mujoco.MjModel.from_xml_path(str(path))
    document = read_document(path)
    for number in range(1, mj_model.nbody):
        node = find_element(document, "body", body_label(mj_model, number))
        assert (
            float(node.child("geom").get("mass"))
            == mj_model.body_mass[number]
            == number
        )


@pytest.mark.parametrize(
    ("content", "label", "message"),
    [
        ("<body name='a'/>", "b", "'b' is not written out in the file"),
        ("<body name='a'/><body name='a'/>", "a", "'a' stands in the file 2 times"),
        ("<replicate count='2'><body/></replicate><body/>", "#3", "is not written out"),
        (
            "<body><attach model='x' body='y' prefix='z'/></body><body/>",
            "#4",
            "is not written out",
        ),
        ("<body/><replicate count='2'><body/></replicate>", "#2", "is not written out"),
    ],
)
def test_what_is_not_written_out_is_one_line(tmp_path, content, label, message):
    text = f"<mujoco><worldbody>{content}</worldbody></mujoco>"
    with pytest.raises(ExportError, match=message) as caught:
        find_element(
            read_document(write_files(tmp_path, {"m.xml": text})), "body", label
        )
    assert "\n" not in str(caught.value)


THETA = random_theta(np.random.default_rng(5), 1.7)


def arm(tmp_path, compiler, text=ARM):
    changed = text.replace("<worldbody>", f"<compiler {compiler}/><worldbody>", 1)
    return write_files(tmp_path, {"m.xml": changed})


@pytest.mark.parametrize(
    ("compiler", "name"),
    [
        ("settotalmass='3'", "settotalmass"),
        ("boundmass='2'", "boundmass"),
        ("boundinertia='1'", "boundinertia"),
        ("fusestatic='true'", "fusestatic"),
    ],
)
def test_a_setting_that_would_change_the_value_is_refused_by_name(
    tmp_path, compiler, name
):
    document = read_document(arm(tmp_path, compiler))
    with pytest.raises(ExportError, match=f"compiler setting {name} ") as caught:
        check_settings(document, find_element(document, "body", "link2"), THETA)
    assert "\n" not in str(caught.value)


def test_fusestatic_does_not_matter_to_a_body_without_welded_children(tmp_path):
    document = read_document(arm(tmp_path, "fusestatic='true'"))
    check_settings(document, find_element(document, "body", "finger"), THETA)


AT_ITS_BOUND = spatial.theta_from_com(
    1.0, np.array([0.0, 0.0, 0.1]), (1e-6 - 3e-16) * np.eye(3)
)


@pytest.mark.parametrize(
    ("compiler", "theta"),
    [
        ("inertiafromgeom='true' inertiagrouprange='0 5'", THETA),
        ("inertiafromgeom='auto' inertiagrouprange='3 4'", THETA),
        ("balanceinertia='true' boundmass='1e-3' boundinertia='1e-6'", THETA),
        ("boundinertia='1e-6'", AT_ITS_BOUND),
    ],
)
def test_the_written_value_survives_and_the_other_bodies_stay(
    tmp_path, compiler, theta
):
    # With inertiafromgeom the geom of link1 decides, although it has an inertial.
    text = ARM.replace(
        '<joint name="j1"', '<geom name="g" size="0.05"/><joint name="j1"'
    )
    text = text.replace(
        '<geom size="0.1"/>', '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    )
    source = arm(tmp_path, compiler, text)
    target = tmp_path / "out" / "m.xml"
    original = mujoco.MjModel.from_xml_path(str(source))
    plan = WriteBack(theta)
    export_updated_xml(source, "link2", plan, 0.0, target, principal=True)
    change = BodyChange("link2", original.body("link2").id, plan)
    verify_written_model(original, target, ModelChange((change,), 0.0))
