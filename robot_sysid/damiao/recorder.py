"""The measurement file of a run, which is written row by row so that an error loses no rows.

Comment lines describe the run (motors, register values, gains, time stamps). Then there is a row
for each control cycle: ``time``, position, velocity and torque of each joint, and per joint the
time stamp of its own sample, the command in force when it was sampled, whether an answer was
doubted, status and temperatures. Cells of a joint that did not answer, or whose answer was not
believed, are empty but for the status that such an answer reported: an answer with a status that is
not the motor's may be a damaged one, whose other fields are not trusted either.

Printing and recording are done by another thread than the control loop. A terminal that is closed,
held (Ctrl-S) or full, or a disk that is full or does not answer, would otherwise stop or delay the
loop, and the motors' watchdogs would release the arm.

The recorded torque is the mean torque while commands are held.
A motor samples its torque when the next command arrives, at which time the joint has moved towards
the last command and the torque has decreased; then the new command increases the torque by a step.
The torque that acts on the arm at low frequencies differs from the samples in three ways:

- Half a step is missing: kp qd / (2 rate) for a steadily moving joint, which looks like negative
  viscous friction. It is known exactly, because position and velocity do not jump.
- Where steps grow, both sides of one are on average above the commands' mean, by a twelfth of the
  growth: an apparent armature of kp / (12 rate^2).
- Between commands the torque falls by a step. The joints' velocities follow, by up to
  step / (12 rate inertia) at the moment of sampling, and damping makes torque of it. That passes
  for viscous friction of kd kp / (12 rate^2 inertia), and for armature in proportion. Where joints
  are coupled and sampled one after the other, they follow each other's steps too.

The first two are computed from the commands; the third needs the arm's inertia. Measured velocities
would show it too, but a motor's filter delays them by an unknown time, which would look like
armature.
"""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable, Mapping, Sequence
from itertools import starmap
from pathlib import Path

import numpy as np

from robot_sysid.damiao.protocol import MitCommand, register_text
from robot_sysid.damiao.safety.plausibility import NO_STATUS, Replies, without_nan
from robot_sysid.damiao.settings import Plan
from robot_sysid.damiao.trajectory import trajectory_columns
from robot_sysid.errors import InputError
from robot_sysid.records import Array
from robot_sysid.records.file_access import hold
from robot_sysid.wording import option_name

Action = Callable[[], object]
"""A function without arguments that prints or writes."""


