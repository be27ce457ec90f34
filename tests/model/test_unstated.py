"""Bodies of the geometry stand for links of which a model states no masses, or one for all."""

from __future__ import annotations

import re

import numpy as np
import pytest

from rigs.files import urdf
from rigs.files.refusals import refused
from robot_sysid import self_test, spatial
from robot_sysid.damiao.safety.holding import refuse_guessed_masses
from robot_sysid.errors import InputError, ModelError
from robot_sysid.model.bodies import body_theta
from robot_sysid.model.units import as_stated
from robot_sysid.model.unstated import ARM_DENSITY, SHAPE_DENSITY
from robot_sysid.parser import load_robot_model
from robot_sysid.records import KINDS

NAMES = ("l1", "l2", "l3", "l4")
SIDES = {"base": 0.1, "l1": 0.1, "l2": 0.08, "l3": 0.08, "l4": 0.05}
"""Side of a cube of each link [m]."""
STATED = {"mass": 2.0, "inertia": "0.01 0.02 0.025"}
SAME = {
    "a hundredth of a kilogram": {"mass": 0.01, "inertia": "1e-5 1e-5 1e-5"},
    "a hundredth, with large inertias": {"mass": 0.01, "inertia": ".01 .01 .01"},
    "one of all": {"mass": 1, "inertia": "1 1 1"},
    "nothing": {"mass": 0, "inertia": "0 0 0"},
}
"""What people put in all links, who have no masses."""


def cube(name, shape="collision"):
    size = " ".join(3 * [str(SIDES[name])])
    return f'<{shape}><origin xyz="0 0 .1"/><geometry><box size="{size}"/></geometry></{shape}>'


def arm(folder, inertial="", shape="", changed=()):
    """The path of an arm of four links; those in ``changed`` state a mass of 2 kg."""
    parts = [urdf.link("base", cube("base", shape) if shape else "")]
    for before, name in zip(("base", *NAMES), NAMES):
        content = urdf.inertial(**STATED) if name in changed else inertial
        content += cube(name, shape) if shape else ""
        parts += [urdf.link(name, content), urdf.joint(before, name)]
    path = folder / "arm.urdf"
    path.write_text(urdf.robot(*parts))
    return path


@pytest.mark.parametrize("inertial", [*SAME.values(), None], ids=[*SAME, "none"])
@pytest.mark.parametrize("shape", ["", "collision", "visual"])
def test_bodies_of_the_geometry_stand_for_the_links(tmp_path, inertial, shape):
    content = urdf.inertial(**inertial) if inertial else ""
    robot = load_robot_model(arm(tmp_path, content, shape))
    assert robot.lacks_masses
    for link in robot.links:
        assert link.placeholders == KINDS
        assert spatial.is_consistent(link.theta)
        assert np.all(link.reference == link.theta)
    masses = robot.thetas[:, 0]
    if shape:
        volumes = np.array([SIDES[name] for name in NAMES]) ** 3
        assert masses == pytest.approx(SHAPE_DENSITY * volumes)
    else:
        # Three ways of 0.2 m between the joints.
        assert robot.mass == pytest.approx(ARM_DENSITY * 0.6**3)
    (note,) = [note for note in robot.notes if "geometry" in note]
    assert f"{robot.mass:.3g} kg" in note
    assert "--total-mass KG" in note
    assert not any("was given" in note for note in robot.notes)


@pytest.mark.parametrize("slid", [-0.4, -0.2, 0.1])
def test_where_on_its_axis_a_joint_has_its_frame_moves_no_rod(tmp_path, slid):
    """The forearm of many arms lies before the frame of its link, which is in the wrist."""
    path = arm(tmp_path)
    rod = load_robot_model(path).links[2]
    text = path.read_text()
    _, third, fourth = re.findall(r'<joint name="l.*?</joint>', text)
    # The third link's frame is turned by 0.1 about x, and slid along its own z axis.
    y, z = -slid * np.sin(0.1), 0.2 + slid * np.cos(0.1)
    text = text.replace(third, third.replace("0 0 0.2", f"0 {y} {z}"))
    text = text.replace(fourth, fourth.replace("0 0 0.2", f"0 0 {0.2 - slid}"))
    path.write_text(text)
    moved = load_robot_model(path).links[2]
    _, centre, inertia = spatial.com_from_theta(rod.theta / rod.theta[0])
    _, moved_centre, moved_inertia = spatial.com_from_theta(
        moved.theta / moved.theta[0]
    )
    assert moved_centre + [0.0, 0.0, slid] == pytest.approx(centre)
    assert moved_inertia == pytest.approx(inertia)


