"""An earlier run as its folder tells it, whichever command made it and however old it is."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.errors import InputError
from robot_sysid.json_files import read_json
from robot_sysid.records import Array
from robot_sysid.records.results import ARM_NAME, PARAMS_NAME, Source
from robot_sysid.report.saved import DATA_NAME, ReportData, load_data

NEWEST = 3
"""Version of params.json that this program knows all of."""
LINK, PAYLOAD, ARM = "link", "payload", "arm"


@dataclass(frozen=True)
class Body:
    """One rigid body before and after.

    Attributes:
        title: what it is called.
        after: (10,) identified parameters.
        errors: (10,) standard errors, all causes together; NaN where they are not known.
        noise: (10,) the part of them that noise explains; NaN likewise.
        before: (10,) of the model, or None.
        truth: (10,) of a simulated arm, or None.
        budget: cause to the part (10,) of the errors that it explains.
        share: (10,) how much of each value comes from the data; NaN where nothing is known.
        kept: (10,) whether a value was kept from the model.
    """

    title: str
    after: Array
    errors: Array
    noise: Array
    before: Array | None
    truth: Array | None
    budget: Mapping[str, Array]
    share: Array
    kept: tuple[bool, ...]


@dataclass(frozen=True)
class Run:
    """What a run left behind.

    Attributes:
        folder: where.
        kind: LINK, PAYLOAD or ARM.
        content: of its JSON file.
        data: what is drawn of its torques; None where there is none.
        missing: one sentence each: what is not there.
    """

    folder: Path
    kind: str
    content: Mapping[str, Any]
    data: ReportData | None
    missing: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the folder, for tables."""
        return self.folder.resolve().name or str(self.folder)

    @property
    def trustworthy(self) -> bool:
        """Whether the result may be used."""
        if self.kind == ARM:
            return self.content.get("status") == "OK"
        return bool(mapping(self.content, "valid").get("trustworthy"))

    @property
    def is_itself(self) -> bool:
        """Whether the model identified its own simulation."""
        return str(self.content.get("source", "")).startswith(Source.ITSELF.value)

    def bodies(self) -> list[Body]:
        """Return the bodies of the result, what was asked for first."""
        if self.kind == ARM:
            return [_arm_body(link) for link in self.content["links"] if link.get("identified")]
        if self.kind == PAYLOAD:
            names = {"payload": "payload", "link": "link without payload"}
            names["link_with_payload"] = "link with payload"
            return [_payload_body(self.content[key], words) for key, words in names.items()]
        return [_link_body(self.content, self.data)]

    def friction(self) -> list[tuple[str, str, float, float]]:
        """Return (joint, term, value, standard error; NaN where not known) of all joints."""
        return list(_friction(self))


