"""All checks of a log: of the recording by itself, then the contest of explanations.

Without a model, a recording can be checked for its length, its clock and its torque channels. For
the clock, the displacement of the joints in each step (from one sample to the next) is compared
with that of the steps around it. A step with twice their speed lacks a sample and its time stamp
does not show that; a step without displacement repeats the previous sample; a long step of time
with the displacement of a short one is a jump of the clock.

A log is a sequence of pieces without gaps. A piece has N samples of n joints: ``time`` (N,) [s],
positions ``q`` [rad], velocities ``qd`` [rad/s] or None, and torques ``tau`` [N m], (N, n) each.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

import numpy as np

from robot_sysid.diagnosis import Finding
from robot_sysid.diagnosis.contest import findings
from robot_sysid.diagnosis.limited_in_time import (
    MANY_VALUES,
    Stretch,
    failed_sensors,
    leave_out,
    unusual_torque,
)
from robot_sysid.diagnosis.log_refusal import refuse_for
from robot_sysid.errors import InputError, SysidError, prefix_input_errors
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.rows import Recording
from robot_sysid.logs.reader import MeasurementLog
from robot_sysid.records import Array, Measurement, RobotModel
from robot_sysid.records.messages import (
    Level,
    Progress,
    count_text,
    percent,
    position_unit,
    torque_unit,
)
from robot_sysid.signals.process import LogPiece, check_losses, process
from robot_sysid.signals.resampling import (
    cut_pieces,
    duration,
    sampling_period,
    select_pieces,
)

ROWS = 40
"""Least number of independent samples per joint, for ten parameters and the joint's friction."""
SLOWEST_RATE = 10.0
"""Sampling rate below which a motion cannot be differentiated [Hz]."""
SLOWEST = 0.05
"""Speed that at least one joint has to reach [rad/s]."""
TRYING = "Trying explanations"
"""Label of the progress of the contest of explanations."""


def slow_findings(
    robot: RobotModel, recordings: Sequence[Recording]
) -> Iterator[Finding]:
    """Yield a finding where no speed reaches ``SLOWEST``, too slow for friction."""
    speeds = np.concatenate([each.motion.qd for each in recordings])
    fastest = np.max(np.abs(speeds), axis=0)
    joint = np.argmax(fastest)
    if fastest[joint] < SLOWEST:
        unit = position_unit(robot.is_slide[joint])
        text = f"no joint moves faster than {fastest[joint]:.2g} {unit}/s"
        yield Finding(Level.REFUSES, "too-little", text, "record a faster motion")


def enough_findings(
    pieces: Sequence[Measurement], recordings: Sequence[Recording]
) -> Iterator[Finding]:
    """Yield findings where the sampling rate, or the number of independent samples, is too low.

    A low-pass of f [Hz], as of the recordings, leaves 2 f independent samples per second.
    """
    signals = recordings[0].signals
    span = duration(pieces)
    rows = 2.0 * signals.cutoff * span
    rate = 1.0 / sampling_period(pieces[0].time)
    if rate < SLOWEST_RATE:
        text = f"{rate:.3g} samples per second are too few"
        yield Finding(Level.REFUSES, "too-little", text, "record at 100 or more")
    if rows < ROWS:
        text = (
            f"{span:.3g} s behind a low-pass of {signals.cutoff:.3g} Hz hold about {rows:.0f} "
            f"independent samples per joint, and {ROWS} are needed"
        )
        yield Finding(Level.REFUSES, "too-little", text, "record longer")


REPEATED = 0.3
"""Largest speed of a step that counts as a repeated sample, over that of the steps around it."""
LOST = (1.6, 4.0)
"""Least and largest speed of a step with lost samples, over that of the steps around it: 2 for one
lost sample."""
FEW = 0.003
"""Share of steps with lost or repeated samples above which a finding is made."""
MANY = 0.02
"""Share of steps with lost or repeated samples above which the finding is more severe."""
# Least duration of a step that is a jump of the clock, over the median duration.
_JUMP = 1.75
# Largest displacement in a jump of the clock, over that of the steps around it.
_NO_WAY = 1.4
# Least displacement, over the noise of positions, of the steps that are judged.
_CLEAR = 8.0
# Number of samples of a piece, and of steps of all pieces, below which findings are not made.
_ENOUGH = 100


