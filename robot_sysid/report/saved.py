"""What a run leaves in its folder for a report: report_data.npz, of a bounded size.

Torques of a log of any length become at most ``MOST`` instants to draw, and statistics of all of
them: residuals by size, by time lag and by speed.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.formats.arrays import npz_arrays
from robot_sysid.records import Array
from robot_sysid.records.data import SIGNALS, Signals, Traces

DATA_NAME = "report_data.npz"
MOST = 2000
"""Instants that are kept for drawing."""
_VERSION = 1


@dataclass(frozen=True)
class ReportData(Signals):
    """What a report draws of n joints; the time runs on from log to log.

    Attributes:
        edges, counts: (n, B + 1), (n, B) histogram of the residual [N m].
        lags, correlation: (L,) [s], (n, L) autocorrelation of the residual.
        independent: (n,) size of the correlation that noise alone exceeds in one lag of twenty.
        speed: (n, S) middles of bins of speed [rad/s]; NaN where one is empty.
        residual_mean, residual_spread: (n, S) of the residual in each bin [N m].
        friction_measured, friction_predicted: (n, S) mean friction torque in each bin [N m].
        lower, upper, velocity, torque: (n,) limits; infinite where there is none.
        truth: (10,) what a simulated arm's link really is; empty where nobody knows.
        result: hash of the JSON file that this belongs to.
    """

    n_samples: int
    edges: Array
    counts: Array
    lags: Array
    correlation: Array
    independent: Array
    speed: Array
    residual_mean: Array
    residual_spread: Array
    friction_measured: Array
    friction_predicted: Array
    lower: Array
    upper: Array
    velocity: Array
    torque: Array
    truth: Array
    result: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        n = len(self.joints)
        for name in ("counts", "correlation", "speed", "lower", "independent"):
            if len(getattr(self, name)) != n:
                raise ValueError(f"{name} does not fit {n} joints")
        if len(self.truth) not in (0, 10):
            raise ValueError("truth has no ten parameters")

    @property
    def step(self) -> int:
        """Every which instant is drawn."""
        return max(1, round(self.n_samples / max(len(self.time), 1)))

    @property
    def drawn(self) -> str:
        """What of the data is drawn, in words; empty where it is all."""
        if len(self.time) >= self.n_samples:
            return ""
        return f"drawn: {len(self.time)} of {self.n_samples} instants; statistics are of all"


def report_data(traces: Traces, result: str = "") -> ReportData:
    """Return what a report draws of some traces; ``result`` is the hash of their JSON file."""
    count = len(traces.time)
    kept = np.unique(np.linspace(0, count - 1, min(count, MOST)).round().astype(int))
    residual = traces.residual
    # The logs one after the other, a second apart.
    steps = np.diff(traces.time, prepend=traces.time[:1])
    time = np.cumsum(np.where(steps < 0.0, 1.0, steps))
    drawn: dict[str, Any] = {
        name: np.asarray(getattr(traces, name)[kept], dtype=np.float32) for name in SIGNALS
    }
    return ReportData(
        joints=traces.joints,
        is_slide=traces.is_slide,
        time=time[kept],
        **drawn,
        n_samples=count,
        **histogram(residual),
        **autocorrelation(time, residual),
        **by_speed(traces.qd, residual, traces.friction),
        **vars(traces.limits),
        truth=np.zeros(0) if traces.truth is None else traces.truth.theta,
        result=result,
    )


def data_bytes(data: ReportData) -> bytes:
    """Return the content of report_data.npz; the same for the same data."""
    arrays = {each.name: np.asarray(getattr(data, each.name)) for each in fields(data)}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, version=np.array(_VERSION), **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def load_data(path: Path) -> ReportData:
    """Return what was saved.

    Raises:
        InputError: the file is not there, or is not what this program writes.
    """
    remedy = "identify again with this version to have it written"
    if not path.exists():
        raise InputError(f"there is no {path}; {remedy}")
    try:
        content = npz_arrays(path)
    except InputError as error:
        raise InputError(f"{error}; {remedy}") from None
    version = content.pop("version", None)
    if version is None or version.shape != () or version != _VERSION:
        raise InputError(f"{path} was written by another version; {remedy}")
    try:
        return _restored(content)
    except (InputError, KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(f"{path} is damaged: {error}; {remedy}") from None


def _restored(content: Mapping[str, Array]) -> ReportData:
    values: dict[str, Any] = {each.name: content[each.name] for each in fields(ReportData)}
    kinds: dict[str, Callable[[Any], Any]] = {
        **{"n_samples": int, "result": str},
        **{"joints": lambda a: tuple(map(str, a)), "is_slide": lambda a: tuple(map(bool, a))},
    }
    for name, array in values.items():
        values[name] = kinds[name](array) if name in kinds else np.asarray(array, dtype=float)
    return ReportData(**values)


BINS, SPEED_BINS = 31, 24
LONGEST_LAG = 2.0
"""Up to which lag the autocorrelation is computed [s]."""
_MOST_LAGS = 80
_WIDE = 4.0
_LEAST_IN_BIN = 4


def histogram(residual: Array) -> dict[str, Array]:
    """Return edges (n, B + 1) and counts (n, B) of residuals (K, n), out to four times their rms.

    What is farther out is counted in the outermost bins.
    """
    edges, counts = [], []
    for column in residual.T:
        known = column[np.isfinite(column)]
        rms = float(np.sqrt(np.mean(known**2))) if len(known) else 0.0
        reach = _WIDE * rms or 1.0
        limits = np.linspace(-reach, reach, BINS + 1)
        edges.append(limits)
        counts.append(np.histogram(np.clip(known, -reach, reach), limits)[0])
    return {"edges": np.array(edges), "counts": np.array(counts, dtype=float)}


def autocorrelation(time: Array, residual: Array) -> dict[str, Array]:
    """Return lags (L,) [s], correlation (n, L) and independent (n,) of residuals (K, n).

    r(l) = mean(e_k e_{k+l}) / mean(e_k^2) over the pairs of samples that were both used. Noise
    without memory exceeds 1.96 / sqrt(pairs) in one lag of twenty (Box, Jenkins, "Time Series
    Analysis", 1970, ch. 2).

    Args:
        time: (K,) [s].
        residual: (K, n); NaN where a sample was not used.
    """
    step = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    step = step if step > 0.0 else 1.0
    last = int(min(LONGEST_LAG / step, len(time) // 4))
    shifts = np.unique(np.linspace(0, last, min(last, _MOST_LAGS) + 1).round().astype(int))
    used = np.isfinite(residual)
    values = np.where(used, residual, 0.0)
    power = np.mean(values**2, axis=0, where=used) if np.any(used) else np.zeros(used.shape[1])
    found = np.zeros((residual.shape[1], len(shifts)))
    for k, shift in enumerate(shifts):
        end = len(values) - shift
        pairs = np.sum(used[:end] & used[shift:], axis=0)
        total = np.sum(values[:end] * values[shift:], axis=0)
        scale = power * np.maximum(pairs, 1)
        found[:, k] = np.divide(total, scale, out=np.zeros_like(total), where=scale > 0.0)
    independent = 1.96 / np.sqrt(np.maximum(np.sum(used, axis=0), 1))
    return {"lags": shifts * step, "correlation": found, "independent": independent}


BY_SPEED = (
    *("speed", "residual_mean", "residual_spread"),
    *("friction_measured", "friction_predicted"),
)


def by_speed(qd: Array, residual: Array, friction: Array) -> dict[str, Array]:
    """Return means in bins of each joint's own speed, and the residual's standard deviation.

    Args:
        qd, residual, friction: (K, n); the residual is NaN where a sample was not used.

    Returns:
        ``BY_SPEED`` to (n, S); NaN where a bin has hardly any samples.
    """
    found = {name: np.full((qd.shape[1], SPEED_BINS), np.nan) for name in BY_SPEED}
    for joint, speed in enumerate(qd.T):
        used = np.isfinite(residual[:, joint])
        fastest = float(np.max(np.abs(speed), initial=0.0, where=used)) or 1.0
        edges = np.linspace(-fastest, fastest, SPEED_BINS + 1)
        place = np.clip(np.digitize(speed, edges) - 1, 0, SPEED_BINS - 1)
        for k in range(SPEED_BINS):
            here = used & (place == k)
            if np.count_nonzero(here) < _LEAST_IN_BIN:
                continue
            left, predicted = residual[here, joint], friction[here, joint]
            means = (np.mean(each) for each in (predicted + left, predicted))
            numbers = np.mean(speed[here]), np.mean(left), np.std(left), *means
            for name, number in zip(BY_SPEED, numbers):
                found[name][joint, k] = number
    return found
