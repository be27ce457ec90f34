"""Data that a run saves for its report (report_data.npz), and loading of a finished run.

``report_data`` thins the signals of a log of any length to at most ``MAX_INSTANTS`` instants and
computes statistics of all instants: histogram, autocorrelation and speed bins of the residual.
``load_run`` reads these data and the run's params.json from its folder.
"""

from __future__ import annotations

import hashlib
import io
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.uncertainty import autocovariance
from robot_sysid.export import SCHEMA_VERSION
from robot_sysid.logs.arrays import npz_arrays
from robot_sysid.logs.table import as_input_errors
from robot_sysid.records import SIGNAL_NAMES, Array, Signals, Source, Traces, Validation
from robot_sysid.records.file_access import PARAMS_NAME, read_json
from robot_sysid.results.body_errors import ERROR_NAMES
from robot_sysid.results.record import PAYLOAD, Quantity

DATA_NAME = "report_data.npz"
"""Name of the file of a run's folder that holds ``ReportData``."""
MAX_INSTANTS = 2000
"""Largest number of instants saved for drawing: more than a figure has pixels across."""
BINS = 31
"""Number of bars of a histogram of residuals: as many as a figure of 11 cm shows."""
SPEED_BINS = 24
"""Number of speed bins per joint: as many as a figure of 11 cm shows."""
LONGEST_LAG = 2.0
"""Largest lag of the autocorrelation [s]: ten times that over which friction is correlated."""
_MOST_LAGS = 80
"""Largest number of lags above zero of which the autocorrelation is saved."""
_WIDE = 4.0
"""Half width of a histogram in root mean squares of the residual: normal noise exceeds it once in
16 000 samples."""
_LEAST_IN_BIN = 4
"""Smallest number of samples of a speed bin whose mean is meaningful."""
_VERSION = 1
"""Version of the format of report_data.npz; a file of another version is not read."""
_REMEDY = "identify again"
"""End of an error message: what the user can do about a file that cannot be read."""
BY_SPEED = ("speed", "friction_measured", "friction_predicted")
"""Fields of ``ReportData`` that hold means in bins of speed."""


@dataclass(frozen=True)
class ReportData(Signals):
    """Signals of n joints at K <= ``MAX_INSTANTS`` instants to draw; statistics of all instants.

    The time of the inherited signals grows from log to log, with a gap of a second between logs.
    Units are those of hinges; positions of slides are in m, their torques in N.

    Attributes:
        n_samples: number of instants of the run, of which K are drawn.
        edges: (n, B + 1) edges of the histogram's B = ``BINS`` bins of the residual [N m].
        counts: (n, B) number of residuals in each bin.
        lags: (L,) time lags of the autocorrelation [s], the first zero.
        correlation: (n, L) autocorrelation of the residual, 1 at lag zero.
        independent: (n,) absolute autocorrelation that white noise exceeds in one lag of twenty.
        speed: (n, S) mean velocity in each of S = ``SPEED_BINS`` bins [rad/s]; this and the
            following two are NaN in a bin with hardly any samples.
        friction_measured: (n, S) mean of the predicted friction plus the residual [N m].
        friction_predicted: (n, S) mean of the predicted friction torque in each bin [N m].
        lower: (n,) lower position limits [rad]; infinite where there is none.
        upper: (n,) upper position limits [rad]; infinite where there is none.
        velocity: (n,) velocity limits [rad/s]; infinite where there is none.
        torque: (n,) torque limits [N m]; infinite where there is none.
        truth: (10,) true parameters of a simulated arm's terminal link; (0,) for a real arm.
        result: SHA-256 hash of the params.json that these data belong to.
    """

    n_samples: int
    edges: Array
    counts: Array
    lags: Array
    correlation: Array
    independent: Array
    speed: Array
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
        """Sentence on how many instants are drawn of how many; "" if all of them are drawn."""
        if len(self.time) >= self.n_samples:
            return ""
        return f"drawn: {len(self.time)} of {self.n_samples} instants; statistics are of all"


