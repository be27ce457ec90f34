"""A terminal in simulated time."""

from __future__ import annotations

import os


class Terminal:
    """Standard output of a command on a rig, which may be closed, as by the end of a connection.

    It is closed where ``rig.terminal_is_closed`` is true. Who then asks for its file, to send it
    nowhere, has what is written afterwards dropped.

    Args:
        stream: takes what is written.
        rig: whose clock it is, and who may close it.
        on_text: called with each text that is written.
    """

    def __init__(self, stream, rig, on_text):
        self._stream = stream
        self._rig = rig
        self._on_text = on_text
        self._is_dropped = False

    def isatty(self):
        """It wraps and colours nothing."""
        return False

    def write(self, text):
        if self._is_dropped:
            return
        if self._rig.terminal_is_closed:
            raise OSError(5, "Input/output error")
        self._on_text(text)
        self._stream.write(text)

    def flush(self):
        self._stream.flush()

    def fileno(self):
        """A file that whoever asks may send elsewhere."""
        self._is_dropped = self._rig.terminal_is_closed
        return os.open(os.devnull, os.O_WRONLY)
