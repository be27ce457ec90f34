"""The written model holds what was identified, and nothing else of the user's model has changed.

A model in memory needs no file.
"""

from __future__ import annotations

import itertools
import re
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from lxml import etree
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx

from rigs.arms import small_arms
from rigs.arms.small_arms import random_theta
from rigs.files import results as made
from rigs.files import urdf
from rigs.files.model_files import ARM, write_files
from rigs.files.releases import since
from robot_sysid import records, spatial
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics, LinkDynamics
from robot_sysid.errors import ExportError
from robot_sysid.estimate.choose import coupling, motors_of
from robot_sysid.model.bodies import body_theta, find_flange
from robot_sysid.model.compilation import compile_model
from robot_sysid.model.units import mass_unit
from robot_sysid.parser import load_robot_model
from robot_sysid.records.file_access import atomic_files
from robot_sysid.records.quantities import FILE, BodyEstimate, Quantity, body_quantities
from robot_sysid.results.record import PAYLOAD, ModelTarget, Payload
from robot_sysid.results.verdicts import Verdict
from robot_sysid.results.written_model import write_model

MJCF = ARM.replace(
    '<body name="tool" pos="0 0 0.1" euler="10 20 30">',
    '<body name="tool" pos="0 0 0.1" euler="10 20 30"><site name="flange" pos="0 0.02 0.05" '
    'quat="1 0.2 0.3 -0.4"/>',
)
HEAVY = urdf.inertial(2.0, "0.1 0.2 0.3")
LIGHT = urdf.inertial(0.2)
LINKS = {"l1": urdf.inertial(), "l2": f"\n{HEAVY}", "tool": LIGHT, "flange": ""}
URDF = urdf.robot(urdf.serial(LINKS, fixed=("tool", "flange")))
JOINTS = {"xml": "j2", "urdf": "l1_l2"}
SUFFIXES = pytest.mark.parametrize("suffix", list(JOINTS))
FIELDS = {"armature": "armature", "damping": "viscous", "frictionloss": "coulomb"}
"""Number of a joint in an MJCF to its name in a row."""
TURNED = np.array([1.1, -0.7, -9.6])


@pytest.fixture(scope="module")
def robots(tmp_path_factory):
    """Suffix to the arm in a file of that kind."""
    folder = tmp_path_factory.mktemp("arm")
    write_files(folder, {"arm.xml": MJCF, "arm.urdf": URDF})
    return {
        suffix: load_robot_model(folder / f"arm.{suffix}", joint=joint)
        for suffix, joint in JOINTS.items()
    }


def checkpoints(robot):
    """A random motion of 5 samples at which torques are compared."""
    q, qd, qdd = small_arms.random_motion(np.random.default_rng(0), robot.n_joints, 5)
    return records.Motion(np.arange(5.0), 0.3 * q, qd, qdd)


def load_arm(folder, xml, joint=None):
    """The arm of an MJCF text, which is written to a file in the folder."""
    return load_robot_model(write_files(folder, {"arm.xml": xml}), joint=joint)


class WrittenModel(NamedTuple):
    path: Path
    mj_model: mujoco.MjModel
    notes: tuple[str, ...]


def write_and_compile(
    robot,
    result,
    folder=None,
    as_body=None,
    file_kind=None,
    through=lambda files: files,
):
    """Write the model of a result, by default into the folder ``out`` beside the original.

    ``through`` returns what receives drafts in the place of the files.
    """
    path = (folder or robot.path.parent / "out") / f"updated{robot.path.suffix}"
    with atomic_files() as files:
        target = ModelTarget(through(files), path, checkpoints(robot))
        kind = file_kind or result.model_kind
        notes = write_model(result, target, as_body, kind)
    return WrittenModel(path, compile_model(path).mj_model, notes)


def file_of(joints, gravity=None, motors=()):
    """What a written model should hold beside links, as fields of a result.

    ``joints``: joint or motor to its numbers by their names in MJCF.
    """
    rows = []
    for owner, numbers in joints.items():
        for attribute, value in numbers.items():
            rows.append(Quantity(FIELDS[attribute], owner, "", None, value, 0, FILE))
    return {"quantities": rows, "file": made.model_file(gravity=gravity, motors=motors)}


