"""The page: what its template needs of a run or of several, and the file.

Names from models and logs are text that somebody else wrote: all of it is escaped, and the page
itself forbids scripts and anything from elsewhere.
"""

from __future__ import annotations

import base64
import datetime
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid import __version__
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.errors import InputError
from robot_sysid.records import Traces
from robot_sysid.records.file_access import (
    CARD_NAME,
    PARAMS_NAME,
    require_writable,
    write_atomically,
)
from robot_sysid.records.messages import (
    Progress,
    number_text,
    percent,
    term_unit,
    with_error,
)
from robot_sysid.report import figures
from robot_sysid.report.drawing import Figure, drawing_style
from robot_sysid.report.pictures import pictures
from robot_sysid.report.runs import Run, body_in
from robot_sysid.results.body_errors import ERROR_NAMES
from robot_sysid.results.parameter_table import (
    BeforeAfter,
    central_numbers,
    friction_rows,
    ten_rows,
)
from robot_sysid.results.record import Quantity, Verdict

_ODD = (ArithmeticError, AttributeError, LookupError, OSError, TypeError, ValueError)
"""Errors that a page may raise if somebody has edited the run's params.json by hand."""
REPORT_NAME = "report.html"
"""File name of the page about one run, and of its template."""
COMPARISON_NAME = "comparison.html"
"""File name of the page that compares several runs, and of its template."""


def write_report(
    runs: Sequence[Run],
    destination: Path,
    mesh_dir: Path | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write the page of a run, or one that compares several, and return its path.

    Args:
        runs: one run, or the runs to compare.
        destination: folder to write to; need not exist.
        mesh_dir: folder of the meshes of the run's model; None for the folder that the model names.
        progress: is advanced while figures are drawn; None for no display.

    Raises:
        InputError: a result file has unexpected content, or the file cannot be written.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined, TemplateError

    require_writable(destination)
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        prose=_prose,
        base64=base64.b64encode,
        number=_cell,
        percent=percent,
        quantity=_quantity_cell,
    )
    environment.globals.update(version=__version__, term_unit=term_unit)
    name = REPORT_NAME if len(runs) == 1 else COMPARISON_NAME
    template = environment.get_template(name)
    try:
        values: Mapping[str, Any] = {"runs": list(map(_summary_of, runs))}
        if len(runs) == 1:
            values = _values_of(runs[0], mesh_dir, progress or Progress())
        text = template.render(values)
    except (*_ODD, TemplateError) as error:
        cause = f"{type(error).__name__}: {error}"
        raise InputError(
            f"{runs[0].folder}: a result cannot be shown ({cause})"
        ) from None
    write_atomically(destination / name, text + "\n")
    return destination / name


def _values_of(run: Run, mesh_dir: Path | None, progress: Progress) -> dict[str, Any]:
    """Return what the template of a run's page is filled with."""
    content = run.content
    card = run.folder / CARD_NAME
    payload = content["payload"]
    is_card = payload is not None and payload["card"] is not None and card.is_file()
    entry = next(iter(run.bodies.values()))
    causes = {}
    if entry["standard_errors"].get("m") is not None:
        for cause, errors in entry["error_budget"].items():
            causes[cause] = errors["m"] or 0.0
    images, no_pictures = pictures(run, mesh_dir)
    with drawing_style():
        drawn = _figures_of(run, progress)
    return {
        **_summary_of(run),
        "tables": {name: _body_cells(run, name) for name in run.bodies},
        "figures": drawn,
        "pictures": images,
        "no_pictures": no_pictures,
        "card": card.read_text("utf-8") if is_card else "",
        "cause": max(causes, key=lambda cause: causes[cause]) if causes else "",
    }


def _summary_of(run: Run) -> dict[str, Any]:
    """Return what both pages say of a run: title, rating and main numbers."""
    content = run.content
    rating = "part" if content["status"] == Verdict.TORQUES_ONLY.name else "good"
    # A run may refuse a model whose numbers it trusts.
    is_refused = content["verdict"][0].startswith("Not usable")
    if is_refused or not content["valid"]["trustworthy"]:
        rating = "bad"
    written_at = (run.folder / PARAMS_NAME).stat().st_mtime
    day = datetime.date.fromtimestamp(written_at).isoformat()
    name = next(iter(run.bodies))
    rows = [*body_rows(run, name)[:4]]
    if run.traces is not None and not run.is_payload:
        rows += _friction_rows(run, run.traces)
    return {
        "run": run,
        "content": content,
        "title": f"{Path(content['model']['path']).stem}, {day}: {run.log_names}",
        "day": day,
        "rating": rating,
        "body_numbers": [_cells(row) for row in rows],
    }


