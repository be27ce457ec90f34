"""Setting the motors' watchdogs for one run; the old values come back afterwards."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping

from robot_sysid.damiao.register_client import RegisterClient
from robot_sysid.damiao.registers import TIMEOUT, TIMEOUT_UNIT
from robot_sysid.errors import HardwareAbort


@contextlib.contextmanager
def watchdogs_set_to(
    client: RegisterClient, before: Mapping[int, float], seconds: float | None
) -> Iterator[None]:
    """Write the watchdog register of each motor, and its old value when the block ends.

    Nothing is stored to flash: after a power cycle the motors have their own values again.

    Args:
        client: talks to the motors.
        before: CAN id to the value of the register now.
        seconds: watchdog time [s]; None leaves them alone.
    """
    if seconds is None:
        yield
        return
    try:
        for can_id in before:
            client.write(can_id, TIMEOUT, float(round(seconds / TIMEOUT_UNIT)))
        yield
    finally:
        for can_id, value in before.items():
            # A motor that does not answer any more keeps the safer value until power-off.
            with contextlib.suppress(HardwareAbort):
                client.write(can_id, TIMEOUT, value)
