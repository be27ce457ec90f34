"""Columns that are not what they are taken for: signs, exchanged joints, degrees, units of torque.

These mistakes are finite in number, or a factor per joint. Each is undone and the rows made again;
how likely the log is then is the same figure as for an explanation that adds columns. What changes
torques alone needs no new rows, and is tried of every log; the others where the model does not fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from robot_sysid.diagnosis import Finding, Level
from robot_sysid.diagnosis.evidence import Hypotheses, Posterior
from robot_sysid.diagnosis.rows import LogRows, base_prior, log_rows, rms
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.signals.process import ProcessedSignals

REFUSED, WARNED = 1.6, 1.3
"""Factors by which torque may be too large or too small before a log is refused, or warned of."""
UNITS = {1e3: "mN·m", 100.0: "N·cm", 10.197: "kgf·cm", 8.851: "lbf·in"}
UNITS.update({0.7376: "lbf·ft", 141.6: "ozf·in", 1e-3: "kN·m"})
"""Newton metre in other units."""
SMALL, ODD_UNIT = 0.6, 20.0
"""Size of a torque without gravity over the model's, at most; factor by which one joint's torque
over the model's is larger than the other joints', where it has a unit of its own."""
SHORT = 6.0
"""Length of the stretch on which relabelled motions are tried first [s]."""
# Scales that differ by less have one cause; a unit's scale is met within this factor.
_SAME, _CLOSE = 1.35, 1.25
# Torque at the joint per ampere of its motor, at least and at most [N m/A]: a UR10e's is 10 to 12.
_PER_AMPERE = (2.0, 25.0)
# Width of the prior of the logarithm of a scale; rounds in which it is found, and how far it may be
# from where a round begins, as a share.
_LOG_RANGE, _ROUNDS, _FAR = 20.0, 5, 0.7
# Scales of any unit and gear lie between; relative error of a scale beyond which the other joints'
# is taken; part of the strongest joint's load below which a joint's scale is not asked.
_LEAST, _MOST, _KNOWN, _LOADED = 1e-4, 1e5, 0.3, 0.1
# The same part below which a joint's torque is mostly friction.
_LEAST_LOAD = 0.03
# Best relabellings of a stretch that are scored on the whole log.
_FINALISTS = 3


@dataclass(frozen=True)
class Relabelling:
    """A mistake in the columns, and how it is undone.

    Attributes:
        name: of the check.
        text: what is wrong and what to do.
        motion, torque: what of (N, n) arrays of motion and of torque is the arm's own.
    """

    name: str
    text: str
    motion: Callable[[Array], Array] | None = None
    torque: Callable[[Array], Array] | None = None

    def undone(self, signals: Sequence[ProcessedSignals]) -> list[ProcessedSignals]:
        """Return the signals without the mistake."""
        return [self._of(each) for each in signals]

    def _of(self, signals: ProcessedSignals) -> ProcessedSignals:
        arrays: dict[str, Any] = {}
        if self.motion is not None:
            arrays = {name: self.motion(getattr(signals, name)) for name in ("q", "qd", "qdd")}
        if self.torque is not None:
            arrays["tau"] = self.torque(signals.tau)
        return replace(signals, **arrays)


def relabellings(robot: RobotModel) -> Iterator[Relabelling]:
    """Yield every mistake of this kind, those of torques alone first."""
    names = robot.joint_names
    kinds = (("torque",), ("position",), ("position", "torque"))
    orders = list(_orders(names))
    for which in kinds:
        moved, turned = "position" in which, "torque" in which
        for joint, name in enumerate(names):
            sign = np.where(np.arange(len(names)) == joint, -1.0, 1.0)
            flip = sign.__mul__
            columns = " and ".join(f"{kind}.{name} = -TITLE" for kind in which)
            text = (
                f"the {' and '.join(which)} of joint {name} has the opposite sign of the model's; "
                f"flip it in the file of --columns: {columns}"
            )
            yield Relabelling("sign", text, flip if moved else None, flip if turned else None)
        where = "" if moved and turned else f" in the {which[0]}s"
        for text, order in orders:

            def arrange(values: Array, order: list[int] = order) -> Array:
                return values[:, order]

            advice = "put the columns right with --columns FILE"
            yield Relabelling(
                "order",
                f"{text}{where}; {advice}",
                arrange if moved else None,
                arrange if turned else None,
            )
    to_radians = np.where(robot.is_slide, 1.0, np.pi / 180.0)
    yield Relabelling(
        "angle-unit", "positions look like degrees; pass --units deg", to_radians.__mul__
    )
    yield Relabelling(
        "angle-unit",
        "positions look like radians that were taken for degrees; say rad where degrees are said: "
        "in --units, the file of --columns, a column's title or the recorder",
        (1.0 / to_radians).__mul__,
    )


def _orders(names: Sequence[str]) -> Iterator[tuple[str, list[int]]]:
    plain = list(range(len(names)))
    for first, second in combinations(plain, 2):
        order = plain.copy()
        order[first], order[second] = second, first
        yield f"joints {names[first]} and {names[second]} are exchanged", order
    if len(names) > 2:
        yield "the order of the joints is reversed", plain[::-1]


@dataclass(frozen=True)
class Relabelled:
    """A mistake that was undone, by how much that makes the log likelier, and what it is then."""

    name: str
    level: Level
    text: str
    gain: float
    posterior: Posterior
    log: LogRows


def undone_torques(
    log: LogRows, signals: Sequence[ProcessedSignals], base: Hypotheses, found: Posterior
) -> list[Relabelled]:
    """Return mistakes of torques alone, of which the rows are those of the log itself."""
    mistakes = [m for m in relabellings(log.robot) if m.motion is None]
    if usual_scale(log) < SMALL:
        mistakes += _without_links(log, signals)
    candidates = []
    for mistake in mistakes:
        assert mistake.torque is not None
        right = log.with_torque(mistake.torque(log.torque))
        candidates.append((base.gain_of_right(right, found), mistake, right))
    candidates.sort(key=lambda candidate: -candidate[0])
    undone = []
    for screened_gain, mistake, right in candidates[:_FINALISTS]:
        if screened_gain > 0.0:
            posterior = base.with_right(right).posterior(found.noise)
            gain = posterior.log_evidence - found.log_evidence
            undone.append(_relabelled(mistake, gain, posterior, right))
    return undone


def _without_links(log: LogRows, signals: Sequence[ProcessedSignals]) -> Iterator[Relabelling]:
    """Yield that the links' weight, or all that they make, was taken off the torque."""
    robot = log.robot

    def torques(motion: Motion) -> tuple[Array, Array]:
        still = np.zeros_like(motion.q)
        dynamics = LinkDynamics(robot)
        weight = dynamics.motion(motion.q, still, still).torque(robot.thetas)
        whole = dynamics.motion(motion.q, motion.qd, motion.qdd).torque(robot.thetas)
        return weight, whole

    # Through the low-pass: what that takes off may be more than the noise.
    parts = [each.passed(torques, smooth=True) for each in signals]
    weight, whole = (np.concatenate(part) for part in zip(*parts))
    yield Relabelling(
        "gravity",
        "the torque fits the model without gravity: gravity is compensated in it already; record "
        "the measured joint torque, not the command",
        torque=weight.__add__,
    )
    yield Relabelling(
        "gravity",
        "the torque has nothing of its motion but friction: this is an external torque, what is "
        "left after the controller's model; record the measured joint torque",
        torque=whole.__add__,
    )


