"""Columns that are not what they are taken for: signs, exchanged joints, degrees, units of torque.

These mistakes are finite in number, or a factor per joint. Each is undone and the rows made again;
how likely the log is then is the same figure as for an explanation that adds columns. What changes
torques alone needs no new rows, and is tried of every log; the others where the model does not fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.diagnosis import Finding, Level
from robot_sysid.diagnosis.evidence import Hypotheses, Posterior
from robot_sysid.diagnosis.rows import (
    LEAST_TORQUE,
    LogRows,
    Prior,
    base_prior,
    log_rows,
    rms,
)
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.signals.process import ProcessedSignals

REFUSED = 1.6
WARNED = 1.3
"""Factors by which torque may be too large or too small before a log is refused, or warned of."""
UNITS = {1e3: "mN·m", 100.0: "N·cm", 10.197: "kgf·cm", 8.851: "lbf·in"}
UNITS.update({0.7376: "lbf·ft", 141.6: "ozf·in", 1e-3: "kN·m"})
"""Newton metre in other units."""
SMALL = 0.6
ODD_UNIT = 20.0
"""Size of a torque without gravity over the model's, at most; factor by which one joint's torque
over the model's is larger than the other joints', where it has a unit of its own."""
SHORT = 6.0
"""Length of the stretch on which relabelled motions are tried first [s]."""
# Scales that differ by less have one cause; a unit's scale is met within this factor.
_SAME = 1.35
_CLOSE = 1.25
# Torque at the joint per ampere of its motor, at least and at most [N m/A]: a UR10e's is 10 to 12.
_PER_AMPERE = (2.0, 25.0)
# Standard deviations of the logarithm of a scale that all joints have and of each joint's own;
# rounds in which scales are found, and how far they may be from where a round begins, as a share.
_COMMON_RANGE = 4.0
_OWN_RANGE = 0.4
_ROUNDS = 5
_FAR = 0.7
# Scales of any unit and gear lie between; relative error of a scale beyond which the other joints'
# is taken; part of the strongest joint's load from which on usual torques say a scale.
_LEAST = 1e-4
_MOST = 1e5
_KNOWN = 0.3
_LOADED = 0.1
# The same part below which a joint's torque is mostly friction.
_LEAST_LOAD = 0.03
# Factors by which a scale may differ from the ratio of usual torques, where links make most of the
# torque and where friction does.
_FARTHEST = 3.0
_FRICTION = 10.0
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
        return [self._of(log) for log in signals]

    def _of(self, signals: ProcessedSignals) -> ProcessedSignals:
        arrays: dict[str, Any] = {}
        if self.motion is not None:
            arrays = {
                name: self.motion(getattr(signals, name)) for name in ("q", "qd", "qdd")
            }
        if self.torque is not None:
            arrays["tau"] = self.torque(signals.tau)
        return replace(signals, **arrays)


def relabellings(robot: RobotModel) -> Iterator[Relabelling]:
    """Yield every mistake of this kind, those of torques alone first."""
    names = robot.joint_names
    kinds = (("torque",), ("position",), ("position", "torque"))
    orders = list(_orders(names))
    for which in kinds:
        moved = "position" in which
        turned = "torque" in which
        for joint, name in enumerate(names):
            sign = np.where(np.arange(len(names)) == joint, -1.0, 1.0)
            flip = sign.__mul__
            columns = " and ".join(f"{kind}.{name} = -TITLE" for kind in which)
            text = (
                f"the {' and '.join(which)} of joint {name} has the opposite sign of the model's; "
                f"flip it in the file of --columns: {columns}"
            )
            yield Relabelling(
                "sign", text, flip if moved else None, flip if turned else None
            )
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
        "angle-unit",
        "positions look like degrees; pass --units deg",
        to_radians.__mul__,
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
    prior: Prior
    log: LogRows


def undone_torques(
    log: LogRows,
    signals: Sequence[ProcessedSignals],
    base: Hypotheses,
    base_posterior: Posterior,
) -> list[Relabelled]:
    """Return mistakes of torques alone, of which the rows are those of the log itself."""
    mistakes = [m for m in relabellings(log.robot) if m.motion is None]
    if usual_scale(log) < SMALL:
        mistakes += _without_links(log, signals)
    candidates = []
    for mistake in mistakes:
        assert mistake.torque is not None
        right = log.with_torque(mistake.torque(log.torque))
        candidates.append((base.gain_of_right(right, base_posterior), mistake, right))
    candidates.sort(key=lambda candidate: -candidate[0])
    undone = []
    for screened_gain, mistake, right in candidates[:_FINALISTS]:
        if screened_gain > 0.0:
            posterior = base.with_right(right).posterior(base_posterior.noise)
            gain = posterior.log_evidence - base_posterior.log_evidence
            undone.append(_relabelled(mistake, gain, posterior, base.prior, right))
    return undone


def _without_links(
    log: LogRows, signals: Sequence[ProcessedSignals]
) -> Iterator[Relabelling]:
    """Yield that the links' weight, or all that they make, was taken off the torque."""
    robot = log.robot

    def torques(motion: Motion) -> tuple[Array, Array]:
        still = np.zeros_like(motion.q)
        dynamics = LinkDynamics(robot)
        weight = dynamics.motion(motion.q, still, still).torque(robot.thetas)
        whole = dynamics.motion(motion.q, motion.qd, motion.qdd).torque(robot.thetas)
        return weight, whole

    # Through the low-pass: what that takes off may be more than the noise.
    filtered = [log.filter_columns(torques, smooth=True) for log in signals]
    weight = np.concatenate([of_log[0] for of_log in filtered])
    whole = np.concatenate([of_log[1] for of_log in filtered])
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


