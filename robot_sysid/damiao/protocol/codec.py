"""Packing and unpacking of MIT command and feedback frames, for all joints at once.

MIT command, 64 bits, most significant first: position 16, velocity 12, kp 12, kd 12, torque 12.
Feedback: status 4, id 4, position 16, velocity 12, torque 12, two temperature bytes. A quantity in
[lo, hi] is the integer u = (x - lo) (2^bits - 1) / (hi - lo): no code stands for exactly zero.

Arrays are (..., n): any leading shape, n joints last; frames are (..., n, 8) bytes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records import Array

Bytes = NDArray[np.uint8]
Codes = NDArray[np.int64]

KP_MAX = 500.0
KD_MAX = 5.0
KD_STEP = KD_MAX / 0xFFF
"""The least damping that a frame can carry [N m s/rad]."""
# A register holds float32: 12.566 comes back as 12.5659999..., which must not refuse 12.566.
_FLOAT32_SLACK = 1e-6
_HAS_SIGN = np.array([-1.0, -1.0, 0.0, 0.0, -1.0])
# Position, velocity and torque among the fields of a command.
_MEASURED = [0, 1, 4]


class _Layout:
    """What the 64 bits of a frame hold: F fields, the most significant first."""

    def __init__(self, *bits: int) -> None:
        self.full = (1 << np.array(bits)) - 1
        self._shifts = 64 - np.cumsum(bits)

    def pack(self, fields: Codes) -> Bytes:
        """Return frames (..., n, 8) of fields (..., n, F), of which the lowest bits count."""
        words = np.bitwise_or.reduce((fields & self.full) << self._shifts, axis=-1)
        return words.astype(">i8")[..., None].view(np.uint8)

    def unpack(self, frames: Bytes) -> Codes:
        """Return the fields (..., n, F) of frames (..., n, 8)."""
        words = (
            np.ascontiguousarray(frames, dtype=np.uint8).view(">i8").astype(np.int64)
        )
        return np.asarray((words >> self._shifts) & self.full)


_COMMAND = _Layout(16, 12, 12, 12, 12)
_FEEDBACK = _Layout(4, 4, 16, 12, 12, 8, 8)


@dataclass(frozen=True, init=False)
class Scaling:
    """What the integers in each joint's frames mean.

    ``limits`` are the PMAX [rad], VMAX [rad/s] and TMAX [N m] (n, 3) of n joints.
    """

    limits: Array
    # Ranges (n, 5) of the command's fields: position, velocity, kp, kd, torque.
    _low: Array
    _high: Array

    def __init__(self, limits: Iterable[Sequence[float]]) -> None:
        table = np.array(list(limits), dtype=float).reshape(-1, 3)
        for name, value in zip(("position", "velocity", "torque"), table.T):
            if not np.all(np.isfinite(value) & (value > 0.0)):
                raise InputError(
                    f"{name} scaling must be positive numbers, got {value.tolist()}"
                )
        high = np.insert(table, [2, 2], (KP_MAX, KD_MAX), axis=1)
        vars(self).update(limits=table, _low=high * _HAS_SIGN, _high=high)

    @property
    def steps(self) -> tuple[Array, Array, Array]:
        """One quantisation step (n,) of position [rad], velocity [rad/s] and torque [N m]."""
        position, velocity, torque = ((self._high - self._low) / _COMMAND.full).T[
            _MEASURED
        ]
        return position, velocity, torque

    def _codes(self, values: Array, offset: float, rows: Any = slice(None)) -> Codes:
        """Return floor(code + offset) of values (..., n, F) of some fields, saturated."""
        low = self._low[:, rows]
        high = self._high[:, rows]
        full = _COMMAND.full[rows]
        exact = (values - low) * (full / (high - low)) + offset
        return np.clip(np.floor(exact), 0, full).astype(np.int64)

    def _values(self, codes: Any, rows: Any = slice(None)) -> Array:
        """Return what codes (..., n, F) of some fields mean, as (F, ..., n)."""
        low = self._low[:, rows]
        high = self._high[:, rows]
        full = _COMMAND.full[rows]
        return np.moveaxis(codes * ((high - low) / full) + low, -1, 0)

    def _refuse_outside(self, values: Array) -> None:
        room = _FLOAT32_SLACK * self._high
        # Written so that a NaN counts as outside.
        beyond = np.moveaxis(
            ~((values >= self._low - room) & (values <= self._high + room)), -1, 0
        )
        for where in np.argwhere(beyond)[:1]:
            what = where[0]
            bad = np.moveaxis(values, -1, 0)[tuple(where)]
            raise InputError(
                f"{MitCommand._fields[what]} {bad:g} {_place(beyond)} is outside its range, "
                f"limit {self._high[where[-1], what]:g}"
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
        position, velocity, kp, kd, torque = self
        return np.asarray(kp * (position - q) + kd * (velocity - qd) + torque)


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
    values = _last_axis(*command)
    scaling._refuse_outside(values)
    # floor(x + 1/2): numpy's rint rounds halves to even, which differs in the last bit.
    codes = scaling._codes(values, 0.5)
    unstable = (values[..., 2] > 0.0) & (codes[..., 3] == 0)
    if np.any(unstable):
        raise InputError(
            f"kp > 0 needs kd of at least {KD_STEP:.2g} {_place(unstable)}: less is sent as 0"
        )
    frames = _COMMAND.pack(codes)
    special = np.all(frames[..., :7] == 0xFF, axis=-1)
    if np.any(special):
        raise InputError(
            f"the command {_place(special)} has every field at its maximum and "
            "would read as a special frame; lower its gains or torque"
        )
    return frames


def decode_mit(frames: Bytes, scaling: Scaling) -> MitCommand:
    """Return what MIT frames (..., n, 8) command; the motor's side of ``encode_mit``."""
    return MitCommand(*scaling._values(_COMMAND.unpack(frames)))


def encode_feedback(feedback: Feedback, scaling: Scaling) -> Bytes:
    """Return feedback frames (..., n, 8) as a motor sends them: truncated and saturated."""
    measured = _last_axis(feedback.position, feedback.velocity, feedback.torque)
    codes = np.moveaxis(scaling._codes(measured, 0.0, _MEASURED), -1, 0)
    hot = feedback.temperature_mos, feedback.temperature_rotor
    return _FEEDBACK.pack(_last_axis(feedback.status, feedback.can_id, *codes, *hot))


def decode_feedback(
    frames: Bytes, scaling: Scaling, half_step: bool = False
) -> Feedback:
    """Return what feedback frames (..., n, 8) say.

    The motor drops the fraction when it packs a value, so what arrives is on average half a
    quantisation step too low; ``half_step`` adds it to position, velocity and torque.
    """
    codes = _FEEDBACK.unpack(frames)
    p, v, t = scaling._values(codes[..., 2:5] + (0.5 if half_step else 0.0), _MEASURED)
    status, can_id, *_, mos, rotor = np.moveaxis(codes, -1, 0)
    return Feedback(can_id, status, p, v, t, mos, rotor)


def _last_axis(*fields: Any) -> Any:
    return np.stack(np.broadcast_arrays(*fields), axis=-1)


def _place(mask: Any) -> str:
    return f"of motor number {int(np.argwhere(np.atleast_1d(mask))[0][-1]) + 1}"
