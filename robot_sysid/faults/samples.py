"""What a recording shows by itself, without a model: its clock and its channels. For
the clock, the displacement of the joints in each step (from one sample to the next) is compared
with that of the steps around it. A step with twice their speed lacks a sample and its time stamp
does not show that; a step without displacement repeats the previous sample; a long step of time
with the displacement of a short one is a jump of the clock.

A log is a sequence of pieces without gaps. A piece has N samples of n joints: ``time`` (N,) [s],
positions ``q`` [rad], velocities ``qd`` [rad/s] or None, and torques ``tau`` [N m], (N, n) each.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.faults import Finding
from robot_sysid.faults.stretches import (
    MANY_VALUES,
    failed_sensors,
    held_length,
    leave_out,
)
from robot_sysid.records import Array, Recording, RobotModel
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.levels import SURE
from robot_sysid.records.messages import Level, count_text, percent, torque_unit
from robot_sysid.records.usual_errors import DELAY
from robot_sysid.signals.filters import integrate
from robot_sysid.signals.resampling import (
    GAP_STEPS,
    cut_pieces,
    sampling_period,
    select_pieces,
)

ENOUGH_STEPS = 100
"""Steps of a piece, or of a log, below which nothing is said of its clock."""
PART = 60.0
"""Time of a log that is judged at once [s]."""
JUMP = 1.4
"""Displacement in a long step, over that of a single step, below which the clock has jumped: with a
sample missing it has two."""
DOUBLE_SPEED = (1.6, 4.0)
"""Speeds of a step, over that of its neighbours, that say that samples are lost: one doubles it."""
UNEVEN_SPEED = (1.25, 1.5)
"""Speeds that only noise makes."""
STANDING_SPEED = 0.3
"""Speed of a step, over that of its neighbours, below which it repeats a position."""
FEW = 0.003
"""Share of steps above which a finding is made: right logs with stamps of their samples have none,
logs with one stale sample in a hundred more than twice as many."""
BY_CHANCE = 3.0
"""Steps that look so in a right log that was sampled some times a second: two in 180."""
MUCH = 0.02
"""Share of steps with lost samples from which on a log is refused."""
UNEVEN_STAMPS = 0.02
"""Typical deviation of a step's duration above which stamps are those of a slow computer: a lower
cut-off makes up for them."""
NOISE_OVER_EXCESS = 3.0
"""Steps with the larger speed over those with the smaller one that noise may make."""
OTHER = 0.5
"""Relative difference above which velocities are of another motion, or in another unit."""
WINDOW = 16.0
"""Length of the windows in which velocities and positions are compared [s]."""
COMPARED = 64.0
"""Time of a log in which they are compared [s]."""
LEAST_MOVE = 0.01
"""Squared displacement of a joint that moves enough, over that of the joint that moves most."""
RIGHT_TIME = 0.03
"""Error of time by velocities that is none: more than a low-pass of the velocities makes."""
ODD_VELOCITY = 0.1
"""Error of a joint's velocities from which on it is noted."""
CLEAR_STEP = 64.0
"""Squared displacement of a step over that of noise from which on its speed says something."""
LEAST_STEP = 0.02
"""The same over that of the fastest step: with a seventh of the speed or less, near a reversal, a
step says little of the clock."""
LONGEST_HELD = 2.0 * SURE * 1e-3 * DELAY
"""Longest time for which a column is held, which is late by half of it in the mean [s]."""
NEAR_END = 0.02
"""Distance from an end of a channel's range that is near it, as a share of the range."""
SATURATED = 0.005
"""Share of samples at one value, the end of the range, above which a sensor saturates: more than
right logs have whose torque is read in coarse steps."""
MOST_VISITS = 2
"""Times that a channel that is held, and so has few readings, comes to the end of its range by
chance, as one that is rounded may."""
NEAR_ZERO = 0.02
"""Torque that is next to none, as a share of the joint's largest."""
MOST_TOUCHES = 5
"""Times that a joint's torque comes down to none and is on the same side afterwards, by chance:
rarely once in a right log, again and again in sizes of currents."""
WITH_MOTION = 0.98
"""Share of samples in which a torque has the sign of the motion that weight does not let it have:
at one at least of the joints that carry weight, right logs have it in many fewer. Arms with more
friction than weight have it in all."""
LEAST_SPEED = 0.1
"""Speed of a joint from which on its direction is sure, as a share of its largest."""
DIRECTION_TIME = 0.02
"""Time before and after a sample in which a joint's direction is taken [s]."""
LEAST_WAYS = 0.1
"""Least share of samples in either direction: a weight that is only lifted pulls against it."""
COMPARED_SAMPLES = 2000
"""Samples whose sign is compared with that of the motion."""
SHOWN_WEIGHT = 0.5
"""By how much a torque grows with the model's weight, over the ratio of their means, from which on
it is of weight: torque of weight grows with it about as much as its mean, external torque less."""
LEAST_WEIGHT = 0.25
"""Torque of the model's weight, as a share of that of the joint that carries most, above which a
joint carries weight."""
LEAST_TRAVEL = 0.01
"""Travel below which a joint does not move [rad or m]."""
AT_END_OVER_NEAR = 4.0
"""Samples at the end of the range over those near it that chance does not make; sensors that
saturate make 6 to 12."""