def clock_findings(pieces: Sequence[Measurement]) -> Iterator[Finding]:
    """Yield findings on the clock: lost samples, repeated samples, and jumps of the time stamps.

    Nothing is found in pieces, or a log, of fewer than ``_ENOUGH`` steps.
    """
    parts = cut_pieces(pieces, _PART)
    steps = [_steps(part) for part in parts if len(part) > _ENOUGH]
    if not steps:
        return
    speed, duration = map(np.concatenate, zip(*steps))
    if len(speed) < _ENOUGH:
        return
    # Speeds and durations are relative to those of the steps around, see ``_steps``.
    is_long = duration > _JUMP
    is_jump = is_long & (speed * duration < _NO_WAY) & (speed > 0.0)
    jumps = np.sum(is_jump)
    speed[is_long] = 1.0
    lost = float(np.mean((speed > LOST[0]) & (speed < LOST[1])))
    # A lost sample doubles the speed; noise makes smaller excesses, too, and more of them.
    uneven = float(np.mean((speed > 1.25) & (speed < 1.5)))
    repeated = float(np.mean(np.abs(speed) < REPEATED))
    remedy = "record the time at which each sample was taken"
    # Noise that makes many steps of the smaller excess may also make those with the larger one.
    if lost > max(FEW, 3.0 * uneven):
        text = f"{percent(lost)} of the steps have lost samples that the time stamps do not show"
        yield Finding(
            Level.REFUSES if lost > MANY else Level.DOUBTS, "clock", text, remedy
        )
    if repeated > FEW:
        text = (
            f"{percent(repeated)} of the steps repeat the position of the sample before while the "
            "arm moves"
        )
        # A low-pass smooths a repeated sample away, but not a wrong time.
        yield Finding(
            Level.DOUBTS if repeated > MANY else Level.SAYS, "clock", text, remedy
        )
    if jumps:
        text = f"the clock jumps ahead {count_text(jumps, 'time')} without a sample missing"
        yield Finding(
            Level.DOUBTS,
            "clock",
            text,
            "use the time stamps of the controller's own clock",
        )


INTEGRATION_TIME = 1.0
"""Time over which recorded velocities are integrated [s]: filters of a drive hardly change such
integrals."""
WRONG_TIME = 0.03
"""Relative error of the time stamps above which a log is refused: correct logs have 0.001, a log
whose velocities pass a low-pass of 3 Hz has 0.028."""
OTHER = 0.5
"""Relative difference above which the velocities are of another motion, or in another unit."""
WRONG_VELOCITY = 0.1
"""Relative difference above which the velocities of single joints are noted."""
ALIKE = 0.02
"""Largest difference between joints in the relative error of the time stamps."""


def velocity_ratios(pieces: Sequence[Measurement]) -> Array:
    """Return recorded velocities over the derivatives of positions, of each joint (n,).

    It is one of joints that hardly move, and where no velocities were recorded.

    The displacements p of a joint by its positions and v by its velocities are compared by the sums
    p.p and p.v over all stretches of ``INTEGRATION_TIME``, one of which begins at every sample of
    the windows of ``spread_windows``. The velocities are p.v / p.p times the derivatives.
    """
    from scipy.integrate import cumulative_trapezoid

    displacements = []
    for piece in spread_windows(pieces):
        length = max(1, round(INTEGRATION_TIME / sampling_period(piece.time)))
        if piece.qd is not None and len(piece) > length:
            integral = cumulative_trapezoid(piece.qd, piece.time, axis=0, initial=0.0)
            tracks = np.stack((piece.q, integral))
            displacements.append(tracks[:, length:] - tracks[:, :-length])
    if not displacements:
        return np.ones(pieces[0].q.shape[1])
    moves = np.concatenate(displacements, axis=1)
    # A constant error of a drive's speed is neither an error of time nor another motion.
    by_position, by_velocity = moves - np.mean(moves, axis=1, keepdims=True)
    squares = np.sum(by_position**2, axis=0)
    # Joints that move enough, with a tenth of the largest displacement.
    moving = squares > 0.01 * np.max(squares)
    products = np.sum(by_position * by_velocity, axis=0)
    return np.where(moving, products / np.where(moving, squares, 1.0), 1.0)


