"""Faults that last a moment: their stretch is left out, and the rest of the log is used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import robot_sysid
from rigs.arms import small_arms
from rigs.arms.motions import sampled, smooth_step
from rigs.logs.log_files import JOINTS
from robot_sysid.faults.stretches import MANY_VALUES, failed_sensors, leave_out
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.records.messages import Level
from robot_sysid.signals.frozen import Stretch, equal_runs
from tests.faults.conftest import (
    FOUR_AXES,
    JOINT,
    NOISY,
    SAMPLES,
    findings_of,
    found_in,
    judged,
)

BEGIN, END = 4.0, 5.2
"""When a fault acts [s]."""
BESIDE = 1.5
"""Longest time beside a fault that is left out with it [s]."""


def rows_between(log, begin=BEGIN, end=END):
    """Return the rows (N,) of a stretch of a log."""
    return (log.time >= begin) & (log.time <= end)


def with_torque(log, torque):
    """Return a log with more torque (N, n) while the fault acts."""
    return replace(log, tau=log.tau + torque * rows_between(log)[:, None])


def push(log):
    """Return a log with half a sine wave of torque at all joints."""
    wave = np.sin(np.pi * (log.time - BEGIN) / (END - BEGIN))
    return with_torque(log, np.outer(wave, np.std(log.tau, axis=0)))


def rest_hand(log):
    """Return a log with a constant torque at two joints."""
    return with_torque(log, 0.7 * np.std(log.tau, axis=0) * [0.0, 1.0, 1.0, 0.0])


def hold(log, column, joints, value=None):
    """Return a log in which positions or torques of joints stand, or have a value."""
    values = vars(log)[column].copy()
    rows = np.flatnonzero(rows_between(log))
    held = values[rows[0], joints] if value is None else value
    values[np.ix_(rows, joints)] = held
    return replace(log, qd=None, **{column: values})


FAULTS = {
    "push": push,
    "hand": rest_hand,
    "no torque": lambda log: hold(log, "tau", [1], 0.0),
    "held torque": lambda log: hold(log, "tau", [2]),
    "torque at its end": lambda log: hold(log, "tau", [1], 1.3 * np.max(log.tau[:, 1])),
    "one frozen position": lambda log: hold(log, "q", [2]),
    "all positions frozen": lambda log: hold(log, "q", range(4)),
}
"""Name of a fault that lasts a moment to the function that puts it into a log of four joints."""


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_that_lasts_a_moment_is_left_out_and_said(four_joints, fault):
    log = FAULTS[fault](four_joints.log)
    answer = judged(four_joints.robot, log)
    findings = answer.findings
    assert {finding.level for finding in findings} == {Level.SAYS}, findings
    assert all("left out" in finding.text for finding in findings)
    (recording,) = answer.fit.recordings
    time = recording.motion.time
    used = time[np.any(recording.is_used, axis=1)]
    assert not np.any((used > BEGIN + 0.02) & (used < END - 0.02))
    step = float(np.median(np.diff(time)))
    assert step * (len(time) - len(used)) - (END - BEGIN) <= BESIDE
    error = answer.fit.by_name["m"] - four_joints.theta[0]
    assert abs(error) < 3.0 * answer.fit.error_of("m")


@pytest.mark.slow
@pytest.mark.parametrize(
    "spans",
    [[(0.5 + k, 0.9 + k) for k in range(8)], [(1.0, 9.0)]],
    ids=["often", "most of the log"],
)
def test_a_fault_that_comes_back_or_lasts_stops_the_identification(four_joints, spans):
    tau = four_joints.log.tau.copy()
    for span in spans:
        tau[rows_between(four_joints.log, *span), 1] = 0.0
    findings = found_in(four_joints, tau=tau)
    assert any(f.about == "held" and f.level is Level.DOUBTS for f in findings)


@pytest.mark.slow
def test_pushes_that_come_back_stop_the_identification(four_joints):
    log = four_joints.log
    waves = np.maximum(np.sin(2.0 * np.pi * log.time), 0.0) * (np.sin(log.time) > 0.0)
    tau = log.tau + np.outer(waves, 0.5 * np.std(log.tau, axis=0))
    assert any(f.level is not Level.SAYS for f in found_in(four_joints, tau=tau))


SPANS = st.lists(
    st.builds(
        lambda start, length: Stretch(
            start, start + length, np.array([0, 1, 0]) > 0, "held"
        ),
        st.floats(-1.0, 11.0),
        st.floats(0.0, 0.6),
    ),
    max_size=2,
)


def used_times(pieces):
    """Return the times of the rows of pieces that are not left out [s]."""
    times = []
    for piece in pieces:
        times.append(piece.time[~piece.is_left_out])
    return np.concatenate(times)


@given(SPANS, SPANS)
def test_leaving_out_more_never_uses_more_rows(first, second):
    """Nothing but what is left out changes, and the order of stretches does not matter."""
    once, _ = leave_out(JOINTS, [SAMPLES], first)
    twice, _ = leave_out(JOINTS, once, second)
    together, _ = leave_out(JOINTS, [SAMPLES], [*second, *first])
    left_out = np.zeros(len(SAMPLES), dtype=bool)
    for stretch in (*first, *second):
        left_out |= rows_between(SAMPLES, stretch.start, stretch.stop)
    for pieces in (twice, together):
        np.testing.assert_array_equal(used_times(pieces), SAMPLES.time[~left_out])
        for piece in pieces:
            changed = np.any(piece.q != SAMPLES.q[np.isin(SAMPLES.time, piece.time)])
            assert not changed or np.any(piece.is_left_out)


@given(st.permutations(range(3)), st.integers(0, 2), st.integers(300, 1500))
def test_what_is_left_out_does_not_depend_on_the_order_of_joints(order, joint, start):
    tau = NOISY.tau.copy()
    q = NOISY.q.copy()
    tau[start : start + 200, joint] = tau[start, joint]
    other = (joint + 1) % 3
    q[start + 100 : start + 260, other] = q[start + 100, other]
    outcomes = []
    for columns in (order, range(3)):
        columns = [*columns]
        log = replace(NOISY, q=q[:, columns], tau=tau[:, columns])
        names = [JOINTS[column] for column in columns]
        (piece,), notes = leave_out(names, [log], [*failed_sensors([log])])
        assert {note.level for note in notes} == {Level.SAYS}
        positions = piece.q[:, np.argsort(columns)].tolist()
        texts = [sorted(note.text) for note in notes]
        outcomes.append((piece.is_left_out.tolist(), positions, texts))
    assert outcomes[0] == outcomes[1]


def test_coarse_steps_and_joints_at_rest_are_no_failed_sensors():
    coarse = replace(
        NOISY, q=np.round(NOISY.q / 0.01) * 0.01, tau=np.round(NOISY.tau / 0.05) * 0.05
    )
    assert [*failed_sensors([NOISY, coarse])] == []
    resting = NOISY.q.copy()
    resting[:600, 1] = resting[600, 1]
    assert [*failed_sensors([replace(NOISY, q=resting)])] == []


@pytest.mark.slow
@pytest.mark.parametrize("joint", [1, 2])
def test_a_joint_that_friction_holds_with_one_torque_is_no_failed_sensor(
    four_joints, joint
):
    """A controller's dead zone asks it for the same torque while other joints move."""
    motion = four_joints.motion
    count = len(motion.time) // 3
    goes = smooth_step((np.arange(len(motion.q)) - count) / count)
    q = motion.q.copy()
    q[:, joint] = q[0, joint] + goes * (q[:, joint] - q[0, joint])
    moved = sampled(motion.time, q)
    qd = moved.qd.copy()
    qd[:count, joint] = 0.0
    noise = 0.01 * np.random.default_rng(0).standard_normal(q.shape)
    log = four_joints.arm.log(replace(moved, qd=qd), noise)
    # Between the least and the largest torque.
    tau = log.tau.copy()
    tau[:count, joint] = np.median(tau[:, joint])
    log = replace(log, tau=tau)
    assert not [*failed_sensors([log])]
    assert findings_of(four_joints.robot, log) == ()


