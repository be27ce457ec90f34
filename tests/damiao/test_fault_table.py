"""What goes wrong, what every motor does 0.1, 0.5 and 2 s later, and what is said.

One line per fault: states are the status codes of motors 1 and 2 (0 disabled, 1 enabled, D
watchdog expired); a controlled stop keeps them enabled while it brakes. Faults of single motors in
all phases are in test_plan.py.
"""

from __future__ import annotations

import errno
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from robot_sysid.damiao.bus import BusLink, LinkError
from robot_sysid.damiao.preflight import Permissions
from robot_sysid.damiao.protocol import frames
from robot_sysid.damiao.session import MotorSession
from robot_sysid.damiao.simulated import Fault
from robot_sysid.errors import SysidError
from tests.support.damiao_rig import GRAVITY, Rig, swing

AFTER = (0.1, 0.5, 2.0)
STOPPED = 3
BRAKES, DROPS, TRIPS = "11 00 00", "00 00 00", "DD DD DD"


def raising(error):
    def fail(*_):
        raise error

    return fail


def hung_up(rig):
    """The terminal is closed: printing fails from now on, and two signals come."""
    rig.console = raising(OSError(errno.EIO, "Input/output error"))
    rig.stop("stopped by SIGHUP")
    rig.clock.at(rig.clock.now() + 0.01, lambda: rig.stop("stopped by SIGHUP"))


def terminated(rig):
    """Nobody reads our output any more, and the system asks us to end."""
    rig.console = raising(BrokenPipeError(errno.EPIPE, "Broken pipe"))
    rig.stop("stopped by SIGTERM")


def disk_full(rig):
    rig.recorder_file.write = raising(OSError(errno.ENOSPC, "No space left on device"))


def driver_fails(kind, seconds):
    """The driver raises something of its own for a while."""

    def cause(rig):
        until, send, receive = rig.clock.now() + seconds, rig.bus.send, rig.bus.receive

        def failing(call):
            def wrapped(*arguments):
                rig.clock.sleep_until(rig.clock.now() + 1e-4)
                if rig.clock.now() < until:
                    raise kind
                return call(*arguments)

            return wrapped

        rig.bus.send, rig.bus.receive = failing(send), failing(receive)

    return cause


def fault(kind, joint, value=1.0):
    return lambda rig: Fault(kind, joint, value).apply(rig.motors[joint])


def slow_adapter(rig):
    rig.adapter.delay = iter(np.random.default_rng(0).uniform(5e-3, 16e-3, 10**5)).__next__


def motion(change=None):
    time, q, qd, tau = (x.copy() for x in swing(2, duration=1.0))
    if change:
        change(q, qd, tau)
    return time, q, qd, tau


def pushed(q, qd, tau):
    """Constant feed-forward torque just below what the motor can do, on a joint that stands."""
    q[:, 0] = qd[:, 0] = 0.0
    tau[:, 0] = 26.9


def drifting(q, qd, tau):
    q[:, 0], qd[:, 0] = 0.0, 9.0
    qd[[0, -1], 0] = 0.0


def flipped(q, qd, tau):
    qd[:, 1] *= -1.0


def jumping(q, qd, tau):
    q[125:, 0] += 0.15


def lifted(q, qd, tau):
    """The whole motion where gravity pulls."""
    tau += GRAVITY * (np.sin(q + 0.8) - np.sin(q))
    q += 0.8


@dataclass(frozen=True)
class Line:
    """A line of the table; before a run, the cause is what changes the trajectory."""

    fault: str
    cause: Callable[..., None] | None
    states: str
    said: str
    code: int = STOPPED
    options: dict[str, Any] | None = None
    complete: bool = True


KEPT = {"watchdog": 0.0, "allowed": Permissions(watchdog=0.1)}
TABLE = (
    Line("terminal closed", hung_up, BRAKES, "stopped by SIGHUP"),
    Line("output closed, SIGTERM", terminated, BRAKES, "stopped by SIGTERM"),
    Line("disk full", disk_full, BRAKES, "cannot record: No space left on device", complete=False),
    Line("driver raises, 20 ms", driver_fails(RuntimeError("usb"), 0.02), BRAKES, "usb"),
    Line("driver raises, for good", driver_fails(KeyError("x"), 1e9), TRIPS, "Cut their power"),
    Line("adapter unplugged", driver_fails(LinkError("gone"), 1e9), TRIPS, "gone; no confirmation"),
    Line("motor dies", fault("silent", 1), "1D 0D 0D", "motor 2. Cut their power"),
    Line("answers lost", fault("lost-replies", 1), "11 00 00", "motor 2. Cut their power"),
    Line("over-current", fault("status", 1, 0xA), "1A 0A 0A", "motor 2 reports status A"),
    Line("watchdog set for the run", fault("silent", 1), "1D 0D 0D", "motor 2. Cut", options=KEPT),
    Line("blocked joint", fault("jammed", 0), BRAKES, "off its speed, limit 1.0"),
    Line("encoder slips 0.15 rad", fault("slip", 1, 0.15), BRAKES, "motor 2 jumped by 0.15"),
    Line("adapter turns slow", slow_adapter, BRAKES, "did not answer in time for", complete=False),
)  # fmt: skip
LIFTED = {"faults": [Fault("torque-factor", 1, 5 / 3)], "start": [0.8, 0.8]}
COLUMN = "but the positions change by"
REFUSED = (
    Line("feed-forward runs away", pushed, "", "motor 1 is"),
    Line("9 rad/s, standing", drifting, "", f"line 5: velocity 9 rad/s of motor 1, {COLUMN} 0 "),
    Line("velocity's sign", flipped, "", f"of motor 2, {COLUMN}"),
    Line("0.15 rad jump", jumping, "", f"of motor 1, {COLUMN}"),
    Line("slow adapter", None, "", "use --rate 50", options={"adapter": lambda: 0.016}),
    Line("reports 1.67 times the torque", lifted, "", "motor 2 reports 1.67 times", options=LIFTED),
    Line("kd of zero", None, "", "--kd must be at least", 2, {"kp": (100.0,), "kd": (5e-4,)}),
    Line("watchdog of 100 s", None, "", "of 100 s is none", options={"watchdog": 100.0}),
)


