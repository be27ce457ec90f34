"""Are the commands of a log those that its positions follow?

What is refused is what no servo does. A soft servo sags under its load, sticks in its friction and
is limited, so that its positions change by a fraction of what its commands do, keep a distance to
them, and correlate with them at nearly any lag; none of this is a fault by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Recording
from robot_sysid.servo.loop import LEAST_MOTION, MAX_DELAY, commands, low_pass
from robot_sysid.signals.resampling import sampling_period
from robot_sysid.wording import option_name

REACH = 3.0 * MAX_DELAY
"""Largest shift between commands and positions that is tried [s]: far enough beyond the longest
delay that a wrong one shows as what it is."""
SHIFT = 0.02
"""Distance between shifts [s], beside those of the ten nearest samples, where a copy shows."""
LEAST_CORRELATION = 0.3
"""Least correlation of commands with the positions that follow them."""
LEAST_RESPONSE = 0.4
"""Standard deviation of positions, over that of commands, below which a servo is too weak for its
load: its positions need not correlate with its commands, nor at any one delay."""
LEAST_SLOPE = 0.5
"""Least change of commands, over that of positions which correlate with them."""
LARGEST_SLOPE = 2.0
LARGEST_RANGE = 2.0 * np.pi
"""Change of commands over that of positions, and range of commands [rad or m], above both of which
they have another unit: commands of a servo that sags go no further than a turn."""
LARGEST_OFFSET = 0.3
STEADY = 0.1
"""Distance that commands keep [rad or m], and its change over that of positions, above and below
which a zero is wrong: the distance of a servo that sags changes with its load and its friction."""
CLEAR_LEAD = 1.5
CLEAR_DELAY = 10.0
"""How many times as much other lags leave unexplained of the commands, from which on positions
lead, or are later than a servo's."""
CLEAR_DIRECTION = -0.2
"""Correlation with the direction of motion of what commands differ by at one position, below which
positions lead: friction, damping and delay all put the command ahead of the motion."""
LEAST_REVERSAL = 0.3
"""Share of the direction of motion that positions do not tell by themselves, above which a motion
comes by the same positions in both directions."""
MOVING = 0.1
"""Share of the largest speed from which on a joint moves in a direction."""
DIRECTION_TIME = 0.03
"""Half of the time over which the direction of motion is taken [s]."""
DEGREE = 3
"""Degree of the polynomial of positions that stands for how far a servo sags."""
OF_OTHER = 10.0
"""How many times as much the own commands of a joint leave unexplained of its positions as those of
another joint, from which on columns were exchanged."""
COPIED = 1e-9
"""Distance below which a command equals a position [rad or m]: rounding of a file."""
COPIED_SHARE = 0.98
"""Share of commands that equal a position in a log whose commands were copied from them."""


@dataclass(frozen=True)
class Following:
    """How positions of a joint follow commands.

    Attributes:
        lags: (L,) of positions behind commands that were tried [s].
        correlations: (L,) at these lags.
        slope: change of commands over that of positions, at the best lag of a servo.
        offset: distance that commands keep, at this lag [rad or m].
        steadiness: change of that distance over that of positions.
        is_copy: whether commands equal positions, at the best of all lags.
        response: standard deviation of positions over that of commands behind a low-pass.
        command_range: largest less smallest command [rad or m].
        direction: correlation of commands with the direction of motion, beside positions.
        reversal: share of the direction that positions do not tell.
    """

    lags: Array
    correlations: Array
    slope: float
    offset: float
    steadiness: float
    is_copy: bool
    response: float
    command_range: float
    direction: float
    reversal: float

    def best(self, is_one: NDArray[np.bool_]) -> tuple[float, float]:
        """Return lag [s] and correlation where this is highest among some lags; -1 for none."""
        if not np.any(is_one):
            return 0.0, -1.0
        k = np.flatnonzero(is_one)[np.argmax(self.correlations[is_one])]
        return float(self.lags[k]), float(self.correlations[k])

    @property
    def is_servos(self) -> NDArray[np.bool_]:
        """Which of the lags (L,) a servo may have."""
        return _may_be_servos(self.lags)

    @property
    def correlation(self) -> float:
        """The highest one at a lag that a servo may have."""
        return self.best(self.is_servos)[1]

    @property
    def opposite(self) -> float:
        """The lowest one at such a lag."""
        return float(np.min(self.correlations[self.is_servos]))

    def is_clearer(self, correlation: float, times: float) -> bool:
        """Return whether a correlation leaves so many times less unexplained than a servo's."""
        return times * (1.0 - correlation) < 1.0 - self.correlation


