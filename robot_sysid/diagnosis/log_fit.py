"""A log's fit with the columns of explanations beside those of its own terms.

Throughout, K is the number of rows of all recordings, J that of joints with equations, p that of
parameters.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.equations import names_of, split_name
from robot_sysid.dynamics.inverse_dynamics import gravity_vector
from robot_sysid.estimate.choose import solved
from robot_sysid.estimate.fit import Equations, Fit, correlation_times, fit, solve
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.questions import Question
from robot_sysid.estimate.rows import Mask, Part, Recording, Sums, add_up
from robot_sysid.estimate.terms import LINKS, ArmTerms, Point, Prior, Term
from robot_sysid.records import Array, RobotModel

LEAST_TORQUE = 0.02
"""Least typical torque of a joint, as a share of the strongest joint's."""
LOADED = 0.1
"""Least model torque of a joint that links load, over that of the most loaded one."""
HEAVIEST = 0.6
"""Largest mass of a plausible last link, as a share of the arm's mass."""
FAR = 40.0
"""Squared deviation of the other links from the model that no log reaches with the right model."""


@dataclass(frozen=True)
class LogRows:
    """The rows of a log: columns of all terms, and their sums.

    Attributes:
        arm: all terms.
        recordings: the pieces of the log.
        point: around which terms were linearised.
        sums: of all rows.
        columns: (K, J, p) torque per unit of each parameter.
        right_sides: (K, J) measured torque without that of springs and tendons [N m].
        used: (K, J) which rows count.
    """

    arm: ArmTerms
    recordings: tuple[Recording, ...]
    point: Point
    sums: Sums
    columns: Array
    right_sides: Array
    used: Mask

    @property
    def torque(self) -> Array:
        """Measured torque (K, J), low-passed [N m]."""
        torque = np.concatenate([recording.torque for recording in self.recordings])
        return np.asarray(torque[:, self.arm.indices])

    @property
    def moving(self) -> list[int]:
        """Numbers of the joints that move fast enough for some row to count."""
        counts = np.sum(self.sums.counts, axis=0)
        return [int(self.arm.indices[row]) for row in np.flatnonzero(counts)]

    @property
    def held(self) -> Array:
        """Values (p,) of parameters that are not estimated: the model's."""
        return np.array([self.arm.model.get(name, 0.0) for name in self.sums.names])

    @cached_property
    def typical_torque(self) -> Array:
        """Root mean square torque (J,), at least ``LEAST_TORQUE`` of the largest [N m]."""
        torque = np.sqrt(np.mean(self.right_sides**2, axis=0))
        return np.maximum(torque, LEAST_TORQUE * float(np.max(torque)))

    def torque_of(self, names: Sequence[str], values: Array) -> Array:
        """Return the torque (K, J) of named parameters with values [N m]."""
        at = [self.sums.names.index(name) for name in names]
        return np.asarray(self.columns[:, :, at] @ values)

    def residuals(self, fitted: Fit) -> Array:
        """Return the residual torque (K, J) of a fit [N m]; NaN where a row is not used."""
        at = np.flatnonzero(fitted.full)
        predicted = self.columns[:, :, at] @ fitted.full[at]
        return np.where(self.used, self.right_sides - predicted, np.nan)

    def with_torque(self, torque: Array) -> LogRows:
        """Return the rows with other measured torques (K, J) [N m], added up as one block."""
        right_sides = self.right_sides + torque - self.torque
        grams = []
        for joint, columns in enumerate(self.sums.columns):
            used = self.used[:, joint]
            b = right_sides[used, joint]
            gram = self.sums.totals[joint].copy()
            gram[:-1, -1] = gram[-1, :-1] = self.columns[used, joint][:, columns].T @ b
            gram[-1, -1] = b @ b
            grams.append(gram[None])
        counts = np.sum(self.sums.counts, axis=0, keepdims=True)
        sums = replace(
            self.sums, grams=tuple(grams), counts=counts, logs=self.sums.logs[:1]
        )
        return replace(self, sums=sums, right_sides=right_sides)

    def fit(
        self,
        terms: Sequence[Term],
        like: Fit,
        correlation: Array | None = None,
        is_alike: bool = True,
    ) -> Fit:
        """Return the fit of terms to a question that has been asked before.

        Args:
            terms: of the question.
            like: a fit of it; noise begins with its noise, where it ``is_alike``.
            correlation: (J,) rows that count as one; those of ``like`` by default.
            is_alike: whether the other fit's noise and correlation tell something of this one.
        """
        if correlation is None and is_alike:
            correlation = like.correlation
        return fit(
            self.arm,
            self.recordings,
            self.point,
            self.sums,
            terms,
            noise=like.noise if is_alike else None,
            correlation=correlation,
            possible=False,
            question=like.question,
        )


