"""Short runs of two pendulums on simulated motors that something stops, and their motors after it.

States are the status codes of motors 1 and 2 (0 disabled, 1 enabled, D watchdog expired); a
controlled stop keeps them enabled while it brakes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from robot_sysid.damiao.protocol import ENABLE, is_special

AFTER = (0.1, 0.5, 2.5)
"""When the motors' states are looked at, after the fault has begun [s]."""
BRAKES = "11 00 00"
DROPS = "00 00 00"
TRIPS = "DD DD DD"
SLOWLY = "11 11 00"
"""Motors are held until they have come to rest."""


@dataclass(frozen=True)
class PendulumCase:
    """A fault that stops a run of pendulums.

    Attributes:
        cause: begins the fault in a rig.
        states: of the motors at the times ``AFTER``.
        words: of the error.
        options: of the rig.
        phase: in which the fault begins.
        begins: how long after the phase's beginning [s].
        is_recorded: whether every answer that came is in the recording; by its nature a full disk
            or a slow adapter leaves some out.
        name: of the incident.
    """

    cause: Callable[[Any], object]
    states: str
    words: str
    options: dict[str, Any] = field(default_factory=dict)
    phase: str = "playing"
    begins: float = 0.15
    is_recorded: bool = True
    name: str = ""


def states_of(rig):
    """Return the status codes of all motors now, a character each."""
    rig.arm.advance(rig.clock.now())
    return "".join(f"{motor.status:X}" for motor in rig.motors)


def check_stop(rig, case):
    """Play a case on a rig; AssertionError where it does not stop as the case says."""
    began = []
    registers = []

    def cause(run):
        began.append(run.clock.now())
        for moment in AFTER:
            run.at(moment, lambda: registers.append(states_of(run)))
        case.cause(run)

    with rig.stop.on_signals():
        rig.during(case.phase, case.begins, cause).run(settle=0.0)
    rig.clock.sleep_until(began[0] + AFTER[-1])
    last = {j: int(code, 16) for j, code in enumerate(case.states[-2:])}
    rig.assert_stopped(case.words, last, is_recorded=case.is_recorded)
    if case.phase != "enabling":
        assert " ".join(registers) == case.states
        assert rig.has_begun("stopping")
    if case.states == SLOWLY:
        assert "# stop: " in rig.record_path.read_text()
    special = [frame.data[7] for frame in rig.wire.sent if is_special(frame.data)]
    assert special.count(ENABLE) == 2
