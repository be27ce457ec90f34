"""A payload or all links in the user's model: what was identified is there, and nothing else."""

from __future__ import annotations

import difflib
from contextlib import contextmanager

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ExportError
from robot_sysid.mjcf.changes import JointChange
from robot_sysid.model.compilation import compile_model
from robot_sysid.model.flange import find_flange
from robot_sysid.model.inertia import body_theta, composite_theta
from robot_sysid.output import model_writing
from robot_sysid.output.model_writing import ModelTarget, write_link, write_links, write_payload
from robot_sysid.parser import load_robot_model
from robot_sysid.records import InertialParameters, Motion
from robot_sysid.records.atomic_files import whole_files
from robot_sysid.simulator import ArmTorque
from tests.support import arms
from tests.support.model_files import (
    ARM,
    INERTIAL,
    random_theta,
    urdf_inertial,
    urdf_joint,
    urdf_link,
    urdf_robot,
    write_files,
)
from tests.support.releases import since

MJCF = ARM.replace(
    '<body name="tool" pos="0 0 0.1" euler="10 20 30">',
    '<body name="tool" pos="0 0 0.1" euler="10 20 30"><site name="flange" pos="0 0.02 0.05" '
    'quat="1 0.2 0.3 -0.4"/>',
)
URDF = urdf_robot(
    urdf_link("base"),
    urdf_link("l1", urdf_inertial()),
    urdf_link("l2", "\n" + urdf_inertial(2.0, "0.1 0.2 0.3")),
    urdf_link("tool", urdf_inertial(0.2)),
    urdf_link("flange"),
    urdf_joint("base", "l1"),
    urdf_joint("l1", "l2"),
    urdf_joint("l2", "tool", "fixed"),
    urdf_joint("tool", "flange", "fixed"),
)
JOINTS = {"xml": "j2", "urdf": "l1_l2"}
SUFFIXES = pytest.mark.parametrize("suffix", list(JOINTS))


@pytest.fixture(scope="module")
def robots(tmp_path_factory):
    """Suffix to the arm in a file of that kind."""
    folder = tmp_path_factory.mktemp("arm")
    write_files(folder, {"arm.xml": MJCF, "arm.urdf": URDF})
    return {
        suffix: load_robot_model(folder / f"arm.{suffix}", joint=joint)
        for suffix, joint in JOINTS.items()
    }


def checkpoints(robot, seed=0):
    q, qd, qdd = arms.random_motion(np.random.default_rng(seed), robot.n_joints, 5)
    return Motion(np.arange(5.0), 0.3 * q, qd, qdd)


@contextmanager
def target_of(robot, folder=None):
    """Where a model goes to; the file is there when the block ends."""
    path = (folder or robot.path.parent / "out") / f"updated{robot.path.suffix}"
    with whole_files() as files:
        yield ModelTarget(files, path, checkpoints(robot), 1.23e-4)


def some_payload(rng):
    return InertialParameters(random_theta(rng, 10.0 ** rng.uniform(-2.0, 1.0)))


def assert_same_theta(found, expected, rtol=1e-11):
    scale = spatial.parameter_scale(expected[0], spatial.characteristic_length(expected))
    assert np.max(np.abs(found - expected) / scale) < rtol


@SUFFIXES
@pytest.mark.parametrize("seed", range(2))
def test_a_payload_is_merged_into_the_terminal_link(robots, suffix, seed):
    robot, rng = robots[suffix], np.random.default_rng(seed)
    payload, flange = some_payload(rng), find_flange(robot)
    with target_of(robot) as target:
        assert write_payload(robot, payload, flange, target) == ()
    written = compile_model(target.path).mj_model
    expected = robot.prior.theta + flange.from_flange(payload.theta)
    assert_same_theta(composite_theta(written, robot.reference_qpos, robot.body_id), expected)
    assert f"with a payload of {payload.mass:.4g} kg in it" in target.path.read_text()


@SUFFIXES
@pytest.mark.parametrize("seed", range(2))
def test_a_payload_becomes_a_body_of_its_own(robots, suffix, seed):
    robot, rng = robots[suffix], np.random.default_rng(seed)
    payload, flange = some_payload(rng), find_flange(robot)
    with target_of(robot) as target:
        assert write_payload(robot, payload, flange, target, as_body="load & co") == ()
    written = compile_model(target.path).mj_model
    new = written.body("load & co")
    assert_same_theta(body_theta(written, new.id), payload.theta)
    assert written.body(int(new.parentid[0])).name == ("tool" if suffix == "xml" else "flange")
    expected = robot.prior.theta + flange.from_flange(payload.theta)
    terminal = written.body(robot.body_name).id
    assert_same_theta(composite_theta(written, robot.reference_qpos, terminal), expected)
    # Everything else is as it was: the terminal link alone weighs what the model says.
    assert_same_theta(body_theta(written, terminal), body_theta(robot.mj_model, robot.body_id))


