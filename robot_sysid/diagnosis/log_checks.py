"""All checks of a log: of the recording by itself, then the contest of explanations.

A recording shows without a model: its length, its clock, its torque channels. A joint that moves
goes about as far in one step of time as in the steps around it. A step with twice the speed has
lost a sample that its time stamp does not show; one without speed repeats the sample before it; a
long step of time with the way of a short one is a jump of the clock.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from robot_sysid.diagnosis import Finding, Level
from robot_sysid.diagnosis.contest import Contest, findings
from robot_sysid.diagnosis.relabelling import model_torque
from robot_sysid.diagnosis.rows import low_pass, rms
from robot_sysid.errors import InputError, SysidError, prefix_input_errors
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.logs.reader import MeasurementLog
from robot_sysid.records import Array, Measurement, RobotModel
from robot_sysid.records.messages import Progress, percent
from robot_sysid.signals.process import ProcessedSignals
from robot_sysid.signals.resampling import sampling_period

SHORTEST = 1.0
"""Length of a log below which no arm does anything worth fitting [s]."""


ROWS = 40
"""Independent samples per joint that ten parameters and its friction need at least."""


SLOWEST_RATE = 10.0
"""Samples per second below which a motion cannot be differentiated [Hz]."""


SLOWEST = 0.05
"""Speed that one joint at least has to reach [rad/s]."""


def length_findings(pieces: Sequence[Measurement]) -> Iterator[Finding]:
    """Yield a finding where a log, or what its gaps leave of it, is too short for anything."""
    span = _length(pieces)
    if span < SHORTEST:
        text = f"the log is {span:.2g} s long, too short; record ten seconds or more"
        yield Finding("too-little", Level.REFUSE, text)


def _length(pieces: Sequence[Measurement]) -> float:
    return sum(float(piece.time[-1] - piece.time[0]) for piece in pieces)


def slow_findings(qd: Array) -> Iterator[Finding]:
    """Yield a finding where no joint's speed (K, n) is enough to be told from its friction."""
    fastest = float(np.max(np.abs(qd)))
    if fastest < SLOWEST:
        text = f"no joint moves faster than {fastest:.2g} rad/s; record a faster motion"
        yield Finding("too-little", Level.REFUSE, text)


def enough_findings(pieces: Sequence[Measurement], cutoff: float) -> Iterator[Finding]:
    """Yield what there is too little of behind a low-pass [Hz]."""
    span = _length(pieces)
    rows = int(2.0 * cutoff * span)
    rate = 1.0 / sampling_period(pieces[0].time)
    if rate < SLOWEST_RATE:
        text = f"{rate:.3g} samples per second are too few; record at 100 or more"
        yield Finding("too-little", Level.REFUSE, text)
    if rows < ROWS:
        text = f"{span:.3g} s behind a low-pass of {cutoff:.3g} Hz hold about {rows} "
        text += f"independent samples per joint, and {ROWS} are needed; record longer"
        yield Finding("too-little", Level.REFUSE, text)


LOST = (1.6, 4.0)


REPEATED = 0.3
"""Speed over that of the steps around it, of a step with lost samples (one lost is 2) and of a
repeated one (0)."""


FEW = 0.003


MANY = 0.02
"""Share of such steps that is warned of, and that is refused."""


# Length of a step, in usual ones, and its way, in those of the steps around it, of a clock's jump.
_JUMP = 1.75


_NO_WAY = 1.4


# Ratio to noise of a step that counts, and how many of them say something.
_CLEAR = 8.0


_ENOUGH = 100