def clock_findings(pieces: Sequence[Recording]) -> Iterator[Finding]:
    """Yield findings on the clock: lost samples, repeated samples, and jumps of the time stamps.

    Nothing is found in pieces, or a log, of fewer than ``ENOUGH_STEPS``.
    """
    parts = cut_pieces(pieces, PART)
    steps = [_steps(part) for part in parts if len(part) > ENOUGH_STEPS]
    if not steps:
        return
    speed, duration = map(np.concatenate, zip(*steps))
    if len(speed) < ENOUGH_STEPS:
        return
    # Speeds and durations are relative to those of the steps around, see ``_steps``: a jump of the
    # clock has the displacement of a single step.
    is_long = duration > GAP_STEPS
    jumps = np.sum(is_long & (speed * duration < JUMP) & (speed > 0.0))
    speed[is_long] = 1.0
    # A lost sample doubles the speed; noise makes smaller excesses, too, and more of them.
    lost, uneven = (
        float(np.mean((speed > least) & (speed < largest)))
        for least, largest in (DOUBLE_SPEED, UNEVEN_SPEED)
    )
    repeated = float(np.mean(np.abs(speed) < STANDING_SPEED))
    is_uneven = np.median(np.abs(duration - 1.0)) > UNEVEN_STAMPS
    level = Level.SAYS if is_uneven else Level.DOUBTS
    remedy = "record the time at which each sample was taken"
    few = max(FEW, BY_CHANCE / len(speed))
    # Noise that makes many steps of the smaller excess may also make those with the larger one.
    if lost > max(few, NOISE_OVER_EXCESS * uneven):
        text = f"{percent(lost)} of the steps have lost samples that the time stamps do not show"
        is_much = lost > MUCH and not is_uneven
        if not is_much:
            # All speeds are too fast by that share, and accelerations by twice as much.
            text += (
                f": viscous friction comes out too small by about {percent(lost)}, rotors and "
                f"inertias by {percent(2.0 * lost)} or more"
            )
        yield Finding(
            Level.REFUSES if is_much else level, FaultName.CLOCK, text, remedy
        )
    # A low-pass smooths a repeated sample away, but not a wrong time.
    if repeated > few:
        text = (
            f"{percent(repeated)} of the steps repeat the position of the sample before while the "
            "arm moves"
        )
        yield Finding(Level.SAYS, FaultName.CLOCK, text, remedy)
    if jumps:
        text = f"the clock jumps ahead {count_text(jumps, 'time')} without a sample missing"
        remedy = "use the time stamps of the controller's own clock"
        yield Finding(level, FaultName.CLOCK, text, remedy)


