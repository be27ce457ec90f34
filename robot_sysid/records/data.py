"""Motion and recordings, and what follows from them.

``FitQuality`` and ``Validation`` say how well a fit describes samples; ``Traces`` are what a report
draws of them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, groupby
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records.arrays import Array, check_arrays
from robot_sysid.records.messages import count_text
from robot_sysid.records.servo_setting import UNKNOWN, ServoSetting

RECORDING_SEPARATION = 10.0
"""Time that is put between recordings with separate clocks [s]: longer than any filter."""


def shift_behind(last: float, first: float) -> float:
    """Return what is added to the times of a recording that follows another one in a log [s].

    ``last`` is the other one's last time, and ``first`` the recording's first.
    """
    return last + RECORDING_SEPARATION - first


@dataclass(frozen=True)
class Motion:
    """Motion of the n chain joints at N instants.

    Attributes:
        time: (N,) instants [s].
        q, qd, qdd: (N, n) positions [rad], velocities [rad/s] and accelerations [rad/s^2]; m in
            place of rad for a slide. Columns are the joints, base to terminal.
    """

    time: Array
    q: Array
    qd: Array
    qdd: Array

    def __post_init__(self) -> None:
        _check_samples(self, "qd", "qdd")

    def __getitem__(self, rows: Any) -> Motion:
        return Motion(self.time[rows], self.q[rows], self.qd[rows], self.qdd[rows])


def _check_samples(record: Motion | Recording, *names: str) -> None:
    """Make the arrays of a record read-only and check their shapes.

    Args:
        record: the record, whose fields are replaced by views; its ``time`` has the shape (N,), its
            ``q`` (N, n).
        names: of its further fields of the shape (N, n); one that is None is left out.

    Raises:
        InputError: a shape differs, or an element is not finite.
    """
    check_arrays(record, time=(None,))
    check_arrays(record, q=(len(record.time), None))
    given = (name for name in names if getattr(record, name) is not None)
    check_arrays(record, **dict.fromkeys(given, record.q.shape))


class MotionPlan(Protocol):
    """A trajectory: anything with a duration that can be evaluated exactly at any time."""

    @property
    def duration(self) -> float:
        """Length [s]."""

    def evaluate(self, time: Array) -> Motion:
        """Return the motion at times (N,) [s], with exact derivatives."""


MOST_LISTED = 8
"""Columns that are not used which a note lists."""
_WHOLE_NUMBER = re.compile(r"\d+")


@dataclass(frozen=True)
class Column:
    """A column of a log's file.

    Attributes:
        index: of the column, from 0.
        title: as the file has it.
        factor: by which the column's numbers are multiplied to be in SI units.
        declared_factor: the part of this factor that the line of a columns file states.
        zero: the number in the column that stands for zero.
        constant: what is added to the column in SI units; of a joint that stands still and has no
            column, whose factor is zero, its position.
    """

    index: int
    title: str
    factor: float
    declared_factor: float = 1.0
    zero: float = 0.0
    constant: float = 0.0


@dataclass(frozen=True)
class ColumnMap:
    """The column of each quantity of a log; tuples hold one per chain joint, base to terminal.

    Attributes:
        time: None for a log without time stamps.
        rate: samples per second of a log without time stamps [Hz].
        position: of each joint.
        torque: of each joint; of a log of servos, its commanded position.
        velocity: () where velocities are differentiated from positions.
        motor_torque: of a log of servos, measured torque of each joint; () where it has none.
        joint_time: time stamps of each joint; () where the log has none.
        titles: of all columns of the log, used or not.
        angle_declared: whether the unit of angles was declared (option or title), not assumed.
        length_declared: whether that of slides was.
        commanded: whether ``torque`` holds commanded positions in place of torques.
        notes: sentences on which joints of the log are those of the model, where their names
            differ, and on what is not used.
    """

    time: Column | None
    rate: float | None
    position: tuple[Column, ...]
    torque: tuple[Column, ...]
    velocity: tuple[Column, ...]
    joint_time: tuple[Column, ...]
    titles: Sequence[str]
    angle_declared: bool
    commanded: bool
    notes: tuple[str, ...]
    length_declared: bool = False
    motor_torque: tuple[Column, ...] = ()

    def groups(self) -> tuple[tuple[Column, ...], ...]:
        """Return the columns of position, torque, velocity, motor torque and joint time; () for one
        that the log does not have.
        """
        return (
            self.position,
            self.torque,
            self.velocity,
            self.motor_torque,
            self.joint_time,
        )

    def columns(self) -> list[Column]:
        """Return all columns: time, where there is one, then ``groups`` one after the other."""
        time = [self.time] if self.time else []
        return [*time, *chain(*self.groups())]

    def describe(self) -> str:
        """Return a sentence on the columns that are used, and on the others."""
        time = _quote([self.time]) if self.time else f"row number at {self.rate:g} Hz"
        velocity = "differentiated from position"
        if self.velocity:
            velocity = f"from {_quote(self.velocity)}"
        quantity = "command" if self.commanded else "torque"
        used = (
            f"time from {time}; position from {_quote(self.position)}; "
            f"velocity {velocity}; {quantity} from {_quote(self.torque)}"
        )
        if self.motor_torque:
            used += f"; motor torque from {_quote(self.motor_torque)}"
        if self.joint_time:
            used += f"; own time from {_quote(self.joint_time)}"
        indices = {column.index for column in self.columns()}
        others = [t for index, t in enumerate(self.titles) if index not in indices]
        unused = [*_ends_of_counted(others)]
        if len(unused) > MOST_LISTED:
            unused[MOST_LISTED:] = [f"{len(unused) - MOST_LISTED} more"]
        return f"{used}; not used: {', '.join(unused)}" if unused else used


def _quote(columns: Sequence[Column]) -> str:
    """Return titles in quotes, with their factors; of titles that are counted the ends."""
    return ", ".join(_ends_of_counted(_quoted_titles(columns)))


def _ends_of_counted(texts: Sequence[str]) -> Iterator[str]:
    """Yield texts, of three or more in a row that are counted the first and the last."""
    for _, group in groupby(texts, lambda text: _WHOLE_NUMBER.sub("", text)):
        row = [*group]
        if len(row) > 2 and _are_counted(row):
            yield f"{row[0]} ... {row[-1]}"
        else:
            yield from row


def _are_counted(texts: Sequence[str]) -> bool:
    """Return whether one whole number in texts of one form goes up by one from each to the next."""
    numbers = np.array([_WHOLE_NUMBER.findall(text) for text in texts], dtype=float)
    steps = np.diff(numbers, axis=0)
    return bool(np.all(steps == steps[0]) and [*steps[0][steps[0] != 0.0]] == [1.0])


def _quoted_titles(columns: Sequence[Column]) -> list[str]:
    """Return each title in quotes, with its factor."""
    texts = []
    for column in columns:
        if not column.factor:
            texts.append(column.title)
            continue
        text = f"'{column.title}'"
        if column.zero:
            text = f"({text} - {column.zero:g})"
        scale = "" if column.factor == 1.0 else f" x {column.factor:.6g}"
        texts.append(f"{text}{scale}")
    return texts


@dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """What the sensors of an arm read, in N samples of n joints, from a log or a simulation.

    It is one record from the reader to the low-pass: a whole log, a stretch of it, or a chunk of a
    simulation. ``recording[a:b]`` is the recording of consecutive samples, of which the arrays are
    views.

    Attributes:
        time: (N,) [s], increasing.
        q: (N, n) positions [rad].
        tau: (N, n) joint torques [N m]; position errors [rad] where ``command`` is not None.
        qd, qdd: (N, n) velocities, accelerations [rad/s, rad/s^2]; None where the log has none.
        joint_time: (N, n) when each joint was sampled [s]; None where ``time`` holds for all.
        command: (N, n) commanded positions [rad], of a log of servos; else None.
        motor_torque: (N, n) torques [N m] that were measured beside the commands, as from motor
            currents, zero of joints without; None where the log has none.
        hole: (N,) length of the hole in the log that a sample bridges [s]: zero where it bridges
            none, infinite where something is wrong with it and no estimate uses it; None for zeros.
        name: path of the log as the user gave it, which messages have; "" of a simulation.
        joint_names: (n,) of the arm that a log was read for, base to terminal.
        columns: the column of the file that each quantity of a log was read from.
        options: name to value of the options with which a log was read.
        notes: sentences for the user on columns, rows left out and corrections.
        is_loaded: whether the arm carries the payload.
        order: position among all recordings in time, from -1 for the first to 1 for the last; 0
            where the order is not known.
        setting: what servos were recorded with.
    """

    time: Array
    q: Array
    qd: Array | None
    tau: Array
    qdd: Array | None = None
    joint_time: Array | None = None
    command: Array | None = None
    motor_torque: Array | None = None
    hole: Array | None = None
    name: str = ""
    joint_names: tuple[str, ...] = ()
    columns: ColumnMap | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    is_loaded: bool = False
    order: float = 0.0
    setting: ServoSetting = UNKNOWN

    def __post_init__(self) -> None:
        _check_samples(
            self, "qd", "tau", "qdd", "joint_time", "command", "motor_torque"
        )

    def __len__(self) -> int:
        return len(self.time)

    def __getitem__(self, rows: slice) -> Recording:
        arrays = {name: values[rows] for name, values in self.arrays().items()}
        return replace(self, **arrays)

    def __fspath__(self) -> str:
        """The path, so that a log that was read may stand where its file is expected."""
        return self.name

    __str__ = __fspath__

    def __repr__(self) -> str:
        size = f"{len(self)} samples of {count_text(self.q.shape[1], 'joint')}"
        return f"<Recording {self.name}: {size} in {self.duration:.4g} s>"

    @property
    def duration(self) -> float:
        """Time from the first to the last sample, without what is between recordings [s]."""
        separations = RECORDING_SEPARATION * np.count_nonzero(self.is_separation)
        return float(np.ptp(self.time)) - separations

    @property
    def is_separation(self) -> NDArray[np.bool_]:
        """Which steps (N - 1,) from sample to sample lead to the next recording."""
        step = np.diff(self.time)
        return np.isclose(step, RECORDING_SEPARATION, rtol=0.0, atol=1e-6)

    @property
    def is_left_out(self) -> NDArray[np.bool_]:
        """Which samples (N,) something is wrong with, so that no estimate uses them."""
        return np.isinf(np.zeros(len(self)) if self.hole is None else self.hole)

    def arrays(self) -> dict[str, Any]:
        """Return name to samples of what was recorded."""
        of_samples = {name: getattr(self, name) for name in _SAMPLED}
        return {
            name: values for name, values in of_samples.items() if values is not None
        }


# Fields of a recording with an element or row per sample.
_SAMPLED = (
    "time",
    "q",
    "qd",
    "tau",
    "qdd",
    "joint_time",
    "command",
    "motor_torque",
    "hole",
)


def join_recordings(chunks: Iterable[Recording]) -> Recording:
    """Return consecutive chunks as one recording; all have the same quantities."""
    chunks = list(chunks)
    arrays: dict[str, Any] = {}
    for name in chunks[0].arrays():
        arrays[name] = np.concatenate([getattr(chunk, name) for chunk in chunks])
    return replace(chunks[0], **arrays)


@dataclass(frozen=True, eq=False)
class JointErrors:
    """Torque errors of J joints as sums of squares, from which every error that is stated follows.

    Attributes:
        joint_names: of the joints, base to terminal.
        blocks: (B, J) sums of the squared errors of each joint in blocks of time [N^2 m^2].
        counts: (J,) number of samples in the sums of each joint.
    """

    joint_names: tuple[str, ...]
    blocks: Array
    counts: Array

    @property
    def squares(self) -> Array:
        """Sums (J,) of the squared errors of each joint [N^2 m^2]."""
        return np.asarray(np.sum(self.blocks, axis=0))

    @property
    def rmse(self) -> float:
        """Root mean square error of all joints [N m]."""
        return float(
            np.sqrt(np.sum(self.squares) / max(float(np.sum(self.counts)), 1.0))
        )

    @property
    def rmse_per_joint(self) -> dict[str, float]:
        """Joint name to its root mean square error [N m]."""
        errors = np.sqrt(self.squares / np.maximum(self.counts, 1.0))
        return dict(zip(self.joint_names, errors.tolist()))


@dataclass(frozen=True, eq=False)
class FitQuality(JointErrors):
    """What the equations of a fit determine, and how well it describes them.

    Attributes:
        condition_number: of the stacked regressor, or of its identifiable part where it has less
            than full rank.
        n_base_params: number of identifiable combinations of the terminal link's parameters and its
            joint's friction.
        unidentifiable: parameters that the data alone does not determine, in words, for instance
            "mass".
        noise_per_joint: joint name to standard deviation of its torque noise [N m], where used.
    """

    condition_number: float
    n_base_params: int
    unidentifiable: tuple[str, ...]
    noise_per_joint: Mapping[str, float]

    @property
    def samples_per_joint(self) -> dict[str, int]:
        """Joint name to the number of samples of its equations."""
        return dict(zip(self.joint_names, self.counts.astype(int).tolist()))


@dataclass(frozen=True, eq=False)
class Validation(JointErrors):
    """Torque prediction errors on some data.

    Attributes:
        source: description of the data.
        squared_torque: (J,) sum of the squared torques of each joint [N^2 m^2].
        is_informative: whether the fitted data determines the torque of such a motion well enough
            for these errors to speak against the fit.
    """

    source: str
    squared_torque: Array
    is_informative: bool

    @property
    def n_samples(self) -> int:
        """Number of samples of the joint that has most."""
        return int(np.max(self.counts, initial=0))

    @property
    def relative_error(self) -> float | None:
        """||tau - prediction|| / ||tau|| of all joints; None where tau is zero."""
        return _relative(
            float(np.sum(self.squares)), float(np.sum(self.squared_torque))
        )

    @property
    def relative_error_per_joint(self) -> dict[str, float | None]:
        """Joint name to its relative error, or None."""
        errors = map(_relative, self.squares, self.squared_torque)
        return dict(zip(self.joint_names, errors))


def _relative(error: float, torque: float) -> float | None:
    """Return a relative error from squares; None where there is no torque."""
    return float(np.sqrt(error / torque)) if torque > 0.0 else None


Error = TypeVar("Error")


@dataclass(frozen=True)
class Errors(Generic[Error]):
    """Torque errors of two models on the same data.

    Attributes:
        before: of the original model.
        after: of the written model.
    """

    before: Error
    after: Error


@dataclass(frozen=True)
class ModelErrors(Errors[Validation]):
    """Torque errors of two models in recordings, each joint's sensor offset removed.

    Attributes:
        as_used: with offsets counted as errors: no file holds them.
    """

    as_used: Errors[Validation]

    @property
    def before_as_used(self) -> Validation:
        """Error of the original model with offsets counted as errors."""
        return self.as_used.before

    @property
    def after_as_used(self) -> Validation:
        """Error of the written model with offsets counted as errors."""
        return self.as_used.after


ITSELF = "simulation of the model itself"
"""Description of the data of a self-test."""


@dataclass(frozen=True)
class DataOrigin:
    """Where the data of an identification comes from.

    Attributes:
        description: such as "log arm.csv", or ``ITSELF``.
        duration: [s].
        sample_rate: [Hz].
        seed: of trajectory and simulated noise; None for a log.
        files: full paths of the logs.
    """

    description: str
    duration: float
    sample_rate: float
    seed: int | None = None
    files: tuple[str, ...] = ()


SIGNAL_NAMES = ("qd", "measured", "predicted", "prior_prediction", "friction")
"""The fields of ``Traces`` with one column per joint."""


@dataclass(frozen=True)
class Traces:
    """Speeds and torques of n joints at all K instants of a result's data, which figures draw.

    Attributes:
        joints: names, base to terminal.
        is_slide: (n,) whether a joint is a slide.
        time: (K,), which starts anew with each log [s].
        qd: (K, n) velocities [rad/s].
        measured: (K, n) torque [N m]; NaN where a sample was not used.
        predicted: (K, n) torque that the result predicts [N m].
        prior_prediction: (K, n) torque [N m] that the model predicts as its file has it; of a
            payload, torque of the arm without it.
        friction: (K, n) the part of ``predicted`` that is friction [N m].
    """

    joints: tuple[str, ...]
    is_slide: tuple[bool, ...]
    time: Array
    qd: Array
    measured: Array
    predicted: Array
    prior_prediction: Array
    friction: Array

    def __post_init__(self) -> None:
        shapes = {np.shape(getattr(self, name)) for name in SIGNAL_NAMES}
        if shapes != {(len(self.time), len(self.joints))}:
            raise InputError(f"signals of a result have the shapes {shapes}")

    @property
    def residual(self) -> Array:
        """Measured minus predicted torque (K, n) [N m]; NaN where a sample was not used."""
        return self.measured - self.predicted
