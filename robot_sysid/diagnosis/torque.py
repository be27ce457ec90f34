"""What torques say of a log: mistakes that can be undone, their scale, gravity, contact, the model.

Signs, exchanged joints, a reversed order and degrees are finite in number: each is undone on the
low-passed samples and the fit repeated. A mistake is named where undoing it makes its joints fit.
Scale: the links before the terminal one are known, so that their torque is a column whose
coefficient is the scale; the terminal link, which is not known, keeps ten columns of its own.
Unexplained torque in a burst is contact, a collision or a moving gripper. A model that would need
an impossible terminal link, or leaves much of the torque, is that of another arm, or several
mistakes come together.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, islice

import numpy as np
from numpy.typing import NDArray

from robot_sysid.diagnosis import Finding, Level, model_fit
from robot_sysid.diagnosis.model_fit import Fit, ModelFit, Sample, explains, rms, slow_speed
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.figures import percent

DOUBTFUL = 0.9
"""Cost without a mistake from which a model is rather that of another arm; right logs: 0.87."""
# One fit per mistake: fewer instants than elsewhere do. So many are looked at together.
_EVERY, _AT_ONCE = 2, 30
REFUSED, WARNED = 1.6, 1.3
"""Factors by which torque may be too large or too small before a log is refused, or warned of."""
SURE = 3.0
"""Standard errors that a joint's scale has to be away from one."""
UNITS = {1e3: "mN·m", 100.0: "N·cm", 10.197: "kgf·cm", 8.851: "lbf·in"}
UNITS.update({0.7376: "lbf·ft", 141.6: "ozf·in", 1e-3: "kN·m"})
"""Newton metre in other units."""
# A scale is a unit's within this factor (N cm and kgf cm differ by 1.02, lbf in by 1.15); scales of
# the joints are one within that factor.
_CLOSE, _SAME = 1.25, 1.35
# Torque at the joint per ampere of its motor, at least and at most [N m/A]: a UR10e's is 10 to 12.
_PER_AMPERE = (2.0, 25.0)
# Mass of a terminal link, as a part of the arm's, that speaks for a wrong scale.
_RATHER_HEAVY = 0.35
# Relative standard error of a joint's scale beyond which it is taken from the other joints.
_KNOWN = 0.3
# Part of the strongest joint's load, by the known links, below which a joint's scale is not asked.
_LOADED = 0.1
ODD_UNIT = 20.0
"""Factor by which one joint's torque over the model's is larger than the other joints'; right logs
have 2 at most."""
# Part of the strongest joint's load below which a joint's torque is mostly friction.
_LEAST_LOAD = 0.03
# Scales of any unit and gear lie between.
_LEAST, _MOST = 1e-4, 1e5
# Rounds in which a scale is found, and standard deviation of how far it may be from where a round
# begins (a share): the ratio of the usual torques is right within a factor of a few.
_SCALE_ROUNDS, _FAR = 6, 0.7
# Tolerance of a joint that is not asked, in units of its own.
_IGNORED = 1e3


def hypotheses(sample: Sample, robot: RobotModel) -> Iterator[tuple[str, str, Sample]]:
    """Yield every mistake that is tried: its name, a text, and the log without it."""
    to_radians = np.where(robot.is_slide, 1.0, np.pi / 180.0)
    text = "positions look like degrees; pass --units deg"
    yield "angle-unit", text, sample.with_motion(to_radians)
    text = "positions look like radians that were taken for degrees; say rad where degrees are "
    text += "said: in --units, the file of --columns, a column's title or the recorder"
    yield "angle-unit", text, sample.with_motion(1.0 / to_radians)
    yield from _signs(sample, robot.joint_names)
    yield from _orders(sample, robot.joint_names)


def explanations(log: ModelFit) -> list[tuple[Fit, Finding]]:
    """Return the mistakes that explain a log, best first, each behind the fit without it."""
    sample = log.sample.thinned(_EVERY)
    base = log.fit(sample)
    possible, convincing = log.plausible(base), []
    for name, text, undone in _likely(log, sample, base):
        after = log.fit(undone)
        if log.plausible(after) and explains(base, after, certain=possible):
            if after.cost > DOUBTFUL:
                text = f"this looks like the model of another arm; if it is not, {text}"
            convincing.append((after, Finding(name, Level.REFUSE, text)))
    return sorted(convincing, key=lambda each: each[0].cost)