def velocity_ratios(pieces: Sequence[Recording]) -> Array:
    """Return recorded velocities over the derivatives of positions, of each joint (n,).

    It is one of joints that hardly move, and where no velocities were recorded.

    The displacements p of a joint by its positions and v by its velocities are compared by the sums
    p.p and p.v over all stretches of a second, as filters of a drive hardly change such integrals;
    one begins at every sample of windows that are spread over a long log. The velocities are
    p.v / p.p times the derivatives.
    """
    ratios = np.ones(pieces[0].q.shape[1])
    # Pieces of a log have the same columns.
    if pieces[0].qd is None:
        return ratios
    displacements = []
    for piece in select_pieces([*cut_pieces(pieces, WINDOW)], COMPARED):
        length = max(1, round(1.0 / sampling_period(piece.time)))
        if len(piece) > length:
            assert piece.qd is not None
            tracks = np.stack((piece.q, integrate(piece.qd, piece.time)))
            displacements.append(tracks[:, length:] - tracks[:, :-length])
    if not displacements:
        return ratios
    moves = np.concatenate(displacements, axis=1)
    # A constant error of a drive's speed is neither an error of time nor another motion.
    by_position, by_velocity = moves - np.mean(moves, axis=1, keepdims=True)
    squares = np.sum(by_position**2, axis=0)
    products = np.sum(by_position * by_velocity, axis=0)
    # Joints that move enough, with a tenth of the largest displacement.
    moving = squares > LEAST_MOVE * np.max(squares)
    ratios[moving] = products[moving] / squares[moving]
    return ratios


def time_share(ratios: Array) -> float | None:
    """Return the share by which time is too long if velocities are right, from ratios (n,).

    It is zero where it is none, or none of time; None where no velocity says anything.
    """
    off = ratios[ratios != 1.0] - 1.0
    if not len(off):
        return None
    share = float(np.median(off))
    return share if RIGHT_TIME < abs(share) < OTHER else 0.0


def velocity_notes(ratios: Array, joint_names: Sequence[str]) -> Iterator[Finding]:
    """Yield a note where ratios (n,) of ``velocity_ratios`` are not one."""
    off = np.abs(ratios - 1.0)
    odd = np.flatnonzero((off > ODD_VELOCITY) & (off < OTHER))
    if len(odd):
        names = ", ".join(joint_names[k] for k in odd.tolist())
        factor = np.median(ratios[odd])
        text = f"recorded velocities of {names} are {factor:.3g} times the derivatives of positions"
        yield Finding(
            Level.SAYS, FaultName.CLOCK, f"{text}, which are used in their place"
        )


def _steps(piece: Recording) -> tuple[Array, Array]:
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
    # A slow joint that is sampled fast moves by one or two steps of its encoder at a time.
    moves = np.where(displacement == 0.0, np.inf, np.abs(displacement))
    encoder_step = np.min(moves, axis=0)
    jitter = np.maximum(jitter, np.where(np.isfinite(encoder_step), encoder_step, 0.0))
    duration = step[2:-2] / typical_step
    is_clear = square > max(CLEAR_STEP * np.sum(jitter**2), LEAST_STEP * np.max(square))
    distance = product[is_clear] / square[is_clear]
    return distance / duration[is_clear], duration[is_clear]


def saturation_findings(
    robot: RobotModel, pieces: Sequence[Recording]
) -> Iterator[Finding]:
    """Yield findings on torque channels that saturate, where they are not left out."""
    torques = [piece.tau[~piece.is_left_out] for piece in pieces]
    held = held_samples(pieces, "tau")
    channels = np.concatenate(torques).T
    for name, channel, length in zip(robot.joint_names, channels, held):
        if len(np.unique(channel)) < MANY_VALUES:
            continue
        values, numbers = readings(channel, length)
        total = np.sum(numbers)
        near = NEAR_END * np.ptp(values)
        for end in (np.min(values), np.max(values)):
            is_end = values == end
            # One reading is at the end of any range, and a slow driver may repeat it by chance.
            count = np.sum(numbers[is_end]) - 1
            others = np.sum(numbers[np.abs(values - end) < near]) - count
            is_often = length == 1 or np.count_nonzero(is_end) > MOST_VISITS
            if is_often and count > max(SATURATED * total, AT_END_OVER_NEAR * others):
                share = percent(count / total)
                unit = torque_unit(name in robot.slides)
                text = (
                    f"the torque of joint {name} is exactly {end:.4g} {unit}, the end of its "
                    f"range, in {share} of the samples: the sensor saturates, and what that joint "
                    "carries, its friction and its rotor come out too small"
                )
                yield Finding(
                    Level.DOUBTS,
                    FaultName.SATURATED,
                    text,
                    "move slower, or carry less",
                )


