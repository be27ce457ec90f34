"""Every frame of a run, as it was on the bus, in one of python-can's own log formats."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

from robot_sysid.damiao.bus.can_bus import import_can
from robot_sysid.damiao.bus.clock import Clock
from robot_sysid.damiao.protocol.frames import Frame
from robot_sysid.errors import InputError


class RawFrameLog:
    """Observes a link and writes its frames.

    The format follows the file's suffix: .log (candump), .asc, .blf, .csv, .trc, ... Time stamps
    are seconds since 1970.

    Args:
        path: the file; must not exist unless ``overwrite``.
        clock: the clock that frame times are in.
        channel: name of the bus in the log.
        overwrite: replace an existing file.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        clock: Clock,
        channel: str = "can0",
        overwrite: bool = False,
    ) -> None:
        self._can = import_can()
        if Path(path).exists() and not overwrite:
            raise InputError(f"{path} exists; choose another --record file or give --overwrite")
        try:
            self._writer: Any = self._can.Logger(os.fspath(path))
        except ValueError as error:
            raise InputError(f"cannot log frames to {path}: {error}") from None
        except OSError as error:
            raise InputError(f"cannot write {path}: {error.strerror}") from None
        self._channel = channel
        self._offset = time.time() - clock.now()
        self._waiting: list[tuple[float, Frame, bool]] = []

    def __call__(self, frame: Frame, sent: bool) -> None:
        """Take a frame; it is written with the next flush."""
        self._waiting.append((frame.time, frame, sent))

    def flush(self) -> None:
        """Write what has come since the last flush, in order of time."""
        for stamp, frame, sent in sorted(self._waiting, key=lambda entry: entry[0]):
            self._writer.on_message_received(self._message(stamp, frame, sent))
        self._waiting.clear()
        file: Any = getattr(self._writer, "file", None)
        if file is not None:
            file.flush()

    def close(self) -> None:
        """Write the rest and finish the file."""
        self.flush()
        self._writer.stop()

    def _message(self, stamp: float, frame: Frame, sent: bool) -> Any:
        return self._can.Message(
            timestamp=stamp + self._offset,
            arbitration_id=frame.id,
            data=frame.data,
            is_extended_id=False,
            is_error_frame=frame.error,
            is_fd=frame.fd,
            bitrate_switch=frame.fd,
            is_rx=not sent,
            channel=self._channel,
        )