def _likely(log: ModelFit, sample: Sample, base: Fit) -> Iterator[tuple[str, str, Sample]]:
    """Yield those of ``hypotheses`` whose least cost leaves them a chance."""
    tried, possible = hypotheses(sample, log.robot), log.plausible(base)
    while some := list(islice(tried, _AT_ONCE)):
        for each, least in zip(some, log.least_costs([undone for *_, undone in some])):
            if explains(base, replace(base, cost=float(least)), certain=possible):
                yield each


def _signs(sample: Sample, names: tuple[str, ...]) -> Iterator[tuple[str, str, Sample]]:
    for joint, name in enumerate(names):
        sign = np.ones(len(names))
        sign[joint] = -1.0
        moved = sample.with_motion(sign)
        for kinds, undone in (
            (("torque",), sample.with_torque(sign)),
            (("position",), moved),
            (("position", "torque"), moved.with_torque(sign)),
        ):
            text = f"the {' and '.join(kinds)} of joint {name} has the opposite sign of the model's"
            columns = " and ".join(f"{kind}.{name} = -TITLE" for kind in kinds)
            yield "sign", f"{text}; flip it in the file of --columns: {columns}", undone


def _orders(sample: Sample, names: tuple[str, ...]) -> Iterator[tuple[str, str, Sample]]:
    plain = list(range(len(names)))
    orders = []
    for first, second in combinations(plain, 2):
        order = plain.copy()
        order[first], order[second] = second, first
        orders.append((order, f"joints {names[first]} and {names[second]} are exchanged"))
    if len(names) > 2:
        orders.append((plain[::-1], "the order of the joints is reversed"))
    for order, said in orders:
        moved = sample.with_order(order, model_fit.MOTION)
        for what, undone in (
            ("", moved.with_order(order, model_fit.TORQUE)),
            (" in the positions", moved),
            (" in the torques", sample.with_order(order, model_fit.TORQUE)),
        ):
            yield "order", f"{said}{what}; put the columns right with --columns FILE", undone


def torque_scales(log: ModelFit) -> tuple[Array, Array]:
    """Return (scale (n,), its relative standard error (n,)): torque column over true torque.

    It begins with the ratio of the usual torques. In each round the torque of the known links is
    one more column in each joint's equation; its coefficient is what is left of the joint's scale.
    """
    sample, known_links = log.sample, log.links.copy()
    known_links[-1] = 0.0
    rest, model = log.torque(sample, known_links), rms(log.model_torque)
    loaded = rms(rest) > _LOADED * float(np.max(rms(rest)))
    floor = 1e-6 * float(np.max(model))
    scale = np.clip(rms(sample.tau) / np.maximum(model, floor), _LEAST, _MOST)
    # A joint that the known links hardly load tells nothing of its own scale.
    sample = _without(sample, ~loaded)
    own = rest[:, :, None] * np.eye(rest.shape[1])
    spread = np.full(rest.shape[1], _FAR)
    for _ in range(_SCALE_ROUNDS):
        found = log.fit(sample.with_torque(1.0 / scale), own, spread, known_links=True)
        left = np.clip(1.0 + found.extra, 0.2, 5.0)
        error = np.where(loaded, found.error / left, np.inf)
        known = error < _KNOWN
        scale = np.clip(np.where(known, scale * left, scale), _LEAST, _MOST)
    if np.any(known):
        scale = np.where(known, scale, np.median(scale[known]))
    return scale, error


def _without(sample: Sample, joints: NDArray[np.bool_] | int) -> Sample:
    """Return a sample in which one joint, or some (n,), hardly count."""
    sigma = sample.sigma.copy()
    sigma[joints] *= _IGNORED
    return replace(sample, sigma=sigma)


def unit_findings(log: ModelFit) -> Iterator[Finding]:
    """Yield a finding where one joint's torque is in another unit than the others'."""
    floor = _LEAST_LOAD * strongest(log)
    ratio = rms(log.sample.tau) / np.maximum(rms(log.model_torque), floor)
    joint = int(np.argmax(ratio))
    factor = float(ratio[joint] / np.median(np.delete(ratio, joint))) if len(ratio) > 2 else 1.0
    if factor > ODD_UNIT and log.plausible(log.fit(_without(log.sample, joint))):
        name = log.robot.joint_names[joint]
        yield Finding(
            "torque-scale",
            Level.REFUSE,
            f"torque of joint {name} alone reads {factor:.2g} times too much, or more: as in mN·m "
            f"or N·cm; put it right with --columns FILE: torque.{name} = 0.001 * TITLE",
        )