@SUFFIXES
def test_the_link_alone_can_be_written_beside_its_payload(robots, suffix):
    robot, rng = robots[suffix], np.random.default_rng(3)
    payload, flange = some_payload(rng), find_flange(robot)
    link = InertialParameters(robot.prior.theta + random_theta(rng, 0.4))
    for name in (None, "load"):
        with target_of(robot) as target:
            write_payload(robot, payload, flange, target, link, as_body=name)
        written = compile_model(target.path).mj_model
        whole = composite_theta(written, robot.reference_qpos, written.body(robot.body_name).id)
        assert_same_theta(whole, link.theta + flange.from_flange(payload.theta))
    assert_same_theta(whole - flange.from_flange(payload.theta), link.theta, 1e-9)
    assert "without the payload" in target.path.read_text()


def test_only_lines_are_added_for_a_body_of_its_own(robots):
    robot = robots["xml"]
    with target_of(robot, robot.path.parent) as target:
        write_payload(
            robot,
            some_payload(np.random.default_rng(0)),
            find_flange(robot),
            target,
            as_body="load",
        )
    difference = list(difflib.ndiff(MJCF.splitlines(), target.path.read_text().splitlines()))
    assert [line for line in difference if line.startswith(("- ", "? "))] == []
    comment, opened, inertial, closed = [line[2:] for line in difference if line[:2] == "+ "]
    indent = " " * 12
    assert comment.startswith(f"{indent}<!-- System ID: body 'load' identified with RMSE 0.000123")
    assert "at site 'flange' -->" in comment
    assert opened.startswith(f'{indent}<body name="load" pos="0.0 0.02 0.05" quat="0.88')
    assert inertial.startswith(f"{indent}  <inertial pos=") and closed == f"{indent}</body>"
    target.path.unlink()


def test_the_flanges_place_is_written_without_rounding_dust(robots):
    robot = robots["xml"]
    flange = find_flange(robot, "0.1,0.2,0.3,90,0,0")
    with target_of(robot) as target:
        write_payload(robot, some_payload(np.random.default_rng(0)), flange, target, as_body="x")
    assert '<body name="x" pos="0.1 0.2 0.3" quat="0.70710678' in target.path.read_text()


@SUFFIXES
@pytest.mark.parametrize("name", ["tool", "world", "", " "])
def test_a_name_that_is_taken_is_refused_and_leaves_nothing(robots, suffix, name):
    robot = robots[suffix]
    folder = robot.path.parent / "refused"
    with (
        pytest.raises(ExportError, match="cannot be called") as error,
        target_of(robot, folder) as target,
    ):
        write_payload(
            robot, some_payload(np.random.default_rng(0)), find_flange(robot), target, as_body=name
        )
    assert "tool" in str(error.value) and not folder.exists()


def test_a_joint_name_of_a_urdf_that_is_taken_is_refused(tmp_path):
    text = URDF.replace("l2_tool", "load_joint")
    robot = load_robot_model(write_files(tmp_path, {"arm.urdf": text}), joint="l1_l2")
    with pytest.raises(ExportError, match="called 'load'"), target_of(robot) as target:
        write_payload(
            robot,
            some_payload(np.random.default_rng(0)),
            find_flange(robot),
            target,
            as_body="load",
        )


def test_an_impossible_payload_is_refused(robots):
    robot = robots["xml"]
    theta = spatial.theta_from_com(1.0, np.zeros(3), np.diag([1.0, 1.0, 3.0]))
    with (
        pytest.raises(ExportError, match="'load' are not a possible rigid body"),
        target_of(robot) as target,
    ):
        write_payload(robot, InertialParameters(theta), find_flange(robot), target, as_body="load")


def test_a_compiler_that_would_fuse_the_body_is_refused_by_name(tmp_path):
    text = arms.THREE.replace("<compiler ", '<compiler fusestatic="true" ')
    robot = load_robot_model(write_files(tmp_path, {"arm.xml": text}))
    with (
        pytest.raises(ExportError, match="compiler setting fusestatic"),
        target_of(robot) as target,
    ):
        payload = some_payload(np.random.default_rng(0))
        write_payload(robot, payload, find_flange(robot), target, as_body="load")


def test_a_body_that_comes_with_something_else_is_refused(robots, monkeypatch):
    robot, text = robots["xml"], model_writing.changed_model_text

    def with_a_site(source, change, *rest):
        written = text(source, change, *rest)
        return written.replace(b"<inertial", b"<site/><inertial") if change.welded else written

    monkeypatch.setattr(model_writing, "changed_model_text", with_a_site)
    with (
        pytest.raises(ExportError, match="new body 'load' changes nsite"),
        target_of(robot) as target,
    ):
        payload = some_payload(np.random.default_rng(0))
        write_payload(robot, payload, find_flange(robot), target, as_body="load")


