"""The page: its sections in order, the verdict, comparisons of runs, HTML and files of a report.

Names from models and logs are text that somebody else wrote: all of it is escaped, and the page
itself forbids scripts and anything from elsewhere.
"""

from __future__ import annotations

import base64
import datetime
import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from operator import attrgetter
from pathlib import Path

from robot_sysid import __version__
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.errors import InputError, SysidError
from robot_sysid.mjcf.documents import read_document
from robot_sysid.mjcf.inertial import format_rmse
from robot_sysid.records.data import Traces
from robot_sysid.records.file_access import (
    MODEL_NAMES,
    PARAMS_NAME,
    atomic_files,
    require_writable,
    write_atomically,
)
from robot_sysid.records.messages import (
    PARAMETER_UNITS,
    Progress,
    number_text,
    term_unit,
    with_error,
)
from robot_sysid.report import joint_sections
from robot_sysid.report.body_sections import (
    card,
    largest_cause_text,
    main_numbers,
    parameters,
    scatter,
    visibility,
)
from robot_sysid.report.drawing import png, svg
from robot_sysid.report.joint_sections import error_sets, most_changed, total_errors
from robot_sysid.report.pictures import picture
from robot_sysid.report.runs import DATA_NAME, Run, data_bytes, report_data
from robot_sysid.report.sections import Figure, Section, table
from robot_sysid.results.record import Verdict

_TEMPLATE = Path(__file__).with_name("template.html")
"""Jinja template of the page."""
_ODD = (ArithmeticError, AttributeError, LookupError, OSError, TypeError, ValueError)
"""Errors that a section may raise if somebody has edited the run's params.json by hand."""


def sections_of(
    runs: Sequence[Run], mesh_dir: Path | None = None, progress: Progress | None = None
) -> list[Section]:
    """Return the sections of the page about one run, or of one that compares several runs.

    Args:
        runs: one run, or the runs to compare.
        mesh_dir: folder of the meshes of the run's model; None for the folder that the model names.
        progress: is advanced before each section of a single run; None for no display.

    Raises:
        InputError: a result file has unexpected content; sections cannot be made of it.
    """
    makers: tuple[Callable[[Run], Section | None], ...] = (
        verdict,
        card,
        scatter,
        parameters,
        visibility,
        joint_sections.torques,
        joint_sections.residuals,
        joint_sections.friction,
        joint_sections.excitation,
        joint_sections.errors,
        joint_sections.rollout,
        partial(picture, mesh_dir=mesh_dir),
    )
    progress = progress or Progress()
    sections: list[Section | None] = []
    try:
        if len(runs) > 1:
            return [maker(runs) for maker in COMPARISON]
        for maker in makers:
            progress.advance("Drawing the report", len(sections), len(makers), "")
            sections.append(maker(runs[0]))
        return list(filter(None, sections))
    except _ODD as error:
        cause = f"{type(error).__name__}: {error}"
        raise InputError(
            f"{runs[0].folder}: a result cannot be shown ({cause})"
        ) from None


def html(title: str, sections: Sequence[Section]) -> str:
    """Return an HTML page with figures and style inside, which refers to no other file.

    Args:
        title: title of the page, plain text.
        sections: sections in order.
    """
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    environment.filters.update(prose=_prose, base64=base64.b64encode)
    environment.globals.update(svg=svg)
    template = environment.from_string(_TEMPLATE.read_text(encoding="utf-8"))
    return template.render(title=title, sections=sections, version=__version__) + "\n"


def _prose(text: str) -> str:
    """Return a sentence as escaped HTML, with text between backticks as <code> elements.

    Spaces around ± and before % become non-breaking ones, "->" an arrow. The page's template
    (Jinja) marks the result as ``safe``, so that it is not escaped twice.
    """
    from markupsafe import escape

    with_arrows = str(escape(text)).replace(" -&gt; ", "\u00a0→\u00a0")
    unbroken = re.sub(" (?=[±%])|(?<=±) ", "\u00a0", with_arrows)
    return re.sub("`([^`]*)`", r"<code>\1</code>", unbroken)


REPORT_NAME = "report.html"
"""File name of the page about one run."""
COMPARISON_NAME = "comparison.html"
"""File name of the page that compares several runs."""
PLOTS_NAME = "plots"
"""Name of the folder of the figures' files, beside the page."""


