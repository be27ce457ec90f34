"""A listener that keeps what the user would be told."""

from __future__ import annotations

from robot_sysid.records.messages import Progress


class NoteRecorder(Progress):
    """Keeps all notes."""

    def __init__(self):
        self.notes = []

    def note(self, *messages):
        self.notes += messages
