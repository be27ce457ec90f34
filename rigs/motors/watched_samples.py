"""Samples of two joints that a watch sees, without motors and without time, and what it says.

Only the second joint, motor 2, is ever at fault.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from rigs.motors.damiao_rig import mit_command, state, undoubted_replies
from robot_sysid.damiao.joints import damiao_joints
from robot_sysid.damiao.protocol import ENABLED, BusTiming
from robot_sysid.damiao.references import Reference
from robot_sysid.damiao.safety.holding import HoldingTorque, torque_doubt
from robot_sysid.damiao.safety.plausibility import NO_STATUS
from robot_sysid.damiao.safety.watch import PLAYING, Watch
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.errors import HardwareAbort
from robot_sysid.records.usual_errors import WEIGHT

JOINTS = damiao_joints(["DM4340"] * 2, 2)
STEPS = np.full(2, 4e-4), np.array([0.02, 0.02]), np.full(2, 0.0137)
PEAK = np.full(2, 27.0)
KP = 180.0
KD = 4.5
CYCLE = 0.004
HOLDING = HoldingTorque(JOINTS, lambda q: 8.0 * np.cos(q), torque_doubt(JOINTS))
MANY = 50
"""Number of unanswered commands that does not stop a run which is to show something else."""
LENIENT = {"max_missed": MANY, "max_lost": MANY, "max_doubted": MANY}


def complete_settings(**settings):
    """Return the settings of a run of the two joints, with their gains."""
    return PlaySettings(**settings).for_motors([j.spec for j in JOINTS], BusTiming())


def watch(**settings):
    """Return a watch over the two joints."""
    return Watch(JOINTS, complete_settings(**settings), STEPS, PEAK, HOLDING)


def words_of(cycles, phase=PLAYING, **settings):
    """Return what a watch says to cycles of replies and commands, or None."""
    watched = watch(**settings)
    try:
        for replies, command in cycles:
            watched.health.update(replies)
            watched.check(replies, command, reference_of(command), phase)
    except HardwareAbort as stopped:
        return str(stopped)
    return None


def reference_of(command):
    """Return the reference of a command whose torque is the weight."""
    weight = command.torque
    return Reference(
        command.position, command.velocity, weight, weight, WEIGHT * np.abs(weight)
    )


def cycle(k, command, answered, *signals):
    """Return replies and command of a cycle; the second joint's signals may be missing."""
    seen = np.array([True, answered])
    now = state(*np.where(seen, signals, np.nan), status=np.where(seen, 1, NO_STATUS))
    time = np.where(seen, k * CYCLE, np.nan)
    return undoubted_replies(seen, time, now, seen), command


def stand(cycles, q=0.0, answered=True):
    """Yield cycles of joints that stand, the second at q [rad]; their command holds them at 0."""
    for k in range(cycles):
        command = mit_command(np.zeros(2), 0.0, KP, KD)
        yield cycle(k, command, answered, [0.0, q], [0.0, 0.0], [0.0, -KP * q])


def miss_answers(cycles):
    """Yield cycles without an answer: in the second one the motor is not commanded."""
    for k, (replies, command) in enumerate(stand(cycles, answered=False)):
        yield replace(replies, requested=np.array([True, k != 1])), command


def answer_late(times):
    """Yield cycles in which each fifth command is answered as late as the next one is sent."""
    for _ in range(times):
        yield from miss_answers(4)
        yield from stand(1)


def count_frames(cycles, **counts):
    """Yield cycles of standing joints in which frames are counted that nobody awaited."""
    for replies, command in stand(cycles):
        yield replace(replies, **{k: np.array(v) for k, v in counts.items()}), command


def refuse_answer(k, code):
    """Return a cycle in which the second joint's answer has a status code, and is not believed."""
    command = mit_command(np.zeros(2), 0.0, KP, KD)
    replies, _ = cycle(k, command, False, [0.0, 0.0], [0.0, 0.0], [0.0, 0.0])
    every = np.array([True, True])
    doubted = np.array([False, True])
    reported = np.array([ENABLED, code])
    return replace(
        replies, requested=every, doubted=doubted, reported=reported
    ), command


def swing(
    seconds=3.0,
    off=lambda t: 0.0,
    velocity=1.0,
    torque=1.0,
    fed=lambda p: 8.0 * np.cos(p),
    frozen_after=np.inf,
    misses=0.0,
    slip=0.0,
):
    """Yield cycles of joints that swing, the second with what is wrong with it.

    Its position is off by an angle ``off(t)`` [rad], what it reports has other scales ``velocity``
    and ``torque``, or stays the same; a share of its answers is missing, or its gear slips [rad/s].
    """
    random = np.random.default_rng(0)
    q, qd = 0.3, 0.0
    for k in range(round(seconds / CYCLE)):
        time = k * CYCLE
        p = 0.3 * np.cos(2.0 * time) + slip * time
        v = -0.6 * np.sin(2.0 * time)
        command = mit_command([0.0, p], [0.0, v], KP, KD, [8.0, fed(p)])
        if time < frozen_after:
            q = p + off(time)
            qd = v + (off(time + 1e-6) - off(time)) / 1e-6
        else:
            qd = 0.0
        commanded = command.motor_torque(np.array([0.0, q]), np.array([0.0, qd]))[1]
        reported = round(q / 4e-4) * 4e-4, qd * velocity, commanded * torque
        answered = random.random() >= misses
        yield cycle(k, command, answered, *zip((0.0, 0.0, 8.0), reported))


def damage_sample(**values):
    """Return cycles of a swing in one of which a signal is wrong where no filter notices it."""
    cycles = [*swing()]
    replies, command = cycles[300]
    changed = {name: np.array(value) for name, value in values.items()}
    feedback = replace(replies.feedback, **changed)
    cycles[300] = replace(replies, feedback=feedback), command
    return cycles


@dataclass(frozen=True)
class SampleCase:
    """What a watch sees of an incident, and says.

    Attributes:
        plays: each returns cycles of replies and commands that show it.
        words: of the message; None where the watch has to be silent.
        settings: of the run.
        phase: of the run.
        name: of the incident.
    """

    plays: tuple[Callable[[], Iterable], ...]
    words: str | None
    settings: dict
    phase: object = PLAYING
    name: str = ""


def sample_case(words, *plays, phase=PLAYING, **settings):
    """Return the case of cycles that have to make a watch say something, or None."""
    return SampleCase(plays, words, settings, phase)


def swing_case(words, misses=(0.0, 0.2), **wrong):
    """Return the case of a swing, also where a share of the answers is missing."""
    plays = (partial(swing, misses=share, **wrong) for share in misses)
    return sample_case(words, *plays, **LENIENT)