def report_data(traces: Traces, result: str = "") -> ReportData:
    """Return evenly thinned signals and statistics of the signals of a run, for its report.

    Args:
        traces: signals of n joints at all instants of the run's logs.
        result: SHA-256 hash of the run's params.json.
    """
    count = len(traces.time)
    indices = _spread_indices(count - 1, MAX_INSTANTS)
    residual = traces.residual
    # The time starts anew with each log: here one log follows the other, a second apart.
    steps = np.diff(traces.time, prepend=traces.time[:1])
    time = np.cumsum(np.where(steps < 0.0, 1.0, steps))
    drawn: dict[str, Any] = {}
    for name in SIGNAL_NAMES:
        drawn[name] = np.asarray(getattr(traces, name)[indices], np.float32)
    return ReportData(
        joints=traces.joints,
        is_slide=traces.is_slide,
        time=time[indices],
        **drawn,
        n_samples=count,
        **histogram(residual),
        **autocorrelation(time, residual),
        **means_by_speed(traces.qd, residual, traces.friction),
        **vars(traces.limits),
        truth=np.zeros(0) if traces.truth is None else traces.truth.theta,
        result=result,
    )


def _spread_indices(last: int, largest_count: int) -> NDArray[np.int64]:
    """Return at most ``largest_count`` evenly spread indices from 0 to ``last``, both included."""
    count = min(last + 1, largest_count)
    return np.unique(np.linspace(0, last, count).round().astype(int))


def data_bytes(data: ReportData) -> bytes:
    """Return the content of report_data.npz; equal data give equal bytes."""
    arrays = {**vars(data)}
    # In the file, the prior prediction has the name "before".
    arrays["before"] = arrays.pop("prior_prediction")
    buffer = io.BytesIO()
    np.savez_compressed(buffer, version=_VERSION, **arrays)
    return buffer.getvalue()


def load_data(path: Path) -> ReportData:
    """Return the data of a file that ``data_bytes`` made.

    Raises InputError if there is no such file, it is damaged or its version is not ``_VERSION``.
    """
    # All other fields are arrays of floats.
    converters: dict[str, Callable[[Array], Any]] = {
        "n_samples": int,
        "result": str,
        "joints": lambda a: tuple(map(str, a)),
        "is_slide": lambda a: tuple(map(bool, a)),
    }
    try:
        with as_input_errors(path, "the data of a report"):
            content = npz_arrays(path)
            if content.pop("version", None) != _VERSION:
                raise InputError(f"{path} was written by another version")
            content["prior_prediction"] = content.pop("before")
            values = {}
            for data_field in fields(ReportData):
                convert = converters.get(
                    data_field.name, partial(np.asarray, dtype=float)
                )
                values[data_field.name] = convert(content[data_field.name])
            return ReportData(**values)
    except InputError as error:
        remedy = "identify again with this version to have it written"
        raise InputError(f"{error}; {remedy}") from None


def histogram(residual: Array) -> dict[str, Array]:
    """Return the histogram of each joint's residuals over plus and minus four root mean squares.

    Args:
        residual: (K, n) residuals [N m]; NaN where a sample was not used.

    Returns:
        "edges": (n, B + 1) edges of the B = ``BINS`` bins [N m]; "counts": (n, B) residuals in each
        bin, those beyond the outermost edges in the outermost bins.
    """
    edges = []
    counts = []
    for column in residual.T:
        finite = column[np.isfinite(column)]
        reach = _WIDE * float(np.sqrt(np.mean(finite**2))) if len(finite) else 0.0
        # Any width serves where all residuals are zero.
        reach = reach or 1.0
        joint_edges = np.linspace(-reach, reach, BINS + 1)
        within_edges = np.clip(finite, joint_edges[0], joint_edges[-1])
        edges.append(joint_edges)
        counts.append(np.histogram(within_edges, joint_edges)[0])
    return {"edges": np.array(edges), "counts": np.array(counts, dtype=float)}