def payload_of(robot, theta, flange_position=None):
    """A payload with the parameters theta (10,) in the flange frame."""
    flange = find_flange(robot, flange_position)
    recordings = {"empty": ("a",), "loaded": ("b", "c")}
    body = vars(BodyEstimate(theta, "load"))
    return Payload(**body, flange=flange, recordings=recordings)


def result_of(robot, theta=None, **changes):
    """A result with the parameters theta (10,) of the terminal link, by default the model's own."""
    thetas = robot.thetas
    if theta is not None:
        thetas[-1] = theta
    link = BodyEstimate(thetas[-1], robot.body_name)
    changes = {"verdict": Verdict.OK, "thetas": thetas, **changes}
    if changes.get("payload") is not None:
        payload = replace(changes["payload"], name=PAYLOAD)
        total = replace(link, name=f"{robot.body_name} with payload")
        bodies = (payload, link, total)
        rows = [row for body in bodies for row in body_quantities(body)]
        changes["quantities"] = (*rows, *changes.get("quantities", ()))
    return made.found(robot=robot, total=link, **changes)


def some_payload(rng):
    """Parameters (10,) of a random body of 0.01 to 10 kg."""
    return random_theta(rng, 10.0 ** rng.uniform(-2.0, 1.0))


def terminal_composite(mj_model, robot):
    """The parameters (10,) in a model of the terminal link with all bodies that it carries."""
    terminal = mj_model.body(robot.body_name).id
    return small_arms.composite_theta(mj_model, robot.reference_qpos, terminal)


def assert_same_theta(actual, expected, rtol=1e-11):
    """Compare parameters (10,) relative to those of the body's mass and size."""
    scale = spatial.parameter_scale(
        expected[0], spatial.characteristic_length(expected)
    )
    assert np.max(np.abs(actual - expected) / scale) < rtol


@SUFFIXES
def test_without_a_file_the_terminal_link_alone_is_written(robots, suffix):
    robot = robots[suffix]
    theta = robot.prior.theta + random_theta(np.random.default_rng(1), 0.5)
    _, mj_model, notes = write_and_compile(robot, result_of(robot, theta))
    assert notes == ()
    assert_same_theta(terminal_composite(mj_model, robot), theta)
    masses = robot.mj_model.body_mass.copy()
    masses[robot.body_id] = mj_model.body_mass[robot.body_id]
    assert_array_equal(mj_model.body_mass, masses)
    assert_array_equal(mj_model.opt.gravity, robot.mj_model.opt.gravity)


@pytest.mark.parametrize(
    ("suffix", "flange_position", "name", "has_file"),
    [
        ("xml", None, None, True),
        ("xml", None, "load & co", False),
        ("urdf", None, None, False),
        # Where roll and yaw turn about one axis, or nearly so, a URDF states a flange all the same.
        ("urdf", "0,0,0.1,90,90,0", "load & co", True),
        ("urdf", "0,0,0.1,90,89.99979,7", "load & co", False),
    ],
)
def test_a_payload_goes_onto_the_links_of_the_file_or_model(
    robots, suffix, flange_position, name, has_file
):
    """Merged with the last link, or as a body of its own."""
    robot = robots[suffix]
    rng = np.random.default_rng(3)
    theta = some_payload(rng)
    payload = payload_of(robot, theta, flange_position)
    thetas = robot.thetas
    file = {}
    if has_file:  # what it says of the terminal link counts, not what the payload does
        thetas = new_links(robot, rng)
        joints = dict.fromkeys(robot.joint_names, {"frictionloss": 0.25})
        file = file_of(joints, TURNED)
    result = result_of(robot, thetas=thetas, **file, payload=payload)
    path, mj_model, notes = write_and_compile(robot, result, as_body=name)
    # Gravity of a URDF is said, too, as others turn the base.
    assert len(notes) == (has_file and suffix == "urdf")
    expected = thetas[-1] + payload.flange.from_flange(theta)
    assert_same_theta(terminal_composite(mj_model, robot), expected)
    if name is not None:
        load = mj_model.body(name)
        assert_same_theta(body_theta(mj_model, load.id), theta)
        assert mj_model.body(int(load.parentid[0])).name == robot.body_name
        assert ("without the payload" in path.read_text()) == has_file
    if has_file:
        assert_array_equal(mj_model.opt.gravity, TURNED)
        assert_array_equal(mj_model.dof_frictionloss[robot.dof_index], 0.25)
        reloaded = load_robot_model(path, joint=JOINTS[suffix])
        assert_same_theta(reloaded.links[0].theta, thetas[0])


