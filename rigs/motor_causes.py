"""What may go wrong with a motor or an arm in the middle of a run, as causes for ``fault_bench``.

A cause is called with the run at the moment at which the fault begins.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigs.damaged_links import Damage
from rigs.faulty_arm import JAM_DAMPING, bench_motor
from robot_sysid.damiao import protocol
from robot_sysid.damiao.protocol import ENABLED

_FOREIGN_PERIOD = 0.01
UNDER_VOLTAGE = 0x9
OVER_CURRENT = 0xA


@dataclass(frozen=True)
class DamagedFrame:
    """One feedback frame is damaged."""

    damage: Damage

    def __call__(self, run):
        run.link.damage = self.damage


@dataclass(frozen=True)
class WeakMotor:
    """A motor delivers a share of the torque that it makes by its own account, or reports it."""

    joint: int
    share: float
    is_reported: bool = False

    def __call__(self, run):
        run.arm.torque_share[self.joint] = self.share
        run.arm.share_is_reported[self.joint] = self.is_reported


@dataclass(frozen=True)
class LostMotor:
    """A motor loses its supply: it is silent, and its windings are open."""

    joint: int

    def __call__(self, run):
        motor = run.motors[self.joint]
        motor.silent = True
        motor.brake = 0.0
        run.arm.torque_share[self.joint] = 0.0


@dataclass(frozen=True)
class FailedMotor:
    """A motor reports a fault and leaves the enabled state."""

    joint: int
    status: int = OVER_CURRENT

    def __call__(self, run):
        run.motors[self.joint].fail(self.status)


@dataclass(frozen=True)
class MovedZero:
    """A motor's zero is elsewhere than the joint map says, by an angle [rad]."""

    joint: int
    angle: float

    def __call__(self, run):
        run.arm.encoder_error[self.joint] = self.angle


@dataclass(frozen=True)
class SecondMotor:
    """Another motor with the same id comes alive, elsewhere by an angle [rad].

    It answers before the first one, or after it.
    """

    joint: int
    angle: float
    status: int = ENABLED
    is_first: bool = True

    def __call__(self, run):
        twin = bench_motor(run.motors[self.joint].joint)
        twin.status = self.status
        twin.position = run.motors[self.joint].position + self.angle
        # Its watchdog has heard something just now.
        twin.fed_at = run.clock.now()
        twin.answers_first = self.is_first
        run.arm.motors.append(twin)


@dataclass(frozen=True)
class SecondMaster:
    """Another computer commands one motor to a place an angle [rad] away, 100 times a second."""

    joint: int
    angle: float
    is_seen: bool
    kp: float = 60.0

    def __call__(self, run):
        self._send(run, run.arm.mechanism.q[self.joint] + self.angle)

    def _send(self, run, target):
        joint = run.motors[self.joint].joint
        fields = (np.array([value]) for value in (target, 0.0, self.kp, 1.0, 0.0))
        scaling = protocol.Scaling([joint.spec.limits])
        data = protocol.encode_mit(protocol.MitCommand(*fields), scaling)[0].tobytes()
        run.link.send_foreign(protocol.Frame(joint.can_id, data), self.is_seen)
        run.at(_FOREIGN_PERIOD, lambda: self._send(run, target))


@dataclass(frozen=True)
class FrozenEncoder:
    """An encoder's position stays as it is, with no speed; for the servo too, or for answers."""

    joint: int
    is_in_servo: bool = True

    def __call__(self, run):
        position = run.arm.mechanism.q[self.joint]
        if self.is_in_servo:
            run.arm.frozen_encoder[self.joint] = position
        else:
            run.motors[self.joint].frozen_position = position


@dataclass(frozen=True)
class SlippingGear:
    """Encoder and joint drift apart [rad/s]; the speed reported is the encoder's or the joint's."""

    joint: int
    rate: float = 0.3
    is_felt: bool = True

    def __call__(self, run):
        run.arm.slip_rate[self.joint] = self.rate
        run.arm.slip_is_felt[self.joint] = self.is_felt


@dataclass(frozen=True)
class MotorSetting:
    """Something about a motor's answers changes: an attribute of ``BenchMotor`` gets a value."""

    joint: int
    attribute: str
    value: float

    def __call__(self, run):
        setattr(run.motors[self.joint], self.attribute, self.value)


@dataclass(frozen=True)
class SaggingSupply:
    """The supply of all motors sags to 40 % within a second; after two, one reports it."""

    joint: int

    def __call__(self, run):
        run.arm.supply_rate = 0.6
        run.at(2.0, lambda: run.motors[self.joint].fail(UNDER_VOLTAGE))


@dataclass(frozen=True)
class GrippedMass:
    """The terminal link takes up a mass [kg]."""

    mass: float = 3.0

    def __call__(self, run):
        run.arm.grip(self.mass)


@dataclass(frozen=True)
class Push:
    """Somebody pushes the terminal link sideways, with a force [N] for a time [s]."""

    force: float = 60.0
    duration: float = 0.3

    def __call__(self, run):
        run.arm.push = self.force * np.array([0.0, 0.6, -0.8])
        run.at(self.duration, lambda: setattr(run.arm, "push", None))


@dataclass(frozen=True)
class JammedJoint:
    """Something holds a joint."""

    joint: int

    def __call__(self, run):
        run.arm.jam_damping[self.joint] = JAM_DAMPING


def joint_of(cause):
    """Return the joint at fault of a cause, or None."""
    if isinstance(cause, DamagedFrame):
        return cause.damage.joint
    return getattr(cause, "joint", None)
