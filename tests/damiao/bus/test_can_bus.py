"""The same arm behind python-can: virtual bus, serial adapter on a pseudo-terminal, frame log."""

from __future__ import annotations

import os
import subprocess
import sys

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.damiao.bus.can_bus import INTERFACES, BusLink, open_bus
from robot_sysid.damiao.bus.can_log import RawFrameLog
from robot_sysid.damiao.bus.clock import SimulatedClock, SystemClock
from robot_sysid.damiao.bus.inspection import inspect_bus
from robot_sysid.damiao.bus.link import GuardedLink, LinkError
from robot_sysid.damiao.bus.slcan import SlcanTerminal, frame_from_line, line_from_frame
from robot_sysid.damiao.protocol.bus_load import BusTiming
from robot_sysid.damiao.protocol.frames import Frame
from robot_sysid.damiao.protocol.motors import MOTORS
from robot_sysid.damiao.simulated.arm import SimulatedArm
from robot_sysid.damiao.simulated.motor import simulated_motor
from robot_sysid.damiao.simulated.server import served_in_background
from robot_sysid.errors import InputError
from tests.support.damiao_rig import Pendulums

FRAMES = st.builds(
    lambda identifier, data, fd: Frame(identifier, data, fd=fd),
    st.integers(0, 0x7FF),
    st.binary(max_size=8),
    st.booleans(),
)


def two_motor_arm():
    motors = [simulated_motor(MOTORS["DM4340"], i, i + 16) for i in (1, 2)]
    return SimulatedArm(Pendulums(2), motors)


@given(FRAMES)
def test_frames_survive_the_serial_text(frame):
    assert frame_from_line(line_from_frame(frame)) == frame


@pytest.mark.parametrize(
    "line", ["", "O", "S8", "C", "t", "t12", "t0013", "t001zz", "t0019" + 18 * "0", "x"]
)
def test_lines_that_are_no_frames_give_none(line):
    assert frame_from_line(line) is None


@pytest.mark.parametrize("fd", [False, True])
def test_an_arm_on_the_virtual_bus_answers(fd):
    clock, timing = SystemClock(), BusTiming(fd=fd)
    near, far = (open_bus("virtual", f"test-{fd}", timing, clock) for _ in range(2))
    try:
        with served_in_background(two_motor_arm(), far, clock):
            found = inspect_bus(GuardedLink(near, clock.now, fd), clock, (1, 2, 3))
    finally:
        near.close()
    assert sorted(found.motors) == [1, 2]
    assert found.motors[1].limits == (12.5, 10.0, 28.0)


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo-terminals")
def test_an_arm_behind_a_serial_adapter_answers_pythons_slcan():
    pytest.importorskip("serial")
    clock = SystemClock()
    far = SlcanTerminal(clock)
    with served_in_background(two_motor_arm(), far, clock):
        bus = can.Bus(interface="slcan", channel=far.device, bitrate=1000000, sleep_after_open=0)
        near = BusLink(bus, clock)
        try:
            found = inspect_bus(GuardedLink(near, clock.now), clock, (1, 2, 3))
        finally:
            near.close()
    assert sorted(found.motors) == [1, 2]
    assert found.motors[2].feedback.temperature_rotor[0] == 29


def test_stamps_of_the_virtual_bus_are_in_our_clock_and_sent_frames_come_back():
    clock = SystemClock()
    near, far = (open_bus("virtual", "stamps", BusTiming(), clock) for _ in range(2))
    try:
        before = clock.now()
        near.send(Frame(0x123, b"abc"))
        echo, seen = (link.receive(clock.now() + 1.0) for link in (near, far))
        after = clock.now()
    finally:
        near.close()
        far.close()
    assert (echo.id, echo.data, echo.echo) == (0x123, b"abc", True)
    assert (seen.id, seen.data, seen.echo) == (0x123, b"abc", False)
    assert before - 1e-3 <= seen.time <= after + 1e-3


