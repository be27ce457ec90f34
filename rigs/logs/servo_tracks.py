"""Joints behind servos, made up one by one: what drives them, and how they are played."""

import numpy as np

from robot_sysid.servo.loop import MAX_DELAY
from robot_sysid.servo.play import DIRECTIONS, KEPT, STEPS, Tracks, join_tracks, play
from robot_sysid.servo.unknowns import NAMES, column

STEP = STEPS[0]
"""Time step of made-up tracks [s]."""
EARLY = round(MAX_DELAY / STEP) + 2
"""Number of steps before the start whose commands are known."""
RATE = 125.0
"""Samples per second, each at a position that is kept [Hz]."""


def numbers_of(**numbers):
    """Return numbers (1, u) of a joint whose servo has no limit and no delay, without friction."""
    usual = {"gain": 10.0, "torque_limit": 1e3}
    row = np.zeros((1, len(NAMES)))
    for name, value in {**usual, **numbers}.items():
        row[0, column(name)] = value
    return row


def track_of(
    command,
    seconds=1.0,
    inertia=0.02,
    torque=0.0,
    slope=0.0,
    start=(0.0, 0.0),
    measured=0.0,
    joint=0,
    error=0.0,
    inertia_error=0.0,
):
    """Return the track of a joint that gets the commands ``command(time)``.

    Args:
        command: function of times [s], zero at the start.
        seconds: length.
        inertia: of the links about the joint [kg m^2].
        torque: of the links [N m].
        slope: of the joint's weight [N m/rad].
        start: position, and velocity half a step before [rad, rad/s].
        measured: positions at the samples [rad].
        joint: its number.
        error: torque of the first direction of link errors [N m].
        inertia_error: inertia of this direction [kg m^2].
    """
    n_samples = round(seconds * RATE) + 1
    n_steps = KEPT * (round((n_samples - 1) / (RATE * STEP * KEPT)) + 1)
    time = STEP * np.arange(-EARLY, n_steps)
    flat = np.zeros((n_steps, 1))
    errors = np.zeros((DIRECTIONS, n_steps, 1))
    errors[0] = error
    inertia_errors = np.zeros_like(errors)
    inertia_errors[0] = inertia_error
    since = np.arange(n_samples) / (RATE * STEP * KEPT)
    sample = np.minimum(since.round().astype(int), n_steps // KEPT - 1)
    return Tracks(
        step=STEP,
        joint=np.array([joint]),
        scale=np.ones(1),
        strength=np.ones(1),
        command=np.broadcast_to(command(time), time.shape)[:, None] + 0.0,
        torque=flat + torque,
        inertia=flat + inertia,
        slope=flat + slope,
        middle=flat,
        errors=errors,
        inertia_errors=inertia_errors,
        start=np.array(start, dtype=float)[:, None],
        sample=sample[None],
        share=(since - sample)[None],
        is_sample=np.ones((1, n_samples), dtype=bool),
        measured=np.broadcast_to(measured, n_samples)[None] + 0.0,
    )


def times_of(tracks):
    """Return the times (m,) of the samples of made-up tracks since their start [s]."""
    return np.arange(tracks.measured.shape[1]) / RATE


def play_once(tracks, numbers, errors=0.0, start=0.0):
    """Return played positions (T, m) of tracks with numbers (T, u) or (1, u)."""
    count = len(tracks)
    table = np.broadcast_to(numbers, (1, count, len(NAMES)))
    of_links = np.zeros((1, count, len(tracks.errors)))
    of_links[0, :, 0] = errors
    from_start = np.zeros((1, 2, count)) + start
    return play(tracks, table, of_links, from_start)[0] + tracks.measured


def joined(*tracks):
    """Return several made-up tracks as one."""
    return join_tracks(tracks)
