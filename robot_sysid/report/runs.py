"""What a run leaves in its folder for a report, and an earlier run as its folder tells it.

Torques of a log of any length become at most ``MOST`` instants to draw, and statistics of all of
them: residuals by size, by time lag and by speed. With them comes what the JSON file holds.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.errors import InputError
from robot_sysid.json_files import read_json
from robot_sysid.logs.formats.arrays import npz_arrays
from robot_sysid.records import Array
from robot_sysid.records.data import SIGNALS, Signals, Traces
from robot_sysid.records.results import PARAMS_NAME, Source
from robot_sysid.results.json import SCHEMA_VERSION
from robot_sysid.results.record import LINK, PAYLOAD

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
    drawn: dict[str, Any] = {n: np.asarray(getattr(traces, n)[kept], np.float32) for n in SIGNALS}
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


BY_SPEED = ("speed", "residual_mean", "residual_spread", "friction_measured", "friction_predicted")


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


_REMEDY = "identify again"


@dataclass(frozen=True)
class Body:
    """One rigid body before and after.

    Attributes:
        thetas: its parameters (10,): "after" as identified and, where they are known, "before" in
            the model, "in the file" that was written and the "truth" of a simulated arm.
        errors: (10,) standard errors, all causes together; NaN where they are not known.
        budget: cause to the part (10,) of the errors that it explains.
        share: (10,) how much of each value comes from the data; NaN where nothing is known.
        kept: (10,) whether a value was kept from the model.
    """

    title: str
    thetas: Mapping[str, Array]
    errors: Array
    budget: Mapping[str, Array]
    share: Array
    kept: tuple[bool, ...]

    @property
    def after(self) -> Array:
        """Identified parameters (10,)."""
        return self.thetas["after"]


@dataclass(frozen=True)
class Run:
    """What a run left behind: its JSON file's content, data to draw, and what is not there."""

    folder: Path
    content: Mapping[str, Any]
    data: ReportData | None
    missing: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the folder, for tables."""
        return self.folder.resolve().name or str(self.folder)

    @property
    def question(self) -> str:
        """``LINK`` or ``PAYLOAD``."""
        return PAYLOAD if self.content.get("question") == PAYLOAD else LINK

    @property
    def trustworthy(self) -> bool:
        """Whether the result may be used."""
        return bool(mapping(self.content, "valid").get("trustworthy"))

    @property
    def is_itself(self) -> bool:
        """Whether the model identified its own simulation."""
        return str(self.content.get("source", "")).startswith(Source.ITSELF.value)

    def bodies(self) -> list[Body]:
        """Return the payload, the link without and with it; or all links, the terminal one first.

        Raises:
            KeyError, TypeError, ValueError: the file is damaged.
        """
        content = self.content
        if self.question == PAYLOAD:
            titles = {"body": "payload", "link": "link without payload"}
            titles["total"] = "link with payload"
            return [_body(content["payload"][key], words) for key, words in titles.items()]
        truth = None if self.data is None or not len(self.data.truth) else self.data.truth
        alone = {**content, "name": content.get("body_name", "link"), "model": None}
        alone["source"] = content.get("parameter_source")
        *others, last = mappings(content, "links") or [alone]
        return [_body(last, str(last["name"]), truth), *(_body(e, str(e["name"])) for e in others)]

    def friction(self, kind: str = "terms") -> list[tuple[str, str, float, float]]:
        """Return (joint, term, value, standard error; NaN where not known) of all joints.

        Args:
            kind: "terms", or "in_the_file" for what the written model holds.
        """
        owners = {**mapping(self.content, "joints"), **mapping(self.content, "couplings")}
        terms = [(owner, mapping(mapping(owners, owner), kind)) for owner in owners]
        return [(owner, name, *figure(found, name)) for owner, found in terms for name in found]


def mapping(content: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """Return the entries under a key; none where there are none."""
    found = content.get(key)
    return found if isinstance(found, Mapping) else {}


def mappings(content: Mapping[str, Any], key: str) -> list[Mapping[str, Any]]:
    """Return the list of entries under a key; an empty one where there is none."""
    found = content.get(key)
    return [e for e in found if isinstance(e, Mapping)] if isinstance(found, list) else []


def listed(content: Mapping[str, Any], key: str) -> tuple[str, ...]:
    """Return the sentences under a key."""
    found = content.get(key)
    return tuple(str(each) for each in found) if isinstance(found, list) else ()


def number(value: Any) -> float:
    """Return a number of a JSON file; NaN for null."""
    return np.nan if value is None or isinstance(value, bool) else float(value)


def figure(content: Mapping[str, Any], key: str) -> tuple[float, float]:
    """Return the value and its standard error under a key; NaN where they are not known."""
    found = mapping(content, key)
    return number(found.get("value")), number(found.get("standard_error"))


def fingerprint(path: Path) -> str:
    """Return the hash of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def load_run(folder: Path) -> Run:
    """Return what a run left in a folder.

    Raises:
        InputError: there is no result, or its file is damaged or of another version.
    """
    path = folder / PARAMS_NAME
    if not path.is_file():
        raise InputError(
            f"{folder} holds no result: there is no {PARAMS_NAME}; give the folder that a run "
            f"wrote to, or {_REMEDY} where an earlier version wrote arm.json"
        )
    content = read_json(path, _REMEDY)
    if not isinstance(content, dict):
        raise InputError(f"{path} is no result of this program; {_REMEDY}")
    version = content.get("schema_version")
    if version != SCHEMA_VERSION:
        wanted = f"and this program reads {SCHEMA_VERSION}"
        raise InputError(f"{path} has schema_version {version!r:.20}, {wanted}; {_REMEDY}")
    missing: tuple[str, ...] = ()
    try:
        data: ReportData | None = load_data(folder / DATA_NAME)
        if data is not None and data.result != fingerprint(path):
            raise InputError(f"{folder / DATA_NAME} belongs to another run; {_REMEDY}")
    except InputError as error:
        data, missing = None, (f"measured and predicted torques cannot be drawn: {error}",)
    run = Run(folder, content, data, missing)
    try:
        if not all(np.all(np.isfinite(body.after)) for body in run.bodies()):
            raise ValueError("a parameter is not a number")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        cause = f"{type(error).__name__}: {error}"
        raise InputError(f"{path} is damaged ({cause}); {_REMEDY}") from None
    return run


def _theta(entries: Mapping[str, Any]) -> Array:
    inertia = entries["inertia_tensor"]
    values = [entries["mass"], *entries["center_of_mass_moment"]]
    theta = np.array([number(v) for v in (*values, *(inertia[n] for n in PARAMETER_NAMES[4:]))])
    if theta.shape != (10,):
        raise ValueError("the centre of mass has not three components")
    return theta


def _body(entries: Mapping[str, Any], title: str, truth: Array | None = None) -> Body:
    kept, budget = mapping(entries, "source"), mapping(entries, "error_budget")
    places = {"before": "model", "after": "", "in the file": "in_the_file"}
    found = {what: mapping(entries, key) if key else entries for what, key in places.items()}
    thetas = {what: _theta(each) for what, each in found.items() if each}
    return Body(
        title=title,
        thetas=thetas if truth is None else {**thetas, "truth": truth},
        errors=_ten(entries, "standard_errors"),
        budget={cause: _ten(budget, cause) for cause in budget},
        share=_ten(entries, "data_share"),
        kept=tuple(kept.get(name) == "from_model" for name in PARAMETER_NAMES),
    )


def _ten(entries: Mapping[str, Any], key: str) -> Array:
    return np.array([number(mapping(entries, key).get(name)) for name in PARAMETER_NAMES])
