"""A log's fit with the columns of explanations beside those of its own terms.

Throughout, K is the number of rows of all recordings, J that of joints with equations, p that of
parameters.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from typing import Any

import numpy as np

from robot_sysid.dynamics.equations import names_of
from robot_sysid.estimate.choose import solved
from robot_sysid.estimate.fit import Fit, correlation_times, fit, solve
from robot_sysid.estimate.options import EstimationOptions, Priors
from robot_sysid.estimate.questions import Question
from robot_sysid.estimate.rows import Mask, Recording, Rows, Sums, add_up
from robot_sysid.estimate.terms import LAST_LINK, LINKS, ArmTerms, Point, Term
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.usual_errors import SCALE

LEAST_TORQUE = 0.02
"""Least typical torque of a joint, as a share of the strongest joint's."""
LOADED = 0.1
"""Least model torque of a joint that links load, over that of the most loaded one."""
HEAVIEST = 0.6
"""Largest mass of a plausible last link, as a share of the arm's mass."""
FAR = 40.0
"""Squared deviation of the other links from the model that no log reaches with the right model."""


def typical_torque(sums: Sums) -> Array:
    """Return the root mean square torque (J,), at least ``LEAST_TORQUE`` of the largest [N m]."""
    torque = sums.rms_torque
    return np.maximum(torque, LEAST_TORQUE * np.max(torque))


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

    @cached_property
    def typical_torque(self) -> Array:
        """``typical_torque`` (J,) of the rows."""
        return typical_torque(self.sums)

    @cached_property
    def joined(self) -> Sums:
        """The sums with all blocks as one."""
        return replace(
            self.sums,
            grams=tuple(total[None] for total in self.sums.totals),
            counts=np.sum(self.sums.counts, axis=0, keepdims=True),
            logs=self.sums.logs[:1],
        )

    def torque_of(self, names: Iterable[str], values: Array) -> Array:
        """Return the torque (K, J) of named parameters with values [N m]."""
        at = [self.sums.names.index(name) for name in names]
        return self.columns[:, :, at] @ values

    def residuals(self, fitted: Fit) -> Array:
        """Return the residual torque (K, J) of a fit [N m]; NaN where a row is not used."""
        is_set = fitted.full != 0.0
        names = compress(fitted.sums.names, is_set)
        predicted = self.torque_of(names, fitted.full[is_set])
        return np.where(self.used, self.right_sides - predicted, np.nan)

    def fit(
        self, terms: Sequence[Term], like: Fit, correlation: Array | None = None
    ) -> Fit:
        """Return the fit of terms to a question that has been asked before.

        Args:
            terms: of the question.
            like: a fit of it.
            correlation: (J,) rows that count as one; those of ``like`` by default.
        """
        return fit(
            self.arm,
            self.recordings,
            self.point,
            self.joined,
            terms,
            noise=like.noise,
            correlation=like.correlation if correlation is None else correlation,
            possible=False,
            question=like.question,
        )


def root_mean_square(torque: Array) -> Array:
    """Return the root mean square (J,) of torques (K, J)."""
    return np.sqrt(np.mean(torque**2, axis=0))


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

    def make(rows: Rows) -> tuple[Array, Array, Mask]:
        """Return the columns, right-hand sides and mask of used rows of a chunk."""
        chunks.append(arm.equations(rows, point))
        return chunks[-1]

    sums = add_up(recordings, arm.names, arm.joints, make)
    columns, tau, used = map(np.concatenate, zip(*chunks))
    return LogRows(arm, tuple(recordings), point, sums, columns, tau, used)


def dry_friction(fitted: Fit) -> tuple[Array, Array]:
    """Return Coulomb friction (J,) without its bound and its standard error [N m].

    That of a joint that stands still is zero, its error infinite.
    """
    joints = fitted.arm.joints
    dry = np.zeros(len(joints))
    error = dry + np.inf
    equations = fitted.equations
    values, inverse = solve(equations.normal(fitted.weights), equations.reference)
    for joint, name in enumerate(names_of("coulomb", joints)):
        if name in fitted.names:
            at = fitted.names.index(name)
            dry[joint] = values[at]
            error[joint] = np.sqrt(max(inverse[at, at], 0.0))
    return dry, error


def evidence(fitted: Fit) -> float:
    """Return the log marginal likelihood of a log: dry friction that drives a joint is unlikely."""
    from scipy.special import log_ndtr

    dry, error = dry_friction(fitted)
    return fitted.log_evidence + np.sum(log_ndtr(dry / error))


