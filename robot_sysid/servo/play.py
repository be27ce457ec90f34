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
from typing import Any

import numpy as np
from numpy.typing import NDArray

import robot_sysid.records.usual_errors as usual_errors
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.estimate.links import EXPECTED, link_factor
from robot_sysid.records import Array, Recording, RobotModel
from robot_sysid.records.servo_setting import UNKNOWN
from robot_sysid.servo.loop import (
    MAX_DELAY,
    commands,
    longest_period,
    low_pass_motion,
    stretches,
)
from robot_sysid.servo.setting import gain_of, links_of, strength_of
from robot_sysid.servo.unknowns import NAMES, SLIP_SPEED
from robot_sysid.simulation.playback import interpolate
from robot_sysid.spatial import N_INERTIAL

STEPS = (0.001, 0.002)
"""Least and largest time step [s]."""
STEPS_PER_SAMPLE = 12.0
"""Time steps between samples, within ``STEPS``."""
FADED = 40.0
"""Exponent at which friction has faded: what is less takes a processor long."""
TOGETHER = 42
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
        changes: dict[str, Any] = {
            name: np.take(getattr(self, name), chosen, axis)
            for name, axis in TRACK_AXES.items()
        }
        return replace(self, **changes)


TRACK_AXES = {
    "joint": 0,
    "scale": 0,
    "strength": 0,
    "command": 1,
    "torque": 1,
    "inertia": 1,
    "slope": 1,
    "middle": 1,
    "errors": 2,
    "inertia_errors": 2,
    "start": 1,
    "sample": 0,
    "share": 0,
    "is_sample": 0,
    "measured": 0,
}
"""Name of an array of ``Tracks`` to its axis that is that of the tracks."""


def join_tracks(parts: Sequence[Tracks]) -> Tracks:
    """Return tracks of one time step as one, in their order."""
    joined: dict[str, Any] = {
        name: np.ascontiguousarray(
            np.concatenate([getattr(part, name) for part in parts], axis)
        )
        for name, axis in TRACK_AXES.items()
    }
    # One step's numbers lie side by side: a play goes through them step by step.
    return replace(parts[0], **joined)


@dataclass(frozen=True)
class _Links:
    """What the links ask of each joint at the N samples of a piece.

    Attributes:
        along: (N, n, 4) torque, inertia, slope and middle, as in ``Tracks``.
        speed: (N, n) behind a low-pass [rad/s].
        qdd: (N, n) accelerations behind it [rad/s^2].
        errors: (N, n, E) torque by one standard deviation of each link error [N m].
        inertia_errors: (N, n, E) inertia about the joint by the same [kg m^2].
    """

    along: Array
    speed: Array
    qdd: Array
    errors: Array
    inertia_errors: Array


def inertia_columns(dynamics: LinkDynamics, q: Array) -> Array:
    """Return the derivative (N, n, 10 n) of the inertia about each joint by the links' thetas.

    Args:
        dynamics: of the arm.
        q: (N, n) positions [rad or m].
    """
    n = q.shape[1]
    zero = np.zeros_like(q)
    links = [*range(n)]
    at_rest = dynamics.motion(q, zero, zero).columns(links)
    found = np.empty_like(at_rest)
    for joint, unit in enumerate(np.eye(n)):
        pushed = dynamics.motion(q, zero, zero + unit).columns(links)
        found[:, joint] = (pushed - at_rest)[:, joint]
    return found


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
    unknown = factor * np.repeat(~is_known, N_INERTIAL)[:, None]
    errors = motion.columns(links.tolist()) @ unknown
    by_thetas = inertia_columns(dynamics, q)
    inertia = by_thetas @ thetas.ravel()
    slope = np.empty_like(q)
    for joint, unit in enumerate(np.eye(robot.n_joints)):
        moved = (q + ANGLE * unit, q - ANGLE * unit)
        more, less = (dynamics.motion(each, qd, qdd).torque(thetas) for each in moved)
        slope[:, joint] = (more - less)[:, joint] / (2.0 * ANGLE)
    along = np.stack((torque - inertia * qdd, inertia, slope, q), axis=2)
    return _Links(along, qd, qdd, errors, by_thetas @ unknown)


@dataclass(frozen=True)
class KnownLinks:
    """The links of an arm, as far as they are known before a log.

    Attributes:
        thetas: (n, 10) those of the file; of one that was weighed, as it was.
        factor: (10 n, E) their errors, see ``link_factor``; none of one that was weighed.
        directions: (n, 10 n, J) of each joint the thetas of all links by one standard deviation of
            each direction of link errors.
    """

    thetas: Array
    factor: Array
    directions: Array