@SUFFIXES
@pytest.mark.parametrize("name", ["tool", " "])
def test_a_name_that_is_taken_is_refused_and_leaves_nothing(robots, suffix, name):
    robot = robots[suffix]
    folder = robot.path.parent / "refused"
    theta = some_payload(np.random.default_rng(0))
    result = result_of(robot, payload=payload_of(robot, theta))
    with pytest.raises(ExportError, match="cannot be called"):
        write_and_compile(robot, result, folder, as_body=name)
    assert not folder.exists()


@since(3, 1)
def test_a_body_of_its_own_changes_a_damping_that_follows_from_the_inertia(tmp_path):
    servo = '<actuator><position joint="j2" kp="10" dampratio="1"/></actuator></mujoco>'
    robot = load_arm(tmp_path, MJCF.replace("</mujoco>", servo), "j2")
    payload = payload_of(robot, some_payload(np.random.default_rng(0)))
    result = result_of(robot, payload=payload)
    mj_model = write_and_compile(robot, result, as_body="load").mj_model
    assert mj_model.actuator_biasprm[0, 2] < robot.mj_model.actuator_biasprm[0, 2] < 0.0


def new_links(robot, rng):
    """The parameters (n_links, 10) of the model's links with a random body bolted to each."""
    thetas = robot.thetas
    for theta, link in zip(thetas, robot.links):
        if link.has_mass:
            theta += random_theta(rng, 0.5)
    return thetas


def new_joints(robot, rng):
    """Random rotor inertia and friction of each joint."""
    joints = {}
    for joint in robot.joint_names:
        joints[joint] = dict(zip(FIELDS, rng.uniform(0.1, 2.0, 3)))
    return joints


ROTORS = """<actuator><motor joint="joint1" gear="3" armature=".02" damping=".1"/>
<motor joint="joint2" armature=".3"/><motor joint="joint2" gear="2" armature=".01" damping=".05"/>
</actuator>"""


@since(3, 7)
@pytest.mark.parametrize("factor", [0.0, 2.5])
def test_rotors_and_damping_stated_at_actuators_move_to_their_joints(tmp_path, factor):
    """The sum is what was identified; the written file has it at the joint."""
    xml = small_arms.serial_arm(
        (small_arms.Z, small_arms.Y, small_arms.X), joint='armature=".1"', extra=ROTORS
    )
    robot = load_arm(tmp_path, xml)
    numbers = np.array([[0.1, 0.1 + 0.18, 0.1 + 0.3 + 0.04], [0.0, 0.9, 0.2]])
    assert_allclose((robot.armature, robot.friction.viscous), numbers)
    joints = {}
    for name, values in zip(robot.joint_names, factor * numbers.T):
        joints[name] = dict(zip(FIELDS, values))
    result = result_of(robot, **file_of(joints))
    reloaded = load_robot_model(write_and_compile(robot, result).path)
    model = reloaded.mj_model
    written = reloaded.armature, reloaded.friction.viscous
    assert_allclose(written, factor * numbers, rtol=1e-12)
    assert_allclose(model.dof_dampingpoly, robot.mj_model.dof_dampingpoly, rtol=1e-12)
    for name in ("armature", "damping", "dampingpoly"):
        assert not np.any(getattr(model, f"actuator_{name}"))


LUGRE = (
    '<dcmotor joint="joint{}" gear="2" motorconst="1e-3 1e-3" resistance="1" lugre="{}"/>',
    '<general joint="joint{}" gear="2" dyntype="dcmotor" gaintype="dcmotor" biastype="dcmotor" '
    'actdim="1" actearly="true" actlimited="false" gainprm="1 1e-3" dynprm="0 0 0 0 0 1e3 5" '
    'biasprm="0 0 0 .5 .6 .1"/>',
)


