"""What a run leaves in its folder for a report, and an earlier run as its folder tells it.

Torques of a log of any length become at most ``MOST`` instants to draw, and statistics of all of
them: residuals by size, by time lag and by speed. With them comes what the JSON file holds.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.uncertainty import autocovariance
from robot_sysid.export import SCHEMA_VERSION
from robot_sysid.logs.arrays import npz_arrays
from robot_sysid.records import SIGNAL_NAMES, Array, Signals, Traces, Validation
from robot_sysid.records.file_access import PARAMS_NAME, read_json
from robot_sysid.results.cards import ERROR_NAMES
from robot_sysid.results.record import PAYLOAD, Quantity

DATA_NAME = "report_data.npz"
MOST = 2000
"""Instants that are kept for drawing: more than a figure has pixels across."""
BINS = 31
SPEED_BINS = 24
"""Bars of a histogram and bins of speed: as many as a figure of 11 cm shows."""
LONGEST_LAG = 2.0
"""Up to which lag the autocorrelation is computed [s]: friction remembers for tenths of it."""
_MOST_LAGS = 80
_WIDE = 4.0
"""Reach of a histogram in root mean squares: noise is beyond it once in 16 000 samples."""
_LEAST_IN_BIN = 4
"""Samples of which a mean and a spread say anything."""
_VERSION = 1
_REMEDY = "identify again"
BY_SPEED = (
    "speed",
    "residual_mean",
    "residual_spread",
    "friction_measured",
    "friction_predicted",
)


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
        truth: (10,) parameters of a simulated arm's terminal link; empty for a real arm.
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

    @property
    def thinning_text(self) -> str:
        """Sentence on how many of the instants are drawn; "" where all are."""
        if len(self.time) >= self.n_samples:
            return ""
        return f"drawn: {len(self.time)} of {self.n_samples} instants; statistics are of all"


def report_data(traces: Traces, result: str = "") -> ReportData:
    """Return what a report draws of some traces; ``result`` is the hash of their JSON file."""
    count = len(traces.time)
    indices = np.unique(np.linspace(0, count - 1, min(count, MOST)).round().astype(int))
    residual = traces.residual
    # The logs one after the other, a second apart.
    steps = np.diff(traces.time, prepend=traces.time[:1])
    time = np.cumsum(np.where(steps < 0.0, 1.0, steps))
    drawn: dict[str, Any] = {
        name: np.asarray(getattr(traces, name)[indices], np.float32)
        for name in SIGNAL_NAMES
    }
    return ReportData(
        joints=traces.joints,
        is_slide=traces.is_slide,
        time=time[indices],
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
    arrays = {
        data_field.name: np.asarray(getattr(data, data_field.name))
        for data_field in fields(data)
    }
    arrays["before"] = arrays.pop("prior_prediction")
    buffer = io.BytesIO()
    np.savez_compressed(buffer, version=np.array(_VERSION), **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def load_data(path: Path) -> ReportData:
    """Return what was saved; InputError where there is nothing, or nothing of this program."""
    converters: dict[str, Callable[[Array], Any]] = {
        **{
            data_field.name: lambda a: np.asarray(a, dtype=float)
            for data_field in fields(ReportData)
        },
        "n_samples": int,
        "result": str,
        "joints": lambda a: tuple(map(str, a)),
        "is_slide": lambda a: tuple(map(bool, a)),
    }
    try:
        if not path.exists():
            raise InputError(f"there is no {path}")
        content = npz_arrays(path)
        if content.pop("version", None) != _VERSION:
            raise InputError(f"{path} was written by another version")
        content["prior_prediction"] = content.pop("before")
        return ReportData(
            **{name: convert(content[name]) for name, convert in converters.items()}
        )
    except InputError as error:
        cause = str(error)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        cause = f"{path} is damaged: {error}"
    raise InputError(f"{cause}; identify again with this version to have it written")


def histogram(residual: Array) -> dict[str, Array]:
    """Return edges (n, B + 1) and counts (n, B) of residuals (K, n), out to four times their rms.

    What is farther out is counted in the outermost bins.
    """
    edges = []
    counts = []
    for column in residual.T:
        finite = column[np.isfinite(column)]
        reach = _WIDE * float(np.sqrt(np.mean(finite**2))) if len(finite) else 0.0
        edges.append(np.linspace(-(reach or 1.0), reach or 1.0, BINS + 1))
        counts.append(np.histogram(np.clip(finite, *edges[-1][[0, -1]]), edges[-1])[0])
    return {"edges": np.array(edges), "counts": np.array(counts, dtype=float)}


def autocorrelation(time: Array, residual: Array) -> dict[str, Array]:
    """Return lags (L,) [s], correlation (n, L) and independent (n,) of residuals (K, n).

    r(l) = mean(e_k e_{k+l}) / mean(e_k^2) over the pairs of samples that were both used. Noise
    without memory exceeds 1.96 / sqrt(pairs) in one lag of twenty (Box, Jenkins, "Time Series
    Analysis", 1970, ch. 2). Times are (K,) [s]; a residual is NaN where a sample was not used.
    """
    step = (float(np.median(np.diff(time))) if len(time) > 1 else 0.0) or 1.0
    last = int(min(LONGEST_LAG / step, len(time) // 4))
    shifts = np.unique(
        np.linspace(0, last, min(last, _MOST_LAGS) + 1).round().astype(int)
    )
    covariances = [autocovariance(column, last)[0] for column in residual.T]
    correlation = np.array(
        [(covariance / (covariance[0] or 1.0))[shifts] for covariance in covariances]
    )
    independent = 1.96 / np.sqrt(np.maximum(np.sum(np.isfinite(residual), axis=0), 1))
    return {
        "lags": shifts * step,
        "correlation": correlation,
        "independent": independent,
    }


def by_speed(qd: Array, residual: Array, friction: Array) -> dict[str, Array]:
    """Return ``BY_SPEED`` to (n, S): means in bins of each joint's own speed, and the spread.

    Speeds, residuals and friction are (K, n), the residual NaN where a sample was not used. A bin
    with hardly any samples is NaN.
    """
    statistics = np.full((len(BY_SPEED), qd.shape[1], SPEED_BINS), np.nan)
    for joint in range(qd.shape[1]):
        used = np.isfinite(residual[:, joint])
        speed, residuals, frictions = (
            samples[used, joint] for samples in (qd, residual, friction)
        )
        fastest = float(np.max(np.abs(speed), initial=0.0)) or 1.0
        edges = np.linspace(-fastest, fastest, SPEED_BINS + 1)
        bins = np.clip(np.digitize(speed, edges) - 1, 0, SPEED_BINS - 1)
        for k in np.flatnonzero(
            np.bincount(bins, minlength=SPEED_BINS) >= _LEAST_IN_BIN
        ):
            in_bin = bins == k
            middle, mean, mean_friction = (
                np.mean(samples[in_bin]) for samples in (speed, residuals, frictions)
            )
            statistics[:, joint, k] = (
                middle,
                mean,
                np.std(residuals[in_bin]),
                mean + mean_friction,
                mean_friction,
            )
    return dict(zip(BY_SPEED, statistics))


@dataclass(frozen=True)
class Body:
    """One rigid body before and after.

    Attributes:
        thetas: its parameters (10,): "after" as identified and, where they are known, "before" in
            the model, "in the file" that was written and the "truth" of a simulated arm.
        errors: (10,) standard errors, all causes together; NaN where they are not known.
        budget: cause to the part (10,) of the errors that it explains.
        central: (4,) standard errors of mass and centre of mass; NaN where they are not known.
        share: (10,) how much of each value comes from the data; NaN where nothing is known.
        is_from_model: (10,) whether the value of a parameter was kept from the model.
    """

    title: str
    thetas: Mapping[str, Array]
    errors: Array
    budget: Mapping[str, Array]
    central: Array
    share: Array
    is_from_model: Sequence[bool]

    @property
    def after(self) -> Array:
        """Identified parameters (10,)."""
        return self.thetas["after"]

    def stated(self, errors: Array) -> list[float | None]:
        """Return errors; None where the run states none, as of a model's own simulation."""
        return [each if self.budget else None for each in errors.tolist()]


@dataclass(frozen=True)
class Run:
    """What a run left behind.

    Attributes:
        content: of its JSON file, with figures, validations and inertia as the records they were.
        bodies: the payload, the link without and with it; or all links, the terminal one first.
        data: what there is to draw.
        missing: why there is nothing, one sentence.
    """

    folder: Path
    content: Mapping[str, Any]
    bodies: Sequence[Body]
    data: ReportData | None
    missing: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the folder, for tables."""
        return self.folder.resolve().name or str(self.folder)

    @property
    def is_payload(self) -> bool:
        """Whether it was asked for a payload."""
        return bool(self.content["question"] == PAYLOAD)

    @property
    def all_known(self) -> bool:
        """Whether all of a payload is known; of a link, the model has what is not."""
        return bool(self.content["valid"]["all_identified"]) or not self.is_payload

    def friction(self, key: str = "terms") -> dict[tuple[str, str], Quantity]:
        """Return (joint, term) to its figure; ``kind`` "in_the_file" is for the written model's,
        "another_day" for another log than those of the run.
        """
        owners = {**self.content["joints"], **self.content["couplings"]}
        term_maps = [(owner, entry.get(key, {})) for owner, entry in owners.items()]
        return {
            (owner, name): quantity
            for owner, entries in term_maps
            for name, quantity in entries.items()
        }

    def friction_of_logs(self) -> dict[str, dict[tuple[str, str], Quantity]]:
        """Return "joint in LOG" to (joint, term) to its figure, where there are several logs."""
        tables: dict[str, dict[tuple[str, str], Quantity]] = {}
        for joint, entry in self.content["joints"].items():
            for log, terms in entry.get("logs", {}).items():
                table = tables.setdefault(f"joint in {log}", {})
                table.update({(joint, term): figure for term, figure in terms.items()})
        return tables


def number(value: Any) -> float:
    """Return a number of a JSON file; NaN for null."""
    return np.nan if value is None else float(value)


def fingerprint(path: Path) -> str:
    """Return the hash of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def load_run(folder: Path) -> Run:
    """Return what a run left in a folder.

    InputError where there is no result, or its file is damaged or of another version.
    """
    path = folder / PARAMS_NAME
    if not path.is_file():
        raise InputError(
            f"{folder} holds no result: there is no {PARAMS_NAME}; give the folder that a run "
            "wrote to"
        )
    content = read_json(path, _REMEDY)
    if not isinstance(content, dict):
        raise InputError(f"{path} is no result of this program; {_REMEDY}")
    version = content.get("schema_version")
    if version != SCHEMA_VERSION:
        expectation = f"and this program reads {SCHEMA_VERSION}"
        raise InputError(
            f"{path} has schema_version {version!r:.20}, {expectation}; {_REMEDY}"
        )
    missing: tuple[str, ...] = ()
    try:
        data: ReportData | None = load_data(folder / DATA_NAME)
        if data is not None and data.result != fingerprint(path):
            raise InputError(f"{folder / DATA_NAME} belongs to another run; {_REMEDY}")
    except InputError as error:
        data = None
        missing = (f"measured and predicted torques cannot be drawn: {error}",)
    try:
        content = {key: _restore_records(value) for key, value in content.items()}
        bodies = _bodies(
            content, None if data is None or not len(data.truth) else data.truth
        )
        if not all(np.all(np.isfinite(body.after)) for body in bodies):
            raise ValueError("a parameter is not a number")
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        cause = f"{type(error).__name__}: {error}"
        raise InputError(f"{path} is damaged ({cause}); {_REMEDY}") from None
    return Run(folder, content, bodies, data, missing)


def _restore_records(value: Any) -> Any:
    """Return part of a JSON file with the records in it: figures, validations, bodies, inertia."""
    if isinstance(value, list):
        return [_restore_records(item) for item in value]
    if not isinstance(value, dict):
        return value
    entries = {key: _restore_records(item) for key, item in value.items()}
    if entries.keys() == {"value", "standard_error", "interval"}:
        return Quantity(number(entries["value"]), number(entries["standard_error"]))
    if "relative_error_per_joint" in entries:
        return Validation(**entries)
    if "error_budget" in entries:
        return _body(entries)
    return _theta(entries) if "inertia_tensor" in entries else entries


def _bodies(content: Mapping[str, Any], truth: Array | None) -> list[Body]:
    if content["question"] == PAYLOAD:
        titles = {
            "body": "payload",
            "link": "link without payload",
            "total": "link with payload",
        }
        return [
            replace(content["payload"][key], title=title)
            for key, title in titles.items()
        ]
    terminal_entries = {
        **content,
        "name": content["body_name"],
        "source": content["parameter_source"],
    }
    links = list(content["links"]) or [
        _body({**terminal_entries, "error_budget": {}, "model": None})
    ]
    if truth is not None:
        links[-1] = replace(links[-1], thetas={**links[-1].thetas, "truth": truth})
    return [links[-1], *links[:-1]]


def _theta(entries: Mapping[str, Any]) -> Array:
    inertia = entries["inertia_tensor"]
    values = [entries["mass"], *entries["center_of_mass_moment"]]
    theta = np.array(
        [*values, *(inertia[name] for name in PARAMETER_NAMES[4:])], dtype=float
    )
    if theta.shape != (10,):
        raise ValueError("the centre of mass has not three components")
    return theta


def _body(entries: Mapping[str, Any]) -> Body:
    thetas = {
        "before": entries["model"],
        "after": _theta(entries),
        "in the file": entries.get("in_the_file"),
    }
    sources = entries["source"]
    return Body(
        title=str(entries["name"]),
        thetas={
            version: theta for version, theta in thetas.items() if theta is not None
        },
        errors=_parameter_array(entries["standard_errors"]),
        budget={
            cause: _parameter_array(cause_errors)
            for cause, cause_errors in entries["error_budget"].items()
        },
        central=_parameter_array(entries["standard_errors"], ERROR_NAMES[:4]),
        share=_parameter_array(entries.get("data_share")),
        is_from_model=[sources.get(name) == "from_model" for name in PARAMETER_NAMES],
    )


def _parameter_array(
    named: Mapping[str, Any] | None, names: Sequence[str] = PARAMETER_NAMES
) -> Array:
    """Return the values of the ten parameters (10,), or of other names; NaN for null."""
    return np.array([(named or {}).get(name) for name in names], dtype=float)
