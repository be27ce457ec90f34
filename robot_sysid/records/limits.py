"""The limits of a motion: of positions, speeds, accelerations, torques, of the tool and of space.

Who limits an arm, its model, its user and its motors, states it in the same record, and
``Limits.of`` returns the tightest of them. What breaks a limit is found here and nowhere else
(``Limits.excesses``), by the largest values of a motion.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records.arrays import Array

LIMITED = {
    "position": "rad",
    "velocity": "rad/s",
    "acceleration": "rad/s^2",
    "torque": "N·m",
}
"""The quantities of a joint that have limits, in the order of their columns, to units of hinges."""
LARGEST = [*LIMITED][1:]
"""Those of them with a limit that is the same in both directions."""
ROUNDING = 1e-9
"""Share of a limit by which rounding may exceed it: the motion may start exactly at one."""


def limited_quantities(joints: Sequence[str]) -> list[tuple[str, str]]:
    """Return each limited quantity and its owner in words, (m,), of n joints in words."""
    quantities = [(quantity, joint) for quantity in LIMITED for joint in joints]
    return [*quantities, ("speed", "the tool")]


def limit_name(quantity: str, owner: str) -> str:
    """Return the name of a limit, such as "torque limit of joint elbow"."""
    kind = "" if quantity == "clearance" else "limit "
    return f"{quantity} {kind}of {owner}"


@dataclass(frozen=True)
class HalfSpace:
    """Space that certain bodies must stay in: points x with normal . x >= offset.

    Attributes:
        normal: (3,) unit vector in the world that points into the space.
        offset: of the boundary from the world's origin along the normal [m].
        clearance: distance that the bodies have to keep from the boundary [m].
        bodies: MuJoCo ids of these bodies.
        label: name of the boundary for messages.
    """

    normal: Array
    offset: float
    clearance: float
    bodies: tuple[int, ...]
    label: str


class LimitUse(NamedTuple):
    """The farthest value of a limited quantity along a motion, and its limit.

    Attributes:
        quantity: one of ``LIMITED``; "speed" of the tool, "clearance" of two bodies.
        owner: the joint, tool or bodies that have the limit, in words.
        middle: that value and limit are stated from, of a position's range, else zero [SI].
        value: the farthest one from the middle [SI]; negative for a position below it.
        limit: of the value, with its sign [SI].
        time: when the value is reached [s].
        is_kept: whether the value is within the limit, but for rounding.
    """

    quantity: str
    owner: str
    middle: float
    value: float
    limit: float
    time: float
    is_kept: bool

    @property
    def name(self) -> str:
        """Name of the limit."""
        return limit_name(self.quantity, self.owner)

    @property
    def share(self) -> float:
        """The value over the limit: above 1 where it is exceeded."""
        return self.value / self.limit


# Which of two limits is the tighter one, for each field of ``Limits``.
_TIGHTER: Mapping[str, Callable[[Any, Any], Any]] = {
    "lower": np.maximum,
    "upper": np.minimum,
    **dict.fromkeys((*LARGEST, "tool_speed"), np.minimum),
    "clearance": np.maximum,
    "spaces": operator.add,
}


@dataclass(frozen=True)
class Limits:
    """Limits of n joints, each (n,) or one number for all, and of what they carry.

    They are m in all: one of each of ``LIMITED`` of each joint, and that of the tool. A joint has
    both limits of its position, or none. Without an argument there is no limit.

    Attributes:
        lower: smallest positions [rad or m].
        upper: largest positions [rad or m].
        velocity: largest speeds in both directions [rad/s or m/s].
        acceleration: largest accelerations in both directions [rad/s^2 or m/s^2].
        torque: largest torques in both directions [N m or N].
        tool_speed: largest speed of the tool's fastest point [m/s].
        clearance: least distance between bodies that are apart at rest [m].
        spaces: half-spaces that bodies have to stay in.

    Raises:
        InputError: a number is NaN, or nothing keeps the limits.
    """

    lower: Array = -np.inf  # type: ignore[assignment]
    upper: Array = np.inf  # type: ignore[assignment]
    velocity: Array = np.inf  # type: ignore[assignment]
    acceleration: Array = np.inf  # type: ignore[assignment]
    torque: Array = np.inf  # type: ignore[assignment]
    tool_speed: float = np.inf
    clearance: float = 0.0
    spaces: tuple[HalfSpace, ...] = ()

    def __post_init__(self) -> None:
        names = ("lower", "upper", *LARGEST)
        arrays = np.broadcast_arrays(*(getattr(self, name) for name in names))
        for name, array in zip(names, arrays):
            object.__setattr__(self, name, array.astype(float))
        is_open = np.isinf(arrays[:2])
        # Written so that NaN is refused.
        is_kept = (self.lower <= self.upper) & (is_open[0] == is_open[1])
        least = np.min(arrays[2:], initial=self.tool_speed)
        if not (np.all(is_kept) and least > 0.0):
            raise InputError(
                "limits are empty: need lower <= upper, both or none, and all others above zero"
            )

    @classmethod
    def of(cls, *sources: Limits) -> Limits:
        """Return the tightest limits of several sources: of the model, the user, the motors."""
        tightest = {}
        for name, tighter in _TIGHTER.items():
            tightest[name] = reduce(tighter, map(attrgetter(name), sources))
        return cls(**tightest)

    @property
    def has_range(self) -> NDArray[np.bool_]:
        """Whether positions of each joint (n,) are limited."""
        return np.isfinite(self.lower)

    @property
    def center(self) -> Array:
        """Middle of the position limits (n,) [rad or m]; zero where there are none."""
        ends = np.where(self.has_range, (self.lower, self.upper), 0.0)
        return 0.5 * (ends[0] + ends[1])

    @property
    def span(self) -> Array:
        """Half of the range (n,) between the position limits [rad or m]."""
        return 0.5 * (self.upper - self.lower)

    def around(self, reference: Array, reach: Array | float) -> Limits:
        """Return limits with a range for each joint: where a joint has none, it is the reference
        (n,) plus and minus a reach, (n,) or one number [rad or m].
        """
        lower = np.where(self.has_range, self.lower, reference - reach)
        upper = np.where(self.has_range, self.upper, reference + reach)
        return replace(self, lower=lower, upper=upper)

    def with_positions(self, q: Array) -> Limits:
        """Return limits whose ranges include positions q (n,) too [rad]; NaN is left out."""
        lower = np.fmin(self.lower, q)
        return replace(self, lower=lower, upper=np.fmax(self.upper, q))

    @property
    def largest(self) -> Array:
        """Largest absolute values (4, n) of the quantities, of positions from the middle."""
        return np.stack((self.span, *(getattr(self, name) for name in LARGEST)))

    @property
    def columns(self) -> Array:
        """Largest absolute values (m,) of the columns of ``signals``."""
        return np.append(self.largest, self.tool_speed)

    def signals(
        self, q: Array, qd: Array, qdd: Array, tau: Array, tool: Array | float = 0.0
    ) -> Array:
        """Return the quantities that have limits (N, m) of N samples of a motion.

        Args:
            q, qd, qdd, tau: (N, n) of the joints.
            tool: (N,) speed of the tool's fastest point [m/s].
        """
        speed = np.broadcast_to(tool, len(q))
        return np.column_stack((q - self.center, qd, qdd, tau, speed))

    def uses(
        self,
        chunks: Iterable[tuple[Array, Array]],
        joints: Sequence[str],
        rounding: Array | float = 0.0,
    ) -> list[LimitUse]:
        """Return how far a motion uses each limit, one of each of ``columns``.

        Args:
            chunks: stretches of the motion: times (N,) [s] and ``signals`` (N, m).
            joints: the n joints in words.
            rounding: by how much the values may be off, of all or of each column (m,).
        """
        peaks = [_farthest(signals, time[:, None]) for time, signals in chunks]
        values, times = _farthest(*map(np.stack, zip(*peaks)))
        n_joints = len(joints)
        columns = self.columns
        middles = np.append(self.center, np.zeros(len(columns) - n_joints))
        # Only positions have limits that differ between the two directions.
        values[n_joints:] = np.abs(values[n_joints:])
        # A value that is NaN is not within its limit.
        is_kept = np.abs(values) <= (1.0 + ROUNDING) * columns + rounding
        limits = np.copysign(columns, values)
        owners = limited_quantities(joints)
        rows = zip(owners, middles, values, limits, times, is_kept)
        return [LimitUse(*owner, *numbers) for owner, *numbers in rows]


def _farthest(values: Array, time: Array) -> tuple[Array, Array]:
    """Return values (M,) farthest from zero in rows (N, M), NaN where one is, and their times."""
    row = np.argmax(np.abs(values), axis=0)[None]
    times = np.broadcast_to(time, values.shape)
    return np.take_along_axis(values, row, 0)[0], np.take_along_axis(times, row, 0)[0]
