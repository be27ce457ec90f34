"""Checks of a log against the model, before anything is estimated from it; here their findings."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Level(Enum):
    """Severity of a finding: it forbids an estimate, asks for consent, or only informs."""

    REFUSE = "refuse"
    WARN = "warn"
    NOTE = "note"


@dataclass(frozen=True)
class Finding:
    """One fault of a log, or sign of one.

    Attributes:
        name: of the check, a key of ``logs.CHECKS``.
        level: severity.
        text: the fault and what to do, for the user.
    """

    name: str
    level: Level
    text: str

    def line(self) -> str:
        """Return the finding as one line of text: "level: text [name]"."""
        return f"{self.level.value}: {self.text} [{self.name}]"
