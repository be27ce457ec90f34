"""The command motors hold: an arm that stands, drifts, falls, or has a fault while it floats."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.arms import small_arms
from rigs.arms.wrong_arms import resting_torque
from rigs.files.command_line import MotorsCommandLine
from rigs.motors.damiao_rig import (
    COARSE_STEP,
    MotorBus,
    map_line,
    only_asks,
    trajectory_of,
)
from rigs.motors.incidents import FLOATING
from rigs.motors.terminals import Terminal
from robot_sysid.damiao.execution import Equipment
from robot_sysid.damiao.floating import SETTLING, Drift, Floating
from robot_sysid.damiao.joints import damiao_joints, write_joint_map
from robot_sysid.damiao.protocol import DISABLE, DISABLED, special_frame
from robot_sysid.damiao.references import Reference
from robot_sysid.damiao.settings import Plan, PlaySettings
from robot_sysid.errors import HardwareAbort
from robot_sysid.records import Limits
from robot_sysid.simulation.plant import ArmStepper

POSE = 0.8, 0.3
USUAL = "--accept-directions --yes --for 0.8 --rate 100 --channel can0"


def arm(tip_mass=0.8, dry=0.05, viscous=1.0):
    """A model of two joints that gravity loads, with friction and a mass at its end [kg]."""
    joint = f'armature=".05" damping="{viscous}" frictionloss="{dry}" range="-2.5 2.5"'
    tip = small_arms.TIP.replace('mass=".8"', f'mass="{tip_mass}"')
    return small_arms.serial_arm(
        (small_arms.Y, small_arms.Y), joint=joint, tip_inertial=tip
    )


@dataclass
class FloatTest:
    """What a float test printed, the motors that it moved, and since when they floated [s]."""

    code: int
    out: str
    err: str
    bus: MotorBus
    since: float | None = None

    @property
    def moved(self):
        """Farthest that each joint (n,) got from where it began to float, or to be held, until the
        motors were disabled [rad].
        """
        off = special_frame(DISABLE, 0).data
        times = [frame.time for frame in self.bus.wire.sent if frame.data == off]
        end = min(times, default=np.inf)
        since = self.since or 0.0
        path = [q for t, q, _ in self.bus.arm.truth if since < t < end]
        return np.max(np.abs(np.array(path) - path[0]), axis=0)


HIDDEN = (
    r"stands: friction holds it, the test does not show its gravity; by the model's friction, "
    r"errors below (\S+) N·m do not show"
)


@pytest.fixture
def float_test(capsys, monkeypatch, tmp_path, heard):
    """Runs a float test of an arm by a model; ``cause`` happens when it has floated for a while."""

    def run(truth, model, options=("--float",), cause=None):
        mechanism = ArmStepper(small_arms.robot_of(truth), POSE, 2e-3)
        joints = damiao_joints(["DM4310"] * 2, 2)
        bus = MotorBus(joints, mechanism, watchdog=0.15, echo=True)
        bus.terminal_is_closed = False
        bus.arm.takes_whole_steps = True
        floats_since = []

        def note_floating(text):
            if text.startswith("taking the stiffness away"):
                floats_since.append(bus.clock.now() + SETTLING)
                if cause is not None:
                    bus.at(SETTLING + 1.3, lambda: cause(bus))

        monkeypatch.setattr("sys.stdout", Terminal(sys.stdout, bus, note_floating))
        path = tmp_path / "model.xml"
        path.write_text(model)
        motors = MotorsCommandLine(capsys, bus.equipment)
        printed = motors.run("hold", USUAL, *options, "--model", path)
        assert bus.states() == [DISABLED] * 2 or cause is not None
        return FloatTest(*printed, bus, *floats_since)

    return run


def test_an_arm_whose_model_is_right_stands(float_test):
    test = float_test(arm(), arm())
    assert test.code == 0 and "Done: all joints stand" in test.out
    sizes = np.array(re.findall(HIDDEN, test.out), float)
    assert sizes == pytest.approx(0.05, abs=0.005) and len(sizes) == 2
    # What stiffness held beside the model's gravity is nothing.
    assert np.all(test.moved < 0.01)


@pytest.mark.slow
def test_of_a_joint_that_friction_holds_no_torque_is_said(float_test):
    """But how large an error of its gravity friction hides: as large a one as this model has."""
    model = arm(dry=0.3)
    truth = arm(0.9, dry=0.3)
    test = float_test(truth, model)
    assert test.code == 0 and "differs" not in test.out
    sizes = np.array(re.findall(HIDDEN, test.out), float)
    errors = np.abs(gravity(truth) - gravity(model))
    assert len(sizes) == 2 and np.all(errors < sizes) and np.max(errors) > 0.1


@pytest.mark.slow
def test_of_a_joint_whose_friction_is_not_known_no_torque_is_said(float_test):
    """Steps of the commanded torque alone let a joint drift whose gravity is right."""
    frictionless = arm(dry=0.0, viscous=0.0)
    test = float_test(frictionless, frictionless, ("--float", "--for", 2))
    assert re.search(
        r"joint\d drifts at \S+ deg/s: the model states no friction", test.out
    )
    assert "differs" not in test.out and "do not show" not in test.out


def test_the_arm_is_held_with_its_stiffness_where_it_does_not_float(float_test):
    test = float_test(arm(1.0), arm(), options=())
    assert test.code == 0 and "holding (0.8 s)" in test.out
    assert "Done: held, and all motors are disabled" in test.out
    assert test.since is None and np.all(test.moved < 0.05)


def gravity(model):
    """Return the torque (n,) that holds a model's arm in its pose [N m]."""
    robot = small_arms.robot_of(model)
    return resting_torque(robot, np.array([POSE]), robot.thetas)[0]