def clock_findings(pieces: Sequence[Measurement]) -> Iterator[Finding]:
    """Yield what the steps of a log's pieces say."""
    parts = [_steps(piece) for piece in pieces if len(piece) > _ENOUGH]
    if not parts:
        return
    speed, longer = (np.concatenate(same) for same in zip(*parts))
    if len(speed) < _ENOUGH:
        return
    jumps = int(
        np.count_nonzero((longer > _JUMP) & (speed * longer < _NO_WAY) & (speed > 0.0))
    )
    plain = longer < _JUMP
    lost = float(np.mean(plain & (speed > LOST[0]) & (speed < LOST[1])))
    between = float(np.mean(plain & (speed > 1.25) & (speed < 1.5)))
    still = float(np.mean(plain & (np.abs(speed) < REPEATED)))
    odd = {"repeat the position of the sample before while the arm moves": still}
    if lost > 3.0 * between:
        odd = {"have lost samples that the time stamps do not show": lost, **odd}
    for what, share in odd.items():
        if share > FEW:
            text = f"{100.0 * share:.2g} % of the steps {what}; record the time of each sample"
            # A low-pass takes out a repeated sample, not a time that was lost.
            levels = (
                (Level.WARN, Level.REFUSE)
                if "lost" in what
                else (Level.NOTE, Level.WARN)
            )
            yield Finding("clock", levels[share > MANY], text)
    if jumps:
        text = f"the clock jumps ahead {jumps} times without a sample missing; use the stamps of "
        yield Finding("clock", Level.WARN, f"{text}the controller's own clock")


WINDOW = 1.0
"""Time over which recorded velocities are summed [s]: a drive's filter does little to such sums."""


WRONG_TIME = 0.03


OTHER = 0.5


ALIKE = 0.02
"""Share by which time is off that is refused; by which velocities are something else; by how
much joints may differ in it. A right log has 0.001, one whose velocities pass 3 Hz 0.028."""


def velocity_findings(
    pieces: Sequence[Measurement], joint_names: Sequence[str]
) -> Iterator[Finding]:
    """Yield where positions and recorded velocities disagree about the time, or altogether."""
    known = [piece for piece in pieces if piece.qd is not None]
    if not known:
        return
    products = np.array([_products(known, k) for k in range(len(joint_names))])
    size = products[:, 0, 0]
    clear = np.flatnonzero(size > 0.01 * np.max(size, initial=0.0))
    (size, crossed), (_, other) = products[clear].T
    each = crossed / size
    share = float(np.median(each)) - 1.0 if len(each) else 0.0
    if WRONG_TIME < abs(share) < OTHER and np.ptp(each) < ALIKE:
        text = f"by the recorded velocities, time in the log is {100.0 * abs(share):.2g} % too "
        text += f"{'long' if share > 0.0 else 'short'}; record the controller's own time stamps, "
        text += f"or scale them with --columns FILE: time = {1.0 / (1.0 + share):.3g} * TITLE"
        yield Finding("clock", Level.REFUSE, text)
    off = np.flatnonzero(other - 2.0 * crossed + size > OTHER**2 * size)
    rest = other - each * crossed > OTHER**2 * other
    said = [
        f"{joint_names[clear[k]]} {'another motion' if rest[k] else f'{each[k]:.3g} times that'}"
        for k in off
    ]
    if said:
        name = (
            "order"
            if np.any(rest[off])
            else "sign"
            if np.any(each[off] < 0.0)
            else "angle-unit"
        )
        text = f"recorded velocities are not how positions change ({', '.join(said)}); nothing is "
        text += "made from them, but look which column is wrong, and name it with --columns FILE"
        yield Finding(name, Level.NOTE, text)


def _products(pieces: Sequence[Measurement], joint: int) -> Array:
    """Return products (2, 2) of a joint's ways in all windows, by positions and by velocities.

    Joint by joint: of all at once, a long log would be in memory twice more.
    """
    parts = []
    for piece in pieces:
        assert piece.qd is not None
        q = piece.q[:, joint]
        qd = piece.qd[:, joint]
        length = max(1, round(WINDOW / sampling_period(piece.time)))
        moved = 0.5 * (qd[1:] + qd[:-1]) * np.diff(piece.time)
        summed = np.concatenate(([0.0], np.cumsum(moved)))
        parts.append((q[length:] - q[:-length], summed[length:] - summed[:-length]))
    ways = np.concatenate(parts, axis=1)
    # A drive's constant error of the speed is neither a time nor another motion.
    ways -= np.sum(ways, axis=1, keepdims=True) / max(ways.shape[1], 1)
    return np.asarray(ways @ ways.T)


