"""What a model states of its links: placeholders are found by kind, and right models have none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from rigs.arms.small_arms import compile_xml, robot_of
from rigs.files import urdf
from rigs.files.places import MODELS
from rigs.files.refusals import refused
from rigs.files.releases import since
from robot_sysid import self_test, spatial
from robot_sysid.errors import ModelError
from robot_sysid.parser import load_robot_model
from robot_sysid.records import KINDS

MASS, CENTRE, INERTIA = KINDS
MASSES = (5.0, 4.0, 2.5, 1.5, 0.9)
CENTRE_OF_MASS = np.array([0.0, 0.0, 0.1])
"""That of each link, in the middle of its rod [m]."""


def arm(folder, placeholders=()):
    """An arm whose links are rods of 0.2 m; ``placeholders`` are (number of a link, kind)."""
    bodies = {}
    for number, mass in enumerate(MASSES):
        com = CENTRE_OF_MASS.copy()
        inertia = mass * np.diag([0.0035, 0.0034, 0.0008])
        if (number, CENTRE) in placeholders:
            com[:] = 0.0
        if (number, INERTIA) in placeholders:
            inertia = 0.05 * inertia
        if (number, MASS) in placeholders:
            mass = 2e-4
            inertia = 1e-6 * np.eye(3)
        bodies[f"link{number}"] = mass, com, inertia
    return load_robot_model(urdf.write_bodies(folder, bodies))


@given(
    st.sets(
        st.tuples(st.integers(0, len(MASSES) - 2), st.sampled_from(KINDS)), max_size=3
    )
)
def test_what_is_not_stated_is_found_by_kind_and_named_once(tmp_path_factory, drawn):
    # Where half of the links have such inertias, units are blamed.
    assume(sum(kind == INERTIA for _, kind in drawn) < 2)
    robot = arm(tmp_path_factory.mktemp("arm"), drawn)
    is_wrong = [("inertia", number) for number, kind in drawn if kind == INERTIA]
    masses = {number for number, kind in drawn if kind == MASS}
    is_odd = any(number not in masses for _, number in is_wrong)
    others = [(number, kind) for number, kind in drawn if kind != INERTIA]
    notes = [n for n in robot.notes if "placeholders" in n or "probably wrong" in n]
    assert len(notes) == bool(others) + is_odd
    # Nothing is known of the inertia of a mass that is not.
    implied = {(number, INERTIA) for number, kind in drawn if kind == MASS}
    for number, link in enumerate(robot.links):
        expected = {kind for kind in KINDS if (number, kind) in drawn | implied}
        assert set(link.placeholders) == expected
        assert bool(expected) == any(link.body_name in note for note in notes)
        if not expected:
            assert link.reference is link.theta or np.all(link.reference == link.theta)


def test_a_self_test_takes_placeholders_as_the_model_has_them(tmp_path):
    """Also what its data does not show of the last link, the one that is identified."""
    last = len(MASSES) - 1
    path = arm(tmp_path, {(last, INERTIA), (1, CENTRE)}).path
    log, simulated = (load_robot_model(path, as_stated=each) for each in (False, True))
    assert not any(f"link{last}" in note for note in log.notes)
    (note,) = [note for note in simulated.notes if f"link{last}" in note]
    assert "with a log a body" in note
    for link, same in zip(log.links, simulated.links):
        assert_array_equal(same.reference, same.theta)
        assert_array_equal(same.theta, link.theta)
    result = self_test(path, duration=3.0, seed=1)
    assert result.total.theta == pytest.approx(log.links[-1].theta, abs=1e-8)


@given(st.integers(0, len(MASSES) - 2), st.sampled_from(KINDS))
def test_a_rod_between_the_joints_stands_for_it(tmp_path_factory, number, kind):
    """Of rods, it is what was stated before, but for an inertia about the rod's own axis."""
    folder = tmp_path_factory.mktemp("arm")
    right = arm(folder).links[number]
    link = arm(folder, {(number, kind)}).links[number]
    assert spatial.is_consistent(link.reference)
    mass, com, inertia = spatial.com_from_theta(link.reference)
    true_mass, true_com, true_inertia = spatial.com_from_theta(right.theta)
    # Its error is as large as itself.
    assert abs(mass - true_mass) < 2.0 * mass
    assert com == pytest.approx(true_com, abs=1e-12)
    assert np.trace(inertia) / mass == pytest.approx(
        np.trace(true_inertia) / true_mass, rel=0.2
    )


