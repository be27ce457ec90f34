"""The page: its sections in order, the verdict, comparisons of runs, HTML and files of a report.

Names from models and logs are text that somebody else wrote: all of it is escaped, and the page
itself forbids scripts and anything from elsewhere.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from robot_sysid import __version__
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.errors import InputError
from robot_sysid.mjcf.inertial import format_rmse
from robot_sysid.records.data import Source, Traces
from robot_sysid.records.file_access import (
    MODEL_NAMES,
    atomic_files,
    require_writable,
    write_atomically,
)
from robot_sysid.records.messages import PARAMETER_UNITS, Progress, percent, with_error
from robot_sysid.report import joint_sections
from robot_sysid.report.body_sections import (
    card,
    parameters,
    picture,
    scatter,
    visibility,
)
from robot_sysid.report.drawing import Section, inline, png, svg, table
from robot_sysid.report.joint_sections import error_numbers, error_sets, most_changed
from robot_sysid.report.runs import DATA_NAME, Run, data_bytes, report_data

_TEMPLATE = Path(__file__).with_name("template.html")


_ODD = (ArithmeticError, AttributeError, LookupError, OSError, TypeError, ValueError)
"""What a part raises where a result file that somebody changed by hand holds something odd."""


def sections_of(
    runs: Sequence[Run], mesh_dir: Path | None = None, progress: Progress | None = None
) -> list[Section]:
    """Return all parts of the page about a run, or about several beside each other.

    InputError where a result file holds something odd.
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
    sections: list[Section | None] = []
    try:
        if len(runs) > 1:
            return [maker(runs) for maker in COMPARISON]
        for maker in makers:
            (progress or Progress()).advance(
                "Drawing the report", len(sections), len(makers), ""
            )
            sections.append(maker(runs[0]))
        return [section for section in sections if section is not None]
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
            figure for section in sections for figure in section.figures if plots
        ):
            kinds = {".png": png(figure)}
            if figure.drawing is not None:
                kinds[".svg"] = svg(figure).encode()
            for suffix, content in kinds.items():
                path = destination / PLOTS_NAME / (figure.name + suffix)
                files.write(path, content)
                written.append(path)
    return tuple(written)


def verdict(run: Run) -> Section:
    """Return the verdict as the console says it, the torque error, and one figure of a torque."""
    content = run.content
    is_usable = run.content["valid"]["trustworthy"]
    of_itself = str(content["source"]).startswith(Source.ITSELF.value)
    return Section(
        "verdict",
        "Verdict",
        sentences=content["verdict"],
        headline=_headline(run),
        points=tuple(_other_models(run)),
        figures=() if of_itself or run.data is None else (most_changed(run),),
        missing=run.missing,
        verdict="bad" if not is_usable else "good" if run.all_known else "part",
        details=(
            ("What was identified", (*_masses(run), *_origin(run))),
            ("What limits it", (*content["reasons"], *content["limitations"])),
            ("What the run had to say", content["notes"]),
        ),
    )


def _headline(run: Run) -> str:
    """Return "torque error 27 % → 0.3 %", of a payload its mass before it; "" where neither is."""
    file = run.content["file"]
    errors = [] if file is None else file["torque_error"].values()
    shares = ["not known" if error is None else percent(error) for error in errors]
    texts = [f"torque error {' → '.join(shares)}"] if shares else []
    body = run.bodies[0]
    mass = with_error(float(body.after[0]), body.stated(body.errors)[0], "kg")
    return ", ".join([f"payload {mass}", *texts] if run.is_payload else texts)


def _masses(run: Run) -> Iterator[str]:
    for body in run.bodies if run.is_payload else run.bodies[:1]:
        mass = float(body.after[0])
        error = float(body.errors[0])
        relative = (
            f" ({percent(error / mass)})" if np.isfinite(error) and mass > 0.0 else ""
        )
        stated = body.stated(body.errors)[0]
        yield f"Mass of {body.title}: {with_error(mass, stated, 'kg')}{relative}."


