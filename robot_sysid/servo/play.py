"""Joints behind servos, each played by itself: commands in, motion out, for many sets of numbers.

Of one joint of an arm the others are where they were measured. What the links ask of it is then a
number that changes with time: c(t) + M(t) qdd + G(t) (q - measured q), with the torque c of the
measured motion without the joint's own acceleration, the inertia M about the joint and the slope G
of its weight. So the joints of an arm are played side by side, each from the start of each of many
short windows (multiple shooting, Bock 1983), for every set of numbers that a search asks for, in
one loop over time steps.

A step is that of Störmer and Verlet: velocities are half a step before positions. Damping is exact
to second order, dry friction implicit: it holds a joint that it can hold.

T is the number of tracks, a track being a joint in a window; S that of steps, m that of samples in
a window, v that of sets of numbers, J that of directions of link errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

import robot_sysid.records.usual_errors as usual_errors
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.estimate.links import EXPECTED, link_factor
from robot_sysid.records import Array, Recording, RobotModel
from robot_sysid.servo.loop import MAX_DELAY, commands, longest_period, low_pass_motion
from robot_sysid.servo.setting import gain_of, links_of, strength_of
from robot_sysid.servo.unknowns import NAMES, SLIP_SPEED
from robot_sysid.simulation.playback import interpolate

STEPS = (0.001, 0.002)
"""Least and largest time step [s]."""
STEPS_PER_SAMPLE = 12.0
"""Time steps between samples, within ``STEPS``."""
FADED = 40.0
"""Exponent at which friction has faded: what is less takes a processor long."""
TOGETHER = 40
"""Sets of numbers that are played together: more do not fit into a processor's cache."""
KEPT = 4
"""Steps between positions that are kept; samples between them are interpolated."""
DIRECTIONS = 5
"""Number of directions in which link errors change the torque of a joint most."""
ANGLE = 1e-4
"""Change of a joint's position of the slope of its weight [rad or m]."""
LARGEST_ERROR = np.pi
"""Largest position error of a sample [rad or m]: that of a play that diverges."""
LINK_SHARE = 0.01 * usual_errors.LINK
"""Relative standard deviation of links, as ``link_factor`` takes it."""
LINK_ERROR = LINK_SHARE * EXPECTED.mass
"""Relative standard deviation of the links' masses."""


@dataclass(frozen=True)
class Tracks:
    """What drives each joint in each window.

    Attributes:
        step: time step of a play [s].
        joint: (T,) number of the joint.
        scale: (T,) gain over that of the first recording, by register and voltage.
        strength: (T,) torque limit over that of the first recording, by voltage.
        command: (H + S, T) commanded positions at the steps, those before the start first.
        torque: (S, T) of the measured motion without the joint's own acceleration [N m].
        inertia: (S, T) of the links about the joint [kg m^2].
        slope: (S, T) of the joint's weight [N m/rad].
        middle: (S, T) measured positions behind a low-pass [rad or m].
        errors: (J, S, T) torque without the joint's own acceleration by one standard deviation of
            each direction of link errors [N m].
        inertia_errors: (J, S, T) inertia about the joint by the same [kg m^2].
        start: (2, T) position and velocity at the start [rad, rad/s].
        sample: (T, m) kept step before each sample; zero beyond the last.
        share: (T, m) of the way to the next one.
        is_sample: (T, m) whether there is a sample.
        measured: (T, m) positions [rad or m].
    """

    step: float
    joint: NDArray[np.int64]
    scale: Array
    strength: Array
    command: Array
    torque: Array
    inertia: Array
    slope: Array
    middle: Array
    errors: Array
    inertia_errors: Array
    start: Array
    sample: NDArray[np.int64]
    share: Array
    is_sample: NDArray[np.bool_]
    measured: Array

    def __len__(self) -> int:
        """Return the number of tracks."""
        return len(self.joint)

    def at(self, chosen: NDArray[np.int64]) -> Tracks:
        """Return some of the tracks, any of them several times."""
        by_column = ("command", "torque", "inertia", "slope", "middle", "start")
        changes = {name: getattr(self, name)[:, chosen] for name in by_column}
        by_row = (
            "joint",
            "scale",
            "strength",
            "sample",
            "share",
            "is_sample",
            "measured",
        )
        changes.update((name, getattr(self, name)[chosen]) for name in by_row)
        errors = ("errors", "inertia_errors")
        changes.update((name, getattr(self, name)[:, :, chosen]) for name in errors)
        return replace(self, **changes)


