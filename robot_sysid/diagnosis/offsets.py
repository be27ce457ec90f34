"""Constants that a log may be off by: zeros of its positions, delays of its torques, clock, a hum.

Each constant is one column in a fit of all joints, made around what was found in the round before:

    zero of joint i      -d tau / d q_i
    delay of joint j     -d/dt [torque that the fit explains]_j in its own equation
    time base 1 + c      2 [rigid-body torque without gravity], for qdd grows with (1 + c)^2
    its drift            the same times t, from -1 to 1 over the log
    hum of joint j       a sine, of the frequency that most is left of

Gravity needs no clock, inertia does: where they disagree, the time base is wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.diagnosis import Finding, Level, model_fit
from robot_sysid.diagnosis.model_fit import Fit, ModelFit, Sample, explains, fall, friction_sign
from robot_sysid.dynamics.nuisances import gravity, tilt_columns, zero_columns
from robot_sysid.records import Array, Motion
from robot_sysid.records.figures import percent

SMALL_ZERO, LARGE_ZERO = 0.02, 0.04
"""Error of a joint's zero that is told, and that stops an identification [rad]."""
SURE_ZERO = 3.5
"""Standard errors that a zero has to be away from nothing."""
SURE_DELAY, SHORT_DELAY, LONG_DELAY = 4.0, 0.005, 0.015
"""Standard errors that a delay has to be away from none; delay that is told, and that stops [s]."""
SURE_CLOCK, LIKELY_CLOCK, SEEN_CLOCK = 9.0, 4.0, 3.0
"""Fall of chi-squared by a time base that is refused, warned and told of; right logs: 2.3."""
CLEAR_CLOCK = 1.5
"""Standard errors that it has to be away from right: right logs have up to 1.2, and a fall of 6.6
where the model does not fit well."""
SCALE, TILT = 0.1, np.radians(3.0)
"""Standard deviations of a joint's torque scale (motor constants of one arm are off by a tenth) and
of how far a base is from level [rad]."""
LAGS, LOSS = (0.04, 0.12), 0.1
"""By how much dry friction may be late [s]; standard deviation of a gear's loss, a share."""
HUM, CLEAR_HUM = 0.7, 0.4
"""Part of a joint's residual squares beside a hum that is told, and that stops; right logs: 0.9."""
# Standard deviations of zeros [rad], of delays [s] and of the time base and its drift (shares).
_ZEROS, _DELAYS, _CLOCK = 0.5, 0.05, 0.2
_ROUNDS, _STEP = 4, 0.01
# Falls of chi-squared below which the first round is the last; of 1300 right and wrong logs of ten
# arms, those of which delays or zeros are told have 7.1 at least, and a time base 1.4.
_NO_OFFSET, _NO_CLOCK = 5.0, 1.0


@dataclass(frozen=True)
class Offsets:
    """Constants (e,), their standard errors (e,), and the fit of the log without them."""

    value: Array
    error: Array
    after: Fit

    def gain(self, base: Fit) -> float:
        """Return by how much more chi-squared falls without them than by chance."""
        return fall(base, self.after) - len(self.value)


def _found(
    log: ModelFit,
    columns: Callable[[Sample, Fit], Array],
    undone: Callable[[Array], Sample],
    spread: Array,
    least: float,
) -> Offsets:
    """Return constants of some standard deviations (e,), by their columns (K, n, e) around a sample
    and its fit, and what undoes them; ``least`` is the fall that the first round needs.
    """
    sample, total, found = log.sample, np.zeros(len(spread)), log.fit()
    base = found
    for _ in range(_ROUNDS):
        found = log.fit(sample, columns(sample, found), spread)
        if sample is log.sample and fall(base, found) < least:
            return Offsets(found.extra, found.error, found)
        total = total + np.clip(found.extra, -spread, spread)
        sample = undone(total)
    return Offsets(total, found.error, log.fit(sample))


def joint_zeros(log: ModelFit) -> Offsets:
    """Return what each position (n,) reads too much [rad]."""

    def columns(sample: Sample, found: Fit) -> Array:
        motion = Motion(log.time, sample.q, sample.qd, sample.qdd)
        return zero_columns(log.robot, found.thetas, motion)

    spread, sample = np.full(log.robot.n_joints, _ZEROS), log.sample
    return _found(log, columns, lambda z: replace(sample, q=sample.q - z), spread, _NO_OFFSET)