@since(4)
@pytest.mark.parametrize("motor", LUGRE)
def test_friction_of_motors_and_springs_that_yield_gives_way_to_identified(
    tmp_path, motor
):
    """It is in the written file once, by MuJoCo's own simulation, at a joint that slides."""
    xml = small_arms.serial_arm(
        (small_arms.Z, small_arms.Y, small_arms.X),
        joint='stiffness="100" springyield=".3" limited="true" range="-9 9"',
        extra=f"<actuator>{motor.format(2, '1e3 5 .5 .6 .1')}"
        '<position joint="joint1" kp="5"/></actuator>',
    )
    robot = load_arm(tmp_path, xml)
    yielding = 100.0 * robot.mj_model.jnt_springyield
    assert_allclose(robot.friction.coulomb, yielding + [0.0, 0.0, 1.0])
    rng = np.random.default_rng(0)
    joints = new_joints(robot, rng)
    result = result_of(robot, **file_of(joints))
    path = write_and_compile(robot, result).path
    model = mujoco.MjModel.from_xml_path(str(path))
    dry = [numbers["frictionloss"] for numbers in joints.values()]
    assert_allclose(model.dof_frictionloss, dry)
    model.dof_frictionloss[:] = 0.0
    model.dof_damping[:] = 0.0
    model.opt.gravity[:] = 0.0
    model.dof_armature[:] = 1e9
    data = mujoco.MjData(model)
    data.qvel[2] = 0.4
    for _ in range(100):
        mujoco.mj_step(model, data)
    # What the motor brakes by its voltage is left.
    assert_allclose(data.qfrc_passive + data.qfrc_actuator, 0.0, atol=1e-5)


@since(4)
def test_friction_of_a_class_of_motors_is_written_out_first(tmp_path):
    motor = LUGRE[1].format(2).replace('dynprm="0 0 0 0 0 1e3 5"', "")
    xml = small_arms.serial_arm(
        (small_arms.Z, small_arms.Y, small_arms.X),
        extra='<default><general dynprm="0 0 0 0 0 1e3 5"/></default>'
        f"<actuator>{motor}</actuator>",
    )
    robot = load_arm(tmp_path, xml)
    joints = new_joints(robot, np.random.default_rng(0))
    with pytest.raises(
        ExportError, match=r"LuGre friction of actuator number 0 is not"
    ):
        write_and_compile(robot, result_of(robot, **file_of(joints)))


SLACK = small_arms.TENDON_SPRING.replace(
    'stiffness="25" springlength=".2" damping="3"', ""
)
RATIOS = np.array([0.0, 1.0, -2.0])


def with_motor(robot, seed):
    """What a file holds: every link, every joint, and a motor that turns two joints; the last two
    as they were drawn, too."""
    rng = np.random.default_rng(seed)
    (motor,) = motors_of(robot, "chain")[0] or (coupling(robot, RATIOS),)
    joints = new_joints(robot, rng)
    joints[motor.name] = new_joints(robot, rng)["joint1"]
    if "armature" not in robot.path.read_text().partition("<fixed")[2]:
        # MuJoCo before 3.2.7 has no rotor inertia of tendons.
        del joints[motor.name]["armature"]
    file = file_of(joints, motors=(motor,))
    return {"thetas": new_links(robot, rng), **file}, joints


@pytest.mark.parametrize(
    "source",
    [small_arms.THREE, SLACK, pytest.param(small_arms.SHARED_MOTOR, marks=since(3, 3))],
)
def test_a_motor_that_turns_two_joints_is_a_fixed_tendon(tmp_path, source):
    robot = load_arm(tmp_path, source)
    file, joints = with_motor(robot, 7)
    path = write_and_compile(robot, result_of(robot, **file)).path
    assert "motor that turns joint1 and joint2 identified with" in path.read_text()
    reloaded = load_robot_model(path)
    model = reloaded.mj_model
    assert model.ntendon == max(robot.mj_model.ntendon, 1) + (source == SLACK)
    assert model.tendon_stiffness[-1] == 0.0

    # What the file takes is the torque of what was identified.
    motion = checkpoints(robot)
    links = LinkDynamics(robot).motion(motion.q, motion.qd, motion.qdd)
    expected = links.torque(file["thetas"])
    # Row i of the transmission (4, 3) is the speed of owner i: the joints, then the motor.
    transmission = np.vstack((np.eye(3), RATIOS))
    for values, ratios in zip(joints.values(), transmission):
        speed = motion.qd @ ratios
        torque = values["frictionloss"] * np.sign(speed) + values["damping"] * speed
        torque += values.get("armature", 0.0) * (motion.qdd @ ratios)
        expected += np.outer(torque, ratios)
    assert_allclose(ArmDynamics(reloaded)(motion), expected, rtol=1e-9, atol=1e-9)

    # Written again, it is the same motor with other numbers.
    file, joints = with_motor(reloaded, 8)
    path = write_and_compile(reloaded, result_of(reloaded, **file)).path
    (motor,) = motors_of(load_robot_model(path), "chain")[0]
    assert_array_equal(motor.model[0], joints[motor.name]["frictionloss"])


