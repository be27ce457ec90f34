"""The page: which parts in which order, their HTML, and the files of a report.

Names from models and logs are text that somebody else wrote: all of it is escaped, and the page
itself forbids scripts and anything from elsewhere.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from robot_sysid import __version__
from robot_sysid.records.atomic_files import require_writable, whole_files
from robot_sysid.records.data import Traces
from robot_sysid.report.drawing import Section, inline, png, svg
from robot_sysid.report.runs import DATA_NAME, Run, data_bytes, load_run, report_data
from robot_sysid.report.sections import comparison, signals, verdict
from robot_sysid.report.sections.parameters import card, parameters, scatter, visibility
from robot_sysid.report.sections.picture import picture

_TEMPLATE = Path(__file__).with_name("template.html")


def sections_of(run: Run, mesh_dir: Path | None = None) -> list[Section]:
    """Return all parts of a run's page."""
    makers = (
        *(verdict.verdict, card, scatter, parameters, visibility),
        *(signals.torques, signals.residuals, signals.friction, signals.excitation),
        *(signals.errors, signals.rollout),
        partial(picture, mesh_dir=mesh_dir),
        verdict.next_steps,
    )
    return list(_made(makers, run))


def sections_comparing(runs: Sequence[Run]) -> list[Section]:
    """Return all parts of a page about several runs."""
    makers = comparison.verdicts, comparison.compared, comparison.friction_beside
    return list(_made((*makers, comparison.predicted), runs))


def _made(
    makers: Sequence[Callable[[Any], Section | None]], about: Run | Sequence[Run]
) -> Iterator[Section]:
    """Yield the parts; where the result file holds something odd, what it was in a part's place."""
    odd = (ArithmeticError, AttributeError, LookupError, OSError, TypeError, ValueError)
    for maker in makers:
        name = getattr(maker, "__name__", "picture")
        try:
            section = maker(about)
        except odd as error:
            cause = f"this part cannot be shown: the result holds {type(error).__name__}: {error}"
            section = Section(name, name.capitalize().replace("_", " "), missing=(cause,))
        if section is not None:
            yield section


def html(title: str, sections: Sequence[Section]) -> str:
    """Return a page that opens without anything else."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.filters.update(prose=_prose, picture=_picture, inline=inline)
    template = environment.from_string(_TEMPLATE.read_text(encoding="utf-8"))
    return template.render(title=title, sections=sections, version=__version__) + "\n"


def _prose(text: str) -> str:
    """Return a sentence with what stands between backticks as code."""
    from markupsafe import escape

    return re.sub("`([^`]*)`", r"<code>\1</code>", str(escape(text)))


def _picture(content: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(content).decode('ascii')}"


REPORT_NAME, COMPARISON_NAME, PLOTS_NAME = "report.html", "comparison.html", "plots"


def save_data(folder: Path, traces: Traces, result: str) -> Path:
    """Write what a later report of this run needs; ``result`` is the hash of its JSON file.

    Raises:
        InputError: it cannot be written.
    """
    with whole_files() as files:
        files.write(folder / DATA_NAME, data_bytes(report_data(traces, result)))
    return folder / DATA_NAME


def write_report(
    folders: Sequence[Path],
    destination: Path,
    mesh_dir: Path | None = None,
    page: bool = True,
    plots: bool = False,
) -> tuple[Path, ...]:
    """Write the page of a run, or one that compares several, and return what was written.

    With ``plots``, each figure is written as PNG and SVG, too.

    Raises:
        InputError: a folder holds no result, or nothing can be written.
    """
    runs = [load_run(folder) for folder in folders]
    require_writable(destination)
    if len(runs) == 1:
        sections = sections_of(runs[0], mesh_dir)
        title, name = f"robot-sysid: {runs[0].name}", REPORT_NAME
    else:
        sections = sections_comparing(runs)
        title, name = f"robot-sysid: {len(runs)} runs", COMPARISON_NAME
    written = []
    with whole_files() as files:
        if page:
            files.write(destination / name, html(title, sections))
            written.append(destination / name)
        for figure in (each for section in sections for each in section.figures if plots):
            kinds = {".png": png(figure)}
            if figure.drawing is not None:
                kinds[".svg"] = svg(figure).encode()
            for suffix, content in kinds.items():
                path = destination / PLOTS_NAME / (figure.name + suffix)
                files.write(path, content)
                written.append(path)
    return tuple(written)
