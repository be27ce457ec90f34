"""Checks of a log against the arm's model before an estimate: the record of one finding."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from robot_sysid.records import Array

COLUMNS_ADVICE = "; put the columns right with --columns FILE"
"""End of the text of a finding on wrong columns."""


class Level(Enum):
    """Severity of a finding: REFUSE forbids an estimate, WARN needs consent, NOTE only informs."""

    REFUSE = "refuse"
    WARN = "warn"
    NOTE = "note"


@dataclass(frozen=True)
class ColumnCorrection:
    """Columns that joints have to be given in place of theirs.

    Attributes:
        quantities: whose columns are wrong: "position", "torque" or both.
        joint_names: (n,) of the chain, base to terminal.
        order: (n,) for each joint, the index of the joint that has its columns.
        factors: (n,) by which each joint's right column has to be multiplied.
    """

    quantities: tuple[str, ...]
    joint_names: tuple[str, ...]
    order: tuple[int, ...]
    factors: tuple[float, ...]

    @classmethod
    def of_factors(
        cls, quantities: tuple[str, ...], joint_names: Sequence[str], factors: Array
    ) -> ColumnCorrection:
        """Return the correction that multiplies each joint's own column by a factor (n,)."""
        order = tuple(range(len(joint_names)))
        return cls(quantities, tuple(joint_names), order, tuple(factors.tolist()))

    def apply(self, values: Array) -> Array:
        """Return recorded values (N, n) with the columns put right."""
        return values[:, self.order] * np.array(self.factors)


@dataclass(frozen=True)
class Finding:
    """One fault of a log, or sign of one.

    Attributes:
        name: name of the check that made the finding, a key of ``logs.CHECKS``.
        level: severity.
        text: the fault and what to do, for the user.
        payload_options: options of ``payload``, with their values, with which a weight of known
            mass determines each joint's torque scale; () where that is no remedy.
        options: options of every command, with their values, that put the log right; () for none.
        correction: columns that put the log right; None for none.
        is_left_out: whether the fault lasts a moment, which is left out, so that the rest is right.
    """

    name: str
    level: Level
    text: str
    payload_options: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    correction: ColumnCorrection | None = None
    is_left_out: bool = False

    def line(self) -> str:
        """Return the finding as one line of text: "level: text [name]"."""
        return f"{self.level.value}: {self.text} [{self.name}]"