def undone_columns(
    log: LogRows,
    signals: Sequence[ProcessedSignals],
    base_posterior: Posterior,
    options: EstimationOptions,
) -> list[Relabelled]:
    """Return mistakes of columns, those that a short stretch finds most likely."""
    stretch = [_busiest(signals)]
    short = log_rows(log.robot, stretch)
    candidates = []
    for mistake in relabellings(log.robot):
        rows = log_rows(log.robot, mistake.undone(stretch), short.used)
        posterior = Hypotheses(rows, base_prior(rows, options)).posterior()
        candidates.append((posterior.log_evidence, mistake))
    candidates.sort(key=lambda candidate: -candidate[0])
    undone = []
    for _, mistake in candidates[:_FINALISTS]:
        rows = log_rows(log.robot, mistake.undone(signals), log.used)
        prior = base_prior(rows, options)
        posterior = Hypotheses(rows, prior).posterior()
        gain = posterior.log_evidence - base_posterior.log_evidence
        undone.append(_relabelled(mistake, gain, posterior, prior, rows))
    return undone


def _relabelled(
    mistake: Relabelling, gain: float, posterior: Posterior, prior: Prior, log: LogRows
) -> Relabelled:
    return Relabelled(
        mistake.name, Level.REFUSE, mistake.text, float(gain), posterior, prior, log
    )


def _busiest(signals: Sequence[ProcessedSignals]) -> ProcessedSignals:
    """Return the stretch of a log in which joints move most."""
    best = max(signals, key=len)
    count = round(SHORT * best.rate)
    if len(best) <= count:
        return best
    relative = np.abs(best.qd) / np.maximum(np.max(np.abs(best.qd), axis=0), 1e-9)
    travelled = np.append(0.0, np.cumsum(np.sum(relative, axis=1)))
    start = int(np.argmax(travelled[count:] - travelled[:-count]))
    stretch = slice(start, start + count)
    names = ("time", "q", "qd", "qdd", "tau", "bridged", "turning")
    return replace(best, **{name: getattr(best, name)[stretch] for name in names})


@dataclass(frozen=True)
class TorqueScales:
    """Torque columns over true torques.

    Attributes:
        scale: (n,) of each joint; the median of the others where the torques do not show it.
        shown: (k,) joints whose scale the torques show.
        covariance: (k, k) of the logarithms of theirs.
    """

    scale: Array
    shown: NDArray[np.int64]
    covariance: Array

    @cached_property
    def common(self) -> tuple[float, float]:
        """The scale that all have together and the standard error of its logarithm."""
        precision = np.linalg.inv(self.covariance)
        weight = np.sum(precision, axis=0) / np.sum(precision)
        mean = float(weight @ np.log(self.scale[self.shown]))
        return float(np.exp(mean)), float(np.sum(precision) ** -0.5)

    @property
    def spread(self) -> float:
        """The largest over the smallest."""
        scale = self.scale[self.shown]
        return float(np.max(scale) / np.min(scale))

    @property
    def penalty(self) -> float:
        """Nats that scales cost, which may be anything together and less each of its own."""
        logarithm = np.log(self.scale[self.shown])
        covariance = self.covariance
        if self.spread < _SAME:
            typical, error = self.common
            logarithm = np.log([typical])
            covariance = np.array([[error**2]])
        prior = _COMMON_RANGE**2 + _OWN_RANGE**2 * np.eye(len(logarithm))
        narrowed = np.linalg.slogdet(prior)[1] - np.linalg.slogdet(covariance)[1]
        return float(0.5 * (narrowed + logarithm @ np.linalg.solve(prior, logarithm)))


