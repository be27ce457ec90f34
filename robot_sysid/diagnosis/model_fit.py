"""How well a log fits its model, once the model is allowed to be as wrong as models usually are.

Looked at are some hundred instants, motion and torque low-passed alike. Minimised is

    sum_j (K_e / K) sum_k ((tau_jk - Y_jk theta - friction_jk) / sigma_j)^2
        + sum_i ((theta_i - theta_i,model) / s_i)^2

over the parameters theta of ALL links and each joint's friction. The terminal link may be nearly
anything (that is what will be identified), the other links a few per cent off; K_e is how many
independent samples a log is taken to have. The minimum over n K_e is the cost: below one, nothing
is wrong that could be seen in the torques.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.kinematics import BeyondRigidBodies
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.dynamics.spatial import characteristic_length, com_from_theta, parameter_scale
from robot_sysid.records import Array, Measurement, RobotModel
from robot_sysid.signals.process import process

INSTANTS, FEWEST = 400, 50
"""So many instants stand for a log, and for each of its pieces at least."""
DELAYS = (-0.04, 0.1)
"""Delays of torque between which it is looked for [s]."""
TOLERANCE = 0.04
"""Part of a joint's usual torque that a right model may miss."""
LINK_ERROR = 0.05
"""Standard deviation of another link's parameters as a part of a body of its mass and size."""
PAYLOAD = 0.3
"""Standard deviation of the terminal link's mass as a part of the whole arm's."""
LIGHTEST, HEAVIEST = -0.03, 0.6
"""Mass of a plausible terminal link, as a part of the whole arm's."""
INDEPENDENT = 100
"""Independent samples that a log is taken to have per joint."""
# Numbers that say nothing else are judged by the table of benchmarks/wrong_log_table.py: with them
# all of 138 wrong logs of 23 kinds are named, and 50 of 50 right ones draw no alarm.
CLEARLY = 60.0
"""Fall of chi-squared by undoing a mistake that chance and small errors of a model do not bring."""
LIKELY = 15.0
"""The same where the log as it is would need an impossible terminal link."""
WELL = 1.4
"""Cost of a log that fits: right logs stay below one."""
BETTER = 0.25
"""Part of the cost that is left where a log that does not fit for other reasons fits better."""
N_FRICTION = 4
# Of the strongest joint's torque: one that carries next to nothing is judged by what its neighbours
# carry. Of a joint's top speed: below it the direction of friction is not sure. Of the reach:
# size of what may hang on the terminal link.
_LEAST, _SLOW, _REACH = 0.02, 0.05, 0.15
# Motions whose rows are kept beside the last one: as recorded, and without a mistake.
_MOTIONS = 2
MOTION, TORQUE = ("q", "qd", "qdd"), ("tau", "sigma")
"""Fields of a sample that belong together."""
# Groups of instants, and neighbours in each, that bound what a fit costs.
_GROUPS, _NEIGHBOURS = 14, 6


@dataclass(frozen=True)
class Sample:
    """Motion and torque at K instants: what is measured, or what it would be without a mistake.

    Attributes:
        q, qd, qdd: (K, n) low-passed motion.
        tau: (K, n) low-passed torque [N m].
        sigma: (n,) by how much a right model may miss each joint's torque [N m].
    """

    q: Array
    qd: Array
    qdd: Array
    tau: Array
    sigma: Array

    def with_order(self, joints: list[int], fields: Sequence[str]) -> Sample:
        """Return the sample with the columns of some fields in another order."""
        return replace(self, **{name: getattr(self, name)[..., joints] for name in fields})

    def with_motion(self, factor: Array | float) -> Sample:
        """Return the sample with its motion multiplied by a factor, one for all or (n,)."""
        return replace(self, q=factor * self.q, qd=factor * self.qd, qdd=factor * self.qdd)

    def with_torque(self, factor: Array | float) -> Sample:
        """Return the sample with its torque multiplied by a factor, one for all or (n,)."""
        return replace(self, tau=factor * self.tau, sigma=np.abs(factor) * self.sigma)

    def thinned(self, every: int) -> Sample:
        """Return every so many of the instants."""
        return replace(self, **{name: getattr(self, name)[::every] for name in (*MOTION, "tau")})


@dataclass(frozen=True)
class Fit:
    """One fit.

    Attributes:
        cost: what was minimised, over the number of joints and independent samples.
        residual: (K, n) torque that is not explained [N m].
        friction: (n, 4) Coulomb, viscous, offset and armature of each joint.
        thetas: (n, 10) the links.
        extra, error: (e,) coefficients of further columns, and their standard errors.
    """

    cost: float
    residual: Array
    friction: Array
    thetas: Array
    extra: Array
    error: Array