@pytest.mark.parametrize("ratio", [1.0, 50.0])
def test_what_no_urdf_can_hold_is_in_an_mjcf_beside_it(tmp_path, ratio):
    """Both have the same links; the URDF has rotors in transmissions and no motor of two joints.

    So gravity is the same; no reader takes links for the rotors that it does not know.
    """
    links = {"l1": urdf.inertial(), "l2": HEAVY, "l3": LIGHT}
    stated = (
        '<transmission name="t"><joint name="l1_l2"/><actuator name="m">'
        "<mechanicalReduction>-50</mechanicalReduction></actuator></transmission>"
    )
    text = urdf.robot(urdf.serial(links), stated if ratio > 1.0 else "")
    robot = load_robot_model(write_files(tmp_path, {"arm.urdf": text}))
    motor = coupling(robot, np.eye(robot.n_joints)[:2].sum(axis=0))
    joints = {
        motor.name: {"frictionloss": 0.5},
        "l1_l2": {"armature": 0.1, "frictionloss": 0.2},
    }
    thetas = new_links(robot, np.random.default_rng(0))
    result = result_of(robot, thetas=thetas, **file_of(joints, motors=(motor,)))
    for one_alone in ({"file": None}, {"quantities": ()}):
        assert replace(result, **one_alone).model_kind == "mjcf"
    mjcf = load_robot_model(write_and_compile(robot, result).path)
    folder = tmp_path / "urdf"
    written = write_and_compile(robot, result, folder, file_kind="urdf")
    of_urdf = load_robot_model(written.path)
    assert mjcf.kind == "mjcf" and mjcf.joint_names == robot.joint_names
    assert mjcf.mj_model.tendon_frictionloss.tolist() == [0.5]
    assert mjcf.armature.tolist() == [0.0, 0.1, 0.0]
    assert not np.any(of_urdf.armature) and of_urdf.friction.coulomb[1] == 0.2
    for theta, link, other in zip(thetas, mjcf.links, of_urdf.links):
        assert_same_theta(link.theta, theta)
        assert_same_theta(other.theta, theta)
    q = np.random.default_rng(1).uniform(-1.0, 1.0, (100, robot.n_joints))
    weights = []
    for arm in (mjcf, of_urdf):
        moves = LinkDynamics(arm).motion(q, 0.0 * q, 0.0 * q)
        weights.append(moves.torque(arm.thetas))
    # MuJoCo writes an MJCF's frames with six digits.
    assert_allclose(*weights, rtol=1e-4, atol=1e-5)
    (transmission,) = etree.parse(str(of_urdf.path)).getroot().findall("transmission")
    numbers = {}
    for node in transmission.find("actuator"):
        if node.get("value"):
            numbers[etree.QName(node).localname] = float(node.get("value"))
    assert transmission.find("joint").get("name") == "l1_l2"
    assert numbers == {"rotor_inertia": approx(0.1 / ratio**2), "gear_ratio": ratio}


def test_a_link_is_not_written_where_a_later_joint_moves_its_body(tmp_path):
    robot = load_arm(tmp_path, small_arms.SHARED_BODIES)
    thetas = new_links(robot, np.random.default_rng(0))
    thetas[0] = thetas[2]
    with pytest.raises(ExportError, match="joint yaw moves no link of its own"):
        write_and_compile(robot, result_of(robot, thetas=thetas))


class UnchangedFiles:
    """Files that keep the original model's text whatever is written."""

    def __init__(self, files):
        self.withdraw = files.withdraw
        self.write = lambda path, _: files.write(path, MJCF.encode())


