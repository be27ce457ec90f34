"""Looking at a log against the model before anything is estimated from it: what a check finds."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Level(Enum):
    """How much a finding matters."""

    REFUSE = "refuse"
    WARN = "warn"
    NOTE = "note"


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, or looks so; its name is one of ``logs.options.CHECKS``."""

    name: str
    level: Level
    text: str

    def line(self) -> str:
        """Return it as one line."""
        return f"{self.level.value}: {self.text} [{self.name}]"
