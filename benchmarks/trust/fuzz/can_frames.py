"""Frames of a CAN bus: random ones, nearly right answers, damaged lines of serial adapters."""

from __future__ import annotations

import functools
from collections import deque
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any

import numpy as np

from benchmarks.trust.fuzz.harness import Case
from robot_sysid.damiao.adapters import PACKET, BusLink, SerialAdapter, SerialReader
from robot_sysid.damiao.bus import GuardedLink, SimulatedClock, inspect_bus
from robot_sysid.damiao.joints import damiao_joints
from robot_sysid.damiao.protocol import (
    DISABLE,
    ENABLE,
    REFRESH,
    REGISTER_ID,
    CanFrame,
    MitCommand,
    Scaling,
    decode_feedback,
    decode_mit,
    encode_mit,
    is_special,
)
from robot_sysid.damiao.session import MotorSession
from robot_sysid.errors import SysidError
from robot_sysid.records import Limits

N = 2
_LONGEST = 200
_FLAGS = ("fd", "echo")


def case(random: Random) -> Case:
    """Return frames of 13 bytes each (id, flags, length, data), mostly like those of motors."""
    count = random.randint(1, 40)
    return {
        "frames": b"".join(_frame(random) for _ in range(count)),
        "line": _line(random),
    }


def _frame(random: Random) -> bytes:
    """Return one frame of 13 bytes."""
    data = bytearray(
        random.choice(
            (bytes(8), b"\xff" * 8, random.getrandbits(64).to_bytes(8, "big"))
        )
    )
    data[0] = random.choice((0x11, 0x12, 1, 2, data[0]))
    if random.random() < 0.5:
        data[1:4] = bytes((0, 0x33, random.choice((7, 8, 9, 10, 21, 22, 23, 255))))
    identifier = random.choice((0x11, 0x12, 1, 2, REGISTER_ID, random.getrandbits(11)))
    flags = random.choice((0, 0, 0, 0, random.getrandbits(8)))
    length = random.choice((8, 8, 8, 0, 4))
    return identifier.to_bytes(2, "big") + bytes((flags, 0, length)) + bytes(data)


def _line(random: Random) -> bytes:
    """Return bytes that an adapter may send over its serial line."""
    frame = b"\xaa\x11" + bytes(13) + b"\x55"
    pieces = bytearray(frame * random.randint(1, 6))
    for _ in range(random.randint(0, 8)):
        pieces[random.randrange(len(pieces))] = random.getrandbits(8)
    return bytes(pieces[random.randint(0, 20) :])


def frames_in(data: bytes) -> list[CanFrame]:
    """Return the frames of an input."""
    pieces = [data[k : k + 13] for k in range(0, len(data) - 12, 13)]
    return [
        CanFrame(
            int.from_bytes(piece[:2], "big") & 0x7FF,
            piece[5 : 5 + min(piece[4], 8)],
            **{name: bool(piece[2] & 1 << k) for k, name in enumerate(_FLAGS)},
        )
        for piece in pieces
    ]


class TalkativeBus:
    """A bus whose motors answer some commands, with other frames in between."""

    error_frames = 0

    def __init__(self, frames: list[CanFrame], clock: SimulatedClock) -> None:
        self._frames = deque(frames)
        self._clock = clock
        self._waiting = deque[CanFrame]()
        self._left = _LONGEST

    def send(self, frame: CanFrame) -> None:
        """Answer with the payload of the next frames."""
        self._frames.rotate(-1)
        reply = self._frames[0]
        if reply.id % 4 != 2:
            self._waiting.append(_answer(frame, reply.data.ljust(8, b"\0")))
        if reply.id % 2:
            self._waiting.append(reply)

    def receive(self, until: float) -> Any:
        """Return the next waiting frame, or None after the time is over."""
        if not self._waiting or not self._left:
            self._clock.sleep_until(until)
            return None
        self._left -= 1
        return self._waiting.popleft()._replace(time=self._clock.now())

    def close(self) -> None:
        pass


AT_REST = bytes([0x80, 0x00, 0x80, 0x08, 0x00, 30, 30])