def scale_findings(log: ModelFit) -> Iterator[Finding]:
    """Yield what the scales of the joints that are sure of it say."""
    scale, error = torque_scales(log)
    off = np.abs(np.log(scale))
    sure = off > SURE * error
    if not np.any(sure & (off > np.log(WARNED))):
        return
    known = np.flatnonzero(error <= max(_KNOWN, float(np.min(error))))
    if not _better(log, scale, known):
        return
    weight = 1.0 / error[known] ** 2
    typical = float(np.exp(np.average(np.log(scale[known]), weights=weight)))
    spread = float(np.max(scale[known]) / np.min(scale[known]))
    listed = ", ".join(f"{log.robot.joint_names[j]} {scale[j]:.3g}" for j in known)
    yield Finding(
        "torque-scale",
        Level.REFUSE if np.any(sure & (off > np.log(REFUSED))) else Level.WARN,
        f"torque reads {typical:.3g} times what the model takes ({listed}): "
        f"{_meaning(typical, spread, float(np.sum(weight) ** -0.5), log.divided)}",
    )


def _better(log: ModelFit, scale: Array, known: NDArray[np.int64]) -> bool:
    """Return whether the log is more likely with these scales than without."""
    # With a wrong scale the terminal link has to make up for the whole arm's torque.
    before = log.fit(log.sample, known_links=True)
    asked = _without(log.sample, ~np.isin(np.arange(len(scale)), known))
    after = log.fit(asked.with_torque(1.0 / scale), known_links=True)
    if not log.plausible(after):
        return False
    if not log.plausible(before, _RATHER_HEAVY):
        return True
    return explains(log.fit(asked, known_links=True), after)


def _meaning(typical: float, spread: float, error: float, divided: Array) -> str:
    """Return what a scale with this relative standard error probably is, and what to do; torques
    were divided (n,) already.
    """
    remedy = "if the model is this arm's, pass --torque-scale"
    scales = divided[:1] if np.ptp(divided) == 0.0 else divided

    def in_all(scale: float, digits: str = ".4g") -> str:
        return ",".join(format(each, digits) for each in (scale * scales).tolist())

    if spread > _SAME:
        own = "a factor of its own for every joint, as "
        if typical < 0.5:
            return (
                f"{own}motor currents in amperes have (give the torque per ampere with "
                "--torque-constants), or the model of another arm"
            )
        each = "per joint" if np.all(divided == 1.0) else "per joint, times the one given"
        return f"{own}per cent of rated torque has, or the model of another arm; {remedy} {each}"
    nearest = min(UNITS, key=lambda factor: abs(np.log(typical / factor)))
    if abs(np.log(typical / nearest)) < max(np.log(_CLOSE), SURE * error):
        return f"as in {UNITS[nearest]}; {remedy} {in_all(nearest)}"
    if _PER_AMPERE[0] < 1.0 / typical < _PER_AMPERE[1]:
        return "as motor currents in amperes have; give N·m per ampere with --torque-constants"
    if 1.0 / 200.0 < typical < 1.0 / _PER_AMPERE[1]:
        return (
            f"as on the motor's side of a gear of 1:{1.0 / typical:.0f}, or in amperes; give the "
            f"ratio as --torque-scale {in_all(typical)}, or --torque-constants"
        )
    return f"another scale, or the model of another arm; {remedy} {in_all(typical, '.3g')}"


SMALL = 0.6
"""Size of a torque without gravity over that of the model, at most."""
# How much more friction alone may cost than links without gravity, to be as good.
_NO_MORE = 1.3
# What is left, and what friction is, of a torque that follows from rigid bodies alone.
_EXACT, _FRICTIONLESS = 0.02, 5e-3
# Noise in a torque that somebody computed, as a part of it.
_QUIET = 1e-3


def gravity_findings(log: ModelFit, best: float) -> Iterator[Finding]:
    """Yield a finding where torque without gravity, or any link, costs less than ``best``."""
    sample = log.sample
    size = float(np.median((rms(sample.tau) / rms(log.model_torque))[loaded(log)]))
    if size > SMALL:
        return
    alone = log.fit(sample, only_friction=True)
    weightless = log.fit(sample, weightless=True)
    scale, _ = torque_scales(log)
    scaled = log.fit(sample.with_torque(1.0 / scale))
    least = min(alone.cost, weightless.cost)
    if least > best or (scaled.cost < least and log.plausible(scaled)):
        return
    if alone.cost < _NO_MORE * weightless.cost:
        text = (
            "has nothing of its motion but friction: this is an external torque, what is left "
            "after the controller's model; record the measured joint torque"
        )
    elif not log.plausible(weightless):
        return
    else:
        text = (
            "fits it without gravity: gravity is compensated in it already; record the measured "
            "joint torque, not the command"
        )
    size_text = f"the torque is {size:.2g} times as large as the model's and {text}"
    yield Finding("gravity", Level.REFUSE, size_text)


