"""``robot-sysid plan MODEL``: design, check, save and export a trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from robot_sysid.commands.arguments import Parser, parsed
from robot_sysid.commands.console import Console
from robot_sysid.commands.run import add_model, carry_out
from robot_sysid.config import PLANNED, PREDICTED, MotorOptions, OutputOptions, SysidConfig
from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.model.options import ModelOptions
from robot_sysid.motion.options import ExcitationOptions, LimitOptions, PoseOptions
from robot_sysid.records.options import OptionRecord, option, record_from
from robot_sysid.records.sampling import TrajectoryOptions
from robot_sysid.simulation.options import SimulatedArmOptions

if TYPE_CHECKING:
    from robot_sysid.outcome import PlanOutcome
    from robot_sysid.preview.film import Shown
    from robot_sysid.records import RobotModel

MAIN = (
    *("mesh_dir", "joint", "output_dir", "duration", "seed", "speed", "trajectory"),
    *("save_trajectory", "excitation", "excitation_time_budget", "max_velocity", "max_torque"),
    *("workspace", "keep_out", "export_damiao", "motor_type"),
)
NO_RESULT = ("keep", "links", "bundle", "report", "plots")


SUFFIXES = (".mp4", ".gif")


def film_path(text: str) -> Path:
    """Return the path of a film."""
    path = Path(text)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{text!r} is no film; its name ends in {' or '.join(SUFFIXES)}")
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


def build_parser(full: bool = True) -> Parser:
    """Return the parser of this command."""
    parser = Parser(
        "plan",
        "robot-sysid plan arm.xml --save-trajectory plan.json",
        "Design a trajectory that tells most about the terminal link, check it against "
        "all limits, say what it promises, and write it. --trajectory checks one that was saved.",
        None if full else MAIN,
    )
    add_model(parser)
    parser.add("model and output", ModelOptions, OutputOptions, leave_out=NO_RESULT)
    parser.add("trajectory", TrajectoryOptions)
    parser.add("excitation", ExcitationOptions, usual=PLANNED)
    parser.add("plan for a payload", PoseOptions)
    parser.add("limits", LimitOptions)
    parser.add("prediction", EstimationOptions, SimulatedArmOptions, only=PREDICTED)
    parser.add("Damiao motors", MotorOptions)
    parser.add("preview", PreviewOptions)
    parser.add_console()
    return parser


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    values, console = parsed(build_parser, arguments)
    wanted = record_from(PreviewOptions, values)
    for key in ("view", "video"):
        values.pop(key, None)
    require_preview(wanted)

    def show(outcome: PlanOutcome, console: Console) -> None:
        checked = outcome.checked
        if checked is not None and checked.problem is not None and (wanted.view or wanted.video):
            from robot_sysid.preview.film import shown_plan

            shown = shown_plan(checked.problem, checked.plan)
            show_preview(checked.problem.robot, shown, wanted, console)

    return carry_out(SysidConfig.of_plan(**values), console, show)


def require_preview(wanted: PreviewOptions) -> None:
    """Raise InputError where a preview cannot be shown; asked before a long run."""
    if wanted.view or wanted.video:
        from robot_sysid.preview.film import require_display, require_film

        if wanted.view:
            require_display()
        if wanted.video:
            require_film(wanted.video)


def show_preview(robot: RobotModel, shown: Shown, wanted: PreviewOptions, console: Console) -> None:
    """Render and play a motion."""
    from robot_sysid.preview.film import view, write_film

    for note in shown.notes:
        console.note(note)
    if wanted.video:
        console.stage(f"Rendering {len(shown.time)} pictures...")
        write_film(robot, shown, wanted.video, console)
        console.stage(f"Film: {wanted.video}")
    if wanted.view:
        view(robot, shown)
