"""Checks of a log against the arm's model before an estimate: the record of one finding."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Level(Enum):
    """Severity of a finding: REFUSE forbids an estimate, WARN needs consent, NOTE only informs."""

    REFUSE = "refuse"
    WARN = "warn"
    NOTE = "note"


@dataclass(frozen=True)
class Finding:
    """One fault of a log, or sign of one.

    Attributes:
        name: name of the check that made the finding, a key of ``logs.CHECKS``.
        level: severity.
        text: the fault and what to do, for the user.
        payload_options: options of ``payload``, with their values, with which a weight of known
            mass determines each joint's torque scale; () where that is no remedy.
    """

    name: str
    level: Level
    text: str
    payload_options: tuple[str, ...] = ()

    def line(self) -> str:
        """Return the finding as one line of text: "level: text [name]"."""
        return f"{self.level.value}: {self.text} [{self.name}]"