def log_rows(
    arm: ArmTerms,
    recordings: Sequence[Recording],
    point: Point,
    more: Sequence[Term] = (),
) -> LogRows:
    """Return the rows of recordings, with the columns of more terms beside the arm's."""
    arm = copy.copy(arm)
    arm.terms = {**arm.terms, **{term.names[0]: term for term in more}}
    arm.names = tuple(name for term in arm.terms.values() for name in term.names)
    chunks = []

    def make(part: Part) -> tuple[Array, Array, Mask]:
        """Return the columns, right-hand sides and mask of used rows of a part."""
        columns = [term.columns(part, point) for term in arm.terms.values()]
        tau = part.recording.torque[part.rows][:, arm.indices] - arm.known(part)
        used = part.recording.used[part.rows][:, arm.indices]
        chunks.append((np.concatenate(columns, axis=2), tau, used))
        return chunks[-1]

    sums = add_up(recordings, arm.names, arm.joints, make)
    columns, tau, used = map(np.concatenate, zip(*chunks))
    return LogRows(arm, tuple(recordings), point, sums, columns, tau, used)


def with_term(terms: Sequence[Term], added: Term) -> list[Term]:
    """Return a question with one more term; its prior widens that of parameters that it has."""
    wider = []
    is_new = True
    for term in terms:
        if added.names[0] in term.names and term.prior is not None:
            at = [term.names.index(name) for name in added.names]
            covariance = term.prior.factor @ term.prior.factor.T
            assert added.prior is not None
            covariance[np.ix_(at, at)] += added.prior.factor @ added.prior.factor.T
            factor = np.asarray(np.linalg.cholesky(covariance), dtype=float)
            term = replace(term, prior=Prior(term.prior.mean, factor))
            is_new = False
        wider.append(term)
    return [*wider, added] if is_new else wider


def unbounded(fitted: Fit) -> tuple[Array, Array]:
    """Return (values (k,), standard errors (k,)) of a fit without bounds, by formal errors."""
    equations = fitted.equations
    normal = equations.data(fitted.weights) + equations.prior
    values, inverse = solve(normal, equations.usual)
    return values, np.sqrt(np.maximum(np.diag(inverse), 0.0))


def coulomb_indices(fitted: Fit) -> NDArray[np.int64]:
    """Return the indices of Coulomb friction; a joint that stands still has none."""
    names = names_of("coulomb", fitted.arm.joints)
    return fitted.at([name for name in names if name in fitted.names])


def dry_friction(fitted: Fit) -> tuple[Array, Array]:
    """Return Coulomb friction (J,) without its bound and its standard error [N m].

    That of a joint that stands still is zero, its error infinite.
    """
    joints = fitted.arm.joints
    dry = np.zeros(len(joints))
    error = dry + np.inf
    values, errors = unbounded(fitted)
    for k in coulomb_indices(fitted):
        row = joints.index(split_name(fitted.names[k])[1])
        dry[row] = values[k]
        error[row] = errors[k]
    return dry, error


def evidence(fitted: Fit) -> float:
    """Return the log marginal likelihood of a log: dry friction that drives a joint is unlikely."""
    from scipy.special import log_ndtr

    dry, error = dry_friction(fitted)
    return fitted.log_evidence + float(np.sum(log_ndtr(dry / error)))


def fixed_evidence(rows: LogRows, terms: Sequence[Term], like: Fit) -> float:
    """Return the log marginal likelihood of terms with the noise of a fit, up to a constant."""
    equations = Equations(rows.sums, terms, rows.held)
    normal = equations.data(like.weights) + equations.prior
    values, inverse = solve(normal, equations.usual)
    change = np.append(-values, 1.0)
    misfit = float(change @ normal @ change)
    return float(0.5 * (np.linalg.slogdet(inverse)[1] - misfit) - equations.log_prior)


