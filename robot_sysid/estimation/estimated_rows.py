"""Equations of recordings in the estimated parameters only: held parameters move to the right.

Each joint has rows x = right-hand side [N m]. The torque of parameters that are held at known
values is subtracted from the right-hand side, and their columns are dropped.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.estimation.dataset import DecimatedSamples
from robot_sysid.estimation.unknowns import Unknowns
from robot_sysid.records import Array


@dataclass(frozen=True)
class EstimatedRows:
    """Rows of recordings in the estimated parameters, the torque of held ones subtracted.

    Iterating makes the rows of one joint at a time: those of all joints take much memory.

    Attributes:
        samples: equations of each recording in all p parameters; all have the same columns.
        unknowns: which parameters are estimated, and the values (p,) at which others are held.
    """

    samples: tuple[DecimatedSamples, ...]
    unknowns: Unknowns

    def __iter__(self) -> Iterator[tuple[int, Array, Array]]:
        """Yield (joint number, rows (M, k), right-hand sides (M,)) of each joint.

        M counts the rows of all recordings, one recording below the other; k are the estimated
        parameters in the joint's equations.
        """
        for joint in range(len(self.samples[0].columns)):
            # No variable here keeps rows in memory while the next ones are made.
            yield (joint, *self._joint_rows(joint))

    def _joint_rows(self, joint: int) -> tuple[Array, Array]:
        """Return a joint's (rows (M, k), right-hand sides (M,)), in new arrays."""
        columns = self.samples[0].columns[joint]
        is_estimated = np.isin(columns, self.unknowns.estimated)
        held = self.unknowns.held[columns[~is_estimated]]
        n_rows = sum(map(len, self.samples))
        all_rows = np.empty((n_rows, np.count_nonzero(is_estimated)))
        right_sides = []
        start = 0
        for recording in self.samples:
            rows = recording.rows[joint]
            all_rows[start : start + len(rows)] = rows[:, is_estimated]
            start += len(rows)
            right_sides.append(recording.tau[joint] - rows[:, ~is_estimated] @ held)
        return all_rows, np.concatenate(right_sides)


def restrict_samples(samples: DecimatedSamples, unknowns: Unknowns) -> DecimatedSamples:
    """Return a recording's rows in the estimated parameters, the torque of held ones subtracted.

    The names of the result are those of the estimated parameters, in ascending order of their
    indices; ``samples`` is not changed.
    """
    columns = []
    for indices in samples.columns:
        estimated = indices[np.isin(indices, unknowns.estimated)]
        # Their positions among the estimated parameters, which ascend.
        columns.append(np.searchsorted(unknowns.estimated, estimated))
    _, rows, right_sides = zip(*EstimatedRows((samples,), unknowns))
    return replace(
        samples,
        names=unknowns.estimated_names,
        columns=tuple(columns),
        rows=rows,
        tau=right_sides,
    )
