"""Sensors that failed for a while: their stretches of a log are left out, and the rest is used.

A sensor that fails shows itself: a channel repeats one value while the arm moves
(``signals.frozen``). What touched the arm shows as torque that a fit leaves over
(``estimate.contacts``). Throughout, n is the number of joints.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from robot_sysid.estimate.contacts import MOST_SHARE, MOST_STRETCHES
from robot_sysid.faults import Finding
from robot_sysid.records import Array, Recording
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.messages import Level, count_text
from robot_sysid.signals.frozen import Stretch, equal_runs, frozen_positions, true_runs

MANY_VALUES = 100
"""Number of different values below which a channel has coarse steps, which repeat by chance."""
ROUNDED = 1.5
"""Steps of a channel by which it has to jump, before or after it repeated a value: torque that
changes slowly stays on one step, and goes on to the next."""
STANDING = 0.005
"""Speed up to which a joint stands [rad/s]: what holds it, its friction or a brake, needs no torque
that changes, and its rows are not used."""


def failed_sensors(pieces: Sequence[Recording]) -> Iterator[Stretch]:
    """Yield the stretches in which a position or torque repeats its value while the arm moves."""
    for piece in pieces:
        joints = np.eye(piece.q.shape[1], dtype=bool)
        for joint, q, tau in zip(joints, piece.q.T, piece.tau.T):
            runs = [(FaultName.HELD, rows) for rows in frozen_positions(piece.time, q)]
            runs += held_torques(piece, q, tau)
            for name, rows in runs:
                start, stop = piece.time[[rows.start, rows.stop - 1]].tolist()
                yield Stretch(start, stop, joint, name)


def held_torques(
    piece: Recording, q: Array, tau: Array
) -> Iterator[tuple[FaultName, slice]]:
    """Yield (name, rows) where a joint's torque (N,) repeats its value while it moves.

    ``q`` (N,) are the joint's positions: one that friction holds may have the same torque all the
    time while other joints move.
    """
    values = np.unique(tau)
    if len(values) < MANY_VALUES:
        return
    # Of a slow driver the largest reading repeats as long as any other one.
    ends = () if held_length([tau]) > 1 else (values[0], values[-1])
    least = ROUNDED * np.min(np.diff(values))
    changes = np.abs(np.diff(tau, prepend=tau[0], append=tau[-1]))
    for rows in equal_runs(piece.time, tau):
        if max(changes[rows.start], changes[rows.stop]) < least:
            continue
        # The range of positions counts: an arm may return to where it was.
        length = min(float(np.ptp(piece.time[rows])), 1.0)
        if np.ptp(q[rows]) >= STANDING * length:
            is_end = tau[rows.start] in ends
            yield FaultName.SATURATED if is_end else FaultName.HELD, rows


def held_length(columns: Sequence[Array]) -> int:
    """Return for how many samples a channel, (N,) of each piece, is held between two changes.

    A slow driver gives each number several times. What comes in coarse steps repeats by chance, and
    goes on to the next step: it is not held.
    """
    values = np.unique(np.concatenate(columns))
    if len(values) < 2:
        return 1
    changes = [*map(np.diff, columns)]
    sizes = np.abs(np.concatenate(changes))
    is_jumping = np.median(sizes[sizes > 0.0]) > ROUNDED * np.min(np.diff(values))
    gaps = np.concatenate([np.diff(np.flatnonzero(each)) for each in changes])
    return int(np.median(gaps)) if is_jumping and len(gaps) else 1


def leave_out(
    joint_names: Sequence[str],
    pieces: Sequence[Recording],
    stretches: Sequence[Stretch],
) -> tuple[list[Recording], list[Finding]]:
    """Return the pieces of a log with the rows of stretches marked as left out, and what to say.

    Positions there are replaced by a smooth motion: the low-pass of the rows beside them must meet
    no jump. Where too much would be left out, the pieces are returned as they are, with a warning.

    Args:
        joint_names: (n,) of the chain.
        pieces: the log without gaps.
        stretches: may overlap.
    """
    kept = []
    runs = []
    left_out_count = 0
    for piece in pieces:
        wrong = np.zeros(piece.q.shape, dtype=bool)
        for stretch in stretches:
            within = (piece.time >= stretch.start) & (piece.time <= stretch.stop)
            wrong[within] |= stretch.joints
        left_out = np.any(wrong, axis=1)
        for rows in true_runs(left_out):
            start, stop = piece.time[[rows.start, rows.stop - 1]].tolist()
            *_, name = (s.name for s in stretches if s.start <= start <= s.stop)
            runs.append(Stretch(start, stop, np.any(wrong[rows], axis=0), name))
        left_out_count += int(np.sum(left_out))
        if not np.any(left_out):
            kept.append(piece)
        elif not np.all(left_out):
            kept.append(_mark(piece, left_out))
    is_much = left_out_count > MOST_SHARE * sum(map(len, pieces))
    found = stretch_findings(joint_names, runs, is_much)
    is_left_out = all(finding.level is Level.SAYS for finding in found)
    return (kept if is_left_out else list(pieces)), found


def stretch_findings(
    joint_names: Sequence[str], stretches: Sequence[Stretch], is_much: bool = False
) -> list[Finding]:
    """Return what is said of stretches that are left out.

    It is a doubt where they are too many, or too much (``is_much``) of a log.
    """
    texts = []
    for start, stop, joints, name in stretches:
        is_touched = name is FaultName.CONTACT
        fault = "something touched the arm" if is_touched else "a sensor failed"
        names = ", ".join(compress(joint_names, joints))
        texts.append(f"{fault} from {start:.2f} s to {stop:.2f} s ({names})")
    if is_much or len(texts) > MOST_STRETCHES:
        count = count_text(len(texts), "time")
        text = f"{texts[0]}; {count} in all, too much to leave out"
        remedy = "record again without it"
        return [Finding(Level.DOUBTS, stretches[0].name, text, remedy)]
    return [
        Finding(Level.SAYS, stretch.name, f"{text}: left out")
        for stretch, text in zip(stretches, texts)
    ]


def _mark(piece: Recording, left_out: NDArray[np.bool_]) -> Recording:
    """Return a piece with rows (N,) marked as left out, and without those of them at its ends."""
    from scipy.interpolate import CubicSpline

    left_out = left_out | piece.is_left_out
    kept = np.flatnonzero(~left_out)
    q = piece.q.copy()
    q[left_out] = CubicSpline(piece.time[kept], q[kept])(piece.time[left_out])
    marked = replace(piece, q=q, hole=np.where(left_out, np.inf, 0.0))
    return marked[kept[0] : kept[-1] + 1]