def held_samples(pieces: Sequence[Recording], quantity: str) -> NDArray[np.int64]:
    """Return for how many samples the ``q`` or ``tau`` of each joint (n,) is held."""
    columns = [getattr(piece, quantity).T for piece in pieces]
    return np.array([held_length(channel) for channel in zip(*columns)], dtype=np.int64)


def readings(values: Array, held: int) -> tuple[Array, NDArray[np.int64]]:
    """Return (values (K,), numbers of readings (K,)) of the visits of a channel (N,) to a value.

    ``held``: samples for which a reading is held; a slow driver may hold one somewhat longer.
    """
    starts = np.flatnonzero(np.append(True, np.diff(values) != 0.0))
    lengths = np.diff(np.append(starts, len(values)))
    return values[starts], np.maximum(1, np.round(lengths / held)).astype(np.int64)


def rate_findings(robot: RobotModel, pieces: Sequence[Recording]) -> Iterator[Finding]:
    """Yield the finding that columns are held for so long that they are late."""
    for quantity, word in (("q", "position"), ("tau", "torque")):
        held = held_samples(pieces, quantity)
        length = sampling_period(pieces[0].time) * np.max(held)
        if np.max(held) > 1 and length > LONGEST_HELD:
            names = ", ".join(compress(robot.joint_names, held == np.max(held)))
            # A reading is new in its first sample, and nearly as old as the next in its last.
            late = 1e3 * 0.5 * length * (1.0 - 1.0 / np.max(held))
            yield Finding(
                Level.DOUBTS,
                FaultName.HELD,
                f"the {word} of {names} is new in every {np.max(held)}. sample only, "
                f"{1.0 / length:.3g} times a second: the others repeat it, while the arm moves on, "
                f"so that it is {late:.2g} ms late in the mean",
                "record positions and torques as often as each other, or keep only the rows in "
                "which both are new",
            )


def unsigned_findings(pieces: Sequence[Recording]) -> Iterator[Finding]:
    """Yield the finding that torques have no sign: they come down to zero, and never pass it.

    Weight may hold a joint, or a whole arm, on one side. Where its torque comes down to nothing,
    friction, which turns round with the motion, and noise take it to the other side.
    """
    q, tau = (
        np.concatenate([getattr(piece, name)[~piece.is_left_out] for piece in pieces])
        for name in ("q", "tau")
    )
    moves = (np.ptp(q, axis=0) > LEAST_TRAVEL) & np.any(tau, axis=0)
    tau = tau[:, moves]
    size = np.abs(tau)
    is_one_sided = np.all(tau >= 0.0, axis=0) | np.all(tau <= 0.0, axis=0)
    near = size < NEAR_ZERO * np.max(size, axis=0, initial=0.0)
    returns = np.sum(near[1:] & ~near[:-1], axis=0)
    if len(returns) and np.all(is_one_sided) and np.max(returns) >= MOST_TOUCHES:
        never = "negative" if np.any(tau > 0.0) else "positive"
        yield Finding(
            Level.REFUSES,
            FaultName.UNSIGNED,
            f"the torque of no joint is ever {never}, though it comes down to zero again and "
            "again: it is without a sign, as the size of a motor's current",
            "record the torque, or the current, with its sign: no sign can be given to it "
            "afterwards",
        )