def test_a_result_that_the_file_does_not_reproduce_is_withdrawn(robots):
    robot = robots["xml"]
    rng = np.random.default_rng(0)
    folder = robot.path.parent / "withdrawn"
    for changes in (
        {"thetas": new_links(robot, rng)},
        file_of({}, TURNED),
        {"payload": payload_of(robot, some_payload(rng))},
    ):
        name = "load" if "payload" in changes else None
        with pytest.raises(ExportError):
            result = result_of(robot, **changes)
            write_and_compile(robot, result, folder, name, through=UnchangedFiles)
        assert not folder.exists()


@pytest.mark.parametrize("moment", ["1e-6", "0", "1e-1"])
def test_a_frame_without_mass_is_no_obstacle(tmp_path, moment):
    """As exporters write for a tool's point; one as large as the link leaves nothing beside it."""
    tcp = urdf.inertial(0.0, f"{moment} {moment} {moment}")
    text = urdf.robot(
        urdf.serial({"l1": HEAVY, "l2": LIGHT, "tcp": tcp}, fixed=("tcp",))
    )
    robot = load_robot_model(write_files(tmp_path, {"arm.urdf": text}))
    thetas = new_links(robot, np.random.default_rng(0))
    thetas[-1] = body_theta(robot.mj_model, robot.body_id)
    path = write_and_compile(robot, result_of(robot, thetas=thetas)).path
    assert_same_theta(load_robot_model(path).prior.theta, thetas[-1], 1e-9)


@pytest.mark.parametrize("factor", [0.5, 1.5])
def test_a_factor_on_all_masses_is_in_all_bodies_of_the_file(tmp_path, factor):
    text = small_arms.serial_arm(("0 0 1", "0 1 0"), tip=small_arms.fingers())
    path = write_files(tmp_path, {"arm.xml": text})
    robot = load_robot_model(path, mass_scale=factor)
    thetas = robot.thetas
    thetas[0] *= 1.2
    written = write_and_compile(robot, result_of(robot, thetas=thetas)).mj_model
    expected = factor * load_robot_model(path).mj_model.body_mass
    expected[robot.links[0].body_id] *= 1.2
    assert_allclose(written.body_mass, expected, rtol=1e-9)


def test_a_urdf_in_tonnes_becomes_an_mjcf_in_kilograms(tmp_path):
    """The file that MuJoCo makes of it is in tonnes, too, and no arm."""
    light = urdf.inertial(1e-3, inertia="1e-5 2e-5 2.5e-5")
    text = urdf.robot(urdf.serial(dict.fromkeys(("l1", "l2", "l3"), light)))
    path = write_files(tmp_path, {"arm.urdf": text})
    robot = load_robot_model(path, mass_scale=1e3)
    thetas = robot.thetas
    thetas[-1] *= 1.1
    result = result_of(robot, thetas=thetas)
    written = write_and_compile(robot, result, file_kind="mjcf").mj_model
    assert_allclose(written.body_mass[-3:], [1.0, 1.0, 1.1], rtol=1e-9)


@pytest.mark.parametrize("kind", ["urdf", "mjcf"])
def test_bodies_that_stand_for_missing_masses_are_written(tmp_path, kind):
    """Also of links that were not identified, whose masses the file does not state."""
    same = urdf.inertial(mass=0.01, inertia="1e-4 1e-4 1e-4")
    text = urdf.robot(urdf.serial(dict.fromkeys(("l1", "l2", "l3"), same)))
    robot = load_robot_model(write_files(tmp_path, {"arm.urdf": text}))
    thetas = robot.thetas
    thetas[1] *= 1.2
    result = result_of(robot, thetas=thetas)
    written = write_and_compile(robot, result, file_kind=kind)
    again = load_robot_model(written.path)
    assert not again.lacks_masses
    assert_allclose(again.thetas, thetas, rtol=1e-9, atol=1e-12)


def test_fingers_that_leave_no_possible_gripper_are_refused(tmp_path):
    text = small_arms.serial_arm(("0 0 1", "0 1 0"), tip=small_arms.fingers())
    # The model says more of its fingers than there is of the whole gripper.
    robot = load_arm(tmp_path, text.replace('mass=".03"', 'mass=".6"'), "joint1")
    theta = 0.1 * robot.thetas[-1]
    with pytest.raises(ExportError, match="a model without fingers that the arm did"):
        write_and_compile(robot, result_of(robot, theta))