def mapping(content: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """Return the entries under a key; none where there are none, as in older files."""
    found = content.get(key)
    return found if isinstance(found, Mapping) else {}


def listed(content: Mapping[str, Any], key: str) -> tuple[str, ...]:
    """Return the sentences under a key."""
    found = content.get(key)
    return tuple(str(each) for each in found) if isinstance(found, (list, tuple)) else ()


def number(value: Any) -> float:
    """Return a number of a JSON file; NaN for null."""
    if value is None or isinstance(value, bool):
        return np.nan
    return float(value)


def result_file(folder: Path) -> Path:
    """Return the JSON file of the last run that wrote to a folder.

    Raises:
        InputError: there is none.
    """
    found = [folder / name for name in (PARAMS_NAME, ARM_NAME) if (folder / name).is_file()]
    if not found:
        raise InputError(
            f"{folder} holds no result: neither {PARAMS_NAME} nor {ARM_NAME}; give the folder that "
            "an earlier run wrote to"
        )
    return max(found, key=lambda path: path.stat().st_mtime_ns)


def fingerprint(path: Path) -> str:
    """Return the hash of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def load_run(folder: Path) -> Run:
    """Return what a run left in a folder.

    Raises:
        InputError: there is no result, or its file is damaged.
    """
    path = result_file(folder)
    content = _read(path)
    data, missing = None, []
    try:
        data = load_data(folder / DATA_NAME)
        if data.result != fingerprint(path):
            raise InputError(f"{folder / DATA_NAME} belongs to another run")
    except InputError as error:
        data = None
        missing.append(f"measured and predicted torques cannot be drawn: {error}")
    version = content.get("schema_version")
    if path.name == PARAMS_NAME and version != NEWEST:
        older = f"{path.name} has schema {version!r}, this program writes {NEWEST}"
        missing.append(f"{older}: what the file does not hold is left out")
    kind = ARM if path.name == ARM_NAME else PAYLOAD if "payload" in content else LINK
    run = Run(folder, kind, content, data, tuple(missing))
    _require_whole(run, path)
    return run


def _read(path: Path) -> Mapping[str, Any]:
    content = read_json(path, "identify again")
    if not isinstance(content, dict):
        raise InputError(f"{path} is no result of this program; identify again")
    return content


def _require_whole(run: Run, path: Path) -> None:
    """Raise InputError where the ten parameters are not there."""
    try:
        bodies = run.bodies()
        if not bodies or not all(np.all(np.isfinite(body.after)) for body in bodies):
            raise ValueError("a parameter is not a number")
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        cause = f"{type(error).__name__}: {error}"
        raise InputError(f"{path} is damaged ({cause}); identify again") from None


def _theta(entries: Mapping[str, Any]) -> Array:
    """Return theta (10,) of JSON entries."""
    inertia = entries["inertia_tensor"]
    values = [entries["mass"], *entries["center_of_mass_moment"]]
    theta = np.array([number(v) for v in (*values, *(inertia[n] for n in PARAMETER_NAMES[4:]))])
    if theta.shape != (10,):
        raise ValueError("the centre of mass has not three components")
    return theta


def _ten(values: Mapping[str, Any]) -> Array:
    return np.array([number(values.get(name)) for name in PARAMETER_NAMES])


def _link_body(content: Mapping[str, Any], data: ReportData | None) -> Body:
    kept = mapping(content, "parameter_source")
    by_name = {str(k): v for k, v in mapping(content, "error_budget").items()}
    causes = dict.fromkeys(cause for n in PARAMETER_NAMES for cause in mapping(by_name, n))
    truth = None if data is None or not len(data.truth) else data.truth
    return Body(
        title=str(content.get("body_name", "link")),
        after=_theta(content),
        errors=_ten(mapping(content, "standard_errors")),
        noise=_ten(mapping(content, "standard_errors_noise")),
        before=_theta(content["prior"]) if mapping(content, "prior") else None,
        truth=truth,
        budget={
            cause: np.array([number(mapping(by_name, n).get(cause)) for n in PARAMETER_NAMES])
            for cause in causes
        },
        share=_ten(mapping(content, "data_share")),
        kept=tuple(kept.get(name) == "from_model" for name in PARAMETER_NAMES),
    )


def _payload_body(entries: Mapping[str, Any], title: str) -> Body:
    errors = _ten(mapping(entries, "standard_errors"))
    return Body(
        title=title,
        after=_theta(entries),
        errors=errors,
        noise=_ten(mapping(entries, "standard_errors_noise")),
        before=None,
        truth=None,
        budget={cause: _ten(part) for cause, part in mapping(entries, "error_budget").items()},
        share=np.full(10, np.nan),
        kept=(False,) * 10,
    )


def _arm_body(link: Mapping[str, Any]) -> Body:
    return Body(
        title=str(link["body"]),
        after=_theta(link["identified"]),
        errors=_ten(mapping(link, "standard_errors")),
        noise=np.full(10, np.nan),
        before=_theta(link["model"]) if link.get("model") else None,
        truth=None,
        budget={},
        share=np.full(10, np.nan),
        kept=(False,) * 10,
    )


def _friction(run: Run) -> Any:
    """Yield what ``Run.friction`` returns."""
    content = run.content
    if run.kind == LINK:
        errors = mapping(content, "standard_errors")
        for joint, terms in mapping(content, "friction_per_joint").items():
            for term, value in terms.items():
                yield joint, term, number(value), number(errors.get(f"{term}[{joint}]"))
        return
    if run.kind == ARM:
        owners = {**mapping(content, "joints"), **mapping(content, "motors")}
        entries = {(o, term): entry for o, terms in owners.items() for term, entry in terms.items()}
    else:
        parts = {name: name.partition("[") for name in mapping(content, "parameters")}
        inside = {name: (rest[:-1], term) for name, (term, found, rest) in parts.items() if found}
        entries = {key: content["parameters"][name] for name, key in inside.items()}
    for (owner, term), entry in entries.items():
        if isinstance(entry, Mapping) and "standard_error" in entry:
            yield owner, term, number(entry["value"]), number(entry["standard_error"])