@pytest.mark.slow
@pytest.mark.parametrize(("share", "viscous", "code"), [(1.15, 0.3, 3), (0.85, 1.5, 0)])
def test_a_wrong_gravity_is_named_with_its_sign_and_size(
    float_test, share, viscous, code
):
    """Of a mass at the end that is 15 % off; a joint with little friction is caught."""
    model = arm(viscous=viscous)
    truth = arm(0.8 * share, viscous=viscous)
    test = float_test(truth, model)
    (size,) = re.findall(
        r"joint0 drifts at \S+ deg/s: its gravity differs from .* by (\S+) ± ", test.out
    )
    error = gravity(truth) - gravity(model)
    excess = np.sign(gravity(model)) * error
    assert float(size) == pytest.approx(excess[0], rel=0.15)
    assert "robot-sysid plan" in test.out and "--for arm --motor-type" in test.out
    assert test.code == code
    # The bound, and what a joint needs to stop.
    assert np.all(test.moved < 0.2)


@pytest.mark.parametrize(
    ("gravity", "error", "difference"),
    [(-2.0, -0.4, "2 N·m by 0.40"), (2.0, -0.4, "2 N·m by -0.40"), (0.0, 0.4, "0 N·m by 0.40")],
)  # fmt: skip
def test_a_joint_that_is_heavier_than_its_model_differs_by_more_than_zero(
    gravity, error, difference
):
    drift = Drift("elbow", 0.1, gravity, error, 0.1, False)
    words = f"its gravity differs from the model's {difference} ± 0.10 N·m"
    assert str(drift) == f"elbow drifts at 5.73 deg/s: {words}"


@given(
    speed=st.sampled_from([0.0, 0.1, -0.2]),
    friction=st.floats(0.01, 2.0) | st.just(np.inf),
    is_at_end=st.booleans(),
)
def test_a_torque_is_said_only_of_a_joint_that_moves_against_known_friction(
    speed, friction, is_at_end
):
    doubt = np.inf if is_at_end else friction
    text = str(Drift("elbow", speed, 2.0, 0.4 if speed else np.nan, doubt, is_at_end))
    is_seen = speed != 0.0 and np.isfinite(doubt)
    assert ("its gravity differs" in text) == is_seen
    assert ("the test does not show its gravity" in text) == (not is_seen)
    is_hidden = speed == 0.0 and np.isfinite(doubt)
    assert ("do not show" in text) == is_hidden
    assert "nan" not in text and "not known" not in text
    assert ("stands" in text) == (speed == 0.0)


@pytest.mark.slow
def test_options_do_not_let_an_arm_fall(float_test):
    wide = ("--float", "--max-tracking-error", 100)
    test = float_test(arm(0.92), arm(), options=wide)
    assert test.code == 3 and "and was caught" in test.err
    assert np.all(test.moved < 0.2)


def mirrored(joint):
    """A joint map in which one motor turns the other way than it does, and stands where it does."""
    mounted = [(), ()]
    mounted[joint] = (-1, 2.0 * POSE[joint])
    return [map_line(f"joint{j}", j + 1, j + 0x11, *mounted[j]) for j in range(2)]


OTHER_ARMS = {
    # Gravity hardly loads it: only floating shows what is wrong.
    "wrist mirrored": (0.6, 0.6, mirrored(1), r"joint1\) is not carried", 0.06),
    "shoulder mirrored": (0.8, 0.8, mirrored(0), r"joint0\) disagrees in", 0.2),
    "far too heavy": (0.8, 2.0, (), r"joint0\) disagrees in position", 0.1),
    "far too light": (1.4, 0.8, (), r"joint0\) is not carried", 0.2),
}
"""The mass at the arm's end and that of its model [kg], the joint map, what is said, and how far a
joint gets [rad]."""


@pytest.mark.slow
@pytest.mark.parametrize("name", OTHER_ARMS)
def test_the_model_of_another_arm_is_caught(float_test, tmp_path, name):
    mass, model_mass, rows, message, bound = OTHER_ARMS[name]
    options = ["--float"]
    if rows:
        write_joint_map(tmp_path / "joint_map.csv", rows)
        options += ["--joint-map", tmp_path / "joint_map.csv"]
    test = float_test(arm(mass), arm(model_mass), options)
    assert test.code == 3 and re.search(message, test.err)
    assert np.all(test.moved < bound)