def undone_motions(
    log: LogRows, signals: Sequence[ProcessedSignals], found: Posterior, options: EstimationOptions
) -> list[Relabelled]:
    """Return mistakes of positions, those that a short stretch finds most likely."""
    stretch = [_busiest(signals)]
    short = log_rows(log.robot, stretch)
    prior = base_prior(short, options)
    candidates = []
    for mistake in relabellings(log.robot):
        if mistake.motion is not None:
            rows = log_rows(log.robot, mistake.undone(stretch), short.used)
            posterior = Hypotheses(rows, prior).posterior()
            candidates.append((posterior.log_evidence, mistake))
    candidates.sort(key=lambda candidate: -candidate[0])
    undone = []
    for _, mistake in candidates[:_FINALISTS]:
        rows = log_rows(log.robot, mistake.undone(signals), log.used)
        posterior = Hypotheses(rows, base_prior(rows, options)).posterior()
        gain = posterior.log_evidence - found.log_evidence
        undone.append(_relabelled(mistake, gain, posterior, rows))
    return undone


def _relabelled(
    mistake: Relabelling, gain: float, posterior: Posterior, log: LogRows
) -> Relabelled:
    return Relabelled(mistake.name, Level.REFUSE, mistake.text, float(gain), posterior, log)


def _busiest(signals: Sequence[ProcessedSignals]) -> ProcessedSignals:
    """Return the stretch of a log in which joints move most."""
    best = max(signals, key=len)
    count = round(SHORT * best.rate)
    if len(best) <= count:
        return best
    relative = np.abs(best.qd) / np.maximum(np.max(np.abs(best.qd), axis=0), 1e-9)
    travelled = np.append(0.0, np.cumsum(np.sum(relative, axis=1)))
    start = int(np.argmax(travelled[count:] - travelled[:-count]))
    part = slice(start, start + count)
    names = ("time", "q", "qd", "qdd", "tau", "bridged", "turning")
    return replace(best, **{name: getattr(best, name)[part] for name in names})


