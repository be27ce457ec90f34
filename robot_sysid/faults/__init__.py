"""Checks of logs against the arm's model: the record of one finding.

A fault of the torque is a row of the table in ``faults``; a mistake in the columns of a log, one in
``readings``. ``search`` is the one loop that offers faults to the fit of a log, ``findings`` the
order in which everything is asked, ``gate`` the one entrance of all commands.
"""

from __future__ import annotations

from dataclasses import dataclass

from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.messages import Remark


@dataclass(frozen=True)
class ColumnCorrection:
    """Columns that joints have to be given in place of theirs.

    Attributes:
        position: (n,) for each joint, the index of the joint that has its position, and by which
            that column has to be multiplied.
        torque: the same of torques.
        zeros: (n,) what is to be added to positions then [rad]; () for nothing.
    """

    position: tuple[tuple[int, float], ...]
    torque: tuple[tuple[int, float], ...]
    zeros: tuple[float, ...] = ()


@dataclass(frozen=True)
class Finding(Remark):
    """A fault of a log, or sign of one, and what puts the log right.

    Attributes:
        about: name of the fault.
        options: ways to put the log right, each options with their values as words; () for none.
        command: name of the only command that has these options; "" where every one has them.
        correction: columns that put the log right; None for none.
        is_common_factor: whether it is a factor on all torques, or on all masses, which torques
            cannot tell apart. Two logs of one arm have it in common.
    """

    about: FaultName
    options: tuple[tuple[str, ...], ...] = ()
    command: str = ""
    correction: ColumnCorrection | None = None
    is_common_factor: bool = False

    def line(self) -> str:
        """Return the finding as one line of text: "level: text; remedy [name]"."""
        return f"{self.level.value}: {self.sentence} [{self.about}]"
