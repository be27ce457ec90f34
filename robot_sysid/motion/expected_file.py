"""How far off the written model file will be on any motion, before any torque is measured.

Any motion is one of those that are made up all over the arm's range (``elsewhere``). What is not as
the model says are all terms of the fit, each as large as it usually is before a log; a file holds
some of them, and the recording of a planned motion decides how well (``file_errors``).

Shapes: J joints with equations; p parameters in the sums, P of them unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

import robot_sysid.records.usual_errors as usual_errors
from robot_sysid.dynamics.friction import OFFSET, ROTOR
from robot_sysid.estimate.fit import Equations, Fit
from robot_sysid.estimate.links import EXPECTED, link_factor
from robot_sysid.estimate.options import (
    FILE_FRICTION,
    FILE_LINKS,
    FILE_ROTORS,
    EstimationOptions,
)
from robot_sysid.estimate.questions import (
    PER_CENT,
    Question,
    arm_question,
    usual_offset,
)
from robot_sysid.estimate.rows import Sums
from robot_sysid.estimate.terms import (
    DELAY,
    FRICTION,
    FURTHER_FRICTION,
    LAST_LINK,
    LINKS,
    MOTORS,
    ArmTerms,
    Prior,
    Term,
    independent,
)
from robot_sysid.motion.elsewhere import (
    highest_speed,
    made_up_motions,
    sums_elsewhere,
    without_constant,
)
from robot_sysid.motion.file_errors import FileErrors
from robot_sysid.motion.prediction import ExpectedFile
from robot_sysid.motion.problem import ExcitationProblem
from robot_sysid.records import Array, Motion
from robot_sysid.records.option_fields import DEFAULT_MAX_VELOCITY


def judging_speeds(problem: ExcitationProblem) -> Array:
    """Return the highest speeds (n,) of the motions that a file is judged on [rad/s or m/s].

    They are those that the planned motion may have; of hinges, the usual limit at most, as arms
    seldom move faster, and a faster motion is one of its own.
    """
    speeds = problem.limits.velocity
    usual = np.minimum(speeds, DEFAULT_MAX_VELOCITY)
    return np.where(problem.robot.is_slide, speeds, usual)


@dataclass(frozen=True)
class Judgement:
    """Motions on which a model file is judged, and what may be wrong with an arm on them.

    Attributes:
        arm: all terms of the arm.
        sums: of the motions; their torque is minus what no term has.
        motions: made up all over the arm's range.
        torque: (J,) root mean square of each joint's torque by the model, ``PLANNED_LEAST`` of the
            strongest joint's at least [N m].
    """

    arm: ArmTerms
    sums: Sums
    motions: Sequence[Motion]
    torque: Array

    @classmethod
    def of(cls, problem: ExcitationProblem, arm: ArmTerms) -> Judgement:
        """Return the judgement of an arm's files, the same in every call."""
        rng = np.random.default_rng(0)
        motions = [*made_up_motions(problem.robot, judging_speeds(problem), rng)]
        point = replace(arm.start(), friction=arm.model)
        sums = sums_elsewhere(arm, point, motions)
        squares = sums.squared_residuals(model_values(arm, sums.names))
        torque = np.sqrt(squares / sums.row_counts)
        least = usual_errors.PLANNED_LEAST * np.max(torque)
        return cls(arm, sums, motions, np.maximum(torque, least))

    def terms(self, options: EstimationOptions, is_replaced: bool) -> list[Term]:
        """Return all terms of the arm, each with how far it usually is from the model.

        Args:
            options: of the identification.
            is_replaced: whether the last link may carry another tool than the model's, so that
                nothing is known of it; else it is as far off as links usually are.
        """
        arm = self.arm
        dry = usual_errors.PLANNED_DRY * self.torque
        question = Question(
            options, link_scales=EXPECTED, dry=tuple(dry.tolist()), usual_offsets=True
        )
        terms = []
        for term in arm_question(arm, question, self.torque):
            prior = term.prior
            if term.cause == LAST_LINK:
                prior = self._last_link(options, is_replaced)
            if prior is None:
                prior = self._usual_friction(term)
            else:
                # Priors of an estimate are as cautious as the errors that it prints.
                share = usual_errors.ERRORS_AS_THEY_ARE
                prior = Prior(prior.mean, share * prior.factor)
            term = replace(term, prior=prior)
            if term.cause != DELAY:
                terms.append(term)
        # A file's fit has the offsets of sensors whatever the friction model is.
        if all(term.key != OFFSET.name for term in terms):
            usual = usual_offset(arm, self.torque)
            prior = independent(np.full(len(arm.joints), usual))
            terms.append(replace(arm.terms[OFFSET.name], prior=prior))
        return terms

    def _last_link(self, options: EstimationOptions, is_replaced: bool) -> Prior:
        """Return the prior of the last link."""
        robot = self.arm.robot
        if is_replaced:
            return independent(robot.prior.scale)
        share = PER_CENT * max(options.priors.link, usual_errors.LINK)
        factor = link_factor(robot, [robot.n_joints - 1], share, EXPECTED)
        return Prior(np.zeros(len(factor)), factor)

    def _usual_friction(self, term: Term) -> Prior:
        """Return the prior of friction and rotors, which an identification finds without one.

        Each makes a share of the torque of the joints at which it acts.
        """
        at = self.sums.at(term.names)
        squares = self.sums.squares[:, at] / self.sums.row_counts[:, None]
        column = np.sqrt(np.sum(squares, axis=0))
        torque = np.sqrt(self.torque**2 @ (squares > 0.0))
        shares = [
            usual_errors.PLANNED_ROTOR
            if parameter.name == ROTOR.name
            else usual_errors.PLANNED_FRICTION
            for parameter in term.parameters
        ]
        return independent(shares * torque / np.where(column > 0.0, column, np.inf))

    def products(self, terms: Sequence[Term]) -> Array:
        """Return the products (P, P) of the columns of terms, but for constant torques.

        A constant torque at a joint counts as an offset of its sensor, and not as an error.
        """
        products = products_of(self.sums, terms, np.ones(len(self.torque)))
        names = [name for term in terms for name in term.names]
        for name in self.arm.terms[OFFSET.name].names:
            products = without_constant(products, names.index(name))
        return products

    def expected_file(self, fitted: Fit, is_replaced: bool) -> ExpectedFile:
        """Return what the file is expected to be that is fitted to a planned motion's recording.

        Args:
            fitted: the fit to expect of the recording, with the noise of its rows.
            is_replaced: as in ``terms``.
        """
        options = fitted.question.options
        terms = self.terms(options, is_replaced)
        units = units_of(terms)
        products = self.products(terms)
        lengths = [len(term.names) for term in terms]
        held = in_file(terms, options.kept)
        is_friction = np.repeat([_is_friction(term) for term in terms], lengths)
        is_offset = np.repeat([term.key == OFFSET.name for term in terms], lengths)
        bounded = np.concatenate(
            [
                [parameter.lower == 0.0 for parameter in term.parameters]
                for term in terms
            ]
        )
        refitted = held & (is_friction | is_offset)
        squares = units.T @ products @ units
        errors = FileErrors(squares, held, refitted, held & bounded)
        recorded = products_of(fitted.sums, terms, fitted.weights)
        information = units.T @ recorded @ units + np.eye(len(units))
        covariance = errors.covariance(information)

        names = self.sums.names
        model = model_values(self.arm, names)
        torque_squares = np.sum(self.sums.squared_residuals(model)) + errors.before

        at = np.flatnonzero(is_friction)
        friction = errors.elsewhere[np.ix_(at, at)]
        friction_errors = np.vdot(friction, covariance[np.ix_(at, at)])
        stated = model[self.sums.at([n for term in terms for n in term.names])][at]
        of_model = stated @ products[np.ix_(at, at)] @ stated
        friction_squares = of_model + np.trace(friction)
        speeds = np.concatenate([each.qd for each in self.motions])
        fastest = np.max(np.abs(speeds), axis=0)
        speed, unit = highest_speed(self.arm.robot, fastest)
        return ExpectedFile(
            speed=speed,
            speed_unit=unit,
            before=float(np.sqrt(errors.before / torque_squares)),
            after=float(
                np.sqrt(np.vdot(errors.elsewhere, covariance) / torque_squares)
            ),
            friction=float(np.sqrt(friction_errors / friction_squares))
            if len(at)
            else None,
        )


