"""Process a measured log into the signals from which regressors are computed.

1. a uniform time grid (``resampling``);
2. one cut-off for everything of a log, chosen from the data (``cutoff``);
3. positions are low-passed and differentiated (``filters``), those without noise differentiated as
   they are; velocity columns of the log are not
   used: a drive filters and delays them in its own way;
4. regressor columns and torques pass the same low-pass and are decimated to its bandwidth. What
   depends on the sign of a speed is computed at the full rate (``filter_columns``);
5. the ends are cut off. Rows over long holes in the log, or over moments at which a joint is too
   slow for its friction to have a sign, are masked (``FilteredRecording.is_moving``).

A filtered row mixes all samples under the filter's window, near a reversal also some in which the
direction of friction is not known. Rows with more than ``LARGEST_SLOW_SHARE`` of the filter's
weight on such samples are masked. A mask that only looks at a row's own instant leaves errors in
viscous friction that are several times as large.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError, prefix_input_errors
from robot_sysid.records import Array, Motion, Recording, RobotModel
from robot_sysid.records.messages import Detail, count_text, percent, position_unit
from robot_sysid.signals.cutoff import CutoffChoice, choose_cutoff
from robot_sysid.signals.filters import REACH, LowPass, derivatives, design_low_pass
from robot_sysid.signals.frozen import Stretch, equal_runs
from robot_sysid.signals.resampling import (
    SHORTEST_PIECE,
    resample_uniformly,
    sampling_period,
)

Mask = NDArray[np.bool_]
"""Boolean mask, True where a row is used, or a sample has what it is named for."""
LARGEST_SLOW_SHARE = 0.07
"""Share of the filter's weight that samples inside the deadband, or in long holes of the log, may
have in a row that is used."""

TURN_TRAVELS = (1e-3, 3e-3)
"""Travels from a turn within which dry friction may not have turned round [rad], of zones one
around the other: teeth and balls bend before they slide. Gears of real arms take about the smaller
one, and after the larger one next to nothing of the change is left. The larger zone makes the
rotors of long logs right; at every joint it makes the file of a short log worse, which has no rows
to spare."""
NOISELESS = 1e-3
"""Share of noise in the acceleration below which positions are differentiated as they are."""
LONGEST_HOLE = 5.5
"""Sampling periods of the longest hole that a spline bridges, one of four lost samples: noise of
the samples around it is at most three times the usual noise in a row over them, and grows with the
square of their number."""
BLOW_REACH = 0.25
"""Periods of the cut-off within which a blow reaches rows."""
DEADBAND_SHARE = 0.005
"""Share of its peak speed below which a joint has hardly left stiction."""
LEAST_DEADBAND = 1e-3
"""Speed as which encoder noise alone can look [rad/s]."""
NOTED_LOSS = 0.05
"""Share of rows beside lost samples from which on the user is told."""
NOTED_SLOWNESS = 0.5
"""Share of a joint's rows in use below which the user is told."""
NORMAL_MEDIAN = 0.6745
"""Median of the size of a standard normal number."""
CLEAR_DEVIATIONS = 6.0
"""Deviations by which readings do not differ by chance; if they are rounded, that is between one
step and two."""
CLEAR_STEP = 0.1
"""Share of a joint's largest step from which on it moves fast before an abrupt stop."""
PINION = 0.05
"""Usual radius of the pinion that moves a slide [m]; screws turn round within less travel."""


class KeptColumns:
    """Columns that were made of a recording's samples, by key, so that each is made once.

    Recordings of the same samples, of which other rows are used, share them.

    Args:
        columns: key to those that are known from the start.
    """

    def __init__(self, columns: Mapping[object, Array] | None = None) -> None:
        self._columns = dict(columns or {})

    def get(self, key: object, make: Callable[[], Array]) -> Array:
        """Return the columns of a key, made where they are asked for first: do not change them."""
        if key not in self._columns:
            self._columns[key] = make()
        return self._columns[key]


