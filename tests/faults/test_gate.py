"""One gate: mistakes of several joints, experiments that are no mistakes, logs judged together."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from rigs.arms.wrong_arms import truth_of
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.errors import InputError, SysidError
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.questions import Question
from robot_sysid.faults import Finding
from robot_sysid.faults.gate import (
    accepted_doubts,
    in_order,
    judge,
    require_acceptable,
    usable_fit,
)
from robot_sysid.records import Motion, Recording
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.messages import Level, Progress
from tests.faults.conftest import findings_of, fit_of, found_in, read_log, slow


@pytest.mark.slow
@pytest.mark.parametrize("turned", [(0, 2), *slow((1, 2), (0, 1, 3))])
def test_turned_signs_of_several_joints_are_named_together(four_joints, turned):
    signs = np.where(np.isin(range(4), turned), -1.0, 1.0)
    (finding,) = found_in(four_joints, tau=signs * four_joints.log.tau)
    assert finding.about == "sign"
    assert tuple(factor for _, factor in finding.correction.torque) == tuple(signs)


def test_a_torque_of_weight_alone_is_no_fault_of_the_clock(four_joints):
    """Such as of an arm that is guided by hand, or of a controller's model of gravity."""
    noise = np.random.default_rng(0).normal(0.0, 0.02, four_joints.still.shape)
    found = found_in(four_joints, tau=four_joints.still + noise)
    assert {f.about for f in found} == {"computed"} and not found[0].options
    assert "time" not in found[0].sentence


def swings(robot, seed, times=2.0):
    """Return a right log in which one joint after the other swings a few times."""
    rng = np.random.default_rng(seed)
    time = np.arange(4000) / 200.0
    rate = 0.8 * np.pi
    phase = rate * (time[:, None] - 5.0 * np.arange(robot.n_joints))
    is_own = (phase >= 0.0) & (phase < 2.0 * np.pi * times)
    size = is_own * rng.uniform(0.5, 0.9, robot.n_joints)
    q = size * (1.0 - np.cos(phase))
    qd = rate * size * np.sin(phase)
    qdd = rate**2 * size * np.cos(phase)
    tau = ArmDynamics(robot)(Motion(time, q, qd, qdd))
    noise = 0.02 * rng.normal(size=q.shape)
    return Recording(time, np.round(q, 4), None, tau + noise)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("seed", range(3))
def test_joints_that_are_driven_one_at_a_time_are_an_experiment(four_joints, seed):
    found = findings_of(four_joints.robot, swings(four_joints.robot, seed))
    assert all(finding.level is Level.SAYS for finding in found), found


def test_joints_that_hardly_move_are_too_little_however_long_the_log_is(four_joints):
    """Independent samples are those of moments at which a joint moves."""
    short = swings(four_joints.robot, 0, times=0.5)
    (finding,) = findings_of(four_joints.robot, short)
    assert finding.about == "too-little" and finding.level is Level.REFUSES
    assert "20 s behind a low-pass" in finding.text


@pytest.mark.slow
def test_logs_that_each_show_some_joints_are_judged_together(four_joints):
    """What one log does not show, another one does."""
    logs = []
    for moving in ((0, 1), (1, 2, 3)):
        moves = np.isin(np.arange(4), moving).astype(float)
        plan = four_joints.plan.scale_amplitudes(moves)
        logs.append(truth_of(four_joints.robot, seed=4, played=plan).log)
    assert findings_of(four_joints.robot, *logs) == ()
    wrong = [replace(log, tau=log.tau * [1.0, 1.0, -1.0, 1.0]) for log in logs]
    (finding,) = findings_of(four_joints.robot, *wrong)
    assert finding.about == "sign" and "joint joint2 has" in finding.text