def _figures_of(run: Run, progress: Progress) -> dict[str, list[Figure]]:
    """Return the figures of a page by its section."""
    traces = run.traces
    name, *others = run.bodies
    drawn: dict[str, list[Figure]] = {"bodies": [figures.parameter_figure(run, name)]}
    if run.bodies[name].get("error_budget"):
        drawn["bodies"].append(figures.budget_figure(name, run.bodies[name]))
    if others and not run.is_payload:
        drawn["bodies"].append(figures.mass_figure(run))
    file = run.content["file"]
    if file is not None and file["before"]["rmse_per_joint"]:
        drawn["prediction"] = [figures.prediction_figure(file)]
    if traces is None:
        return drawn
    joint = figures.most_changed(traces)
    drawn["first"] = [figures.torque_figure(traces, joint, "first")]
    for section in ("torques", "friction", "motion"):
        drawn[section] = []
    for joint in range(len(traces.joints)):
        progress.advance("Drawing the report", joint, len(traces.joints), "")
        drawn["torques"].append(figures.torque_figure(traces, joint))
        drawn["motion"].append(figures.motion_figure(traces, joint))
        if np.any(traces.friction[:, joint]):
            drawn["friction"].append(figures.friction_figure(traces, joint))
    return drawn


def body_rows(run: Run, name: str) -> list[BeforeAfter]:
    """Return the rows of a body's mass, centre of mass and inertia about it."""
    entry = run.bodies[name]
    model = entry.get("model") or {}
    prior = body_in(model) if "mass" in model else None
    shares = np.ones(10)
    if "data_share" in entry:
        shares = np.array([entry["data_share"][key] or 0.0 for key in PARAMETER_NAMES])
    errors = np.zeros(10)
    if not run.is_self_test:
        # params.json has no number for an infinite error.
        known = (entry["standard_errors"][key] for key in ERROR_NAMES)
        errors = np.array([np.inf if error is None else error for error in known])
    return ten_rows(body_in(entry), prior, errors, shares)


def _body_cells(run: Run, name: str) -> list[tuple[str, ...]]:
    """Return the rows of a body's table, the last cell its value in the written file."""
    rows = body_rows(run, name)
    written = run.bodies[name].get("in_the_file")
    if written is None:
        return [(*_cells(row), "") for row in rows]
    values = central_numbers(body_in(written)).tolist()
    return [
        (*_cells(row), number_text(value, row.error))
        for row, value in zip(rows, values)
    ]


def _cells(row: BeforeAfter) -> tuple[str, ...]:
    """Return a row as text, the unit behind the name."""
    name, *values, unit, change = row.cells
    return (f"{name} [{unit}]" if unit else name, *values, change)


def _friction_rows(run: Run, traces: Traces) -> Iterator[BeforeAfter]:
    """Return the rows of the terminal joint's friction and rotor inertia, where estimated."""
    name = run.content["joint_name"]
    joint = run.content["joints"].get(name, {"terms": {}, "model": {}})
    terms = {}
    for term, quantity in joint["terms"].items():
        error = quantity["standard_error"]
        terms[term] = Quantity(quantity["value"], np.nan if error is None else error)
    is_slide = dict(zip(traces.joints, traces.is_slide)).get(name, False)
    return friction_rows(terms, joint["model"], is_slide)


def _cell(value: float | None, error: float | None = None) -> str:
    """Return a number of params.json as text of a cell; "–" for none."""
    return "–" if value is None else number_text(float(value), error)


def _quantity_cell(entry: Mapping[str, Any]) -> str:
    """Return a number with its standard error; one without is held or not determined."""
    error = entry["standard_error"]
    if error is None:
        return f"{number_text(entry['value'])} (no ±)"
    return with_error(entry["value"], error)


def _prose(text: str) -> Any:
    """Return a sentence as HTML, with text between backticks as <code> elements.

    Spaces around ± and before % become non-breaking ones, "->" an arrow.
    """
    from markupsafe import Markup, escape

    with_arrows = str(escape(text)).replace(" -&gt; ", "\u00a0→\u00a0")
    unbroken = re.sub(" (?=[±%])|(?<=±) ", "\u00a0", with_arrows)
    return Markup(re.sub("`([^`]*)`", r"<code>\1</code>", unbroken))
