"""Which answer belongs to which command, although answers carry no number.

Each command is answered once, in order. Where an answer is missing at the end of its cycle, the
next thing heard from that motor may be it, late, or the answer to the next command. So the motor is
told nothing new until the missing answer has come or is long overdue: what a slow adapter holds
back is out of the way then, and each answer that is believed belongs to the command before it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
PAUSE = 4
"""Cycles of silence after which a missing answer counts as lost."""


class Outstanding:
    """Keeps the books on commands and answers of n motors."""

    def __init__(self, n: int) -> None:
        self._owed, self._silent = np.zeros(n, int), np.zeros(n, int)
        self._told = np.zeros(n, bool)

    def may_be_told(self, wanted: Mask) -> Mask:
        """Begin a cycle: return which of the motors ``wanted`` (n,) get a command in it."""
        self._silent = np.where(self._told, 0, self._silent + 1)
        self._owed[self._silent >= PAUSE] = 0
        self._told = np.asarray(wanted & (self._owed == 0))
        self._owed += self._told
        return self._told

    def heard(self, j: int) -> bool:
        """Note an answer; return whether it is that to the command of this cycle."""
        timely = bool(self._told[j] and self._owed[j] == 1)
        self._owed[j] = max(self._owed[j] - 1, 0)
        self._silent[j] = 0
        return timely
