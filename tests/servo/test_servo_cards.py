"""Cards of an arm behind servos: what reads them moves as what was found does."""

from __future__ import annotations

import ast
import re
import sys
from dataclasses import dataclass, replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from rigs.arms.servo_fits import identification_of, servo_fit
from rigs.files import schemas
from rigs.files.model_files import write_files
from rigs.files.releases import since
from robot_sysid import servo
from robot_sysid.config import IdentifyConfig
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Motion, Recording
from robot_sysid.records.controllers import ALL, SIMULATORS
from robot_sysid.records.file_access import SIMULATOR_CARD_NAMES
from robot_sysid.servo.play import make_tracks, play
from robot_sysid.servo.unknowns import SLIP_SPEED, column
from tests.results.test_simulator_cards import constants, module_of, snippet

ARM = """<mujoco><compiler angle="radian"/>
<option timestep="0.001" integrator="implicitfast"/><worldbody>
<body name="upper"><joint name="arm/lift" axis="0 1 0" range="-2 2"/>
<inertial pos=".2 0 0" mass=".4" diaginertia="2e-3 2e-3 2e-3"/>
<body name="fore" pos=".25 0 0"><joint name="roll" axis="1 0 0" range="-2 2"/>
<inertial pos=".02 0 .01" mass=".1" diaginertia="1e-4 1e-4 1e-4"/></body></body></worldbody>
<actuator><position name="a" joint="arm/lift" kp="15" forcerange="-3 3"/>
<position name="b" joint="roll" kp="15" forcerange="-3 3"/></actuator></mujoco>"""
NUMBERS = {
    "gain": [18.0, 12.0],
    "torque_limit": [1.5, 0.8],
    "damping": [0.5, 0.3],
    "frictionloss": [0.1, 0.05],
    "armature": [0.03, 0.02],
    "stribeck": [0.04, 0.0],
    "load_share": [0.1, 0.05],
    "dead_zone": 0.0,
    "command_delay": 0.02,
}
SECONDS = 3.0


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    folder = tmp_path_factory.mktemp("in")
    return load_robot_model(write_files(folder, {"arm.xml": ARM}))


def write(robot, folder, fit):
    """Write the results of a fit with all cards."""
    zero = np.zeros((3, robot.n_joints))
    poses = Motion(np.arange(3.0), zero, zero, zero)
    config = IdentifyConfig.of(
        robot.path, measurements=("log.csv",), output_dir=folder, cards=ALL
    )
    return servo.write_servos(config, identification_of(robot, fit), poses)


@pytest.fixture(scope="module", params=[0.0, 0.4])
def output(request, robot, tmp_path_factory):
    """Results of servos that command a share of the damping, within their limits."""
    folder = tmp_path_factory.mktemp("out")
    fit = servo_fit(robot, **NUMBERS)
    own = request.param * fit.in_file.numbers[1]
    write(robot, folder, replace(fit, in_file=replace(fit.in_file, servo_damping=own)))
    return folder


@pytest.mark.parametrize("simulator", [*SIMULATORS])
def test_a_card_has_the_servos_as_found_and_as_in_the_file(output, simulator):
    card = constants(output / SIMULATOR_CARD_NAMES[simulator])
    model = mujoco.MjModel.from_xml_path(str(output / "updated_model.xml"))
    for k, joint in enumerate(("arm/lift", "roll")):
        in_file = card["JOINTS"][joint]
        assert in_file["stiffness"] == pytest.approx(model.actuator_gainprm[k, 0])
        assert in_file["effort_limit"] == pytest.approx(model.actuator_forcerange[k, 1])
        # That of a joint and of its servo, which a simulator's servo has as one.
        damping = model.dof_damping[k] - model.actuator_biasprm[k, 2]
        assert in_file["damping"] == pytest.approx(damping)
        assert damping == pytest.approx(NUMBERS["damping"][k])
        found = card["SERVOS"][joint]
        for name, number in found.items():
            expected = np.broadcast_to(NUMBERS.get(name, 0.0), 2)[k]
            assert number == pytest.approx(expected, abs=1e-9), name
    assert card["SLIP_SPEED"] == SLIP_SPEED and card["DELAY"] == pytest.approx(0.02)
    low, high = card["DELAY_RANGE"]
    assert low < 0.02 < high
    assert card["delay_steps"](0.001) == (round(low / 0.001), round(high / 0.001))


def test_ranges_are_two_standard_errors_to_both_sides_as_far_as_possible(output):
    card = constants(output / "drake_card.py")
    rows = schemas.check(output / "servo.json")["quantities"]
    rows = {(row["of"], row["name"]): row for row in rows if row["source"] != "file"}
    for joint, ranges in card["RANGES"].items():
        assert set(ranges) == set(card["SERVOS"][joint])
        for name, (low, high) in ranges.items():
            row = rows[joint, name]
            assert high == pytest.approx(row["value"] + 2.0 * row["error"])
            assert 0.0 <= low <= row["value"] <= high
            if name in ("gain", "torque_limit", "damping", "armature"):
                assert low * high == pytest.approx(row["value"] ** 2)
            else:
                expected = row["value"] - 2.0 * row["error"]
                assert low == pytest.approx(max(expected, 0.0))


