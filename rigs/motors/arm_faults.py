"""What may go wrong with an arm of ``rigs.motors.sound_arms``: faults that happen at a moment.

They are no rows of ``rigs.motors.incidents``: these arms and motors are a witness that shares no
code with the package and its simulated motors, so that a fault is something else there. What comes
of them ``benchmarks/motors/motor_differences.py`` prints.
"""

from __future__ import annotations

import math
from functools import partial

from rigs.motors.sound_runs import ArmFault

ONSET = 1.5
"""When a fault happens, after the motion has begun [s]."""
FADED_SHARE = 0.5
FADING_TIME = 5.0
"""To which share torque fades, and in which time [s]."""
REBOOT_TIME = 8e-3
"""How long a motor is silent that starts again [s]."""
ODD_STATUS = 3
ODD_EVERY = 10


def change_motor(name, joint, after=ONSET, **values):
    """Return the fault that gives attributes of a joint's motor other values."""

    def act(arm):
        for attribute, value in values.items():
            assert hasattr(arm.motors[joint], attribute), attribute
            setattr(arm.motors[joint], attribute, value)

    return ArmFault(name, act, after, joint)


def shift_report(joint, size, after=ONSET):
    """Return the fault that a joint reports a position too large [rad]; its loop works."""
    return change_motor(
        f"reports {size:g} rad too much", joint, after, report_shift=size
    )


def shift_encoder(joint, size, after=ONSET):
    """Return the fault that the encoder jumps, which the motor's loop uses too [rad]."""

    def act(arm):
        arm.motors[joint].encoder_shift += size

    return ArmFault(f"encoder jumps by {size:g} rad", act, after, joint)


def drift_encoder(joint, rate, is_felt, after=ONSET):
    """Return the fault that the encoder drifts [rad/s], with its velocity feeling it or not."""
    name = f"encoder drifts by {rate:g} rad/s, {'felt' if is_felt else 'not felt'}"
    return change_motor(name, joint, after, drift_rate=rate, drift_is_felt=is_felt)


def weaken(joint, share, after=ONSET):
    """Return the fault that a motor makes another torque than it says, by a factor."""

    def act(arm):
        arm.motors[joint].torque_share *= share

    return ArmFault(f"torque times {share:g}", act, after, joint)


def weaken_all(share, after=ONSET):
    """Return the fault that all motors make another torque than they say, by a factor."""

    def act(arm):
        for motor in arm.motors:
            motor.torque_share *= share

    return ArmFault(f"torque of all motors times {share:g}", act, after)


def fade_all(after=ONSET):
    """Return the fault that the torque of all motors fades to half."""

    def act(arm):
        begin = arm.plant.time
        sound = [motor.torque_share for motor in arm.motors]

        def fade(time):
            done = min((time - begin) / FADING_TIME, 1.0)
            for motor, share in zip(arm.motors, sound):
                motor.torque_share = share * (1.0 - (1.0 - FADED_SHARE) * done)

        arm.every_step.append(fade)

    name = f"all motors fade to {FADED_SHARE:g} in {FADING_TIME:g} s"
    return ArmFault(name, act, after)


def pull(joint, torque, after=ONSET):
    """Return the fault that something pulls at a joint, as a cable does [N m]."""

    def act(arm):
        arm.plant.external[joint] = torque

    return ArmFault(f"cable pulls with {torque:g} N·m", act, after, joint)


def drag(joint, torque, after=ONSET):
    """Return the fault that a brake drags at a joint [N m]."""

    def act(arm):
        arm.plant.brake[joint] = torque

    return ArmFault(f"brake drags with {torque:g} N·m", act, after, joint)


def tilt_base(degrees, after=None):
    """Return the fault that the base is tilted."""

    def act(arm):
        arm.plant.tilt(math.radians(degrees))

    return ArmFault(f"base is tilted by {degrees:g} degrees", act, after)


def loosen(joint, degrees, after=None):
    """Return the fault that there is backlash between motor and link."""
    name = f"backlash of {degrees:g} degrees"
    return change_motor(name, joint, after, gap=math.radians(degrees))


def drop_mass(mass, after=ONSET):
    """Return the fault that the arm drops what it has carried, of which no model knows [kg]."""

    def act(arm):
        arm.plant.carry(-mass)

    return ArmFault(f"drops {mass:g} kg", act, after, None, mass)


def restart_motor(joint, after=ONSET):
    """Return the fault that a motor starts again, and then is disabled."""

    def act(arm):
        arm.motors[joint].restart(arm.plant.time, REBOOT_TIME)

    return ArmFault("motor starts again", act, after, joint)


def table_faults(loaded, wrist):
    """Return a fault of each kind, at joints that gravity loads much and hardly.

    ``loaded`` is the number of a joint such as the shoulder, ``wrist`` that of one near the tip.
    """
    odd = {"odd_status": ODD_STATUS, "odd_every": ODD_EVERY}
    of_motor = partial(change_motor, joint=loaded)
    return [
        *(shift_report(loaded, size) for size in (0.7, 1.57, 3.14, 6.28)),
        weaken(loaded, 0.5),
        fade_all(),
        drift_encoder(loaded, 0.06, is_felt=True),
        drift_encoder(loaded, 0.06, is_felt=False),
        drift_encoder(wrist, 0.06, is_felt=True),
        pull(loaded, 4.5),
        pull(loaded, 13.5),
        pull(wrist, 4.5),
        tilt_base(20.0),
        weaken_all(1.3, after=None),
        weaken_all(0.7, after=None),
        weaken(loaded, 1.3, after=None),
        weaken(loaded, 0.7, after=None),
        of_motor("torque reads 1.3 times too much", after=None, torque_reading=1.3),
        of_motor("kd is ignored", after=None, kd_share=0.0),
        of_motor("kp is ignored", kp_share=0.0),
        drop_mass(0.7),
        drag(loaded, 4.0),
        loosen(loaded, 3.0),
        of_motor("encoder scale 1.05", after=None, encoder_scale=1.05),
        _other_torque_limit(loaded, 1.5),
        of_motor("status 3 in every tenth answer", **odd),
        restart_motor(loaded),
    ]


def _other_torque_limit(joint, factor):
    """Return the fault that a motor packs torque by another TMAX than its register says."""

    def act(arm):
        motor = arm.motors[joint]
        motor.true_torque_limit = factor * motor.limits[2]

    return ArmFault(f"TMAX is {factor:g} times the register's", act, None, joint)