def save_data(folder: Path, traces: Traces, result: str) -> None:
    """Write report_data.npz, from which the figures of a run can be drawn later.

    Args:
        folder: folder of the run.
        traces: signals of the run's joints at all instants.
        result: SHA-256 hash of the run's params.json, by which the two files are matched.

    Raises:
        InputError: the file cannot be written.
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
    """Write the page of a run, or one that compares several, and return the paths of all files.

    The files appear all together or, on an error, not at all.

    Args:
        runs: one run, or the runs to compare.
        destination: folder to write to; need not exist.
        mesh_dir: folder of the meshes of the run's model; None for the folder that the model names.
        page: whether the page is written.
        plots: whether each figure is written, too, as PNG and, if it is a drawing, as SVG.
        progress: is advanced before each section; None for no display.

    Raises:
        InputError: a result file has unexpected content, or a file cannot be written.
    """
    require_writable(destination)
    title = title_of(runs[0])
    name = REPORT_NAME
    if len(runs) > 1:
        title = f"{len(runs)} runs compared: {', '.join(run_by_name(runs))}"
        name = COMPARISON_NAME
    sections = sections_of(runs, mesh_dir, progress)
    contents: dict[Path, str | bytes] = {}
    if page:
        contents[destination / name] = html(title, sections)
    for section in sections if plots else ():
        for figure in section.figures:
            path = destination / PLOTS_NAME / figure.name
            contents[path.with_suffix(".png")] = figure.png
            if figure.drawing is not None:
                contents[path.with_suffix(".png")] = png(figure.drawing)
                contents[path.with_suffix(".svg")] = svg(figure.drawing, figure.name)
    with atomic_files() as files:
        for path, content in contents.items():
            files.write(path, content)
    return tuple(contents)


def title_of(run: Run) -> str:
    """Return the title of a run's page: the robot, the day of the identification, the logs."""
    path = Path(run.content["model"]["path"])
    robot = path.stem
    try:
        root = read_document(path).root
        robot = root.get("model") or root.get("name") or robot
    except SysidError:
        # The model is not where it was: its file's name has to do.
        pass
    return f"{robot}, {_day(run)}: {run.log_names}"


def _day(run: Run) -> str:
    """Return the day on which the run wrote its result, as "2026-11-24"."""
    written = (run.folder / PARAMS_NAME).stat().st_mtime
    return datetime.date.fromtimestamp(written).isoformat()


def verdict(run: Run) -> Section:
    """Return the first section of a run's page: verdict, main numbers, one torque, what limits it.

    The sentences are those of the console. A figure shows the joint torque whose prediction changed
    most, unless the data are a simulation of the model itself, or cannot be read.
    """
    content = run.content
    rating = "good"
    if content["status"] == Verdict.TORQUES_ONLY.name:
        rating = "part"
    # A run may refuse a model whose numbers it trusts, as after a rollout that is no better.
    is_refused = content["verdict"][0].startswith("Not usable")
    if is_refused or not content["valid"]["trustworthy"]:
        rating = "bad"
    numbers = main_numbers(run)
    figures: tuple[Figure, ...] = ()
    if run.data is not None and not run.is_self_test:
        figures = (most_changed(run.data),)
    return Section(
        "verdict",
        "Verdict",
        sentences=content["verdict"],
        tables=(numbers,) if rating != "bad" else (),
        points=tuple(_other_models(run)),
        figures=figures,
        missing=run.missing,
        verdict=rating,
        details=(
            ("Arm, model and data", tuple(_origin(run))),
            ("What limits the result", tuple(_limits(run))),
            ("Notes of the run", content["notes"]),
        ),
    )


def _limits(run: Run) -> Iterator[str]:
    """Yield sentences on why the result is not usable, or on what limits its accuracy."""
    yield from run.content["reasons"]
    cause = largest_cause_text(run.bodies[0])
    if cause:
        yield f"most of the mass's error comes from {cause}"
    yield from run.content["limitations"]


def _origin(run: Run) -> Iterator[str]:
    """Yield sentences on what was identified, from which data, and on the residual torque."""
    content = run.content
    joint_name = content["joint_name"]
    question = (
        f"the arm's links and joints. {run.bodies[0].title} is the terminal link with all that "
        f"is bolted to it, behind joint {joint_name}"
    )
    if run.is_payload:
        question = (
            f"a payload behind joint {joint_name}, from recordings without and with it"
        )
    yield f"Identified on {_day(run)}: {question}."
    yield f"Model: `{content['model']['path']}`."
    yield f"Data: {content['source']}, {content['duration']:.3g} s."
    yield "Paths are those of the computer and the folder in which robot-sysid ran."
    if content["rmse"] is not None and not run.is_self_test:
        rmse = number_text(content["rmse"])
        yield f"Root mean square of the residual torque of the fit, all joints: {rmse} N·m."


