"""Finding what is wrong with a log before anything is estimated from it.

Each check looks at the usable rows and ends in notes (the run goes on) or in an InputError (the
numbers could not mean what they seem to). Both name lines and a remedy.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs import motion_checks
from robot_sysid.logs.rows import LogRows
from robot_sysid.logs.timing import LogContext, clock_notes, require_one_clock
from robot_sysid.records import Array

LARGEST_GARBAGE = 0.01
"""Share of rows that are no rows of numbers beyond which a log is refused."""


def check_log(rows: LogRows, context: LogContext) -> tuple[str, ...]:
    """Run every check over the rows of a log and return one sentence for what is worth knowing.

    Raises:
        InputError: the log cannot be used as it is.
    """
    if not rows.n_read and rows.foreign:
        raise InputError(
            f"{context.name}: none of its {rows.foreign} rows holds a position and a torque of "
            f"{', '.join(context.joint_names)}"
        )
    if len(rows.lines) < 10:
        raise InputError(
            f"{context.name} has only {len(rows.lines)} usable rows; an excitation of several "
            "seconds is needed"
        )
    notes = [*_repair_notes(rows, context), *clock_notes(rows, context)]
    motion_checks.require_radians(rows, context)
    motion_checks.require_no_jumps(rows, context)
    notes += [*motion_checks.rest_notes(rows, context), *motion_checks.limit_notes(rows, context)]
    motion_checks.require_torque(rows, context)
    motion_checks.require_no_motor_current(rows, context)
    notes += motion_checks.velocity_notes(rows, context)
    require_one_clock(rows, context)
    return tuple(notes)


def sign_check(
    tau_measured: Array, tau_model: Array, joint_names: Sequence[str]
) -> tuple[str, ...]:
    """Compare the signs of measured torques with those the model predicts.

    Args:
        tau_measured, tau_model: (N, n) [N m].
        joint_names: the n joints.

    Returns:
        One sentence per joint whose torque runs against the model's. A payload can turn the torque
        of a wrist round; whether a sign is wrong is asked by ``checks``.
    """
    product = np.sum(tau_measured * tau_model, axis=0)
    norm = np.linalg.norm(tau_measured, axis=0) * np.linalg.norm(tau_model, axis=0)
    correlation = np.divide(product, norm, out=np.zeros_like(product), where=norm > 0.0)
    return tuple(
        f"the torque of joint {name} runs against the model's (correlation {value:.2f}); "
        "check its sign and the order of the columns, unless the payload is heavy"
        for name, value in zip(joint_names, correlation)
        if value < -0.3
    )


def _repair_notes(rows: LogRows, context: LogContext) -> Iterator[str]:
    if len(rows.missing) > 0.05 * rows.n_read:
        raise InputError(
            f"{context.name}: {len(rows.missing)} of {rows.n_read} rows have empty or NaN "
            f"cells ({rows.listed(rows.missing)}); mend the recording, or keep a broken column out "
            "with --columns FILE"
        )
    if len(rows.repeated) > 0.05 * rows.n_read:
        raise InputError(
            f"{context.name}: {len(rows.repeated)} of {rows.n_read} rows repeat the time "
            f"stamp before them ({rows.listed(rows.repeated)}); write the time with more digits"
        )
    if len(rows.unreadable) > LARGEST_GARBAGE * rows.n_read:
        raise InputError(
            f"{context.name}: {len(rows.unreadable)} of {rows.n_read} rows are no rows of numbers "
            f"({rows.complaint or rows.listed(rows.unreadable)}), more than "
            f"{100.0 * LARGEST_GARBAGE:g} %; mend the recording"
        )
    if rows.foreign:
        yield f"left out {rows.foreign} rows that hold nothing of this arm"
    if rows.thinned > 1:
        yield (
            f"a long log: every {rows.thinned} rows were low-passed and made one, which leaves "
            f"{len(rows.lines)}"
        )
    said = (
        (rows.unreadable, "left out {count} rows that are no rows of numbers ({lines})"),
        (rows.missing, "left out {count} rows with empty or NaN cells ({lines})"),
        (rows.repeated, "left out {count} rows that repeat a time stamp ({lines})"),
        (rows.cut_off, "left out the last row, which is cut off ({lines})"),
        (rows.wrapped, "unwrapped positions that jump by a full turn ({lines})"),
    )
    for lines, text in said:
        if len(lines):
            yield text.format(count=len(lines), lines=rows.listed(lines))
