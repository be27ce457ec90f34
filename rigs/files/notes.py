"""A listener that keeps what the user would be told."""

from robot_sysid.records.messages import Progress


class NoteRecorder(Progress):
    """Keeps all notes, and which shares of the steps were done; ``then`` is called with each."""

    def __init__(self, then=lambda share: None):
        self.notes = []
        self.shares = []
        self._then = then

    def advance(self, label, done, total, text):
        self.shares.append(done / total)
        self._then(done / total)

    def note(self, *messages):
        self.notes += messages