def undone_scales(
    log: LogRows, found: Posterior, options: EstimationOptions, divided: Array
) -> list[Relabelled]:
    """Return a unit, a common scale or a scale per joint, whichever the torques say.

    Args:
        divided: (n,) scale that torques were divided by already.
    """
    scale, error = torque_scales(log, options)
    known = np.flatnonzero(np.isfinite(error))
    if not len(known):
        return []
    weight = 1.0 / error[known] ** 2
    typical = float(np.exp(np.average(np.log(scale[known]), weights=weight)))
    spread = float(np.max(scale[known]) / np.min(scale[known]))
    common_error = float(np.sum(weight) ** -0.5)
    if spread < _SAME:
        scale = np.full(len(scale), _unit_near(typical, common_error) or typical)
        penalty = _log_prior_width(common_error)
    else:
        penalty = sum(_log_prior_width(float(each)) for each in error[known])
    undone = log.with_torque(log.torque / scale)
    posterior = Hypotheses(undone, base_prior(undone, options)).posterior()
    density = float(np.sum(np.maximum(np.sum(log.used, axis=0), 1) * np.log(scale)))
    gain = posterior.log_evidence - density - found.log_evidence - penalty
    listed = ", ".join(f"{log.robot.joint_names[j]} {scale[j]:.3g}" for j in known)
    text = (
        f"torque reads {typical:.3g} times what the model takes ({listed}): "
        f"{_meaning(typical, spread, common_error, divided)}"
    )
    off = float(np.max(np.abs(np.log(scale[known]))))
    level = Level.REFUSE if off > np.log(REFUSED) else Level.WARN
    level = level if off > np.log(WARNED) else Level.NOTE
    return [Relabelled("torque-scale", level, text, gain, posterior, undone)]


def _log_prior_width(error: float) -> float:
    """Return the nats that a scale costs which may be anything and is known this well."""
    return float(np.log(_LOG_RANGE / (np.sqrt(2.0 * np.pi) * max(error, 1e-3))))


def usual_scale(log: LogRows) -> float:
    """Return the torque of the joints that the model loads over the model's."""
    model = model_torque(log)
    loaded = model > _LOADED * float(np.max(model))
    return float(np.median((rms(log.torque) / np.maximum(model, 1e-12))[loaded]))


def model_torque(log: LogRows) -> Array:
    """Return the usual torque (n,) that the model's links make [N m]."""
    motion = log.motion
    moves = LinkDynamics(log.robot).motion(motion.q, motion.qd, motion.qdd)
    return rms(moves.torque(log.robot.thetas))