def computed_findings(log: ModelFit, base: Fit) -> Iterator[Finding]:
    """Yield a finding where the torque is the model's own, without noise and friction."""
    sample, joints = log.sample, loaded(log)
    usual = rms(sample.tau)
    exact = rms(base.residual) < _EXACT * usual
    sizes = np.stack((np.ones_like(usual), rms(sample.qd)), axis=1)
    friction = np.sum(np.abs(base.friction[:, :2]) * sizes, axis=1) < _FRICTIONLESS * usual
    quiet = log.noise < _QUIET * usual
    if np.all((exact & friction & quiet)[joints]):
        yield Finding(
            "computed",
            Level.WARN,
            "the torque follows rigid-body dynamics to "
            f"{percent(float(np.max((rms(base.residual) / usual)[joints])))} and has no "
            "friction: it was computed, or commanded, not measured; record the measured torque",
        )


def loaded(log: ModelFit) -> np.ndarray:
    """Return (n,) whether a joint carries a fair part of what the strongest of its kind carries."""
    return np.asarray(rms(log.model_torque) >= _LOADED * strongest(log))


def strongest(log: ModelFit) -> Array:
    """Return (n,) the usual torque of the strongest joint of its kind.

    A lift carries many more newtons than the arm on it newton metres.
    """
    usual, slide = rms(log.model_torque), log.robot.is_slide
    most = [np.max(usual[slide == kind], initial=0.0) for kind in (False, True)]
    return np.where(slide, most[1], most[0])


UNEXPLAINED = 0.3
"""Torque that is left, as a part of what is measured, beyond which the model is not of this arm."""
LENGTH = 0.3
"""Over so long a time a burst is looked for [s]."""
STRONG, ABOVE = 30.0, 20.0
"""Mean square of residual over tolerance in a burst, and how far it stands above the usual."""


def model_findings(log: ModelFit) -> Iterator[Finding]:
    """Yield a finding where the model would need an impossible terminal link, or does not fit."""
    found = log.fit(log.sample, known_links=True)
    arm = float(np.sum(log.links[:, 0]))
    mass = float(found.thetas[-1, 0])
    left = float(np.sqrt(np.sum(found.residual**2) / np.sum(log.sample.tau**2)))
    text = f"to fit this log, the terminal link would have {mass:.3g} kg on an arm of {arm:.3g} kg"
    if log.plausible(found):
        if left <= UNEXPLAINED:
            return
        text = f"the model leaves {percent(left)} of the torque unexplained, whatever the "
        text += "terminal link is"
    text += ": is the model of this arm, with what is fixed to its other links, and its base "
    yield Finding("model", Level.REFUSE, f"{text}mounted as the model says?")


def contact_findings(log: ModelFit, base: Fit) -> Iterator[Finding]:
    """Yield a finding at the strongest burst."""
    residual = _beyond_friction(log, base)
    squares = (residual / log.sample.sigma) ** 2
    step = float(np.median(np.diff(log.time)))
    width = max(3, round(LENGTH / step))
    if len(squares) < 4 * width:
        return
    pooled = np.convolve(np.mean(squares, axis=1), np.ones(width) / width, mode="valid")
    worst, usual = int(np.argmax(pooled)), float(np.median(pooled))
    if pooled[worst] < STRONG or pooled[worst] < ABOVE * usual:
        return
    part = slice(worst, worst + width)
    joint = int(np.argmax(np.mean(squares[part], axis=0)))
    peak = float(np.max(np.abs(residual[part, joint])))
    yield Finding(
        "contact",
        Level.WARN,
        f"from {log.time[worst]:.2f} s to {log.time[part][-1]:.2f} s something else acts "
        f"on the arm: {peak:.3g} N m at joint {log.robot.joint_names[joint]} that the model "
        "does not explain; was there contact, or did a gripper move? cut it out, or record again",
    )


def _beyond_friction(log: ModelFit, base: Fit) -> Array:
    """Return (K, n) residuals less what dry friction of a joint that hardly moves may explain."""
    # An arm that creeps to its rest still has all of its dry friction, in a direction that the
    # low-passed speed does not tell.
    speed = np.abs(log.sample.qd)
    unsure = np.where(speed < slow_speed(log.sample.qd), 2.0 * np.abs(base.friction[:, 0]), 0.0)
    return np.asarray(np.sign(base.residual) * np.maximum(np.abs(base.residual) - unsure, 0.0))