@pytest.mark.slow
def test_friction_of_one_log_that_is_not_that_of_the_others_is_no_delay(four_joints):
    cold = four_joints.arm
    warm = replace(cold, coulomb=0.6 * cold.coulomb, viscous=0.6 * cold.viscous)
    motion = truth_of(four_joints.robot, seed=5).motion
    noise = 0.02 * np.random.default_rng(0).standard_normal(motion.q.shape)
    other = warm.log(motion, noise)
    (finding,) = findings_of(four_joints.robot, four_joints.log, other)
    assert finding.about == "friction" and finding.level is Level.SAYS
    assert "friction is not that of the other logs" in finding.text
    changes = re.findall(r"(-?[\d.]+) ± ([\d.]+) % at joint\d", finding.text)
    assert len(changes) >= 3
    # Of what the sentence says the log is.
    change = 0.6 - 1.0 if "in log1" in finding.text else 1.0 / 0.6 - 1.0
    for share, error in changes:
        assert float(share) == pytest.approx(100.0 * change, abs=3.0 * float(error))
        assert float(error) < 10.0


@pytest.mark.slow
def test_friction_that_changes_over_a_log_is_said_with_its_size(four_joints):
    truth = truth_of(four_joints.robot, seed=5)
    motion = truth.motion
    noise = 0.02 * np.random.default_rng(0).standard_normal(motion.q.shape)
    cold = four_joints.arm
    without = replace(cold, coulomb=0.0 * cold.coulomb, viscous=0.0 * cold.viscous)
    log = cold.log(motion, noise)
    friction = log.tau - without.log(motion, noise).tau
    along = (log.time - log.time[0]) / np.ptp(log.time) - 0.5
    falling = replace(log, tau=log.tau - 0.3 * along[:, None] * friction)
    (finding,) = findings_of(four_joints.robot, falling)
    assert finding.about == "friction" and "off by half of this" in finding.text
    changes = re.findall(r"(-?[\d.]+) ± ([\d.]+) % at joint\d", finding.text)
    assert changes
    for share, error in changes:
        assert float(share) == pytest.approx(-30.0, abs=3.0 * float(error))


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.4, *slow(1.7, 2.5)])
def test_a_payload_is_refused_for_what_its_logs_are_refused_for(four_joints, factor):
    """Torques that are all scaled do not cancel in the difference of the logs."""
    robot = four_joints.robot
    loaded = truth_of(robot, seed=4, load=0.5).log
    logs = []
    for name, log in (("empty.csv", four_joints.log), ("loaded.csv", loaded)):
        logs.append(read_log(robot, replace(log, tau=factor * log.tau), name))
    link = Question(EstimationOptions())
    payload = replace(link, loaded=True)
    for asked, read, sides in ((payload, logs, [False, True]), (link, logs[:1], ())):
        judged = judge(robot, read, asked, Progress(), sides)
        with pytest.raises(InputError, match="times those of the model's masses"):
            usable_fit(judged, ("torque-scale",), Progress())


def with_jumps(log):
    """Return a log whose clock jumps ahead by 50 ms three times."""
    jumps = np.zeros(len(log))
    jumps[[600, 1200, 2000]] = 0.05
    return replace(log, time=log.time + np.cumsum(jumps))


@pytest.mark.slow
def test_what_needs_less_of_a_log_comes_first(four_joints):
    """Samples before columns: a remedy of columns is none while samples are doubted."""
    robot = four_joints.robot
    signs = np.where(np.arange(4) == 2, -1.0, 1.0)
    both = with_jumps(replace(four_joints.log, tau=signs * four_joints.log.tau))
    judged = judge(
        robot, [read_log(robot, both)], Question(EstimationOptions()), Progress()
    )
    assert {finding.about for finding in judged.findings} == {"clock", "sign"}
    with pytest.raises(InputError, match="the clock jumps .* opposite sign") as error:
        usable_fit(judged, (), Progress())
    assert not error.value.options
    with pytest.raises(InputError, match="opposite sign") as error:
        usable_fit(judged, ("clock",), Progress())
    assert "clock" not in str(error.value)


def test_a_torque_that_was_computed_is_named_before_a_model_that_is_off(four_joints):
    truth = truth_of(four_joints.robot, seed=6, wrong_links=0.3)
    (finding,) = found_in(truth, tau=truth.rigid)
    assert finding.about == "computed"