def odd_unit_finding(log: LogRows) -> Finding | None:
    """Return that one joint's torque is in another unit than the others'; None where none is."""
    model = model_torque(log)
    ratio = rms(log.torque) / np.maximum(model, _LEAST_LOAD * float(np.max(model)))
    joint = int(np.argmax(ratio))
    if len(ratio) < 3:
        return None
    factor = float(ratio[joint] / np.median(np.delete(ratio, joint)))
    # A torque without gravity has a share of the model's at joints that carry weight.
    if factor < ODD_UNIT or usual_scale(log) < SMALL:
        return None
    name = log.robot.joint_names[joint]
    text = (
        f"torque of joint {name} alone reads {factor:.2g} times too much, or more: as in mN·m or "
        f"N·cm; put it right with --columns FILE: torque.{name} = 0.001 * TITLE"
    )
    return Finding("torque-scale", Level.REFUSE, text)


def torque_scales(log: LogRows, options: EstimationOptions) -> tuple[Array, Array]:
    """Return (scale (n,), relative standard error (n,)): torque column over true torque.

    It begins with the ratio of usual torques. In each round the torque of the links that are known
    is one more column in each joint's equation. A joint that they hardly load has the others' usual
    scale and an infinite error.
    """
    robot, motion = log.robot, log.motion
    thetas = robot.thetas
    moves = LinkDynamics(robot).motion(motion.q, motion.qd, motion.qdd)
    model = rms(moves.torque(thetas))
    thetas[-1] = 0.0
    known = moves.torque(thetas)
    loaded = rms(known) > _LOADED * float(np.max(rms(known)))
    scale = np.clip(rms(log.torque) / np.maximum(model, 1e-6 * np.max(model)), _LEAST, _MOST)
    error = np.full(len(scale), np.inf)
    for _ in range(_ROUNDS):
        if np.any(loaded):
            scale = np.where(loaded, scale, np.median(scale[loaded]))
        undone = log.with_torque(log.torque / scale)
        base = Hypotheses(undone, base_prior(undone, options))
        width = len(scale)
        own = []
        for joint in range(width):
            columns = np.zeros((len(known), width))
            columns[:, joint] = _FAR * loaded[joint] * known[:, joint]
            own.append(base.transform.of_joint(joint, columns))
        found = base.with_columns(own).posterior()
        share = np.clip(1.0 + _FAR * found.values[-width:], 0.2, 5.0)
        error = _FAR * np.sqrt(np.diag(found.covariance)[-width:]) / share
        error = np.where(loaded & (error < _KNOWN), error, np.inf)
        scale = np.clip(np.where(np.isfinite(error), scale * share, scale), _LEAST, _MOST)
    sure = np.isfinite(error)
    if np.any(sure):
        scale = np.where(sure, scale, np.median(scale[sure]))
    return scale, error


def _unit_near(typical: float, error: float) -> float | None:
    """Return the unit's factor that a scale with some relative error is, if any."""
    nearest = min(UNITS, key=lambda factor: abs(np.log(typical / factor)))
    off = abs(np.log(typical / nearest))
    return nearest if off < max(np.log(_CLOSE), 3.0 * error) and abs(np.log(nearest)) > 1 else None


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
        return (
            f"{own}uncalibrated currents or per cent of rated torque have, or the model of another "
            f"arm; {remedy} {each}: the file of robot-sysid payload --known-mass"
        )
    nearest = _unit_near(typical, error)
    if nearest is not None:
        return f"as in {UNITS[nearest]}; {remedy} {in_all(nearest)}"
    if _PER_AMPERE[0] < 1.0 / typical < _PER_AMPERE[1]:
        return "as motor currents in amperes have; give N·m per ampere with --torque-constants"
    if 1.0 / 200.0 < typical < 1.0 / _PER_AMPERE[1]:
        return (
            f"as on the motor's side of a gear of 1:{1.0 / typical:.0f}, or in amperes; give the "
            f"ratio as --torque-scale {in_all(typical)}, or --torque-constants"
        )
    return f"another scale, or the model of another arm; {remedy} {in_all(typical, '.3g')}"