def _steps(piece: Measurement) -> tuple[Array, Array]:
    """Return per clear step its speed over that around it, and its length over the usual one."""
    step = np.diff(piece.time)
    usual = float(np.median(step))
    size = np.zeros(len(step) - 4)
    along = np.zeros(len(step) - 4)
    noise = 0.0
    for q in piece.q.T:
        way = np.diff(q)
        pace = way * (usual / step)
        a, b, c, d = (pace[k : len(pace) - 4 + k] for k in (0, 1, 3, 4))
        # The mean of the middle two is the median of four.
        lower = np.maximum(np.minimum(a, b), np.minimum(c, d))
        around = 0.5 * (lower + np.minimum(np.maximum(a, b), np.maximum(c, d)))
        size += around**2
        along += way[2:-2] * around
        noise += float(np.median(np.abs(np.diff(way)))) ** 2
    length = step[2:-2] / usual
    clear = size > max(_CLEAR**2 * noise, 0.02 * float(np.max(size, initial=0.0)))
    return along[clear] / size[clear] / length[clear], length[clear]


LONG = 0.3
"""Time for which a torque that changes otherwise is not exactly the same [s]."""


OFTEN = 0.005
"""Share of samples at the largest value beyond which a sensor is at its end."""


# A channel of fewer values has coarse steps, which repeat by themselves.
_MANY_VALUES = 100


# Speed of an arm that moves [rad/s]; samples in a row, or in all, that are no chance.
_MOVING = 0.05


_RUN = 4


_SEEN = 20


def sensor_findings(
    pieces: Sequence[Measurement], joint_names: Sequence[str]
) -> Iterator[Finding]:
    """Yield what the torque channels of a log's pieces say."""
    for joint, name in enumerate(joint_names):
        tau = np.concatenate([piece.tau[:, joint] for piece in pieces])
        if len(np.unique(tau)) < _MANY_VALUES:
            continue
        share, value = max(_at_end(tau, 1.0), _at_end(tau, -1.0))
        if share > OFTEN:
            yield Finding(
                "saturated",
                Level.WARN,
                f"the torque of joint {name} is exactly {value:.4g} N m, the end of its range, in "
                f"{100.0 * share:.2g} % of the samples: the sensor is at its end; move slower, or "
                "carry less",
            )
        held = max(_longest_hold(piece, joint) for piece in pieces)
        if held > LONG:
            text = f"the torque of joint {name} stands still for {held:.2g} s while the arm moves: "
            yield Finding(
                "held",
                Level.WARN,
                f"{text}the channel holds its last value; record again",
            )


def _at_end(tau: Array, sign: float) -> tuple[float, float]:
    """Return (share of samples exactly at the end of the range, that value)."""
    end = float(np.max(sign * tau))
    there = sign * tau == end
    near = (sign * tau > end - 0.02 * float(np.ptp(tau))) & ~there
    runs = np.diff(
        np.flatnonzero(np.diff(np.concatenate(([0], there.view(np.int8), [0]))))
    )
    count = int(np.sum(there))
    beside = int(np.sum(near))
    steady = np.max(runs[::2], initial=0) >= _RUN and count > 3 * beside
    clipped = steady or (count >= _SEEN and count > 5 * beside)
    return (float(np.mean(there)) if clipped else 0.0, sign * end)


def _longest_hold(piece: Measurement, joint: int) -> float:
    """Return for how long a torque stays exactly the same while any joint moves [s]."""
    changes = np.flatnonzero(np.diff(piece.tau[:, joint]))
    edges = np.concatenate(([0], changes + 1, [len(piece)]))
    longest = 0.0
    for start in np.flatnonzero(np.diff(edges) >= _RUN):
        first = edges[start]
        last = edges[start + 1] - 1
        length = float(piece.time[last] - piece.time[first])
        # An arm that comes back to where it was has moved as well.
        moved = np.max(np.ptp(piece.q[first : last + 1], axis=0))
        if length > longest and moved > _MOVING * min(length, 1.0):
            longest = length
    return longest


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
"""Findings that other links than the model's would bring as well."""


# What is left of a torque that follows from rigid bodies alone, its noise and friction, as parts.
_EXACT = 0.004


_QUIET = 5e-4


_FRICTIONLESS = 0.002


