"""Checks of a log against the arm's model before an estimate: the record of one finding."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_sysid.records import Array
from robot_sysid.records.messages import Remark


@dataclass(frozen=True)
class ColumnCorrection:
    """Columns that joints have to be given in place of theirs.

    Attributes:
        quantities: whose columns are wrong: "position", "torque" or both.
        order: (n,) for each joint, the index of the joint that has its columns.
        factors: (n,) by which each joint's right column has to be multiplied.
    """

    quantities: tuple[str, ...]
    order: tuple[int, ...]
    factors: tuple[float, ...]

    @classmethod
    def of_factors(cls, factors: Array, *quantities: str) -> ColumnCorrection:
        """Return the correction that multiplies each joint's own column by a factor (n,)."""
        return cls(quantities, tuple(range(len(factors))), tuple(factors.tolist()))

    def apply(self, quantity: str, values: Array) -> Array:
        """Return recorded values (N, n) of a quantity with the columns put right."""
        if quantity not in self.quantities:
            return values
        return values[:, self.order] * np.array(self.factors)


@dataclass(frozen=True)
class Finding(Remark):
    """A fault of a log, or sign of one, and what puts the log right.

    ``about`` is the name of the check that made the finding, a key of ``logs.CHECKS``.

    Attributes:
        options: ways to put the log right, each options with their values as words; () for none.
        command: name of the only command that has these options; "" where every one has them.
        correction: columns that put the log right; None for none.
    """

    options: tuple[tuple[str, ...], ...] = ()
    command: str = ""
    correction: ColumnCorrection | None = None

    def line(self) -> str:
        """Return the finding as one line of text: "level: text; remedy [name]"."""
        return f"{self.level.value}: {self.sentence} [{self.about}]"