def time_share(ratios: Array) -> float:
    """Return the share by which time is too long if velocities are right, from ratios (n,).

    It is zero where joints do not have it in common.
    """
    off = ratios[ratios != 1.0] - 1.0
    share = float(np.median(off)) if len(off) else 0.0
    is_common = WRONG_TIME < abs(share) < OTHER and np.ptp(off) < ALIKE
    return share if is_common else 0.0


def velocity_notes(ratios: Array, joint_names: Sequence[str]) -> Iterator[Finding]:
    """Yield a note where ratios (n,) of ``velocity_ratios`` are not one."""
    off = np.abs(ratios - 1.0)
    odd = np.flatnonzero((off > WRONG_VELOCITY) & (off < OTHER))
    if len(odd):
        names = ", ".join(joint_names[k] for k in odd.tolist())
        factor = np.median(ratios[odd])
        text = f"recorded velocities of {names} are {factor:.3g} times the derivatives of positions"
        yield Finding(Level.SAYS, "clock", f"{text}, which are used in their place")


def _steps(piece: Measurement) -> tuple[Array, Array]:
    """Return (relative speed (S,), relative duration (S,)) of the S steps with motion above noise.

    The speed of a step, from one sample to the next, is relative to that of the two steps before
    and the two after it, over all joints, and negative against their direction. Its duration is
    relative to the median duration. The first and last two steps are left out, which have no such
    neighbours.
    """
    step = np.diff(piece.time)
    typical_step = np.median(step)
    displacement = np.diff(piece.q, axis=0)
    # Displacement in a step of typical duration.
    pace = displacement * (typical_step / step)[:, None]
    neighbours = (pace[:-4], pace[1:-3], pace[3:-1], pace[4:])
    reference = np.median(neighbours, axis=0)
    square = np.sum(reference**2, axis=1)
    product = np.sum(displacement[2:-2] * reference, axis=1)
    jitter = np.median(np.abs(np.diff(displacement, axis=0)), axis=0)
    duration = step[2:-2] / typical_step
    # Steps with a seventh of the fastest speed or less, near a reversal, say little of the clock.
    is_clear = square > max(_CLEAR**2 * np.sum(jitter**2), 0.02 * np.max(square))
    distance = product[is_clear] / square[is_clear]
    return distance / duration[is_clear], duration[is_clear]


OFTEN = 0.005
"""Share of samples at the end of the range above which a sensor saturates."""
# Number of samples at the end of the range over that of others within 2 % of the range from it,
# above which they are not there by chance.
_CROWDED = 4.0


def saturation_findings(
    robot: RobotModel, pieces: Sequence[Measurement]
) -> Iterator[Finding]:
    """Yield findings on torque channels that saturate, where they are not left out."""
    torques = []
    for piece in pieces:
        left_out = piece.left_out
        torques.append(piece.tau if left_out is None else piece.tau[~left_out])
    for name, values in zip(robot.joint_names, np.concatenate(torques).T):
        if len(np.unique(values)) < MANY_VALUES:
            continue
        near = 0.02 * np.ptp(values)
        for end in (np.min(values), np.max(values)):
            count = np.sum(values == end)
            others = np.sum(np.abs(values - end) < near) - count
            if count > max(OFTEN * len(values), _CROWDED * others):
                share = percent(count / len(values))
                unit = torque_unit(name in robot.slides)
                text = (
                    f"the torque of joint {name} is exactly {end:.4g} {unit}, the end of its "
                    f"range, in {share} of the samples: the sensor saturates"
                )
                yield Finding(
                    Level.DOUBTS, "saturated", text, "move slower, or carry less"
                )


WINDOW = 16.0
"""Length of the windows of a long log that are used [s]."""
CUTOFF_HZ = 8.0
"""Highest cut-off of the low-pass [Hz]: faster motion has little information on links."""
CUTOFF_SHARE = 0.6
"""Ratio of the cut-off to the one that suits accelerations. It is below one because explanations
have columns that are time derivatives of torques: their noise of positions would count as evidence.
"""
MOST_WINDOWS = 4
"""Number of windows of a long log that are used, spread evenly."""
# Longest part of a log in which torque that is unusual is looked for at once [s].
_PART = 56.0
# Time by which parts of a log overlap [s].
_OVERLAP = 4.0
OF_LINKS = (
    "torque-scale",
    "zero",
    "tilt",
    "model",
    "unexplained",
    "clock",
    "gravity",
    "force",
)
"""Checks that a faultless log fails if the arm's links differ from the model's."""


