"""What may go wrong with a motor or an arm in the middle of a run, as causes for ``fault_bench``.

A cause is called with the run at the moment at which the fault begins.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigs.damaged_links import Damage
from rigs.damiao_rig import motor
from robot_sysid.damiao import protocol
from robot_sysid.damiao.protocol import ENABLED

_FOREIGN_PERIOD = 0.01
UNDER_VOLTAGE = 0x9
OVER_CURRENT = 0xA


@dataclass(frozen=True)
class DamagedFrame:
    """One feedback frame is damaged."""

    damage: Damage

    @property
    def joint(self):
        """The joint whose frame it is."""
        return self.damage.joint

    def __call__(self, run):
        run.link.damage = self.damage


@dataclass(frozen=True)
class Setting:
    """Values of a joint change: attributes of its motor, or what the arm has for each joint."""

    joint: int
    values: dict[str, float]

    def __call__(self, run):
        for name, value in self.values.items():
            if hasattr(run.motors[self.joint], name):
                setattr(run.motors[self.joint], name, value)
            else:
                getattr(run.arm, name)[self.joint] = value


def setting(joint, **values):
    """Return the cause that gives a joint these values."""
    return Setting(joint, values)


def lost_motor(joint):
    """Return the cause of a motor without supply: it is silent, and its windings are open."""
    return setting(joint, silent=True, brake=0.0, torque_share=0.0)


@dataclass(frozen=True)
class FailedMotor:
    """A motor reports a fault and leaves the enabled state."""

    joint: int
    status: int = OVER_CURRENT

    def __call__(self, run):
        run.motors[self.joint].fail(self.status)


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
        twin = motor(run.motors[self.joint].joint)
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
        run.link.send_foreign(protocol.CanFrame(joint.can_id, data), self.is_seen)
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
class SaggingSupply:
    """The supply of all motors sags to 40 % within a second; after two, one reports it."""

    joint: int

    def __call__(self, run):
        run.arm.supply_rate = 0.6
        run.at(2.0, lambda: run.motors[self.joint].fail(UNDER_VOLTAGE))


def grip_mass(run):
    """The terminal link takes up 3 kg."""
    run.arm.grip(3.0)


def push(run):
    """Somebody pushes the terminal link sideways, with 60 N for 0.3 s."""
    run.arm.push = np.array([0.0, 36.0, -48.0])
    run.at(0.3, lambda: setattr(run.arm, "push", None))