def test_what_the_file_states_is_kept_for_its_writer(tmp_path):
    robot = load_robot_model(arm(tmp_path, urdf.inertial(**SAME["one of all"])))
    stated = as_stated(robot)
    assert np.all(stated.thetas[:, 0] == 1.0)
    assert not stated.lacks_masses
    for link in stated.links:
        assert body_theta(stated.mj_model, link.body_id)[0] == 1.0


@pytest.mark.parametrize("number", [*SAME.values()][:3], ids=[*SAME][:3])
def test_a_self_test_takes_the_numbers_that_the_file_has(tmp_path, number):
    """Bodies of the geometry are for logs; the output says of which links."""
    result = self_test(arm(tmp_path, urdf.inertial(**number)), duration=3.0, seed=1)
    mass = float(number["mass"])
    assert result.robot.thetas[:, 0] == pytest.approx(mass)
    assert result.total.mass == pytest.approx(mass, rel=1e-6)
    (note,) = [note for note in result.robot.notes if "geometry" in note]
    assert f"mass, centre of mass, inertia of {', '.join(NAMES)}" in note
    assert "with a log a body" in note
    written = result.save(tmp_path / "found")
    (file,) = [path for path in written if path.suffix == ".urdf"]
    masses = re.findall(r'<mass value="(.*?)"', file.read_text())
    assert [float(value) for value in masses] == pytest.approx([mass] * len(NAMES))


def test_a_self_test_has_bodies_of_the_geometry_where_the_file_has_no_number(tmp_path):
    path = arm(tmp_path, changed=("l4",))
    result = self_test(path, duration=3.0, seed=1)
    assert result.robot.lacks_masses
    assert result.total.mass == pytest.approx(2.0, rel=1e-6)
    (note,) = [note for note in result.robot.notes if "geometry" in note]
    assert "the masses of l1, l2, l3, " in note


@pytest.mark.parametrize("shape", ["", "collision"])
def test_the_mass_of_the_data_sheet_is_spread_by_volume(tmp_path, shape):
    """The base, of which it has a part, is no link."""
    robot = load_robot_model(arm(tmp_path, shape=shape), total_mass=10.0)
    volumes = np.array([*SIDES.values()]) ** 3
    share = 1.0 - (volumes[0] / np.sum(volumes) if shape else 0.0)
    assert robot.mass == pytest.approx(10.0 * share)
    (note,) = [note for note in robot.notes if "geometry" in note]
    assert "10 kg" in note


def test_it_overrules_masses_that_are_stated(tmp_path):
    path = arm(tmp_path, urdf.inertial(**STATED))
    assert not load_robot_model(path).lacks_masses
    robot = load_robot_model(path, total_mass=3.0)
    assert robot.lacks_masses
    assert robot.mass == pytest.approx(3.0)


def test_links_that_state_a_mass_keep_it(tmp_path):
    path = arm(tmp_path, shape="collision", changed=("l2",))
    robot = load_robot_model(path, total_mass=5.0)
    assert robot.links[1].theta[0] == 2.0
    assert not robot.links[1].placeholders
    with refused("links that state their mass weigh 2 kg", InputError):
        load_robot_model(path, total_mass=1.0)


def test_one_link_without_a_mass_makes_no_guess_of_all(tmp_path):
    robot = load_robot_model(arm(tmp_path, changed=("l1", "l2", "l3")))
    assert not robot.lacks_masses
    assert robot.links[-1].placeholders


def test_shapes_that_are_none_of_an_arm_say_nothing(tmp_path):
    path = arm(tmp_path, shape="collision")
    text = path.read_text().replace('box size="0.', 'box size="10.')
    path.write_text(text)
    assert load_robot_model(path).mass == pytest.approx(ARM_DENSITY * 0.6**3)


def test_masses_in_another_unit_are_no_placeholders(tmp_path):
    bodies = {
        name: (1e-3 * mass, np.array([0.0, 0.0, 0.1]), 1e-5 * mass * np.diag([3, 4, 5]))
        for name, mass in zip(NAMES, (4.0, 3.0, 2.0, 1.0))
    }
    with refused("foam or more than lead", ModelError):
        load_robot_model(urdf.write_bodies(tmp_path, bodies))


def test_meshes_that_nobody_reads_leave_lengths(tmp_path):
    path = arm(tmp_path)
    mesh = urdf.mesh("collision", "arm.dae")
    path.write_text(path.read_text().replace("</link>", f"{mesh}</link>"))
    robot = load_robot_model(path)
    assert robot.lacks_masses
    assert robot.lacks_meshes


def test_no_motor_is_led_by_guessed_masses(tmp_path):
    robot = load_robot_model(arm(tmp_path))
    with refused("states no masses that motors could carry the arm by", InputError):
        refuse_guessed_masses(robot)