def joint_delays(log: ModelFit) -> Offsets:
    """Return by how much each torque (n,) is late [s]."""
    own = np.eye(log.robot.n_joints)

    def columns(sample: Sample, found: Fit) -> Array:
        q, qd, qdd, third = sample.q, sample.qd, sample.qdd, log.jerk
        torque = sample.tau, sample.sigma
        before, after = (
            log.explained(Sample(q + h * qd, qd + h * qdd, qdd + h * third, *torque), found)
            for h in (-_STEP, _STEP)
        )
        return ((before - after) / (2.0 * _STEP))[:, :, None] * own

    def undone(delays: Array) -> Sample:
        return replace(log.sample, tau=log.later(np.clip(delays, *model_fit.DELAYS)))

    return _found(log, columns, undone, np.full(len(own), _DELAYS), _NO_OFFSET)


def time_base(log: ModelFit) -> Offsets:
    """Return (by which share the log's time is too long, and its drift from middle to end)."""
    ends = log.time[[0, -1]]
    place = (2.0 * log.time - ends.sum()) / np.ptp(ends)
    course = np.stack((np.ones_like(place), place), axis=1)

    def columns(sample: Sample, found: Fit) -> Array:
        return 2.0 * log.torque(sample, found.thetas, weightless=True)[:, :, None] * course[:, None]

    def undone(shares: Array) -> Sample:
        faster, sample = 1.0 + (course @ shares)[:, None], log.sample
        return replace(sample, qd=faster * sample.qd, qdd=faster**2 * sample.qdd)

    return _found(log, columns, undone, np.full(2, _CLOCK), _NO_CLOCK)


def other_friction(log: ModelFit) -> Offsets:
    """Return friction (3 n,) that joints may have beside: what builds up over some way after each
    reversal [N m], and a gear's loss, which grows with its load (a share).
    """
    sample, own = log.sample, np.eye(log.robot.n_joints)
    sign, usual = friction_sign(sample), sample.sigma / model_fit.TOLERANCE
    each = [friction_sign(sample, lag) - sign for lag in LAGS] + [sign * np.abs(log.model_torque)]
    columns = np.concatenate([column[:, :, None] * own for column in each], axis=2)
    prior = np.concatenate((np.tile(0.5 * usual, len(LAGS)), np.full(len(own), LOSS)))
    after = log.fit(extra=columns, prior=prior)
    return Offsets(after.extra, after.error, after)


def other_sensors(log: ModelFit, base: Fit) -> Offsets:
    """Return what torque sensors and the base may be off by beside: (n,) each scale (a share), and
    two angles of the base [rad].
    """
    rigid, own = log.torque(log.sample, base.thetas), np.eye(log.robot.n_joints)
    columns, prior = rigid[:, :, None] * own, np.full(len(own), SCALE)
    if np.any(gravity(log.robot)):
        tilt = tilt_columns(log.robot, base.thetas, log.sample.q)
        columns, prior = np.concatenate((columns, tilt), axis=2), np.append(prior, [TILT, TILT])
    after = log.fit(extra=columns, prior=prior)
    return Offsets(after.extra, after.error, after)


def strongest_sine(log: ModelFit) -> Offsets:
    """Return the sine that stands out most in what is left of a torque: joint, Hz, size [N m]."""
    base, time, count = log.fit(), log.time - log.time[0], len(log.time)
    span, step = float(np.ptp(time)), float(np.median(np.diff(time)))
    rates = np.arange(2.0 / span, 0.4 / step, 0.25 / span)
    # Powers, as the rates are evenly spaced: a tenth of the time of as many exponentials.
    turns, most = np.exp(0.5j * np.pi / span * time), len(rates) + 8
    parts = zip(*(np.array_split(each, 10) for each in (turns, base.residual)))
    sums = (np.vander(turn, most, increasing=True).T[8:] @ left for turn, left in parts)
    taken = np.abs(sum(sums)) ** 2 * (2.0 / count)
    at, joint = np.unravel_index(int(np.argmax(taken / log.sample.sigma**2)), taken.shape)
    columns = np.zeros((count, len(log.links), 2))
    phase = 2.0 * np.pi * rates[at] * time
    columns[:, joint] = np.stack((np.cos(phase), np.sin(phase)), axis=1)
    size = log.sample.sigma[joint] / model_fit.TOLERANCE
    after = log.fit(extra=columns, prior=np.full(2, size))
    return Offsets(np.array([joint, rates[at], np.hypot(*after.extra)]), np.zeros(3), after)


def offset_findings(log: ModelFit, base: Fit) -> list[Finding]:
    """Return what is found of those constants without which the log fits best.

    Nothing where friction, torque scales or a tilted base explain it as well.
    """
    kinds = (
        (joint_delays(log), delay_findings),
        (joint_zeros(log), zero_findings),
        (time_base(log), clock_findings),
        (strongest_sine(log), hum_findings),
    )
    best, found = other_friction(log).gain(base), list[Finding]()
    for each, tell in kinds:
        if each.gain(base) > best and (told := [*tell(log, base, each)]):
            best, found = each.gain(base), told
    # Not asked of right logs, of which nothing is found.
    return found if found and best > other_sensors(log, base).gain(base) else []


