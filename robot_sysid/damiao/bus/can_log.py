"""Every frame of a run, as it was on the bus, in one of python-can's own log formats."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
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
        channels: names of the buses in the log.
    """

    def __init__(self, path: Path, clock: Clock, channels: Sequence[str]) -> None:
        self._can = import_can()
        try:
            self._writer: Any = self._can.Logger(str(path))
        except ValueError as error:
            raise InputError(f"cannot log frames to {path}: {error}") from None
        except OSError as error:
            raise InputError(f"cannot write {path}: {error.strerror}") from None
        self._channels = tuple(channels)
        self._offset = time.time() - clock.now()
        self._waiting: list[tuple[Frame, bool]] = []

    def __call__(self, frame: Frame, sent: bool) -> None:
        """Take a frame."""
        self._waiting.append((frame, sent))

    def taken(self) -> list[tuple[Frame, bool]]:
        """Return the frames that came since the last call, for ``write``."""
        taken, self._waiting = self._waiting, []
        return taken

    def write(self, frames: list[tuple[Frame, bool]]) -> None:
        """Write frames in order of time; may be called from another thread than the rest."""
        for frame, sent in sorted(frames, key=lambda entry: entry[0].time):
            stamp, channel = frame.time + self._offset, self._channels[frame.bus]
            rest = {"timestamp": stamp, "is_rx": not sent, "channel": channel}
            self._writer.on_message_received(message_of(self._can, frame, **rest))
        file: Any = getattr(self._writer, "file", None)
        if file is not None:
            file.flush()

    def close(self) -> None:
        """Finish the file, if there is room for it."""
        with contextlib.suppress(Exception):
            self._writer.stop()