def motion_sign_findings(
    robot: RobotModel, pieces: Sequence[Recording]
) -> Iterator[Finding]:
    """Yield the finding that torques have the sign of the motion, whatever the weight.

    Friction has it, and weight has not: it pulls one way while a joint moves up and down. So does
    the torque of a joint that carries weight, unless friction is larger everywhere. Then it is
    larger by the weight in one direction and smaller by it in the other; a torque without a sign is
    as large in both, and grows with the weight, which friction alone does not (external torque).
    """
    parts = [_directions(piece) for piece in pieces]
    every = max(1, sum(len(q) for q, *_ in parts) // COMPARED_SAMPLES)
    q, way, tau = (np.concatenate(of)[::every] for of in zip(*parts))
    still = np.zeros_like(q)
    weight = ArmDynamics(robot).torque(q, still, still)
    size = np.sqrt(np.mean(weight**2, axis=0))
    is_compared = ~robot.is_slide | np.all(robot.is_slide)
    size = np.where(is_compared & np.any(tau, axis=0), size, 0.0)
    carrying = np.flatnonzero(size > LEAST_WEIGHT * np.max(size))
    if not len(carrying) or not all(
        _has_sign_of_motion(way[:, joint], tau[:, joint], weight[:, joint])
        for joint in carrying.tolist()
    ):
        return
    names = ", ".join(robot.joint_names[joint] for joint in carrying.tolist())
    yield Finding(
        Level.REFUSES,
        FaultName.UNSIGNED,
        f"the torque of {names} has the sign of the motion, up and down alike, which weight has "
        "not: it is without a sign of its own, as the size of a motor's current that was given the "
        "motion's",
        "record the torque, or the current, with its own sign",
    )


def _directions(piece: Recording) -> tuple[Array, Array, Array]:
    """Return (positions, ways in a short time around each, torques) (M, n) of samples in use."""
    reach = max(1, round(DIRECTION_TIME / sampling_period(piece.time)))
    way = piece.q[2 * reach :] - piece.q[: -2 * reach]
    middle = slice(reach, len(piece) - reach)
    is_used = ~piece.is_left_out[middle]
    return piece.q[middle][is_used], way[is_used], piece.tau[middle][is_used]


def _has_sign_of_motion(way: Array, tau: Array, weight: Array) -> bool:
    """Return whether the torque (M,) of a joint has the sign of its ways, and no weight's."""
    size = np.abs(tau)
    is_clear = (np.abs(way) > LEAST_SPEED * np.max(np.abs(way), initial=0.0)) & (
        size > NEAR_ZERO * np.max(size, initial=0.0)
    )
    direction = np.sign(way[is_clear])
    if len(direction) < ENOUGH_STEPS:
        return False
    is_both = abs(float(np.mean(direction))) < 1.0 - 2.0 * LEAST_WAYS
    along = tau[is_clear] * direction
    if not is_both or np.mean(along > 0.0) < WITH_MOTION:
        return False
    own = weight[is_clear]
    # What weight adds in one direction and takes away in the other, beside what is alike in both.
    columns = np.stack((np.abs(own), own * direction, np.ones_like(own)), axis=1)
    alike, *_ = np.linalg.lstsq(columns, along, rcond=None)[0]
    usual = float(np.mean(along)) / max(float(np.mean(np.abs(own))), 1e-300)
    # Friction alone, as of external torque, has that sign, too.
    return float(alike) > SHOWN_WEIGHT * usual


def check_recording(
    robot: RobotModel, pieces: Sequence[Recording]
) -> tuple[list[Finding], list[Recording]]:
    """Return what a recording shows by itself, and its pieces with what is to be used of them.

    Args:
        robot: the arm with its model.
        pieces: the log, cut at gaps.
    """
    kept, found = leave_out(robot.joint_names, pieces, [*failed_sensors(pieces)])
    # Not of servos, whose positions were commanded.
    if all(piece.command is None for piece in kept):
        found += [*unsigned_findings(kept), *motion_sign_findings(robot, kept)]
    found += [
        *clock_findings(kept),
        *saturation_findings(robot, kept),
        *rate_findings(robot, kept),
    ]
    return found, kept
