"""What motors answered in a control cycle, and which of these answers are believed.

Serial adapters have no checksum between the bus and the computer, so one damaged character makes a
position radians wrong or a healthy motor faulty. A sample is believed when it follows from the last
believed one: how far the joint came agrees with its speeds, the speed changed no faster than a
motor can change it, and the reported torque changed as the command did. One that does not follow is
set aside; nothing uses it. When the next one follows from it, both were true: that is a finding.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot_sysid.damiao.protocol import codec
from robot_sysid.damiao.protocol.frames import ENABLED
from robot_sysid.records import Array

NO_STATUS = -1
Mask = NDArray[np.bool_]
Counts = NDArray[np.int64]

# What joints do at most from one sample to the next, beside going on as they were: judgements
# [rad, rad/s^2, share]. 200 rad/s^2 is 7 N m (a DM4310) on a light 0.035 kg m^2; a slip of 0.15 rad
# has to be seen.
_LEAST_JUMP = 0.05
_TOP_ACCELERATION = 200.0
_SPEED_DOUBT = 0.5
# A blow or a stop within one cycle of 4 ms takes this much speed at least [rad/s].
_LEAST_SPEED_CHANGE = 1.0
# Of the peak torque: how far a reported torque changes beside the command's own change.
_TORQUE_DOUBT = 0.3
# Windings warm up by a degree in seconds [deg C].
_HEAT_CHANGE = 5.0


@dataclass(frozen=True)
class Replies:
    """What came back in one cycle; status -1 and NaN values where a joint has no believed answer.

    Attributes:
        answered: (n,) joints whose answer came in time and is believed.
        time: (n,) when each joint took its sample, in the link's clock [s]: when its command was on
            the bus where the adapter reports that, else when the reply arrived.
        feedback: what the joints answered, each (n,), in joint space.
        asked: (n,) joints that were sent something.
        command: what each joint is under now, as the motors read it.
        doubted: (n,) joints whose answer came but was set aside.
        jump: (n,) how far a joint's position jumped, as two samples in a row say; else 0 [rad].
        surplus: (n,) answers beyond the one that was due.
        foreign: (n,) commands to this joint's motor that another program sent.
    """

    answered: Mask
    time: Array
    feedback: codec.Feedback
    asked: Mask
    command: codec.MitCommand | None = None
    doubted: Mask = field(default_factory=lambda: np.zeros(0, dtype=bool))
    jump: Array = field(default_factory=lambda: np.zeros(0))
    surplus: Counts = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    foreign: Counts = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __post_init__(self) -> None:
        n_joints = len(self.answered)
        for name, dtype in (
            ("doubted", bool),
            ("jump", float),
            ("surplus", int),
            ("foreign", int),
        ):
            if len(getattr(self, name)) != n_joints:
                object.__setattr__(self, name, np.zeros(n_joints, dtype=dtype))


@dataclass(frozen=True)
class _Samples:
    """One sample per joint, each (n,), with the torque it should report by the command in force."""

    time: Array
    q: Array
    qd: Array
    torque_error: Array
    enabled: Mask
    heat: Array

    def where(self, selected: Mask, other: _Samples) -> _Samples:
        """Return these samples for the joints ``selected`` (n,), and others for the rest."""
        names = vars(self)
        pairs = {name: (getattr(self, name), getattr(other, name)) for name in names}
        return _Samples(
            **{name: np.where(selected, *pair) for name, pair in pairs.items()}
        )


class _Change(NamedTuple):
    """What joints (n,) did between two samples: whether a position or a torque error changed more
    than it can, and whether all is plausible.
    """

    jumps: Mask
    bends: Mask
    is_plausible: Mask


class SampleFilter:
    """Decides which answers of n motors are believed, and keeps the last believed ones.

    Args:
        peak_torque: (n,) of each joint [N m].
        velocity_step: (n,) one quantisation step of each joint's velocity [rad/s].
    """

    def __init__(self, peak_torque: Array, velocity_step: Array) -> None:
        self._peak = peak_torque
        self._velocity_step = velocity_step
        n_joints = len(peak_torque)
        unknown = np.full(n_joints, np.nan)
        enabled = np.ones(n_joints, dtype=bool)
        self._last = _Samples(unknown, unknown, unknown, unknown, enabled, unknown)
        self._suspect = self._last
        self._is_suspected = np.zeros(n_joints, dtype=bool)

    @property
    def q(self) -> Array:
        """Last believed positions (n,) [rad]."""
        return self._last.q

    @property
    def qd(self) -> Array:
        """Last believed velocities (n,) [rad/s]."""
        return self._last.qd

    def start(self, time: float, q: Array) -> None:
        """Begin with an arm that stands at q (n,) [rad]."""
        zero_speed = np.zeros_like(q)
        self._last = replace(
            self._last, time=zero_speed + time, q=q.copy(), qd=zero_speed
        )

    def believe(self, replies: Replies, acted: codec.MitCommand | None) -> Replies:
        """Return replies without the answers that are not believed.

        ``acted`` is the command in force when the samples were taken.
        """
        feedback = replies.feedback
        q = feedback.position
        qd = feedback.velocity
        tau = feedback.torque
        expected = tau if acted is None else acted.motor_torque(q, qd)
        error = tau - np.clip(expected, -self._peak, self._peak)
        heat = np.maximum(feedback.temperature_mos, feedback.temperature_rotor).astype(
            float
        )
        now = _Samples(replies.time, q, qd, error, feedback.status == ENABLED, heat)
        came = replies.answered
        change = self._compare(self._last, now)
        follows = change.is_plausible & (now.enabled | ~self._last.enabled)
        repeated = self._compare(self._suspect, now).is_plausible & self._is_suspected
        repeated &= now.enabled == self._suspect.enabled
        # A position that the motor's own control does not see is none, however often it comes; and
        # a motor that switches itself off does not jump.
        repeated &= ~(change.jumps & (change.bends | ~now.enabled))
        believed = came & (follows | repeated)
        jumped = believed & ~follows & change.jumps
        jump = np.where(jumped, q - self._last.q, 0.0)
        self._is_suspected = np.where(came, ~believed, self._is_suspected)
        self._suspect = now.where(came, self._suspect)
        self._last = now.where(believed, self._last)
        return _hide_doubted(replies, came & ~believed, np.nan_to_num(jump))

    def _compare(self, previous: _Samples, now: _Samples) -> _Change:
        """Return what is not plausible about samples after those previous.

        What is not known of the sample before is not compared.
        """
        passed = np.maximum(np.nan_to_num(now.time - previous.time), 0.0)
        expected_change = 0.5 * (now.qd + previous.qd) * passed
        distance = np.abs(now.q - previous.q - expected_change)
        accelerated = _TOP_ACCELERATION * passed
        tolerance = (
            _LEAST_JUMP
            + _SPEED_DOUBT * np.abs(expected_change)
            + 0.5 * accelerated * passed
        )
        jumps = distance > tolerance
        change = np.abs(now.qd - previous.qd)
        throws = change > _LEAST_SPEED_CHANGE + 4.0 * self._velocity_step + accelerated
        bends = (
            np.abs(now.torque_error - previous.torque_error)
            > _TORQUE_DOUBT * self._peak
        )
        heats = np.abs(now.heat - previous.heat) > _HEAT_CHANGE
        return _Change(jumps, bends, ~(jumps | throws | bends | heats))


def _hide_doubted(replies: Replies, doubted: Mask, jump: Array) -> Replies:
    feedback = replies.feedback
    hidden = replace(
        feedback,
        status=np.where(doubted, NO_STATUS, feedback.status),
        position=np.where(doubted, np.nan, feedback.position),
        velocity=np.where(doubted, np.nan, feedback.velocity),
        torque=np.where(doubted, np.nan, feedback.torque),
    )
    answered = replies.answered & ~doubted
    return replace(
        replies, answered=answered, feedback=hidden, doubted=doubted, jump=jump
    )
