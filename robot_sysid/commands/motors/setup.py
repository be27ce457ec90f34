"""``robot-sysid motors setup|monitor``: change one motor, or watch all.

Setup changes ids, mode and watchdog, and clears an error: each by an option of its own, for one
motor, while it is disabled; each step prints the old value and reads the new one back. No run on
motors does any of this.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Optional

import numpy as np

from robot_sysid.commands.motors.following import step_with_motors
from robot_sysid.commands.motors.session import Session, motor_table
from robot_sysid.damiao.adapters import BusAddress
from robot_sysid.damiao.bus import (
    GuardedLink,
    InspectedMotor,
    RegisterClient,
    inspect_bus,
)
from robot_sysid.damiao.joints import id_problems
from robot_sysid.damiao.protocol import (
    CLEAR_ERROR,
    ENABLED,
    MIT_MODE,
    STORE,
    TIMEOUT_UNIT,
    Register,
    is_fault,
    is_motion,
    register_frame,
    register_text,
    special_frame,
    status_text,
)
from robot_sysid.errors import HardwareAbort, InputError, SysidError
from robot_sysid.records.option_fields import OptionRecord, given_values, option

STORING_TIME = 0.05
"""Time that a motor is left alone to write its flash memory [s]: longer than it takes (a
judgement)."""


@dataclass(frozen=True)
class SetupOptions(OptionRecord):
    """Changes of one motor by ``motors setup``; without any, the motors are listed."""

    motor: Optional[int] = option(None, "CAN id of the motor to change", "ID")
    new_id: Optional[int] = option(None, "new CAN id", "ID")
    new_master_id: Optional[int] = option(None, "new id it answers on", "ID")
    mit: bool = option(False, "set the control mode to MIT")
    watchdog: Optional[float] = option(
        None, "set its watchdog, 0 for none", "S [s] >= 0"
    )
    clear_error: bool = option(False, "clear its error, once you know its cause")
    store: bool = option(False, "keep the changes when the power goes off")


@dataclass(frozen=True)
class MonitorOptions(OptionRecord):
    """Options of ``motors monitor``, which goes on until Ctrl-C without ``lifetime``."""

    lifetime: Optional[float] = option(
        None, "end after this time", "S [s] > 0", flag="--for", default_text="Ctrl-C"
    )

    interval: float = option(1.0, "time between two looks", "S [s] > 0", flag="--every")


def list_motors(session: Session, link: GuardedLink) -> Mapping[int, InspectedMotor]:
    """Return the motors on a bus by CAN ids, and print them; SysidError where none answers."""
    motors = inspect_bus(link).motors
    if not motors:
        address = session.options.address
        hint = ""
        if address.interface == BusAddress.interface:
            hint = (
                f"; ip -details link show {address.channel} says whether the bus lives"
            )
        raise SysidError(f"no motor answers: check power, wiring and bit rate{hint}")
    session.console.stage(*motor_table(motors.values()))
    return motors


def setup(session: Session, options: SetupOptions) -> int:
    """List the motors on a bus, change one of them if the options say so; return the exit code 0.

    Errors are those of ``change_motor``, ``list_motors`` and ``_motor_to_change``, and InputError
    for a change without --motor.
    """
    changes = given_values(options).keys() - {"motor"}
    if changes and options.motor is None:
        raise InputError("--motor says which motor to change, for instance --motor 1")
    # A model that cannot be read is refused before a motor is changed.
    session.options.require_model()
    robot = session.robot
    with session.open_guarded(is_motion) as link:
        motors = list_motors(session, link)
        done = f"motors that answer: {len(motors)}"
        if changes:
            motor = _motor_to_change(motors, options)
            for line in change_motor(link, motor, options):
                session.console.stage(line)
            done = f"{motor.name} is changed"
            motors = {**motors, options.new_id or motor.can_id: motor}
    step = step_with_motors(session, robot, motors)
    if changes - {"clear_error"} and not options.store:
        done += ", and forgets it when its power goes off"
        store = "--motor", str(options.new_id or options.motor), "--store"
        step = session.step_to("setup", "Next, let it keep the changes", *store)
    session.conclude(f"Done: {done}", step)
    return 0


def change_motor(
    link: GuardedLink, motor: InspectedMotor, options: SetupOptions
) -> Iterator[str]:
    """Change registers and error of a motor, so that it stays reachable; yield a line for each.

    Args:
        link: link of the motor's bus that lets configuration frames pass.
        motor: the motor, as inspected.
        options: what to change.

    Raises:
        HardwareAbort: the motor refuses, does not answer any more, or is enabled.
        InputError: a value does not fit into its register.
    """
    client = RegisterClient(link)
    ids = {Register.MST_ID: motor.master_id, Register.ESC_ID: motor.can_id}

    def require_disabled() -> int:
        """Return the status code, which is the upper half of the first byte of feedback."""
        frame = client.refresh(ids[Register.ESC_ID], ids[Register.MST_ID])
        if frame is None:
            raise HardwareAbort(
                f"{motor.name} does not tell its state; nothing more is done"
            )
        status = frame.data[0] >> 4
        if status == ENABLED:
            raise HardwareAbort(
                f"{motor.name} is enabled; end the program that uses it, nothing more is done"
            )
        return status

    status = require_disabled()
    if options.clear_error:
        link.send(special_frame(CLEAR_ERROR, motor.can_id))
        text = status_text(status)
        status = require_disabled()
        if is_fault(status):
            raise HardwareAbort(f"{motor.name} still reports {status_text(status)}")
        yield f"{motor.name}: {text} is now {status_text(status)}"
    watchdog = options.watchdog
    values = {
        Register.CTRL_MODE: MIT_MODE if options.mit else None,
        Register.TIMEOUT: watchdog and round(watchdog / TIMEOUT_UNIT),
        Register.MST_ID: options.new_master_id,
        Register.ESC_ID: options.new_id,
    }
    for register, value in values.items():
        if value is None:
            continue
        require_disabled()
        client.write(ids[Register.ESC_ID], register, value)
        if register in ids:
            ids[register] = int(value)
        old = register_text(register, motor.registers.get(register, np.nan))
        yield f"{motor.name}: {old} is now {register_text(register, value)}"
    if options.store:
        require_disabled()
        link.send(register_frame(STORE, ids[Register.ESC_ID], register=1))
        link.clock.sleep_until(link.clock.now() + STORING_TIME)
        yield f"{motor.name} keeps its values when the power goes off"


def _motor_to_change(
    motors: Mapping[int, InspectedMotor], options: SetupOptions
) -> InspectedMotor:
    """Return the motor that the options name, of all motors by their CAN ids.

    Raises:
        HardwareAbort: no motor, or more than one, has that id.
        InputError: its new ids would clash with other motors.
    """
    motor = motors.get(options.motor or 0)
    if motor is None or len(motor.reply_ids) != 1:
        raise HardwareAbort(
            f"no motor answers to CAN id {options.motor}, or several share it: leave one motor on "
            "the bus"
        )
    ids = motor.can_id, motor.master_id
    new_master = options.new_master_id
    new_ids = options.new_id or ids[0], ids[1] if new_master is None else new_master
    # Alone, and beside each other motor: ids that clash already may be put right one by one.
    beside = [[(m.can_id, m.master_id)] for m in motors.values() if m is not motor]
    for other in ([], *beside):
        old_problems = [*id_problems([ids, *other])]
        for problem in id_problems([new_ids, *other]):
            if problem not in old_problems:
                raise InputError(f"nothing was changed: {problem}")
    return motor


def monitor(session: Session, options: MonitorOptions) -> int:
    """Print the motors' states at every interval, without enabling them; return the exit code 0.

    It ends with Ctrl-C or after the lifetime of the options. SysidError where no motor answers.
    """
    with session.open_guarded(is_motion) as link:
        client = RegisterClient(link)
        motors = list_motors(session, link).values()
        last = link.clock.now() + (options.lifetime or np.inf) - options.interval
        with contextlib.suppress(KeyboardInterrupt):
            while link.clock.now() < last:
                link.clock.sleep_until(link.clock.now() + options.interval)
                states = [replace(m, feedback=client.state_of(m)) for m in motors]
                session.console.stage(*motor_table(states))
    return 0