@pytest.mark.parametrize("about", [FaultName.CLOCK, FaultName.GRAVITY])
def test_a_note_on_the_model_beside_what_needs_less_is_its_consequence(about):
    note = Finding(Level.SAYS, FaultName.MODEL, "a sibling of this arm")
    first = Finding(Level.REFUSES, about, "no torque of this arm")
    assert in_order([note, first]) == (first,)
    later = Finding(Level.REFUSES, FaultName.SIGN, "a sign is wrong")
    assert in_order([note, later]) == (later, note)


def test_an_accepted_doubt_is_said_and_passes_no_refusal(four_joints):
    robot = four_joints.robot
    jumping = read_log(robot, with_jumps(four_joints.log))
    judged = judge(robot, [jumping], Question(EstimationOptions()), Progress())
    _, notes = usable_fit(judged, ("clock",), Progress())
    assert any(note.startswith("accepted: the clock jumps") for note in notes)
    (passed,) = accepted_doubts(judged.findings, ("clock",))
    assert passed.about is FaultName.CLOCK
    assert not accepted_doubts(judged.findings, ("zero",))
    refusal = Finding(Level.REFUSES, FaultName.SIGN, "a sign is wrong")
    other = Finding(Level.REFUSES, FaultName.ORDER, "joints are exchanged")
    found = (*judged.findings, refusal, other)
    with pytest.raises(InputError, match="--accept clock accepts doubts of that name"):
        require_acceptable([jumping], found, ("clock",))


@pytest.mark.parametrize("count", [1, 2])
def test_a_doubt_alone_has_its_remedies(four_joints, count):
    """Where something else is in doubt as well, they may not be enough."""
    scale = ("--torque-scale", "1.2")
    doubt = Finding(
        Level.DOUBTS, FaultName.TORQUE_SCALE, "a factor", options=(scale,), command="c"
    )
    other = Finding(Level.DOUBTS, FaultName.ZERO, "a zero is wrong")
    with pytest.raises(SysidError, match="nothing was written") as caught:
        require_acceptable([four_joints.log], [doubt, other][:count])
    assert caught.value.exit_code == 1
    expected = ((scale,), "c") if count == 1 else ((), "")
    assert (caught.value.options, caught.value.command) == expected


def test_two_zeros_that_are_wrong_are_put_right_together(four_joints):
    """By lines of one columns file."""
    robot = four_joints.robot
    log = four_joints.log
    turned = np.array([0.0, 0.5, -0.5, 0.0]) * np.pi
    judged = judge(
        robot,
        [read_log(robot, replace(log, q=log.q + turned))],
        Question(EstimationOptions()),
        Progress(),
    )
    corrections = {finding.correction for finding in judged.findings}
    assert len(judged.findings) == 2 and len(corrections) == 1
    np.testing.assert_allclose(corrections.pop().zeros, -turned, atol=1e-9)


@pytest.mark.slow
def test_a_delay_is_said_with_the_number_that_it_moves_most(four_joints):
    """Of one joint: the delay of all joints is in every fit, and moves nothing."""
    tau = four_joints.log.tau.copy()
    tau[:, 2] = np.roll(tau[:, 2], 12)
    late = replace(four_joints.log, tau=tau)
    (finding,) = findings_of(four_joints.robot, late)
    assert finding.about == "delay"
    said = re.search(
        r"makes the viscous friction of (joint\d) too (large|small) by ([\d.]+) ± ",
        finding.text,
    )
    assert said is not None, finding.text
    key = f"viscous[{said[1]}]"
    right, wrong = fit_of(four_joints), fit_of(four_joints, tau=tau)
    off = wrong.by_name[key] - right.by_name[key]
    assert float(said[3]) == pytest.approx(abs(off), rel=0.2)
    assert (said[2] == "large") == (off > 0.0)
    all_late = replace(four_joints.log, tau=np.roll(four_joints.log.tau, 8, axis=0))
    (finding,) = findings_of(four_joints.robot, all_late)
    assert finding.about == "delay" and "makes" not in finding.text
