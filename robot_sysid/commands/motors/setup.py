"""``robot-sysid motors setup|monitor``: change one motor, or watch all.

Setup changes ids, mode and watchdog, and clears an error: each by an option of its own, for one
motor, while it is disabled; each step prints the old value and reads the new one back. No run on
motors does any of this.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace

from robot_sysid.commands.motors.session import Session, motor_table
from robot_sysid.damiao.bus import (
    GuardedLink,
    InspectedMotor,
    Inspection,
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
from robot_sysid.errors import HardwareAbort, InputError
from robot_sysid.records.file_access import DAMIAO_NAME
from robot_sysid.records.messages import NextStep
from robot_sysid.records.option_fields import (
    OptionRecord,
    given_values,
    option,
    record_from,
)

# Verdict of a command that finds no motor.
_SILENT = ("Not usable: no motor answers: check power, wiring and bit rate",)


@dataclass(frozen=True)
class SetupOptions(OptionRecord):
    """Changes of one motor by ``motors setup``; without any, the motors are listed."""

    motor: int | None = option(None, "CAN id of the motor to change", "ID")
    new_id: int | None = option(None, "new CAN id", "ID")
    new_master_id: int | None = option(None, "new id it answers on", "ID")
    mit: bool = option(False, "set the control mode to MIT")
    watchdog: float | None = option(None, "set its watchdog, 0 for none", "S [s] >= 0")
    clear_error: bool = option(False, "clear its error, once you know its cause")
    store: bool = option(False, "keep the changes when the power goes off")


@dataclass(frozen=True)
class MonitorOptions(OptionRecord):
    """Options of ``motors monitor``, which goes on until Ctrl-C without ``lifetime``."""

    lifetime: float | None = option(
        None, "end after this time", "S [s] > 0", flag="--for", default_text="Ctrl-C"
    )

    interval: float = option(1.0, "time between two looks", "S [s] > 0", flag="--every")


class MotorSetup:
    """Changes registers and error of one motor, which has to be disabled.

    Args:
        link: link of the motor's bus that lets configuration frames pass.
        motor: the motor, as inspected.
    """

    def __init__(self, link: GuardedLink, motor: InspectedMotor) -> None:
        self._link = link
        self._client = RegisterClient(link)
        self._name = motor.name
        # Present ids of the motor.
        self._can_id = motor.can_id
        self._master_id = motor.master_id

    def apply(self, options: SetupOptions) -> Iterator[str]:
        """Make the changes, in an order in which the motor stays reachable; yield a line for each.

        HardwareAbort where the motor refuses, does not answer any more, or is enabled.
        """
        self._require_disabled()
        if options.clear_error:
            yield self._clear_error()
        ticks = None
        if options.watchdog is not None:
            ticks = round(options.watchdog / TIMEOUT_UNIT)
        values: dict[int, float | None] = {
            Register.CTRL_MODE: MIT_MODE if options.mit else None,
            Register.TIMEOUT: ticks,
            Register.MST_ID: options.new_master_id,
            Register.ESC_ID: options.new_id,
        }
        for register, value in values.items():
            if value is not None:
                yield self._write_register(register, value)
        if options.store:
            self._require_disabled()
            self._link.send(register_frame(STORE, self._can_id, register=1))
            # Longer than a motor takes to write its flash memory (a judgement).
            self._link.clock.sleep_until(self._link.clock.now() + 0.05)
            yield f"{self._name} keeps its values when the power goes off"

    def _write_register(self, register: int, value: float) -> str:
        """Write a value to a register by its number; return a line with the old and new value.

        HardwareAbort where the motor is enabled, or refuses the value.
        """
        self._require_disabled()
        old = self._client.read(self._can_id, register)
        self._client.write(self._can_id, register, value)
        if register == Register.ESC_ID:
            self._can_id = int(value)
        if register == Register.MST_ID:
            self._master_id = int(value)
        old_text = "unknown" if old is None else register_text(register, old)
        return f"{self._name}: {old_text} is now {register_text(register, value)}"

    def _clear_error(self) -> str:
        """Clear the motor's error and return a line with its old and its new status.

        HardwareAbort where the motor still reports an error.
        """
        text = status_text(self._status())
        self._link.send(special_frame(CLEAR_ERROR, self._can_id))
        status = self._status()
        new_text = status_text(status)
        if is_fault(status):
            raise HardwareAbort(f"{self._name} still reports {new_text}")
        return f"{self._name}: {text} is now {new_text}"

    def _require_disabled(self) -> None:
        """Raise HardwareAbort where the motor is enabled."""
        if self._status() == ENABLED:
            raise HardwareAbort(
                f"{self._name} is enabled; end the program that uses it, nothing was changed"
            )

    def _status(self) -> int:
        """Return the motor's present status code; HardwareAbort where no answer comes.

        It is the upper half of the first byte of a feedback frame.
        """
        frame = self._client.refresh(self._can_id, self._master_id)
        if frame is None:
            raise HardwareAbort(
                f"{self._name} does not tell its state; nothing more is done"
            )
        return frame.data[0] >> 4


def setup(session: Session) -> int:
    """List the motors on a bus, change one of them if the options say so; return the exit code.

    It is 1 where there is no motor, else 0. Errors are those of ``MotorSetup`` and
    ``_motor_to_change``, and InputError for a change without --motor.
    """
    options = record_from(SetupOptions, session.values)
    changes = given_values(options).keys() - {"motor"}
    if changes and options.motor is None:
        raise InputError("--motor says which motor to change, for instance --motor 1")
    with session.open_guarded(is_motion) as link:
        inspection = inspect_bus(link)
        session.console.stage(*motor_table(inspection.motors.values()))
        if changes:
            motor = _motor_to_change(inspection, options)
            for line in MotorSetup(link, motor).apply(options):
                session.console.stage(line)
    if not inspection.motors:
        session.verdict = _SILENT
        return 1
    done = f"motors that answer: {len(inspection.motors)}"
    if changes:
        done = f"motor {options.motor} is changed"
    command = session.command("check", trajectory=DAMIAO_NAME)
    step = NextStep("Next, check the motors for a trajectory", command)
    session.conclude(f"Done: {done}", step)
    return 0


def _motor_to_change(inspection: Inspection, options: SetupOptions) -> InspectedMotor:
    """Return the motor that the options name.

    Raises:
        HardwareAbort: no motor, or more than one, has that id.
        InputError: its new ids would clash with other motors.
    """
    motors = inspection.motors
    motor = motors.get(options.motor or 0)
    if motor is None or len(motor.reply_ids) != 1:
        raise HardwareAbort(
            f"no motor answers to CAN id {options.motor}, or several share it: leave one motor on "
            "the bus"
        )
    ids = motor.can_id, motor.master_id
    new_master = options.new_master_id
    if new_master is None:
        new_master = motor.master_id
    new_ids = options.new_id or motor.can_id, new_master
    # Alone, and beside each other motor: ids that clash already may be put right one by one.
    beside = [[(m.can_id, m.master_id)] for m in motors.values() if m is not motor]
    for other in ([], *beside):
        old_problems = set(id_problems([ids, *other]))
        for problem in id_problems([new_ids, *other]):
            if problem not in old_problems:
                raise InputError(f"nothing was changed: {problem}")
    return motor


def monitor(session: Session) -> int:
    """Print the motors' states at every interval, without enabling them; return the exit code.

    It ends with Ctrl-C or after the lifetime of the options. The code is 1 if no motor answers.
    """
    options = record_from(MonitorOptions, session.values)
    with session.open_guarded(is_motion) as link:
        motors = list(inspect_bus(link).motors.values())
        if not motors:
            session.verdict = _SILENT
            return 1
        clock = link.clock
        client = RegisterClient(link)
        end = clock.now() + (options.lifetime or float("inf"))
        with contextlib.suppress(KeyboardInterrupt):
            while clock.now() < end:
                motors = [replace(m, feedback=client.state_of(m)) for m in motors]
                session.console.stage(*motor_table(motors))
                clock.sleep_until(clock.now() + options.interval)
    return 0
