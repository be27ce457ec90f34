"""URDF as MuJoCo can compile it; what must not be dropped is an error."""

from __future__ import annotations

import pytest

from rigs.files import urdf
from rigs.files.model_files import document_of, write_files
from rigs.files.refusals import refused
from robot_sysid.errors import ModelError
from robot_sysid.mjcf.assets import find_assets, relocate
from robot_sysid.mjcf.documents import read_document
from robot_sysid.mjcf.updated_model import ModelChange, changed_model_text
from robot_sysid.mjcf.urdf import inertia_increases, make_compilable
from robot_sysid.parser import load_robot_model


def compilable_urdf(document):
    notes = make_compilable(document)
    return document.text(), notes


def moved_text(document, folder):
    relocate(document, folder)
    return document.text()


def arm(tmp_path, content, *more):
    text = urdf.robot(urdf.serial({"l1": content}), *more)
    return document_of(tmp_path, text, "m.urdf")


@pytest.mark.parametrize("setting", ["", "true"])
@pytest.mark.parametrize(("moving", "is_refused"), [((), False), (("l2",), True)])
def test_a_mesh_weighs_nothing_in_a_link_that_no_joint_moves(
    tmp_path, setting, moving, is_refused
):
    """The mesh is that of l3, fixed to l2, which is fixed to the base or not."""
    mesh = urdf.mesh("collision", "x.stl")
    links = {"l1": "", "l2": urdf.inertial(), "l3": mesh, "l4": urdf.inertial()}
    fixed = {"l1", "l2", "l3"}.difference(moving)
    parts = (
        f'<mujoco><compiler inertiafromgeom="{setting}"/></mujoco>' if setting else "",
        urdf.serial(links, fixed),
    )
    document = document_of(tmp_path, urdf.robot(*parts), "arm.urdf")
    if is_refused:
        with refused("mesh x.stl of link 'l3' is not found", ModelError):
            compilable_urdf(document)
        return
    text, (note,) = compilable_urdf(document)
    assert b"x.stl" not in text and "x.stl" in note


@pytest.mark.parametrize(
    ("content", "has_minimum"),
    [
        ("", True),
        (urdf.inertial(mass=0.0, inertia="0 0 0"), True),
        (urdf.inertial(mass=2.0, inertia="0 0 0"), True),
        (urdf.inertial(), False),
    ],
)
def test_the_minimum_goes_to_moving_links_without_inertia(
    tmp_path, content, has_minimum
):
    text, notes = compilable_urdf(arm(tmp_path, content))
    assert (b'ixx="1e-09"' in text) == has_minimum
    assert [("'l1'" in note) for note in notes] == [True] * has_minimum
    if "2.0" in content:
        assert b'<mass value="2.0"/>' in text


def test_a_link_whose_mass_is_welded_to_it_needs_no_minimum(tmp_path):
    more = (urdf.link("tool", urdf.inertial()), urdf.joint("l1", "tool", "fixed"))
    assert compilable_urdf(arm(tmp_path, "", *more))[1] == ()


def document(tmp_path, *elements, name="robots/arm.urdf"):
    return document_of(tmp_path, urdf.robot(*elements, urdf.link("base")), name)


def mesh_found(tmp_path, name, mesh_dir=None):
    """The file that a mesh of this name is."""
    link = urdf.link("l1", urdf.mesh("visual", name))
    path = document(tmp_path, link).path
    (mesh,) = find_assets(read_document(path, mesh_dir))
    return mesh.path


@pytest.mark.parametrize(
    ("name", "mesh"),
    [
        ("meshes/a.stl", "robots/meshes/a.stl"),
        ("package://pack/meshes/a.stl", "pack/meshes/a.stl"),
        ("package://pack/meshes/a.stl", "meshes/a.stl"),
        ("package://pack/meshes/a.stl", "robots/meshes/a.stl"),
        ("model://pack/meshes/a.stl", "pack/meshes/a.stl"),
        ("away/meshes/a.stl", "robots/a.stl"),
        ("meshes\\a.stl", "robots/meshes/a.stl"),
    ],
)
def test_a_mesh_is_found_in_the_folders_above(tmp_path, name, mesh):
    write_files(tmp_path, {mesh: ""})
    assert mesh_found(tmp_path, name) == tmp_path / mesh


@pytest.mark.parametrize("mesh", ["pack/meshes/a.stl", "meshes/a.stl", "a.stl"])
def test_the_users_mesh_folder_comes_first(tmp_path, mesh):
    write_files(tmp_path, {f"mine/{mesh}": "", "robots/meshes/a.stl": ""})
    path = mesh_found(tmp_path, "package://pack/meshes/a.stl", tmp_path / "mine")
    assert path == tmp_path / "mine" / mesh


def test_what_is_missing_or_unreadable_is_not_usable(tmp_path):
    write_files(tmp_path, {"robots/a.dae": "", "robots/b.STL": ""})
    shapes = [urdf.mesh("visual", name) for name in ("a.dae", "b.STL", "c.stl", "")]
    text, _ = compilable_urdf(document(tmp_path, urdf.link("l", "".join(shapes))))
    assert (
        text.count(b"<visual>") == 1 and str(tmp_path / "robots/b.STL").encode() in text
    )


