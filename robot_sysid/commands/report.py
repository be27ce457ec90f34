"""``robot-sysid report DIR...``: a page about an earlier run, or one that compares several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robot_sysid.commands import Console
from robot_sysid.commands.arguments import Command
from robot_sysid.config import Config, OutputOptions
from robot_sysid.errors import SysidError
from robot_sysid.model import ModelOptions
from robot_sysid.records.file_access import FOLDER_OPTION, REPORT_NAME, claim
from robot_sysid.records.option_fields import (
    FileArguments,
    option,
    options_of_all,
    record_from,
)
from robot_sysid.report.drawing import require_matplotlib

if TYPE_CHECKING:
    from robot_sysid.report.runs import Run


@dataclass(frozen=True)
class RunFolders(FileArguments):
    """The runs that a page is about."""

    folders: tuple[Path, ...] = option(
        (), "folder that a run wrote to", "DIR", flag="folders", takes_many=True
    )


def run(values: Mapping[str, Any], console: Console) -> int:
    """Run the command and return its exit code."""
    mesh_dir = record_from(ModelOptions, values).mesh_dir
    folder = record_from(OutputOptions, values).output_dir
    require_matplotlib()
    # Imported here so that --help and usage errors do not wait for MuJoCo.
    from robot_sysid.report.page import COMPARISON_NAME
    from robot_sysid.report.runs import load_run

    runs = [load_run(path) for path in record_from(RunFolders, values).folders]
    if "output_dir" not in values:
        folder = runs[0].folder
    name = REPORT_NAME if len(runs) == 1 else COMPARISON_NAME
    with claim([(FOLDER_OPTION, folder / name)], console.note):
        return _write_page(runs, folder, mesh_dir, console)


def _write_page(
    runs: Sequence[Run], folder: Path, mesh_dir: Path | None, console: Console
) -> int:
    """Write the page of runs into a folder, whose files are held; return the exit code."""
    from robot_sysid.pipeline.comparison import compare_runs, sentences
    from robot_sysid.report.page import write_report

    differences = []
    changes = []
    if len(runs) == 2:
        try:
            changes = compare_runs(runs, console)
            differences = sentences(changes)
        except SysidError as error:
            differences = [f"no common fit of the two runs: {error}"]
    path = write_report(runs, folder, mesh_dir, console, differences, changes)
    console.stage(f"Written: {path}", *differences)
    verdicts = [run.verdict for run in runs]
    console.result(
        {"written": [str(path)], "verdicts": verdicts, "differences": differences}
    )
    if len(runs) == 1:
        console.stage(*verdicts[0])
    return 0


COMMANDS = (
    Command(
        "report",
        "report sysid_output",
        "Write report.html about an earlier run: a page with figures that opens "
        "without a network. Several folders are compared in comparison.html.",
        {
            "": options_of_all(RunFolders),
            "page": options_of_all(
                OutputOptions, only=("output_dir",), output_dir="the first run's own"
            ),
            "model": options_of_all(ModelOptions, only=("mesh_dir",)),
        },
        run,
    ),
)


def draw_report(config: Config, verdict: Sequence[str], console: Console) -> str | None:
    """Draw the report of a run that has just ended; return why it is missing, or None.

    Args:
        config: options of the run, with the folders of its results and of the model's meshes.
        verdict: last lines of the run, with the next step.
        console: prints where the report is.
    """
    from robot_sysid.report.page import write_report
    from robot_sysid.report.runs import load_run

    console.stage("Drawing the report...")
    try:
        folder = config.output.output_dir
        mesh_dir = config.model.mesh_dir
        run = replace(load_run(folder), printed=tuple(verdict))
        path = write_report([run], folder, mesh_dir, console)
    except Exception as error:  # The run is done, and its results must stand.
        cause = f"{type(error).__name__}: {error}"
        if isinstance(error, SysidError):
            cause = str(error)
        return f"the results are written, but the report is not: {cause}"
    console.stage(f"Report: {path}")
    return None
