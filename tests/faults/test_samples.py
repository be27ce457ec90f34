"""Checks of logs: length, clock, sensors, velocities, and the findings that stop."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.signal import butter, sosfiltfilt

from rigs.arms import small_arms
from rigs.arms.wrong_arms import ARMS, DEVIATIONS, draw_arm, truth_of
from rigs.files.places import MODELS as public_models
from rigs.logs.log_files import JOINTS, arm_of
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics, with_gravity
from robot_sysid.errors import InputError, SysidError
from robot_sysid.faults import Finding
from robot_sysid.faults.gate import TRYING, require_acceptable
from robot_sysid.faults.samples import (
    clock_findings,
    motion_sign_findings,
    rate_findings,
    saturation_findings,
    time_share,
    unsigned_findings,
    velocity_notes,
    velocity_ratios,
)
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Recording
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.messages import Level
from robot_sysid.trajectory import generate_excitation_trajectory, motion_chunks
from tests.faults.conftest import (
    FOUR_AXES,
    JOINT,
    NOISY,
    SAMPLES,
    findings_of,
    found_in,
    judged,
    slow,
)


def test_a_correct_log_has_no_findings():
    assert list(clock_findings([NOISY])) == []
    assert list(saturation_findings(arm_of(JOINTS), [NOISY])) == []


@pytest.mark.parametrize("quantity, word", [("q", "position"), ("tau", "torque")])
@pytest.mark.parametrize("length, is_late", [(0.01, False), (0.1, True)])
def test_a_column_that_is_new_in_few_samples_is_doubted(
    four_joints, quantity, word, length, is_late
):
    """Short ones are those of drivers at half the rate of the log."""
    log = four_joints.log
    every = round(length / (log.time[1] - log.time[0]))
    values = getattr(log, quantity).copy()
    values[:, 1] = values[::every, 1].repeat(every)[: len(values)]
    wrong = replace(log, **{quantity: values})
    found = [*rate_findings(four_joints.robot, [wrong])]
    assert [each.level for each in found] == [Level.DOUBTS] * is_late
    # Readings are as old as their place among those that repeat them.
    late = 1e3 * np.mean(np.arange(every)) * (log.time[1] - log.time[0])
    for finding in found:
        assert f"the {word} of joint1 is new in every {every}." in finding.text
        assert f"{late:.2g} ms late in the mean" in finding.text


@given(st.integers(0, 2**32), st.floats(0.04, 0.2))
def test_lost_samples_behind_a_counted_time_are_refused(seed, share):
    received = np.flatnonzero(np.random.default_rng(seed).random(len(SAMPLES)) > share)
    log = Recording(
        SAMPLES.time[: len(received)], SAMPLES.q[received], None, SAMPLES.tau[received]
    )
    (finding,) = clock_findings([log])
    assert finding.level is Level.REFUSES and "lost samples" in finding.text
    honest = replace(log, time=SAMPLES.time[received])
    assert list(clock_findings([honest])) == []


def test_a_few_lost_samples_are_doubted_with_what_they_do_to_numbers():
    """All speeds are too fast by the share that is lost."""
    received = np.flatnonzero(np.random.default_rng(0).random(len(SAMPLES)) > 0.01)
    log = Recording(
        SAMPLES.time[: len(received)], SAMPLES.q[received], None, SAMPLES.tau[received]
    )
    (finding,) = clock_findings([log])
    assert finding.level is Level.DOUBTS
    lost, viscous, rotors = map(float, re.findall(r"([\d.]+) %", finding.text))
    too_fast = 100.0 * (SAMPLES.time[received[-1]] / log.time[-1] - 1.0)
    assert viscous == lost == pytest.approx(too_fast, rel=0.2)
    assert rotors == pytest.approx(2.0 * lost, rel=0.05)


@given(st.integers(0, 2**32), st.floats(5.0, 12.0))
def test_samples_that_are_few_are_not_lost(seed, rate):
    """Between two of them, a motion speeds up by more than noise makes of one that is dense."""
    rng = np.random.default_rng(seed)
    time = np.arange(60.0 * rate) / rate
    rates = 2.0 * np.pi * rng.uniform(0.05, 0.5, (5, 3))
    phases = rates * time[:, None, None] + rng.uniform(0.0, 6.0, (5, 3))
    q = np.sum(rng.uniform(0.1, 0.4, (5, 3)) * np.sin(phases), axis=1)
    assert list(clock_findings([Recording(time, q, None, q)])) == []


@given(st.floats(0.2, 3.0), st.integers(100, 500))
@example(1.05, 250)
def test_a_slow_motion_in_steps_of_an_encoder_loses_no_samples(steps, rate):
    time = np.arange(20 * rate) / rate
    step = 25.0 / 65535
    fastest = steps * step * rate
    frequencies = np.array([1.3, 2.9])
    way = fastest / frequencies * np.sin(time[:, None] * frequencies + [0.0, 1.0])
    q = step * np.round(way / step)
    log = Recording(time, q, None, np.zeros_like(q))
    assert not [each for each in clock_findings([log]) if "lost" in each.text]


@given(st.integers(100, 1900), st.floats(0.05, 0.4))
def test_a_jump_of_the_clock_is_told_from_a_hole(at, jump):
    time = SAMPLES.time.copy()
    time[at:] += jump
    (finding,) = clock_findings([replace(SAMPLES, time=time)])
    assert "jumps ahead 1 time " in finding.text


@given(st.floats(0.8, 1.3))
def test_a_stretched_time_contradicts_recorded_velocities(factor):
    qd = np.gradient(SAMPLES.q, SAMPLES.time, axis=0)
    log = replace(SAMPLES, time=factor * SAMPLES.time, qd=qd)
    share = time_share(velocity_ratios([log]))
    if abs(factor - 1.0) > 0.035:
        assert share == pytest.approx(factor - 1.0, abs=0.01)
    elif abs(factor - 1.0) < 0.025:
        assert share == 0.0
    assert time_share(velocity_ratios([replace(log, qd=None)])) is None


def test_velocities_of_one_joint_that_are_a_factor_off_are_noted():
    qd = np.gradient(SAMPLES.q, SAMPLES.time, axis=0) * [1.0, 0.8, 1.0]
    ratios = velocity_ratios([replace(SAMPLES, qd=qd)])
    (finding,) = velocity_notes(ratios, JOINTS)
    assert finding.level is Level.SAYS and time_share(ratios) == 0.0
    assert f"velocities of {JOINTS[1]} are 0.8 times" in finding.text


@pytest.mark.parametrize(
    "recorded",
    [
        np.degrees,
        lambda qd: -qd,
        lambda qd: np.roll(np.round(qd, 2), 10, axis=0) + 0.2,
        lambda qd: sosfiltfilt(butter(2, 3.0, fs=200.0, output="sos"), qd, 0),
    ],
)
def test_velocities_in_other_units_late_or_smooth_are_no_fault_of_the_clock(recorded):
    qd = recorded(np.gradient(SAMPLES.q, SAMPLES.time, axis=0))
    ratios = velocity_ratios([replace(SAMPLES, qd=qd)])
    assert time_share(ratios) == 0.0 and [*velocity_notes(ratios, JOINTS)] == []


def test_repeated_samples_are_found():
    q = SAMPLES.q.copy()
    q[1::10] = q[0:-1:10]
    assert any(
        "repeat the position" in f.text for f in clock_findings([replace(SAMPLES, q=q)])
    )


@given(st.integers(0, 2), st.floats(0.2, 0.7))
def test_a_sensor_at_its_end_is_found(joint, share):
    tau = NOISY.tau.copy()
    low = tau[:, joint].min()
    tau[:, joint] = np.minimum(tau[:, joint], low + share * np.ptp(tau[:, joint]))
    arm = arm_of(JOINTS, is_slide=(False, False, True))
    findings = list(saturation_findings(arm, [replace(NOISY, tau=tau)]))
    assert {finding.about for finding in findings} == {"saturated"}
    unit = "N" if joint == 2 else "N·m"
    assert f"joint {JOINTS[joint]} is exactly" in findings[0].text
    assert f" {unit}, the end of its range" in findings[0].text
    assert "come out too small" in findings[0].text


def test_the_largest_torque_of_a_short_log_does_not_saturate():
    tau = SAMPLES.tau.copy()
    tau[50] += 9.0
    short = replace(SAMPLES, tau=tau)[:180]
    assert list(saturation_findings(arm_of(JOINTS), [short])) == []


@pytest.mark.parametrize("is_clipped", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_a_slow_driver_saturates_where_it_comes_to_the_end_again_and_again(
    four_joints, seed, is_clipped
):
    """Its largest reading is repeated, as every other one, by chance somewhat longer."""
    log = four_joints.log
    tau = log.tau
    if is_clipped:
        tau = np.clip(tau, *np.quantile(tau, (0.1, 0.9), axis=0))
    waits = np.random.default_rng(seed).exponential(20.0, len(tau)).astype(int)
    times = np.append(0, np.cumsum(waits))
    last = np.searchsorted(times, np.arange(len(tau)), side="right") - 1
    held = replace(log, tau=tau[times[last]])
    found = [*saturation_findings(four_joints.robot, [held])]
    assert bool(found) == is_clipped


def with_two_signs(joints):
    """Return the recording with torques of some joints about zero, and of the others above it."""
    tau = NOISY.tau - np.mean(NOISY.tau, axis=0)
    lift = 1.1 * np.max(np.abs(tau), axis=0) * ~np.isin(np.arange(3), joints)
    return replace(NOISY, tau=tau + lift)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_torque_without_a_sign_is_refused(sign):
    log = with_two_signs([0, 1, 2])
    (finding,) = unsigned_findings([replace(log, tau=sign * np.abs(log.tau))])
    assert finding.level is Level.REFUSES and finding.about is FaultName.UNSIGNED
    never = "negative" if sign > 0.0 else "positive"
    assert f"ever {never}" in finding.text


@pytest.mark.parametrize("joints", [[0, 1, 2], [1], [0, 2], []])
def test_torque_that_weight_holds_on_one_side_has_a_sign(joints):
    assert list(unsigned_findings([with_two_signs(joints)])) == []


@pytest.mark.parametrize("friction", [0.1, 1.0, 3.0, 10.0])
def test_torque_with_the_sign_of_the_motion_is_refused_unless_friction_gives_it(
    four_joints, friction
):
    robot, plan = four_joints.robot, four_joints.plan
    motion = next(motion_chunks(plan, 200.0))
    weight = ArmDynamics(robot).torque(motion.q, *np.zeros((2, *motion.q.shape)))
    size = friction * np.sqrt(np.mean(weight**2, axis=0))
    tau = weight + size * np.sign(motion.qd)
    log = Recording(motion.time, motion.q, None, tau)
    assert not [*motion_sign_findings(robot, [log])]
    turned = replace(log, tau=np.abs(tau) * np.sign(motion.qd))
    found = [*motion_sign_findings(robot, [turned])]
    # Where friction is larger than the weight, the sign that is given is the right one.
    assert len(found) == (friction < 1.0)


# ---- against the model


def test_a_log_that_cannot_be_checked_is_named(four_joints):
    text = r"^log0\.csv: the log's 12 s are too short for a cut-off of 0.001 Hz"
    with pytest.raises(InputError, match=text):
        judged(four_joints.robot, four_joints.log, cutoff=1e-3)


# ---- signs and mounting


def mounting_of(four_joints, gravity):
    """A log of the arm under gravity, and the direction (3,) that its finding states [m/s^2]."""
    robot = four_joints.robot
    log = truth_of(with_gravity(robot, np.array(gravity)), seed=3).log
    (finding,) = findings_of(robot, log)
    assert finding.level is Level.REFUSES and "on a wall or a ceiling" in finding.text
    ((flag, *numbers),) = finding.options
    assert flag == "--gravity"
    return log, 9.81 * np.array([*map(float, numbers)])


@pytest.mark.slow
def test_an_arm_that_hangs_is_named(four_joints):
    gravity = (0.0, 0.0, 9.81)
    assert_array_equal(mounting_of(four_joints, gravity)[1], gravity)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gravity", "stated"),
    [
        ((0.0, 0.0, 9.81), (0.0, 0.0, 9.81)),
        # A base is off by a degree, which the fit of a file finds itself.
        ((-9.81, 0.1, 0.1), (-9.81, 0.0, 0.0)),
        ((6.9, 0.0, 6.9), None),
    ],
)
def test_a_log_is_right_with_the_direction_that_its_finding_states(
    four_joints, gravity, stated
):
    log, direction = mounting_of(four_joints, gravity)
    assert_allclose(direction, gravity, atol=0.4)
    assert stated is None or np.array_equal(direction, stated)
    assert findings_of(with_gravity(four_joints.robot, direction), log) == ()


@pytest.mark.slow
def test_gravity_that_was_stated_the_wrong_way_round_is_named(four_joints):
    """A base turned by 180 degrees about its upright first joint is that joint's zero, too."""
    wall = with_gravity(four_joints.robot, np.array([9.81, 0.0, 0.0]))
    log = truth_of(wall, seed=3).log
    stated = with_gravity(wall, np.array([-9.81, 0.0, 0.0]))
    (finding,) = findings_of(stated, log)
    assert finding.level is Level.REFUSES and "--gravity" in finding.remedy