INCLUDING = {
    "scene.xml": '<mujoco><include file="parts/arm.xml"/><worldbody/></mujoco>',
    "parts/arm.xml": '<mujoco><worldbody><include file="link.xml"/></worldbody></mujoco>',
    "parts/link.xml": f"<all><body name='a'><joint name='one'/>{INERTIAL}<body name='b'>"
    f"<joint axis='0 1 0'/>{INERTIAL}<body pos='0 0 .1'/></body></body></all>",
}


@since(3, 1, 6)
def test_a_nameless_empty_body_in_an_include_can_carry_it(tmp_path):
    robot = load_robot_model(write_files(tmp_path, INCLUDING))
    flange = find_flange(robot, "#3")
    before = (tmp_path / "parts/link.xml").read_bytes()
    with target_of(robot) as target:
        write_payload(robot, some_payload(np.random.default_rng(0)), flange, target, as_body="load")
    written = compile_model(target.path).mj_model
    assert written.body("load").parentid[0] == 3
    assert (tmp_path / "parts/link.xml").read_bytes() == before


def new_links(robot, rng):
    """Every link as the model has it, with something bolted to it."""
    return np.array(
        [
            link.theta + random_theta(rng, 0.5) if link.has_mass else link.theta
            for link in robot.links
        ]
    )


def new_joints(robot, rng, names=("armature", "damping", "frictionloss")):
    return [
        JointChange(joint, **dict(zip(names, rng.uniform(0.1, 2.0, len(names)))))
        for joint in robot.joint_names
    ]


@pytest.mark.parametrize("name", sorted(arms.MODELS))
def test_all_links_and_joints_are_written(tmp_path, name):
    rng = np.random.default_rng(7)
    path = write_files(tmp_path, {"arm.xml": arms.MODELS[name]})
    robot = load_robot_model(path)
    thetas, joints = new_links(robot, rng), new_joints(robot, rng)
    with target_of(robot) as target:
        write_links(robot, thetas, target, joints)
    again = load_robot_model(target.path)
    for before, after in zip(thetas, again.links):
        if np.any(before):
            assert_same_theta(after.theta, before)
    dofs = robot.dof_index
    for field in ("armature", "damping", "frictionloss"):
        expected = [change.numbers[field] for change in joints]
        np.testing.assert_array_equal(getattr(again.mj_model, f"dof_{field}")[dofs], expected)
    if all(name[0] != "#" for name in robot.joint_names):
        text = target.path.read_text()
        assert text.count("System ID: body") == sum(link.has_mass for link in robot.links)
        assert f"armature, damping, frictionloss of joint '{robot.terminal_joint}'" in text


def test_a_urdf_gets_friction_but_says_that_it_holds_no_rotor_inertia(robots):
    robot, rng = robots["urdf"], np.random.default_rng(7)
    thetas, joints = new_links(robot, rng), new_joints(robot, rng)
    with target_of(robot) as target:
        notes = write_links(robot, thetas, target, joints)
    assert len(notes) == 1 and "a URDF cannot hold rotor inertia" in notes[0]
    again = load_robot_model(target.path, joint="l1_l2")
    np.testing.assert_array_equal(again.friction.viscous, [joint.damping for joint in joints])
    np.testing.assert_array_equal(again.friction.coulomb, [joint.frictionloss for joint in joints])
    for before, after in zip(thetas, again.links):
        assert_same_theta(after.theta, before)


def test_a_joint_that_is_not_named_keeps_its_numbers(tmp_path):
    robot = load_robot_model(write_files(tmp_path, {"arm.xml": arms.DRY_FRICTION}))
    with target_of(robot) as target:
        write_links(
            robot,
            new_links(robot, np.random.default_rng(0)),
            target,
            [JointChange("joint1", damping=0.25)],
        )
    written = compile_model(target.path).mj_model
    np.testing.assert_array_equal(written.dof_damping, [2.0, 0.25, 2.0])
    np.testing.assert_array_equal(written.dof_frictionloss, [1.5, 1.5, 1.5])


@pytest.mark.parametrize("name", sorted(arms.MODELS))
def test_an_offset_is_a_torque_that_motion_takes_both_ways(tmp_path, name):
    robot = load_robot_model(write_files(tmp_path, {"arm.xml": arms.MODELS[name]}))
    own = robot.mj_model.jnt_stiffness[robot.mj_model.dof_jntid[robot.dof_index]]
    offsets = np.where(own == 0.0, np.linspace(-0.4, 0.5, robot.n_joints), np.nan)
    asked = [
        JointChange(joint, offset=float(offset))
        for joint, offset in zip(robot.joint_names, offsets)
        if np.isfinite(offset)
    ]
    thetas = np.array([link.theta for link in robot.links])
    with target_of(robot) as target:
        write_links(robot, thetas, target, asked)
    motion = checkpoints(robot, seed=4)
    before, after = (ArmTorque(each)(motion) for each in (robot, load_robot_model(target.path)))
    np.testing.assert_allclose(after - before, np.tile(np.nan_to_num(offsets), (5, 1)), atol=5e-3)


