"""The frozen records that pass between stages; each checks itself once. SI units and radians.

Legend of shapes: N samples, n chain joints (base to terminal), p parameters.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from robot_sysid.records.arm import *  # noqa: F403
    from robot_sysid.records.arrays import *  # noqa: F403
    from robot_sysid.records.data import *  # noqa: F403
    from robot_sysid.records.limits import *  # noqa: F403


def __getattr__(name: str) -> Any:
    """Import the modules of records on first use: options and progress do not wait for numpy."""
    for module_name in ("arm", "arrays", "data", "limits"):
        names = vars(importlib.import_module(f"{__name__}.{module_name}"))
        if name in names:
            return globals().setdefault(name, names[name])
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
