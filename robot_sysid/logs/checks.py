"""Finding what is wrong with a log before anything is estimated from it.

Each check sees the rows once, chunk by chunk, keeps a few sums and ends in notes (the run goes on)
or in an InputError (the numbers could not mean what they seem to). Both name lines and a remedy.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.motion_checks import Angles, Jumps, Limits, Rest, Torque, Velocity
from robot_sysid.logs.rows import LogChunk, Repairs
from robot_sysid.logs.timing import Check, Clock, JointTime, LogContext, Timing
from robot_sysid.records import Array


def check_log(
    chunks: Iterable[LogChunk], context: LogContext, repairs: Repairs
) -> tuple[Timing, tuple[str, ...]]:
    """Run every check over the rows of a log.

    Args:
        chunks: iterable of LogChunk, in order.
        context: what is known about the log.
        repairs: what reading had to leave out or mend; complete once ``chunks`` is used up.

    Returns:
        Timing, and one sentence for each thing worth knowing.

    Raises:
        InputError: the log cannot be used as it is.
    """
    clock = Clock()
    checks: tuple[Check, ...] = (
        clock, Angles(), Jumps(), Rest(), Limits(context), Torque(), Velocity(clock),
        JointTime(),
    )  # fmt: skip
    previous: LogChunk | None = None
    for chunk in chunks:
        seen = chunk if previous is None else _joined(previous, chunk)
        for check in checks:
            check.update(seen)
        previous = chunk.rows(slice(-1, None))
    timing = clock.timing(context)
    notes = _repair_notes(context, repairs)
    for check in checks:
        notes += check.finish(context, timing)
    return timing, tuple(notes)


def sign_check(
    tau_measured: Array, tau_model: Array, joint_names: Sequence[str]
) -> tuple[str, ...]:
    """Compare the signs of measured torques with those the model predicts.

    Args:
        tau_measured, tau_model: (N, n) [N m].
        joint_names: the n joints.

    Returns:
        One sentence per joint whose torque hardly follows the model.

    Raises:
        InputError: a joint's torque clearly has the opposite sign.
    """
    product = np.sum(tau_measured * tau_model, axis=0)
    norm = np.linalg.norm(tau_measured, axis=0) * np.linalg.norm(tau_model, axis=0)
    correlation = np.divide(product, norm, out=np.zeros_like(product), where=norm > 0.0)
    notes = []
    for name, value in zip(joint_names, correlation):
        if value < -0.7:
            raise InputError(
                f"the torque of joint {name} has the opposite sign of the model's (correlation "
                f"{value:.2f}); flip it in the columns file: torque.{name} = -TITLE, or correct "
                "the sign and the zero of the positions"
            )
        if value < -0.3:
            notes.append(
                f"the torque of joint {name} runs against the model's (correlation {value:.2f}); "
                "check its sign and the order of the columns"
            )
    return tuple(notes)


def _joined(previous: LogChunk, chunk: LogChunk) -> LogChunk:
    def both(name: str) -> Array | None:
        value = getattr(chunk, name)
        return None if value is None else np.concatenate((getattr(previous, name), value))

    names = ("q", "tau", "qd", "qdd", "joint_time")
    lines = np.concatenate((previous.lines, chunk.lines))
    return LogChunk(lines, np.concatenate((previous.time, chunk.time)), *map(both, names))  # type: ignore[arg-type]


def _repair_notes(context: LogContext, repairs: Repairs) -> list[str]:
    usable = max(1, repairs.rows)
    if repairs.missing.count > 0.05 * usable:
        raise InputError(
            f"{context.name}: {repairs.missing.count} of {repairs.rows} rows have empty or NaN "
            f"cells ({repairs.missing}); mend the recording, or keep a broken column out with "
            "--columns FILE"
        )
    if repairs.repeated.count > 0.05 * usable:
        raise InputError(
            f"{context.name}: {repairs.repeated.count} of {repairs.rows} rows repeat the time "
            f"stamp before them ({repairs.repeated}); write the time with more digits"
        )
    said = (
        (repairs.missing, "left out {count} rows with empty or NaN cells ({lines})"),
        (repairs.repeated, "left out {count} rows that repeat a time stamp ({lines})"),
        (repairs.cut_off, "left out the last row, which is cut off ({lines})"),
        (repairs.wrapped, "unwrapped positions that jump by a full turn ({lines})"),
    )
    return [text.format(count=r.count, lines=r) for r, text in said if r.count]
