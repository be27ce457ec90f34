"""Damiao motors from Python: ``rs.motors.play``.

Nothing is printed, and nobody is asked whether the arm may move.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robot_sysid.api.keywords import Model, path_of, with_keywords
from robot_sysid.damiao import execution
from robot_sysid.damiao.bus import inspect_bus
from robot_sysid.damiao.player import PlayReport, StopRequest
from robot_sysid.damiao.preflight import require_playable
from robot_sysid.errors import InputError, SysidError
from robot_sysid.records.file_access import atomic_files, temporary_folder
from robot_sysid.records.option_fields import given_values

if TYPE_CHECKING:
    from robot_sysid.api.results import PlanResult

__all__ = ["Say", "play"]


def __dir__() -> list[str]:
    return [*__all__]


Say = Callable[[str], None]
"""Function that is called with one sentence about each event of a run."""


@with_keywords(execution.RUN_OPTIONS)
def play(
    trajectory: Path | str | PlanResult,
    *,
    model: Model | None = None,
    joint_map: Path | str | None = None,
    simulate: bool = False,
    say: Say = lambda sentence: None,
    **options: Any,
) -> PlayReport:
    """Play a trajectory on Damiao motors, with all checks of ``robot-sysid motors play``.

    The arm moves without a question to the user first. Ctrl-C brings the arm to rest, if this is
    called in the main thread.

    Args:
        trajectory: a file for motors, or a plan, made with ``export_damiao=True, motor_type=...``.
        model: MJCF or URDF file of the arm, with which the motors are compared; by default the
            model of the plan, if ``trajectory`` is a plan.
        joint_map: file that says how each joint's motor is mounted.
        simulate: play on a simulated arm of the model instead, in simulated time.
        say: called with a sentence for each thing that happens.
        options: those of ``robot-sysid motors play``, such as ``channel="can0"``, ``speed=0.3``,
            ``park="rest"`` or ``record="measured.csv"``.

    Returns:
        A report with number of cycles, lateness [s], missed commands and the largest tracking error
        of each joint [rad].

    Raises:
        InputError: an option or a file cannot be used.
        HardwareAbort: a check forbids it, or the run was stopped; its message says whether a motor
            may still be enabled.
    """
    with _motor_file(trajectory) as (path, plan_options):
        values = {"trajectory": path, "joint_map": joint_map, **plan_options, **options}
        if model is not None:
            values["model"] = path_of(model)
        run = execution.MotorRun(values)
        plan = run.plan()
        require_playable(run.checks(plan))
        with run.open_simulated(plan) if simulate else run.open_guarded() as link:
            inspection = inspect_bus(link)
            # The signs of a simulated arm's motors are not in doubt.
            checks = run.inspection_checks(plan, inspection, not simulate)
            require_playable(checks)
            holding = run.holding(plan)
            return execution.run(link, plan, inspection, StopRequest(), say, holding)


@contextlib.contextmanager
def _motor_file(
    trajectory: Path | str | PlanResult,
) -> Iterator[tuple[Path, Mapping[str, Any]]]:
    """Yield the path of a trajectory's motor file, and key to value of the options on its arm.

    The file of a plan is temporary, and its options are those that the plan was made with; a path
    is yielded as it is, without options.

    Raises:
        SysidError: the plan must not be played.
        InputError: the plan was made without motors.
    """
    from robot_sysid.api.results import PlanResult
    from robot_sysid.pipeline.planning import draft_motor_file

    if not isinstance(trajectory, PlanResult):
        yield Path(trajectory), {}
        return
    if trajectory.failure:
        raise SysidError(f"{trajectory.failure}; not played")
    config = trajectory.config
    arm_options = {"model": config.model.path, **given_values(config.model)}
    with temporary_folder() as folder:
        with atomic_files() as files:
            plan = trajectory.checked.plan
            paths, _ = draft_motor_file(config, trajectory.robot, plan, files, folder)
        if not paths:
            raise InputError(
                "the plan is for no motors; give rs.plan export_damiao and motor_type"
            )
        yield paths[0], arm_options