def test_a_joint_that_did_not_move_has_the_numbers_of_the_file(robot, tmp_path):
    fit = replace(servo_fit(robot, **NUMBERS), is_known=np.array([True, False]))
    write(robot, tmp_path, fit)
    card = constants(tmp_path / "bam_card.py")
    assert card["RANGES"]["roll"] == {} and card["RANGES"]["arm/lift"]
    still = card["SERVOS"]["roll"]
    assert (still["gain"], still["torque_limit"], still["load_share"]) == (
        15.0,
        3.0,
        0.0,
    )


@pytest.mark.parametrize("simulator", [*SIMULATORS])
def test_the_head_of_a_card_has_no_more_than_ten_lines(output, simulator):
    path = output / SIMULATOR_CARD_NAMES[simulator]
    lines = snippet(path)
    ast.parse("\n".join(lines))
    assert 5 < len(lines) <= 10
    card = constants(path)
    called = re.findall(rf"{simulator}_card\.(\w+)", path.read_text())
    assert called and all(name in card for name in called)


def commands(time):
    """Steps that put both servos at their torque limit, and sines."""
    square = 0.8 * np.sign(np.sin(2.0 * np.pi * 0.7 * time))
    return np.stack((square, 0.5 * np.sin(4.0 * time)), axis=1)


def played(model, delay=0.0):
    """Positions (N, 2) of a compiled model that is driven by commands from rest."""
    data = mujoco.MjData(model)
    time = np.arange(0.0, SECONDS, model.opt.timestep)
    positions = np.empty((len(time), 2))
    goals = np.where((time < delay)[:, None], 0.0, commands(time - delay))
    for k, goal in enumerate(goals):
        data.ctrl[:] = goal
        mujoco.mj_step(model, data)
        positions[k] = data.qpos
    return positions


@since(4, 0)
def test_the_lines_of_dc_motors_move_as_the_written_model(output):
    """In its place: the delay that it lacks is that of its commands."""
    text = (output / "mjlab_card.py").read_text()
    lines = re.findall(r"^#   (<dcmotor .*/>)$", text, re.M)
    assert len(lines) == 2
    written = mujoco.MjModel.from_xml_path(str(output / "updated_model.xml"))
    expected = played(written, delay=0.02)
    xml = (output / "updated_model.xml").read_text()
    xml = re.sub(r"<position [^>]*/>", "", xml)
    xml = re.sub(r' damping="[^"]*"', "", xml)
    xml = xml.replace("<actuator>", "<actuator>" + "".join(lines))
    motors = mujoco.MjModel.from_xml_string(xml)
    assert motors.nu == 2 and not motors.dof_damping.any()
    moved = played(motors)
    assert np.ptp(expected[:, 0]) > 0.5
    assert_allclose(moved, expected, atol=1e-6)


@dataclass
class DelayedPDActuatorCfg:
    """The fields that Isaac Lab 3.0 documents of its class of this name, as far as it needs."""

    joint_names_expr: list
    stiffness: object
    damping: object
    actuator_effort_limit: object = None
    actuator_velocity_limit: object = None
    armature: object = None
    friction: object = None
    dynamic_friction: object = None
    viscous_friction: object = None
    min_delay: int = 0
    max_delay: int = 0


@dataclass
class DCMotorCfg(DelayedPDActuatorCfg):
    """The same of this class."""

    saturation_effort: object = None


@dataclass
class EarlierMotorCfg:
    """The same of Isaac Lab 2.3, which has other names for limits."""

    joint_names_expr: list
    stiffness: object
    damping: object
    effort_limit: object = None
    velocity_limit: object = None
    armature: object = None
    friction: object = None
    dynamic_friction: object = None
    viscous_friction: object = None
    saturation_effort: object = None
    min_delay: int = 0
    max_delay: int = 0


def isaac_card(output, monkeypatch, delayed, motor):
    """The card of Isaac Lab, with stand-ins for its classes and those of USD."""
    usd = SimpleNamespace(MakeValidIdentifier=lambda name: re.sub(r"\W|^\d", "_", name))
    pxr = SimpleNamespace(Gf=None, Tf=usd, Usd=None, UsdGeom=None, UsdPhysics=None)
    actuators = SimpleNamespace(DelayedPDActuatorCfg=delayed, DCMotorCfg=motor)
    for name, module in (("isaaclab.actuators", actuators), ("pxr", pxr)):
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setitem(sys.modules, "isaaclab", SimpleNamespace(actuators=actuators))
    return module_of(output / "isaaclab_card.py")


