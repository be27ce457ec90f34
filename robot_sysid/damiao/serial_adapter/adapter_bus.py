"""The maker's serial adapter as a python-can bus: ``interface="damiao"``.

python-can finds the class by its entry point; it is made on first use, because python-can is an
extra.
"""

from __future__ import annotations

import time
from collections import deque
from functools import cache
from typing import Any

from robot_sysid.damiao.serial_adapter.packets import RECEIVED, PacketReader, packet

BAUD = 921_600
# Longest wait for the line to take a packet: longer, and the motors' watchdogs are near [s].
_WRITE_TIMEOUT = 0.02


def __getattr__(name: str) -> Any:
    if name == "DamiaoSerialBus":
        return _bus_class()
    raise AttributeError(name)


@cache
def _bus_class() -> Any:
    import can
    import serial

    class DamiaoSerialBus(can.BusABC):
        """Classic CAN over the adapter's serial line; the bit rate is set in the adapter.

        Args:
            channel: the serial port, for instance /dev/ttyACM0.
            baudrate: of the line.
            write_timeout: longest wait for the line to take a packet [s].
        """

        def __init__(
            self,
            channel: str,
            baudrate: int = BAUD,
            write_timeout: float = _WRITE_TIMEOUT,
            **rest: Any,
        ) -> None:
            self._port = serial.Serial(channel, baudrate, timeout=0, write_timeout=write_timeout)
            self._reader, self._waiting = PacketReader(), deque[Any]()
            self.channel_info = f"Damiao serial adapter at {channel}"
            super().__init__(channel=channel, **rest)

        def send(self, msg: Any, timeout: float | None = None) -> None:
            """Send a frame; the adapter does not say when it was on the bus."""
            self._port.write(packet(msg.arbitration_id, bytes(msg.data)))

        def _recv_internal(self, timeout: float | None) -> tuple[Any, bool]:
            until = None if timeout is None else time.monotonic() + timeout
            while not self._waiting:
                self._port.timeout = until and max(until - time.monotonic(), 0.0)
                # The rest of what has come already, or the first byte of what comes next.
                piece = self._port.read(max(self._port.in_waiting, 1))
                self._waiting.extend(self._reader.take(piece))
                if not self._waiting and until is not None and time.monotonic() >= until:
                    return None, False
            frame = self._waiting.popleft()
            return _message(can, frame), False

        def shutdown(self) -> None:
            """Close the serial line."""
            super().shutdown()
            self._port.close()

    return DamiaoSerialBus


def _message(can: Any, frame: Any) -> Any:
    return can.Message(
        timestamp=time.time(), arbitration_id=frame.id, data=frame.data, is_extended_id=False
    )


__all__ = ["BAUD", "RECEIVED", "DamiaoSerialBus"]  # noqa: F822
