"""Damiao motors: export, check, play and record trajectories over CAN.

Here is what others use of it: Python programs ``rs.motors.play``, which prints nothing and asks
nobody whether the arm may move, and plans ``arm_motors``; both find it by ``pipeline/motors.py``.

What needs no bus (protocol, trajectory, the simulated arm) works without python-can; the modules
that open a bus or log its frames import it inside the function that does.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from robot_sysid.api.keywords import with_keywords
from robot_sysid.damiao import execution
from robot_sysid.damiao.bus import inspect_bus
from robot_sysid.damiao.checks.after_run import judge_run, recorded_plan
from robot_sysid.damiao.checks.preflight import motor_ratings, require_playable
from robot_sysid.damiao.joints import damiao_joints, map_joints, read_joint_map
from robot_sysid.damiao.player import PlayReport, StopRequest
from robot_sysid.damiao.safety.holding import refuse_guessed_masses
from robot_sysid.damiao.trajectory import export_damiao_trajectory
from robot_sysid.damiao.weight_file import export_weight
from robot_sysid.errors import InputError
from robot_sysid.pipeline.motors import ArmMotors
from robot_sysid.records import Limits, RobotModel
from robot_sysid.records.drafts import temporary_folder
from robot_sysid.records.file_access import DAMIAO_NAME
from robot_sysid.records.option_fields import given_values

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from robot_sysid.api.calls import Model
    from robot_sysid.api.keyword_types import PlayKeywords
    from robot_sysid.api.results import PlanResult
    from robot_sysid.config import MotorOptions
    from robot_sysid.pipeline.motors import MotionChunk

__all__ = ["Say", "play"]


def __dir__() -> list[str]:
    return [*__all__]


def arm_motors(options: MotorOptions, robot: RobotModel) -> ArmMotors:
    """Return the motors that options state, for plans; InputError where they do not fit the arm."""
    refuse_guessed_masses(robot)
    joints = damiao_joints(options.motor_type, robot.n_joints, robot.joint_names)
    if options.joint_map is not None:
        # One that lacks a joint is refused now, and not beside the arm.
        map_joints(joints, read_joint_map(options.joint_map), robot.joint_names)
    frames = np.array([joint.spec.limits for joint in joints])
    _, vmax, tmax = frames.T
    ratings, _ = motor_ratings(joints)
    # Without a range: a joint that may turn for ever plans motions around its reference.
    limits = Limits.of(ratings.limits, Limits(velocity=vmax, torque=tmax))

    def write(chunks: Iterable[MotionChunk], file: TextIO) -> list[str]:
        """Write a motion, clamped to what frames can carry; return the shares that were clamped."""
        percent = export_damiao_trajectory(chunks, joints, file)
        shares = [
            f"{joint.name} ({joint.motor_type}) {share:.1f} %"
            for joint, share in zip(joints, percent)
        ]
        remedy = "; use stronger motors or a slower trajectory" if any(percent) else ""
        return [f"Damiao export, clamped to motor limits: {', '.join(shares)}{remedy}"]

    return ArmMotors(limits, execution.LIMITS, write, export_weight)


Say = Callable[[str], None]
"""Function that is called with one sentence about each event of a run."""


@with_keywords([*execution.RUN_OPTIONS, *execution.SIMULATED_OPTIONS])
def play(
    trajectory: Path | str | PlanResult,
    *,
    model: Model | None = None,
    joint_map: Path | str | None = None,
    simulate: bool = False,
    say: Say = lambda sentence: None,
    **options: Unpack[PlayKeywords],
) -> PlayReport:
    """Play a trajectory on Damiao motors, with all checks of ``robot-sysid motors play``.

    The arm moves without a question to the user first. Ctrl-C brings the arm to rest, if this is
    called in the main thread.

    Args:
        trajectory: a file for motors, or a plan, made with ``motor_type=...``.
        model: MJCF or URDF file of the arm, with which the motors are compared; by default the
            model of the plan, if ``trajectory`` is a plan.
        joint_map: file that says how each joint's motor is mounted; by default that of the plan, if
            ``trajectory`` is a plan that was made with one.
        simulate: play on a simulated arm instead, in simulated time. It is as far from the model as
            arms usually are, or with ``plant_model`` exactly the arm of that file.
        say: called with a sentence for each thing that happens.
        options: those of ``robot-sysid motors play``, such as ``channel="can0"``, ``speed=0.3``,
            ``park="rest"`` or ``record="measured.csv"``.

    Returns:
        A report with number of cycles, lateness [s], largest tracking error of each joint [rad],
        how the motors answered, and what the recording says of the arm. A recording is not to be
        used where its ``confirmed_reports`` name a fault that a motor reported again and again
        while it was driving.

    Raises:
        InputError: an option or a file cannot be used.
        HardwareAbort: a check forbids it, or the run was stopped; its message says whether a motor
            may still be enabled.
    """
    if not simulate and options.get("plant_model") is not None:
        raise InputError("plant_model is about a simulated arm; add simulate=True")
    with _trajectory_options(trajectory) as values:
        values.update(options)
        if joint_map is not None:
            values["joint_map"] = joint_map
        if model is not None:
            from robot_sysid.api.calls import path_of

            values["model"] = path_of(model)
        run = execution.MotorRun(execution.RunOptions.of(values))
        return play_run(run, simulate, say)


def play_run(run: execution.MotorRun, simulate: bool, say: Say) -> PlayReport:
    """Play the trajectory of a run, with all checks; arguments and errors are those of ``play``.

    A program that has a bus of its own makes the run with it.
    """
    with recorded_plan(run.plan()) as plan:
        opened = run.open_simulated(plan) if simulate else run.open_guarded()
        with opened as link:
            inspection = inspect_bus(link)
            # The signs of a simulated arm's motors are not in doubt.
            checks = run.inspection_checks(plan, inspection, real=not simulate)
            require_playable([*run.checks(plan), *checks])
            holding = run.holding(plan)
            report = execution.run(link, plan, inspection, StopRequest(), say, holding)
        said = judge_run(plan, run.options.files.model, run.options.model)
    return replace(report, findings=said.lines, is_as_expected=not said.differs)


@contextlib.contextmanager
def _trajectory_options(
    trajectory: Path | str | PlanResult,
) -> Iterator[dict[str, Any]]:
    """Yield key to value of the options that a trajectory states: its file, of a plan also its arm.

    The file of a plan is temporary.

    Raises:
        SysidError: the plan must not be played.
        InputError: the plan was made without motors.
    """
    from robot_sysid.api.results import PlanResult

    if not isinstance(trajectory, PlanResult):
        yield {"trajectory": Path(trajectory)}
        return
    config = trajectory.config
    if not config.motors.are_stated:
        raise InputError(
            "the plan is for no motors; give rs.plan motor_type, one per joint"
        )
    with temporary_folder() as folder:
        trajectory.save(folder / "plan.json")
        yield {
            "trajectory": folder / DAMIAO_NAME,
            "model": config.model.path,
            "joint_map": config.motors.joint_map,
            **given_values(config.model),
        }
