"""Text logs whose titles say which program wrote them, and so what their units are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from robot_sysid.errors import InputError
from robot_sysid.logs.column_file import ColumnChoices, Units

UR_TORQUE, UR_CURRENT = "actual_current_as_torque", "actual_current"


def known_text(
    titles: Sequence[str], joint_names: Sequence[str], currents: bool
) -> tuple[str, ColumnChoices]:
    """Return (program that wrote the log, what it says of its columns); ("", nothing) if unknown.

    Args:
        titles: of the log.
        joint_names: the n chain joints.
        currents: whether torque constants were given, so that currents are wanted.

    Raises:
        InputError: the log cannot hold measured torque.
    """
    if {"time", "state.q[0]", "state.tau_J[0]"} <= set(titles):
        return "libfranka's logToCSV, time in ms", ColumnChoices(units=Units(time="ms"))
    if {"timestamp", "actual_q_0"} <= set(titles):
        return "Universal Robots RTDE record", _rtde(titles, joint_names, currents)
    return "", ColumnChoices()


def merged(own: ColumnChoices, known: ColumnChoices) -> ColumnChoices:
    """Return what is known of a form with what the user says himself, which comes first."""
    units = Units(own.units.angle or known.units.angle, own.units.time or known.units.time)
    columns = {**known.columns, **own.columns}
    rate = own.rate or (None if own.time else known.rate)
    return replace(own, time=own.time or known.time, columns=columns, units=units, rate=rate)


def _rtde(titles: Sequence[str], joint_names: Sequence[str], currents: bool) -> ColumnChoices:
    """Return the columns of RTDE's fields; ``target_moment`` is computed, not measured."""
    torque = UR_CURRENT if currents else UR_TORQUE
    fields = {"position": "actual_q", "velocity": "actual_qd", "torque": torque}
    columns = {
        quantity: {joint: f"{field}_{k}" for k, joint in enumerate(joint_names)}
        for quantity, field in fields.items()
    }
    there = {q: c for q, c in columns.items() if set(c.values()) <= set(titles)}
    if "torque" not in there:
        raise InputError(
            f"this RTDE recording has no {torque}_0 to {torque}_{len(joint_names) - 1}: "
            "actual_current is in amperes and target_moment is the controller's model, no "
            "measurement; record actual_current_as_torque (PolyScope 5.23 or 10.11 and later), or "
            "record actual_current and give --torque-constants"
        )
    return ColumnChoices(time="timestamp", columns=there)
