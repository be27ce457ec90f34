"""Recordings: what is written and read back, and mean torques of held commands."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.motors.damiao_rig import mit_command, state, trajectory_of, undoubted_replies
from rigs.motors.recordings import read_recording
from robot_sysid.damiao.joints import MOTORS
from robot_sysid.damiao.protocol import Feedback, Scaling, decode_feedback
from robot_sysid.damiao.recorder import Aside, Centring, MeasurementRecorder
from robot_sysid.damiao.settings import Plan, RecordingOptions
from robot_sysid.damiao.simulated import simulated_motor


def recorder_for(path, types=("DM4340",), overwrite=False):
    """A recorder that writes at once, for motors of these types."""
    still = np.zeros((2, len(types)))
    trajectory = trajectory_of((np.arange(2.0), still, still, still), *types)
    motors = [simulated_motor(joint, 0.1) for joint in trajectory.joints]
    plan = Plan(trajectory, recording=RecordingOptions(path, overwrite))
    return MeasurementRecorder(
        path, plan, [motor.registers for motor in motors], Aside(threaded=False)
    )


@given(
    types=st.lists(st.sampled_from(sorted(MOTORS)), min_size=1, max_size=4),
    seed=st.integers(0, 2**32 - 1),
)
def test_every_frame_can_be_told_back_from_the_recording(types, seed, tmp_path_factory):
    """The printed digits suffice to find the very codes the motor sent, whose steps are larger."""
    rng = np.random.default_rng(seed)
    shape = 6, len(types)
    scaling = Scaling(MOTORS[t].limits for t in types)
    answered = rng.random(shape) < 0.5
    times = 0.004 * np.arange(6)
    delays = rng.uniform(1e-4, 2e-3, shape)
    stamps = np.where(answered, times[:, None] + delays, np.nan)
    commands = rng.uniform(-10.0, 10.0, (3, *shape))
    sent = vars(decode_feedback(rng.integers(0, 256, (*shape, 8), np.uint8), scaling))
    heard = {name: np.where(answered, field, np.nan) for name, field in sent.items()}
    measured = {name: heard[name] for name in ("position", "velocity", "torque")}
    path = tmp_path_factory.mktemp("rec") / "measured.csv"
    with recorder_for(path, types) as recorder:
        for k, time in enumerate(times):
            fields = {name: field[k] for name, field in {**sent, **measured}.items()}
            position, velocity, torque = commands[:, k]
            acted = mit_command(position, velocity, torque=torque)
            feedback = Feedback(**fields)
            # The next command makes a step of torque, whose mean is recorded too.
            then = stamps[k] + 7.0, feedback, answered[k], acted._replace(kd=0.0)
            recorder.write(time, 7.0, undoubted_replies(answered[k], *then), acted)
    recording = read_recording(path)
    assert recording.ending == "completed"
    np.testing.assert_allclose(recording.columns["time"], times, atol=1e-6)
    mean = recording.joint_values("cmd_mean")
    assert np.any(np.abs(mean) > 0.01)
    columns = {
        "pos": (heard["position"], 0.49 * scaling.steps[0]),
        "vel": (heard["velocity"], 0.49 * scaling.steps[1]),
        "tau": (heard["torque"] + mean, 0.49 * scaling.steps[2] + 1e-6),
        "time": (stamps, 1e-6),
        "status": (heard["status"], 0.0),
        "temp_mos": (heard["temperature_mos"], 0.0),
        "temp_rotor": (heard["temperature_rotor"], 0.0),
        **{t: (c, 6e-7) for t, c in zip(("cmd_pos", "cmd_vel", "cmd_tau"), commands)},
    }
    for title, (exact, tolerance) in columns.items():
        values = recording.joint_values(title)
        np.testing.assert_array_equal(np.isnan(values), np.isnan(exact))
        assert np.nanmax(np.abs(values - exact) - tolerance, initial=-1.0) <= 0, title


def replies_of(q, qd, time, command=None, torque=0.0):
    """The answers of a cycle, in which the motors took a new command."""
    answered = np.isfinite(q)
    return undoubted_replies(answered, time, state(q, qd, torque, 0), answered, command)


def test_rows_are_in_the_file_before_the_error_that_ends_the_run(tmp_path):
    path = tmp_path / "measured.csv"
    replies = replies_of(*np.ones((3, 1)), torque=1.0)
    with pytest.raises(RuntimeError), recorder_for(path) as recorder:
        recorder.write(0.0, 0.0, replies, mit_command(torque=1.0))
        recording = read_recording(path)
        assert len(recording.columns["time"]) == 1 and recording.ending == "cut short"
        assert list(recording.columns)[-1] == "j0_temp_rotor"
        raise RuntimeError("two\nlines")
    assert read_recording(path).ending == "stopped: two lines"


# --- centring -----------------------------------------------------------------------------------


@pytest.mark.parametrize("threaded", [False, True])
def test_what_goes_wrong_is_kept_and_nothing_is_done_after_it(threaded):
    error = SystemExit()

    def fail():
        raise error

    done = []
    aside = Aside(threaded)
    for k in range(20):
        aside(lambda k=k: done.append(k))
    aside(fail)
    aside(lambda: done.append("more"))
    aside.finish()
    assert aside.failure is error and done == list(range(20))


def test_somebody_who_does_not_answer_is_not_waited_for():
    """A terminal held with Ctrl-S: handing over goes on at once, and the end does not wait long."""
    held = threading.Event()
    aside = Aside(threaded=True)
    aside(held.wait)
    for _ in range(10):
        aside(lambda: None)
    aside.finish(patience=0.01)
    assert isinstance(aside.failure, TimeoutError)
    held.set()


PERIOD = 0.01


def test_a_joint_that_holds_still_gets_the_mean_of_held_commands():
    """The fundamental of a held sine lags by half a period and is lower by sinc."""
    kp = 100.0
    angular = 2.0 * np.pi * 5.0
    times = PERIOD * np.arange(400)
    commands = [mit_command(np.sin(angular * time), kp=kp) for time in times]
    centring = Centring(PERIOD)
    zero = np.zeros(1)
    errors = []
    # Each sample is taken when the next command arrives.
    for time, acted, command in zip(times[1:], commands, commands[1:]):
        replies = replies_of(zero, zero, zero + time, command)
        torque = centring.torques(replies, acted) + kp * acted.position
        middle = np.sin(angular * (time - 0.5 * PERIOD))
        errors.append(torque / kp - np.sinc(5.0 * PERIOD) * middle)
    half_step_only = (angular * PERIOD) ** 2 / 12.0
    assert np.max(np.abs(errors[2:])) < 0.25 * half_step_only


@pytest.mark.parametrize("damping", [0.05, 1.0, 20.0])
def test_a_step_falls_until_it_is_sampled_as_damping_lets_it(damping):
    """The periodic response to a sawtooth of torque, of a joint with inertia and damping.

    I v' + d v = step (1/2 - t / T) has the solution v = level + slope t + fading exp(-d t / I).
    """
    inertia = 0.05
    step = 0.7
    slope = -step / (damping * PERIOD)
    level = 0.5 * step / damping - inertia * slope / damping
    fading = slope * PERIOD / -np.expm1(-damping * PERIOD / inertia)
    velocity = level + fading
    zero = np.zeros(1)
    acted = mit_command(kd=damping)
    replies = replies_of(zero, zero, zero, acted._replace(torque=zero + step))
    centring = Centring(PERIOD, np.array([[1.0 / inertia]]))
    # The cycle before was the same.
    centring.torques(replies, acted)
    centre = centring.torques(replies, acted)
    assert centre[0] == pytest.approx(0.5 * step + damping * velocity, abs=0.02 * step)


def test_a_missing_answer_leaves_the_other_joints_torques_as_they_are():
    """A joint that is silent for a cycle, or from the first on, makes holes for itself alone."""
    inertia = np.array([0.05, 0.03])
    time = np.array([0.0, 0.001])
    for silent_cycles in ({2}, {0}, {0, 1, 2, 3}):
        centring = Centring(PERIOD, np.diag(1.0 / inertia))
        for k in range(4):
            silent = np.array([False, k in silent_cycles])
            q = np.where(silent, np.nan, 0.0)
            stamps = np.where(silent, np.nan, time + k * PERIOD)
            acted = mit_command(np.full(2, 0.01 * k), kp=100.0)
            sent = mit_command(np.full(2, 0.01 * (k + 1)), kp=100.0)
            centre = centring.torques(replies_of(q, q, stamps, sent), acted)
            np.testing.assert_array_equal(np.isfinite(centre), ~silent)
            step = 0.01 * sent.kp[0]
            assert centre[0] == pytest.approx(0.5 * step, rel=0.2)
