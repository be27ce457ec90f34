"""The page: what its template needs of a run or of several, and the file.

Names from models and logs are text that somebody else wrote: all of it is escaped, and the page
itself forbids scripts and anything from elsewhere.
"""

from __future__ import annotations

import base64
import datetime
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid import __version__
from robot_sysid.errors import InputError
from robot_sysid.records.file_access import (
    CARD_NAME,
    PARAMS_NAME,
    REPORT_NAME,
    require_writable,
    write_atomically,
)
from robot_sysid.records.messages import (
    Level,
    Progress,
    number_text,
    percent,
    printable,
)
from robot_sysid.records.quantities import BEYOND, DIFFERENCE, LEAST_SEEN
from robot_sysid.report import figures
from robot_sysid.report.drawing import Figure, drawing_style
from robot_sysid.report.pictures import pictures
from robot_sysid.report.runs import Run
from robot_sysid.results.content import Content
from robot_sysid.results.lines import file_to_use
from robot_sysid.results.table import (
    CURVE_PARTS,
    body_rows,
    cells,
    friction_rows,
    label,
    rows_of,
    shown_columns,
)
from robot_sysid.results.verdicts import Verdict

# Errors that a page may raise if somebody has edited the run's params.json by hand.
_ODD = (ArithmeticError, AttributeError, LookupError, OSError, TypeError, ValueError)
COMPARISON_NAME = "comparison.html"
"""File name of the page that compares several runs, and of its template."""


def write_report(
    runs: Sequence[Run],
    destination: Path,
    mesh_dir: Path | None = None,
    progress: Progress | None = None,
    differences: Sequence[str] = (),
    changes: Sequence[Any] = (),
) -> Path:
    """Write the page of a run, or one that compares several, and return its path.

    Args:
        runs: one run, or the runs to compare.
        destination: folder to write to; need not exist.
        mesh_dir: folder of the meshes of the run's model; None for the folder that the model names.
        progress: is advanced while figures are drawn; None for no display.
        differences: sentences on what has changed from the first run to the second.
        changes: the numbers behind them.

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
        prose=_prose, base64=base64.b64encode, number=number_text, percent=percent
    )
    environment.globals.update(version=__version__)
    name = REPORT_NAME if len(runs) == 1 else COMPARISON_NAME
    template = environment.get_template(name)
    try:
        values = {
            "runs": list(map(_summary_of, runs)),
            "differences": differences,
            "changes": changes,
        }
        if len(runs) == 1:
            values = _values_of(runs[0], mesh_dir, progress or Progress())
        text = template.render(values)
    except (*_ODD, TemplateError) as error:
        cause = f"{type(error).__name__}: {error}"
        raise InputError(
            f"{runs[0].folder}: a result cannot be shown ({cause})"
        ) from None
    lines = map(printable, text.split("\n"))
    write_atomically(destination / name, "\n".join([*lines, ""]))
    return destination / name


def _values_of(run: Run, mesh_dir: Path | None, progress: Progress) -> dict[str, Any]:
    """Return what the template of a run's page is filled with."""
    card = run.folder / CARD_NAME
    file = run.content["file"]
    images, no_pictures = pictures(run, mesh_dir)
    with drawing_style():
        drawn = _figures_of(run, progress)
    return {
        **_summary_of(run),
        "tables": _tables(run),
        "figures": drawn,
        "bars": figures.error_bars(_errors_of_joints(run)),
        "pictures": images,
        "no_pictures": no_pictures,
        "card": card.read_text("utf-8") if card.is_file() else "",
        "elsewhere": file and file_to_use(file)["elsewhere"],
    }