def check_against_model(
    robot: RobotModel,
    pieces: Sequence[Measurement],
    options: EstimationOptions | None = None,
    links_known: bool = True,
    divided: Sequence[float] | Array | None = None,
) -> tuple[Finding, ...]:
    """Return what looks wrong with a log.

    Args:
        options: what the estimate allows for; None for what is usual.
        links_known: whether the model's links are right; where they are to be found, what wrong
            ones would bring as well is only told.
        divided: (n,) scale that torques were divided by already.

    Raises:
        InputError: the log is too short to be looked at.
    """
    options = options or EstimationOptions()
    raw = [*length_findings(pieces), *clock_findings(pieces)]
    raw += velocity_findings(pieces, robot.joint_names)
    raw += sensor_findings(pieces, robot.joint_names)
    if any(each.level is Level.REFUSE for each in raw):
        return tuple(raw)
    signals = low_pass(pieces, options.cutoff)
    found = [*enough_findings(pieces, signals[0].cutoff)]
    if not found:
        contest = Contest(robot, signals, options)
        scales = (
            np.ones(robot.n_joints)
            if divided is None
            else np.asarray(divided, dtype=float)
        )
        found = _computed_findings(contest) or findings(contest, scales)
        found = found or [*slow_findings(contest.log.motion.qd)]
    if not links_known:
        found = [
            replace(f, level=Level.NOTE) if f.name in OF_LINKS else f for f in found
        ]
    return (*raw, *found)


def look_at(
    robot: RobotModel,
    log: MeasurementLog,
    accepted: Collection[str],
    progress: Progress,
    options: EstimationOptions | None = None,
    links_known: bool = True,
) -> None:
    """Tell what ``check_against_model`` finds wrong with a log, and ``require_acceptable``."""
    with prefix_input_errors(str(log.path)):
        found = check_against_model(
            robot, log.pieces, options, links_known, log.torque_scale
        )
    for each in found:
        # What stops a log is told when it does.
        if each.level is Level.NOTE or (
            each.level is Level.WARN and each.name in accepted
        ):
            progress.note(each.line().removeprefix("note: "))
    try:
        require_acceptable(str(log.path), found, accepted)
    except SysidError:
        for note in log.notes:
            progress.note(note)
        raise


def require_acceptable(
    log: str, findings: Iterable[Finding], accepted: Collection[str] = ()
) -> None:
    """Stop at what must not become a number; ``accepted`` names warnings that may.

    Raises:
        InputError: a finding refuses the log.
        SysidError: there is a warning that is not accepted.
    """
    found = list(findings)
    refused = [each.text for each in found if each.level is Level.REFUSE]
    if refused:
        raise InputError(f"{log}: {'; '.join(refused)}")
    warned = [f for f in found if f.level is Level.WARN and f.name not in accepted]
    if warned:
        names = " ".join(
            f"--accept {name}" for name in dict.fromkeys(f.name for f in warned)
        )
        texts = "; ".join(each.text for each in warned)
        raise SysidError(
            f"{log}: {texts}; nothing was written (to go on all the same: {names})"
        )


def _computed_findings(contest: Contest) -> list[Finding]:
    """Return a finding where the torque is the model's own, without noise and friction."""
    log = contest.log
    posterior = contest.posterior
    model = model_torque(log)
    loaded = model > 0.1 * float(np.max(model))
    exact = rms(posterior.residual) < _EXACT * log.usual
    quiet = _fast_torque(contest.signals) < _QUIET * log.usual
    friction = contest.friction_share(posterior) < _FRICTIONLESS
    if not np.all((exact & quiet & friction)[loaded]):
        return []
    text = (
        f"the torque follows rigid-body dynamics to {percent(_EXACT)} and has no friction: it was "
        "computed, or commanded, not measured; record the measured torque"
    )
    return [Finding("computed", Level.WARN, text)]


def _fast_torque(signals: Sequence[ProcessedSignals]) -> Array:
    """Return (n,) the usual torque above the low-pass, noise where it was measured [N m]."""
    parts = []
    for each in signals:
        half = each.low_pass.half_width
        parts.append(each.tau[half : len(each) - half] - each.low_pass.filter(each.tau))
    return rms(np.concatenate(parts))
