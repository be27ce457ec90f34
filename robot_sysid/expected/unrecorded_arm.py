"""How far off the written model file will be on any motion, before any torque is measured.

Any motion is one of those that are made up all over the arm's range (``motions``). What is not as
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
from robot_sysid.estimate.equations.normal import Equations
from robot_sysid.estimate.fit import Fit
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
from robot_sysid.expected.errors import expected
from robot_sysid.expected.file_errors import FileFit
from robot_sysid.expected.knowledge import Knowledge
from robot_sysid.expected.motions import highest_speed, made_up_motions, sums_elsewhere
from robot_sysid.expected.planned_arm import PlannedArm
from robot_sysid.records import Array, Motion
from robot_sysid.records.option_fields import DEFAULT_MAX_VELOCITY


def judging_speeds(problem: PlannedArm) -> Array:
    """Return the highest speeds (n,) of the motions that a file is judged on [rad/s or m/s].

    They are those that the planned motion may have; of hinges, the usual limit at most, as arms
    seldom move faster, and a faster motion is one of its own.
    """
    speeds = problem.limits.velocity
    usual = np.minimum(speeds, DEFAULT_MAX_VELOCITY)
    return np.where(problem.robot.is_slide, speeds, usual)


@dataclass(frozen=True)
class ExpectedFile:
    """How far off a written model file is expected to be on motions all over the arm's range.

    Attributes:
        speed: highest speed of these motions.
        speed_unit: its unit.
        before: torque error of the given model over the torque, both root mean squares of all
            joints together; constant torques, which sensors add, are no errors.
        after: the same of the file.
        friction: error of the file's friction over the friction; None where none is estimated.
        least: what ``after`` is where the arm has as little friction as arms have at least.
    """

    speed: float
    speed_unit: str
    before: float
    after: float
    friction: float | None
    least: float


@dataclass(frozen=True)
class UnrecordedArm:
    """An arm before any log: the motions on which its file is judged, and how far off it may be.

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
    def of(cls, problem: PlannedArm, arm: ArmTerms) -> UnrecordedArm:
        """Return an arm of which there is no log, with the same motions in every call."""
        rng = np.random.default_rng(0)
        motions = [*made_up_motions(problem.robot, judging_speeds(problem), rng)]
        point = replace(arm.start(), friction=arm.model)
        sums = sums_elsewhere(arm, point, motions)
        squares = sums.squared_residuals(model_values(arm, sums.names))
        torque = np.sqrt(squares / sums.row_counts)
        least = usual_errors.PLANNED_LEAST * np.max(torque)
        return cls(arm, sums, motions, np.maximum(torque, least))

    def terms(
        self, options: EstimationOptions, is_replaced: bool, rubbing: float = 1.0
    ) -> list[Term]:
        """Return all terms of the arm, each with how far it usually is from the model.

        Args:
            options: of the identification.
            is_replaced: whether the last link may carry another tool than the model's, so that
                nothing is known of it; else it is as far off as links usually are.
            rubbing: friction of the arm, over that of an arm that has much of it.
        """
        arm = self.arm
        dry = rubbing * usual_errors.PLANNED_DRY * self.torque
        question = Question(
            options, link_scales=EXPECTED, dry=tuple(dry.tolist()), usual_offsets=True
        )
        terms = []
        for term in arm_question(arm, question, self.torque):
            prior = term.prior
            if term.cause == LAST_LINK:
                prior = self._last_link(options, is_replaced)
            if prior is None:
                prior = self._usual_friction(term, rubbing)
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

    def _usual_friction(self, term: Term, rubbing: float) -> Prior:
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
            else rubbing * usual_errors.PLANNED_FRICTION
            for parameter in term.parameters
        ]
        return independent(shares * torque / np.where(column > 0.0, column, np.inf))

    def expected_file(self, fitted: Fit, is_replaced: bool) -> ExpectedFile:
        """Return what the file is expected to be that is fitted to a planned motion's recording.

        How much friction an arm has, nothing tells before a log.

        Args:
            fitted: the fit to expect of the recording, with the noise of its rows.
            is_replaced: as in ``terms``.
        """
        options = fitted.question.options
        terms = self.terms(options, is_replaced)
        units = units_of(terms)
        of_model = self._knowledge(terms, units @ units.T)
        of_file = self._file_knowledge(fitted, terms)
        little = self.terms(options, is_replaced, usual_errors.LITTLE_FRICTION)

        sums = self.sums
        model = self.arm.model
        before = expected(model, of_model, sums)
        after = expected(model, of_file, sums)
        least = expected(model, self._file_knowledge(fitted, little), sums)
        torque = float(np.sum(before.torque) + np.sum(before.of_joints))
        friction = [name for term in terms if _is_friction(term) for name in term.names]
        is_friction = np.isin(sums.names, friction)
        stated = {name: model.get(name, 0.0) for name in friction}
        error = expected(stated, of_file.of(is_friction), sums)
        # A model without any friction is off by all of it.
        whole = expected({}, of_model.of(is_friction), sums)
        speeds = np.concatenate([motion.qd for motion in self.motions])
        fastest = np.max(np.abs(speeds), axis=0)
        speed, unit = highest_speed(self.arm.robot, fastest)
        return ExpectedFile(
            speed=speed,
            speed_unit=unit,
            before=_root_share(before.of_joints, torque),
            after=_root_share(after.of_joints, torque),
            friction=_root_share(error.of_joints, float(np.sum(whole.of_joints)))
            if friction
            else None,
            least=_root_share(least.of_joints, torque),
        )

    def _file_knowledge(self, fitted: Fit, terms: Sequence[Term]) -> Knowledge:
        """Return what a file has, with its errors, that is fitted to a recording to expect."""
        units = units_of(terms)
        recorded = products_of(fitted.sums, terms, fitted.weights)
        information = units.T @ recorded @ units + np.eye(len(units))
        of_unknowns = file_fit(terms, fitted.question.options.kept).covariance(
            information
        )
        return self._knowledge(terms, units @ of_unknowns @ units.T)

    def _knowledge(self, terms: Sequence[Term], covariance: Array) -> Knowledge:
        """Return the model's values, and errors of the parameters of terms (P, P) about them."""
        names = self.sums.names
        at = self.sums.at([name for term in terms for name in term.names])
        of_all = np.zeros((len(names), len(names)))
        of_all[at[:, None], at] = covariance
        return Knowledge(model_values(self.arm, names), of_all)


def _root_share(squares: Array, whole: float) -> float:
    """Return the root of a share of squares (J,) in a whole."""
    return float(np.sqrt(np.sum(squares) / whole))


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


def file_fit(terms: Sequence[Term], kept: Sequence[str]) -> FileFit:
    """Return how a model file is fitted of the parameters (P,) of terms.

    ``kept`` is what the file keeps of the model.
    """
    lengths = [len(term.names) for term in terms]
    is_refitted = [_is_friction(term) or term.key == OFFSET.name for term in terms]
    bounded = [
        parameter.lower == 0.0 for term in terms for parameter in term.parameters
    ]
    held = in_file(terms, kept)
    return FileFit(held, held & np.repeat(is_refitted, lengths), held & bounded)


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