class Courses:
    """What the links ask of an arm's joints along pieces of its logs, to be cut into tracks.

    It is computed once, whatever the length of the windows.

    Args:
        robot: the arm as in the model file.
        pieces: of logs, which have commands.

    Attributes:
        links: as far as they are known.
    """

    def __init__(self, robot: RobotModel, pieces: Sequence[Recording]) -> None:
        self._pieces = pieces
        factor = link_factor(robot, [*range(robot.n_joints)], LINK_SHARE)
        links = [_links(robot, piece, factor) for piece in pieces]
        # Of many link errors, those directions in which they change a joint's torque most.
        together = np.concatenate([each.errors for each in links])
        directions = []
        for of_joint in np.moveaxis(together, 1, 0):
            *_, rows = np.linalg.svd(of_joint, full_matrices=False)
            directions.append(rows[:DIRECTIONS].T)
        self._links = [_in_directions(each, directions) for each in links]
        # A link that was weighed once is known.
        whole = (each.setting for each in pieces if each.setting.is_whole_link)
        thetas, is_known = links_of(robot, next(whole, UNKNOWN))
        unknown = np.repeat(~is_known, N_INERTIAL)[:, None] * factor
        self.links = KnownLinks(
            thetas, unknown, np.stack([unknown @ each for each in directions])
        )

    def tracks(self, window: float, most: int) -> Tracks:
        """Return the tracks of all joints in windows of the pieces.

        Args:
            window: about the length of a window [s].
            most: largest number of windows; they are spread evenly over the pieces.
        """
        windows = self._windows(window, most)
        times = [self._pieces[k].time[at] for k, at in windows]
        longest = max(time[-1] - time[0] for time in times)
        step = float(np.clip(longest_period(self._pieces) / STEPS_PER_SAMPLE, *STEPS))
        n_steps = KEPT * (int(np.ceil(longest / (step * KEPT))) + 1)
        n_samples = max(map(len, times))
        parts = [self._part(k, at, step, n_steps, n_samples) for k, at in windows]
        return join_tracks(parts)

    def _windows(self, window: float, most: int) -> list[tuple[int, slice]]:
        """Return windows as a piece's number and its samples; see ``tracks``."""
        windows = []
        for k, piece in enumerate(self._pieces):
            for rows in stretches(piece):
                last = rows.stop - 1
                count = max(
                    round((piece.time[last] - piece.time[rows.start]) / window), 1
                )
                edges = np.linspace(rows.start, last, count + 1).round().astype(int)
                windows += [
                    (k, slice(first, end + 1)) for first, end in zip(edges, edges[1:])
                ]
        spread = np.linspace(0, len(windows) - 1, min(len(windows), most))
        return [windows[k] for k in np.unique(np.round(spread).astype(int))]

    def _part(
        self, k: int, at: slice, step: float, n_steps: int, n_samples: int
    ) -> Tracks:
        """Return the tracks of one window.

        Args:
            k: number of the piece.
            at: its samples.
            step: time step of a play [s].
            n_steps, n_samples: of all windows.
        """
        piece = self._pieces[k]
        first = self._pieces[0]
        links = self._links[k]
        n = piece.q.shape[1]
        start = piece.time[at][0]
        time = start + step * np.arange(n_steps)
        before = round(MAX_DELAY / step) + 2
        early = start + step * np.arange(-before, n_steps)
        # A command holds until the next one comes.
        last = np.searchsorted(piece.time, early, side="right") - 1
        torque, inertia, slope, middle = np.moveaxis(
            _at_times(time, piece.time, links.along), 2, 0
        )
        since = (piece.time[at] - start) / (step * KEPT)
        gap = n_samples - len(since)
        padded = np.pad(since, (0, gap))
        sample = np.minimum(padded.astype(int), n_steps // KEPT - 1)
        return Tracks(
            step=step,
            joint=np.arange(n),
            scale=np.full(n, gain_of(piece.setting, first.setting)),
            strength=np.full(n, strength_of(piece.setting, first.setting)),
            command=commands(piece)[np.maximum(last, 0)],
            torque=torque,
            inertia=inertia,
            slope=slope,
            middle=middle,
            errors=_by_direction(time, piece.time, links.errors),
            inertia_errors=_by_direction(time, piece.time, links.inertia_errors),
            start=np.stack((piece.q[at][0], links.speed[at][0])),
            sample=np.tile(sample, (n, 1)),
            share=np.tile(padded - sample, (n, 1)),
            is_sample=np.tile(np.arange(n_samples) < len(since), (n, 1)),
            measured=np.pad(piece.q[at], ((0, gap), (0, 0))).T,
        )


def _in_directions(links: _Links, directions: Sequence[Array]) -> _Links:
    """Return links with errors (N, n, J) in directions (E, J) of each joint; those of the torque
    without its own acceleration.
    """
    torque, inertia = (
        np.stack([of[:, k] @ each for k, each in enumerate(directions)], axis=1)
        for of in (links.errors, links.inertia_errors)
    )
    own = torque - inertia * links.qdd[:, :, None]
    return replace(links, errors=own, inertia_errors=inertia)


def _at_times(at: Array, time: Array, values: Array) -> Array:
    """Return values (N, n, k) at other times (S, n, k)."""
    flat = interpolate(at, time, values.reshape(len(values), -1))
    return flat.reshape(len(at), *values.shape[1:])


def _by_direction(at: Array, time: Array, values: Array) -> Array:
    """Return values (N, n, J) at other times, direction first (J, S, n)."""
    return np.moveaxis(_at_times(at, time, values), 2, 0)


def make_tracks(
    robot: RobotModel, pieces: Sequence[Recording], window: float, most: int
) -> Tracks:
    """Return tracks that are cut but once, see ``Courses.tracks``."""
    return Courses(robot, pieces).tracks(window, most)


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
        limited: part of it that the servo commands, within its limit [s].
        coulomb, stribeck: friction, and what there is more of it at rest [rad or m].
        share, load_stribeck: friction over the torque of motor and links, and what it is more at
            rest.
        per_gain: one over the gain [rad/(N m)].
        rotor: inertia over the time step [s].
    """

    limit: Array
    least_limit: Array
    dead_zone: Array
    least_zone: Array
    damping: Array
    limited: Array
    coulomb: Array
    stribeck: Array
    share: Array
    load_stribeck: Array
    per_gain: Array
    rotor: Array

    def motor_torque(self, error: Array, qd: Array) -> Array:
        """Return the damping beside the torque of servos, and their torque in the place of the
        position error.

        Within its limit a servo's own damping is part of that damping, so that steps are stable.
        """
        within = np.minimum(error, self.dead_zone)
        np.maximum(within, self.least_zone, out=within)
        error -= within
        # Now the damping's torque.
        np.multiply(self.limited, qd, out=within)
        error -= within
        held = np.minimum(error, self.limit)
        np.maximum(held, self.least_limit, out=held)
        is_at_limit = held != error
        error += within
        np.copyto(error, held, where=is_at_limit)
        np.multiply(self.limited, is_at_limit, out=held)
        return np.subtract(self.damping, held, out=held)

    def friction(self, drive: Array, qd: Array, links: Array) -> Array:
        """Return the friction that a motion at qd can have, whatever its direction.

        ``drive``: torque of the servos less that of damping, in whose place the friction comes.
        """
        friction = drive
        friction += links
        np.abs(friction, out=friction)
        sticks = friction * self.load_stribeck
        sticks += self.stribeck
        friction *= self.share
        friction += self.coulomb
        fades = qd * (1.0 / SLIP_SPEED)
        fades *= fades
        np.minimum(fades, FADED, out=fades)
        np.negative(fades, out=fades)
        np.exp(fades, out=fades)
        fades *= sticks
        friction += fades
        return friction

    def next_speed(
        self, inertia: Array, qd: Array, error: Array, links: Array
    ) -> Array:
        """Return the velocity at the end of a step, in the place of the position error.

        ``inertia``: of the links over the time step [N m s/rad].
        """
        damping = self.motor_torque(error, qd)
        motor = error
        friction = self.friction(motor - damping * qd, qd, links)
        mass = self.per_gain * inertia
        mass += self.rotor
        decay = damping
        decay /= mass
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
    damping = own["damping"] * per_scale
    limit = own["torque_limit"] * tracks.strength * per_scale
    return _Servos(
        limit=limit,
        least_limit=-limit,
        dead_zone=own["dead_zone"],
        least_zone=-own["dead_zone"],
        damping=damping,
        limited=own["limited_damping"] * damping,
        coulomb=own["frictionloss"] * per_scale,
        stribeck=own["stribeck"] * per_scale,
        share=own["load_share"],
        load_stribeck=own["load_stribeck"],
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
        links = q + zero
        links *= tracks.slope[k]
        links += asked[k, errors_of]
        links *= servos.per_gain
        qd = servos.next_speed(inertia[k, errors_of], qd, error, links)
        q = q + tracks.step * qd
    kept[-1] = q
    return kept