def _origin(run: Run) -> Iterator[str]:
    content = run.content
    payload = run.content["payload"]
    question = "the terminal link, with the other links around it"
    if payload is not None:
        question = "a payload, from recordings without and with it"
    yield (
        f"Identified: {question}, joint {content['joint_name']}. "
        f"Model: {content['model']['path']}. "
        f"Data: {content['source']}, {content['duration']:.3g} s."
    )
    if content["rmse"] is not None:
        yield f"Root mean square of the torque that is left over: {content['rmse']:.3g} N·m."


def _other_models(run: Run) -> Iterator[str]:
    """Yield a warning of each model in the folder that another run has written."""
    ours = format_rmse(run.content["rmse"])
    for path in (run.folder / name for name in MODEL_NAMES.values()):
        # A model that this run read from its own folder stays there where it writes none.
        if path.is_file() and ours not in path.read_text("utf-8", errors="replace"):
            yield f"Do not load {path.name}: it is from another run, and this one wrote none."


def verdicts(runs: Sequence[Run]) -> Section:
    """Return each run's verdict."""
    rows = []
    missing_lines = []
    for name, run in names(runs).items():
        content = run.content
        rows.append(
            (name, content["question"], content["verdict"][0], content["model"]["path"])
        )
        missing_lines += [f"{name}: {line}" for line in run.missing]
    header = ("run", "what", "verdict", "model")
    models = {run.content["model"]["sha256"] for run in runs}
    warned = ("The runs are of different model files.",) if len(models) > 1 else ()
    tables = (table(header, rows),)
    missing = tuple(missing_lines)
    return Section(
        "verdicts", "Verdicts", warned, tables, missing=missing, is_open=True
    )


def names(runs: Sequence[Run]) -> dict[str, Run]:
    """Return the runs by the name of their folder, or its path where two are called the same."""
    short = [run.name for run in runs]
    return {
        run.name if short.count(run.name) < 2 else str(run.folder): run for run in runs
    }


def compare_bodies(runs: Sequence[Run]) -> Section:
    """Return the parameters of the bodies that all runs have, beside each other."""
    bodies = {
        name: {b.title: b for b in run.bodies} for name, run in names(runs).items()
    }
    first, *others = bodies.values()
    common_titles = [
        title
        for title in first
        if all(title in bodies_of_run for bodies_of_run in others)
    ]
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
        same = [bodies_of_run[title] for bodies_of_run in bodies.values()]
        columns = [
            map(
                with_error,
                bodies_of_run.after,
                bodies_of_run.stated(bodies_of_run.errors),
            )
            for bodies_of_run in same
        ]
        labels = (
            f"{label} [{unit}]" for label, unit in zip(PARAMETER_NAMES, PARAMETER_UNITS)
        )
        tables.append(table((title, *bodies), list(zip(labels, *columns))))
    return Section("compared", "Parameters", (explanation,), tables, is_open=True)


def compare_errors(runs: Sequence[Run]) -> Section:
    """Return the torque errors of each run, of each joint where its file holds them."""
    sets = [
        error_set._replace(description=f"{name}: {error_set.description}")
        for name, run in names(runs).items()
        for error_set in error_sets(run)
    ]
    return Section("predicted", "Prediction errors", (), (table(*error_numbers(sets)),))


def friction_beside(runs: Sequence[Run]) -> Section:
    """Return the friction of each run."""
    friction_by_run = {
        name: {key: with_error(*terms) for key, terms in run.friction().items()}
        for name, run in names(runs).items()
    }
    keys = dict.fromkeys(key for terms in friction_by_run.values() for key in terms)
    rows = [
        (*key, *(terms.get(key, "–") for terms in friction_by_run.values()))
        for key in keys
    ]
    return Section(
        "friction",
        "Friction",
        tables=(table(("joint", "term", *friction_by_run), rows),),
    )


COMPARISON = verdicts, compare_bodies, friction_beside, compare_errors
"""What a page about several runs consists of."""
