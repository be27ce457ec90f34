"""What a check finds, and how much it matters."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from enum import Enum

from robot_sysid.errors import InputError, SysidError


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


def require_acceptable(
    log: str, findings: Iterable[Finding], accepted: Collection[str] = ()
) -> None:
    """Stop at what must not become a number; ``accepted`` names warnings that may.

    Raises:
        InputError: a finding refuses the log.
        SysidError: there is a warning that is not accepted.
    """
    found = list(findings)
    refused = [each.text for each in found if each.level is Level.REFUSE]
    if refused:
        raise InputError(f"{log}: {'; '.join(refused)}")
    warned = [f for f in found if f.level is Level.WARN and f.name not in accepted]
    if warned:
        names = " ".join(f"--accept {name}" for name in dict.fromkeys(f.name for f in warned))
        texts = "; ".join(each.text for each in warned)
        raise SysidError(f"{log}: {texts}; nothing was written (to go on all the same: {names})")