@pytest.mark.slow
def test_an_identification_uses_the_rest_and_carries_the_note(four_joints, tmp_path):
    path = tmp_path / "log.csv"
    names = four_joints.robot.joint_names
    write_measurement_csv(path, names, [push(four_joints.log)])
    (tmp_path / "arm.xml").write_text(small_arms.serial_arm(FOUR_AXES, joint=JOINT))
    result = robot_sysid.identify(tmp_path / "arm.xml", path)
    assert any("touched the arm" in remark.text for remark in result.remarks)
    error = result.theta[0] - four_joints.theta[0]
    assert abs(error) < 2.0 * result.standard_errors["m"]


def test_a_torque_in_many_steps_that_changes_slowly_is_no_failed_sensor():
    """It stays on one step where it turns, and goes on to the next; a sensor that failed jumps."""
    step = 0.02
    slow = replace(SAMPLES, time=10.0 * SAMPLES.time)
    coarse = replace(slow, tau=np.round(slow.tau / step) * step)
    column = coarse.tau[:, 0]
    assert len(np.unique(column)) >= MANY_VALUES
    assert [*equal_runs(coarse.time, column)]
    assert [*failed_sensors([coarse])] == []
    held = coarse.tau.copy()
    held[600:760, 0] = held[600, 0]
    (stretch,) = failed_sensors([replace(coarse, tau=held)])
    assert stretch.joints.tolist() == [True, False, False]
