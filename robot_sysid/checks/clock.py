"""Lost and repeated samples and jumps of the clock, seen in steps of position too large or small.

A joint that moves goes about as far in one step of time as in the steps around it. A step with
twice the speed has lost a sample that its time stamp does not show; one with none repeats the
sample before it; a long step of time with the way of a short one is a jump of the clock.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from robot_sysid.checks.finding import Finding, Level
from robot_sysid.records import Array, Measurement

LOST, REPEATED = (1.6, 4.0), 0.3
"""Speed over that of the steps around it, of a step with lost samples and of a repeated one."""
FEW, MANY = 0.003, 0.02
"""Share of such steps that is warned of, and that is refused."""
_JUMP, _NO_WAY = 1.75, 1.4
_CLEAR = 8.0
_ENOUGH = 100


def clock_findings(pieces: Sequence[Measurement]) -> Iterator[Finding]:
    """Yield what the steps of a log's pieces say."""
    parts = [_steps(piece) for piece in pieces if len(piece) > _ENOUGH]
    if not parts:
        return
    speed, longer = (np.concatenate(same) for same in zip(*parts))
    if len(speed) < _ENOUGH:
        return
    jumps = int(np.count_nonzero((longer > _JUMP) & (speed * longer < _NO_WAY) & (speed > 0.0)))
    plain = longer < _JUMP
    lost = float(np.mean(plain & (speed > LOST[0]) & (speed < LOST[1])))
    between = float(np.mean(plain & (speed > 1.25) & (speed < 1.5)))
    still = float(np.mean(plain & (np.abs(speed) < REPEATED)))
    if lost > FEW and lost > 3.0 * between:
        yield _finding(lost, "have lost samples that the time stamps do not show")
    if still > FEW:
        yield _finding(still, "repeat the position of the sample before while the arm moves")
    if jumps:
        yield Finding(
            "clock",
            Level.WARN,
            f"the clock jumps ahead {jumps} times without a sample missing; use the stamps of the "
            "controller's own clock",
        )


def _finding(share: float, what: str) -> Finding:
    level = Level.REFUSE if share > MANY else Level.WARN
    return Finding(
        "clock", level, f"{100.0 * share:.2g} % of the steps {what}; record the time of each sample"
    )


def _steps(piece: Measurement) -> tuple[Array, Array]:
    """Return per clear step its speed over that around it, and its length over the usual one."""
    step = np.diff(piece.time)
    usual = float(np.median(step))
    way = np.diff(piece.q, axis=0)
    pace = way * (usual / step)[:, None]
    around = np.median([pace[k : len(pace) - 4 + k] for k in (0, 1, 3, 4)], axis=0)
    inner, length = way[2:-2], step[2:-2] / usual
    size = np.sum(around**2, axis=1)
    noise = np.sum(np.median(np.abs(np.diff(way, axis=0)), axis=0) ** 2)
    clear = size > max(_CLEAR**2 * float(noise), 0.02 * float(np.max(size, initial=0.0)))
    along = np.sum(inner * around, axis=1)[clear] / size[clear]
    return along / length[clear], length[clear]