def low_pass(pieces: Sequence[Measurement], cutoff: float | None) -> list[Recording]:
    """Return the low-passed recordings of a log, piece by piece.

    Of a log longer than ``MOST_WINDOWS`` times ``WINDOW``, evenly spread windows are used.
    InputError where most rows lie next to lost samples.

    Args:
        pieces: the log without gaps.
        cutoff: cut-off of the low-pass [Hz], lowered to ``CUTOFF_HZ`` where it is higher; None
            chooses one for each piece from the data.
    """
    signals = []
    for piece in spread_windows(pieces):
        log_piece = LogPiece.of(piece)
        cutoff_hz = min(cutoff or CUTOFF_SHARE * log_piece.choice.cutoff, CUTOFF_HZ)
        signals.append(process(log_piece, cutoff=cutoff_hz))
    check_losses(signals)
    return [Recording("log", piece) for piece in signals]


def spread_windows(pieces: Sequence[Measurement]) -> list[Measurement]:
    """Return the pieces of a log, or windows of them where the log is long.

    It is long above ``MOST_WINDOWS`` times ``WINDOW``; at most ``MOST_WINDOWS`` windows, evenly
    spread, are then returned.
    """
    if duration(pieces) <= MOST_WINDOWS * WINDOW:
        return list(pieces)
    return select_pieces([*cut_pieces(pieces, WINDOW)], MOST_WINDOWS * WINDOW)


def check_pieces(
    robot: RobotModel,
    pieces: Sequence[Measurement],
    options: EstimationOptions | None = None,
    links_known: bool = True,
    divided: Sequence[float] | Array | float = 1.0,
    progress: Progress | None = None,
) -> tuple[tuple[Finding, ...], tuple[Measurement, ...]]:
    """Return the findings of all checks of a log, and its pieces with what is to be used of them.

    Checks against the model are left out where a check of the recording by itself refuses the log.

    Args:
        robot: the arm with its model.
        pieces: the log, cut at gaps.
        options: prior uncertainties of the estimate; None for the defaults.
        links_known: whether the model's links are taken as right; if not, findings of ``OF_LINKS``
            are only notes.
        divided: (n,) torque scales by which the torques were divided already.
        progress: is advanced while the log is looked at; None to show nothing.

    Raises:
        InputError: the log is too short to be looked at.
    """
    options = options or EstimationOptions()
    progress = progress or Progress()
    names = robot.joint_names
    pieces, raw = leave_out(names, pieces, [*failed_sensors(pieces)])
    lasts_a_moment = all(finding.level is Level.SAYS for finding in raw)
    raw += [*clock_findings(pieces), *saturation_findings(robot, pieces)]
    if any(finding.level is Level.REFUSES for finding in raw):
        return _in_order(raw), tuple(pieces)
    recordings = low_pass(pieces, options.cutoff)
    found = [*enough_findings(pieces, recordings)]
    if not found:
        touched = []
        if lasts_a_moment:
            touched = [*_touched(robot, pieces, options, progress)]
        pieces, contacts = leave_out(names, pieces, touched)
        if touched:
            recordings = low_pass(pieces, options.cutoff)
        scales = np.full(len(names), divided, dtype=float)
        # Later checks count only where earlier ones find nothing.
        ratios = velocity_ratios(pieces)
        share = time_share(ratios)
        n_tried = 0

        def advance() -> None:
            """Show that one more explanation was tried."""
            nonlocal n_tried
            n_tried += 1
            # Nobody knows how many follow; a log without a fault takes about ten.
            progress.advance(TRYING, n_tried / (n_tried + 10.0), 1.0, "")

        progress.advance(TRYING, 0.0, 1.0, "")
        found = findings(robot, recordings, options, scales, share, advance)
        progress.advance(TRYING, 1.0, 1.0, "")
        found = found or [*slow_findings(robot, recordings)]
        # Where another fault is found, torque that is odd time and again is of that fault.
        raw += [f for f in contacts if f.level is Level.SAYS or not found]
        if not any(finding.about == "clock" for finding in found):
            raw += velocity_notes(ratios, names)
    if not links_known:
        for k, finding in enumerate(found):
            if finding.about in OF_LINKS:
                found[k] = replace(finding, level=Level.SAYS)
    return _in_order([*raw, *found]), tuple(pieces)