def states(rig):
    rig.arm.advance(rig.clock.now())
    return "".join(f"{motor.status:X}" for motor in rig.motors)


# Those that take another way through the code than all others run with every change.
QUICK = ("terminal closed", "disk full", "driver raises, for good", "motor dies")


def lines(table):
    for line in table:
        slow = () if line.fault in QUICK else pytest.mark.slow
        yield pytest.param(line, id=line.fault, marks=slow)


@pytest.mark.parametrize("line", list(lines(TABLE)))
def test_while_it_plays(tmp_path, line, monkeypatch):
    from robot_sysid.damiao import recorder

    rig = Rig(tmp_path, 2, **{"motion": swing(2, duration=1.0), **(line.options or {})})
    began, seen = [], []
    made = recorder.MeasurementRecorder.__init__

    def keep(self, *arguments):
        made(self, *arguments)
        rig.recorder_file = Handle(self._file)
        self._file = rig.recorder_file

    monkeypatch.setattr(recorder.MeasurementRecorder, "__init__", keep)

    def cause(rig):
        began.append(rig.clock.now())
        for later in AFTER:
            rig.clock.at(rig.clock.now() + later, lambda: seen.append(states(rig)))
        line.cause(rig)

    rig.during("playing", 0.3, cause).run(settle=0.0)
    rig.clock.sleep_until(began[0] + AFTER[-1])
    assert line.said in str(rig.error) and "\n" not in str(rig.error), rig.error
    assert rig.error.exit_code == line.code
    assert " ".join(seen) == line.states
    if line.complete:
        rig.assert_nothing_lost()
    if line.options is KEPT:
        # The one that was seen to be off has its old value back, the other one keeps its watchdog.
        assert [m.registers[frames.TIMEOUT] for m in rig.motors] == [0.0, 2000.0]


class Handle:
    """A file whose methods can be replaced."""

    def __init__(self, file):
        self.write, self.flush, self.close = file.write, file.flush, file.close


@pytest.mark.parametrize("line", REFUSED, ids=lambda line: line.fault)
def test_before_it_plays(tmp_path, line):
    """Nothing is played; what cannot be known before is stopped within the first centiseconds."""
    try:
        rig = Rig(tmp_path, 2, **{"motion": motion(line.cause), **(line.options or {})})
        error = rig.run().error
        assert not any(sentence.startswith("playing") for sentence in rig.phases)
        assert states(rig) == "00"
        assert np.max(np.abs(rig.arm.mechanism.qd)) < 1.0
    except SysidError as raised:
        error = raised
    assert line.said in str(error), error
    assert error.exit_code == line.code


def test_a_full_queue_is_tried_again_within_the_cycle(tmp_path):
    """One "no buffer space" costs nothing; a bus that stays full is said to lack power."""
    import can

    rig = Rig(tmp_path, 1)
    calls = []

    class Queue:
        def __init__(self, full):
            self.full = full

        def send(self, message, timeout):
            calls.append(rig.clock.now())
            if len(calls) <= self.full:
                raise can.CanOperationError("Failed to transmit", errno.ENOBUFS)

    from robot_sysid.damiao.protocol.frames import Frame

    BusLink([Queue(1)], rig.clock).send(Frame(1, bytes(8)))
    assert len(calls) == 2 and calls[1] - calls[0] < 1e-3
    with pytest.raises(LinkError, match="check the motors' power, the wiring and the termination"):
        BusLink([Queue(10**9)], rig.clock).send(Frame(1, bytes(8)))
    assert calls[-1] - calls[0] < 4e-3


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_what_a_slow_adapter_delivers_is_never_paired_with_another_command(tmp_path, seed):
    """Answers begin to come 5 to 16 ms late: each one that is believed answers the last command."""
    rig = Rig(tmp_path, 1, max_missed=50, max_speed_error=9.0, max_tracking_error=9.0)
    motor, commands, answered = rig.motors[0], [], []
    answer = motor._command_answer

    def numbered(data, time):
        """Let the winding's temperature say how many commands the motor has had."""
        commands.append(data)
        motor.temperature_rotor = len(commands) % 60
        return answer(data, time)

    motor._command_answer = numbered
    exchange = MotorSession.exchange

    def watched(self, *arguments, **options):
        replies = exchange(self, *arguments, **options)
        if replies.answered[0] and not options:
            answered.append((replies.feedback.temperature_rotor[0], len(commands) % 60))
        return replies

    def slow(rig):
        delays = np.random.default_rng(seed).uniform(5e-3, 16e-3, 10**5)
        rig.adapter.delay = iter(delays).__next__

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MotorSession, "exchange", watched)
        rig.during("playing", 0.3, slow).run()
    assert len(answered) > 200
    assert [got for got, _ in answered] == [told for _, told in answered]
