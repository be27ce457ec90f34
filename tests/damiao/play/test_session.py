"""Registers, inspection and the session, below the level of a whole run."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.damiao.bus.clock import SimulatedClock
from robot_sysid.damiao.bus.inspection import inspect_bus
from robot_sysid.damiao.bus.link import GuardedLink
from robot_sysid.damiao.bus.register_client import RegisterClient
from robot_sysid.damiao.play.session import MotorSession
from robot_sysid.damiao.protocol import registers as reg
from robot_sysid.damiao.protocol.codec import MitCommand, Scaling
from robot_sysid.damiao.protocol.frames import (
    CLEAR_ERROR,
    DISABLE,
    ENABLE,
    REGISTER_ID,
    SET_ZERO,
    STORE,
    Frame,
    disable_frame,
    enable_frame,
    read_frame,
    refresh_frame,
    refuse_harmful,
    write_frame,
)
from robot_sysid.damiao.protocol.joints import damiao_joints
from robot_sysid.damiao.protocol.motors import MOTORS
from robot_sysid.damiao.protocol.registers import (
    DISABLED,
    ENABLED,
    LOST_COMMUNICATION,
    describe,
    is_fault,
)
from robot_sysid.damiao.simulated.arm import SimulatedArm
from robot_sysid.damiao.simulated.motor import simulated_motor
from robot_sysid.damiao.simulated.simulated_link import SimulatedLink
from robot_sysid.errors import HardwareAbort, SysidError
from tests.support.damiao_rig import Pendulums

SPEC = MOTORS["DM4340"]


class Bench:
    """Two motors on a simulated bus, and one program that talks to them."""

    def __init__(self, n=2, echo=False):
        self.motors = [simulated_motor(SPEC, i + 1, i + 17) for i in range(n)]
        self.clock = SimulatedClock()
        self.arm = SimulatedArm(Pendulums(n), self.motors)
        self.bus = SimulatedLink(self.clock, self.arm, echo=echo)
        self.link = GuardedLink(self.bus, self.clock.now)
        self.client = RegisterClient(self.link, self.clock)
        self.session = MotorSession(
            self.link,
            self.clock,
            damiao_joints(["DM4340"] * n, n),
            Scaling.from_limits([SPEC.limits] * n),
        )

    def command(self, q=0.0, kp=20.0):
        n = len(self.motors)
        full = np.full(n, 1.0)
        return MitCommand(q * full, 0 * full, kp * full, full, 0 * full)


# --- registers ----------------------------------------------------------------------------------


@pytest.mark.parametrize("number", sorted(reg.REGISTERS))
@given(data=st.data())
def test_register_values_survive_their_four_bytes(number, data):
    integer = reg.REGISTERS[number].integer
    values = st.integers(0, 2**32 - 1) if integer else st.floats(width=32, allow_nan=False)
    value = data.draw(values)
    assert reg.value_from_bytes(number, reg.bytes_from_value(number, value)) == value


def test_registers_are_read_and_written():
    bench = Bench()
    assert bench.client.read(2, reg.PMAX) == (12.5, 18)
    bench.client.write(2, reg.TIMEOUT, 4000.0)
    assert bench.motors[1].registers[reg.TIMEOUT] == 4000.0


@pytest.mark.parametrize("opcode", [0x33, 0x55])
def test_a_write_may_be_echoed_with_either_opcode(opcode):
    bench = Bench()
    bench.motors[0].write_echo = opcode
    bench.client.write(1, reg.TIMEOUT, 4000.0)
    assert bench.motors[0].registers[reg.TIMEOUT] == 4000.0


def test_a_refused_write_is_noticed():
    bench = Bench()
    with pytest.raises(HardwareAbort, match="motor 1 refused OC_Value = 0.5 and keeps 0.8"):
        bench.client.write(1, 3, 0.5)


def test_a_motor_that_is_not_there_does_not_answer():
    bench = Bench()
    assert bench.client.read(9, reg.PMAX) is None
    with pytest.raises(HardwareAbort, match="motor 9 did not answer to writing TIMEOUT"):
        bench.client.write(9, reg.TIMEOUT, 1.0)


def test_feedback_is_not_taken_for_a_register_reply():
    """A joint at -11.9 rad sends bytes that look like the header of some register's reply."""
    bench = Bench()
    ours = bench.arm.handle

    def with_feedback_first(frame, time):
        lookalike = Frame(17, bytes([0x01, 0x00, 0x33, 0x07, 0x80, 0x00, 30, 30]))
        return [lookalike, *ours(frame, time)]

    bench.arm.handle = with_feedback_first
    assert bench.client.read(1, reg.PMAX).value == 12.5


# --- what is never sent ---------------------------------------------------------------------------


@pytest.mark.parametrize("code", [SET_ZERO, CLEAR_ERROR, 0x00, 0xFF])
def test_harmful_special_frames_are_refused(code):
    with pytest.raises(SysidError, match="refused to send"):
        refuse_harmful(Frame(1, b"\xff" * 7 + bytes([code])))


@pytest.mark.parametrize("operation", [STORE, 0x00, 0xFF])
def test_harmful_register_operations_are_refused(operation):
    with pytest.raises(SysidError, match="refused to send"):
        refuse_harmful(Frame(REGISTER_ID, bytes([1, 0, operation, 1, 0, 0, 0, 0])))


