"""No command leaves its bounds, whatever motors answer and whatever is asked for."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.damiao import protocol
from robot_sysid.damiao.bus import GuardedLink
from robot_sysid.damiao.joints import damiao_joints
from robot_sysid.damiao.protocol import (
    REGISTER_ID,
    Frame,
    MitCommand,
    Scaling,
    is_special,
)
from robot_sysid.damiao.safety.guards import (
    BeyondBounds,
    CommandBounds,
    CommandRange,
    Overload,
)
from robot_sysid.damiao.session import MotorSession
from robot_sysid.errors import SysidError
from tests.support.clocks import ScriptedClock

JOINTS = damiao_joints(["DM4340", "DM4310"], 2)
SCALING = Scaling([joint.spec.limits for joint in JOINTS])
LOWER = np.array([-0.5, -1.0])
UPPER = np.array([0.7, 1.0])
SPEED = np.array([1.0, 2.0])
ANY = st.floats(allow_nan=True, allow_infinity=True)
NUMBERS = st.floats(-30.0, 30.0) | ANY
PAIRS = st.tuples(NUMBERS, NUMBERS)


class AbsurdLink:
    """Motors that answer each frame with what they are given, right for enabling at first."""

    def __init__(self, clock, answers):
        self.clock = clock
        self.answers = answers
        self.sent = []
        self._waiting = []

    def send(self, frame):
        self.sent.append((self.clock.now(), frame))
        j = (frame.data[0] if frame.id == REGISTER_ID else frame.id) - 1
        if len(self.sent) <= 4 or is_special(frame.data) or not self.answers:
            status = 1 if frame.data[7:] == b"\xfc" else 0
            payload = bytes(
                [status << 4 | (j + 1), 0x80, 0x00, 0x80, 0x08, 0x00, 30, 30]
            )
        else:
            payload = self.answers.pop(0)
        if payload is not None:
            self._waiting.append(Frame(0x11 + j, payload, self.clock.now()))

    def receive(self, until):
        if self._waiting:
            return self._waiting.pop(0)
        self.clock.sleep_until(until)
        return None

    def close(self):
        pass


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
    clock = ScriptedClock()
    link = AbsurdLink(clock, list(answers))
    session = MotorSession(
        GuardedLink(link, clock), JOINTS, SCALING, CommandRange(LOWER, UPPER, SPEED)
    )
    start = session.enable()
    last = start.copy()
    enabled_at = clock.now()
    sent_at = np.full(2, clock.now())
    lower = np.minimum(LOWER, start)
    upper = np.maximum(UPPER, start)
    position_step, velocity_step, torque_step = session.steps
    for position, velocity, torque, braking, pause in requests:
        clock.sleep_until(clock.now() + pause)
        n_sent_before = len(link.sent)
        believed, _ = session.believed_motion
        requested = MitCommand(
            np.array(position), np.array(velocity), np.array([180.0, 60.0]),
            np.array([4.5, 1.5]), np.array(torque),
        )  # fmt: skip
        try:
            session.exchange(requested, clock.now() + 0.004, braking=braking)
        except SysidError:
            assert len(link.sent) == n_sent_before and not braking
            continue
        for moment, frame in link.sent[n_sent_before:]:
            j = frame.id - 1
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
            asked_torque = abs(kp * (p - believed[j]) + t)
            available = JOINTS[j].spec.peak_torque + 2.0 * torque_step[j]
            available += (kp + 0.13) * position_step[j] + 0.13 * abs(p - believed[j])
            assert asked_torque <= available
            last[j] = p
            sent_at[j] = moment


BOUNDS = CommandBounds(
    CommandRange(LOWER, UPPER, SPEED),
    np.array([27.0, 7.0]),
    *(np.full(2, 1e-4) for _ in range(3)),
)


LABELS = "first", "second"
# Where both joints were sent last, how long ago, and where they are.
STANDING = np.zeros(2), np.full(2, 0.01), np.zeros(2)


def command(position=0.0, velocity=0.0, torque=0.0, kp=100.0):
    """A command to both joints, out of bounds for the second one at most."""
    fields = (np.array([0.0, value]) for value in (position, velocity, kp, 1.0, torque))
    return MitCommand(*fields)


@pytest.mark.parametrize(
    ("requested", "error_type", "message"),
    [
        (command(position=0.03), BeyondBounds, "would be sent to 0.030 rad"),
        (command(position=float("nan")), BeyondBounds, "would be sent to nan"),
        (command(velocity=2.1), BeyondBounds, "would be told 2.10 rad/s, limit 2.00"),
        (
            command(torque=7.2),
            Overload,
            "would be asked for 7.2 N m and makes 7.0 at most",
        ),
        (command(position=0.01, torque=6.5), Overload, "would be asked for 7.5 N m"),
    ],
)
def test_what_is_asked_too_much_is_named(requested, error_type, message):
    with pytest.raises(BeyondBounds, match=f"^second {message}") as error:
        BOUNDS.require(LABELS, requested, *STANDING)
    assert error.type is error_type
    BOUNDS.require(LABELS, BOUNDS.confine(requested, *STANDING), *STANDING)


def test_what_is_within_the_bounds_is_left_as_it_is():
    requested = command(position=0.019, velocity=1.9, torque=5.0)
    BOUNDS.require(LABELS, requested, *STANDING)
    np.testing.assert_allclose(
        BOUNDS.confine(requested, *STANDING), requested, atol=1e-12
    )


def test_a_range_wider_than_frames_can_say_is_cut_to_what_they_can():
    """In a stop a command beyond the frames' scale would be an error, and nothing be sent."""
    clock = ScriptedClock()
    link = AbsurdLink(clock, [])
    wide = CommandRange(np.full(2, -99.0), np.full(2, 99.0), np.full(2, 5e3))
    session = MotorSession(GuardedLink(link, clock), JOINTS, SCALING, wide)
    session.enable()
    n_sent = len(link.sent)
    clock.sleep_until(clock.now() + 0.1)
    far = MitCommand(
        np.full(2, 90.0), np.full(2, 90.0), np.zeros(2), np.ones(2), np.zeros(2)
    )
    session.exchange(far, clock.now() + 0.004, braking=True)
    assert len(link.sent) == n_sent + 2
    np.testing.assert_array_equal(session.command_range.upper, SCALING.limits[:, 0])
    np.testing.assert_array_equal(session.command_range.speed, SCALING.limits[:, 1])


def test_where_an_arm_stands_is_within_its_range():
    wider = BOUNDS.including(np.array([-0.6, np.nan]))
    np.testing.assert_array_equal(wider.command_range.lower, [-0.6, -1.0])
    np.testing.assert_array_equal(wider.command_range.upper, UPPER)