@dataclass(frozen=True)
class LogFit:
    """A log's fit and its rows."""

    fit: Fit
    rows: LogRows

    @classmethod
    def of(
        cls,
        robot: RobotModel,
        recordings: Sequence[Recording],
        options: EstimationOptions,
    ) -> LogFit:
        """Return the fit of recordings with all that they decide on the question of the arm."""
        # A log is judged with the friction that arms have, whatever is asked of it.
        usual = replace(options, friction_model=None, no_friction=False)
        fitted = solved(robot, recordings, Question(usual))
        return cls(fitted, log_rows(fitted.arm, recordings, fitted.point))

    @cached_property
    def misfit_by_joint(self) -> Array:
        """Unexplained torque (J,), as a share of each joint's: the part that is no white noise.

        Successive rows of white noise behind a low-pass hardly correlate, on average of two lags.
        """
        residual = np.nan_to_num(self.rows.residuals(self.fit))
        power = np.mean(residual**2, axis=0)
        slow = 0.5 * np.mean(residual[1:-1] * (residual[:-2] + residual[2:]), axis=0)
        return np.sqrt(np.clip(slow, 0.0, power)) / self.rows.typical_torque

    @property
    def misfit(self) -> float:
        """Unexplained torque of all joints, as a share of all torque."""
        typical = self.rows.typical_torque
        slow = np.linalg.norm(self.misfit_by_joint * typical)
        return float(slow / np.linalg.norm(typical))

    @cached_property
    def model_torque(self) -> Array:
        """Root mean square torque (J,) of the model's links [N m]."""
        arm = self.fit.arm
        parts = [
            recording.links_torque(
                arm.robot, gravity_vector(arm.robot), arm.robot.thetas
            )
            for recording in self.fit.recordings
        ]
        torque = np.concatenate(parts)[:, arm.indices]
        return np.asarray(np.sqrt(np.mean(torque**2, axis=0)))

    @property
    def links_ratio(self) -> tuple[float, float]:
        """Ratio of the torque of the fitted links to the model's, and its standard error.

        It is that of the median loaded joint. The last link does not count: what is bolted to it
        may be heavy.
        """
        sums = self.fit.sums
        links = [term for term in self.fit.equations.terms if term.cause == LINKS]
        if not links:
            return 1.0, 0.0
        names = links[0].names
        at = self.fit.at(names)
        model = np.array([self.fit.arm.model[name] for name in names])
        places = [sums.names.index(name) for name in names]
        sizes = []
        for columns, total in zip(sums.columns, sums.totals):
            gram = np.zeros((len(sums.names), len(sums.names)))
            gram[np.ix_(columns, columns)] = total[:-1, :-1]
            gram = gram[np.ix_(places, places)]
            pull = gram @ self.fit.free[at]
            own = np.sqrt(max(float(self.fit.free[at] @ pull), 0.0))
            size = np.sqrt(max(float(model @ gram @ model), 0.0))
            error = np.sqrt(
                max(float(pull @ self.fit.inverse[np.ix_(at, at)] @ pull), 0.0)
            )
            sizes.append((size, own, error / max(own, 1e-12)))
        largest = max(sizes)[0]
        ratios = []
        for size, own, error in sizes:
            if size > LOADED * largest:
                ratios.append((own / size, error / size))
        ratios.sort()
        return ratios[len(ratios) // 2] if ratios else (1.0, 0.0)

    @property
    def torque_ratio(self) -> Array:
        """Ratio (J,) of root mean square measured torque to that of the model's links."""
        measured = np.sqrt(np.mean(self.rows.torque**2, axis=0))
        return np.asarray(measured / np.maximum(self.model_torque, 1e-12))

    @property
    def loaded(self) -> Mask:
        """Which joints (J,) links load: more than ``LOADED`` of the most loaded one."""
        return self.model_torque > LOADED * np.max(self.model_torque)

    @property
    def last_mass(self) -> tuple[float, float]:
        """The last link's mass and its standard error [kg]."""
        at = self.fit.names.index("m")
        return float(self.fit.free[at]), float(np.sqrt(self.fit.inverse[at, at]))

    @property
    def is_plausible(self) -> bool:
        """Whether the last link's mass is that of a link, and the others are near the model's.

        The mass has to lie, within two standard errors, between zero and the larger of two limits:
        ``HEAVIEST`` of the arm's mass, and the model's mass plus 30 % of the arm's.
        """
        robot = self.fit.arm.robot
        largest = max(HEAVIEST * robot.mass, robot.prior.mass + 0.3 * robot.mass)
        mass, error = self.last_mass
        is_possible = mass + 2.0 * error > 0.0 and mass - 2.0 * error < largest
        strain = 0.0
        for term, span in zip(self.fit.equations.terms, self.fit.equations.spans):
            if term.cause == LINKS and term.prior is not None:
                rows = term.prior.rows
                strain = float(
                    np.sum((rows[:, :-1] @ self.fit.free[span] - rows[:, -1]) ** 2)
                )
        return is_possible and strain < FAR


def gain_of(log: LogFit, corrected: LogFit, density: Array | float = 0.0) -> float:
    """Return by how much a corrected log is likelier than a log, with the noise of the former.

    ``density`` (J,): logarithm of the factor by which torques were divided.
    """
    correlation = np.minimum(
        correlation_times(corrected.rows.residuals(corrected.fit)), log.fit.correlation
    )
    after = corrected.rows.fit(
        corrected.fit.equations.terms, corrected.fit, correlation
    )
    before = log.rows.fit(log.fit.equations.terms, log.fit, correlation)
    independent = np.sum(log.rows.sums.counts, axis=0) / correlation
    volume = -float(np.sum(independent * density))
    # A parameter without a prior is unknown in proportion to the torque, not in its unit.
    of_joint = dict(zip(log.fit.arm.joints, np.broadcast_to(density, len(correlation))))
    for term in after.equations.terms:
        if term.prior is None:
            for name in term.names:
                joint = name.partition("[")[2].rstrip("]")
                volume += float(of_joint.get(joint, np.mean(density)))
    return evidence(after) - evidence(before) + volume
