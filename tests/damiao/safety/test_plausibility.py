"""Which answers are believed, and which commands are refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.motors.damiao_rig import MotorBus, mit_command, state
from robot_sysid.damiao import protocol
from robot_sysid.damiao.joints import damiao_joints
from robot_sysid.damiao.protocol import Scaling
from robot_sysid.damiao.safety.plausibility import (
    FASTEST,
    LONGEST_SPURT,
    SLACK,
    SampleFilter,
    confine,
    require_allowed,
)
from robot_sysid.errors import HardwareAbort, SysidError
from robot_sysid.records import Limits

PEAK = 27.0
STEP = 0.005
CYCLE = 0.004
KP = 180.0


def swing(k):
    """Position and velocity of a joint that swings, at a cycle."""
    time = k * CYCLE
    return 0.5 * np.sin(2.0 * time), np.cos(2.0 * time)


def answer(k, q=None, qd=None, tau=None, status=1, heat=30):
    """What one joint answers in a cycle in which it follows its command, or says something else."""
    p, v = swing(k)
    command = mit_command(p, v, KP, 4.5, 3.0)
    q = p if q is None else q
    qd = v if qd is None else qd
    commanded = command.motor_torque(np.array([q]), np.array([qd]))[0]
    tau = commanded if tau is None else tau
    seen = state(q, qd, tau, status, heat)
    return np.ones(1, bool), np.array([k * CYCLE]), seen, command


def started_filter():
    """A filter of one joint that stands at zero."""
    judge = SampleFilter(np.array([PEAK]), np.array([STEP]))
    judge.start(0.0, np.zeros(1))
    return judge


def believe_answers(*changes):
    """Return for each of some answers, after ten good ones, whether it is believed."""
    judge = started_filter()
    verdicts = []
    for k in range(1, 11 + len(changes)):
        change = changes[k - 11] if k > 10 else {}
        believed, *_ = judge.believe(*answer(k, **change))
        verdicts.append(bool(believed[0]))
    assert all(verdicts[:10])
    return verdicts[10:]


OFF = {
    "position": lambda k: {"q": swing(k)[0] + 0.78, "tau": 3.0},
    "position, near": lambda k: {"q": swing(k)[0] - 0.06, "tau": 3.0},
    "velocity": lambda k: {"qd": swing(k)[1] - 2.5, "tau": 3.0},
    "torque": lambda k: {"tau": 3.0 + 9.0},
    "status": lambda k: {"status": 9},
    "disabled": lambda k: {"status": 0},
    "heat": lambda k: {"heat": 94},
}


@pytest.mark.parametrize("offset", OFF)
def test_one_damaged_answer_is_set_aside_and_the_next_good_one_believed(offset):
    assert believe_answers(OFF[offset](11), {}, {}) == [False, True, True]


@given(st.integers(1, 200), st.floats(0.0, 1.0))
def test_a_joint_has_moved_on_since_its_last_sample_but_not_for_ever(k, passed):
    """Commands act a cycle later: where the joint was then is no error of its position."""
    judge = started_filter()
    for number in range(1, k + 1):
        judge.believe(*answer(number))
    now = judge.position_at(k * CYCLE + passed)[0]
    spurt = min(passed, LONGEST_SPURT)
    # The swing accelerates by 2 rad/s^2 at most.
    assert abs(now - swing(k + spurt / CYCLE)[0]) < spurt**2 + 1e-9
    assert abs(now - judge.last.q[0]) <= 1.0 * LONGEST_SPURT


@pytest.mark.parametrize("offset", ["velocity", "torque", "status", "disabled", "heat"])
def test_two_that_agree_are_believed(offset):
    assert believe_answers(OFF[offset](11), OFF[offset](12), OFF[offset](13)) == [
        False,
        True,
        True,
    ]


def test_a_position_that_the_torque_contradicts_is_never_believed():
    """Its motor holds the joint where it was: what reports is wrong, and not where it is."""
    offset = OFF["position"]
    assert believe_answers(*(offset(k) for k in range(11, 17))) == [False] * 6


SAMPLES = st.lists(
    st.tuples(
        st.floats(-12.5, 12.5),
        st.floats(-10.0, 10.0),
        st.floats(-28.0, 28.0),
        st.booleans(),
    ),
    max_size=30,
)


@given(SAMPLES)
def test_no_history_moves_what_is_believed_farther_than_a_joint_can_go(samples):
    """Neither do many refused answers in a row, nor a long time without any."""
    judge = started_filter()
    last = 0.0
    for k, (q, qd, tau, is_enabled) in enumerate(samples, 1):
        speeds = np.abs([judge.last.qd[0], qd])
        judge.believe(*answer(k, q, qd, tau, int(is_enabled)))
        now = judge.last.q[0]
        passed = CYCLE * k
        spurt = min(passed, LONGEST_SPURT)
        way = SLACK + 1.5 * speeds.max() * passed + 0.5 * FASTEST * spurt**2
        assert abs(now - last) <= way + 1e-9
        last = now


@pytest.mark.slow
@given(
    angle=st.floats(0.2, 12.0),
    sign=st.sampled_from([-1.0, 1.0]),
    gap=st.integers(1, 250),
)
def test_time_makes_no_position_credible(angle, sign, gap):
    """Whatever the angle, a whole turn too, and though nothing was heard for a second."""
    judge = started_filter()
    for k in range(1, 11):
        judge.believe(*answer(k))
    for k in range(10 + gap, 500):
        p, v = swing(k)
        believed, _, jump = judge.believe(*answer(k, q=p + sign * angle, tau=3.0))
        assert not believed[0]
        assert jump[0] == 0.0
    assert not judge.is_misled[0]


@given(angle=st.floats(0.2, 12.0), sign=st.sampled_from([-1.0, 1.0]))
def test_while_positions_are_refused_the_speed_leads_on(angle, sign):
    """So a stop knows where the joint is, and good answers are believed again at once."""
    judge = started_filter()
    for k in range(1, 11):
        judge.believe(*answer(k))
    for k in range(11, 300):
        believed, followed, _ = judge.believe(
            *answer(k, q=swing(k)[0] + sign * angle, tau=3.0)
        )
        assert followed[0] and not believed[0]
        # The trapezoidal rule leaves a hundredth of a milliradian.
        assert abs(judge.last.q[0] - swing(k)[0]) < 1e-4
    believed, *_ = judge.believe(*answer(300))
    assert believed[0]


@given(angle=st.floats(0.2, 12.0), sign=st.sampled_from([-1.0, 1.0]))
def test_a_position_that_the_motors_own_control_follows_is_named_at_once(angle, sign):
    """Its torque has gone to the peak, so that a second answer would come too late."""
    judge = started_filter()
    for k in range(1, 11):
        judge.believe(*answer(k))
    q = swing(11)[0] + sign * angle
    command = answer(11)[3]
    driven = command.motor_torque(np.array([q]), np.array([swing(11)[1]]))[0]
    tau = float(np.clip(driven, -PEAK, PEAK))
    believed, _, jump = judge.believe(*answer(11, q=q, tau=tau))
    assert not believed[0] and judge.is_misled[0]
    assert abs(jump[0] - sign * angle) < 0.01


JOINTS = damiao_joints(["DM4340", "DM4310"], 2)
SCALING = Scaling([joint.spec.limits for joint in JOINTS])
BOTH = np.array([True, True])
LOWER = np.array([-0.5, -1.0])
UPPER = np.array([0.7, 1.0])
SPEED = np.array([1.0, 2.0])
ANY = st.floats(allow_nan=True, allow_infinity=True)
NUMBERS = st.floats(-30.0, 30.0) | ANY
PAIRS = st.tuples(NUMBERS, NUMBERS)


# Anything at all, or a frame that at least names its sender and says that it is enabled.
PAYLOADS = (
    st.binary(min_size=8, max_size=8)
    | st.builds(
        lambda j, tail: bytes([0x10 | j]) + tail,
        st.integers(1, 2),
        st.binary(min_size=7, max_size=7),
    )
    | st.none()
)
REQUESTS = st.lists(
    st.tuples(PAIRS, PAIRS, PAIRS, st.booleans(), st.floats(0.0, 0.05)),
    min_size=1,
    max_size=25,
)


@given(requests=REQUESTS, answers=st.lists(PAYLOADS, max_size=60))
def test_no_history_makes_a_command_leave_its_bounds(requests, answers):
    bus = MotorBus(JOINTS)
    session = bus.open_session(Limits(LOWER, UPPER, SPEED))
    start = session.enable()
    waiting = list(answers)
    for motor in bus.motors:
        motor.next_answers = waiting
    clock = bus.clock
    last = start.copy()
    enabled_at = clock.now()
    sent_at = np.full(2, clock.now())
    lower = np.minimum(LOWER, start)
    upper = np.maximum(UPPER, start)
    position_step, velocity_step, torque_step = session.steps
    for position, velocity, torque, braking, pause in requests:
        clock.sleep_until(clock.now() + pause)
        n_sent_before = len(bus.wire.sent)
        q = session.position_now
        gains = np.array([180.0, 60.0]), np.array([4.5, 1.5])
        requested = mit_command(position, velocity, *gains, torque)
        try:
            session.exchange(requested, clock.now() + 0.004, BOTH, braking)
        except SysidError:
            assert len(bus.wire.sent) == n_sent_before and not braking
            continue
        for frame in bus.wire.sent[n_sent_before:]:
            j = frame.id - 1
            moment = frame.time
            raw = np.frombuffer(frame.data, dtype=np.uint8)[None]
            one = Scaling([JOINTS[j].spec.limits])
            p, v, kp, _, t = (
                float(value[0]) for value in protocol.decode_mit(raw, one)
            )
            # A late cycle's share may be used by the next one, and no more than 20 ms of it.
            reach = SPEED[j] * (min(moment - sent_at[j], 0.2) + 0.02)
            total_reach = SPEED[j] * (moment - enabled_at + 0.02)
            assert abs(p - start[j]) <= total_reach + 2.0 * position_step[j] * len(
                requests
            )
            assert lower[j] - position_step[j] <= p <= upper[j] + position_step[j]
            assert abs(p - last[j]) <= reach + 2.0 * position_step[j]
            assert abs(v) <= SPEED[j] + 2.0 * velocity_step[j]
            asked_torque = abs(kp * (p - q[j]) + t)
            available = JOINTS[j].spec.peak_torque + 2.0 * torque_step[j]
            available += (kp + 0.13) * position_step[j] + 0.13 * abs(p - q[j])
            assert asked_torque <= available
            last[j] = p
            sent_at[j] = moment


LIMITS = Limits(LOWER, UPPER, SPEED, torque=np.array([27.0, 7.0]))
STEPS = (np.full(2, 1e-4),) * 3


LABELS = "first", "second"
# Where both joints were sent last, how long ago, and where they are.
STANDING = np.zeros(2), np.full(2, 0.01), np.zeros(2)


def command(position=0.0, velocity=0.0, torque=0.0, kp=100.0):
    """A command to both joints, out of bounds for the second one at most."""
    return mit_command([0.0, position], [0.0, velocity], kp, 1.0, [0.0, torque])


@pytest.mark.parametrize(
    ("requested", "message"),
    [
        (command(position=0.03), "would be sent to 0.030 rad"),
        (command(position=float("nan")), "would be sent to nan"),
        (command(velocity=2.1), "would be told 2.10 rad/s, limit 2.00"),
        (command(torque=7.2), "would be asked for 7.2 N·m and makes 7.0 at most"),
        (command(position=0.01, torque=6.5), "would be asked for 7.5 N·m"),
    ],
)
def test_what_is_asked_too_much_is_named(requested, message):
    allowed = confine(requested, LIMITS, *STANDING)
    with pytest.raises(HardwareAbort, match=f"^second {message}"):
        require_allowed(LABELS, requested, allowed, np.zeros(2), STEPS)
    again = confine(allowed, LIMITS, *STANDING)
    require_allowed(LABELS, allowed, again, np.zeros(2), STEPS)


def test_a_range_wider_than_frames_can_say_is_cut_to_what_they_can():
    """In a stop a command beyond the frames' scale would be an error, and nothing be sent."""
    bus = MotorBus(JOINTS)
    session = bus.open_session()
    session.enable()
    n_sent = len(bus.wire.sent)
    bus.clock.stall(0.1)
    far = mit_command(np.full(2, 90.0), 90.0)
    session.exchange(far, bus.clock.now() + 0.004, BOTH, braking=True)
    assert len(bus.wire.sent) == n_sent + 2
    np.testing.assert_array_equal(session.limits.upper, SCALING.limits[:, 0])
    np.testing.assert_array_equal(session.limits.velocity, SCALING.limits[:, 1])