def _answer(frame: CanFrame, payload: bytes) -> CanFrame:
    """Return what a motor would answer, its figures being those of other bytes."""
    if frame.id == REGISTER_ID and frame.data[2] == REFRESH:
        # Where an arm stands is believed when two answers agree.
        return CanFrame(frame.data[0] + 16, bytes([frame.data[0] & 0xF]) + AT_REST)
    if frame.data[7:] == bytes([ENABLE]):
        return CanFrame(frame.id + 16, bytes([0x10 | frame.id & 0xF]) + AT_REST)
    if frame.id == REGISTER_ID:
        motor = frame.data[0]
        return CanFrame(motor + 16, frame.data[:4] + payload[4:])
    status = (
        {ENABLE: 1, DISABLE: 0}.get(frame.data[7], 1) if is_special(frame.data) else 1
    )
    return CanFrame(frame.id + 16, bytes([status << 4 | frame.id & 0xF]) + payload[1:])


@functools.cache
def _joints() -> Any:
    """Return the joints of N motors."""
    return damiao_joints(["DM4340"] * N, N)


def use(case: Case, folder: Path) -> None:
    """Unpack everything, ask the bus for motors, run motors on it, read the serial line."""
    frames = frames_in(case["frames"])
    _codec(frames)
    _line_read(case["line"])
    _through_driver(frames)
    clock = SimulatedClock()
    link = GuardedLink(TalkativeBus(frames, clock), clock)
    if len(frames) % 20 == 0:  # takes ten times as long as all the rest
        for motor in inspect_bus(link).motors.values():
            assert motor.name and motor.master_id >= 0
    _session(frames)


def _codec(frames: list[CanFrame]) -> None:
    """Decode and encode frames as feedback and commands."""
    raw = np.array(
        [list(f.data) for f in frames if len(f.data) == 8], np.uint8
    ).reshape(-1, 1, 8)
    numbers = raw.view("<f4").ravel()
    limits = [tuple(np.resize(numbers, 3))] if numbers.size else [(1.0, 1.0, 1.0)]
    for ranges in ([(12.5, 10.0, 28.0)], limits):
        try:
            scaling = Scaling(ranges)
            assert np.all(np.isfinite(decode_feedback(raw, scaling).position))
            encode_mit(decode_mit(raw, scaling), scaling)
        except SysidError:
            continue


def _line_read(line: bytes) -> None:
    """Read bytes of the maker's serial adapter, seven at a time."""
    pieces = [line[k : k + 7] for k in range(0, len(line), 7)]
    port = SimpleNamespace(in_waiting=0)
    port.read = lambda size: pieces.pop(0) if pieces else b""
    adapter = SerialAdapter.__new__(SerialAdapter)
    adapter._read = SerialReader(port, PACKET)
    while pieces:
        message = adapter.recv(0.0)
        assert message is None or len(message.data) == 8


def _through_driver(frames: list[CanFrame]) -> None:
    """Pass python-can's messages through the bus; its driver raises any error."""
    clock = SimulatedClock()
    waiting = deque(frames)

    def recv(timeout: float) -> Any:
        """Return the next message, or raise as a driver does."""
        clock.sleep_until(clock.now() + 1e-3)
        frame = waiting.popleft()
        if frame.id % 8 == 3:
            raise (ValueError, IndexError, OSError)[frame.id % 3]("broken")
        return SimpleNamespace(
            arbitration_id=frame.id,
            data=bytearray(frame.data),
            timestamp=float(frame.id) - 1.0,
            is_extended_id=frame.id % 8 == 1,
            is_error_frame=frame.id % 16 == 5,
            is_rx=not frame.echo,
            is_fd=frame.fd,
        )

    link = BusLink(SimpleNamespace(recv=recv, shutdown=lambda: 1 / 0), clock)
    while waiting:
        try:
            link.receive(clock.now() + 1.0)
        except SysidError:
            continue
        except IndexError:
            assert not waiting
    link.close()


def _session(frames: list[CanFrame]) -> None:
    """Run motors on a bus whose answers are these frames."""
    clock = SimulatedClock()
    link = GuardedLink(TalkativeBus(frames, clock), clock)
    scaling = Scaling([(12.5, 10.0, 28.0)] * N)
    zeros = np.zeros(N)
    far = np.full(N, 99.0)
    anywhere = Limits(-far, far, far)
    with MotorSession(link, _joints(), scaling, anywhere) as session:
        session.enable()
        for _ in range(3):
            command = MitCommand(zeros, zeros, zeros + 10.0, zeros + 1.0, zeros)
            every = np.ones(N, dtype=bool)
            replies = session.exchange(command, clock.now() + 1e-3, every, False)
            position = replies.feedback.position[replies.answered]
            assert np.all(np.abs(position) < 12.6) and not np.any(np.isnan(position))
