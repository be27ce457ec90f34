"""Packing and unpacking of MIT command and feedback frames, for all joints at once.

MIT command, 64 bits, most significant first: position 16, velocity 12, kp 12, kd 12, torque 12.
Feedback: status 4, id 4, position 16, velocity 12, torque 12, two temperature bytes. A quantity in
[lo, hi] is the integer u = (x - lo) (2^bits - 1) / (hi - lo): no code stands for exactly zero.

Arrays are (..., n): any leading shape, n joints last; frames are (..., n, 8) bytes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records import Array

Bytes = NDArray[np.uint8]
Codes = NDArray[np.int64]

KP_MAX = 500.0
KD_MAX = 5.0
_POSITION_FULL = 0xFFFF
_TWELVE_FULL = 0xFFF
KD_STEP = KD_MAX / _TWELVE_FULL
"""The least damping that a frame can carry [N m s/rad]."""
# A register holds float32: 12.566 comes back as 12.5659999..., which must not refuse 12.566.
_FLOAT32_SLACK = 1e-6
_FULL = np.array([[_POSITION_FULL], *[[_TWELVE_FULL]] * 4])
_HAS_SIGN = np.array([[-1.0], [-1.0], [0.0], [0.0], [-1.0]])
_MEASURED = [0, 1, 4]


@dataclass(frozen=True)
class Scaling:
    """What the integers in each joint's frames mean: (n,) PMAX [rad], VMAX [rad/s], TMAX [N m]."""

    position: Array
    velocity: Array
    torque: Array
    # Ranges (5, n) of the command's fields: position, velocity, kp, kd, torque.
    _low: Array = field(init=False, repr=False, compare=False)
    _high: Array = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("position", "velocity", "torque"):
            value = getattr(self, name)
            if not np.all(np.isfinite(value) & (value > 0.0)):
                raise InputError(f"{name} scaling must be positive numbers, got {value.tolist()}")
        gains = np.full_like(self.position, KP_MAX), np.full_like(self.position, KD_MAX)
        high = np.stack([self.position, self.velocity, *gains, self.torque])
        object.__setattr__(self, "_high", high)
        object.__setattr__(self, "_low", high * _HAS_SIGN)

    @classmethod
    def from_limits(cls, limits: Iterable[tuple[float, float, float]]) -> Scaling:
        """Build the scaling of n joints from their (PMAX, VMAX, TMAX)."""
        table = np.array(list(limits), dtype=float).reshape(-1, 3)
        return cls(table[:, 0], table[:, 1], table[:, 2])

    @property
    def steps(self) -> tuple[Array, Array, Array]:
        """One quantisation step (n,) of position [rad], velocity [rad/s] and torque [N m]."""
        return (
            2.0 * self.position / _POSITION_FULL,
            2.0 * self.velocity / _TWELVE_FULL,
            2.0 * self.torque / _TWELVE_FULL,
        )


class MitCommand(NamedTuple):
    """What a joint is told: torque = kp (position - q) + kd (velocity - qd) + torque.

    All are (..., n) [rad, rad/s, N m/rad, N m s/rad, N m]; kp is 0 to 500 and kd 0 to 5.
    """

    position: Array
    velocity: Array
    kp: Array
    kd: Array
    torque: Array

    def motor_torque(self, q: Array, qd: Array) -> Array:
        """Return the torque (..., n) this asks for at positions and velocities (..., n) [N m]."""
        return np.asarray(
            self.kp * (self.position - q) + self.kd * (self.velocity - qd) + self.torque
        )


@dataclass(frozen=True)
class Feedback:
    """What joints answer, each (..., n); output-shaft quantities [rad, rad/s, N m].

    ``can_id`` has the low four bits of the motor's; for ``status`` see ``registers.describe``. The
    temperatures are those of the power stage and the winding [deg C].
    """

    can_id: Codes
    status: Codes
    position: Array
    velocity: Array
    torque: Array
    temperature_mos: Codes
    temperature_rotor: Codes


def encode_mit(command: MitCommand, scaling: Scaling) -> Bytes:
    """Return the MIT frames (..., n, 8), each value rounded to the nearest code.

    Raises:
        InputError: a value is not finite or outside its range (nothing is clamped), kp > 0 without
            kd > 0 in its frame (the motor would oscillate), or a frame's first seven bytes would
            all be 0xFF (the motor would take it for enable, disable, zero or clear).
    """
    values = np.array(np.broadcast_arrays(*command))
    _refuse_outside(values, scaling)
    # floor(x + 1/2): numpy's rint rounds halves to even, which differs in the last bit.
    p, v, kp, kd, t = _codes(values, scaling, slice(None), 0.5)
    unstable = (values[2] > 0.0) & (kd == 0)
    if np.any(unstable):
        raise InputError(
            f"kp > 0 needs kd of at least {KD_STEP:.2g} {_place(unstable)}: less is sent as 0"
        )
    frames = _pack(
        p.shape, p >> 8, p, v >> 4, (v << 4) | (kp >> 8), kp, kd >> 4, (kd << 4) | (t >> 8), t
    )
    special = np.all(frames[..., :7] == 0xFF, axis=-1)
    if np.any(special):
        raise InputError(
            f"the command {_place(special)} has every field at its maximum and "
            "would read as a special frame; lower its gains or torque"
        )
    return frames