@pytest.mark.slow
def test_turned_torques_of_all_joints_are_named_and_the_search_is_shown(four_joints):
    turned = replace(four_joints.log, tau=-four_joints.log.tau)
    shown = []
    progress = SimpleNamespace(
        advance=lambda label, *state: label == TRYING and shown.append(state[0])
    )
    (finding,) = findings_of(four_joints.robot, turned, progress=progress)
    assert finding.text.startswith("the torque of every joint has the opposite sign")
    assert shown == sorted(shown) and len(shown) > 4 and shown[-1] == 1.0


@pytest.mark.slow
def test_one_joint_in_degrees_is_no_torque_in_another_unit(four_joints):
    degrees = np.where(np.arange(4) == 2, 180.0 / np.pi, 1.0)
    (finding,) = found_in(four_joints, q=four_joints.log.q * degrees, qd=None)
    assert finding.text == "the position of joint joint2 looks like degrees"
    assert finding.correction.position[2] == (2, pytest.approx(np.pi / 180.0))


@pytest.mark.slow
def test_a_turned_position_of_a_vertical_joint_is_no_turned_torque(four_joints):
    """The torques of the joint fit nearly as well with a turned torque."""
    signs = np.array([-1.0, 1.0, 1.0, 1.0])
    log = four_joints.log
    (finding,) = found_in(four_joints, q=log.q * signs, qd=log.qd * signs)
    assert finding.text.startswith("the position of joint joint0 has the opposite sign")


