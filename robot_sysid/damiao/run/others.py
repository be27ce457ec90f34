"""Motors on the bus that no joint of the trajectory has: a gripper, the other arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robot_sysid.damiao.bus.inspection import InspectedMotor, Inspection
from robot_sysid.damiao.exchange.settings import PlaySettings
from robot_sysid.damiao.play.sampler import Reference, ReferenceFunction
from robot_sysid.damiao.protocol.bus_load import BusTiming
from robot_sysid.damiao.protocol.joints import DamiaoJoint
from robot_sysid.damiao.protocol.motors import matching_types
from robot_sysid.records import Array


def other_motors(
    inspection: Inspection, joints: Sequence[DamiaoJoint]
) -> tuple[InspectedMotor, ...]:
    """Return the motors that answer but drive no joint of these."""
    known = {joint.address for joint in joints}
    return tuple(m for address, m in sorted(inspection.motors.items()) if address not in known)


def held_joint(motor: InspectedMotor) -> DamiaoJoint | None:
    """Return a motor as one that can be held where it is; None where its type is not known."""
    types = matching_types(motor.limits) if motor.limits else ()
    if not types:
        return None
    bus, can_id = motor.address
    return DamiaoJoint(types[0], can_id, motor.master_id, "", bus, motor.channel)


def with_held(
    settings: PlaySettings, held: Sequence[DamiaoJoint], timing: BusTiming
) -> PlaySettings:
    """Return settings with gains for the held motors behind those of the trajectory's joints."""
    usual = PlaySettings(rate=settings.rate).for_motors([j.spec for j in held], timing)
    return replace(
        settings,
        kp=(*settings.kp, *usual.kp),
        kd=(*settings.kd, *usual.kd),
        max_torque_error=(*settings.max_torque_error, *usual.max_torque_error),
    )


def alongside(reference: ReferenceFunction, positions: Array) -> ReferenceFunction:
    """Return a reference that also holds further motors at positions (m,) [rad]."""
    still = np.zeros_like(positions)

    def both(time: float) -> Reference:
        parts = zip(reference(time), (positions, still, still))
        return Reference(*(np.concatenate(pair) for pair in parts))

    return both