def decode_mit(frames: Bytes, scaling: Scaling) -> MitCommand:
    """Return what MIT frames (..., n, 8) command; the motor's side of ``encode_mit``."""
    d = np.asarray(frames, dtype=np.int64)
    p = (d[..., 0] << 8) | d[..., 1]
    v = (d[..., 2] << 4) | (d[..., 3] >> 4)
    kp = ((d[..., 3] & 0xF) << 8) | d[..., 4]
    kd = (d[..., 5] << 4) | (d[..., 6] >> 4)
    t = ((d[..., 6] & 0xF) << 8) | d[..., 7]
    return MitCommand(
        _values(p, scaling.position, _POSITION_FULL),
        _values(v, scaling.velocity, _TWELVE_FULL),
        np.asarray(kp * (KP_MAX / _TWELVE_FULL)),
        np.asarray(kd * (KD_MAX / _TWELVE_FULL)),
        _values(t, scaling.torque, _TWELVE_FULL),
    )


def encode_feedback(feedback: Feedback, scaling: Scaling) -> Bytes:
    """Return feedback frames (..., n, 8) as a motor sends them: truncated and saturated."""
    fields = (feedback.position, feedback.velocity, feedback.torque)
    values = np.array(np.broadcast_arrays(*fields))
    p, v, t = _codes(values, scaling, _MEASURED, 0.0)
    head = (np.asarray(feedback.status) << 4) | (np.asarray(feedback.can_id) & 0xF)
    hot = np.asarray(feedback.temperature_mos), np.asarray(feedback.temperature_rotor)
    return _pack(p.shape, head, p >> 8, p, v >> 4, (v << 4) | (t >> 8), t, *hot)


def decode_feedback(frames: Bytes, scaling: Scaling, half_step: bool = False) -> Feedback:
    """Return what feedback frames (..., n, 8) say.

    The motor drops the fraction when it packs a value, so what arrives is on average half a
    quantisation step too low; ``half_step`` adds it to position, velocity and torque.
    """
    d = np.asarray(frames, dtype=np.int64)
    shift = 0.5 if half_step else 0.0
    p = ((d[..., 1] << 8) | d[..., 2]) + shift
    v = ((d[..., 3] << 4) | (d[..., 4] >> 4)) + shift
    t = (((d[..., 4] & 0xF) << 8) | d[..., 5]) + shift
    return Feedback(
        d[..., 0] & 0xF,
        d[..., 0] >> 4,
        _values(p, scaling.position, _POSITION_FULL),
        _values(v, scaling.velocity, _TWELVE_FULL),
        _values(t, scaling.torque, _TWELVE_FULL),
        d[..., 6],
        d[..., 7],
    )


def _ranges(scaling: Scaling, rows: Any, dimensions: int) -> tuple[Array, Array, Array]:
    """Return (low, high, full) of some fields, shaped to broadcast with (fields, ..., n)."""
    low, high = scaling._low[rows], scaling._high[rows]
    shape = (len(low), *[1] * (dimensions - 2))
    full = _FULL[rows].reshape(*shape, 1)
    return low.reshape(*shape, -1), high.reshape(*shape, -1), full


def _refuse_outside(values: Array, scaling: Scaling) -> None:
    low, high, _ = _ranges(scaling, slice(None), values.ndim)
    slack = _FLOAT32_SLACK * high
    # Written so that a NaN counts as outside.
    outside = ~((values >= low - slack) & (values <= high + slack))
    if np.any(outside):
        where = np.argwhere(outside)[0]
        bad, limit = values[tuple(where)], np.broadcast_to(high, values.shape)[tuple(where)]
        raise InputError(
            f"{MitCommand._fields[where[0]]} {bad:g} {_place(outside)} is outside its range, "
            f"limit {limit:g}"
        )


def _codes(values: Array, scaling: Scaling, rows: Any, offset: float) -> Codes:
    """Return floor(code + offset) of (fields, ..., n) values, saturated."""
    low, high, full = _ranges(scaling, rows, values.ndim)
    exact = (values - low) * (full / (high - low)) + offset
    return np.clip(np.floor(exact), 0, full).astype(np.int64)


def _values(codes: Any, limit: Array, full: int) -> Array:
    return np.asarray(codes * (2.0 * limit / full) - limit)


def _pack(shape: tuple[int, ...], *columns: Any) -> Bytes:
    frames = np.empty((*shape, 8), dtype=np.uint8)
    for k, column in enumerate(columns):
        frames[..., k] = column & 0xFF
    return frames


def _place(mask: Any) -> str:
    """Say which of the motors, base to terminal, is the first in a mask."""
    return f"of motor number {int(np.argwhere(np.atleast_1d(mask))[0][-1]) + 1}"