@dataclass(frozen=True)
class FilteredRecording:
    """A recording, low-passed: K rows (instants) of equations, made from N samples of n joints.

    The samples lie on a uniform grid. Their motion is low-passed, their torque still raw, so that
    it passes the low-pass exactly as often as the columns of equations do.

    Attributes:
        time: (N,) [s].
        q: (N, n) positions [rad].
        qd: (N, n) velocities [rad/s].
        qdd: (N, n) accelerations [rad/s^2].
        tau: (N, n) torques, uniform but not filtered [N m].
        bridged: (N,) whether the motion of a sample was computed from samples over a long hole in
            the log.
        from_turn: (N, n) travel of each joint from where it turns round [rad], of a slide that of
            its pinion; zero where it may be standing.
        deadband: (n,) speed below which the direction of a joint's friction is not sure [rad/s].
        low_pass: the filter for columns and torques.
        name: of the log, in messages.
        is_loaded: whether the arm carries the payload.
        order: as of ``Recording``.
        notes: what a reader should know about the log.
        acceleration_error: expected error of the acceleration over its root mean square; 0 where
            the cut-off was given.
        acceleration_noise: (n,) standard deviation of the noise of each joint's acceleration
            [rad/s^2]; zero where the cut-off was given.
        touched: stretches in which torque is left over that is ordinary at no other time.
        every: of how many rows one counts.
        chosen: (K, n) rows that are used; None for all that the signals allow (``is_used``).
        kept: columns that were made of the samples.
    """

    time: Array
    q: Array
    qd: Array
    qdd: Array
    tau: Array
    bridged: Mask
    from_turn: Array
    deadband: Array
    low_pass: LowPass
    name: str = ""
    is_loaded: bool = False
    order: float = 0.0
    notes: tuple[str, ...] = ()
    acceleration_error: float = 0.0
    acceleration_noise: Array = field(default_factory=partial(np.zeros, 1))
    touched: tuple[Stretch, ...] = ()
    every: int = 1
    chosen: Mask | None = None
    kept: KeptColumns = field(default_factory=KeptColumns, compare=False)

    @classmethod
    def exact(
        cls, motion: Any, tau: Array, low_pass: LowPass, **fields: Any
    ) -> FilteredRecording:
        """Return samples without noise as a recording of which nothing is left out.

        Args:
            motion: positions, velocities and accelerations (N, n).
            tau: (N, n) torques [N m].
            low_pass: of torques and columns.
            fields: further fields of the recording.
        """
        series = motion.time, motion.q, motion.qd, motion.qdd, tau
        never = np.zeros(len(tau), dtype=bool)
        far = np.full(tau.shape, np.inf)
        return cls(*series, never, far, np.zeros(1), low_pass, **fields)

    def __len__(self) -> int:
        """Return the number K of rows."""
        return len(self.motion.time)

    @property
    def cutoff(self) -> float:
        """Cut-off of the low-pass [Hz]."""
        return self.low_pass.cutoff

    @property
    def rate(self) -> float:
        """Sample rate of the grid [Hz]."""
        return self.low_pass.rate

    def samples(self, chosen: NDArray[np.int64] | slice) -> Motion:
        """Return the motion (m, n) at m samples: their indices, or a slice of them, for views."""
        return Motion(
            self.time[chosen], self.q[chosen], self.qd[chosen], self.qdd[chosen]
        )

    @cached_property
    def motion(self) -> Motion:
        """Positions, speeds, accelerations (K, n) at the instants of rows, low-passed once."""
        lost = self.low_pass.half_width
        return self.samples(
            slice(lost, len(self.time) - lost, self.low_pass.step * self.every)
        )

    @cached_property
    def torque(self) -> Array:
        """The measured torque (K, n), low-passed like the columns [N m]."""
        return self.low_pass.decimate(self.tau)[:: self.every]

    @property
    def has_torque(self) -> Mask:
        """Which joints (n,) have a torque: it is zero throughout where no sensor measured it."""
        return np.any(self.tau, axis=0)

    @cached_property
    def is_complete(self) -> Mask:
        """Which rows (K,) have a filter's window with next to no weight of bridged samples."""
        return self._is_light(self.bridged)

    @cached_property
    def is_moving(self) -> Mask:
        """Which rows (K, n) are complete, with little weight of slow samples in their window."""
        is_slow = np.abs(self.qd) < self.deadband
        return self._is_light(is_slow) & self.is_complete[:, None]

    @cached_property
    def is_used(self) -> Mask:
        """Which rows (K, n) may be used: those that were chosen, else those of joints with torque
        where friction has a direction.
        """
        if self.chosen is not None:
            return self.chosen
        return self.is_moving & self.has_torque

    def at_turns(self, travel: float) -> Mask:
        """Return which rows (K, n) lie within a travel [rad] of where a joint turns round."""
        return ~self._is_light(self.from_turn <= travel)

    def _is_light(self, is_marked: Mask) -> Mask:
        """Return (K, ...) whether marked samples have next to no weight in each row's window."""
        shares = self.low_pass.weight_shares(is_marked)[:: self.every]
        return shares <= LARGEST_SLOW_SHARE

    def only(self, rows: Mask) -> FilteredRecording:
        """Return the recording in which some rows, (K,) or (K, n), are used at most."""
        return self.using((self.is_used.T & rows.T).T)

    def using(
        self,
        is_used: Mask,
        columns: Mapping[object, Array] | None = None,
        **changes: Any,
    ) -> FilteredRecording:
        """Return the recording with changed fields, of whose rows those (K, n) are used.

        Columns that were made of this recording are those of the other one only where no field
        changes.

        Args:
            is_used: the rows.
            columns: key to columns that are known of the changed recording.
            changes: fields.
        """
        kept = KeptColumns(columns) if changes else self.kept
        return replace(self, chosen=is_used, kept=kept, **changes)

    def with_all_rows(self, **changes: Any) -> FilteredRecording:
        """Return the recording with changed fields, of which all rows are used that the signals
        allow, whichever were chosen before.
        """
        return replace(self, chosen=None, **changes)

    def at_every_sample(self) -> FilteredRecording:
        """Return the recording with a row at each sample that the low-pass reaches.

        A row is used where the nearest row of this recording is.
        """
        stride = self.low_pass.step * self.every
        count = len(self.time) - 2 * self.low_pass.half_width
        nearest = (np.arange(count) + stride // 2) // stride
        is_used = self.is_used[np.minimum(nearest, len(self) - 1)]
        low_pass = replace(self.low_pass, step=1)
        return self.using(is_used, low_pass=low_pass, every=1)

    def filter_columns(self, make: Callable[[Motion], Array]) -> Array:
        """Return columns (K, ...) that are made from the motion, low-passed and decimated.

        What has the sign of a speed has to pass the filter that the torque has passed. ``make``
        takes the motion at m samples and returns its columns (m, ...).
        """
        low_pass = self.low_pass
        reach = len(low_pass.kernel)
        # Decimated rows that are computed at once: bounds memory, changes no result.
        count = 500
        blocks = []
        for first in range(0, len(self.time) - reach + 1, count * low_pass.step):
            last = first + (count - 1) * low_pass.step + reach
            blocks.append(low_pass.decimate(make(self.samples(slice(first, last)))))
        return np.concatenate(blocks)[:: self.every]


def low_pass_uniform(
    uniform: Recording, choice: CutoffChoice, robot: RobotModel
) -> FilteredRecording:
    """Return a recording low-passed: positions are low-passed and differentiated.

    Args:
        uniform: on a uniform grid, as ``resample_uniformly`` returns it.
        choice: of the cut-off.
        robot: the arm, whose joints the notes name.

    Raises:
        InputError: the log is too short, or the cut-off does not fit its sample rate.
    """
    rate = 1.0 / sampling_period(uniform.time)
    low_pass = design_low_pass(choice.cutoff, rate)
    # Positions with so little noise are differentiated as they are.
    kernel = np.ones(1) if choice.noise_share < NOISELESS else low_pass.kernel
    position_filter = replace(low_pass, step=1, kernel=kernel)
    # Samples that positions and their derivatives lose at each end; torques lose more.
    lost = position_filter.half_width + REACH
    shortest = 2 * (lost + low_pass.half_width) + 10 * low_pass.step
    if len(uniform) < shortest:
        raise InputError(
            f"the log's {len(uniform) / rate:.3g} s are too short for a cut-off of "
            f"{choice.cutoff:.3g} Hz, which needs {shortest / rate:.3g} s; record longer"
        )
    inner = slice(lost, len(uniform) - lost)
    q = position_filter.decimate(uniform.q)
    qd, qdd = derivatives(q, rate)
    # It is at most one period of the cut-off.
    longest_hole = min(LONGEST_HOLE / rate, 1.0 / choice.cutoff)
    assert uniform.hole is not None
    hole_share = position_filter.weight_shares(uniform.hole > longest_hole)
    reach = np.ones(2 * round(BLOW_REACH * rate / choice.cutoff) + 1)
    stops = abrupt_stops(uniform.time, uniform.q)
    stops = np.convolve(stops, reach, "same")[: len(stops)] > 0.0
    stop_share = position_filter.weight_shares(stops)
    radius = np.where(robot.is_slide, PINION, 1.0)
    deadband = DEADBAND_SHARE * np.max(np.abs(qd), axis=0)
    filtered = FilteredRecording(
        time=uniform.time[inner],
        q=q[REACH:-REACH],
        qd=qd,
        qdd=qdd,
        tau=uniform.tau[inner],
        bridged=(hole_share + stop_share)[REACH:-REACH] > LARGEST_SLOW_SHARE,
        from_turn=travel_from_turns(uniform.q[inner], q[REACH:-REACH], qd) / radius,
        deadband=np.maximum(deadband, LEAST_DEADBAND),
        low_pass=low_pass,
        name=uniform.name,
        is_loaded=uniform.is_loaded,
        order=uniform.order,
        acceleration_error=choice.expected_error,
        acceleration_noise=np.sqrt(
            choice.joint_noise * np.sum(np.mean(qdd**2, axis=0))
        ),
    )
    filter_note = Detail(f"low-pass with a cut-off of {choice.cutoff:.4g} Hz")
    row_notes = _notes(filtered, robot, longest_hole)
    return replace(filtered, notes=(*uniform.notes, filter_note, *row_notes))


def _notes(
    filtered: FilteredRecording, robot: RobotModel, longest_hole: float
) -> Iterator[str]:
    """Yield sentences for the user on the rows of a recording; a ``Detail`` is printed on demand
    only.

    Args:
        filtered: the recording.
        robot: the arm.
        longest_hole: length of a hole in the log beyond which rows beside it are not used [s].
    """
    missing = 1.0 - float(np.mean(filtered.is_complete))
    if missing > 0.0:
        note = (
            f"{percent(missing)} of the rows lie next to lost samples (gaps of more than "
            f"{1e3 * longest_hole:.3g} ms) or what is left out, and are not used"
        )
        yield note if missing > NOTED_LOSS else Detail(note)
    usable = np.count_nonzero(filtered.is_moving, axis=0)
    shares = usable / max(np.count_nonzero(filtered.is_complete), 1)
    slow: dict[tuple[str, str], list[str]] = {}
    for joint, name in enumerate(robot.joint_names):
        if shares[joint] < NOTED_SLOWNESS:
            unit = position_unit(robot.is_slide[joint])
            speed = f"{filtered.deadband[joint]:.2g} {unit}/s"
            slow.setdefault((percent(shares[joint]), speed), []).append(name)
    for (share, speed), names in slow.items():
        yield Detail(
            f"only {share} of the rows of {count_text(len(names), 'joint')} are used "
            f"({', '.join(names)}): in the others the speed is below {speed}, where the direction "
            "of friction is not sure"
        )


def travel_from_turns(readings: Array, q: Array, qd: Array) -> Array:
    """Return how far (N, n) each joint is from the turn before or after it, zero where not clearly.

    A joint with dry friction does not turn round at once: it stands until its torque has changed by
    twice the friction, 20 to 60 ms under a stiff controller. Low-passed positions show a smooth
    turn instead, with a speed that has a sign at every moment, and Coulomb friction computed from
    that sign is wrong by up to twice its size, in the direction of the acceleration at every turn:
    it looks like rotor inertia. A joint may be standing until a reading differs clearly from the
    outermost one; where it does not stand, its gears still bend the other way first.

    Args:
        readings: (N, n) positions as they were read [rad].
        q: (N, n) low-passed positions [rad].
        qd: (N, n) low-passed velocities, whose sign shows the turns [rad/s].

    Returns:
        The farthest that the joint has been from the outermost reading on its way from or to the
        turn [rad]; infinite where it does not turn round.
    """
    travel = np.full(qd.shape, np.inf)
    sizes = np.median(np.abs(readings - q), axis=0)
    clear = CLEAR_DEVIATIONS * sizes / NORMAL_MEDIAN
    for reading, speed, own in zip(readings.T, qd.T, travel.T):
        # Around each turn, the samples from the turn before it to the turn after it.
        turns = np.flatnonzero(np.diff(np.sign(speed))) + 1
        edges = [0, *turns.tolist(), len(speed)]
        for start, turn, stop in zip(edges, edges[1:], edges[2:]):
            # 1 where the joint turns at its highest position, -1 at its lowest.
            outward = np.sign(speed[turn - 1] - speed[turn])
            height = outward * reading[start:stop]
            away = np.max(height) - height
            before, after = away[: turn - start][::-1], away[turn - start :]
            farthest = np.maximum.accumulate(before)[::-1], np.maximum.accumulate(after)
            own[start:stop] = np.minimum(own[start:stop], np.concatenate(farthest))
    return np.where(travel > clear, travel, 0.0)


def abrupt_stops(time: Array, readings: Array) -> Mask:
    """Return at which samples (N,) a joint stops or starts at once, as at the end of its range.

    Its acceleration there is that of a blow, which no motor makes. From one sample to the next its
    speed is lost, to stand still for a while.

    Args:
        time: (N,) [s].
        readings: (N, n) positions as they were read [rad].
    """
    is_stop = np.zeros(len(readings), dtype=bool)
    for reading in readings.T:
        steps = np.abs(np.diff(reading))
        least = CLEAR_STEP * np.max(steps)
        for run in equal_runs(time, reading):
            # A slow joint of a coarse encoder has steps of one count between such of none.
            before = steps[max(run.start - 3, 0) : run.start]
            after = steps[run.stop - 1 : run.stop + 2]
            is_stop[run.start] |= len(before) > 0 and np.min(before) > least
            is_stop[run.stop - 1] |= len(after) > 0 and np.min(after) > least
    return is_stop


def check_losses(recordings: Sequence[FilteredRecording]) -> None:
    """Raise InputError where lost samples spoil most rows of a log's pieces, and the others last
    less than ``SHORTEST_PIECE``.
    """
    is_complete = np.concatenate([recording.is_complete for recording in recordings])
    entire_time = sum(len(recording.time) / recording.rate for recording in recordings)
    used_time = float(np.mean(is_complete)) * entire_time
    if used_time < min(SHORTEST_PIECE, 0.5 * entire_time):
        raise InputError(
            f"only {used_time:.2g} s of {entire_time:.3g} s are free of lost samples, which is too "
            "little for an estimate; record without losses, for example on the computer that "
            "controls the arm"
        )


def low_pass_recordings(
    robot: RobotModel, recordings: Sequence[Recording], cutoff: float | None = None
) -> tuple[list[FilteredRecording], tuple[str, ...]]:
    """Resample every recording to a uniform grid and low-pass it, each log with its own cut-off.

    A slow motion asks for a low one, behind which a fast one would lose what it tells of rotors:
    with one for both, a slow log beside a fast one makes the file worse than the fast one alone.

    Args:
        robot: the arm with its model.
        recordings: without long holes; those of one name are stretches of one log.
        cutoff: of the low-pass of all [Hz]; None for the lowest that any stretch of a log requires.

    Returns:
        (filtered recordings, one for each; notes on them, one sentence each).

    Raises:
        InputError: a recording is too short.
    """
    resampled = []
    choices = []
    cutoffs: dict[str, float] = {}
    for recording in recordings:
        with prefix_input_errors(recording.name):
            uniform = resample_uniformly(recording)
            choice = choose_cutoff(uniform.q, 1.0 / sampling_period(uniform.time))
        resampled.append(uniform)
        choices.append(choice)
        lowest = min(choice.cutoff, cutoffs.get(uniform.name, np.inf))
        cutoffs[uniform.name] = cutoff or lowest
    logs: defaultdict[str, list[FilteredRecording]] = defaultdict(list)
    filtered = []
    for uniform, choice in zip(resampled, choices):
        if cutoff is not None or choice.cutoff > cutoffs[uniform.name]:
            choice = choice._replace(
                cutoff=cutoffs[uniform.name],
                expected_error=0.0,
                joint_noise=np.zeros_like(choice.joint_noise),
            )
        with prefix_input_errors(uniform.name):
            filtered.append(low_pass_uniform(uniform, choice, robot))
        logs[uniform.name].append(filtered[-1])
    notes = {}
    for name, of_log in logs.items():
        with prefix_input_errors(name):
            check_losses(of_log)
        notes[name] = [note for stretch in of_log for note in stretch.notes]
    return filtered, tuple(shared_notes(notes))


def shared_notes(notes_by_name: Mapping[str, Collection[str]]) -> Iterator[str]:
    """Yield each note once, with the names of its recordings where there are several recordings.

    Args:
        notes_by_name: name of a recording to its notes; a note may be a subclass of ``str``.
    """
    for note in dict.fromkeys(chain(*notes_by_name.values())):
        about = [name for name, notes in notes_by_name.items() if note in notes]
        where = ", ".join(about)
        if len(about) == len(notes_by_name):
            where = "all recordings"
        yield note if len(notes_by_name) == 1 else type(note)(f"{where}: {note}")
