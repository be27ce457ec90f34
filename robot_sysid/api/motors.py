"""Damiao motors from Python: ``rs.motors.play`` and ``rs.motors.hold``.

Nothing is printed, and nobody is asked whether the arm may move.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robot_sysid.api.keywords import Model, path_of, with_keywords
from robot_sysid.damiao.bus import GuardedLink, inspect_bus
from robot_sysid.damiao.execution import MotorRun, lengthen_hold
from robot_sysid.damiao.player import PlayReport, StopRequest
from robot_sysid.damiao.preflight import require_no_stop
from robot_sysid.damiao.settings import Plan
from robot_sysid.damiao.simulated import DEFAULT_WATCHDOG
from robot_sysid.damiao.trajectory import LIMITS
from robot_sysid.errors import InputError, SysidError
from robot_sysid.records.file_access import DAMIAO_NAME, temporary_folder
from robot_sysid.records.option_fields import given_options

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from robot_sysid.api import keyword_types as types
    from robot_sysid.api.results import PlanResult

Say = Callable[[str], None]


@with_keywords(**dict.fromkeys(LIMITS))
def play(
    trajectory: Path | str | PlanResult,
    *,
    model: Model | None = None,
    joint_map: Path | str | None = None,
    simulate: bool = False,
    say: Say = lambda sentence: None,
    **options: Unpack[types.PlayKeywords],
) -> PlayReport:
    """Play a trajectory on Damiao motors, with all checks of ``robot-sysid motors play``.

    Nobody is asked first. Ctrl-C brings the arm to rest, where this is the main thread.

    Args:
        trajectory: a file for motors, or a plan, made with ``export_damiao=True, motor_type=...``.
        model: MJCF or URDF file of the arm, to compare with; that of the plan where there is one.
        joint_map: how each joint's motor is mounted.
        simulate: play on a simulated arm of the model instead, in simulated time.
        say: called with a sentence for each thing that happens.
        options: those of ``robot-sysid motors play``, such as ``channel="can0"``, ``speed=0.3``,
            ``park="rest"`` or ``record="measured.csv"``.

    Returns:
        How it went: cycles, lateness [s], missed commands and worst tracking [rad] per joint.

    Raises:
        InputError: an option or a file cannot be used.
        HardwareAbort: a check forbids it, or the run was stopped; its message says whether a motor
            may still be enabled.
    """
    with _motor_file(trajectory) as (path, own):
        chosen = {
            **own,
            **({} if model is None else {"model": path_of(model)}),
            **options,
        }
        asked = _asked(say, trajectory=path, joint_map=joint_map, **chosen)
        plan = asked.plan()
        require_no_stop(asked.checks(plan), "not played")
        asked.require_free(plan)
        arm = asked.simulated_arm(plan, DEFAULT_WATCHDOG) if simulate else None
        with asked.open_guarded() if arm is None else asked.open_simulated(arm) as link:
            return _played(asked, link, plan, say, real=not simulate)


@with_keywords()
def hold(
    model: Model,
    seconds: float,
    *,
    joint_map: Path | str | None = None,
    say: Say = lambda sentence: None,
    **options: Unpack[types.HoldKeywords],
) -> PlayReport:
    """Hold an arm where it stands for some time [s], as ``robot-sysid motors hold`` does.

    For the other arguments, what is returned and what is raised see ``play``.
    """
    if not seconds > 0.0:
        raise InputError(f"seconds must be above 0, got {seconds}")
    asked = _asked(say, model=path_of(model), joint_map=joint_map, **options)
    with asked.open_guarded() as link:
        plan = asked.hold_plan(inspect_bus(link))
        require_no_stop(asked.checks(plan), "not held")
        asked.require_free(plan)
        return _played(asked, link, lengthen_hold(plan, seconds), say, real=False)


def _asked(say: Say, **values: Any) -> MotorRun:
    return MotorRun(values, lambda words, last: say(words))


def _played(
    asked: MotorRun, link: GuardedLink, plan: Plan, say: Say, real: bool
) -> PlayReport:
    stop = StopRequest()
    inspection = inspect_bus(link)
    require_no_stop(asked.inspection_checks(plan, inspection, real), "not played")
    return asked.play(link, plan, inspection, stop, say, lambda time: None)


@contextlib.contextmanager
def _motor_file(
    trajectory: Path | str | PlanResult,
) -> Iterator[tuple[Path, Mapping[str, Any]]]:
    """Yield the file of a trajectory, and which arm it is for, where a plan tells."""
    from robot_sysid.api.results import PlanResult
    from robot_sysid.pipeline.planning import motor_writer

    if not isinstance(trajectory, PlanResult):
        yield Path(trajectory), {}
        return
    if trajectory.failure:
        raise SysidError(f"{trajectory.failure}; not played")
    config = trajectory.config
    rate = config.trajectory.sample_rate
    plan = trajectory.checked.plan
    write = motor_writer(config.motors, trajectory.robot, plan, rate)
    if write is None:
        raise InputError(
            "the plan is for no motors; give rs.plan export_damiao and motor_type"
        )
    arm = {
        each.key: getattr(config.model, each.key)
        for each in given_options(config.model)
    }
    with (
        temporary_folder() as folder,
        open(folder / DAMIAO_NAME, "w", encoding="utf-8") as file,
    ):
        write(file)
        file.flush()
        yield folder / DAMIAO_NAME, {"model": config.model.path, **arm}