def undone_scales(
    log: LogRows, base_posterior: Posterior, options: EstimationOptions, divided: Array
) -> list[Relabelled]:
    """Return a unit, a common scale or a scale per joint, whichever the torques say.

    Args:
        divided: (n,) scale that torques were divided by already.
    """
    scales = torque_scales(log, options)
    if not len(scales.shown):
        return []
    typical, common_error = scales.common
    scale = scales.scale
    if scales.spread < _SAME:
        scale = np.full(len(scale), _unit_near(typical, common_error) or typical)
    undone = log.with_torque(log.torque / scale)
    prior = base_prior(undone, options)
    posterior = Hypotheses(undone, prior).posterior()
    density = float(np.sum(np.maximum(np.sum(log.used, axis=0), 1) * np.log(scale)))
    gain = (
        posterior.log_evidence - density - base_posterior.log_evidence - scales.penalty
    )
    listed = ", ".join(
        f"{log.robot.joint_names[j]} {scale[j]:.3g}" for j in scales.shown
    )
    text = (
        f"torque reads {typical:.3g} times what the model takes ({listed}): "
        f"{_meaning(typical, scales.spread, common_error, divided)}"
    )
    off = float(np.max(np.abs(np.log(scale[scales.shown]))))
    level = Level.REFUSE if off > np.log(REFUSED) else Level.WARN
    level = level if off > np.log(WARNED) else Level.NOTE
    return [Relabelled("torque-scale", level, text, gain, posterior, prior, undone)]


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


def torque_scales(log: LogRows, options: EstimationOptions) -> TorqueScales:
    """Return by what each joint's torque was multiplied, from the ratio of usual torques on.

    In each round the torque of the links as they are found is one more column in each joint's
    equation: a step of Gauss and Newton.
    """
    model = model_torque(log)
    loaded = model > _LOADED * float(np.max(model))
    ratio = np.clip(
        rms(log.torque) / np.maximum(model, 1e-6 * np.max(model)), _LEAST, _MOST
    )
    usual = float(np.median(ratio[loaded]))
    # Friction makes the torque of a joint that links hardly load.
    is_odd = np.abs(np.log(ratio / usual)) > np.log(_FRICTION)
    is_of_links = loaded | (is_odd & (model > LEAST_TORQUE * float(np.max(model))))
    scale = np.where(is_of_links, ratio, usual)
    farthest = np.where(loaded, _FARTHEST, _FRICTION)
    least = scale / farthest
    most = scale * farthest
    covariance = np.eye(len(scale))
    values: Array | None = None
    for _ in range(_ROUNDS):
        undone = log.with_torque(log.torque / scale)
        prior = base_prior(undone, options)
        base = Hypotheses(undone, prior)
        rigid = undone.links_torque(prior.mean if values is None else values)
        columns = []
        for joint, own_column in enumerate(np.eye(len(scale))):
            of_joint = _FAR * rigid[:, joint, None] * own_column
            columns.append(base.transform.of_joint(joint, of_joint))
        posterior = base.with_columns(columns).posterior()
        sought = slice(len(prior.kept), None)
        change = np.clip(1.0 + _FAR * posterior.values[sought], 0.2, 5.0)
        covariance = (
            _FAR**2 * posterior.covariance[sought, sought] / np.outer(change, change)
        )
        scale = np.clip(scale * change, least, most)
        values = prior.parameters(posterior.values)
    is_sure = np.sqrt(np.diag(covariance)) < _KNOWN
    # Torque that has nothing of a heavy link is not that of other units.
    sure = np.flatnonzero(is_sure & np.all(is_sure[loaded]))
    if len(sure):
        scale = np.where(is_sure, scale, np.median(scale[sure]))
    return TorqueScales(scale, sure, covariance[np.ix_(sure, sure)])


def _unit_near(typical: float, error: float) -> float | None:
    """Return the unit's factor that a scale with some relative error is, if any."""
    nearest = min(UNITS, key=lambda factor: abs(np.log(typical / factor)))
    off = abs(np.log(typical / nearest))
    return (
        nearest
        if off < max(np.log(_CLOSE), 3.0 * error) and abs(np.log(nearest)) > 1
        else None
    )


def _meaning(typical: float, spread: float, error: float, divided: Array) -> str:
    """Return what a scale with this relative standard error probably is, and what to do; torques
    were divided (n,) already.
    """
    remedy = "if the model is this arm's, pass --torque-scale"
    scales = divided[:1] if np.ptp(divided) == 0.0 else divided

    def in_all(scale: float, digits: str = ".4g") -> str:
        return ",".join(format(value, digits) for value in (scale * scales).tolist())

    if spread > _SAME:
        factors = "a factor of its own for every joint, as "
        if typical < 0.5:
            return (
                f"{factors}motor currents in amperes have (give the torque per ampere with "
                "--torque-constants), or the model of another arm"
            )
        for_joints = (
            "per joint" if np.all(divided == 1.0) else "per joint, times the one given"
        )
        return (
            f"{factors}uncalibrated currents or per cent of rated torque have, or the model of "
            f"another arm; {remedy} {for_joints}: the file of robot-sysid payload --known-mass"
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
    return (
        f"another scale, or the model of another arm; {remedy} {in_all(typical, '.3g')}"
    )
