"""The planning stage: the torque that motors are sent, and when a motion may be played."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rigs.arms import small_arms
from rigs.arms.excitation_arms import tube_arm
from rigs.arms.small_arms import X, Y, Z
from robot_sysid.config import MotorOptions, PlanConfig
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.errors import InputError
from robot_sysid.expected.recording import Prediction
from robot_sysid.expected.unrecorded_arm import ExpectedFile
from robot_sysid.motion import LimitOptions
from robot_sysid.motion.problem import build_problem
from robot_sysid.parser import load_robot_model
from robot_sysid.pipeline.motions import CheckedPlan
from robot_sysid.pipeline.motors import arm_motors
from robot_sysid.pipeline.planning import (
    draft_motor_file,
    elsewhere_answer,
    motor_commands,
    plan_conditions,
    plan_verdict,
    write_plan,
)
from robot_sysid.trajectory import SineTrajectory

WALL = '<body name="wall" pos=".55 0 .75"><geom type="box" size=".02 .6 .9"/></body>'
XML = small_arms.serial_arm(
    (small_arms.Z, small_arms.Y), joint='range="-2 2" frictionloss=".4"'
)


@pytest.fixture
def robot(arm_file):
    return load_robot_model(arm_file(XML))


def test_sent_torques_differ_from_the_models_at_reversals_only(robot):
    """There dry friction passes through zero instead of jumping between +-0.4 N m."""
    amplitude = np.array([[0.5], [0.3]])
    frequency_hz = np.full((2, 1), 0.5)
    plan = SineTrajectory(
        np.zeros(2), amplitude, frequency_hz, np.zeros((2, 1)), duration=4.0, fade=1.0
    )
    for time, q, qd, tau in motor_commands(robot, plan, 500.0):
        motion = plan.evaluate(time)
        difference = np.abs(tau - ArmDynamics(robot)(motion))
        np.testing.assert_array_equal(q, motion.q)
        np.testing.assert_array_equal(qd, motion.qd)
        assert np.all(difference <= 0.4 + 1e-12)
        assert np.all(difference[np.abs(qd) > 0.05] < 1e-4)
        assert np.any(difference > 0.1)


def test_motors_of_another_number_of_joints_are_refused(robot):
    motors = MotorOptions(export_damiao=True, motor_type=("DM4340",))
    with pytest.raises(InputError, match="motor"):
        arm_motors(motors, robot)
    assert draft_motor_file(PlanConfig(), robot, None, None, None) == ((), [])


def test_a_motion_keeps_what_its_motors_and_their_frames_can_do(robot):
    motors = arm_motors(MotorOptions(True, ("DM4340", "DMS3519")), robot)
    limits = motors.limits
    np.testing.assert_allclose(limits.velocity, [52 * 2 * np.pi / 60, 2000.0])
    assert limits.torque.tolist() == [27.0, 2.0] and not limits.has_range.any()


def still():
    """A motion of two joints that stand still."""
    return SineTrajectory(*np.zeros((1, 2)), *np.zeros((3, 2, 1)), 4.0, fade=1.0)


def predicted(mass_error, file=None):
    """A made-up prediction for a mass of 1 kg."""
    errors = np.full(10, mass_error)
    causes = {"links": (mass_error, 0.1)}
    return Prediction("link1", None, np.ones(10), errors, causes, {}, (), file)


def expected(before, after):
    """A made-up file: what its error is expected to be, and was."""
    return ExpectedFile(
        speed=2.0,
        speed_unit="rad/s",
        before=before,
        after=after,
        friction=0.1,
        least=0.05,
    )


@pytest.mark.parametrize(
    ("prediction", "verdict"),
    [
        (predicted(0.1), "Usable"),
        (predicted(0.4), "Usable"),
        (
            predicted(0.5),
            "Not ready: after this motion the mass of link1 is known to 50 %",
        ),
        (
            predicted(np.inf),
            "Not ready: this motion does not determine the mass of link1",
        ),
        # Of a file its error on any motion counts, whatever is known of one mass.
        (predicted(2.0, expected(0.4, 0.1)), "Usable"),
        (predicted(np.inf, expected(0.4, 0.37)), "Usable"),
        (
            predicted(0.01, expected(0.4, 0.39)),
            "Not ready: after this motion the written file is expected to be no better",
        ),
        (None, "Not ready: the errors that it will leave cannot be predicted"),
    ],
)
def test_the_step_after_a_motion_that_is_not_ready_does_not_play_it(
    robot, tmp_path, prediction, verdict
):
    config = PlanConfig.of(robot.path, output_dir=tmp_path)
    written = write_plan(config, robot, CheckedPlan(still()), prediction, [])
    assert written.verdict[0].startswith(verdict)
    assert (written.result["next_step"] is None) == verdict.startswith("Not ready")


@pytest.mark.parametrize(("noise", "is_longer"), [(0.6, True), (1.2, False)])
def test_a_load_in_the_noise_needs_a_longer_motion_or_a_heavier_load(
    robot, tmp_path, noise, is_longer
):
    """Four times as long, noise is half of it; the command repeats what was asked."""
    causes = {"noise": (noise, 0.1), "the torque scales": (0.1, 0.1)}
    mass_error = np.hypot(noise, 0.1)
    prediction = replace(predicted(mass_error), by_cause=causes)
    options = {"for_": "payload", "payload_reserve": 0.2, "output_dir": tmp_path}
    config = PlanConfig.of(robot.path, **options)
    written = write_plan(config, robot, CheckedPlan(still()), prediction, [])
    least = f"shows loads from {2.0 * mass_error:.2g} kg on"
    assert "Not ready" in written.verdict[0] and least in written.verdict[0]
    assert len(written.verdict) == 1 + 2 * is_longer
    if is_longer:
        assert "to 32 %" in written.verdict[1]
        for option in ("--duration 60", "--for payload", "--payload-reserve 0.2"):
            assert option in written.verdict[2]


def test_a_start_behind_a_wall_is_a_condition(arm_file, tmp_path):
    """A wall stands between an arm that leans left and the pose where it leans right."""
    left, right = ((0.0, lean, 0.0, 0.0) for lean in (-0.9, 0.9))
    robot = load_robot_model(arm_file(tube_arm((Z, Y, X, Y), WALL)))
    qpos = robot.reference_qpos.copy()
    qpos[robot.qpos_index] = left
    robot = replace(robot, reference_qpos=qpos)
    problem = build_problem(robot, LimitOptions())
    config = PlanConfig.of(robot.path, output_dir=tmp_path)
    for start, begin in ((left, "Usable: "), (right, "Usable once the arm has been ")):
        plan = SineTrajectory(np.array(start), *np.zeros((3, 4, 1)), 4.0, fade=1.0)
        checked = CheckedPlan(plan, problem)
        written = write_plan(config, robot, checked, predicted(0.1), [])
        assert written.verdict[0].startswith(begin)
    assert "is not free, by the clearance of " in written.verdict[0]
    assert "wall" in written.verdict[0]


def test_the_answer_has_what_is_expected_of_the_file():
    assert elsewhere_answer(predicted(0.2, expected(0.4, 0.1))) == {
        "speed": 2.0,
        "speed_unit": "rad/s",
        "after": 0.1,
        "least": 0.05,
        "friction": 0.1,
        "load": 0.2,
    }
    assert elsewhere_answer(predicted(np.inf, expected(0.4, 0.1)))["load"] is None
    assert elsewhere_answer(predicted(0.2)) is None
    assert elsewhere_answer(None) is None


@pytest.mark.parametrize(
    ("contact", "n_unguarded", "lacks_meshes", "phrases"),
    [
        (None, 0, True, []),
        ("link0 and link5", 0, False, ["free, by the clearance of link0 and link5"]),
        (None, 2, False, ["2 of 6 moving links", "watch it in a viewer"]),
        (None, 6, True, ["6 of 6 moving links", "--mesh-dir FOLDER"]),
        ("link0 and link5", 6, True, ["brought to the start", "--mesh-dir FOLDER"]),
    ],
)
def test_a_plan_is_usable_once_what_was_not_checked_is(
    contact, n_unguarded, lacks_meshes, phrases
):
    arm = SimpleNamespace(lacks_meshes=lacks_meshes)
    problem = SimpleNamespace(robot=arm, n_joints=6, unguarded=range(n_unguarded))
    verdict = plan_verdict("", plan_conditions(problem, contact))
    assert all(phrase in verdict for phrase in phrases)
    assert verdict.startswith("Usable once ") is bool(phrases)
