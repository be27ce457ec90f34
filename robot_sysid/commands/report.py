"""``robot-sysid report DIR...``: a page about an earlier run, or one that compares several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robot_sysid.commands.arguments import Parser, parsed
from robot_sysid.commands.console import Console
from robot_sysid.config import OutputOptions
from robot_sysid.errors import SysidError
from robot_sysid.model import ModelOptions
from robot_sysid.records.option_fields import (
    OptionRecord,
    option,
    parse_folder,
    record_from,
)


@dataclass(frozen=True)
class PageOptions(OptionRecord):
    """Where the page goes, and what goes beside it."""

    output_dir: Path | None = option(
        None,
        "folder for the page",
        "DIR",
        parse=parse_folder,
        default_text="the run's own, or the first one's",
    )
    plots: bool = option(False, "also write the figures as PNG and SVG")


def build_parser(full: bool = True) -> Parser:
    """Return the parser of this command."""
    parser = Parser(
        "report",
        "robot-sysid report sysid_output",
        "Write report.html about an earlier run: a page with figures that opens "
        "without a network. Several folders are compared in comparison.html.",
    )
    parser.add_argument(
        "folders",
        metavar="DIR",
        nargs="+",
        type=Path,
        help="folder that a run wrote to",
    )
    parser.add("page", PageOptions)
    parser.add("model", ModelOptions, only=("mesh_dir",))
    return parser.with_console()


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    values, console = parsed(build_parser, arguments)
    page = record_from(PageOptions, values)
    model = record_from(ModelOptions, values)
    require_report(OutputOptions(report=True))
    # Imported here so that --help and usage errors do not wait for MuJoCo.
    from robot_sysid.report.page import write_report
    from robot_sysid.report.runs import load_run

    runs = [load_run(folder) for folder in values["folders"]]
    destination = page.output_dir or runs[0].folder
    written = write_report(
        runs, destination, model.mesh_dir, plots=page.plots, progress=console
    )
    console.stage(f"Written: {written[0]}")
    if len(written) > 1:
        console.stage(f"Written: {len(written) - 1} figures in {written[-1].parent}")
    verdicts = [run.content["verdict"] for run in runs]
    console.result({"written": list(map(str, written)), "verdicts": verdicts})
    console.stage(*(verdicts[0] if len(runs) == 1 else ()))
    return 0


def require_report(output: OutputOptions) -> None:
    """Raise InputError where a report is wanted that cannot be made; asked before a long run."""
    if output.report or output.plots:
        from robot_sysid.report.drawing import require_libraries

        require_libraries()


def report_of(
    outcome: Any, output: OutputOptions, mesh_dir: Path | None, console: Console
) -> str | None:
    """Write what a later report needs, and the report where it is wanted; return why that failed.

    The results are in their files already; whatever fails here leaves them there.
    """
    wanted = output.report or output.plots
    traces = outcome.traces
    # A plan, and servos found without torques, have none to draw.
    if traces is None or not (wanted or outcome.result.is_measured):
        return None
    from robot_sysid.report.page import save_data, write_report
    from robot_sysid.report.runs import load_run

    try:
        save_data(output.output_dir, traces(), outcome.result_hash)
        if not wanted:
            return None
        console.stage("Drawing the report...")
        page = output.report
        run = load_run(output.output_dir)
        written = write_report([run], run.folder, mesh_dir, page, output.plots, console)
    except Exception as error:  # the run is done, and what it found must stand
        cause = (
            str(error)
            if isinstance(error, SysidError)
            else f"{type(error).__name__}: {error}"
        )
        if not wanted:
            console.note(f"nothing was left for a later report: {cause}")
            return None
        return f"the results are written, but the report is not: {cause}"
    console.stage(f"Report: {written[0] if page else written[0].parent}")
    return None
