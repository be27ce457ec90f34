"""Settings that change inertias at compile time are dealt with or refused."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ExportError
from robot_sysid.export import export_updated_xml
from robot_sysid.mjcf.compiler_settings import check_settings, setting
from robot_sysid.mjcf.documents import read_document
from robot_sysid.mjcf.inertial import find_body
from robot_sysid.mjcf.write_back import WriteBack
from robot_sysid.output.verification import verify_written_model
from tests.support.model_files import ARM, random_theta, write_files

THETA = random_theta(np.random.default_rng(5), 1.7)


def arm(tmp_path, compiler, text=ARM):
    changed = text.replace("<worldbody>", f"<compiler {compiler}/><worldbody>", 1)
    return write_files(tmp_path, {"m.xml": changed})


@pytest.mark.parametrize(
    ("compiler", "name"),
    [
        ("settotalmass='3'", "settotalmass"),
        ("settotalmass='0x10'", "settotalmass"),
        ("boundmass='2'", "boundmass"),
        ("boundinertia='1'", "boundinertia"),
        ("fusestatic='true'", "fusestatic"),
    ],
)
def test_a_setting_that_would_change_the_value_is_refused_by_name(tmp_path, compiler, name):
    document = read_document(arm(tmp_path, compiler))
    with pytest.raises(ExportError, match=f"compiler setting {name} ") as caught:
        check_settings(document, find_body(document, "link2"), THETA)
    assert "\n" not in str(caught.value)


def test_a_value_at_its_bound_but_for_rounding_is_written(tmp_path):
    theta = spatial.theta_from_com(1.0, np.array([0.0, 0.0, 0.1]), (1e-6 - 3e-16) * np.eye(3))
    source, target = arm(tmp_path, "boundinertia='1e-6'"), tmp_path / "out" / "m.xml"
    original = mujoco.MjModel.from_xml_path(str(source))
    export_updated_xml(source, "link2", WriteBack(theta), 0.0, target)
    verify_written_model(original, target, {original.body("link2").id: WriteBack(theta)})


def test_fusestatic_does_not_matter_to_a_body_without_welded_children(tmp_path):
    document = read_document(arm(tmp_path, "fusestatic='true'"))
    check_settings(document, find_body(document, "finger"), THETA)


def test_the_last_setting_counts(tmp_path):
    text = ARM.replace("<worldbody>", "<compiler boundmass='1'/><worldbody>")
    document = read_document(arm(tmp_path, "boundmass='2'", text))
    assert setting(document, "boundmass") == "2" and setting(document, "strippath") is None


@pytest.mark.parametrize(
    "compiler",
    [
        "inertiafromgeom='true'",
        "inertiafromgeom='true' inertiagrouprange='0 5'",
        "inertiafromgeom='auto'",
        "balanceinertia='true'",
        "boundmass='1e-3' boundinertia='1e-6'",
        "inertiagrouprange='3 4'",
    ],
)
def test_the_written_value_survives_and_the_other_bodies_stay(tmp_path, compiler):
    # With inertiafromgeom the geom of link1 decides, although it has an inertial.
    text = ARM.replace('<joint name="j1"', '<geom name="g" size="0.05"/><joint name="j1"')
    text = text.replace(
        '<geom size="0.1"/>', '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    )
    source = arm(tmp_path, compiler, text)
    original = mujoco.MjModel.from_xml_path(str(source))
    target, plan = tmp_path / "out" / "m.xml", WriteBack(THETA)
    export_updated_xml(source, "link2", plan, 0.0, target, principal=True)
    verify_written_model(original, target, {original.body("link2").id: plan})