@dataclass(frozen=True)
class _Links:
    """What the links ask of each joint at the samples of a piece: (N, n) each, errors (N, n, E) of
    the torque at the measured motion, of that without own acceleration, and of the inertia.
    """

    torque: Array
    inertia: Array
    slope: Array
    middle: Array
    speed: Array
    errors: Array
    own_errors: Array
    inertia_errors: Array


def _links(robot: RobotModel, piece: Recording, factor: Array) -> _Links:
    """Return what the links ask of each joint of a piece.

    Args:
        robot: the arm.
        piece: of a log, whose setting may name a load.
        factor: of the links' errors, see ``link_factor``.
    """
    dynamics = LinkDynamics(robot)
    thetas, is_known = links_of(robot, piece.setting)
    q, qd, qdd = low_pass_motion(piece)
    motion = dynamics.motion(q, qd, qdd)
    torque = motion.torque(thetas)
    links = np.arange(robot.n_joints)
    unknown = factor * np.repeat(~is_known, len(factor) // len(links))[:, None]
    errors = motion.columns(links.tolist()) @ unknown
    zero = np.zeros_like(q)
    at_rest = dynamics.motion(q, zero, zero)
    torque_at_rest = at_rest.torque(thetas)
    columns_at_rest = at_rest.columns(links.tolist())
    inertia_errors = np.empty_like(errors)
    inertia = np.empty_like(q)
    slope = np.empty_like(q)
    for joint in links.tolist():
        unit = np.zeros(robot.n_joints)
        unit[joint] = 1.0
        pushed = dynamics.motion(q, zero, zero + unit)
        inertia[:, joint] = (pushed.torque(thetas) - torque_at_rest)[:, joint]
        change = (pushed.columns(links.tolist()) - columns_at_rest)[:, joint]
        inertia_errors[:, joint] = change @ unknown
        moved = (q + ANGLE * unit, q - ANGLE * unit)
        more, less = (dynamics.motion(each, qd, qdd).torque(thetas) for each in moved)
        slope[:, joint] = (more - less)[:, joint] / (2.0 * ANGLE)
    own_errors = errors - inertia_errors * qdd[:, :, None]
    own = torque - inertia * qdd
    return _Links(own, inertia, slope, q, qd, errors, own_errors, inertia_errors)


def make_tracks(
    robot: RobotModel, pieces: Sequence[Recording], window: float, most: int
) -> Tracks:
    """Return the tracks of an arm's joints in windows of pieces of its logs.

    Args:
        robot: the arm as in the model file.
        pieces: of logs, which have commands.
        window: about the length of a window [s].
        most: largest number of windows; they are spread evenly over the pieces.
    """
    n = robot.n_joints
    factor = link_factor(robot, [*range(n)], LINK_SHARE)
    links = [_links(robot, piece, factor) for piece in pieces]
    together = np.concatenate([each.errors for each in links])
    directions = []
    for joint in range(n):
        *_, rows = np.linalg.svd(together[:, joint], full_matrices=False)
        directions.append(rows[:DIRECTIONS].T)
    windows = []
    for k, piece in enumerate(pieces):
        length = piece.time[-1] - piece.time[0]
        edges = np.linspace(0, len(piece) - 1, max(round(length / window), 1) + 1)
        edges = np.round(edges).astype(int)
        windows += [
            (k, slice(first, last + 1)) for first, last in zip(edges, edges[1:])
        ]
    spread = np.linspace(0, len(windows) - 1, min(len(windows), most))
    windows = [windows[k] for k in np.unique(np.round(spread).astype(int))]
    lengths = [pieces[k].time[at][-1] - pieces[k].time[at][0] for k, at in windows]
    most_samples = max(len(pieces[k].time[at]) for k, at in windows)
    step = float(np.clip(longest_period(pieces) / STEPS_PER_SAMPLE, *STEPS))
    n_steps = KEPT * (int(np.ceil(max(lengths) / (step * KEPT))) + 1)
    before = round(MAX_DELAY / step) + 2
    parts = []
    for k, at in windows:
        piece = pieces[k]
        start = piece.time[at][0]
        time = start + step * np.arange(n_steps)
        early = start + step * np.arange(-before, n_steps)
        # A command holds until the next one comes.
        last = np.searchsorted(piece.time, early, side="right") - 1
        along = links[k]
        at_time = [
            interpolate(time, piece.time, values)
            for values in (along.torque, along.inertia, along.slope, along.middle)
        ]
        errors, inertia_errors = (
            np.moveaxis(
                np.array(
                    [
                        interpolate(time, piece.time, of[:, joint] @ directions[joint])
                        for joint in range(n)
                    ]
                ),
                (2, 1),
                (0, 1),
            )
            for of in (along.own_errors, along.inertia_errors)
        )
        since = (piece.time[at] - start) / (step * KEPT)
        gap = most_samples - len(since)
        padded = np.pad(since, (0, gap))
        sample = np.minimum(padded.astype(int), n_steps // KEPT - 1)
        parts.append(
            (
                np.arange(n),
                np.full(n, gain_of(piece.setting, pieces[0].setting)),
                np.full(n, strength_of(piece.setting, pieces[0].setting)),
                commands(piece)[np.maximum(last, 0)],
                *at_time,
                errors,
                inertia_errors,
                np.stack((piece.q[at][0], along.speed[at][0])),
                np.tile(sample, (n, 1)),
                np.tile(padded - sample, (n, 1)),
                np.tile(np.arange(most_samples) < len(since), (n, 1)),
                np.pad(piece.q[at], ((0, gap), (0, 0))).T,
            )
        )
    axes = (0, 0, 0, 1, 1, 1, 1, 1, 2, 2, 1, 0, 0, 0, 0)
    return Tracks(
        step, *(np.concatenate(rows, axis) for rows, axis in zip(zip(*parts), axes))
    )


def play(tracks: Tracks, numbers: Array, errors: Array, start: Array) -> Array:
    """Return played minus measured positions (v, T, m) [rad or m]; zero where there is no sample.

    Args:
        tracks: what drives the joints.
        numbers: (v, T, u) of ``unknowns``, gains in N m/rad.
        errors: (v, T, J) link errors in standard deviations.
        start: (v, 2, T) added to the tracks' start.
    """
    parts = []
    for first in range(0, len(numbers), TOGETHER):
        at = slice(first, first + TOGETHER)
        kept = _positions(tracks, numbers[at], errors[at], start[at])
        columns = np.arange(len(tracks))[:, None]
        lower = np.moveaxis(kept, 1, 2)[tracks.sample, columns]
        upper = np.moveaxis(kept, 1, 2)[tracks.sample + 1, columns]
        played = lower + tracks.share[..., None] * (upper - lower)
        missed = played - tracks.measured[..., None]
        missed = np.nan_to_num(missed, nan=LARGEST_ERROR)
        missed = np.clip(missed, -LARGEST_ERROR, LARGEST_ERROR)
        parts.append(np.moveaxis(missed * tracks.is_sample[..., None], 2, 0))
    return np.concatenate(parts)


def _distinct(rows: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return where each distinct row of (v, ...) is first, and which of them each row is."""
    flat = rows.reshape(len(rows), -1)
    _, first, which = np.unique(flat, axis=0, return_index=True, return_inverse=True)
    return first, which.reshape(-1)


def _goals(tracks: Tracks, delay: Array, lag: Array) -> Array:
    """Return what servos follow (S, v, T): commands of a delay (v, T) before, smoothed by a lag.

    Smoothing is that of first order.
    """
    from scipy.signal import lfilter

    n_steps = len(tracks.torque)
    before = len(tracks.command) - n_steps
    # Velocities are half a step before positions: what comes at a step acts from its middle on.
    late = np.clip(delay / tracks.step + 0.5, 0.0, before - 2.0)
    whole = late.astype(int)
    part = late - whole
    goals = np.empty((n_steps, *delay.shape))
    for k in range(delay.shape[0]):
        for track in range(delay.shape[1]):
            end = len(tracks.command) - whole[k, track]
            now = tracks.command[end - n_steps - 1 : end, track]
            goal = now[1:] + part[k, track] * (now[:-1] - now[1:])
            follows = tracks.step / (lag[k, track] + tracks.step)
            if follows < 1.0:
                rest = [(1.0 - follows) * goal[0]]
                goal, _ = lfilter([follows], [1.0, follows - 1.0], goal, zi=rest)
            goals[:, k, track] = goal
    return goals


@dataclass(frozen=True)
class _Servos:
    """Numbers (v, T) of servos of a play, by which its steps go; all torques are over the gain.

    Attributes:
        limit, least_limit: largest and least torque [rad or m].
        dead_zone, least_zone: distance from a goal within which there is no torque, to both sides
            [rad or m].
        damping: of joint and servo [s].
        coulomb, stribeck: friction, and what there is more of it at rest [rad or m].
        share: friction over the torque of motor and links.
        per_gain: one over the gain [rad/(N m)].
        rotor: inertia over the time step [s].
    """

    limit: Array
    least_limit: Array
    dead_zone: Array
    least_zone: Array
    damping: Array
    coulomb: Array
    stribeck: Array
    share: Array
    per_gain: Array
    rotor: Array

    def motor_torque(self, error: Array) -> Array:
        """Return the torque of servos by their position error, in the place of the error."""
        within = np.minimum(error, self.dead_zone)
        np.maximum(within, self.least_zone, out=within)
        error -= within
        np.minimum(error, self.limit, out=error)
        np.maximum(error, self.least_limit, out=error)
        return error

    def friction(self, qd: Array, motor: Array, links: Array) -> Array:
        """Return the friction that a motion at qd can have, whatever its direction."""
        friction = motor - self.damping * qd
        friction += links
        np.abs(friction, out=friction)
        friction *= self.share
        friction += self.coulomb
        fades = qd * (1.0 / SLIP_SPEED)
        fades *= fades
        np.minimum(fades, FADED, out=fades)
        np.negative(fades, out=fades)
        np.exp(fades, out=fades)
        fades *= self.stribeck
        friction += fades
        return friction

    def next_speed(
        self, inertia: Array, qd: Array, motor: Array, links: Array
    ) -> Array:
        """Return the velocity at the end of a step, in the place of the motor's torque.

        ``inertia``: of the links over the time step [N m s/rad].
        """
        friction = self.friction(qd, motor, links)
        mass = self.per_gain * inertia
        mass += self.rotor
        decay = self.damping / mass
        growth = 0.5 * decay
        growth += 1.0
        decay *= growth
        decay += 1.0
        decay *= mass
        # Now what the velocity is divided by.
        speed = motor
        speed -= links
        speed *= growth
        mass *= qd
        speed += mass
        speed /= decay
        friction *= growth
        friction /= decay
        held = np.minimum(speed, friction)
        np.negative(friction, out=friction)
        np.maximum(held, friction, out=held)
        speed -= held
        return speed


def _servos(tracks: Tracks, own: Mapping[str, Array]) -> _Servos:
    """Return the numbers of a play from unknowns (v, T) by name."""
    # Numbers over the gain are those of the first recording's gain.
    per_scale = 1.0 / tracks.scale
    limit = own["torque_limit"] * tracks.strength * per_scale
    return _Servos(
        limit=limit,
        least_limit=-limit,
        dead_zone=own["dead_zone"],
        least_zone=-own["dead_zone"],
        damping=own["damping"] * per_scale,
        coulomb=own["frictionloss"] * per_scale,
        stribeck=own["stribeck"] * per_scale,
        share=own["load_share"],
        per_gain=1.0 / (own["gain"] * tracks.scale),
        rotor=own["armature"] * per_scale / tracks.step,
    )


def _positions(tracks: Tracks, numbers: Array, errors: Array, start: Array) -> Array:
    """Return the kept positions (S / KEPT + 1, v, T) of a play; see ``play``."""
    own = {name: numbers[:, :, k] for k, name in enumerate(NAMES)}
    servos = _servos(tracks, own)
    timing = np.stack((own["command_delay"], own["loop_lag"]), axis=1)
    distinct, timing_of = _distinct(timing)
    goals = _goals(tracks, timing[distinct, 0], timing[distinct, 1])
    distinct, errors_of = _distinct(errors)
    by_errors = np.einsum("dtj,jst->sdt", errors[distinct], tracks.errors)
    asked = tracks.torque[:, None] + by_errors
    asked -= (tracks.slope * tracks.middle)[:, None]
    by_errors = np.einsum("dtj,jst->sdt", errors[distinct], tracks.inertia_errors)
    inertia = (tracks.inertia[:, None] + by_errors) / tracks.step
    zero = own["zero"]
    q, qd = (each + more for each, more in zip(tracks.start, np.moveaxis(start, 1, 0)))
    kept = np.empty((len(asked) // KEPT + 1, *q.shape))
    for k in range(len(asked)):
        if k % KEPT == 0:
            kept[k // KEPT] = q
        error = goals[k, timing_of]
        error -= q
        motor = servos.motor_torque(error)
        links = q + zero
        links *= tracks.slope[k]
        links += asked[k, errors_of]
        links *= servos.per_gain
        qd = servos.next_speed(inertia[k, errors_of], qd, motor, links)
        q = q + tracks.step * qd
    kept[-1] = q
    return kept