def test_links_that_are_the_models_own_are_left_alone(tmp_path):
    robot = load_arm(tmp_path, small_arms.THREE)
    thetas = robot.thetas
    thetas[-1] += random_theta(np.random.default_rng(2), 0.2)
    result = result_of(robot, thetas=thetas)
    text = write_and_compile(robot, result).path.read_text()
    assert text.count("System ID") == 1
    assert text.count(small_arms.LINK) == small_arms.THREE.count(small_arms.LINK) == 2


NAMED = [small_arms.SEVEN, small_arms.COUPLED_FINGERS, small_arms.SPRINGS]
if hasattr(mujoco.MjModel, "dof_dampingpoly"):
    NAMED.append(small_arms.NONLINEAR_DAMPING)


@given(
    st.sampled_from(NAMED) | small_arms.random_chain(),
    small_arms.rigid_bodies(),
    small_arms.SEEDS,
    st.sampled_from(["links", "merged", "own body"]),
)
def test_any_arm_takes_any_links_and_any_payload(
    tmp_path_factory, xml, last_body, seed, target
):
    """Several joints to a body, slides, fingers, any frame, nonlinear damping.

    Every written model is compiled, compared and moved by the writing itself.
    """
    rng = np.random.default_rng(seed)
    numbers = itertools.count()
    xml = re.sub(
        "<joint type", lambda _: f'<joint name="joint{next(numbers)}" type', xml
    )
    path = write_files(tmp_path_factory.mktemp("any"), {"arm.xml": xml})
    last = f"joint{len(re.findall('joint name=.joint', xml)) - 1}"
    robot = load_robot_model(path, joint=last)
    at = ", ".join(str(value) for value in (*rng.uniform(-1.0, 1.0, 3), 10, 20, 30))
    thetas = new_links(robot, rng)
    thetas[-1] = robot.prior.theta + last_body
    # A drawn body may make the arm heavier than lead of its length, which is read as a wrong unit.
    assume(mass_unit(robot, float(np.sum(thetas[:, 0])) / robot.mass) == 1.0)
    joints = new_joints(robot, rng)
    gravity = 9.8 * rng.normal(size=3)
    has_payload = target != "links"
    payload = payload_of(robot, some_payload(rng), at) if has_payload else None
    name = "load" if target == "own body" else None
    result = result_of(
        robot, thetas=thetas, payload=payload, **file_of(joints, gravity)
    )
    path = write_and_compile(robot, result, as_body=name).path
    written = load_robot_model(path, joint=last)
    for theta, link in zip(thetas[: -1 if has_payload else None], written.links):
        if np.any(theta):
            assert_same_theta(link.theta, theta, 1e-9)
    model = written.mj_model
    for field in FIELDS:
        expected = [joints[joint][field] for joint in robot.joint_names]
        assert_array_equal(getattr(model, f"dof_{field}")[robot.dof_index], expected)
    assert_array_equal(model.opt.gravity, gravity)
    if xml == small_arms.NONLINEAR_DAMPING:
        assert_array_equal(model.dof_dampingpoly, robot.mj_model.dof_dampingpoly)
    text = path.read_text()
    assert "System ID: gravity in place of" in text
    n_written = sum(link.has_mass for link in robot.links)
    assert text.count("System ID: body") >= n_written - has_payload


def test_a_compilers_bound_on_moments_is_kept_with_a_note(tmp_path):
    text = small_arms.THREE.replace("<compiler ", '<compiler boundinertia="2e-4" ')
    robot = load_arm(tmp_path, text)
    thin = spatial.theta_from_com(1.0, np.zeros(3), np.diag([1e-2, 1e-2, 1e-4]))
    _, mj_model, notes = write_and_compile(robot, result_of(robot, thin))
    assert "(boundinertia), so all three are written 0.0001 kg·m² larger" in notes[0]
    assert_allclose(
        terminal_composite(mj_model, robot)[[4, 9]], [1.01e-2, 2e-4], rtol=1e-9
    )