def delay_findings(log: ModelFit, base: Fit, found: Offsets) -> Iterator[Finding]:
    """Yield a finding where all torques, or one, belong to an earlier or later position."""
    weight, count = found.error**-2, len(found.error)
    common = float(np.sum(weight * found.value) / np.sum(weight))
    cases = [np.full(count, common), *np.diag(found.value)]
    fits = [log.fit(replace(log.sample, tau=log.later(each))) for each in cases]
    best = int(np.argmin([fit.cost for fit in fits]))
    delay = common if best == 0 else float(found.value[best - 1])
    error = float(np.sum(weight) ** -0.5 if best == 0 else found.error[best - 1])
    # Friction that builds up over some speed looks like a short delay, or a negative one.
    long = abs(delay) > LONG_DELAY
    if abs(delay) < SURE_DELAY * error or delay < (-LONG_DELAY if long else SHORT_DELAY):
        return
    clear = explains(base, fits[best])
    if not (clear or long and explains(base, fits[best], certain=False)):
        return
    one = "" if best == 0 else f" of joint {log.robot.joint_names[best - 1]} alone"
    text = f"torque{one} lags position by about {1e3 * delay:.0f} ms; "
    remedy = "record both at the same instant, or have it found (identify --delay auto; payload "
    remedy += "does so by itself)"
    text += "record all joints at once" if one else remedy
    yield Finding("delay", Level.WARN if long and clear else Level.NOTE, text)


def zero_findings(log: ModelFit, base: Fit, found: Offsets) -> Iterator[Finding]:
    """Yield a finding per joint whose position is surely off by a constant."""
    names, far_off = log.robot.joint_names, np.abs(found.value) > SURE_ZERO * found.error
    sure = np.where(far_off, found.value, 0.0)
    # How sure each zero is decides; the fit as a whole need not fall as much as for a mistake.
    if not explains(base, found.after, certain=False):
        return
    far = int(np.argmax(np.abs(sure)))
    if abs(sure[far]) > _ZEROS:
        text = f"to fit this log, the position of joint {names[far]} would have to be off by "
        text += f"{sure[far]:.2g} rad: is the model of this arm, with zeros in the same places?"
        yield Finding("model", Level.REFUSE, text)
        return
    for name, zero, error in zip(names, sure, found.error):
        if abs(zero) >= SMALL_ZERO:
            level = Level.WARN if abs(zero) >= LARGE_ZERO else Level.NOTE
            text = f"the position of joint {name} reads {zero:+.3g} rad too much (standard "
            yield Finding("zero", level, f"{text}error {error:.1g}); correct its zero")


def clock_findings(log: ModelFit, base: Fit, found: Offsets) -> Iterator[Finding]:
    """Yield a finding where inertia and gravity disagree about the time base."""
    gained, sure = fall(base, found.after), np.any(np.abs(found.value) > CLEAR_CLOCK * found.error)
    if found.after.cost > model_fit.WELL or gained < SEEN_CLOCK or not sure:
        return
    share, drift = found.value
    remedy = "record the controller's own time stamps"
    if abs(drift) > 2.0 * found.error[1]:
        text = f"the clock drifts: time is {_too_long(share - drift)} at first, "
        text += f"{_too_long(share + drift)} at the end"
    else:
        text = f"time in the log is {_too_long(share)}"
        remedy += f", or scale them with --columns FILE: time = {1.0 / (1.0 + share):.3g} * TITLE"
    text = f"by inertia beside gravity, {text} (\u00b1 {percent(float(found.error[0]))}); {remedy}"
    level = Level.WARN if gained > LIKELY_CLOCK else Level.NOTE
    yield Finding("clock", Level.REFUSE if gained > SURE_CLOCK else level, text)


def hum_findings(log: ModelFit, base: Fit, found: Offsets) -> Iterator[Finding]:
    """Yield a finding where most of what is left of a joint's torque is one sine."""
    joint, rate, size = int(found.value[0]), *found.value[1:]
    before, after = (float(np.sum(fit.residual[:, joint] ** 2)) for fit in (base, found.after))
    if after > HUM * before or not explains(base, found.after, certain=False):
        return
    text = f"torque of joint {log.robot.joint_names[joint]} hums: a sine of {rate:.2g} Hz and "
    text += f"{size:.2g} N m that neither motion nor friction makes; find its source, record again"
    yield Finding("contact", Level.WARN if after < CLEAR_HUM * before else Level.NOTE, text)


def _too_long(share: float) -> str:
    return f"{percent(abs(share))} too {'long' if share > 0.0 else 'short'}"