def _other_models(run: Run) -> Iterator[str]:
    """Yield a warning of each model file in the run's folder that another run has written.

    A written model states the root mean square residual of its run, by which the run is recognised.
    """
    rmse_text = format_rmse(run.content["rmse"])
    for name in MODEL_NAMES.values():
        path = run.folder / name
        # A run that writes no model leaves an older one in its folder.
        if path.is_file() and rmse_text not in path.read_text("utf-8", "replace"):
            yield f"Do not load {name}: it is from another run, and this one wrote none."


def verdicts(runs: Sequence[Run]) -> Section:
    """Return the section of a comparison whose table has each run's question, verdict and model.

    A sentence warns where the runs used different model files. Data that a run lacks are named.
    """
    rows = []
    missing_lines = []
    for name, run in run_by_name(runs).items():
        content = run.content
        rows.append(
            (name, content["question"], content["verdict"][0], content["model"]["path"])
        )
        missing_lines += [f"{name}: {line}" for line in run.missing]
    header = ("run", "question", "verdict", "model")
    models = {run.content["model"]["sha256"] for run in runs}
    warnings = ("The runs are of different model files.",) if len(models) > 1 else ()
    tables = (table(header, rows),)
    missing = tuple(missing_lines)
    return Section(
        "verdicts", "Verdicts", warnings, tables, missing=missing, is_open=True
    )


def run_by_name(runs: Sequence[Run]) -> dict[str, Run]:
    """Return the runs by the name of their folder, or by its path if several have that name."""
    folder_names = list(map(attrgetter("name"), runs))
    run_of = {}
    for run in runs:
        is_unique = folder_names.count(run.name) == 1
        run_of[run.name if is_unique else str(run.folder)] = run
    return run_of


def compare_bodies(runs: Sequence[Run]) -> Section:
    """Return the section with the identified parameters of each body that all runs have.

    There is one table per body, with one column per run.
    """
    bodies = {}
    for name, run in run_by_name(runs).items():
        bodies[name] = {body.title: body for body in run.bodies}
    first, *others = bodies.values()
    # Bodies that all runs have, in the order of the first run.
    common = set(first).intersection(*others)
    common_titles = [title for title in first if title in common]
    explanation = (
        "Values ± one standard error. Runs whose ranges do not meet contradict each "
        "other."
    )
    if not common_titles:
        explanation = (
            "These runs have no body in common, so there are no numbers to compare."
        )
    tables = []
    for title in common_titles:
        labels = map("{} [{}]".format, PARAMETER_NAMES, PARAMETER_UNITS)
        columns = [labels]
        for body_by_title in bodies.values():
            body = body_by_title[title]
            errors = body.errors_or_none(body.errors)
            columns.append(map(with_error, body.identified, errors))
        tables.append(table((title, *bodies), zip(*columns)))
    return Section("compared", "Parameters", (explanation,), tables, is_open=True)


def compare_errors(runs: Sequence[Run]) -> Section:
    """Return the section with one table per run of its torque errors over all joints."""
    named = run_by_name(runs).items()
    tables = [total_errors(list(error_sets(run)), title=name) for name, run in named]
    return Section("predicted", "Prediction errors", (), tables, is_open=True)


def compare_friction(runs: Sequence[Run]) -> Section:
    """Return the section with a table of friction coefficients, one column per run.

    "–" stands for a coefficient that a run did not estimate.
    """
    names = run_by_name(runs)
    rows: dict[tuple[str, str], list[str]] = {}
    for column, run in enumerate(names.values(), start=2):
        for owner, terms in run.friction().items():
            for term, quantity in terms.items():
                unit = term_unit(term, run.slides.get(owner, False)) or "1"
                cells = [owner, f"{term} [{unit}]", *"–" * len(names)]
                row = rows.setdefault((owner, term), cells)
                row[column] = quantity.text
    comparison = table(("joint", "term", *names), list(rows.values()))
    return Section("friction", "Friction", tables=(comparison,), is_open=True)


COMPARISON = verdicts, compare_bodies, compare_friction, compare_errors
"""Functions that each return one section of a page about several runs, in the page's order."""
