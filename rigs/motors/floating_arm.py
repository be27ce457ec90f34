"""What may happen to an arm that floats, carried by its model's gravity alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class FloatingCase:
    """A fault of the first joint of an arm that floats and sinks by 4 deg/s.

    Attributes:
        cause: begins the fault on the arm's bus.
        code: exit code of the command.
        words: pattern of what is said.
        bound: how far the joint then gets [rad]; the other one is held within 0.03 rad.
        name: of the incident.
    """

    cause: Callable[[Any], object]
    code: int = 3
    words: str = ""
    bound: float = np.inf
    name: str = ""