def _may_be_servos(lags: Array) -> NDArray[np.bool_]:
    """Return which lags (L,) of positions behind commands a servo may have [s]."""
    return (lags >= 0.0) & (lags <= MAX_DELAY)


def follow(time: Array, q: Array, command: Array) -> Following:
    """Return how positions (N,) follow commands (N,), recorded at times (N,) [s]."""
    period = sampling_period(time)
    steps = _steps(period, REACH, len(q))
    steps = np.concatenate((-steps[:0:-1], steps))
    found = [_at_lag(q, command, step) for step in steps.tolist()]
    correlations = np.array([correlation for correlation, _ in found])
    lags = np.asarray(period * steps, dtype=float)
    is_servos = _may_be_servos(lags)
    best = np.flatnonzero(is_servos)[np.argmax(correlations[is_servos])]
    early, late = _shifted(command, q, int(steps[best]))
    distances = early - late
    copied = np.subtract(*_shifted(command, q, int(steps[np.argmax(correlations)])))
    direction, reversal = _direction(period, q, command)
    return Following(
        lags=lags,
        correlations=correlations,
        slope=found[best][1],
        offset=float(np.median(distances)),
        steadiness=(float(np.std(distances)) / max(float(np.std(late)), 1e-300)),
        is_copy=bool(np.quantile(np.abs(copied), COPIED_SHARE) < COPIED),
        response=(
            float(np.std(q)) / max(float(np.std(low_pass(time, command))), 1e-300)
        ),
        command_range=float(np.ptp(command)),
        direction=direction,
        reversal=reversal,
    )


