"""Things that go wrong with a simulated arm, on demand."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from robot_sysid.damiao.protocol.registers import CTRL_MODE, TIMEOUT, TIMEOUT_UNIT, TMAX, VMAX
from robot_sysid.damiao.simulated.motor import SimulatedMotor
from robot_sysid.errors import InputError


def _set_register(number: int, scale: float = 1.0) -> Callable[[SimulatedMotor, float], None]:
    def apply(motor: SimulatedMotor, value: float) -> None:
        motor.registers[number] = value * scale

    return apply


def _set(name: str) -> Callable[[SimulatedMotor, float], None]:
    def apply(motor: SimulatedMotor, value: float) -> None:
        setattr(motor, name, type(getattr(motor, name))(value))

    return apply


_KINDS: Mapping[str, Callable[[SimulatedMotor, float], None]] = {
    "status": lambda motor, value: motor.fail(int(value)),
    "jammed": _set("jammed"),
    "silent": _set("silent"),
    "lost-replies": _set("loses_replies"),
    "temperature-mos": _set("temperature_mos"),
    "temperature-rotor": _set("temperature_rotor"),
    "velocity-factor": _set("velocity_factor"),
    "torque-factor": _set("torque_factor"),
    "slip": _set("slip"),
    "peak-torque": _set("peak_torque"),
    "tmax": _set_register(TMAX),
    "vmax": _set_register(VMAX),
    "mode": _set_register(CTRL_MODE),
    "watchdog": _set_register(TIMEOUT, 1.0 / TIMEOUT_UNIT),
}


@dataclass(frozen=True)
class Fault:
    """One thing that goes wrong.

    Attributes:
        kind: what; see ``FAULT_KINDS``.
        joint: which joint, from 0.
        value: status code, temperature, new register value, ... or 1 for "on" and 0 for "off".
        after: seconds after the arm was first enabled; 0 means from the beginning.
    """

    kind: str
    joint: int
    value: float = 1.0
    after: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in _KINDS:
            raise InputError(f"unknown fault {self.kind!r}; valid: {', '.join(_KINDS)}")

    def apply(self, motor: SimulatedMotor) -> None:
        """Let it happen."""
        _KINDS[self.kind](motor, self.value)


FAULT_KINDS = tuple(_KINDS)


def parse_fault(text: str) -> Fault:
    """Return the fault written as KIND:JOINT[=VALUE][@SECONDS], for instance status:2=13@4.5.

    Raises:
        InputError: the text has another form, or an unknown kind.
    """
    rest, _, after = text.partition("@")
    rest, _, value = rest.partition("=")
    kind, _, joint = rest.partition(":")
    try:
        amount, delay = float(value or 1.0), float(after or 0.0)
        if not math.isfinite(amount + delay):
            raise ValueError
        return Fault(kind, int(joint), amount, delay)
    except ValueError:
        raise InputError(
            f"a fault is written KIND:JOINT[=VALUE][@SECONDS], got {text!r}; "
            f"kinds: {', '.join(FAULT_KINDS)}"
        ) from None