def _in_order(found: Sequence[Finding]) -> tuple[Finding, ...]:
    """Return findings by their level, the most severe first, each once."""
    return tuple(sorted(dict.fromkeys(found), key=lambda f: [*Level].index(f.level)))


def _touched(
    robot: RobotModel,
    pieces: Sequence[Measurement],
    options: EstimationOptions,
    progress: Progress,
) -> Iterator[Stretch]:
    """Yield the stretches of a log with torque that is ordinary at no other time.

    A long log is judged part by part, so that memory does not grow with it. Parts overlap, as the
    low-pass loses their ends.
    """
    windows = [*cut_pieces(pieces, _PART, _OVERLAP)]
    count = min(math.ceil(duration(pieces) / _PART), len(windows))
    parts = np.array_split(np.arange(len(windows)), count)
    for number, part in enumerate(parts):
        progress.advance("Looking for contacts", number, count, "")
        recordings = low_pass([windows[k] for k in part], options.cutoff)
        yield from unusual_torque(robot, recordings, options)


def check_log(
    robot: RobotModel,
    log: MeasurementLog,
    accepted: Collection[str],
    progress: Progress,
    options: EstimationOptions | None = None,
    links_known: bool = True,
) -> MeasurementLog:
    """Return a log without what is left out of it; raise an error where a finding forbids its use.

    The findings that do not forbid it become notes of the log. The error has the refusals or, if
    there are none, the doubts that are not accepted; the other notes are then reported.

    Args:
        robot: the arm with its model.
        log: the log that was read.
        accepted: names of checks whose doubts are accepted.
        progress: is advanced, and receives the notes of a log that is not used.
        options: see ``check_pieces``.
        links_known: see ``check_pieces``.

    Raises:
        InputError: a finding refuses the log, or the log is too short to be checked.
        SysidError: there is a doubt that is not accepted.
    """
    with prefix_input_errors(str(log.path)):
        findings_of_log, pieces = check_pieces(
            robot, log.pieces, options, links_known, log.torque_scale, progress
        )
    notes = list(log.notes)
    for finding in findings_of_log:
        is_accepted = finding.level is Level.DOUBTS and finding.about in accepted
        if finding.level is Level.SAYS or is_accepted:
            notes.append(f"{finding.sentence} [{finding.about}]")
    try:
        require_acceptable(log, findings_of_log, accepted)
    except SysidError:
        progress.note(*notes)
        raise
    return replace(log, pieces=tuple(map(LogPiece.of, pieces)), notes=tuple(notes))


def require_acceptable(
    log: MeasurementLog, findings: Sequence[Finding], accepted: Collection[str] = ()
) -> None:
    """Raise an error where a finding refuses the log or is a doubt that is not accepted.

    Args:
        log: the log that was read.
        findings: the findings of all checks.
        accepted: names of checks whose doubts are accepted.

    Raises:
        ColumnsError: a finding refuses the log, and other columns put it right.
        InputError: a finding refuses the log.
        SysidError: there is a doubt that is not accepted.
    """
    refused = [f for f in findings if f.level is Level.REFUSES]
    # A remedy is none where something else is wrong as well.
    if len(refused) == 1:
        raise refuse_for(log, refused[0])
    if refused:
        raise InputError(f"{log.path}: {'; '.join(f.sentence for f in refused)}")
    doubts = [
        f for f in findings if f.level is Level.DOUBTS and f.about not in accepted
    ]
    if doubts:
        texts = "; ".join(finding.sentence for finding in doubts)
        # Each name once, in the order of the findings.
        names = dict.fromkeys(finding.about for finding in doubts)
        accepting = " ".join(f"--accept {name}" for name in names)
        advice = f"nothing was written (to go on all the same: {accepting})"
        raise SysidError(f"{log.path}: {texts}; {advice}")