def _summary_of(run: Run) -> dict[str, Any]:
    """Return what both pages say of a run: title, rating and main numbers."""
    content = run.content
    verdict = Verdict[content["status"]]
    rating = "part" if verdict.level is Level.DOUBTS else "good"
    # A run may refuse a model whose numbers it trusts.
    if content["failure"] is not None:
        rating = "bad"
    written_at = (run.folder / PARAMS_NAME).stat().st_mtime
    day = datetime.date.fromtimestamp(written_at).isoformat()
    logs = ", ".join(Path(log).name for log in content["logs"]) or content["source"]
    asked = run.bodies[0]
    main = [_table(body_rows(content, asked)[:4], asked)]
    if content["payload"] is None:
        joint = content["joint_name"]
        beyond = rows_of(content, BEYOND)
        judged = (DIFFERENCE, LEAST_SEEN)
        beyond = [row for row in beyond if row["name"] not in judged]
        main.append(_table(beyond, BEYOND))
        main.append(_table(friction_rows(content, joint), joint))
    return {
        "run": run,
        "content": content,
        "title": f"{Path(content['model']['path']).stem}, {day}: {logs}",
        "rating": rating,
        "main": [table for table in main if len(table) > 1],
    }


def _table(rows: Sequence[Content], title: str) -> list[tuple[str, ...]]:
    """Return the table of rows, headings first, with the unit behind each name."""
    shown = []
    for row in rows:
        name = f"{row['of']}: {label(row)}" if row["of"] != title else label(row)
        name += f" [{row['unit']}]" if row["unit"] else ""
        shown.append(cells({**row, "unit": ""}, name))
    return shown_columns(shown, title)


def _tables(run: Run) -> dict[str, list[list[tuple[str, ...]]]]:
    """Return the tables of a page by its section: bodies, friction, and all other numbers."""
    content = run.content
    bodies = [_table(body_rows(content, body), body) for body in run.bodies]
    friction = []
    others = []
    for owner in dict.fromkeys(row["of"] for row in content["quantities"]):
        if owner in (*run.bodies, BEYOND):
            continue
        rows = friction_rows(content, owner)
        friction += [_table(rows, owner)] if rows else []
        # Parts of friction that bends are in the whole of it.
        others += [
            row
            for row in rows_of(content, owner)
            if row not in rows and row["name"] not in CURVE_PARTS
        ]
    sensors = [_table(others, "sensors and recordings")] if others else []
    return {"bodies": bodies, "friction": friction, "sensors": sensors}


def _figures_of(run: Run, progress: Progress) -> dict[str, list[Figure]]:
    """Return the figures of a page by its section."""
    traces = run.traces
    if traces is None:
        return {}
    drawn: dict[str, list[Figure]] = {"joints": [], "torques": [], "friction": []}
    for joint in range(len(traces.joints)):
        progress.advance("Drawing the report", joint, len(traces.joints), "")
        drawn["joints"].append(figures.torque_panel(traces, joint))
        drawn["torques"].append(figures.torque_figure(traces, joint))
        if np.any(traces.friction[:, joint]):
            drawn["friction"].append(figures.friction_figure(traces, joint))
    return drawn


def _errors_of_joints(run: Run) -> dict[str, tuple[float, float]]:
    """Return joint to the relative error of its torque, before and after.

    They are those of the verdict, of the written model on data that did not make it; without such a
    file, those of the fit.
    """
    file = run.content["file"]
    if not file:
        return figures.drawn_errors(run.traces) if run.traces else {}
    used = file_to_use(file)
    before, after = (
        used[model]["relative_error_per_joint"]
        for model in ("before_as_used", "after_as_used")
    )
    errors = {}
    for joint, error in before.items():
        pair = [error, after[joint]]
        first, second = (np.nan if value is None else value for value in pair)
        errors[joint] = (float(first), float(second))
    return errors


def _prose(text: str) -> Any:
    """Return a sentence as HTML, with text between backticks as <code> elements.

    Spaces around ± and before % become non-breaking ones, "->" an arrow.
    """
    from markupsafe import Markup, escape

    with_arrows = str(escape(text)).replace(" -&gt; ", "\u00a0→\u00a0")
    unbroken = re.sub(" (?=[±%])|(?<=±) ", "\u00a0", with_arrows)
    return Markup(re.sub("`([^`]*)`", r"<code>\1</code>", unbroken))
