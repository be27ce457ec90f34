"""The measurement file of a run: written row by row, so that whatever happens, rows are kept.

Comment lines say how it was made (motors, register values, gains, time stamps). Then one row per
control cycle: ``time``, position, velocity and torque of each joint, and per joint the time stamp
of its own sample, the command in force when it was sampled, whether an answer was doubted, status
and temperatures. Cells of a joint that did not answer, or whose answer was not believed, are empty.

Printing and recording happen beside a run. A terminal that is gone, held (Ctrl-S) or full, a disk
that is full or does not answer: a control loop that printed by itself would fail or wait with it,
and the motors' watchdogs would let the arm go. So what is to be said and written is handed over.
"""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from robot_sysid.damiao.bus import RawFrameLog
from robot_sysid.damiao.centring import Centring
from robot_sysid.damiao.protocol.codec import MitCommand
from robot_sysid.damiao.protocol.frames import text_of
from robot_sysid.damiao.protocol.joints import DamiaoJoint
from robot_sysid.damiao.session import Replies
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.errors import InputError

Action = Callable[[], object]
# A judgement: longer than a healthy disk takes, shorter than a person waits for the end of a run.
_PATIENCE = 2.0


class Aside:
    """Does things one after the other; what goes wrong is kept as ``failure`` instead of raised.

    After a failure nothing more is done. Threaded, it has a thread of its own; without, things are
    done at once (for simulated time, where nobody waits).
    """

    def __init__(self, threaded: bool) -> None:
        self.failure: BaseException | None = None
        self._waiting: queue.SimpleQueue[Action | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        if threaded:
            self._thread = threading.Thread(target=self._work, daemon=True)
            self._thread.start()

    def __call__(self, action: Action) -> None:
        """Have something done."""
        if self._thread is None:
            self._do(action)
        else:
            self._waiting.put(action)

    def if_idle(self, action: Action) -> None:
        """Have something done that is not worth waiting for, such as moving a progress bar."""
        if self._waiting.empty():
            self(action)

    def finish(self, patience: float = _PATIENCE) -> None:
        """Wait until all is done, or until ``patience`` [s] is at an end."""
        if self._thread is None:
            return
        self._waiting.put(None)
        self._thread.join(patience)
        if self._thread.is_alive() and self.failure is None:
            self.failure = TimeoutError("it takes nothing any more")

    def _work(self) -> None:
        while (action := self._waiting.get()) is not None:
            self._do(action)

    def _do(self, action: Action) -> None:
        if self.failure is not None:
            return
        try:
            action()
        except BaseException as error:
            self.failure = error


_MEASURED = ("pos", "vel", "tau")
_COMMANDS = ("cmd_pos", "cmd_vel", "cmd_tau", "cmd_step", "cmd_mean")
_EXTRA = ("time", *_COMMANDS, "doubted", "status", "temp_mos", "temp_rotor")


def head_lines(
    joints: Sequence[DamiaoJoint],
    registers: Sequence[Mapping[int, float]],
    run: PlaySettings,
    source: str,
) -> list[str]:
    """Return the comment lines of a recording; registers are, per joint, number to value."""
    texts = [",".join(text_of(k, held[k]) for k in sorted(held)) for held in registers]
    return [
        "robot-sysid motors recording",
        f"trajectory={source}",
        *(
            f"motor_type={j.motor_type},can_id={j.can_id},mode=MIT,master_id={j.master_id}"
            for j in joints
        ),
        *(f"registers_j{j}: {text}" for j, text in enumerate(texts)),
        f"rate_hz={run.rate:g},speed={run.speed:g}",
        "kp=" + " ".join(f"{x:g}" for x in run.kp),
        "kd=" + " ".join(f"{x:g}" for x in run.kd),
        "half_step=1: half a quantisation step added to measured position, velocity and torque, "
        "because motors drop the fraction",
        "centred=1: jN_tau is the measured torque plus jN_cmd_mean, the mean of held commands",
        "jN_cmd_step is the torque step that the command answered by this sample then made",
        "jN_time is when joint N was sampled, jN_cmd_* the command in force at that moment",
        "jN_doubted=1: an answer came that cannot be true; it is left out here",
    ]


class MeasurementRecorder:
    """Writes a run of labelled joints to a CSV file, row by row but aside of the control loop.

    A context manager; the file's last line says how the run ended. Only opening raises: what goes
    wrong later is kept in ``failure``, and the arm is brought to rest first. ``aside`` does the
    writing; the frames are written with every row, if given. ``centring`` makes mean torques of
    those that were sampled.
    """

    def __init__(
        self,
        path: Path,
        head: Sequence[str],
        labels: Sequence[str],
        aside: Aside,
        centring: Centring,
        frames: RawFrameLog | None = None,
        overwrite: bool = False,
    ) -> None:
        self._aside = aside
        self._frames = frames
        self._n = len(labels)
        self._centring = centring
        columns = ["time"]
        for signals in (_MEASURED, _EXTRA):
            columns += [f"{label}_{signal}" for label in labels for signal in signals]
        try:
            self._file = open(path, "w" if overwrite else "x", encoding="utf-8")  # noqa: SIM115
            self._file.writelines(
                [*(f"# {line}\n" for line in head), ",".join(columns) + "\n"]
            )
            self._file.flush()
        except OSError as error:
            raise InputError(f"cannot write {path}: {error.strerror}") from None

    @property
    def failure(self) -> BaseException | None:
        """Why the recording is not complete, or None."""
        return self._aside.failure

    def __enter__(self) -> MeasurementRecorder:
        return self

    def __exit__(
        self, error_type: object, error: BaseException | None, trace: object
    ) -> None:
        ending = (
            "completed" if error is None else f"stopped: {error}".replace("\n", " ")
        )
        self.end_cycle()
        self._aside(lambda: self._file.write(f"# end: {ending}\n"))
        self._aside(self._file.close)
        self._aside.finish()
        if self.failure is not None:
            with contextlib.suppress(OSError):
                self._file.close()

    def write(
        self, time: float, origin: float, replies: Replies, acted: MitCommand
    ) -> None:
        """Write a cycle at ``time`` after ``origin`` [s]; its samples were under ``acted``."""
        self._aside(lambda: self._file.write(self._row(time, origin, replies, acted)))

    def end_cycle(self) -> None:
        """Hand everything to the operating system, which keeps it even if this process dies."""
        self._aside(self._file.flush)
        if self._frames:
            frame_log = self._frames
            frames = frame_log.take_frames()
            self._aside(lambda: frame_log.write(frames))

    def _row(
        self, time: float, origin: float, replies: Replies, acted: MitCommand
    ) -> str:
        measured = replies.feedback
        step, centre = self._centring.torques(replies, acted)
        cells = [f"{time:.6f}"]
        values = measured.position, measured.velocity, measured.torque + centre
        for joint in list(zip(*values))[: self._n]:
            cells += _numbers(joint)
        command = acted.position, acted.velocity, acted.torque, step, centre
        columns = replies.time - origin, *command
        state = (measured.status, measured.temperature_mos, measured.temperature_rotor)
        for j, answered in enumerate(replies.answered[: self._n]):
            cells += _numbers([column[j] for column in columns])
            cells.append(str(int(replies.doubted[j])))
            cells += [str(code[j]) if answered else "" for code in state]
        return ",".join(cells) + "\n"


def _numbers(values: Iterable[float]) -> list[str]:
    return [f"{value:.6f}" if np.isfinite(value) else "" for value in values]