def wide_priors(priors: Priors) -> Priors:
    """Return priors that are no narrower than the default ones."""
    usual = vars(Priors())
    names = ("link", "zero", "gravity", "delay", "friction")
    wide: dict[str, Any] = {
        name: max(vars(priors)[name], usual[name]) for name in names
    }
    if priors.scale is not None:
        scales = np.maximum(np.ravel(priors.scale), SCALE)
        wide["scale"] = tuple(scales.tolist())
    return replace(priors, **wide)


@dataclass(frozen=True)
class LogFit:
    """A log's fit and its rows.

    Attributes:
        fit: of the log.
        rows: of the log, with the columns of all terms.
        options: prior uncertainties of the estimate, as the user gave them.
        found: explanations that act in the log.
    """

    fit: Fit
    rows: LogRows
    options: EstimationOptions
    found: tuple[Term, ...]

    @classmethod
    def of(
        cls,
        robot: RobotModel,
        recordings: Sequence[Recording],
        options: EstimationOptions,
        found: tuple[Term, ...] = (),
    ) -> LogFit:
        """Return the fit of recordings with all that they decide on the question of the arm.

        A log is judged with the friction that arms have, and with the default priors where the
        user's are smaller, whatever is asked of it. ``found`` are explanations that act as well.
        """
        usual = replace(
            options,
            friction_model=None,
            no_friction=False,
            priors=wide_priors(options.priors),
        )
        fitted = solved(robot, recordings, Question(usual))
        rows = log_rows(fitted.arm, fitted.recordings, fitted.point, found)
        if found:
            fitted = rows.fit([*fitted.equations.terms, *found], fitted)
        return cls(fitted, rows, options, found)

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
    def links_torque(self) -> Array:
        """Torque (K, J) of the model's links [N m]."""
        arm = self.rows.arm
        links = [arm.terms[name] for name in (LAST_LINK, LINKS) if name in arm.terms]
        names = [name for term in links for name in term.names]
        values = np.array([arm.model[name] for name in names])
        return self.rows.torque_of(names, values)

    @property
    def model_torque(self) -> Array:
        """Root mean square torque (J,) of the model's links [N m]."""
        return root_mean_square(self.links_torque)

    @property
    def torque_ratio(self) -> Array:
        """Ratio (J,) of root mean square measured torque to that of the model's links."""
        measured = root_mean_square(self.rows.right_sides)
        return measured / np.maximum(self.model_torque, 1e-12)

    @property
    def loaded(self) -> Mask:
        """Which joints (J,) links load: more than ``LOADED`` of the most loaded hinge.

        The force of a slide is in another unit, and exceeds the torques of an arm that it carries.
        """
        torque = self.model_torque
        is_slide = self.fit.arm.robot.is_slide[self.fit.arm.indices]
        return torque > LOADED * np.max(torque[~is_slide], initial=0.0)

    @property
    def last_mass(self) -> tuple[float, float]:
        """The last link's mass and its standard error [kg]."""
        at = self.fit.names.index("m")
        return self.fit.free[at], np.sqrt(self.fit.inverse[at, at])

    @property
    def is_plausible(self) -> bool:
        """Whether the last link's mass is that of a link, and the others are near the model's.

        The mass has to lie, within two standard errors, between zero and the larger of two limits:
        ``HEAVIEST`` of the arm's mass, and the model's mass plus 30 % of the arm's.
        """
        robot = self.fit.arm.robot
        largest = max(HEAVIEST * robot.mass, robot.prior.mass + 0.3 * robot.mass)
        mass, error = self.last_mass
        is_possible = -2.0 * error < mass < largest + 2.0 * error
        for term, span in zip(self.fit.equations.terms, self.fit.equations.spans):
            if term.cause == LINKS and term.prior is not None:
                values = np.append(self.fit.free[span], -1.0)
                is_possible &= np.sum((term.prior.rows @ values) ** 2) < FAR
        return is_possible


def compare(
    before: LogFit, after: LogFit, density: Array | float = 0.0
) -> tuple[float, LogFit]:
    """Return by how much the second of two fits is likelier, and it with the noise it leaves.

    A fault makes noise slow, and hides in it: both are compared with the noise of the second.
    ``density`` (J,): logarithm of the factor by which its torques were divided.
    """
    correlation = correlation_times(after.rows.residuals(after.fit))
    correlation = np.minimum(correlation, before.fit.correlation)
    terms = after.fit.equations.terms
    refitted = after.rows.fit(terms, after.fit, correlation)
    old = before.rows.fit(before.fit.equations.terms, before.fit, correlation)
    gain = evidence(refitted) - evidence(old)
    # A parameter without a prior is unknown in proportion to the torque, not in its unit.
    unknowns = sum(len(term.names) for term in terms if term.prior is None)
    independent = np.sum(before.rows.sums.counts, axis=0) / correlation
    gain += unknowns * np.mean(density) - np.sum(independent * density)
    return gain, replace(after, fit=refitted)
