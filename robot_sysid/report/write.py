"""Reports into folders: data of a run, its page, its figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from robot_sysid.records.atomic_files import require_writable, whole_files
from robot_sysid.records.traces import Traces
from robot_sysid.report.drawing import png, svg
from robot_sysid.report.elements import Section
from robot_sysid.report.page import html, sections_comparing, sections_of
from robot_sysid.report.runs import load_run
from robot_sysid.report.saved import DATA_NAME, data_bytes, report_data

REPORT_NAME, COMPARISON_NAME, PLOTS_NAME = "report.html", "comparison.html", "plots"


def save_data(folder: Path, traces: Traces, result: str) -> Path:
    """Write what a later report of this run needs.

    Args:
        folder: where the run wrote to.
        traces: what is drawn of them.
        result: hash of the JSON file that the run wrote.

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

    Args:
        folders: of the runs.
        destination: folder to write to.
        mesh_dir: the user's mesh folder, if any.
        page: whether to write the page.
        plots: whether to write each figure as PNG and SVG.

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
        for path, content in _plots(destination / PLOTS_NAME, sections) if plots else ():
            files.write(path, content)
            written.append(path)
    return tuple(written)


def _plots(folder: Path, sections: Sequence[Section]) -> Iterator[tuple[Path, bytes]]:
    for figure in (each for section in sections for each in section.figures):
        yield folder / f"{figure.name}.png", png(figure)
        if figure.drawing is not None:
            yield folder / f"{figure.name}.svg", svg(figure).encode()