def isaac_torque(motor, error, speed):
    """What Isaac Lab's DC motor makes of a position error and a speed, by its documentation."""
    wanted = motor.stiffness * error - motor.damping * speed
    line = motor.saturation_effort * (
        np.array([[-1.0], [1.0]]) - speed / motor.actuator_velocity_limit
    )
    largest = motor.actuator_effort_limit
    low, high = np.clip(line, -largest, largest)
    return np.clip(wanted, low, high)


def test_isaac_lab_gets_servos_and_motors_with_the_torque_of_the_file(
    output, monkeypatch
):
    card = isaac_card(output, monkeypatch, DelayedPDActuatorCfg, DCMotorCfg)
    servos = card.servos(0.005)
    motors = card.dc_motors()
    rng = np.random.default_rng(0)
    for k, (joint, usd_name) in enumerate(
        {"arm/lift": "arm_lift", "roll": "roll"}.items()
    ):
        gain, limit, damping = (
            NUMBERS[key][k] for key in ("gain", "torque_limit", "damping")
        )
        arm = servos[joint]
        assert arm.joint_names_expr == [usd_name] == motors[joint].joint_names_expr
        assert arm.actuator_effort_limit == pytest.approx(limit)
        assert (arm.damping, arm.viscous_friction) == (0.0, pytest.approx(damping))
        assert (arm.min_delay, arm.max_delay) == card.delay_steps(0.005)
        error = rng.normal(size=200)
        speed = rng.uniform(-1.0, 1.0, 200) * limit / damping
        expected = np.clip(gain * error, -limit, limit) - damping * speed
        assert_allclose(
            isaac_torque(motors[joint], error, speed), expected, 1e-9, 1e-12
        )


def test_isaac_lab_2_has_other_names_for_the_limits(output, monkeypatch):
    card = isaac_card(output, monkeypatch, EarlierMotorCfg, EarlierMotorCfg)
    assert card.servos(0.005)["roll"].effort_limit == pytest.approx(0.8)
    motor = card.dc_motors()["roll"]
    assert motor.velocity_limit == pytest.approx(0.8 / 0.3)


def test_mjlab_gets_servos_that_are_late(output, monkeypatch):
    stand_in = SimpleNamespace(BuiltinPositionActuatorCfg=dict)
    for name in ("mjlab", "mjlab.actuator"):
        monkeypatch.setitem(sys.modules, name, stand_in)
    card = module_of(output / "mjlab_card.py")
    lift, roll = card.servos(0.002)
    assert lift["target_names_expr"] == ("lift",)
    assert (roll["stiffness"], roll["effort_limit"]) == pytest.approx((12.0, 0.8))
    assert roll["damping"] == 0.0
    assert (lift["delay_min_lag"], lift["delay_max_lag"]) == card.delay_steps(0.002)


@pytest.mark.slow
def test_bam_moves_the_arm_as_it_was_played(robot, output, monkeypatch):
    """With load, Stribeck part and limit."""
    pytest.importorskip("bam")
    card = module_of(output / "bam_card.py")
    spec = mujoco.MjSpec.from_file(str(output / "updated_model.xml"))
    spec.option.timestep = 0.0005
    model = card.with_motors(spec).compile()
    data = mujoco.MjData(model)
    both = card.controllers(model, data, vin=7.4)
    time = np.arange(0.0, SECONDS, 0.01)
    goals = commands(time)
    goals[time < 0.5] = 0.0
    positions = np.empty_like(goals)
    for k, (lift, roll) in enumerate(goals):
        positions[k] = data.qpos
        for _ in range(20):
            both[0].set_q_target("arm/lift", lift)
            both[1].set_q_target("roll", roll)
            for controller in both:
                controller.update()
            mujoco.mj_step(model, data)
    # Velocities at the start of a recording are those of a motion that is under way.
    settled = time >= 0.4
    time, positions, goals = time[settled], positions[settled], goals[settled]
    recording = Recording(time, positions, None, goals - positions, command=goals)
    tracks = make_tracks(robot, [recording], SECONDS, 1)
    size = np.ptp(positions, axis=0)
    assert size[0] > 0.5

    def missed(**changes):
        """Error of each joint, over its motion, of a play with some other numbers."""
        numbers = servo_fit(robot, **{**NUMBERS, **changes}).over_gain[None]
        numbers[..., column("command_delay")] = 0.0
        errors = np.zeros((1, 2, len(tracks.errors)))
        off = play(tracks, numbers, errors, np.zeros((1, 2, 2)))[0]
        return np.sqrt(np.mean(off**2, axis=1)) / size

    assert np.all(missed() < 0.01)
    # That is less than a part of the friction makes.
    for part in ("frictionloss", "load_share"):
        none = [1e-6, *NUMBERS[part][1:]]
        assert missed(**{part: none})[0] > 2.0 * missed()[0], part
