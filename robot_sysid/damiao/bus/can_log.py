"""Every frame of a run, as it was on the bus, in one of python-can's own log formats."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Any

from robot_sysid.damiao.bus.can_bus import import_can, message_of
from robot_sysid.damiao.bus.clock import Clock
from robot_sysid.damiao.protocol.frames import Frame
from robot_sysid.errors import InputError


class RawFrameLog:
    """Observes a link and writes its frames to a file, replacing one that is there.

    The format follows the file's suffix: .log (candump), .asc, .blf, .csv, .trc, ... Time stamps
    are seconds since 1970.

    Args:
        path: the file.
        clock: the clock that frame times are in.
        channel: name of the bus in the log.
    """

    def __init__(self, path: Path, clock: Clock, channel: str) -> None:
        self._can = import_can()
        try:
            self._writer: Any = self._can.Logger(str(path))
        except ValueError as error:
            raise InputError(f"cannot log frames to {path}: {error}") from None
        except OSError as error:
            raise InputError(f"cannot write {path}: {error.strerror}") from None
        self._channel = channel
        self._offset = time.time() - clock.now()
        self._waiting: list[tuple[Frame, bool]] = []

    def __call__(self, frame: Frame, sent: bool) -> None:
        """Take a frame; it is written with the next flush."""
        self._waiting.append((frame, sent))

    def flush(self) -> None:
        """Write what has come since the last flush, in order of time."""
        for frame, sent in sorted(self._waiting, key=lambda entry: entry[0].time):
            stamp = frame.time + self._offset
            rest = {"timestamp": stamp, "is_rx": not sent, "channel": self._channel}
            self._writer.on_message_received(message_of(self._can, frame, **rest))
        self._waiting.clear()
        file: Any = getattr(self._writer, "file", None)
        if file is not None:
            file.flush()

    def close(self) -> None:
        """Write the rest, if there is room for it, and finish the file."""
        with contextlib.suppress(OSError):
            self.flush()
        with contextlib.suppress(OSError):
            self._writer.stop()