def test_what_is_needed_is_not_refused():
    frames = [enable_frame(1), disable_frame(1), read_frame(1, 7), refresh_frame(1)]
    for frame in [*frames, write_frame(1, 9, bytes(4)), Frame(1, bytes(8))]:
        refuse_harmful(frame)
    assert enable_frame(1).data[7] == ENABLE and disable_frame(1).data[7] == DISABLE


def test_a_refused_frame_does_not_reach_the_bus():
    bench = Bench()
    with pytest.raises(SysidError):
        bench.link.send(Frame(1, b"\xff" * 7 + bytes([SET_ZERO])))
    assert bench.bus.sent == []


# --- inspection -----------------------------------------------------------------------------------


def test_inspection_reads_everything_and_changes_nothing():
    bench = Bench()
    before = [dict(m.registers) for m in bench.motors]
    found = inspect_bus(bench.link, bench.clock)
    assert sorted(found.motors) == [1, 2]
    assert set(found.motors[1].registers) == set(reg.LOGGED)
    assert found.motors[2].limits == (12.5, 10.0, 28.0)
    assert found.motors[2].feedback.temperature_mos[0] == 31
    assert [m.registers for m in bench.motors] == before
    assert [m.status for m in bench.motors] == [DISABLED] * 2
    assert {frame.id for frame in bench.bus.sent} == {REGISTER_ID}


def test_inspection_does_not_disturb_a_motor_that_somebody_uses():
    bench = Bench()
    bench.motors[0].status = ENABLED
    bench.motors[0].registers[reg.TIMEOUT] = 0.0
    inspect_bus(bench.link, bench.clock)
    assert bench.motors[0].status == ENABLED


# --- session --------------------------------------------------------------------------------------


def test_leaving_without_having_enabled_sends_nothing():
    bench = Bench()
    with bench.session:
        pass
    assert bench.bus.sent == []


@pytest.mark.parametrize("error", [None, RuntimeError("x"), KeyboardInterrupt(), SystemExit(1)])
def test_every_way_out_disables(error):
    bench = Bench()
    try:
        with bench.session as session:
            session.enable()
            assert [m.status for m in bench.motors] == [ENABLED] * 2
            session.exchange(bench.command(), bench.clock.now() + 0.004)
            if error:
                raise error
    except BaseException as raised:
        assert raised is error
    assert [m.status for m in bench.motors] == [DISABLED] * 2


def test_a_reply_is_the_state_before_the_command_acted():
    bench = Bench()
    with bench.session as session:
        session.enable()
        first = session.exchange(bench.command(0.5, kp=100.0), bench.clock.now() + 0.004)
        bench.clock.sleep_until(bench.clock.now() + 0.004)
        second = session.exchange(bench.command(0.5, kp=100.0), bench.clock.now() + 0.004)
    half = 0.5 * 28.0 * 2 / 4095
    assert np.all(np.abs(first.feedback.torque) <= half * 1.01)
    assert np.all(second.feedback.torque > 10.0)


def test_joints_that_were_not_asked_do_not_answer():
    bench = Bench(3)
    with bench.session as session:
        session.enable()
        only = np.array([True, False, True])
        replies = session.exchange(bench.command(), bench.clock.now() + 0.004, only)
    assert replies.answered.tolist() == [True, False, True]
    assert np.isnan(replies.feedback.position[1]) and np.isnan(replies.time[1])
    assert replies.feedback.status[1] == -1


def test_stale_replies_are_not_taken_for_fresh_ones():
    bench = Bench()
    with bench.session as session:
        session.enable()
        late = session.exchange(bench.command(), bench.clock.now())
        assert not np.any(late.answered)
        bench.clock.sleep_until(bench.clock.now() + 0.02)
        start = bench.clock.now()
        fresh = session.exchange(bench.command(), start + 0.004)
    assert np.all(fresh.answered) and np.all(fresh.time > start)


@pytest.mark.parametrize("echo", [False, True])
def test_stamps_differ_from_joint_to_joint(echo):
    bench = Bench(3, echo)
    with bench.session as session:
        session.enable()
        start = bench.clock.now()
        replies = session.exchange(bench.command(), start + 0.004)
    frame = 135e-6
    first = frame if echo else 4 * frame
    np.testing.assert_allclose(replies.time - start, first + frame * np.arange(3), atol=1e-9)


def test_garbage_on_the_bus_is_ignored():
    bench = Bench()
    garbage = [Frame(17, b""), Frame(17, bytes([0x12]) + bytes(7)), Frame(99, bytes(8))]
    garbage.append(Frame(17, bytes(8), error=True))
    ours = bench.arm.handle
    bench.arm.handle = lambda frame, time: [*garbage, *ours(frame, time)]
    with bench.session as session:
        session.enable()
        replies = session.exchange(bench.command(), bench.clock.now() + 0.004)
    assert np.all(replies.answered)
    assert replies.feedback.status.tolist() == [ENABLED, ENABLED]


def test_a_watchdog_trip_needs_more_than_enabling():
    bench = Bench()
    bench.session.enable()
    bench.clock.sleep_until(bench.clock.now() + 0.2)
    bench.arm.advance(bench.clock.now())
    assert [m.status for m in bench.motors] == [LOST_COMMUNICATION] * 2
    with pytest.raises(HardwareAbort, match="motor 1 .* did not enable: status D"):
        bench.session.enable()


# --- status codes ---------------------------------------------------------------------------------


@pytest.mark.parametrize("code", range(16))
def test_every_code_has_words_and_all_but_two_are_faults(code):
    assert describe(code).startswith(f"status {code:X}: ")
    assert is_fault(code) is (code not in (0, 1))