@pytest.mark.parametrize("count", [3, 5])
def test_one_inertia_for_several_links_is_a_placeholder(tmp_path, count):
    bodies = {}
    for number, mass in enumerate(MASSES):
        value = 0.001 if number < count else 0.004 * mass
        bodies[f"link{number}"] = mass, CENTRE_OF_MASS, np.diag([1.0, 0.9, 0.8]) * value
    path = urdf.write_bodies(tmp_path, bodies)
    found = [link.placeholders for link in load_robot_model(path).links]
    assert found == [(INERTIA,)] * count + [()] * (len(MASSES) - count)


def test_links_of_one_kind_are_no_copies(tmp_path):
    """Modules of one mass and one inertia, about different axes different, are what they are."""
    body = 2.0, CENTRE_OF_MASS, np.diag([0.008, 0.007, 0.002])
    path = urdf.write_bodies(tmp_path, dict.fromkeys(("l1", "l2", "l3", "l4"), body))
    assert not any(link.placeholders for link in load_robot_model(path).links)


SHAPES = """
<mujoco><worldbody><body>
  <joint axis="0 1 0"/><inertial pos="0 0 0" mass="2" diaginertia=".01 .01 .002"/>
  <geom type="box" size=".05 .05 .15" pos="0 0 {offset}" contype="0" conaffinity="0"/>
  <body pos="0 0 .3"><joint axis="0 1 0"/>
    <inertial pos="0 0 .1" mass="1" diaginertia=".004 .004 .001"/></body>
</body></worldbody></mujoco>
"""


@pytest.mark.parametrize(("offset", "is_stated"), [(0.0, True), (0.2, False)])
def test_shapes_say_whether_a_centre_of_mass_is_at_the_joint(offset, is_stated):
    link = robot_of(compile_xml(SHAPES.format(offset=offset))).links[0]
    assert (CENTRE not in link.placeholders) == is_stated
    com = spatial.com_from_theta(link.reference)[1]
    assert com == pytest.approx([0.0, 0.0, offset], abs=1e-9)


@pytest.mark.fast_cases(2)
@since(3, 1, 0)
@pytest.mark.skipif(not MODELS.is_dir(), reason="the public models are not here")
@pytest.mark.parametrize(
    "model",
    [
        *("kuka_iiwa_14/iiwa14.xml", "franka_fr3/FrankaFR3_7DoF.urdf"),
        *("kinova_gen3/gen3.xml", "universal_robots_ur5e/ur5e.xml"),
        *("so101/so101_new_calib.urdf", "ufactory_xarm7/xarm7_nohand.xml"),
    ],
)
def test_public_models_state_their_links(model):
    robot = load_robot_model(MODELS / model)
    assert not any(link.placeholders for link in robot.links)


@pytest.mark.parametrize(
    ("kind", "factor"), [(INERTIA, 0.1), (INERTIA, 1e6), (INERTIA, 1e9), (CENTRE, 1e3)]
)
def test_a_number_of_one_link_in_another_unit_is_named_and_counts_as_not_known(
    tmp_path, kind, factor
):
    """A tenth of an inertia; one in kg mm2 or g mm2; a centre of mass in mm."""
    bodies = {}
    for number, mass in enumerate(MASSES):
        com = CENTRE_OF_MASS * (factor if (number, kind) == (1, CENTRE) else 1.0)
        inertia = mass * np.diag([0.0035, 0.0034, 0.0008])
        inertia *= factor if (number, kind) == (1, INERTIA) else 1.0
        bodies[f"link{number}"] = mass, com, inertia
    path = urdf.write_bodies(tmp_path, bodies)
    if kind == CENTRE:
        with refused(
            "the centre of mass of link1 is probably wrong.*100 m", ModelError
        ):
            load_robot_model(path)
        return
    robot = load_robot_model(path)
    right = arm(tmp_path)
    (note,) = robot.notes
    assert note.startswith(f"the {kind} of link1 in the model is probably wrong")
    link = robot.links[1]
    assert link.placeholders == link.odd == (kind,)
    expected = spatial.com_from_theta(right.links[1].theta)[1]
    assert spatial.com_from_theta(link.reference)[1] == pytest.approx(expected)
    assert not any(other.odd for other in (*robot.links[:1], *robot.links[2:]))