def test_a_joint_of_another_name_than_in_the_file_is_refused(robots):
    robot = robots["xml"]
    with (
        pytest.raises(ExportError, match="joint 'j9' is not written out"),
        target_of(robot) as target,
    ):
        write_links(
            robot,
            new_links(robot, np.random.default_rng(0)),
            target,
            [JointChange("j9", damping=0.25)],
        )


def test_a_link_is_not_written_where_a_later_joint_moves_its_body(tmp_path):
    robot = load_robot_model(write_files(tmp_path, {"arm.xml": arms.SHARED_BODIES}))
    thetas = new_links(robot, np.random.default_rng(0))
    thetas[0] = thetas[2]
    with (
        pytest.raises(ExportError, match="joint yaw moves no link of its own"),
        target_of(robot) as target,
    ):
        write_links(robot, thetas, target)


RIGHT_ANGLES = [
    f"0,0,0.1,{r},{p},{y}" for r in (0, 90) for p in (90, -90, 89.99979) for y in (0, 7)
]


@pytest.mark.parametrize("place", RIGHT_ANGLES)
def test_a_urdf_can_hold_a_flange_at_a_right_angle(robots, place):
    """Where roll and yaw turn about one axis, or nearly so."""
    robot = robots["urdf"]
    with target_of(robot) as target:
        payload = some_payload(np.random.default_rng(0))
        write_payload(robot, payload, find_flange(robot, place), target, as_body="load")


def test_a_springdamper_is_stronger_than_a_damping_and_says_so(tmp_path):
    text = arms.THREE.replace('<joint name="joint1"', '<joint name="joint1" springdamper=".1 1"')
    robot = load_robot_model(write_files(tmp_path, {"arm.xml": text}))
    with pytest.raises(ExportError, match="springdamper"), target_of(robot) as target:
        write_links(
            robot,
            np.array([link.theta for link in robot.links]),
            target,
            [JointChange("joint1", damping=0.25)],
        )


def test_a_result_that_the_file_does_not_reproduce_is_withdrawn(robots, monkeypatch):
    robot = robots["xml"]
    folder = robot.path.parent / "withdrawn"
    monkeypatch.setattr(model_writing, "changed_model_text", lambda *_: MJCF.encode())
    for write in (
        lambda target: write_link(robot, InertialParameters(2.0 * robot.prior.theta), target),
        lambda target: write_links(robot, new_links(robot, np.random.default_rng(0)), target),
        lambda target: write_payload(
            robot, some_payload(np.random.default_rng(0)), find_flange(robot), target, None, "load"
        ),
    ):
        with pytest.raises(ExportError), target_of(robot, folder) as target:
            write(target)
        assert not folder.exists()


@pytest.mark.slow
@given(arms.random_chain(), arms.SEEDS, st.sampled_from(["links", "merged", "own body"]))
def test_any_arm_takes_any_links_and_any_payload(tmp_path_factory, xml, seed, what):
    """Several joints to a body, slides, fingers, any frame: every written model is compiled,
    compared and moved by the writing itself."""
    rng = np.random.default_rng(seed)
    path = write_files(tmp_path_factory.mktemp("any"), {"arm.xml": xml})
    compiled = mujoco.MjModel.from_xml_string(xml)
    carried = [compiled.body(body).name for body in compiled.jnt_bodyid]
    last = max(k for k, name in enumerate(carried) if not name.endswith("finger"))
    robot = load_robot_model(path, joint=f"#{last}")
    place = ", ".join(str(value) for value in (*rng.uniform(-1.0, 1.0, 3), 10, 20, 30))
    flange, payload = find_flange(robot, place), some_payload(rng)
    with target_of(robot) as target:
        if what == "links":
            write_links(robot, new_links(robot, rng), target, new_joints(robot, rng))
        else:
            name = "load" if what == "own body" else None
            write_payload(robot, payload, flange, target, as_body=name)
    assert target.path.is_file()


@given(st.floats(0.0, 1.0), arms.SEEDS)
def test_errors_say_how_far_moments_may_be_inflated(robots, error, seed):
    errors = np.random.default_rng(seed).uniform(2.0, 3.0, 10)
    errors[7] = error
    tolerance = model_writing.moment_tolerance(robots["xml"], errors)
    assert tolerance.most_inflated == error
    assert model_writing.moment_tolerance(robots["xml"], None).most_inflated == 0.0
    assert model_writing.moment_tolerance(robots["xml"], np.full(10, np.inf)).most_inflated == 0.0
