"""Results of the Python functions: identified parameters and planned motions.

A result has its numbers as properties, can be written to files and can be plotted.
"""

from __future__ import annotations

import warnings
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from robot_sysid.config import Config, PlanConfig
from robot_sysid.errors import InputError, SysidError
from robot_sysid.export import Written, writable_folder
from robot_sysid.model.compilation import lasting_folder
from robot_sysid.pipeline.motions import CheckedPlan
from robot_sysid.pipeline.planning import draft_motor_file, draft_plan
from robot_sysid.pipeline.stages import load_arm, write_results
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.records.file_access import atomic_files, claim, models_in
from robot_sysid.records.installation import missing_library
from robot_sysid.records.messages import Progress, torque_unit, with_error
from robot_sysid.report.drawing import COLOURS
from robot_sysid.report.figures import MEASURED_WIDTH
from robot_sysid.results.content import content_of
from robot_sysid.results.lines import result_lines, verdict_lines
from robot_sysid.results.record import Identification
from robot_sysid.results.written_model import spec_of
from robot_sysid.trajectory import sample_count
from robot_sysid.wording import in_python

FIGURE_WIDTH = 8.0
"""Width of a figure [inch], about that of a page's text."""
AXIS_HEIGHT = 1.6
"""Height of one joint's axes [inch]: seven joints fill a page."""
FIGURE_MARGIN = 0.6
"""Height for the label of the time below the axes [inch]."""


def one_thread() -> AbstractContextManager[Any]:
    """Return a context manager that runs linear algebra in one thread."""
    # scipy brings a linear algebra of its own, and only loaded libraries are limited.
    import scipy.linalg  # noqa: F401

    return threadpool_limits(1, user_api="blas")


def _arm_again(config: Config, sha256: str) -> RobotModel:
    """Return the arm of a result, read again from its model file.

    Raises:
        InputError: the file cannot be read any more, or ``sha256`` is not that of its content.
    """
    robot = load_arm(config, Progress())
    if robot.sha256 != sha256:
        raise InputError(
            f"{robot.path} has changed since the result was made; put back the file that was "
            "identified"
        )
    return robot


