"""An earlier run as its folder tells it."""

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
from robot_sysid.records.results import PARAMS_NAME, Source
from robot_sysid.report.saved import DATA_NAME, ReportData, load_data
from robot_sysid.results.json import SCHEMA_VERSION
from robot_sysid.results.record import LINK, PAYLOAD

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
    """Return theta (10,) of JSON entries."""
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
