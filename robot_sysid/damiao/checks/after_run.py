"""What a recorded run says of the arm: where its signals contradict one another or the model.

It is asked when the motors are off, and nothing depends on it but words and an exit code. The
comparison with the model is that of ``robot-sysid check`` (``pipeline/comparison.py``). The
recording's own contradictions need no model:

- A motor in MIT mode makes tau = t + kp (p - q) + kd (v - qd) of the command in force, and reports
  it. A regression of the reported torque on these three (``motor_law``) gives one for each, but for
  what sensors are usually off: less of the stiffness and the damping alone is another TMAX than
  that of the register, nothing of the damping is a gain that is ignored.
- Velocities are the derivatives of positions.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from robot_sysid.damiao.checks.motor_law import (
    PARTS,
    MotorRows,
    MotorSteps,
    estimate_factors,
)
from robot_sysid.damiao.settings import Plan, slowing_in_a_cycle
from robot_sysid.errors import SysidError, error_text
from robot_sysid.model import OF_LOG, ModelOptions
from robot_sysid.records import Array
from robot_sysid.records.drafts import temporary_folder
from robot_sysid.records.levels import SURE
from robot_sysid.records.messages import Progress
from robot_sysid.records.option_fields import given_values

# How far a part's factor may be from one. A motor's torque reading is a few per cent off; of the
# damping a filter of the motor's velocity, which the recording does not have, takes a share.
_TOLERANCES = np.array([0.15, 0.15, 0.5])
# Least share of a joint's torque that a part makes where its factor is judged.
_LEAST_SHARE = 0.03
# Factor of velocities from which on they are not those of the positions, as in
# ``faults.samples``: a low-pass of 3 Hz takes 3 %, steps of the velocity another few.
_LEAST_RATIO = 0.1
# Least velocity (root mean square) that is judged, over the step in which it is reported.
_LEAST_STEPS = 5.0
# Least displacement of a joint whose velocities are judged [rad].
_LEAST_MOTION = 0.1
# Rows of a recording below which nothing is judged: a second at the slowest usual rate.
_LEAST_ROWS = 100
# Least duration of a motion, at its own speed, whose recording is compared with the model [s]. Of
# sound simulated arms, some are told to differ by shorter ones, and none by longer ones, however
# slowly these are played.
_LEAST_SECONDS = 5.0
_REGISTERS = re.compile(
    r"# registers_j(\d+):.*PMAX=([\d.]+).*VMAX=([\d.]+).*TMAX=([\d.]+)"
)
# Steps of a range in an answer: 16 bits of position, 12 of velocity and torque.
POSITION_CODES = 65535
VELOCITY_CODES = 4095
TORQUE_CODES = 4095
_TEMPORARY_NAME = "measured.csv"


@dataclass(frozen=True)
class RunFindings:
    """What the recording of a run says of the arm.

    Attributes:
        lines: a sentence each.
        differs: whether it contradicts itself, or differs from the model by more than usual.
        remedy: what to do; "" for nothing.
    """

    lines: tuple[str, ...] = ()
    differs: bool = False
    remedy: str = ""


@contextlib.contextmanager
def recorded_plan(plan: Plan) -> Iterator[Plan]:
    """Yield the plan with a recording: its own, or a temporary one, which is removed afterwards.

    Where no temporary file can be made, the run is not recorded.
    """
    if plan.recording.record is not None:
        yield plan
        return
    with contextlib.ExitStack() as stack:
        recording = plan.recording
        with contextlib.suppress(OSError):
            folder = stack.enter_context(temporary_folder())
            recording = replace(recording, record=folder / _TEMPORARY_NAME)
        yield replace(plan, recording=recording)


def judge_run(plan: Plan, model: Path | None, options: ModelOptions) -> RunFindings:
    """Return what the recording of a run that went to its end says of the arm.

    It raises nothing: an error of judging is a line.

    Args:
        plan: what was played, with the recording.
        model: file with which the arm is compared; None for none.
        options: which arm of the model it is.
    """
    path = plan.recording.record
    if path is None:
        return RunFindings()
    labels = [joint.label for joint in plan.trajectory.joints]
    lines: list[str] = []
    try:
        lines += contradictions(path, labels)
        if lines:
            # What the signals say of the links is as wrong as they are.
            remedy = "look after the motors' settings and encoders"
            return RunFindings(tuple(lines), True, remedy)
        seconds = float(plan.trajectory.time[-1])
        if model is not None and seconds < _LEAST_SECONDS:
            text = (
                f"a motion of {seconds:.1f} s is too short to compare the arm with its model: "
                f"play one of {_LEAST_SECONDS:.0f} s or longer"
            )
            return RunFindings((text,))
        if model is not None:
            return _beside_model(path, model, options)
    except SysidError as error:
        # A temporary recording is gone when this is read.
        reason = str(error).replace(f"{path}: ", "")
        return RunFindings((f"the recording does not show what the arm is: {reason}",))
    except Exception as error:
        # Nothing that happens here may hide how the run ended.
        return RunFindings(
            (*lines, f"the recording could not be judged: {error_text(error)}"),
            bool(lines),
        )
    return RunFindings()


def _beside_model(path: Path, model: Path, options: ModelOptions) -> RunFindings:
    """Return how the arm of a recording differs from the model; SysidError where nothing shows."""
    # Imported here so that a run does not wait for it.
    from robot_sysid.config import CheckConfig
    from robot_sysid.pipeline.comparison import check_log

    given = given_values(options)
    of_model = {key: given[key] for key in OF_LOG if key in given}
    config = CheckConfig.of(path=model, measurements=(path,), **of_model)
    check = check_log(config, (), Progress())
    if not check.has_changed:
        return RunFindings(check.notes)
    differs, *remedies = check.verdict
    return RunFindings((differs, *check.notes), True, "; ".join(remedies))


def contradictions(path: Path, labels: Sequence[str]) -> list[str]:
    """Return where signals of a recording of n joints contradict one another, a sentence each."""
    gains, steps, columns = _read_recording(path)
    if len(columns["time"]) < _LEAST_ROWS or len(gains["kp"]) != len(labels):
        return []
    sentences = []
    for number, label in enumerate(labels):
        signals = {
            name.partition("_")[2]: values
            for name, values in columns.items()
            if name.startswith(f"j{number}_")
        }
        kp = gains["kp"][number]
        kd = gains["kd"][number]
        rows = MotorRows.of(signals, kp, kd)
        if len(rows.signals["time"]) < _LEAST_ROWS:
            continue
        own = steps.get(number, MotorSteps())
        sentences += [f"{label}: {text}" for text in _of_torque(rows, own)]
        slowed = slowing_in_a_cycle(rows.period, kp, kd)
        of_velocity = _of_velocity(rows.signals, own.velocity, slowed)
        sentences += [f"{label}: {text}" for text in of_velocity]
    return sentences


def _read_recording(
    path: Path,
) -> tuple[dict[str, list[float]], dict[int, MotorSteps], dict[str, Array]]:
    """Return what a recording holds.

    These are the gains kp and kd (n,) in its head, by number of a joint the steps in which its
    motor reports, and the columns (N,) by title.
    """
    gains: dict[str, list[float]] = {"kp": [], "kd": []}
    steps: dict[int, MotorSteps] = {}
    titles: list[str] = []
    rows: list[list[float]] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            key, _, numbers = line[1:].strip().partition("=")
            if key in gains:
                gains[key] = [float(number) for number in numbers.split()]
            match = _REGISTERS.match(line)
            if match:
                number, position, velocity, torque = match.groups()
                steps[int(number)] = MotorSteps(
                    2.0 * float(position) / POSITION_CODES,
                    2.0 * float(velocity) / VELOCITY_CODES,
                    2.0 * float(torque) / TORQUE_CODES,
                )
        elif not titles:
            titles = line.split(",")
        else:
            rows.append([float(cell) if cell else np.nan for cell in line.split(",")])
    table = np.array(rows).reshape(len(rows), len(titles))
    return gains, steps, dict(zip(titles, table.T))


def _of_torque(rows: MotorRows, steps: MotorSteps) -> Iterator[str]:
    """Yield where a joint's reported torque is not that of its commands and its state."""
    if np.count_nonzero(rows.is_judged) < _LEAST_ROWS:
        return
    variances = np.var(rows.parts(np.zeros(len(PARTS))), axis=0)
    total = max(float(np.var(rows.reported_torque)), float(np.max(variances)))
    is_judged = variances > _LEAST_SHARE**2 * total
    if not np.any(is_judged):
        return
    factors, errors = estimate_factors(rows, steps)
    off = np.abs(factors - 1.0) - _TOLERANCES - SURE * errors
    if np.max(off[is_judged]) > 0.0:
        listed = ", ".join(
            f"{factor:.2f} ± {error:.2f} of its {name}"
            for name, factor, error, is_sure in zip(PARTS, factors, errors, is_judged)
            if is_sure
        )
        yield f"the torque that it reports is {listed}, and 1 of each was commanded"


