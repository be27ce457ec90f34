"""Show a motion: as a film (``--video``) or in MuJoCo's viewer (``--view``). Light to import."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from robot_sysid.errors import InputError
from robot_sysid.records.messages import Progress
from robot_sysid.records.option_fields import OptionRecord, option

if TYPE_CHECKING:
    from robot_sysid.motion.plan import CheckedPlan
    from robot_sysid.preview.film import Preview
    from robot_sysid.records import RobotModel

SUFFIXES = (".mp4", ".gif")
"""Endings of film files."""


def film_path(text: str) -> Path:
    """Return the path of a film; InputError where its name ends in none of ``SUFFIXES``."""
    path = Path(text)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"{text!r} is no film; its name ends in {' or '.join(SUFFIXES)}"
        )
    return path


@dataclass(frozen=True)
class PreviewOptions(OptionRecord):
    """Whether and how a motion is shown.

    Attributes:
        view: play the motion in MuJoCo's viewer.
        video: file of the film to render; None for no film.
    """

    view: bool = option(False, "play the motion in MuJoCo's viewer")
    video: Path | None = option(
        None,
        "render the motion as a film (.mp4 or .gif), with limits, clearance and torque over time",
        "FILE",
        parse=film_path,
    )


def require_preview(options: PreviewOptions) -> None:
    """Raise InputError where a preview cannot be shown; called before a long run."""
    if options.view or options.video:
        from robot_sysid.preview.film import require_display, require_film

        if options.view:
            require_display()
        if options.video:
            require_film(options.video)


def show_preview(
    robot: RobotModel, preview: Preview, options: PreviewOptions, progress: Progress
) -> None:
    """Render a motion as a film and play it in the viewer, whichever the options want.

    Args:
        robot: the arm that moves.
        preview: its positions and the quantities drawn beside it.
        options: name the film's file, and say whether the viewer is opened.
        progress: receives a stage before and after the film is rendered.
    """
    from robot_sysid.preview.film import play_in_viewer, write_film

    if options.video:
        progress.stage(f"Rendering {len(preview.time)} pictures...")
        write_film(robot, preview, options.video, progress)
        progress.stage(f"Film: {options.video}")
    if options.view:
        play_in_viewer(robot, preview)


def show_plan(
    checked: CheckedPlan | None, options: PreviewOptions, progress: Progress
) -> None:
    """Show the motion of a plan; do nothing where there is none, or no preview is wanted.

    Args:
        checked: the plan with its problem (arm, limits, obstacles); None where nothing was planned.
        options: whether the motion is shown in the viewer, as a film, or not at all.
        progress: receives a stage before and after a film is rendered.
    """
    if checked is None or checked.problem is None:
        return
    if options.view or options.video:
        from robot_sysid.preview.film import plan_preview

        preview = plan_preview(checked.problem, checked.plan)
        show_preview(checked.problem.robot, preview, options, progress)
