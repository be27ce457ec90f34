"""The page: which parts in which order, their HTML, and the files of a report.

Names from models and logs are text that somebody else wrote: all of it is escaped, and the page
itself forbids scripts and anything from elsewhere.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from robot_sysid import __version__
from robot_sysid.errors import InputError
from robot_sysid.records.data import Traces
from robot_sysid.records.file_access import (
    atomic_files,
    require_writable,
    write_atomically,
)
from robot_sysid.records.messages import Progress
from robot_sysid.report.drawing import Section, inline, png, svg
from robot_sysid.report.runs import DATA_NAME, Run, data_bytes, report_data
from robot_sysid.report.sections import signals, verdict
from robot_sysid.report.sections.parameters import (
    COMPARISON,
    card,
    parameters,
    scatter,
    visibility,
)
from robot_sysid.report.sections.picture import picture

_TEMPLATE = Path(__file__).with_name("template.html")


_ODD = (ArithmeticError, AttributeError, LookupError, OSError, TypeError, ValueError)
"""What a part raises where a result file that somebody changed by hand holds something odd."""


def sections_of(
    runs: Sequence[Run], mesh_dir: Path | None = None, progress: Progress | None = None
) -> list[Section]:
    """Return all parts of the page about a run, or about several beside each other.

    InputError where a result file holds something odd.
    """
    alone: tuple[Callable[[Run], Section | None], ...] = (
        verdict.verdict,
        card,
        scatter,
        parameters,
        visibility,
        signals.torques,
        signals.residuals,
        signals.friction,
        signals.excitation,
        signals.errors,
        signals.rollout,
        partial(picture, mesh_dir=mesh_dir),
    )
    found: list[Section | None] = []
    try:
        if len(runs) > 1:
            return [maker(runs) for maker in COMPARISON]
        for maker in alone:
            (progress or Progress()).advance(
                "Drawing the report", len(found), len(alone), ""
            )
            found.append(maker(runs[0]))
        return [section for section in found if section is not None]
    except _ODD as error:
        cause = f"{type(error).__name__}: {error}"
        raise InputError(
            f"{runs[0].folder}: a result cannot be shown ({cause})"
        ) from None


def html(title: str, sections: Sequence[Section]) -> str:
    """Return a page that opens without anything else."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    environment.filters.update(prose=_prose, base64=base64.b64encode, inline=inline)
    template = environment.from_string(_TEMPLATE.read_text(encoding="utf-8"))
    return template.render(title=title, sections=sections, version=__version__) + "\n"


def _prose(text: str) -> str:
    """Return a sentence with what stands between backticks as code; no line ends at a ± or %."""
    from markupsafe import escape

    held = re.sub(" (?=[±%])|(?<=±) ", "\u00a0", str(escape(text)))
    return re.sub("`([^`]*)`", r"<code>\1</code>", held)


REPORT_NAME = "report.html"
COMPARISON_NAME = "comparison.html"
PLOTS_NAME = "plots"


def save_data(folder: Path, traces: Traces, result: str) -> None:
    """Write what a later report of this run needs; ``result`` is the hash of its JSON file.

    InputError where it cannot be written.
    """
    write_atomically(folder / DATA_NAME, data_bytes(report_data(traces, result)))


def write_report(
    runs: Sequence[Run],
    destination: Path,
    mesh_dir: Path | None = None,
    page: bool = True,
    plots: bool = False,
    progress: Progress | None = None,
) -> tuple[Path, ...]:
    """Write the page of a run, or one that compares several, and return what was written.

    With ``plots``, each figure is written as PNG and SVG, too. InputError where a result cannot be
    shown, or nothing can be written.
    """
    require_writable(destination)
    about = runs[0].name
    name = REPORT_NAME
    if len(runs) > 1:
        about = f"{len(runs)} runs"
        name = COMPARISON_NAME
    sections = sections_of(runs, mesh_dir, progress)
    written = []
    with atomic_files() as files:
        if page:
            files.write(destination / name, html(f"robot-sysid: {about}", sections))
            written.append(destination / name)
        for figure in (
            each for section in sections for each in section.figures if plots
        ):
            kinds = {".png": png(figure)}
            if figure.drawing is not None:
                kinds[".svg"] = svg(figure).encode()
            for suffix, content in kinds.items():
                path = destination / PLOTS_NAME / (figure.name + suffix)
                files.write(path, content)
                written.append(path)
    return tuple(written)