@pytest.mark.slow
def test_friction_that_drives_a_joint_shows_a_turned_sign(four_joints):
    """It is all that shows the sign of a joint that its links hardly load."""
    tau = four_joints.log.tau.copy()
    tau[:, -1] -= 10.0 * four_joints.friction[:, -1]
    (finding, *_) = found_in(four_joints, tau=tau)
    assert finding.about == "sign" and "joint joint3 has the opposite" in finding.text


@pytest.mark.slow
@pytest.mark.parametrize("joint", [0, 3, *slow(1, 2)])
def test_a_joint_that_stands_still_is_no_fault_and_hides_none(four_joints, joint):
    moves = np.arange(4) != joint
    plan = four_joints.plan.scale_amplitudes(moves.astype(float))
    truth = truth_of(four_joints.robot, seed=4, played=plan)
    assert not found_in(truth)
    assert found_in(truth, tau=1000.0 * truth.log.tau)


# ---- correct logs


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize(
    "axes",
    [
        FOUR_AXES,
        (small_arms.Y,),
        (small_arms.Z, small_arms.Y),
        (small_arms.Y, small_arms.X),
    ],
)
def test_dry_friction_at_rest_is_no_contact_and_a_short_arm_no_odd_one(axes):
    """A light arm with much dry friction, which acts until the very end of its creep to rest."""
    robot = small_arms.robot_of(small_arms.serial_arm(axes, joint=JOINT))
    rng = np.random.default_rng(0)
    plan = generate_excitation_trajectory(robot, rng, 12.0)
    motion = next(motion_chunks(plan, 200.0))
    noise = np.random.default_rng(0).normal(0.0, 0.05, motion.q.shape)
    log = Recording(
        motion.time, np.round(motion.q, 5), None, ArmDynamics(robot)(motion) + noise
    )
    assert findings_of(robot, log) == ()


