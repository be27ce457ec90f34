"""The time a search may take, as all its processes see it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

Clock = Callable[[], float]
"""Gives the time [s]."""


class OutOfTime(Exception):
    """The budget is used up in the middle of something."""


@dataclass(frozen=True)
class Budget:
    """When a search ends.

    Attributes:
        deadline: on the clock [s].
        clock: that of the machine, so that it can be asked in other processes too.
    """

    deadline: float
    clock: Clock = time.monotonic

    @property
    def is_over(self) -> bool:
        """Whether time is up."""
        return self.clock() > self.deadline


UNLIMITED = Budget(float("inf"))