class Aside:
    """Runs actions in order without delaying the control loop, and stores their first error.

    After an error no more actions are run; calls raise nothing.

    Args:
        threaded: run actions in a thread of their own; False runs each at once in the caller's
            thread, for simulated time.

    Attributes:
        failure: the first error that an action raised, a TimeoutError of ``finish``, or None.
    """

    def __init__(self, threaded: bool) -> None:
        self.failure: BaseException | None = None
        self._waiting: queue.SimpleQueue[Action | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        if threaded:
            self._thread = threading.Thread(target=self._work, daemon=True)
            self._thread.start()

    def __call__(self, action: Action) -> None:
        """Run an action, or put it into the thread's queue."""
        if self._thread is None:
            self._do(action)
        else:
            self._waiting.put(action)

    def finish(self, patience: float = 2.0) -> None:
        """End the thread, and wait at most ``patience`` [s] until all actions are done.

        Two seconds are longer than a healthy disk takes, and shorter than a person waits. If they
        are not, ``failure`` becomes a TimeoutError unless an action has failed already.
        """
        if self._thread is None:
            return
        self._waiting.put(None)
        self._thread.join(patience)
        if self._thread.is_alive() and self.failure is None:
            self.failure = TimeoutError("it takes nothing any more")

    def _work(self) -> None:
        """Run the actions in the queue until None comes."""
        for action in iter(self._waiting.get, None):
            self._do(action)

    def _do(self, action: Action) -> None:
        """Run an action and store its error; do nothing after an earlier error."""
        if self.failure is not None:
            return
        try:
            action()
        except BaseException as error:
            self.failure = error


# Titles of a joint's further columns, which follow the measured ones of all joints: quantities with
# six decimals, then whole numbers.
_QUANTITIES = ("time", "cmd_pos", "cmd_vel", "cmd_tau", "cmd_mean")
_CODES = ("doubted", "status", "temp_mos", "temp_rotor")


class MeasurementRecorder:
    """Writes a run to a CSV file, row by row, without delaying the control loop.

    A context manager, which ends the file with a line that states how the run ended, and finishes
    ``aside``. Only opening the file raises; a later error is stored as ``failure``, so that the arm
    is brought to rest first.

    Args:
        path: file to write; one that exists raises InputError unless the plan allows to replace it,
            and so does one that another run is writing.
        plan: the plan that is played.
        registers: register values of each joint's motor, by register number.
        aside: runs the actions that write.
    """

    def __init__(
        self,
        path: Path,
        plan: Plan,
        registers: Sequence[Mapping[int, float]],
        aside: Aside,
    ) -> None:
        self._aside = aside
        self._centring = Centring(plan.settings.period, plan.mobility)
        n_joints = plan.trajectory.n_joints
        columns = ["time", *trajectory_columns(n_joints)]
        formats = ["%.6f"] * len(columns)
        for j in range(n_joints):
            columns += [f"j{j}_{signal}" for signal in _QUANTITIES + _CODES]
            formats += ["%.6f"] * len(_QUANTITIES) + ["%.0f"] * len(_CODES)
        self._row_format = ",".join(formats) + "\n"
        lines = [f"# {line}" for line in _head(plan, registers)]
        lines.append(",".join(columns))
        mode = "w" if plan.recording.overwrite else "x"
        self._held = contextlib.ExitStack()
        self._held.enter_context(hold(path, option_name("record")))
        try:
            # Each line goes to the operating system at once, which writes it even if this program
            # dies.
            self._file = open(path, mode, buffering=1, encoding="utf-8")  # noqa: SIM115
            self._file.write("\n".join(lines) + "\n")
        except OSError as error:
            self._held.close()
            raise InputError(f"cannot write {path}: {error.strerror}") from None

    @property
    def failure(self) -> BaseException | None:
        """Why the recording is not complete, or None."""
        return self._aside.failure

    def __enter__(self) -> MeasurementRecorder:
        """Return this recorder, whose file is open already."""
        return self

    def __exit__(
        self, error_type: object, error: BaseException | None, trace: object
    ) -> None:
        """Write how the run ended, and close the file; an error of the run is not suppressed.

        Where writing fails, ``failure`` holds the reason, and nothing is raised.
        """
        ending = "completed"
        if error is not None:
            ending = f"stopped: {error}".replace("\n", " ")
        self._aside(lambda: self._file.write(f"# end: {ending}\n"))
        self._aside(self._file.close)
        self._aside.finish()
        if self.failure is not None:
            with contextlib.suppress(OSError):
                self._file.close()
        self._held.close()

    def write(
        self,
        time: float,
        origin: float,
        replies: Replies,
        acted: MitCommand,
        mark: str = "",
    ) -> None:
        """Write a cycle as a row of the file, with its cells in the order of the titles.

        Args:
            time: time since the trajectory began [s].
            origin: time in the link's clock at which the trajectory began [s].
            replies: replies of the joints in this cycle.
            acted: command in force when the replies were sampled, in joint space.
            mark: begin of the line; "# ..." makes it a comment.
        """

        def write_row() -> None:
            """Write the measured columns of all joints, then the further ones."""
            feedback = replies.feedback
            centre = self._centring.torques(replies, acted)
            # Also of an answer that is not believed, perhaps because of its status.
            is_reported = replies.reported != NO_STATUS
            status = np.where(is_reported, replies.reported, np.nan)
            temperatures = feedback.temperature_mos, feedback.temperature_rotor
            measured = (feedback.position, feedback.velocity, feedback.torque + centre)
            further = (
                replies.time - origin,
                acted.position,
                acted.velocity,
                acted.torque,
                centre,
                replies.doubted,
                status,
                *np.where(replies.answered, temperatures, np.nan),
            )
            # Joint by joint.
            cells = [
                time,
                *np.array(measured).ravel("F").tolist(),
                *np.array(further).ravel("F").tolist(),
            ]
            # What is not known is an empty cell.
            row = (self._row_format % tuple(cells)).replace("nan", "")
            self._file.write(mark + row)

        self._aside(write_row)


def _head(plan: Plan, registers: Sequence[Mapping[int, float]]) -> list[str]:
    """Return the comment lines at the head of a recording, without their "# ".

    The arguments are those of ``MeasurementRecorder``.
    """
    run = plan.settings
    lines = ["robot-sysid motors recording", f"trajectory={plan.trajectory.path.name}"]
    for joint in plan.trajectory.joints:
        lines.append(
            f"motor_type={joint.motor_type},can_id={joint.can_id},mode=MIT,"
            f"master_id={joint.master_id}"
        )
    for j, values in enumerate(registers):
        texts = starmap(register_text, sorted(values.items()))
        lines.append(f"registers_j{j}: {','.join(texts)}")
    lines.append(f"rate_hz={run.rate:g},speed={run.speed:g}")
    for name, gains in (("kp", run.kp), ("kd", run.kd)):
        lines.append(f"{name}={' '.join(map('{:g}'.format, gains))}")
    return [
        *lines,
        "half_step=1: half a quantisation step added to measured position, velocity and torque, "
        "because motors drop the fraction",
        "centred=1: jN_tau is the measured torque plus jN_cmd_mean, the mean of held commands",
        "jN_time is when joint N was sampled, jN_cmd_* the command in force at that moment",
        "jN_doubted=1: an answer came that cannot be true; it is left out here, but for its status",
    ]


class Centring:
    """Corrects the sampled torques of a run to mean torques while commands are held.

    It is used once per control cycle, and remembers the last cycle.

    Args:
        period: length of a control cycle [s].
        mobility: inverse mass matrix (n, n) [1/(kg m^2)]; None where it is unknown, then the third
            difference in the module's docstring remains.
    """

    def __init__(self, period: float, mobility: Array | None = None) -> None:
        self._period = period
        self._mobility = mobility
        # Time and torque step (2, n) of each joint's last answer.
        self._last: Array | None = None

    def torques(self, replies: Replies, acted: MitCommand) -> Array:
        """Return the corrections (n,) to add to a cycle's torques [N m].

        To be called once per cycle, in order: the state of the cycle is stored. ``acted`` is the
        command in force at the samples. Where a joint did not answer, the result is NaN.

        A sawtooth of torque makes a periodic motion, whose velocity follows Bernoulli's second
        polynomial where a joint has inertia only. With damping its velocity decays by a factor
        exp(-a) in a period, which makes the motion smaller by sqrt(1 + (a / 6)^2), within 7 %.
        """
        command = replies.command or acted
        motion = replies.feedback.position, replies.feedback.velocity
        # The step by which the torque changes when the new command acts.
        step = command.motor_torque(*motion) - acted.motor_torque(*motion)
        state = np.array([replies.time, step])
        last = state if self._last is None else self._last
        # A joint that did not answer gets its last time and torque step.
        self._last = np.where(np.isfinite(state), state, last)
        correction = 0.5 * step - without_nan(step - last[1]) / 12.0
        if self._mobility is None:
            return correction
        time, steps = self._last
        # Share of a period that has passed at joint i (rows) since joint j's torque stepped.
        share = (time[:, None] - time) / self._period % 1.0
        polynomial = 0.5 * share * (share - 1.0) + 1.0 / 12.0
        impulse = acted.kd * self._period
        fallen = impulse * ((self._mobility * polynomial) @ steps)
        fallen /= np.hypot(1.0, impulse * np.diag(self._mobility) / 6.0)
        return correction - without_nan(fallen)