@dataclass(frozen=True, repr=False)
class Result(Identification):
    """An identified arm or payload, from ``identify``, ``self_test`` or ``payload``.

    It has all fields of an ``Identification``; ``remarks`` has those on logs, too.

    Attributes:
        config: the options that it was identified with.
    """

    config: Any = None

    def __getstate__(self) -> dict[str, Any]:
        """Return what pickle keeps: all but the compiled model, which is read again when needed."""
        load = partial(_arm_again, self.config, self.robot.sha256)
        return {**vars(self), "robot": self.robot.without_model(load)}

    @property
    def theta(self) -> Array:
        """[m, hx, hy, hz, Ixx, Ixy, Ixz, Iyy, Iyz, Izz] (10,) of the terminal link, or of the
        payload in its flange's frame, inertia about the frame's ORIGIN [kg, kg m, kg m^2]."""
        return self.body.theta

    @property
    def mass(self) -> float:
        """Mass of the terminal body with all that hangs on it, or of the payload [kg]."""
        return self.body.mass

    @property
    def center_of_mass(self) -> Array:
        """Centre of mass (3,) in the body's, or the flange's, frame [m]."""
        return self.body.com

    @property
    def inertia(self) -> Array:
        """Inertia (3, 3) about the centre of mass, axes of the body or the flange [kg m^2]."""
        return self.body.inertia_com

    @property
    def trustworthy(self) -> bool:
        """Whether the numbers may go into a model or a controller."""
        return self.verdict.is_trustworthy

    def lines(self) -> list[str]:
        """Return the lines that the command prints of this result, in Python's words."""
        with in_python():
            return result_lines(content_of(self), self.config.output.links)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of params.json (see docs/formats.md), without cards."""
        with in_python():
            content = content_of(self)
            return {**content, "verdict": [*verdict_lines(content)]}

    def save(self, folder: str | Path) -> tuple[Path, ...]:
        """Write params.json, the data of a later report and, where trusted, the updated model.

        The folder is created where it is missing; returns the written files.

        Raises:
            InputError: the folder cannot be written to, holds files by these names that no run
                wrote, or another run is writing to it.
        """
        folder = Path(folder)
        config = self._config_for(folder)
        with (
            in_python(),
            one_thread(),
            claim(config.folder_files(), warnings.warn),
            writable_folder(folder, Progress()),
        ):
            return self._write(folder).files

    def _config_for(self, folder: Path) -> Config:
        """Return the options with another folder of results."""
        output = replace(self.config.output, output_dir=folder)
        config: Config = replace(self.config, output=output)
        return config

    def _write(self, folder: Path) -> Written:
        """Write the files of the result to a folder."""
        return write_results(self._config_for(folder), self, Progress())

    def spec(self) -> Any:
        """Return a ``mujoco.MjSpec`` with the result applied, of a file that lasts as this process.

        Raises:
            SysidError: the result must not be used, or the model cannot hold it; says why.
        """
        with in_python(), one_thread():
            # Only the model is wanted, no data of a report.
            written = replace(self, traces=None)._write(lasting_folder())
            for path in models_in(written.files):
                return spec_of(path)
            raise SysidError(written.failure or "this result is written into no model")

    def plot(self) -> Any:
        """Return a matplotlib Figure of each joint's torque over time [N m].

        It shows the measured torque, what the model predicts before, and what the result predicts:
        of a payload, the torque without it and with it.

        Raises:
            InputError: matplotlib is not installed, or it is a simulation of the model itself.
        """
        if self.traces is None:
            raise InputError(
                "a self-test has no torques to draw: all are the model's own"
            )
        traces = self.traces()
        try:
            from matplotlib.figure import Figure
        except ImportError:
            raise missing_library("plot()", "matplotlib", "report") from None
        count = len(traces.joints)
        height = AXIS_HEIGHT * count + FIGURE_MARGIN
        figure = Figure(figsize=(FIGURE_WIDTH, height), layout="constrained")
        axes = figure.subplots(count, sharex=True, squeeze=False)[:, 0]
        words = ("before", "after") if self.payload is None else ("without", "with")
        before, after = (f"predicted {word}" for word in words)
        # As in the report.
        series = (
            (traces.measured, "measured", COLOURS["measured"], "-", MEASURED_WIDTH),
            (traces.prior_prediction, before, COLOURS["before"], "--", 1.0),
            (traces.predicted, after, COLOURS["after"], "-", 1.0),
        )
        for k, (axis, joint) in enumerate(zip(axes, traces.joints)):
            for torque, label, colour, dashes, width in series:
                axis.plot(
                    traces.time,
                    torque[:, k],
                    dashes,
                    color=colour,
                    lw=width,
                    label=label,
                )
            axis.set_ylabel(f"{joint}\n[{torque_unit(traces.is_slide[k])}]")
        axes[-1].set_xlabel("time [s]")
        axes[0].legend(loc="upper right", ncols=3)
        return figure

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def __repr__(self) -> str:
        mass = with_error(self.mass, self.standard_errors.get("m"), "kg")
        usable = "usable" if self.trustworthy else "of limited use"
        usable = f"not to be used: {self.failure}" if self.failure else usable
        return f"<Result {self.body.name} of {self.robot.path.name}: {mass}, {usable}>"


@dataclass(frozen=True, repr=False)
class PlanResult:
    """A planned motion, from ``plan``.

    Attributes:
        config: the options of the plan.
        robot: the arm.
        checked: the motion with its limit check.
        prediction: the lines that the command prints on limits and on expected errors.
        notes: the notes that the command would have printed, one sentence each.
    """

    config: PlanConfig
    robot: RobotModel
    checked: CheckedPlan
    prediction: tuple[str, ...]
    notes: tuple[str, ...] = ()

    @property
    def failure(self) -> str | None:
        """Why the motion must not be played, or None."""
        return self.checked.failure

    @property
    def duration(self) -> float:
        """Length of the motion [s]."""
        return float(self.checked.plan.duration)

    def motion(self, time: Array) -> Motion:
        """Return q, qd, qdd (N, n) [rad, rad/s, rad/s^2] at times (N,) [s]."""
        return self.checked.plan.evaluate(np.asarray(time, dtype=float))

    def sampled(self, rate: float | None = None) -> Motion:
        """Return the motion from its begin to its end, sampled at a rate [Hz].

        By default the rate is the option ``sample_rate`` of the plan.
        """
        rate = rate or self.config.trajectory.sample_rate
        return self.motion(np.arange(sample_count(self.duration, rate)) / rate)

    def save(self, path: str | Path) -> tuple[Path, ...]:
        """Write the trajectory (.json), its samples (.csv) and beside them, of a plan for servos,
        ``goals.csv``, and of one for motors the file that they play, ``damiao_trajectory.csv``,
        and what carries the arm in it, ``damiao_trajectory_weight.csv``; return the paths in this
        order.

        Raises:
            SysidError: the motion must not be played; says why.
            InputError: a file cannot be written, or would replace one that no run wrote.
        """
        if self.failure:
            raise SysidError(f"{self.failure}; nothing was written")
        path = Path(path)
        trajectory = replace(self.config.trajectory, save=path)
        output = replace(self.config.output, output_dir=path.parent)
        config = replace(self.config, trajectory=trajectory, output=output)
        plan = self.checked.plan
        written = [*config.folder_files(), *config.named_files()]
        with (
            in_python(),
            one_thread(),
            claim(written, warnings.warn),
            atomic_files() as files,
        ):
            paths = draft_plan(config, self.robot, self.checked, files)
            motors = draft_motor_file(config, self.robot, plan, files, path.parent)
            return paths + motors[0]

    def __str__(self) -> str:
        return "\n".join(self.prediction)

    def __repr__(self) -> str:
        verdict = "keeps all limits"
        if self.failure:
            verdict = f"not to be played: {self.failure}"
        arm = f"{self.robot.n_joints} joints of {self.robot.path.name}"
        return f"<PlanResult {self.duration:g} s for {arm}, {verdict}>"