@pytest.mark.slow
@pytest.mark.skipif(
    not public_models.exists(), reason="the models of public arms are not here"
)
@pytest.mark.parametrize(
    ("arm_name", "deviations", "duration", "seed"),
    [
        # Rounded positions make most of the noise, and that of accelerations is no delay.
        *(("xarm7", deviation, 60.0, 50) for deviation in DEVIATIONS),
        *(("ur5e", deviation, 60.0, 50) for deviation in DEVIATIONS),
        # Of a joint that links hardly load, all but friction and its rotor fits with either sign.
        ("ur5e", "exact", 6.0, 4),
        ("xarm7", "exact", 8.0, 3),
    ],
)
def test_correct_logs_of_public_arms_draw_no_alarm(
    arm_name, deviations, duration, seed
):
    robot = load_robot_model(public_models / ARMS[arm_name])
    log = draw_arm(robot, deviations, False, duration, seed % 2 == 0, seed).log
    assert findings_of(robot, log) == ()


# ---- findings that stop an identification


FINDINGS = st.lists(
    st.builds(
        Finding, st.sampled_from(Level), st.sampled_from([*FaultName]), st.just("words")
    ),
    max_size=6,
)


@given(FINDINGS, st.sets(st.sampled_from([*FaultName])))
def test_refusals_and_doubts_that_nobody_accepts_stop(findings, accepted):
    refused = any(f.level is Level.REFUSES for f in findings)
    doubts = {f.about for f in findings if f.level is Level.DOUBTS} - accepted
    columns = SimpleNamespace(angle_declared=False)
    log = [SimpleNamespace(name="log.csv", columns=columns)]
    if not refused and not doubts:
        require_acceptable(log, findings, accepted)
        return
    with pytest.raises(SysidError) as caught:
        require_acceptable(log, findings, accepted)
    assert isinstance(caught.value, InputError) == refused
    assert str(caught.value).startswith("log.csv: words")
    if not refused:
        assert all(f"--accept {name}" in str(caught.value) for name in doubts)
