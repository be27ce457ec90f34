"""The text of an inertial means exactly theta; settings that would change it are dealt with."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from rigs.arms.small_arms import SEEDS, random_rotation, random_theta
from rigs.files.model_files import ARM, document_of, write_and_verify, write_files
from rigs.files.refusals import refused
from rigs.files.releases import IS_PRINCIPAL, since
from robot_sysid import spatial
from robot_sysid.errors import ExportError
from robot_sysid.mjcf.documents import put_inertial, read_document
from robot_sysid.mjcf.inertial import (
    format_numbers,
    mjcf_inertial,
    plan_write_back,
    possible_body,
)
from robot_sysid.mjcf.inertial import urdf_inertial_about_com as urdf_inertial
from robot_sysid.mjcf.updated_model import BodyChange, ModelChange, find_element
from robot_sysid.model.bodies import body_label, body_theta
from robot_sysid.records import SubtreeBody


@pytest.mark.parametrize("principal", [True, False])
@given(seed=SEEDS)
def test_mujoco_reads_back_what_was_written(principal, seed):
    rng = np.random.default_rng(seed)
    theta = random_theta(rng, 10.0 ** rng.uniform(-3, 1), 10.0 ** rng.uniform(-2, 0))
    if not principal and IS_PRINCIPAL:
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
    ("old", "new"),
    [
        ('<body name="a"/>', '<body name="a">\n      <NEW/>\n    </body>'),
        (
            "<body><inertial pos='0 0 0'\n mass='1'/><joint/></body>",
            "<body><NEW/><joint/></body>",
        ),
        (
            "\n  <body>\n    <joint/>\n  </body>",
            "\n  <body>\n    <NEW/>\n    <joint/>\n  </body>",
        ),
        ("<body><include file='i.xml'/></body>", "<body><NEW/></body>"),
    ],
)
def test_the_old_inertial_goes_and_a_missing_one_comes(tmp_path, old, new):
    text = f"<mujoco><worldbody>{old}</worldbody></mujoco>"
    write_files(tmp_path, {"i.xml": "<x><inertial pos='0 0 0' mass='1'/></x>"})
    document = document_of(tmp_path, text)
    put_inertial(next(document.root.iter("body")), "<NEW/>")
    assert document.text().decode() == text.replace(old, new) + "\n"


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
        mass = float(node.find("geom").get("mass"))
        assert mass == mj_model.body_mass[number] == number


@pytest.mark.parametrize(
    ("content", "label", "message"),
    [
        ("<body name='a'/>", "b", "'b' is not written out in the file"),
        ("<replicate count='2'><body/></replicate><body/>", "#3", "is not written out"),
        (
            "<replicate count='2'><body name='a'/></replicate>",
            "a",
            "is not written out",
        ),
    ],
)
def test_what_is_not_written_out_is_one_line(tmp_path, content, label, message):
    text = f"<mujoco><worldbody>{content}</worldbody></mujoco>"
    with refused(message, ExportError):
        find_element(document_of(tmp_path, text), "body", label)


THETA = random_theta(np.random.default_rng(5), 1.7)


def write_link(tmp_path, compiler, theta):
    """Write as results are written with compiler settings, and verify the written file."""
    text = ARM.replace("<worldbody>", f"<compiler {compiler}/><worldbody>", 1)
    source = write_files(tmp_path, {"m.xml": text})
    change = ModelChange((BodyChange("link2", 3, theta),), 0.0, principal=True)
    write_and_verify(source, change, tmp_path / "out" / "m.xml")


@pytest.mark.parametrize(
    ("compiler", "name"),
    [
        ("settotalmass='3'", "settotalmass"),
        ("boundmass='2'", "boundmass"),
        ("boundinertia='1'", "boundinertia"),
        ("fusestatic='true'", "fusestatic"),
    ],
)
def test_a_setting_that_changes_the_value_is_refused_by_name(tmp_path, compiler, name):
    with refused(f"compiler settings, .*{name}", ExportError):
        write_link(tmp_path, compiler, THETA)


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
    write_link(tmp_path, compiler, theta)


NOTHING = np.zeros(10)


def rigid_bodies(*thetas):
    """Bodies b3, b4, ... that are welded together."""
    return [SubtreeBody(k, f"b{k}", t, True) for k, t in enumerate(thetas, 3)]


def hanging(number, theta):
    """A body on a joint of its own."""
    return SubtreeBody(number, f"b{number}", theta, welded=False)


@given(seed=SEEDS)
def test_the_terminal_body_takes_the_difference(seed):
    rng = np.random.default_rng(seed)
    link, tool, finger = (random_theta(rng, m) for m in (2.0, 0.3, 0.1))
    bodies = [*rigid_bodies(random_theta(rng), tool), hanging(5, finger)]
    plan = plan_write_back(link + tool + finger, bodies)
    assert_allclose(plan.theta, link, rtol=0, atol=1e-14)
    assert not plan.emptied and not plan.notes


@given(seed=SEEDS)
def test_a_massless_terminal_body_takes_the_whole_rigid_group(seed):
    rng = np.random.default_rng(seed)
    tool, finger, load = (random_theta(rng, m) for m in (1.0, 0.1, 0.5))
    noise = 1e-9 * rng.normal(size=10)
    bodies = [*rigid_bodies(NOTHING, tool, NOTHING), hanging(6, finger)]
    plan = plan_write_back(tool + finger + noise, bodies)
    assert_allclose(plan.theta, tool + noise, rtol=0, atol=1e-14)
    assert [body.name for body in plan.emptied] == ["b4"]
    (note,) = plan.notes
    assert "'b3'" in note and "'b4' none" in note
    heavier = plan_write_back(tool + finger + load, bodies)
    assert not heavier.emptied and spatial.is_consistent(heavier.theta)


@given(seed=SEEDS)
def test_what_hangs_on_joints_keeps_its_inertia_or_is_refused(seed):
    rng = np.random.default_rng(seed)
    link, tool, finger = (random_theta(rng, m) for m in (0.2, 0.3, 2.0))
    bodies = [*rigid_bodies(link, tool), hanging(5, finger)]
    with refused("without fingers that the arm did not have", ExportError):
        plan_write_back(link + tool + 0.1 * finger, bodies)


def test_no_scale_makes_an_impossible_link_possible():
    finger = random_theta(np.random.default_rng(0), 1.0)
    bodies = [*rigid_bodies(NOTHING), hanging(4, finger)]
    with refused("'b3' are not a possible rigid body", ExportError):
        plan_write_back(-0.9 * finger, bodies)


@given(seed=SEEDS, flatness=st.floats(-1e-11, 1e-11))
def test_a_body_on_the_edge_is_moved_inside_by_less_than_anyone_sees(seed, flatness):
    rng = np.random.default_rng(seed)
    axes = random_rotation(rng)
    second = axes @ np.diag([2e-3, 1e-3, flatness * 3e-3]) @ axes.T
    com = rng.normal(size=3) * 0.1
    theta = spatial.theta_from_com(1.5, com, np.trace(second) * np.eye(3) - second)
    moved = possible_body(theta, 1.5)
    assert moved is not None and spatial.is_consistent(moved)
    assert np.max(np.abs(moved - theta)) < 1e-10 * 6e-3


@pytest.mark.parametrize(
    "theta",
    [
        NOTHING,
        spatial.theta_from_com(1e-7, np.zeros(3), 1e-9 * np.eye(3)),
        spatial.theta_from_com(-1.0, np.zeros(3), np.eye(3)),
        spatial.theta_from_com(1.0, np.zeros(3), np.zeros((3, 3))),
        spatial.theta_from_com(1.0, np.zeros(3), np.diag([1.0, 1.0, -1.0])),
        np.full(10, np.nan),
    ],
)
def test_what_is_no_body_is_none(theta):
    assert possible_body(theta, 1.0) is None


def rod(rng, mass=1.0):
    """All mass on a line: one moment of inertia is zero."""
    along = np.diag([0.0, 0.0, 0.01 * mass])
    inertia = np.trace(along) * np.eye(3) - along
    return spatial.theta_from_com(mass, rng.normal(size=3), inertia)


@given(seed=SEEDS, bound=st.floats(1e-9, 1e-4))
def test_moments_below_the_files_bound_are_raised(seed, bound):
    identified = rod(np.random.default_rng(seed))
    plan = plan_write_back(identified, rigid_bodies(NOTHING), bound)
    smallest = np.linalg.eigvalsh(spatial.com_from_theta(plan.theta)[2])[0]
    # Rounding of an inertia about an origin metres away, which is of the order of ten.
    assert_allclose(smallest, bound, rtol=0, atol=1e-13)
    assert_allclose(plan.composite, plan.theta, rtol=0, atol=1e-13)
    assert "boundinertia" in plan.notes[0]


@pytest.mark.parametrize(("bound", "is_emptied"), [(1e-6, False), (0.0, True)])
def test_a_body_to_which_the_compiler_gives_its_least_inertia_is_no_reason_to_empty_it(
    bound, is_emptied
):
    """A plate leaves no room for the least moments that boundinertia gives to a bare frame."""
    plate = spatial.theta_from_com(0.5, np.zeros(3), np.diag([1e-4, 2e-4, 3e-4]))
    frame = spatial.theta_from_com(1e-6, np.zeros(3), 1e-6 * np.eye(3))
    bodies = [SubtreeBody(1, "link", plate, True), SubtreeBody(2, "tool0", frame, True)]
    plan = plan_write_back(plate, bodies, bound)
    assert bool(plan.emptied) == is_emptied
