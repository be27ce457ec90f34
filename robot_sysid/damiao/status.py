"""The status code in every feedback frame."""

from __future__ import annotations

DISABLED, ENABLED = 0, 1
LOST_COMMUNICATION = 0xD

_MEANINGS = {
    DISABLED: "disabled",
    ENABLED: "enabled",
    0x2: "encoder error",
    0x3: "output-shaft calibration error",
    0x4: "sensor output error",
    0x5: "calibration data error",
    0x6: "motor parameters could not be read",
    0x7: "sensor could not be read",
    0x8: "over-voltage",
    0x9: "under-voltage",
    0xA: "over-current",
    0xB: "power stage too hot",
    0xC: "winding too hot",
    LOST_COMMUNICATION: "communication lost (watchdog expired)",
    0xE: "overload",
}


def describe(code: int) -> str:
    """Return a status code in words."""
    return f"status {code:X}: {_MEANINGS.get(code, 'not documented')}"


def is_fault(code: int) -> bool:
    """Tell whether a code is a fault; every fault makes the motor leave the enabled state."""
    return code not in (DISABLED, ENABLED)