def test_receiving_ends_in_time():
    clock = SystemClock()
    link = open_bus("virtual", "silence", BusTiming(), clock)
    try:
        start = clock.now()
        assert link.receive(start + 0.02) is None
        assert clock.now() - start >= 0.02
        assert link.receive(start) is None
    finally:
        link.close()


def test_a_bus_that_breaks_raises_our_error():
    clock = SystemClock()
    link = open_bus("virtual", "broken", BusTiming(), clock)
    link.close()
    with pytest.raises(LinkError, match="does not take frames"):
        link.send(Frame(1, b""))
    with pytest.raises(LinkError, match="cannot be read"):
        link.receive(clock.now())


# Older releases of python-can trip over a bus they have only half built.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(
    ("interface", "channel", "words"),
    [
        ("telepathy", "x", "unknown --interface 'telepathy'; valid: socketcan, slcan"),
        ("udp_multicast", "239.0.0.1", "unknown --interface"),
        ("socketcan", "no-such-bus", "cannot open socketcan channel no-such-bus"),
        ("slcan", "/dev/no-such-tty", "cannot open slcan channel /dev/no-such-tty"),
    ],
)
def test_a_bus_that_cannot_be_opened_is_said(interface, channel, words):
    with pytest.raises(InputError, match=words):
        open_bus(interface, channel, BusTiming(), SystemClock())


def test_no_interface_reaches_a_network():
    assert not {"udp_multicast", "socketcand", "remote"} & set(INTERFACES)
    assert set(INTERFACES) <= set(can.VALID_INTERFACES)


@given(st.lists(st.tuples(FRAMES, st.booleans()), min_size=1, max_size=20))
def test_the_frame_log_is_lossless(tmp_path_factory, frames):
    path = tmp_path_factory.mktemp("raw") / "measured.log"
    clock = SimulatedClock()
    log = RawFrameLog(path, clock)
    for k, (frame, sent) in enumerate(frames):
        log(frame._replace(time=0.001 * k), sent)
    log.flush()
    with can.LogReader(path) as reader:
        messages = list(reader)
    log.close()
    assert len(messages) == len(frames)
    for message, (frame, sent) in zip(messages, frames):
        assert message.arbitration_id == frame.id and bytes(message.data) == frame.data
        assert message.is_fd == frame.fd and message.is_rx == (not sent)
    stamps = np.array([message.timestamp for message in messages])
    np.testing.assert_allclose(np.diff(stamps), 0.001, atol=2e-6)


def test_frames_are_logged_in_the_order_of_their_time(tmp_path):
    clock = SimulatedClock()
    log = RawFrameLog(tmp_path / "measured.log", clock)
    for stamp in (0.3, 0.1, 0.2):
        log(Frame(round(10 * stamp), b"", stamp), False)
    log.close()
    with can.LogReader(tmp_path / "measured.log") as reader:
        assert [message.arbitration_id for message in reader] == [1, 2, 3]


@pytest.mark.parametrize(
    ("name", "words"), [("x.unknown", "cannot log frames"), ("there.log", "exists")]
)
def test_a_frame_log_that_cannot_be_made_is_said(tmp_path, name, words):
    (tmp_path / "there.log").write_text("precious")
    with pytest.raises(InputError, match=words):
        RawFrameLog(tmp_path / name, SystemClock())


def test_everything_but_the_bus_works_without_python_can(tmp_path):
    """With python-can out of reach, all modules import, and opening a bus says what to install."""
    script = """
import pkgutil, sys
sys.modules["can"] = None
import robot_sysid.damiao
for module in pkgutil.iter_modules(robot_sysid.damiao.__path__):
    __import__("robot_sysid.damiao." + module.name)
from robot_sysid.damiao_cli import main
sys.exit(main(["check", "--channel", "can0"]))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.strip().endswith('pip install "robot-sysid[can]"')
    assert len(done.stderr.strip().splitlines()) == 1
