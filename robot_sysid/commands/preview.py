"""``--view`` and ``--video``: a motion is shown."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robot_sysid.commands.console import Console
from robot_sysid.errors import InputError
from robot_sysid.records.options import OptionRecord, option

if TYPE_CHECKING:
    from robot_sysid.preview.film import Shown
    from robot_sysid.records import RobotModel

SUFFIXES = (".mp4", ".gif")


def film_path(text: str) -> Path:
    """Return the path of a film."""
    path = Path(text)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"{text!r} is no film; its name ends in {' or '.join(SUFFIXES)}"
        )
    return path


@dataclass(frozen=True)
class PreviewOptions(OptionRecord):
    """Whether a motion is shown."""

    view: bool = option(False, "play the motion in MuJoCo's viewer")
    video: Path | None = option(
        None,
        "render the motion as a film (.mp4 or .gif), with limits, clearance and torque over time",
        "FILE",
        parse=film_path,
    )


def require_preview(wanted: PreviewOptions) -> None:
    """Raise InputError where a preview cannot be shown; asked before a long run."""
    if wanted.view or wanted.video:
        from robot_sysid.preview.film import require_display, require_film

        if wanted.view:
            require_display()
        if wanted.video:
            require_film(wanted.video)


def show_preview(
    robot: RobotModel, shown: Shown, wanted: PreviewOptions, console: Console
) -> None:
    """Render and play a motion."""
    from robot_sysid.preview.film import view, write_film

    if wanted.video:
        console.stage(f"Rendering {len(shown.time)} pictures...")
        write_film(robot, shown, wanted.video, console)
        console.stage(f"Film: {wanted.video}")
    if wanted.view:
        view(robot, shown)


def show_plan(outcome: Any, wanted: PreviewOptions, console: Console) -> None:
    """Show the motion that was planned, if there is one."""
    checked = outcome.checked
    if (
        checked is not None
        and checked.problem is not None
        and (wanted.view or wanted.video)
    ):
        from robot_sysid.preview.film import shown_plan

        shown = shown_plan(checked.problem, checked.plan)
        show_preview(checked.problem.robot, shown, wanted, console)