def _steps(period: float, reach: float, count: int) -> NDArray[np.int64]:
    """Return by how many samples of so many commands are shifted, from none to a time [s]."""
    steps = np.arange(min(round(reach / period), count // 4) + 1)
    return steps[(steps <= 10) | (steps % max(1, round(SHIFT / period)) == 0)]


def _shifted(command: Array, q: Array, step: int) -> tuple[Array, Array]:
    """Return commands and the positions that are so many samples later."""
    end = len(q) - abs(step)
    return command[max(0, -step) :][:end], q[max(0, step) :][:end]


def _at_lag(q: Array, command: Array, step: int) -> tuple[float, float]:
    """Return correlation and slope of commands by positions that are so many samples later."""
    early, late = (x - np.mean(x) for x in _shifted(command, q, step))
    product, square = float(early @ late), float(late @ late)
    scale = np.sqrt(square * float(early @ early))
    return product / max(scale, 1e-300), product / max(square, 1e-300)


def _direction(period: float, q: Array, command: Array) -> tuple[float, float]:
    """Return the correlation of commands with the direction of motion at equal positions, and the
    share of the direction that positions do not tell.

    How far a servo sags depends on its position alone; a polynomial of it is taken from both.
    """
    width = max(1, round(DIRECTION_TIME / period))
    change = np.zeros(len(q))
    change[width:-width] = q[2 * width :] - q[: -2 * width]
    is_moving = np.abs(change) > MOVING * np.max(np.abs(change))
    way = np.where(is_moving, np.sign(change), 0.0)
    place = 2.0 * (q - np.min(q)) / np.ptp(q) - 1.0
    basis = np.linalg.qr(np.polynomial.legendre.legvander(place, DEGREE))[0]
    rest, turned = (x - basis @ (basis.T @ x) for x in (command, way))
    square = float(turned @ turned)
    scale = np.sqrt(square * float(rest @ rest))
    return float(rest @ turned) / max(scale, 1e-300), square / max(
        float(way @ way), 1e-300
    )


def _leads(joint: Following) -> str:
    """Return the complaint on positions that lead their commands; "" for none."""
    lag, correlation = joint.best(joint.lags < 0.0)
    is_led = (
        joint.is_clearer(correlation, CLEAR_LEAD)
        and joint.direction < CLEAR_DIRECTION
        and joint.reversal > LEAST_REVERSAL
    )
    text = (
        f"commands come {lag:.2g} s before them (not 0 to {MAX_DELAY:g} s): columns of commands "
        "and positions were exchanged, or commands were recorded too late"
    )
    return text if is_led else ""


def _is_late(joint: Following) -> str:
    """Return the complaint on positions that are later than a servo's; "" for none."""
    lag, correlation = joint.best(joint.lags > MAX_DELAY)
    is_late = (
        joint.is_clearer(correlation, CLEAR_DELAY)
        and correlation > LEAST_CORRELATION
        and joint.response > LEAST_RESPONSE
    )
    text = (
        f"commands come {lag:.2g} s before them (not 0 to {MAX_DELAY:g} s); check that time "
        "stamps of both are of one clock"
    )
    return text if is_late else ""


def _is_apart(joint: Following) -> str:
    """Return the complaint on positions that do not correlate with commands; "" for none."""
    if joint.correlation >= LEAST_CORRELATION or joint.response < LEAST_RESPONSE:
        return ""
    if joint.opposite < -LEAST_CORRELATION:
        lowest = np.argmin(joint.correlations)
        return (
            f"commands change {joint.correlations[lowest] / joint.response:.3g} times as much: "
            f"turn their sign round ({option_name('columns', 'FILE')} such as 'command.JOINT = "
            "-1 * TITLE')"
        )
    return (
        f"commands have a correlation of {joint.correlation:.2f} with them; check that they were "
        "sent to this joint's servo, and that their columns were not exchanged with another's"
    )


def _has_other_unit(joint: Following) -> str:
    """Return the complaint on the size of commands; "" for none."""
    is_small = joint.correlation >= LEAST_CORRELATION and joint.slope < LEAST_SLOPE
    is_large = joint.slope > LARGEST_SLOPE and joint.command_range > LARGEST_RANGE
    if not is_small and not is_large:
        return ""
    return (
        f"commands change {joint.slope:.3g} times as much (degrees 57.3 times, steps of 4096 a "
        "turn 652 times as much as rad); check their units "
        f"({option_name('units')}, or {option_name('columns', 'FILE')} such as "
        f"'command.JOINT = {1.0 / joint.slope:.4g} * TITLE')"
    )


def _has_other_zero(joint: Following) -> str:
    """Return the complaint on the distance that commands keep; "" for none."""
    is_apart = abs(joint.offset) > LARGEST_OFFSET and joint.steadiness < STEADY
    text = (
        f"commands differ by {joint.offset:.3g} all the time; check the zeros of both"
    )
    return text if is_apart else ""


def _is_copied(joint: Following) -> str:
    """Return the complaint on commands that are positions; "" for none."""
    text = "commands repeat the measured ones; check that they were sent to the servos"
    return text if joint.is_copy else ""


_CHECKS: Sequence[Callable[[Following], str]] = (
    _is_copied,
    _leads,
    _is_late,
    _is_apart,
    _has_other_unit,
    _has_other_zero,
)
"""What may be wrong with the commands of a joint: each returns a complaint, or "" for none."""


def _complaints(log: Recording, joint_names: Sequence[str]) -> Iterator[str]:
    """Yield what is wrong with the commands of joints of a log."""
    travel = np.ptp(log.q, axis=0)
    # A joint that is held sags as the others load it, and follows nothing.
    is_held = (np.ptp(commands(log), axis=0) < LEAST_MOTION) & (travel < LARGEST_OFFSET)
    moving = np.flatnonzero((travel >= LEAST_MOTION) & ~is_held).tolist()
    servos = {k: follow(log.time, log.q[:, k], commands(log)[:, k]) for k in moving}
    for k, joint in servos.items():
        faults = [*filter(None, (check(joint) for check in _CHECKS))]
        other = _other_joint(log, k, joint, moving)
        if other is not None:
            faults.append(
                f"those of joint {joint_names[other]} fit them far better: their columns were "
                "exchanged"
            )
        if faults:
            yield (
                f"the positions of joint {joint_names[k]} do not follow its commands as those of "
                f"a servo: {'; '.join(faults)}"
            )


def _other_joint(
    log: Recording, k: int, joint: Following, moving: Sequence[int]
) -> int | None:
    """Return the joint whose commands the positions of joint ``k`` follow far better than its own,
    of those that move; None for none.
    """
    steps = _steps(sampling_period(log.time), MAX_DELAY, len(log)).tolist()
    for other in moving:
        command = commands(log)[:, other]
        best = max(_at_lag(log.q[:, k], command, step)[0] for step in steps)
        if other != k and joint.is_clearer(best, OF_OTHER) and best > LEAST_CORRELATION:
            return other
    return None


def check_commands(logs: Sequence[Recording], joint_names: Sequence[str]) -> None:
    """Raise InputError where positions of a moving joint cannot be those that follow its commands.

    They follow with a delay, and never lead: what commands differ by at one position, from one
    direction of motion to the other, is ahead of the motion. Commands that equal the positions were
    copied from them. No other command reads commands, so that this check is no part of the gate
    (``faults.gate``).
    """
    for log in logs:
        for complaint in _complaints(log, joint_names):
            raise InputError(f"{log}: {complaint}")
