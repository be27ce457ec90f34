"""Measured and predicted torques of a fit over time, for figures and for programs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from robot_sysid.dynamics.friction import OFFSET
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.rows import row_chunks
from robot_sysid.estimate.terms import FRICTION, PAYLOAD_NAMES
from robot_sysid.records import Array, Traces
from robot_sysid.records.data import SIGNAL_NAMES


@dataclass(frozen=True)
class FitTraces:
    """Computes the torques of a fit over time.

    It is pickled as what it computes: the sums of a fit are larger than the log.

    Attributes:
        fit: of all terms, or of a model file.
    """

    fit: Fit

    def __call__(self, every_sample: bool = True) -> Traces:
        """Return the torques at every sample of the log, or at the rows of the fit alone.

        The rows are as many as the cut-off of the low-pass needs: enough for a figure.
        """
        return traces_of(self.fit, every_sample)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how pickle makes the traces again: from the torques at every sample."""
        return StoredTraces, (_with_signals(self(), np.float32),)


@dataclass(frozen=True)
class StoredTraces:
    """Torques over time that were computed before the result was pickled.

    Attributes:
        traces: at every sample of the log, in single precision, as report_data.npz has them: a
            sensor has fewer digits.
    """

    traces: Traces

    def __call__(self, every_sample: bool = True) -> Traces:
        """Return the torques at every sample, whichever are asked for."""
        return _with_signals(self.traces, np.float64)


def _with_signals(traces: Traces, number: Callable[..., Any]) -> Traces:
    """Return traces with signals of another floating point type."""
    signals = {name: getattr(traces, name).astype(number) for name in SIGNAL_NAMES}
    return replace(traces, **signals)


def traces_of(fitted: Fit, every_sample: bool = True) -> Traces:
    """Return the measured torques, and the predictions of a fit and of the given model.

    All of them are low-passed as their log is in the fit. Both predictions contain the estimated
    offsets of the torque sensors. With a payload, the second prediction is that of the fit without
    the payload.

    Args:
        fitted: the fit.
        every_sample: whether at every sample of the log, or at the rows of the fit alone.
    """
    arm = fitted.arm
    values = fitted.by_name
    model = dict(arm.model)
    if fitted.question.loaded:
        model = {**values, **dict.fromkeys(PAYLOAD_NAMES, 0.0)}
    model.update((name, values[name]) for name in arm.terms[OFFSET.name].names)
    friction = {
        name: values[name]
        for term in fitted.equations.terms
        if term.cause == FRICTION and term.key != "armature"
        for name in term.names
    }
    chunks: list[tuple[Array, ...]] = []
    for recording in fitted.recordings:
        if every_sample:
            recording = recording.at_every_sample()
        for rows in row_chunks(recording, 36 * arm.robot.n_joints):
            signals = (
                rows.motion.time,
                rows.motion.qd[:, arm.indices],
                arm.measured_torque(rows),
                arm.torque(rows, fitted.point, values),
                arm.torque(rows, fitted.point, model),
                arm.torque(rows, fitted.point, friction) - arm.known(rows),
            )
            chunks.append(signals)
    is_slide = tuple(arm.robot.is_slide[arm.indices].tolist())
    return Traces(arm.joints, is_slide, *map(np.concatenate, zip(*chunks)))