class ModelFit:
    """A log as the checks see it, and its fits to the model.

    Args:
        pieces: of one log.
        cutoff: of the low-pass [Hz]; None chooses it from the data.
        divided: (n,) scale that torques were divided by already; None for one.

    Attributes:
        sample: what is measured.
        time: (K,) when [s].
        jerk: (K, n) third derivative of the position.
        noise: (n,) standard deviation of what noise is left in the low-passed torque [N m].
        cutoff: of the low-pass [Hz].
        links: (n, 10) the model's links.
        model_torque: (K, n) what the model says of the motion as recorded, without friction.
    """

    def __init__(
        self,
        robot: RobotModel,
        pieces: Sequence[Measurement],
        cutoff: float | None = None,
        divided: Sequence[float] | Array | None = None,
    ) -> None:
        self.robot, self.pieces = robot, tuple(pieces)
        self.divided = np.ones(robot.n_joints) if divided is None else np.array(divided)
        parts, noises, count = [], [], max(FEWEST, INSTANTS // len(pieces))
        self._torques: list[tuple[Array, Array, Array]] = []
        self._kept: dict[tuple[object, ...], tuple[Array, Array, Array]] = {}
        for piece in pieces:
            signals = process(piece, robot.joint_names, cutoff)
            smooth, lost = signals.low_pass.filtered(signals.tau), signals.low_pass.half_width
            inner = slice(lost, len(signals) - lost)
            at = lost + _instants(signals.time[inner], signals.bridged[inner], count)
            self._torques.append((signals.time[at], signals.time[inner], smooth))
            third = 0.5 * signals.rate * (signals.qdd[at + 1] - signals.qdd[at - 1])
            parts.append([signals.time[at], signals.q[at], signals.qd[at], signals.qdd[at], third])
            rest = [np.std(raw - low) for raw, low in zip(signals.tau[inner].T, smooth.T)]
            noises.append(np.multiply(rest, np.sqrt(np.sum(signals.low_pass.kernel**2))))
            self.cutoff = signals.cutoff
            del signals  # before the next piece's are made, which take as much memory
        self.time, q, qd, qdd, self.jerk = (np.concatenate(same) for same in zip(*parts))
        tau = self.later(np.zeros(robot.n_joints))
        self.noise = np.sqrt(np.mean(np.square(noises), axis=0))
        usual = rms(tau)
        usual = np.maximum(usual, _LEAST * float(np.max(usual)))
        self.sample = Sample(q, qd, qdd, tau, np.hypot(TOLERANCE * usual, self.noise))
        self._dynamics = {False: LinkDynamics(robot), True: LinkDynamics(robot, np.zeros(3))}
        self._beyond, self.links = BeyondRigidBodies(robot), robot.thetas
        rotors = np.outer(robot.armature, [0.0, 0.0, 0.0, 1.0])
        self._start = np.append(self.links, rotors)
        self._scales = _link_scales(robot)
        self.model_torque = self.torque(self.sample, self.links) + self._springs(q, qd)

    def torque(self, sample: Sample, links: Array, weightless: bool = False) -> Array:
        """Return (K, n) the torque of links (n, 10), without friction, armature and springs."""
        motion = self._dynamics[weightless].motion(sample.q, sample.qd, sample.qdd)
        return motion.torque(links)

    def later(self, delays: Array) -> Array:
        """Return (K, n) each joint's torque at later instants, by (n,) how much later [s]."""
        return np.concatenate(
            [
                np.column_stack([np.interp(at + d, time, tau) for d, tau in zip(delays, torque.T)])
                for at, time, torque in self._torques
            ]
        )

    def fit(
        self,
        sample: Sample | None = None,
        extra: Array | None = None,
        prior: Sequence[float] | Array = (),
        weightless: bool = False,
        known_links: bool = False,
        only_friction: bool = False,
    ) -> Fit:
        """Fit one sample; None for what is measured.

        Args:
            extra: (K, n, e) further columns.
            prior: (e,) standard deviations of their coefficients.
            known_links: whether all links but the terminal one are taken to be right.
            only_friction: whether there is nothing but friction, neither links nor rotors.
        """
        sample = sample or self.sample
        count, n = sample.q.shape
        rows, squares, springs = self._rows(sample, weightless)
        if extra is not None:
            crossed = _squares(rows, extra)
            turned = np.swapaxes(crossed, 1, 2)
            squares = np.block([[squares, crossed], [turned, _squares(extra, extra)]])
            rows = np.concatenate((rows, extra), axis=2)
        bodies = float(not only_friction)
        scales = bodies * self._scales
        scales[:-1] *= not known_links
        own = np.tile([1.0, 1.0, 1.0, bodies], n)
        start = np.append(bodies * self._start, np.zeros(len(prior)))
        spread = np.concatenate((scales.ravel(), own * _friction_spread(sample), prior))
        right = sample.tau - springs - rows @ start
        weight = INDEPENDENT / count / sample.sigma**2
        # Least squares in units of the priors, around the model.
        normal = np.tensordot(weight, squares, 1) * np.outer(spread, spread)
        unit, last = np.eye(len(spread)), slice((10 + N_FRICTION) * n, None)
        pull = spread * ((right * weight).ravel() @ rows.reshape(-1, len(spread)))
        solved = np.linalg.solve(normal + unit, np.column_stack((pull, unit[:, last])))
        off, error = solved[:, 0], spread[last] * np.sqrt(np.diag(solved[last, 1:]))
        residual = right - rows @ (spread * off)
        cost = float(np.sum(residual**2 @ weight) + off @ off) / INDEPENDENT
        thetas, terms, extras = np.split(start + spread * off, (10 * n, (10 + N_FRICTION) * n))
        found = terms.reshape(n, N_FRICTION), thetas.reshape(n, 10), extras, error
        return Fit(cost / n, residual, *found)

    def least_costs(self, samples: Sequence[Sample]) -> Array:
        """Return what fits of some samples (h,), of the same instants, cost at least.

        Sums of neighbours' equations, over the root of their number, are orthonormal: no more is
        left of them than of all. In units of priors and tolerances, with A x = b for them,
        min |b - A x|^2 + |x|^2 = b^T (1 + A A^T)^-1 b.
        """
        (count, n), costs = samples[0].q.shape, []
        first = np.linspace(0, count - _NEIGHBOURS, min(_GROUPS, count // _NEIGHBOURS)).astype(int)
        at, motions = np.add.outer(first, np.arange(_NEIGHBOURS)), {id(s.q): s for s in samples}
        some = ([getattr(m, name)[at.ravel()] for m in motions.values()] for name in MOTION)
        q, qd, qdd = map(np.concatenate, some)
        friction = [_friction_columns(each)[at.ravel()] for each in motions.values()]
        links = self._dynamics[False].motion(q, qd, qdd).columns(range(n))
        parts, shape = (links, np.concatenate(friction)), (len(motions), *at.shape, n, -1)
        rows = np.concatenate([each.reshape(shape).sum(axis=2) for each in parts], axis=3)
        springs = self._springs(q, qd).reshape(shape).sum(axis=2)
        known = dict(zip(motions, zip(rows, rows @ self._start + springs[..., 0])))
        for sample in samples:
            columns, own = known[id(sample.q)]
            weight = np.sqrt(INDEPENDENT / count / _NEIGHBOURS) / sample.sigma[:, None]
            spread = np.append(self._scales, _friction_spread(sample))
            scaled = (columns * weight * spread).reshape(-1, len(spread))
            right = ((sample.tau[at].sum(axis=1) - own) * weight[:, 0]).ravel()
            costs.append(right @ np.linalg.solve(scaled @ scaled.T + np.eye(len(right)), right))
        return np.array(costs) / (n * INDEPENDENT)

    def _rows(self, sample: Sample, weightless: bool) -> tuple[Array, Array, Array]:
        """Return rows (K, n, 14 n) of links and friction, their ``_squares``, and ``_springs``."""
        # Those of the last motions are kept: many mistakes that are tried leave them as they are.
        motion = sample.q, sample.qd, sample.qdd
        key = (weightless, *(each.tobytes() for each in motion))
        if key not in self._kept:
            links = self._dynamics[weightless].motion(*motion).columns(range(len(self.links)))
            rows = np.concatenate((links, _friction_columns(sample)), axis=2)
            self._kept = dict([*self._kept.items()][-_MOTIONS:])
            self._kept[key] = rows, _squares(rows, rows), self._springs(sample.q, sample.qd)
        self._kept[key] = self._kept.pop(key)
        return self._kept[key]

    def explained(self, sample: Sample, found: Fit) -> Array:
        """Return (K, n) the torque of a fit, springs left out, along a motion."""
        friction = _friction_columns(sample) @ found.friction.ravel()
        return self.torque(sample, found.thetas) + friction

    def _springs(self, q: Array, qd: Array) -> Array:
        """Return (K, n) the torque of springs, tendons and actuators."""
        return self._beyond.torque(q, qd, np.zeros_like(q))

    def plausible(self, found: Fit, heaviest: float = HEAVIEST) -> bool:
        """Return whether a terminal link's mass could be that of a link with a payload."""
        arm = float(np.sum(self.links[:, 0]))
        share, own = float(found.thetas[-1, 0]) / arm, float(self.links[-1, 0]) / arm
        # An arm of one joint is all terminal link; one of two often is half of it.
        return LIGHTEST < share < max(heaviest, own + PAYLOAD)


def _instants(time: Array, bridged: NDArray[np.bool_], count: int) -> NDArray[np.int64]:
    """Return about so many instants of a piece, as (K,) indices, apart from its ends."""
    reach = (time + DELAYS[0] >= time[0]) & (time + DELAYS[1] <= time[-1])
    there = np.flatnonzero(reach & ~bridged)
    return there[np.unique(np.linspace(0, len(there) - 1, count).astype(int))]


def _friction_spread(sample: Sample) -> Array:
    """Return (4 n,) how large friction may be: up to about what the joint carries."""
    usual = sample.sigma / TOLERANCE
    speed, turning = rms(sample.qd), rms(sample.qdd)
    viscous = usual / np.where(speed > 0.0, speed, 1.0)
    armature = 0.5 * usual / np.where(turning > 0.0, turning, 1.0)
    return np.column_stack((usual, viscous, 0.5 * usual, armature)).ravel()


def _squares(rows: Array, others: Array) -> Array:
    """Return (n, p, r) the sum over instants of each joint's rows (K, n, p) by others (K, n, r)."""
    return np.asarray(rows.transpose(1, 2, 0) @ np.swapaxes(others, 0, 1))


def _friction_columns(sample: Sample) -> Array:
    """Return (K, n, 4 n) Coulomb, viscous, offset and armature of each joint."""
    count, n = sample.q.shape
    sign = friction_sign(sample)
    columns, joints = np.zeros((count, n, n, N_FRICTION)), np.arange(n)
    own = np.stack((sign, sample.qd, np.ones_like(sign), sample.qdd), axis=2)
    columns[:, joints, joints] = own
    return columns.reshape(count, n, -1)


def friction_sign(sample: Sample, lag: float = 0.0) -> Array:
    """Return (K, n) the direction of dry friction, or what it was some time before [s]."""
    slow = slow_speed(sample.qd)
    speed = sample.qd - lag * sample.qdd
    return np.clip(speed / np.where(slow > 0.0, slow, 1.0), -1.0, 1.0)


def slow_speed(qd: Array) -> Array:
    """Return (n,) below which of its speeds (K, n) a joint's friction has no sure direction."""
    return _SLOW * np.asarray(np.max(np.abs(qd), axis=0))


def _link_scales(robot: RobotModel) -> Array:
    """Return (n, 10) how far each link's parameters may be off."""
    masses = np.array([max(float(link.theta[0]), 0.0) for link in robot.links])
    total, reach = float(np.sum(masses)), sum(np.linalg.norm(b.translation) for b in robot.links)
    lengths = [_length(link.theta) if m > 0.0 else 0.0 for link, m in zip(robot.links, masses)]
    scales = [LINK_ERROR * parameter_scale(*pair) for pair in zip(masses.tolist(), lengths)]
    scales[-1] = parameter_scale(PAYLOAD * total, max(_REACH * float(reach), lengths[-1]))
    return np.array(scales)


def _length(theta: Array) -> float:
    """Return the size of a link: of its body, and of where that stands."""
    return max(characteristic_length(theta), float(np.linalg.norm(com_from_theta(theta)[1])))


def rms(values: Array) -> Array:
    """Return (n,) the root mean square over samples (K, n)."""
    return np.asarray(np.sqrt(np.einsum("kn,kn->n", values, values) / len(values)))


def fall(base: Fit, after: Fit) -> float:
    """Return by how much chi-squared is less in another fit."""
    return (base.cost - after.cost) * len(base.friction) * INDEPENDENT


def explains(base: Fit, after: Fit, certain: bool = True) -> bool:
    """Return whether a log fits so much better without a mistake that it was made: less of it is
    enough where it is not certain that the log as it is has a possible terminal link.
    """
    enough = fall(base, after) > (CLEARLY if certain else LIKELY)
    return enough and (after.cost < WELL or after.cost < BETTER * base.cost)