def model_values(arm: ArmTerms, names: Sequence[str]) -> Array:
    """Return the model's values (p,) of parameters."""
    return np.array([arm.model.get(name, 0.0) for name in names])


def products_of(sums: Sums, terms: Sequence[Term], weights: Array) -> Array:
    """Return the products (P, P) of weighted columns; ``weights`` (J,) are those of the joints."""
    equations = Equations(sums, terms, np.zeros(len(sums.names)))
    return equations.data(weights)[:-1, :-1]


def units_of(terms: Sequence[Term]) -> Array:
    """Return the factor (P, P) of the prior covariance of terms that all have a prior."""
    from scipy.linalg import block_diag

    factors = [term.prior.factor for term in terms if term.prior is not None]
    return np.asarray(block_diag(*factors))


def in_file(terms: Sequence[Term], kept: Sequence[str]) -> NDArray[np.bool_]:
    """Return which of the parameters (P,) of terms the fit of a model file has.

    ``kept`` is what the file keeps of the model.
    """
    held = [np.full(len(term.names), is_held(term, kept)) for term in terms]
    return np.concatenate(held)


def is_held(term: Term, kept: Sequence[str] = ()) -> bool:
    """Return whether the fit of a model file has a term: a file holds it, or it is an offset."""
    first = term.parameters[0]
    if term.cause == LAST_LINK or first.name == OFFSET.name:
        return True
    if term.cause == LINKS:
        return FILE_LINKS not in kept
    if term.cause not in (FRICTION, MOTORS) or not first.attribute:
        return False
    return (FILE_ROTORS if first.name == ROTOR.name else FILE_FRICTION) not in kept


def _is_friction(term: Term) -> bool:
    """Return whether a term is friction of joints, or of motors that turn several."""
    return term.cause in (FRICTION, FURTHER_FRICTION, MOTORS) and bool(
        term.parameters[0].is_friction
    )