def _of_velocity(
    signals: Mapping[str, Array], step: float, slowed: float
) -> Iterator[str]:
    """Yield where a joint's velocities are not the derivatives of its positions.

    Args:
        signals: of the joint, (N,) each.
        step: in which its motor reports velocity [rad/s].
        slowed: by how much its mean speed may exceed the sampled one, see ``slowing_in_a_cycle``.
            A velocity that is older than its frame may exceed the mean as much: it is that after
            the step which the command has made, and not that before the next one.
    """
    time = signals["time"]
    position = signals["pos"] - np.mean(signals["pos"])
    speed = float(np.sqrt(np.mean(signals["vel"] ** 2)))
    if np.ptp(position) < _LEAST_MOTION or speed < _LEAST_STEPS * step:
        return
    steps = np.diff(time)
    middle = 0.5 * (signals["vel"][1:] + signals["vel"][:-1])
    integral = np.append(0.0, np.cumsum(steps * middle))
    # A constant error of a drive's speed is no contradiction, nor is an age that is not the
    # position's.
    track = np.column_stack(
        (integral, signals["vel"], time - time[0], np.ones_like(time))
    )
    factors, *_ = np.linalg.lstsq(track, signals["pos"], rcond=None)
    if not 1.0 / slowed - _LEAST_RATIO <= factors[0] <= slowed + _LEAST_RATIO:
        yield (f"its positions move by {factors[0]:.2f} times what its velocities say")