@pytest.mark.slow
def test_a_joint_that_sinks_out_of_its_range_is_caught(float_test):
    """Before its position would be pulled back from far beyond its range."""
    model = arm().replace('range="-2.5 2.5"', f'range="-2.5 {POSE[0] + 0.002}"', 1)
    test = float_test(arm(0.85), model)
    assert test.code == 3
    assert re.search("joint0.* leaves the model's range", test.err)
    assert 0.02 < test.moved[0] < 0.04


@pytest.mark.slow
def test_an_error_of_measuring_does_not_hide_who_was_caught(float_test, monkeypatch):
    """A fit of a drift may fail in numpy."""

    asked = []

    def fail(*_):
        asked.append(True)
        raise np.linalg.LinAlgError("did not converge")

    monkeypatch.setattr(np, "polyfit", fail)
    test = float_test(arm(1.0), arm())
    assert test.code == 3 and "joint0) is not carried" in test.err and asked


@pytest.mark.slow
def test_a_joint_at_an_end_of_its_range_says_nothing_of_its_gravity(float_test):
    model = arm().replace('range="-2.5 2.5"', f'range="-2.5 {POSE[0]}"', 1)
    test = float_test(arm(), model)
    assert test.code == 0
    end = "a stop may hold it, the test does not show its gravity"
    assert f"joint0 stands at an end of its range: {end}\n" in test.out
    assert re.search("joint1 " + HIDDEN, test.out)


def begin_floating():
    """Return the reference of a joint that stands at zero, of a range of 0.09 rad each way."""
    still = np.zeros((2, 1))
    times = np.array([0.0, 5.0])
    trajectory = trajectory_of((times, still, still, still), "DM4310")
    limits = Limits(np.array([-0.09]), np.array([0.09]))
    plan = Plan(trajectory, PlaySettings(rate=250.0), model_limits=limits)
    return Floating(plan, np.zeros_like).begin(Reference(*np.zeros((3, 1))))


@given(
    steps=st.lists(
        st.tuples(st.floats(0.001, 0.02), st.floats(-0.1, 0.1) | st.just(np.nan)),
        min_size=1,
        max_size=40,
    )
)
def test_no_feedback_leads_commands_out_of_their_bounds(steps):
    """Of position and speed; or the joint that moves so is named."""
    zero = np.zeros(1)
    floating = begin_floating()
    floating(0.0)
    floating.follow(zero, zero, zero)
    time = SETTLING
    last = floating(time).position
    for duration, angle in steps:
        floating.follow(np.array([angle]), zero, zero)
        time += duration
        position = floating(time).position
        assert abs(position[0]) <= 0.09
        assert abs(position - last)[0] <= 0.2 * duration + 1e-12
        last = position
    assert len(floating.samples) == len(steps)
    floating.follow(np.array([0.31]), zero, zero)
    with pytest.raises(HardwareAbort, match="motor 1 leaves the model's range"):
        floating(time + 0.01)


def test_a_long_time_needs_no_more_memory():
    """Kept is the last half second, from which the drift follows."""
    begun = begin_floating()
    zero = np.zeros(1)
    for cycle in range(4000):
        begun(cycle / 250.0)
        begun.follow(zero, zero, zero)
    times = [time for time, _ in begun.samples]
    assert len(times) == 125
    assert np.diff(times) == pytest.approx(0.004)
    assert times[-1] == 3999 / 250.0 - SETTLING


@pytest.mark.slow
def test_a_simulated_arm_may_be_another_one(capsys, arm_file):
    motors = MotorsCommandLine(capsys, Equipment(physics_step=COARSE_STEP))
    model = arm_file(arm(viscous=1.5))
    truth = arm_file(arm(1.2, viscous=1.5), "truth.xml")
    words = "hold --float --simulate --for 0.5 --rate 100 --motor-type DM4310 --pose"
    options = (*POSE, "--model", model, "--plant-model", truth)
    code, out, _ = motors.run(words, *options)
    assert code == 3 and "joint0 drifts at" in out


def test_a_model_with_more_joints_than_motors_is_refused(float_test):
    test = float_test(
        arm(), small_arms.serial_arm((small_arms.Y, small_arms.Y, small_arms.X))
    )
    assert test.code == 2 and "motor 3 (joint joint2): no motor answers" in test.err
    assert only_asks(test.bus.wire.sent)


@pytest.mark.slow
@pytest.mark.parametrize("case", FLOATING, ids=lambda case: case.name)
def test_an_arm_with_a_fault_is_held(float_test, case):
    test = float_test(arm(0.85), arm(), cause=case.cause)
    assert test.code == case.code and re.search(case.words, test.err)
    assert test.moved[0] < case.bound and test.moved[1] < 0.03