def test_names_are_rewritten_where_the_file_exists_and_kept_elsewhere(tmp_path):
    write_files(tmp_path, {"pack/a.stl": ""})
    shapes = urdf.mesh("visual", "package://pack/a.stl") + urdf.mesh(
        "visual", "gone.dae"
    )
    text = moved_text(document(tmp_path, urdf.link("l", shapes)), tmp_path / "out")
    assert b'filename="../pack/a.stl"' in text and b'filename="gone.dae"' in text
    assert b'<compiler strippath="false"/>' in text


def test_a_mesh_folder_of_the_file_goes_when_the_names_say_it_all(tmp_path):
    write_files(tmp_path, {"robots/m/a.stl": ""})
    setting = '<mujoco><compiler meshdir="m" strippath="true"/></mujoco>'
    link = urdf.link("l", urdf.mesh("collision", "a.stl"))
    text = moved_text(document(tmp_path, setting, link), tmp_path / "out")
    assert b'<compiler strippath="false"/>' in text and b'"../robots/m/a.stl"' in text


@pytest.mark.parametrize(
    ("inertia", "increase"),
    [
        ("0.01 0.02 0.025", None),
        ("0.01 0.02 0.03001", pytest.approx(1.1e-5, rel=0.1)),
        ("-1e-4 0.02 0.0199", pytest.approx(2.02e-4, rel=0.001)),
        ("0.1 0.2 0.30000000000000004", pytest.approx(3e-12, rel=0.1)),
        ("0 0.02 0.02", pytest.approx(2.02e-8, rel=0.01)),
        ("-1 -1 -1", 1.01),
        ("0 0 0", None),
    ],
)
def test_moments_that_no_body_has_lack_what_makes_them_possible(
    tmp_path, inertia, increase
):
    document = arm(tmp_path, urdf.inertial(inertia=inertia))
    assert inertia_increases(document).get("l1") == increase


def test_balanceinertia_mends_all_but_moments_that_are_not_positive(tmp_path):
    setting = '<mujoco><compiler balanceinertia="true"/></mujoco>'
    for inertia, is_mended in (("0.01 0.02 0.1", False), ("-0.1 0.02 0.02", True)):
        document = arm(tmp_path, urdf.inertial(inertia=inertia), setting)
        assert bool(inertia_increases(document)) == is_mended


def test_an_axis_that_no_joint_uses_need_not_be_one(tmp_path):
    """Of a joint that turns it has to."""
    tip = urdf.joint("l2", "tip", "fixed").replace('"0 0 1"', '"100"')
    links = urdf.serial({"l1": urdf.inertial(), "l2": urdf.inertial()})
    text = urdf.robot(links, urdf.link("tip"), tip)
    path = write_files(tmp_path, {"arm.urdf": text})
    robot = load_robot_model(path)
    assert any("axis of joint l2_tip" in note for note in robot.notes)
    path.write_text(text.replace('type="fixed"', 'type="revolute"'))
    with refused("attribute 'xyz' does not have enough data", ModelError):
        load_robot_model(path)


@pytest.mark.parametrize("root", ["world", "odom"])
def test_a_floating_root_is_held_where_the_user_says_so(tmp_path, root):
    links = urdf.serial({"l1": urdf.inertial(), "l2": urdf.inertial()})
    links = links.replace(
        '<link name="base"></link>', f'<link name="base">{urdf.inertial()}</link>'
    )
    joint = urdf.joint(root, "base", "floating")
    text = urdf.robot(urdf.link(root), joint, links)
    path = write_files(tmp_path, {"arm.urdf": text})
    with refused(f"free joint {root}_base carries the arm.*--fix-base", ModelError):
        load_robot_model(path)
    robot = load_robot_model(path, fix_base=True)
    assert robot.joint_names == ("base_l1", "l1_l2")


@pytest.mark.parametrize(
    ("links", "ends"),
    [
        # The first link has a mass, so that it is no world.
        ({"odom": urdf.inertial()}, ("odom", "base")),
        ({"map": "", "world": ""}, ("map", "world")),
        ({"map": "", "odom": ""}, ("odom", "base")),
    ],
)
def test_a_floating_root_that_mujoco_does_not_take_is_held_too(tmp_path, links, ends):
    """The written model has it fixed, so that it loads."""
    parts = [urdf.serial({"l1": urdf.inertial(), "l2": urdf.inertial()})]
    parts += [urdf.link(name, content) for name, content in links.items()]
    parts.append(urdf.joint(*ends, "floating"))
    names = [*links, "base"]
    for pair in zip(names, names[1:]):
        if pair != ends:
            parts.append(urdf.joint(*pair, "fixed"))
    path = write_files(tmp_path, {"arm.urdf": urdf.robot(*parts)})
    with refused(f"free joint {'_'.join(ends)} carries.*--fix-base", ModelError):
        load_robot_model(path)
    robot = load_robot_model(path, fix_base=True)
    assert robot.joint_names == ("base_l1", "l1_l2")
    assert any("is fixed, in a written model too" in note for note in robot.notes)
    change = ModelChange((), rmse=0.0)
    path.write_bytes(changed_model_text(path, change, tmp_path))
    assert load_robot_model(path).joint_names == robot.joint_names