def autocorrelation(time: Array, residual: Array) -> dict[str, Array]:
    """Return the autocorrelation of each joint's residual and the bound that white noise keeps.

    r(l) = mean(e_k e_{k+l}) / mean(e_k^2) over the pairs of samples that were both used. The
    correlation of white noise exceeds 1.96 / sqrt(samples) in one lag of twenty (Box, Jenkins,
    "Time Series Analysis", 1970, ch. 2). Lags are at most a quarter of the recording.

    Args:
        time: (K,) instants [s].
        residual: (K, n) residuals; NaN where a sample was not used.

    Returns:
        "lags": (L,) from zero, up to ``LONGEST_LAG`` [s]; "correlation": (n, L), zero for a joint
        whose residuals are all zero; "independent": (n,) the bound 1.96 / sqrt(samples).
    """
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    step = step or 1.0
    largest_shift = int(min(LONGEST_LAG / step, len(time) // 4))
    shifts = _spread_indices(largest_shift, _MOST_LAGS + 1)
    correlation = []
    for column in residual.T:
        covariance, *_ = autocovariance(column, largest_shift)
        # Where all residuals are zero, any divisor serves.
        correlation.append((covariance / (covariance[0] or 1.0))[shifts])
    n_used = np.count_nonzero(np.isfinite(residual), axis=0)
    return {
        "lags": shifts * step,
        "correlation": np.array(correlation),
        "independent": 1.96 / np.sqrt(np.maximum(n_used, 1)),
    }


def means_by_speed(qd: Array, residual: Array, friction: Array) -> dict[str, Array]:
    """Return means of speed and friction in S = ``SPEED_BINS`` bins of a joint's velocity.

    The bins of a joint span plus and minus its largest speed.

    Args:
        qd: (K, n) velocities [rad/s].
        residual: (K, n) measured minus predicted torque [N m]; NaN where a sample was not used.
        friction: (K, n) predicted friction torque [N m].

    Returns:
        Each name in ``BY_SPEED`` to its mean (n, S), see ``ReportData``; NaN in a bin of fewer than
        ``_LEAST_IN_BIN`` samples. Samples whose residual is NaN do not count.
    """
    # In the order of BY_SPEED.
    signals = np.stack((qd, friction + residual, friction))
    means = np.full((len(BY_SPEED), qd.shape[1], SPEED_BINS), np.nan)
    for joint in range(qd.shape[1]):
        used_signals = signals[:, np.isfinite(residual[:, joint]), joint]
        speed = used_signals[0]
        fastest = float(np.max(np.abs(speed), initial=0.0)) or 1.0
        edges = np.linspace(-fastest, fastest, SPEED_BINS + 1)
        bins = np.clip(np.digitize(speed, edges) - 1, 0, SPEED_BINS - 1)
        bin_sizes = np.bincount(bins, minlength=SPEED_BINS)
        for k in np.flatnonzero(bin_sizes >= _LEAST_IN_BIN):
            means[:, joint, k] = np.mean(used_signals[:, bins == k], axis=1)
    return dict(zip(BY_SPEED, means))


@dataclass(frozen=True)
class Body:
    """One rigid body of a run's result: its parameters before and after identification.

    The ten parameters are those of ``PARAMETER_NAMES`` (mass [kg], first moment [kg m], inertia
    about the frame's origin [kg m^2]), in the body's frame, of a payload in that of the flange.

    Attributes:
        title: name of the body for the reader.
        thetas: version to parameters (10,): "after" as identified and, where they are known,
            "before" in the model, "in the file" that was written and "truth" of a simulated arm.
        errors: (10,) standard errors, all causes together; NaN where they are not known.
        budget: cause to the standard errors (10,) that it alone produces; empty if the run states
            no errors.
        central: (4,) standard errors of mass [kg] and centre of mass [m]; NaN where not known.
        share: (10,) share of each value that comes from the data, 0 to 1; NaN where not known.
        is_from_model: (10,) whether the value of a parameter is that of the model.
    """

    title: str
    thetas: Mapping[str, Array]
    errors: Array
    budget: Mapping[str, Array]
    central: Array
    share: Array
    is_from_model: Sequence[bool]

    @property
    def identified(self) -> Array:
        """Identified parameters (10,)."""
        return self.thetas["after"]

    def errors_or_none(self, errors: Array) -> list[float | None]:
        """Return ``errors`` (m,) as a list, or m times None if the run states no errors.

        A run states no errors if its data are a simulation of the model itself. ``errors`` are
        standard errors of this body, such as ``central``.
        """
        return errors.tolist() if self.budget else [None] * len(errors)


Friction = Mapping[str, Mapping[str, Quantity]]
"""Joint, or coupling of several, to friction term to its coefficient and standard error."""


@dataclass(frozen=True)
class Run:
    """A finished run, loaded from its folder.

    Attributes:
        folder: folder that the run wrote to.
        content: content of params.json, in which each number with its standard error is a
            ``Quantity``, errors per joint are a ``Validation``, a body with an error budget is a
            ``Body`` and any other set of inertial parameters is an array (10,).
        bodies: the payload, the link without and with it; or all links, the terminal one first.
        data: signals to draw; None if they cannot be read.
        missing: one sentence on why ``data`` is None; empty otherwise.
    """

    folder: Path
    content: Mapping[str, Any]
    bodies: Sequence[Body]
    data: ReportData | None
    missing: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the folder without its parents; names the run in tables."""
        return self.folder.resolve().name or str(self.folder)

    @property
    def is_payload(self) -> bool:
        """Whether the run identified a payload and not the arm's links."""
        return bool(self.content["question"] == PAYLOAD)

    @property
    def is_self_test(self) -> bool:
        """Whether the data are a simulation of the model itself: all errors are of rounding."""
        return str(self.content["source"]).startswith(Source.ITSELF.value)

    @property
    def is_fully_known(self) -> bool:
        """Whether every parameter has a value, from the data or from the model.

        That is so of a link always, since the model has values for parameters that the data does
        not determine; of a payload, if the data determines all of its parameters.
        """
        return bool(self.content["valid"]["all_identified"]) or not self.is_payload

    @property
    def log_names(self) -> str:
        """File names of the logs, or what the data are a simulation of."""
        logs = list(self.content["logs"])
        if self.is_payload:
            recordings = self.content["payload"]["recordings"].values()
            logs = list(itertools.chain.from_iterable(recordings))
        return ", ".join(Path(log).name for log in logs) or self.content["source"]

    @property
    def slides(self) -> dict[str, bool]:
        """Joint to whether it is a slide; {} if the run has no data to draw."""
        return (
            {} if self.data is None else dict(zip(self.data.joints, self.data.is_slide))
        )

    def friction(self, key: str = "terms") -> Friction:
        """Return joint or coupling to friction term to the term's coefficient and standard error.

        Args:
            key: "terms" for the identified coefficients, "in_the_file" for those of the written
                model.
        """
        owners = {**self.content["joints"], **self.content["couplings"]}
        return {owner: entry[key] for owner, entry in owners.items() if entry.get(key)}


def number(value: Any) -> float:
    """Return a number of a JSON file as a float; NaN for null, which is None here."""
    return np.nan if value is None else float(value)


def fingerprint(path: Path) -> str:
    """Return the SHA-256 hash of a file's content, in hexadecimal digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def load_run(folder: Path) -> Run:
    """Return the run whose files are in a folder.

    If report_data.npz cannot be read or belongs to another run, the run has no ``data``, and
    ``missing`` says why.

    Raises InputError if params.json is missing, damaged or of another version.
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
        content = dict(zip(content, map(_restore_records, content.values())))
        truth = None if data is None or not len(data.truth) else data.truth
        bodies = _bodies(content, truth)
        if not all(np.all(np.isfinite(body.identified)) for body in bodies):
            raise ValueError("a parameter is not a number")
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        cause = f"{type(error).__name__}: {error}"
        raise InputError(f"{path} is damaged ({cause}); {_REMEDY}") from None
    return Run(folder, content, bodies, data, missing)


def _restore_records(value: Any) -> Any:
    """Return a value of a JSON file, in which objects at any depth are replaced by records.

    An object is recognised by its keys and becomes a ``Quantity``, a ``Validation``, a ``Body`` or
    the inertial parameters (10,); other values stay as they are. KeyError, TypeError or ValueError
    if an object of a recognised type is incomplete.
    """
    if isinstance(value, list):
        return list(map(_restore_records, value))
    if not isinstance(value, dict):
        return value
    entries = dict(zip(value, map(_restore_records, value.values())))
    if entries.keys() == {"value", "standard_error", "interval"}:
        return Quantity(number(entries["value"]), number(entries["standard_error"]))
    if "relative_error_per_joint" in entries:
        return Validation(**entries)
    if "error_budget" in entries:
        return _body(entries)
    return _theta(entries) if "inertia_tensor" in entries else entries


def _bodies(content: Mapping[str, Any], truth: Array | None) -> list[Body]:
    """Return the bodies of a run.

    They are the payload, the link without it and the link with it; of a run without a payload, the
    arm's links, the terminal link first.

    Args:
        content: content of params.json, with records as from ``_restore_records``.
        truth: (10,) true parameters of the terminal link, which become its version "truth"; None
            for a real arm or a payload.
    """
    if content["question"] == PAYLOAD:
        titles = {
            "body": "payload",
            "link": "link without payload",
            "total": "link with payload",
        }
        payload = content["payload"]
        return [replace(payload[key], title=title) for key, title in titles.items()]
    links = list(content["links"])
    if not links:
        terminal_entries = {
            **content,
            "name": content["body_name"],
            "source": content["parameter_source"],
            "error_budget": {},
            "model": None,
        }
        links = [_body(terminal_entries)]
    if truth is not None:
        links[-1] = replace(links[-1], thetas={**links[-1].thetas, "truth": truth})
    return [links[-1], *links[:-1]]


def _theta(entries: Mapping[str, Any]) -> Array:
    """Return the inertial parameters (10,) of a JSON object, in the order of ``PARAMETER_NAMES``.

    ValueError if the first moment does not have three components.
    """
    inertia = itemgetter(*PARAMETER_NAMES[4:])(entries["inertia_tensor"])
    values = [entries["mass"], *entries["center_of_mass_moment"], *inertia]
    theta = np.array(values, dtype=float)
    if theta.shape != (10,):
        raise ValueError("the centre of mass has not three components")
    return theta


def _body(entries: Mapping[str, Any]) -> Body:
    """Return the body of a JSON object, in which other objects are arrays (10,) already.

    KeyError, TypeError or ValueError if an entry is missing or has another type.
    """
    thetas = {"after": _theta(entries)}
    if entries["model"] is not None:
        thetas = {"before": entries["model"], **thetas}
    if entries.get("in_the_file") is not None:
        thetas["in the file"] = entries["in_the_file"]
    sources = entries["source"]
    errors = entries["standard_errors"]
    budget = entries["error_budget"]
    budget_arrays = map(_parameter_array, budget.values())
    return Body(
        title=str(entries["name"]),
        thetas=thetas,
        errors=_parameter_array(errors),
        budget=dict(zip(budget, budget_arrays)),
        central=_parameter_array(errors, ERROR_NAMES[:4]),
        share=_parameter_array(entries.get("data_share")),
        is_from_model=[sources.get(name) == "from_model" for name in PARAMETER_NAMES],
    )


def _parameter_array(
    named: Mapping[str, Any] | None, names: Sequence[str] = PARAMETER_NAMES
) -> Array:
    """Return the values (m,) of m names in their order; NaN for null or a missing name.

    Args:
        named: name to number or None; None if no number is known.
        names: the m names, by default those of the ten inertial parameters.
    """
    named = named or {}
    return np.array(list(map(named.get, names)), dtype=float)
